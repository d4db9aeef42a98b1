"""OctoMap octrees as maps, and their files, `.ot` (log-odds) and `.bt` (occupied or free).

OctoMap recurses as deep as a file says and does not notice its end, so a damaged file could end the process.
Files are checked before OctoMap reads them.
"""

from __future__ import annotations

import json
import struct
import tempfile
import zlib
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import DAMAGED_CONTENT, DataError, InvalidArgumentError, MissingDataError
from gmmtorch.experiments.baselines.samples import cut_beams
from gmmtorch.kernels import traverse
from gmmtorch.occupancy import BaselineMap, check_resolution, optional_length
from gmmtorch.optional_packages import load_pyoctomap
from gmmtorch.scan import Scan

_BINARY, _FULL = b"# Octomap OcTree binary file", b"# Octomap OcTree file"
_DEPTH = 16
_MAX_NODES = 1 << 25
_MAX_HEADER_BYTES = 1 << 16
_NODE = struct.Struct("<fB")  # log-odds, and a bit for each child
_INNER = 3  # two bits of a child in .bt; 1: free leaf, 2: occupied leaf


def read_octree_file(path: str | Path) -> bytes:
    """The content of a file. Raises `MissingDataError`, and `DataError` for more than 2²⁵ nodes take."""
    path = Path(path).expanduser()
    if not path.is_file():
        raise MissingDataError(f"{path} does not exist; expected an OctoMap file (.bt or .ot).")
    if path.stat().st_size > _MAX_HEADER_BYTES + _MAX_NODES * _NODE.size:
        raise DataError(f"{path} has {path.stat().st_size:,} bytes, more than {_MAX_NODES:,} nodes take.")
    return path.read_bytes()


def parsed_octree(data: bytes, path: str | Path) -> tuple[Any, float]:
    """OctoMap's octree in the content of a file, and the side of its cells (m).

    Raises `DataError` for files that are not an OcTree, are damaged, or have more than 2²⁵ nodes.
    """
    path = Path(path)
    binary, announced, resolution, begin = _header(data, path)
    check = _count_binary if binary else _count_full
    n_nodes = check(data, begin, path) if len(data) > begin else 0
    if n_nodes != announced:
        raise DataError(f"{path} announces {announced:,} nodes, but has {n_nodes:,}; it is damaged.")
    # OctoMap can only read from disk; it gets a header of ours.
    text = f"\nid OcTree\nsize {n_nodes}\nres {resolution!r}\ndata\n".encode()
    tree = load_pyoctomap().OcTree(resolution)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "tree"
        file.write_bytes((_BINARY if binary else _FULL) + text + data[begin:])
        if not binary:
            tree = tree.read(str(file))
        elif not tree.readBinary(str(file)):
            tree = None
    if tree is None:
        raise DataError("OctoMap does not read this octree.")
    return tree, resolution


def _header(data: bytes, path: Path) -> tuple[bool, int, float, int]:
    """Whether it is a `.bt` file, the number of nodes, the side of a cell (m), and where the nodes begin."""
    binary = data.startswith(_BINARY)
    if not (binary or data.startswith(_FULL)):
        raise DataError(f"{path} does not begin as OctoMap's .bt and .ot files do.")
    end = data.find(b"\ndata\n", 0, _MAX_HEADER_BYTES)
    lines = data[:end].decode("ascii", errors="replace").splitlines()
    fields = dict(
        line.split(maxsplit=1) for line in lines if not line.startswith("#") and " " in line.strip()
    )
    kind = fields.get("id")
    if end >= 0 and kind not in ("OcTree", "1", None):
        raise DataError(f"{path} contains a tree of type {kind}; only OcTree is read. Convert it to OcTree.")
    try:
        n_nodes, resolution = int(fields["size"]), check_resolution(float(fields["res"]))
    except (KeyError, ValueError, InvalidArgumentError) as error:
        raise DataError(f"{path}: its header is damaged ({error!r}).") from error
    if end < 0 or kind is None:
        raise DataError(f"{path}: its header is damaged: id or data is missing.")
    if not 0 <= n_nodes <= _MAX_NODES:
        raise DataError(f"{path} announces {n_nodes:,} nodes; at most {_MAX_NODES:,} are read.")
    return binary, n_nodes, resolution, end + len(b"\ndata\n")


def _count_full(data: bytes, begin: int, path: Path) -> int:
    """Number of nodes of an .ot file, in depth-first order. Raises unless they end where the file ends."""
    n_bytes = len(data) - begin
    if n_bytes % _NODE.size:
        raise DataError(f"{path} ends within a node; it is cut off, so fetch it again.")
    nodes = np.frombuffer(data, np.dtype([("log_odds", "<f4"), ("children", "u1")]), offset=begin)
    if not np.isfinite(nodes["log_odds"]).all():
        raise DataError(f"{path} has nodes without a finite probability; it is damaged.")
    n_children = np.unpackbits(nodes["children"][:, None], axis=1).sum(1)
    _check_depths(n_children, path)
    return len(nodes)


def _count_binary(data: bytes, begin: int, path: Path) -> int:
    """Number of nodes of a .bt file, whose records are the nodes with children, in depth-first order."""
    if (len(data) - begin) % 2:
        raise DataError(f"{path} ends within a node; it is cut off, so fetch it again.")
    records = np.frombuffer(data, "<u2", offset=begin)
    kinds = (records[:, None] >> np.arange(0, 16, 2, dtype=np.uint16)) & 3
    _check_depths((kinds == _INNER).sum(1), path, deepest=_DEPTH - 1)
    return 1 + int((kinds != 0).sum())


def _check_depths(n_children: np.ndarray, path: Path, deepest: int = _DEPTH) -> None:
    """Raises unless records with these numbers of children, depth first, are one tree of limited depth."""
    waiting = [0]
    for place, n in enumerate(n_children.tolist()):
        if not waiting:
            raise DataError(f"{path} has {len(n_children) - place} nodes after its tree; it is damaged.")
        depth = waiting.pop()
        if n:
            if depth == deepest:
                raise DataError(f"{path} has nodes deeper than {_DEPTH} levels; it is damaged.")
            waiting += [depth + 1] * n
    if waiting:
        raise DataError(f"{path} ends before its tree does; it is cut off, so fetch it again.")


_MARK = b"# gmmtorch.octomap_map 1 "
_TREE_REACH = (1 << 15) - 2  # cells from the tree's centre along each axis, because keys have 16 bits


class OctoMapMap(BaselineMap):
    """An octree of cells with log-odds (Hornung et al. 2013), by the authors' code.

    As in OctoMap's insertion of point clouds, a scan updates a cell at most once: as a hit if it contains a
    return, otherwise as a miss if a beam passed through it. Beams without return add misses only. A 2D map is
    one flat layer of the octree. The octree's centre is at the first sensor origin, so that maps far from the
    world origin stay exact.

    Args:
        resolution: side of a cell (m).
        hit: occupancy probability of a cell after one hit; all defaults are OctoMap's.
        miss: the same after one miss.
        clamp_low: least probability of a cell.
        clamp_high: largest probability of a cell.
        max_range: longer beams are cut there (m) and add misses only; None: no limit.
        by_ray: inserts beam by beam, so that a scan updates a cell once for each beam through it; slow.
    """

    suffix = ".ot"

    def __init__(
        self,
        resolution: float,
        *,
        hit: float = 0.7,
        miss: float = 0.4,
        clamp_low: float = 0.1192,
        clamp_high: float = 0.971,
        max_range: float | None = None,
        by_ray: bool = False,
    ) -> None:
        self.resolution = check_resolution(resolution)
        for name, value, low, high in (
            ("hit", hit, 0.5, 1),
            ("miss", miss, 0, 0.5),
            ("clamp_low", clamp_low, 0, 0.5),
            ("clamp_high", clamp_high, 0.5, 1),
        ):
            if not low < value < high:
                raise InvalidArgumentError(f"{name}={value} must lie between {low} and {high}.")
        self.hit, self.miss, self.clamp_low, self.clamp_high = hit, miss, clamp_low, clamp_high
        self.max_range = optional_length("max_range", max_range)
        self.by_ray = by_ray
        self._tree: Any = None
        self._anchor: Tensor | None = None  # (D,) int64, the cell at the octree's centre

    @property
    def device(self) -> torch.device:
        return torch.device("cpu")

    def _start(self, dim: int, device: torch.device) -> None:
        self._tree = load_pyoctomap().OcTree(self.resolution)
        self._set_sensor_model()

    def _set_sensor_model(self) -> None:
        self._tree.setProbHit(self.hit)
        self._tree.setProbMiss(self.miss)
        self._tree.setClampingThresMin(self.clamp_low)
        self._tree.setClampingThresMax(self.clamp_high)

    def _learn(self, scan: Scan) -> None:
        if self._anchor is None:
            self._anchor = (scan.origin.double() / self.resolution).floor().long()
        origin = self._local(scan.origin.double()[None])
        ends = self._local(torch.cat([scan.points, scan.no_return]).double())
        farthest = torch.cat([origin, ends]).abs().max()
        if float(farthest) > _TREE_REACH * self.resolution:
            raise InvalidArgumentError(
                f"resolution={self.resolution} m: an octree reaches {_TREE_REACH * self.resolution:.3g} m "
                "from its first sensor origin, and a beam leaves it; use a coarser resolution, or drop stray "
                "points."
            )
        hits, no_return = ends[: scan.points.shape[0]], ends[scan.points.shape[0] :]
        limit = -1.0 if self.max_range is None else self.max_range
        # Not lazy, because only direct updates merge equal siblings.
        clouds = [hits[i : i + 1] for i in range(hits.shape[0])] if self.by_ray else [hits]
        for cloud in clouds:
            self._tree.insertPointCloud(cloud.numpy(), origin[0].numpy(), limit)
        if no_return.shape[0]:
            self._add_misses(origin, hits, no_return)

    def _add_misses(self, origin: Tensor, hits: Tensor, no_return: Tensor) -> None:
        """Adds misses along beams without return, except in cells that the scan's returns have updated."""
        if self.max_range is not None:
            no_return = cut_beams(origin, no_return, self.max_range)
        units = torch.cat([origin, hits, no_return]) / self.resolution
        low = units.floor().amin(0)
        shape = tuple((units.floor().amax(0) - low + 1).long().tolist())
        passed = self._cells_passed(origin, no_return, shape, low)
        count = torch.bincount(passed) if self.by_ray else torch.bincount(passed).clamp_max(1)
        if not self.by_ray and hits.shape[0]:
            updated = torch.cat(
                [
                    self._cells_passed(origin, hits, shape, low),
                    _flat_index(hits / self.resolution, shape, low),
                ]
            ).unique()
            count[updated[updated < count.shape[0]]] = 0
        cells = torch.stack(torch.unravel_index(torch.repeat_interleave(count), shape), 1)
        self._tree.updateNodes(((cells + low + 0.5) * self.resolution).numpy(), False)

    def _cells_passed(self, origin: Tensor, ends: Tensor, shape: tuple[int, ...], low: Tensor) -> Tensor:
        """Flat index of every cell that a beam to each end (B, 3) enters and leaves."""
        starts = (origin / self.resolution).expand_as(ends)
        visits = traverse(starts, ends / self.resolution, shape, low=low)
        return torch.cat([torch.empty(0, dtype=torch.int64), *(voxel for voxel, _ in visits)])

    def _local(self, points: Tensor) -> Tensor:
        """Points (M, 3) in the octree's frame; 2D points are in the middle of the layer above zero."""
        anchor = torch.zeros(points.shape[1]) if self._anchor is None else self._anchor
        local = points - anchor.double() * self.resolution
        if local.shape[1] == 2:
            local = torch.nn.functional.pad(local, (0, 1), value=self.resolution / 2)
        return local

    def _answer(self, query: Tensor) -> Tensor:
        local = self._local(query)
        inside = (local.abs() < _TREE_REACH * self.resolution).all(1)
        theta = query.new_full((query.shape[0],), 0.5)
        search = self._tree.search
        found = (search(point) for point in local[inside].numpy())
        values = [0.5 if node is None else node.getOccupancy() for node in found]
        theta[inside] = torch.tensor(values, dtype=torch.float64)
        return theta

    def _facts(self) -> dict[str, Any]:
        return {**super()._facts(), "anchor": None if self._anchor is None else self._anchor.tolist()}

    def _serialized(self) -> bytes:
        """OctoMap's .ot file, with a comment line that contains the facts and a checksum."""
        tree = self._tree.write()
        if not isinstance(tree, bytes):
            raise DataError("OctoMap could not serialize its octree.")
        first, rest = tree.split(b"\n", 1)
        facts = json.dumps(self._facts(), sort_keys=True).encode()
        head, tail = first + b"\n" + _MARK, b" " + facts + b"\n" + rest
        return head + _checksum(head + tail) + tail

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Reads a map that `save` wrote. Raises `DataError` for other or damaged content."""
        data = read_octree_file(path)
        at = data.find(_MARK) + len(_MARK)
        if at < len(_MARK) or _checksum(data[:at] + data[at + 8 :]) != data[at : at + 8]:
            raise DataError(f"{path} is damaged, or not an OctoMap file that gmmtorch wrote.")
        try:
            facts = json.loads(data[at + 8 : data.index(b"\n", at)])
            anchor = facts.pop("anchor")
            anchor = None if anchor is None else torch.tensor(anchor, dtype=torch.int64)
        except DAMAGED_CONTENT as error:
            raise DataError(f"{path}: its settings are damaged ({error!r}).") from error
        made = cls._from_facts(facts, path)
        made._anchor = anchor
        made._tree, _ = parsed_octree(data, path)
        made._tree.setResolution(made.resolution)  # the file has only six digits of it
        made._set_sensor_model()
        return made

    @classmethod
    def from_octree(cls, path: str | Path) -> Self:
        """A 3D map with the octree of another program's `.bt` or `.ot` file; further scans can be inserted.

        A `.bt` file has two classes: its cells get the probabilities `clamp_low` and `clamp_high`. Raises
        `MissingDataError` for a missing and `DataError` for a damaged or another file.
        """
        tree, resolution = parsed_octree(read_octree_file(path), path)
        made = cls(resolution)
        made._start(3, made.device)
        made.dim, made._tree, made._anchor = 3, tree, torch.zeros(3, dtype=torch.int64)
        made._set_sensor_model()
        return made


def _flat_index(units: Tensor, shape: tuple[int, ...], low: Tensor) -> Tensor:
    """Row-major index (M,) of the cells that contain points (M, 3), given in cells."""
    strides = torch.tensor([shape[1] * shape[2], shape[2], 1])
    return ((units.floor() - low).long() * strides).sum(1)


def _checksum(data: bytes) -> bytes:
    return f"{zlib.crc32(data):08x}".encode()

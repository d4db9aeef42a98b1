"""OctoMapMap: OctoMap itself, through pyoctomap, behind the protocol of every map."""

from __future__ import annotations

import json
import tempfile
import zlib
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gmmtorch.baselines.baseline_map import BaselineMap
from gmmtorch.baselines.samples import check_range
from gmmtorch.errors import DataError, InvalidArgumentError, MissingDataError
from gmmtorch.occupancy.grid import check_resolution
from gmmtorch.occupancy.voxels.ray_traversal import traverse
from gmmtorch.optional_packages import load_pyoctomap
from gmmtorch.scan import Scan

_MARK = b"# gmmtorch.octomap_map 1 "
_TREE_REACH = (1 << 15) - 2  # cells from the tree's middle, along each axis: its keys have 16 bits


class OctoMapMap(BaselineMap):
    """An octree of cells whose log-odds every scan updates (Hornung et al. 2013), by the authors' code.

    As OctoMap inserts point clouds, a scan updates a cell at most once: as a hit if a return lies in
    it, else as a miss if a beam passed through it. Beams without return free their way only. In 2D the
    scene is one flat layer of the octree. The octree's middle is at the first sensor position, so
    that maps far from the origin keep their digits.

    Args:
        resolution: side of a cell (m).
        hit: probability that a cell is occupied given one hit; 0.7 is OctoMap's own, as are the others.
        miss: the same given one miss.
        clamp_low: least probability of a cell.
        clamp_high: largest probability of a cell.
        max_range: beams are cut there, and free their way only (m).
        by_ray: insert beam by beam, so that a scan updates a cell once for every beam that meets it;
            slow.
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
        self.max_range = check_range(max_range)
        self.by_ray = by_ray
        self._tree: Any = None
        self._anchor: Tensor | None = None  # (D,) cell at the octree's middle, int64

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

    # -- learning ---------------------------------------------------------------------------------

    def _learn(self, scan: Scan) -> None:
        if self._anchor is None:
            self._anchor = (scan.origin.double() / self.resolution).floor().long()
        origin = self._local(scan.origin.double()[None])
        ends = self._local(torch.cat([scan.points, scan.no_return]).double())
        furthest = torch.cat([origin, ends]).abs().max()
        if float(furthest) > _TREE_REACH * self.resolution:
            raise InvalidArgumentError(
                f"resolution={self.resolution} m: an octree reaches {_TREE_REACH * self.resolution:.3g} m "
                "from its first sensor position, and a beam leaves it; take a coarser one, or drop stray "
                "points."
            )
        hits, empty = ends[: scan.points.shape[0]], ends[scan.points.shape[0] :]
        limit = -1.0 if self.max_range is None else self.max_range
        # Not lazily: the octree merges equal siblings as it is updated, which it offers no other way.
        clouds = [hits[i : i + 1] for i in range(hits.shape[0])] if self.by_ray else [hits]
        for cloud in clouds:
            self._tree.insertPointCloud(cloud.numpy(), origin[0].numpy(), limit)
        if empty.shape[0]:
            self._free_the_way(origin, hits, empty)

    def _free_the_way(self, origin: Tensor, hits: Tensor, empty: Tensor) -> None:
        """Free the cells of beams without return, save those that the scan's returns have updated."""
        if self.max_range is not None:
            length = (empty - origin).norm(dim=1, keepdim=True)
            empty = origin + (empty - origin) * (self.max_range / length.clamp_min(self.max_range))
        units = torch.cat([origin, hits, empty]) / self.resolution
        low = units.floor().amin(0)
        shape = tuple((units.floor().amax(0) - low + 1).long().tolist())
        passed = self._cells_on_the_way(origin, empty, shape, low)
        freed = torch.bincount(passed) if self.by_ray else torch.bincount(passed).clamp_max(1)
        if not self.by_ray and hits.shape[0]:
            touched = torch.cat(
                [self._cells_on_the_way(origin, hits, shape, low), _flat(hits / self.resolution, shape, low)]
            ).unique()
            freed[touched[touched < freed.shape[0]]] = 0
        cells = torch.repeat_interleave(freed)
        rest, columns = cells, []
        for size in reversed(shape):
            columns.append(rest % size)
            rest = rest // size
        centers = (torch.stack(columns[::-1], 1) + low + 0.5) * self.resolution
        self._tree.updateNodes(centers.numpy(), False)

    def _cells_on_the_way(self, origin: Tensor, ends: Tensor, shape: tuple[int, ...], low: Tensor) -> Tensor:
        """Flat index of every cell that a beam to each end (B, 3) passes through and leaves."""
        starts = (origin / self.resolution).expand_as(ends)
        visits = traverse(starts, ends / self.resolution, shape, low=low)
        return torch.cat([torch.empty(0, dtype=torch.int64), *(visit.voxel for visit in visits)])

    def _local(self, points: Tensor) -> Tensor:
        """Points (M, 3) in the octree's frame: in 2D in the middle of its layer above zero."""
        anchor = torch.zeros(points.shape[1]) if self._anchor is None else self._anchor
        local = points - anchor.double() * self.resolution
        if local.shape[1] == 2:
            local = torch.nn.functional.pad(local, (0, 1), value=self.resolution / 2)
        return local

    # -- answering --------------------------------------------------------------------------------

    def _answer(self, query: Tensor) -> Tensor:
        local = self._local(query)
        inside = (local.abs() < _TREE_REACH * self.resolution).all(1)
        theta = query.new_full((query.shape[0],), 0.5)
        search = self._tree.search
        found = (search(point) for point in local[inside].numpy())
        values = [0.5 if node is None else node.getOccupancy() for node in found]
        theta[inside] = torch.tensor(values, dtype=torch.float64)
        return theta

    # -- keeping ----------------------------------------------------------------------------------

    def _serialized(self) -> bytes:
        """OctoMap's .ot file, with one comment line of what it leaves out, and a check sum."""
        facts = {
            "dim": self.dim,
            "anchor": None if self._anchor is None else self._anchor.tolist(),
            "resolution": self.resolution,
            "hit": self.hit,
            "miss": self.miss,
            "clamp_low": self.clamp_low,
            "clamp_high": self.clamp_high,
            "max_range": self.max_range,
            "by_ray": self.by_ray,
        }
        first, rest = _written(self._tree.write()).split(b"\n", 1)
        about = json.dumps(facts, sort_keys=True).encode()
        head, tail = first + b"\n" + _MARK, b" " + about + b"\n" + rest
        return head + _check_sum(head + tail) + tail

    @classmethod
    def load(cls, path: str | Path) -> OctoMapMap:
        """Read a map that `save` wrote. Raises `DataError` if it is not one, or damaged."""
        path = Path(path)
        if not path.is_file():
            raise MissingDataError(f"{path} does not exist; expected an OctoMap file.")
        data = path.read_bytes()
        at = data.find(_MARK) + len(_MARK)
        if at < len(_MARK) or _check_sum(data[:at] + data[at + 8 :]) != data[at : at + 8]:
            raise DataError(f"{path} is damaged, or no OctoMap file that gmmtorch wrote.")
        try:
            options = json.loads(data[at + 8 : data.index(b"\n", at)])
            dim, anchor = {2: 2, 3: 3}[options.pop("dim")], options.pop("anchor")
            made = cls(**options)
            made._anchor = None if anchor is None else torch.tensor(anchor, dtype=torch.int64)
        except (KeyError, TypeError, ValueError) as error:
            raise DataError(f"{path}: its settings are damaged ({error!r}).") from error
        made._tree = _read_tree(data)
        made._tree.setResolution(made.resolution)  # the file has six digits of it
        made._set_sensor_model()
        made.dim = dim
        return made


def _flat(units: Tensor, shape: tuple[int, ...], low: Tensor) -> Tensor:
    """Row-major index (M,) of the cells that hold the points (M, 3), in cells."""
    cell = (units.floor() - low).long()
    flat = cell[:, 0]
    for axis in range(1, len(shape)):
        flat = flat * shape[axis] + cell[:, axis]
    return flat


def _check_sum(data: bytes) -> bytes:
    return f"{zlib.crc32(data):08x}".encode()


def _written(data: bytes | bool) -> bytes:
    if not isinstance(data, bytes):
        raise DataError("OctoMap could not serialize its octree.")
    return data


def _read_tree(data: bytes) -> Any:
    """The octree of an .ot file; OctoMap reads from disk alone."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "map.ot"
        file.write_bytes(data)
        return load_pyoctomap().OcTree(0.1).read(str(file))

"""OctoMap itself, through pyoctomap, behind the protocol of every map."""

from __future__ import annotations

import json
import zlib
from pathlib import Path
from typing import Any, Self

import torch
from torch import Tensor

from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.experiments.baselines.octree_files import parsed_octree, read_octree_file
from gmmtorch.experiments.baselines.samples import cut_beams
from gmmtorch.kernels import traverse
from gmmtorch.occupancy import BaselineMap, check_resolution, optional_length
from gmmtorch.optional_packages import load_pyoctomap
from gmmtorch.scan import Scan

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

    # -- learning ---------------------------------------------------------------------------------

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
        return torch.cat([torch.empty(0, dtype=torch.int64), *(visit.voxel for visit in visits)])

    def _local(self, points: Tensor) -> Tensor:
        """Points (M, 3) in the octree's frame; 2D points are in the middle of the layer above zero."""
        anchor = torch.zeros(points.shape[1]) if self._anchor is None else self._anchor
        local = points - anchor.double() * self.resolution
        if local.shape[1] == 2:
            local = torch.nn.functional.pad(local, (0, 1), value=self.resolution / 2)
        return local

    # -- queries ----------------------------------------------------------------------------------

    def _answer(self, query: Tensor) -> Tensor:
        local = self._local(query)
        inside = (local.abs() < _TREE_REACH * self.resolution).all(1)
        theta = query.new_full((query.shape[0],), 0.5)
        search = self._tree.search
        found = (search(point) for point in local[inside].numpy())
        values = [0.5 if node is None else node.getOccupancy() for node in found]
        theta[inside] = torch.tensor(values, dtype=torch.float64)
        return theta

    # -- files ------------------------------------------------------------------------------------

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
        except (AttributeError, KeyError, TypeError, ValueError) as error:
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
    cell = (units.floor() - low).long()
    flat = cell[:, 0]
    for axis in range(1, len(shape)):
        flat = flat * shape[axis] + cell[:, axis]
    return flat


def _checksum(data: bytes) -> bytes:
    return f"{zlib.crc32(data):08x}".encode()

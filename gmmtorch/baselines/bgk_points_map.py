"""BGKPointsMap: Bayesian generalized kernel inference from stored samples, at the question itself."""

from __future__ import annotations

import itertools
from pathlib import Path

import torch
from torch import Tensor

from gmmtorch.baselines.baseline_map import BaselineMap
from gmmtorch.baselines.bgk_map import beta_mean, check_positive, sparse_kernel
from gmmtorch.baselines.samples import check_length, check_range, thinned_samples
from gmmtorch.errors import DataError, check_whole
from gmmtorch.files import pack_tensors, read_tensors, require
from gmmtorch.occupancy.grid import MEMORY_LIMIT, check_resolution
from gmmtorch.occupancy.voxels.cell_table import CellTable
from gmmtorch.scan import Scan

_FILE_KIND, _FILE_VERSION = "gmmtorch.bgk_points_map", 1
_FACTS = (
    "dim",
    "resolution",
    "max_points",
    "length",
    "prior",
    "scale",
    "free_resolution",
    "ds_resolution",
    "max_range",
)
_PAIRS_AT_ONCE = 1 << 22
_COARSER = 2**0.125
_LABELS = ("hit", "free")


class BGKPointsMap(BaselineMap):
    """At most `max_points` labelled samples, and Beta posteriors made of them where they are asked for.

    As `BGKMap` (Doherty, Wang & Englot 2017, 2019), but the map is the training data: samples of one
    label that share a cube of side `ds_resolution` are one, at their mean, that weighs as many. When
    there are more than `max_points`, the cubes grow by an eighth power of two until there are not;
    the kernel's length grows with them, so that sparse samples still cover what was seen:

        α(x) = prior + scale · Σ wᵢ k(‖x − xᵢ‖) over hits,   β(x) likewise over free samples,   θ = α/(α + β)

    Where no sample lies within the kernel's length, θ is exactly ½.

    Args:
        resolution: of the questions (m), from which the lengths below follow.
        max_points: samples stored at most, 16 or more; None for no limit.
        length: of the kernel (m), at first; twice the resolution if not given.
        prior: pseudo-counts of either outcome.
        scale: how much one sample counts against the prior.
        free_resolution: distance between the free samples of a beam (m); twice the resolution if not given.
        ds_resolution: side of the cubes (m), at first; the resolution if not given.
        max_range: beams that end beyond are dropped (m).
        memory_limit: bytes that the samples may take.
    """

    def __init__(
        self,
        resolution: float,
        *,
        max_points: int | None = None,
        length: float | None = None,
        prior: float = 0.001,
        scale: float = 1.0,
        free_resolution: float | None = None,
        ds_resolution: float | None = None,
        max_range: float | None = None,
        memory_limit: int = MEMORY_LIMIT,
    ) -> None:
        self.resolution = check_resolution(resolution)
        self.max_points = None if max_points is None else check_whole("max_points", max_points, 16)
        self.length = check_length("length", 2 * self.resolution if length is None else length)
        self.prior = check_positive("prior", prior)
        self.scale = check_positive("scale", scale)
        self.free_resolution = check_length(
            "free_resolution", 2 * self.resolution if free_resolution is None else free_resolution
        )
        self.ds_resolution = check_length(
            "ds_resolution", self.resolution if ds_resolution is None else ds_resolution
        )
        self.max_range = check_range(max_range)
        self.memory_limit = memory_limit
        self._growth = 1.0  # of the cubes and of the kernel's length since the beginning
        self._start(2, torch.device("cpu"))

    @property
    def device(self) -> torch.device:
        return self._tables[0].keys.device

    @property
    def n_points(self) -> int:
        """Samples stored."""
        return sum(table.keys.shape[0] for table in self._tables)

    def _start(self, dim: int, device: torch.device) -> None:
        # Of hits and of free samples; a row: weight, weighted sum of offsets from the cube's centre (m).
        self._tables = [self._new_table(dim, device) for _ in _LABELS]
        self._bins: list[_Bins] | None = None  # made when first asked

    def _new_table(self, dim: int, device: torch.device) -> CellTable:
        side = self.ds_resolution * self._growth
        return CellTable(side, dim, 1 + dim, device, self.memory_limit)

    # -- learning ---------------------------------------------------------------------------------

    def _learn(self, scan: Scan) -> None:
        samples, is_hit = thinned_samples(scan, self.free_resolution, self.ds_resolution, self.max_range)
        self._bins = None
        for table, chosen in zip(self._tables, (is_hit, ~is_hit), strict=True):
            _add(table, samples[chosen], samples.new_ones(int(chosen.sum())))
        while self.max_points is not None and self.n_points > self.max_points:
            self._coarsen()

    def _coarsen(self) -> None:
        """Put the samples into larger cubes."""
        earlier = self._tables
        self._growth *= _COARSER
        self._tables = [self._new_table(table.dim, self.device) for table in earlier]
        for table, finer in zip(self._tables, earlier, strict=True):
            _add(table, *_points(finer))

    # -- answering --------------------------------------------------------------------------------

    def finish(self) -> None:
        """Sort the samples into bins now, rather than at the first question."""
        if self._bins is None:
            self._bins = [_Bins(*_points(table), self.length * self._growth) for table in self._tables]

    def _answer(self, query: Tensor) -> Tensor:
        self.finish()
        hits, misses = (bins.kernel_sum(query) * self.scale for bins in self._bins or [])
        return torch.where(hits + misses > 0, beta_mean(hits, misses, self.prior), 0.5)

    # -- keeping ----------------------------------------------------------------------------------

    def _serialized(self) -> bytes:
        """The cubes of either label, one bit each, and weight and place of their samples as float32."""
        facts = {name: getattr(self, name) for name in _FACTS}
        tensors: dict[str, Tensor] = {}
        for label, table in zip(_LABELS, self._tables, strict=True):
            tensors |= {**table.packed(prefix=f"{label}_"), f"{label}_samples": table.values}
        return pack_tensors(tensors, _FILE_KIND, _FILE_VERSION, growth=self._growth, **facts)

    @classmethod
    def load(cls, path: str | Path) -> BGKPointsMap:
        """Read a map that `save` wrote. Raises `DataError` if it is not one."""
        tensors, facts = read_tensors(path, _FILE_KIND, _FILE_VERSION)
        try:
            options = dict(facts)
            dim, growth = {2: 2, 3: 3}[options.pop("dim")], options.pop("growth")
            made = cls(**options)
            made._growth = check_positive("growth", growth)
            made._start(dim, torch.device("cpu"))
        except (KeyError, TypeError, ValueError) as error:
            raise DataError(f"{path}: its settings are damaged ({error!r}).") from error
        for label, table in zip(_LABELS, made._tables, strict=True):
            table.fill(tensors, path, f"{label}_")
            shape = (table.keys.shape[0], 1 + dim)
            table.values = require(tensors, f"{label}_samples", shape, torch.float32, path)
            if bool((table.values[:, 0] <= 0).any()):
                raise DataError(f"{path}: samples without weight; the file is damaged.")
        made.dim = dim
        return made


def _add(table: CellTable, points: Tensor, weights: Tensor) -> None:
    """Add weighted samples (S, D) to their cubes."""
    if points.shape[0] == 0:
        return
    rows = table.open(table.cells(points))
    offsets = points - table.centers()[rows]
    added = torch.zeros_like(table.values, dtype=torch.float64)
    added.index_add_(0, rows, torch.cat([weights[:, None], weights[:, None] * offsets], 1))
    table.values += added.float()


def _points(table: CellTable) -> tuple[Tensor, Tensor]:
    """Samples (S, D), float64, and weights (S,)."""
    values = table.values.double()
    if values.shape[0] == 0:
        return values[:, 1:], values[:, 0]
    return table.centers() + values[:, 1:] / values[:, :1], values[:, 0]


class _Bins:
    """Weighted points in cubes as wide as the kernel is long, in which its neighbours are found."""

    def __init__(self, points: Tensor, weights: Tensor, length: float) -> None:
        self.length = length
        self.table = CellTable(length, points.shape[1], 0, points.device)
        rows = self.table.open(self.table.cells(points)) if points.shape[0] else points[:, 0].long()
        order = torch.argsort(rows, stable=True)
        self.points, self.weights = points[order], weights[order]
        self.count = torch.bincount(rows)
        self.start = torch.cumsum(self.count, 0) - self.count

    def kernel_sum(self, query: Tensor) -> Tensor:
        """Σ wᵢ k(‖x − xᵢ‖) at each x (M,) of the query (M, D), which may be infinite."""
        total = query.new_zeros(query.shape[0])
        if self.points.shape[0] == 0:
            return total
        for shift in itertools.product((-self.length, 0.0, self.length), repeat=query.shape[1]):
            rows, known = self.table.find(query + query.new_tensor(shift))
            asked = known.nonzero().squeeze(1)
            count = self.count[rows[asked]]
            for part in _portions(count):
                number = torch.repeat_interleave(count[part])
                begin = torch.cumsum(count[part], 0) - count[part]
                within = torch.arange(number.shape[0], device=query.device) - begin[number]
                point = self.start[rows[asked[part]]][number] + within
                at = asked[part][number]
                value = sparse_kernel((query[at] - self.points[point]).norm(dim=1), self.length)
                total.index_add_(0, at, self.weights[point] * value)
        return total


def _portions(count: Tensor) -> list[Tensor]:
    """Indices of `count` (M,) in runs whose counts sum up to little enough to work on at once."""
    portion = torch.div(torch.cumsum(count, 0), _PAIRS_AT_ONCE, rounding_mode="floor")
    _, sizes = torch.unique_consecutive(portion, return_counts=True)
    return list(torch.arange(count.shape[0], device=count.device).split(sizes.tolist()))

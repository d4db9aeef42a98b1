"""Bayesian generalized kernel (BGK) inference of occupancy: on a grid, and from stored samples."""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import Any, Self

import torch
from torch import Tensor

from gmmtorch.errors import DataError, MemoryLimitError, check_number, check_whole
from gmmtorch.experiments.baselines.cell_table import CellMap, CellTable
from gmmtorch.experiments.baselines.samples import thinned_samples
from gmmtorch.files import require
from gmmtorch.linalg import ragged_index
from gmmtorch.occupancy import MEMORY_LIMIT, check_length, check_resolution, optional_length
from gmmtorch.scan import Scan

_CHUNK_PAIRS = 1 << 21
_MAX_OFFSETS = 1 << 20


def sparse_kernel(distance: Tensor, length: float) -> Tensor:
    """Kernel of compact support, Melkumyan & Ramos 2009, (8): 1 at distance 0, 0 from `length` (m) on.

    k(d) = (2 + cos 2πr)/3 · (1 − r) + sin(2πr)/(2π),   r = d/length < 1
    """
    r = distance / length
    turn = 2 * math.pi * r
    value = (2 + turn.cos()) / 3 * (1 - r) + turn.sin() / (2 * math.pi)
    return torch.where(r < 1, value.clamp_min(0), 0.0)


def beta_mean(hits: Tensor, misses: Tensor, prior: float) -> Tensor:
    """Mean of Beta(prior + hits, prior + misses); exactly ½ if hits and misses are equal."""
    return (prior + hits) / (2 * prior + hits + misses)


def kernel_offsets(length: float, resolution: float, dim: int) -> Tensor:
    """Offsets (O, D), int64, from the cell of a sample to all cells whose centre can be within `length` (m).

    Raises `MemoryLimitError` if there are too many.
    """
    reach = math.ceil(length / resolution + 0.5) - 1
    if (2 * reach + 1) ** dim > _MAX_OFFSETS:
        raise MemoryLimitError(
            f"length={length} m reaches {(2 * reach + 1) ** dim:,} cells of {resolution} m from every "
            f"sample, above the limit of {_MAX_OFFSETS:,}; use a shorter length, or a coarser resolution."
        )
    offsets = torch.cartesian_prod(*[torch.arange(-reach, reach + 1)] * dim)
    nearest = ((offsets.abs() - 0.5).clamp_min(0) * resolution).norm(dim=1)
    return offsets[nearest < length]


class BGKMap(CellMap):
    """Cells with a Beta posterior over kernel-weighted counts of hit and free samples.

    Doherty, Wang & Englot 2017, 2019 (la3dm): α = α₀ + Σ k(x, xᵢ) over hits, β likewise over free samples,
    θ = α/(α + β). Each sample contributes to every cell whose centre is within the kernel's length; la3dm
    omits cells in blocks that touch the sample's block only at an edge or corner. Cells without a sample in
    reach are exactly ½.

    Args:
        resolution: side of a cell (m).
        length: of the kernel (m); default twice the resolution, which la3dm uses at 0.1 m.
        prior: pseudo-counts of hits and of misses, la3dm's prior_A and prior_B.
        scale: of the kernel, la3dm's sf2: weight of one sample relative to the prior.
        free_resolution: spacing of the free samples of a beam (m); default twice the resolution. A larger
            spacing leaves gaps.
        ds_resolution: side of the cubes in which a scan's samples are merged (m); default the resolution.
        max_range: beams that end beyond it (m) are dropped; None: no limit.
        memory_limit: largest size of the cells, bytes.
    """

    file_kind = "gmmtorch.bgk_map"
    _content = "sums"  # of the weights of hits, and of free samples

    def __init__(
        self,
        resolution: float,
        *,
        length: float | None = None,
        prior: float = 0.001,
        scale: float = 1.0,
        free_resolution: float | None = None,
        ds_resolution: float | None = None,
        max_range: float | None = None,
        memory_limit: int = MEMORY_LIMIT,
    ) -> None:
        self.resolution = check_resolution(resolution)
        self.length = check_length("length", 2 * self.resolution if length is None else length)
        self.prior = check_number("prior", prior, above=True)
        self.scale = check_number("scale", scale, above=True)
        self.free_resolution = check_length(
            "free_resolution", 2 * self.resolution if free_resolution is None else free_resolution
        )
        self.ds_resolution = check_length(
            "ds_resolution", self.resolution if ds_resolution is None else ds_resolution
        )
        self.max_range = optional_length("max_range", max_range)
        self.memory_limit = memory_limit
        self._start(2, torch.device("cpu"))

    def _samples(self, scan: Scan) -> tuple[Tensor, Tensor]:
        """Thinned samples (S, D) of a scan, and whether each (S,) is a hit."""
        return thinned_samples(scan, self.free_resolution, self.ds_resolution, self.max_range)

    def _learn(self, scan: Scan) -> None:
        samples, is_hit = self._samples(scan)
        offsets = kernel_offsets(self.length, self.resolution, scan.dim).to(samples.device)
        step = max(1, _CHUNK_PAIRS // offsets.shape[0])
        for start in range(0, samples.shape[0], step):
            self._add(samples[start : start + step], is_hit[start : start + step], offsets)

    def _add(self, samples: Tensor, is_hit: Tensor, offsets: Tensor) -> None:
        """Adds samples (S, D) to the cells at `offsets` (O, D) from their own cells."""
        own = self._table.cells(samples)
        within = samples / self.resolution - own  # (S, D), in cells, so exact far from the origin
        distance = ((offsets + 0.5) - within[:, None]).norm(dim=2) * self.resolution  # (S, O)
        weight = self.scale * sparse_kernel(distance, self.length)
        sample, offset = (weight.float() > 0).nonzero(as_tuple=True)
        rows = self._table.open(own[sample] + offsets[offset])
        column = (~is_hit[sample]).long()
        self._table.values.view(-1).index_add_(0, 2 * rows + column, weight[sample, offset].float())

    def _answer(self, query: Tensor) -> Tensor:
        hits, misses = self._table.at(query).unbind(1)
        return beta_mean(hits, misses, self.prior)


_GROWTH_STEP = 2**0.125
_LABELS = ("hit", "free")


class BGKPointsMap(BGKMap):
    """At most `max_points` labelled samples; the Beta posterior of `BGKMap` is computed at the query.

    Samples of one label in a cube of side `ds_resolution` are merged into one, at their mean, with their
    total weight. While there are more than `max_points`, the cubes and the kernel's length grow by a
    factor of 2^(1/8), so that sparse samples still cover the observed space:

        α(x) = prior + scale · Σ wᵢ k(‖x − xᵢ‖) over hits,   β(x) likewise over free samples,   θ = α/(α + β)

    Without a sample within the kernel's length, θ is exactly ½.

    Args:
        resolution: of the queries (m); the default lengths follow from it.
        max_points: largest number of stored samples, 16 or more; None for no limit.
        length, ds_resolution: initial values (m), otherwise as in `BGKMap`.
        prior, scale, free_resolution, max_range, memory_limit: as in `BGKMap`.
    """

    file_kind = "gmmtorch.bgk_points_map"

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
        self.max_points = None if max_points is None else check_whole("max_points", max_points, 16)
        self._growth = 1.0  # factor by which the cubes and the kernel's length have grown
        super().__init__(
            resolution,
            length=length,
            prior=prior,
            scale=scale,
            free_resolution=free_resolution,
            ds_resolution=ds_resolution,
            max_range=max_range,
            memory_limit=memory_limit,
        )

    @property
    def device(self) -> torch.device:
        return self._tables[0].keys.device

    @property
    def n_points(self) -> int:
        """Number of stored samples."""
        return sum(table.keys.shape[0] for table in self._tables)

    def _start(self, dim: int, device: torch.device) -> None:
        # One table of hits and one of free samples.
        # Row: weight, weighted sum of the offsets from the cube's centre (m).
        self._tables = [self._new_table(dim, device) for _ in _LABELS]
        self._bins: list[_Bins] | None = None  # created at the first query

    def _new_table(self, dim: int, device: torch.device) -> CellTable:
        side = self.ds_resolution * self._growth
        return CellTable(side, dim, 1 + dim, device, self.memory_limit)

    def _learn(self, scan: Scan) -> None:
        samples, is_hit = self._samples(scan)
        self._bins = None
        for table, chosen in zip(self._tables, (is_hit, ~is_hit), strict=True):
            _add(table, samples[chosen], samples.new_ones(int(chosen.sum())))
        while self.max_points is not None and self.n_points > self.max_points:
            self._coarsen()

    def _coarsen(self) -> None:
        """Moves the samples into larger cubes."""
        finer = self._tables
        self._growth *= _GROWTH_STEP
        self._tables = [self._new_table(table.dim, self.device) for table in finer]
        for table, earlier in zip(self._tables, finer, strict=True):
            _add(table, *_points(earlier))

    def finish(self) -> None:
        """Sorts the samples into bins, which is otherwise deferred to the first query."""
        if self._bins is None:
            self._bins = [_Bins(*_points(table), self.length * self._growth) for table in self._tables]

    def _answer(self, query: Tensor) -> Tensor:
        self.finish()
        hits, misses = (bins.kernel_sum(query) * self.scale for bins in self._bins or [])
        return torch.where(hits + misses > 0, beta_mean(hits, misses, self.prior), 0.5)

    def _facts(self) -> dict[str, Any]:
        return {**super()._facts(), "growth": self._growth}

    @classmethod
    def _from_facts(cls, facts: dict[str, Any], path: str | Path) -> Self:
        options = dict(facts)
        try:
            growth = check_number("growth", options.pop("growth"), above=True)
        except (KeyError, ValueError) as error:
            raise DataError(f"{path}: its settings are damaged ({error!r}).") from error
        made = super()._from_facts(options, path)
        made._growth = growth
        made._start(made._tables[0].dim, torch.device("cpu"))
        return made

    def _tensors(self) -> dict[str, Tensor]:
        """For each label: the cubes, and weight and position of their samples as float32."""
        tensors: dict[str, Tensor] = {}
        for label, table in zip(_LABELS, self._tables, strict=True):
            tensors |= {**table.packed(prefix=f"{label}_"), f"{label}_samples": table.values}
        return tensors

    def _restore(self, tensors: dict[str, Tensor], path: str | Path) -> None:
        for label, table in zip(_LABELS, self._tables, strict=True):
            table.fill(tensors, path, f"{label}_")
            shape = (table.keys.shape[0], 1 + table.dim)
            table.values = require(tensors, f"{label}_samples", shape, torch.float32, path)
            if bool((table.values[:, 0] <= 0).any()):
                raise DataError(f"{path}: samples have no weight; the file is damaged.")


def _add(table: CellTable, points: Tensor, weights: Tensor) -> None:
    """Adds weighted samples (S, D) to their cubes."""
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
    """Weighted points (S, D) in cubes of the kernel's length, to find the neighbours of a query."""

    def __init__(self, points: Tensor, weights: Tensor, length: float) -> None:
        self.length = length
        self.table = CellTable(length, points.shape[1], 0, points.device)
        rows = self.table.open(self.table.cells(points)) if points.shape[0] else points[:, 0].long()
        order = torch.argsort(rows, stable=True)
        self.points, self.weights = points[order], weights[order]
        self.count = torch.bincount(rows)
        self.start = torch.cumsum(self.count, 0) - self.count

    def kernel_sum(self, query: Tensor) -> Tensor:
        """Σ wᵢ k(‖x − xᵢ‖) (M,) at each x of the query (M, D), which can be infinite."""
        total = query.new_zeros(query.shape[0])
        if self.points.shape[0] == 0:
            return total
        for shift in itertools.product((-self.length, 0.0, self.length), repeat=query.shape[1]):
            rows, known = self.table.find(query + query.new_tensor(shift))
            near = known.nonzero().squeeze(1)
            count = self.count[rows[near]]
            for chunk in _chunks(count):
                number, within = ragged_index(count[chunk])
                point = self.start[rows[near[chunk]]][number] + within
                at = near[chunk][number]
                value = sparse_kernel((query[at] - self.points[point]).norm(dim=1), self.length)
                total.index_add_(0, at, self.weights[point] * value)
        return total


def _chunks(count: Tensor) -> list[Tensor]:
    """Indices of `count` (M,) in consecutive chunks of limited total count."""
    chunk = torch.div(torch.cumsum(count, 0), _CHUNK_PAIRS, rounding_mode="floor")
    _, sizes = torch.unique_consecutive(chunk, return_counts=True)
    return list(torch.arange(count.shape[0], device=count.device).split(sizes.tolist()))

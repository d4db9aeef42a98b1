"""Bayesian generalized kernel (BGK) inference of occupancy on a grid."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from torch import Tensor

from gmmtorch.errors import DataError, MemoryLimitError, check_number
from gmmtorch.experiments.baselines.samples import thinned_samples
from gmmtorch.files import require
from gmmtorch.occupancy import (
    MEMORY_LIMIT,
    CellTable,
    TensorFileMap,
    check_length,
    check_resolution,
    optional_length,
)
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


class BGKMap(TensorFileMap):
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

    @property
    def device(self) -> torch.device:
        return self._table.keys.device

    def _start(self, dim: int, device: torch.device) -> None:
        self._table = CellTable(self.resolution, dim, 2, device, self.memory_limit)

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
        rows, known = self._table.find(query)
        if self._table.keys.shape[0] == 0:
            return query.new_full((query.shape[0],), 0.5)
        hits, misses = self._table.values[rows].double().unbind(1)
        return torch.where(known, beta_mean(hits, misses, self.prior), 0.5)

    def _tensors(self) -> dict[str, Tensor]:
        """The cells, and their two sums as float32."""
        return {**self._table.packed(), "sums": self._table.values}

    def _restore(self, tensors: dict[str, Tensor], path: str | Path) -> None:
        self._table.fill(tensors, path)
        sums = require(tensors, "sums", (self._table.keys.shape[0], 2), torch.float32, path)
        if bool((sums < 0).any()):
            raise DataError(f"{path}: sums contains negative numbers; the file is damaged.")
        self._table.values = sums

"""BGKMap: Bayesian generalized kernel inference of occupancy, on a lattice."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from torch import Tensor

from gmmtorch.baselines.baseline_map import BaselineMap
from gmmtorch.baselines.samples import check_length, check_range, thinned_samples
from gmmtorch.errors import DataError, InvalidArgumentError, MemoryLimitError
from gmmtorch.files import pack_tensors, require
from gmmtorch.occupancy.grid import MEMORY_LIMIT, check_resolution
from gmmtorch.occupancy.voxels.cell_table import CellTable
from gmmtorch.scan import Scan

_FILE_KIND, _FILE_VERSION = "gmmtorch.bgk_map", 1
_PAIRS_AT_ONCE = 1 << 21
_MAX_OFFSETS = 1 << 20


def sparse_kernel(distance: Tensor, length: float) -> Tensor:
    """Compactly supported kernel of Melkumyan & Ramos 2009, (8); 1 at zero, 0 from `length` (m) on.

    k(d) = (2 + cos 2πr)/3 · (1 − r) + sin(2πr)/(2π),   r = d/length < 1
    """
    r = distance / length
    turn = 2 * math.pi * r
    value = (2 + turn.cos()) / 3 * (1 - r) + turn.sin() / (2 * math.pi)
    return torch.where(r < 1, value.clamp_min(0), 0.0)


def check_positive(name: str, value: float) -> float:
    """A number as a float; raises `InvalidArgumentError` unless it is finite and above zero."""
    if not isinstance(value, int | float) or not (math.isfinite(value) and value > 0):
        raise InvalidArgumentError(f"{name}={value!r} must be a finite number above zero.")
    return float(value)


def beta_mean(hits: Tensor, misses: Tensor, prior: float) -> Tensor:
    """Mean of Beta(prior + hits, prior + misses); exactly ½ without any evidence, and where both agree."""
    return (prior + hits) / (2 * prior + hits + misses)


class BGKMap(BaselineMap):
    """Cells whose Beta posterior takes kernel-weighted counts of hit and free samples.

    Doherty, Wang & Englot 2017, 2019 (la3dm): α = α₀ + Σ k(x, xᵢ) over hits, β likewise over free samples,
    θ = α/(α + β). Each sample is given to every cell whose centre lies within the kernel's length of it;
    la3dm leaves out cells in blocks that only touch the sample's at an edge or corner. Cells that no
    sample reaches are exactly ½.

    Args:
        resolution: side of a cell (m).
        length: of the kernel (m); twice the resolution if not given, as la3dm has it at 0.1 m.
        prior: pseudo-counts of either outcome, la3dm's prior_A and prior_B.
        scale: of the kernel, la3dm's sf2: how much one sample counts against the prior.
        free_resolution: distance between the free samples of a beam (m); twice the resolution if not
            given: more would leave gaps between them.
        ds_resolution: side of the cubes that a scan's samples are thinned to (m); the resolution if
            not given.
        max_range: beams that end beyond are dropped (m).
        memory_limit: bytes that the cells may take.
    """

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
        self._table = CellTable(self.resolution, 2, 2)

    @property
    def device(self) -> torch.device:
        return self._table.keys.device

    def _start(self, dim: int, device: torch.device) -> None:
        self._table = CellTable(self.resolution, dim, 2, device, self.memory_limit)

    def _learn(self, scan: Scan) -> None:
        samples, is_hit = thinned_samples(scan, self.free_resolution, self.ds_resolution, self.max_range)
        offsets = kernel_offsets(self.length, self.resolution, scan.dim).to(samples.device)
        for part in range(0, samples.shape[0], max(1, _PAIRS_AT_ONCE // offsets.shape[0])):
            stop = part + max(1, _PAIRS_AT_ONCE // offsets.shape[0])
            self._spread(samples[part:stop], is_hit[part:stop], offsets)

    def _spread(self, samples: Tensor, is_hit: Tensor, offsets: Tensor) -> None:
        """Give samples (S, D) to the cells at `offsets` (O, D) from their own."""
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

    # -- keeping ----------------------------------------------------------------------------------

    def _serialized(self) -> bytes:
        """Cells, and their two sums as float32: all that answers and further learning need."""
        facts = {
            "dim": self.dim,
            "resolution": self.resolution,
            "length": self.length,
            "prior": self.prior,
            "scale": self.scale,
            "free_resolution": self.free_resolution,
            "ds_resolution": self.ds_resolution,
            "max_range": self.max_range,
        }
        tensors = {**self._table.packed(), "sums": self._table.values}
        return pack_tensors(tensors, _FILE_KIND, _FILE_VERSION, **facts)

    @classmethod
    def load(cls, path: str | Path) -> BGKMap:
        """Read a map that `save` wrote. Raises `DataError` if it is not one."""
        made, tensors = cls._opened(path, _FILE_KIND, _FILE_VERSION)
        made._table.fill(tensors, path)
        sums = require(tensors, "sums", (made._table.keys.shape[0], 2), torch.float32, path)
        if bool((sums < 0).any()):
            raise DataError(f"{path}: sums holds negative numbers; the file is damaged.")
        made._table.values = sums
        return made


def kernel_offsets(length: float, resolution: float, dim: int) -> Tensor:
    """Offsets (O, D), int64, from a sample's cell to those whose centre may lie within `length` of it.

    Raises `MemoryLimitError` when they are too many to visit for every sample.
    """
    reach = math.ceil(length / resolution + 0.5) - 1
    if (2 * reach + 1) ** dim > _MAX_OFFSETS:
        raise MemoryLimitError(
            f"length={length} m reaches {(2 * reach + 1) ** dim:,} cells of {resolution} m from every "
            f"sample, above the limit of {_MAX_OFFSETS:,}; take a shorter one, or a coarser resolution."
        )
    offsets = torch.cartesian_prod(*[torch.arange(-reach, reach + 1)] * dim)
    nearest = ((offsets.abs() - 0.5).clamp_min(0) * resolution).norm(dim=1)
    return offsets[nearest < length]

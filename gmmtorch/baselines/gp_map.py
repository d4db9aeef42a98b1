"""GPMap: local Gaussian processes of occupancy, fused on a lattice."""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.baselines.baseline_map import BaselineMap
from gmmtorch.baselines.samples import check_length, check_range, thinned_samples
from gmmtorch.errors import DataError, InvalidArgumentError, check_whole
from gmmtorch.files import pack_tensors, require
from gmmtorch.linalg import safe_cholesky
from gmmtorch.occupancy.grid import MEMORY_LIMIT, check_resolution
from gmmtorch.occupancy.voxels.cell_table import CellTable
from gmmtorch.scan import Scan

_FILE_KIND, _FILE_VERSION = "gmmtorch.gp_map", 1
_FACTS = (
    "dim",
    "resolution",
    "length",
    "variance",
    "noise",
    "gain",
    "min_variance",
    "max_variance",
    "known_variance",
    "block_side",
    "free_resolution",
    "ds_resolution",
    "max_range",
)
_NUMBERS_AT_ONCE = 1 << 23
_MAX_SAMPLES_PER_BLOCK = 2048


class Posterior(NamedTuple):
    """mean (B, M) and variance (B, M) of a Gaussian process at M places, for each of B processes."""

    mean: Tensor
    variance: Tensor


def matern_kernel(a: Tensor, b: Tensor, length: float, variance: float) -> Tensor:
    """Matérn-3/2 covariance (…, N, M) of places a (…, N, D) and b (…, M, D):
    variance · (1 + √3 d/length) exp(−√3 d/length)."""
    r = math.sqrt(3) * torch.cdist(a, b, compute_mode="donot_use_mm_for_euclid_dist") / length
    return variance * (1 + r) * torch.exp(-r)


def gp_regression(
    places: Tensor,
    values: Tensor,
    given: Tensor,
    query: Tensor,
    *,
    length: float,
    variance: float,
    noise: float,
) -> Posterior:
    """Zero-mean regression by B separate processes at once (Rasmussen & Williams 2006, algorithm 2.1).

    Args:
        places: (B, N, D) of the samples, padded to N.
        values: (B, N) measured there.
        given: (B, N) which samples are given; the rest is padding and has no influence.
        query: (B, M, D) where to predict.
        length: of the Matérn-3/2 kernel.
        variance: of the process.
        noise: variance of a measurement.
    """
    both = given[:, :, None] & given[:, None, :]
    covariance = torch.where(both, matern_kernel(places, places, length, variance), 0.0)
    covariance.diagonal(dim1=-2, dim2=-1).add_(torch.where(given, noise, 1.0))
    factor = safe_cholesky(covariance, "the covariance of a block's samples")
    cross = matern_kernel(places, query, length, variance) * given[:, :, None]
    targets = torch.cat([cross, (values * given)[:, :, None]], 2)
    whitened = torch.linalg.solve_triangular(factor, targets, upper=False)
    cross, target = whitened[:, :, :-1], whitened[:, :, -1:]
    return Posterior((cross * target).sum(1), variance - cross.square().sum(1))


class GPMap(BaselineMap):
    """Cells that fuse the predictions of a Gaussian process for each block of cells and scan.

    Occupancy by least-squares classification of samples labelled ±1 (O'Callaghan & Ramos 2012), made
    local as in Wang & Englot 2016 (la3dm's GPOctoMap): a scan's thinned samples in each block train one
    Matérn-3/2 process; it predicts the cells of its block and of those that share a face with it; a
    Bayesian committee machine fuses the predictions of all processes and scans,

        1/σ² = Σⱼ (1/σⱼ² − 1/s²) + 1/max_variance,   m/σ² = Σⱼ mⱼ/σⱼ²,   θ = logistic(γ · m/σ² · min_variance)

    with s² the process's variance. Cells whose σ² stays above `known_variance` are exactly ½: la3dm
    calls them unknown.

    Args:
        resolution: side of a cell (m).
        length: of the kernel (m).
        variance: of the process, la3dm's sf2.
        noise: variance of a label.
        gain: γ of the logistic function, la3dm's l.
        min_variance: at which γ counts in full.
        max_variance: of a cell before it is predicted.
        known_variance: above which a cell is unknown.
        block_side: cells along the side of a block; 4 is la3dm's block_depth of 3.
        free_resolution: distance between the free samples of a beam (m).
        ds_resolution: side of the cubes that a scan's samples are thinned to (m); the resolution if
            not given.
        max_range: beams that end beyond are dropped (m).
        memory_limit: bytes that the cells may take.
    """

    def __init__(
        self,
        resolution: float,
        *,
        length: float = 1.0,
        variance: float = 1.0,
        noise: float = 0.01,
        gain: float = 100.0,
        min_variance: float = 0.001,
        max_variance: float = 1000.0,
        known_variance: float = 0.1,
        block_side: int = 4,
        free_resolution: float = 0.3,
        ds_resolution: float | None = None,
        max_range: float | None = None,
        memory_limit: int = MEMORY_LIMIT,
    ) -> None:
        self.resolution = check_resolution(resolution)
        self.length = check_length("length", length)
        for name, value in (
            ("variance", variance),
            ("noise", noise),
            ("gain", gain),
            ("min_variance", min_variance),
            ("max_variance", max_variance),
            ("known_variance", known_variance),
        ):
            if not isinstance(value, int | float) or not (math.isfinite(value) and value > 0):
                raise InvalidArgumentError(f"{name}={value!r} must be a finite number above zero.")
        self.variance, self.noise, self.gain = float(variance), float(noise), float(gain)
        self.min_variance, self.max_variance = float(min_variance), float(max_variance)
        self.known_variance = float(known_variance)
        self.block_side = check_whole("block_side", block_side, 1)
        self.free_resolution = check_length("free_resolution", free_resolution)
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

    # -- learning ---------------------------------------------------------------------------------

    def _learn(self, scan: Scan) -> None:
        samples, is_hit = thinned_samples(scan, self.free_resolution, self.ds_resolution, self.max_range)
        if samples.shape[0] == 0:
            return
        blocks = torch.div(self._table.cells(samples), self.block_side, rounding_mode="floor")
        blocks, block = torch.unique(blocks, dim=0, return_inverse=True)
        count = torch.bincount(block)
        if int(count.max()) > _MAX_SAMPLES_PER_BLOCK:
            raise InvalidArgumentError(
                f"ds_resolution={self.ds_resolution} m leaves {int(count.max()):,} samples in a block of "
                f"{self.block_side} cells of {self.resolution} m, more than {_MAX_SAMPLES_PER_BLOCK:,}; take "
                "a coarser one, or a smaller block_side."
            )
        inner, around = self._cells_around(scan.dim)
        # In metres from the block's corner, so that far from the origin no digits are lost.
        samples = samples - (blocks[block] * self.block_side) * self.resolution
        values = torch.where(is_hit, 1.0, -1.0).double()
        order = torch.argsort(block, stable=True)
        start = torch.cumsum(count, 0) - count
        for group in self._of_like_size(count, around.shape[0]):
            slot = torch.arange(int(count[group].max()), device=self.device)
            given = slot < count[group][:, None]
            taken = order[(start[group][:, None] + slot).clamp_max(order.shape[0] - 1)]
            posterior = gp_regression(
                samples[taken],
                values[taken],
                given,
                around.expand(group.shape[0], -1, -1),
                length=self.length,
                variance=self.variance,
                noise=self.noise,
            )
            cells = (blocks[group] * self.block_side)[:, None] + inner
            self._fuse(cells.flatten(0, 1), posterior.mean.flatten(), posterior.variance.flatten())

    def _cells_around(self, dim: int) -> tuple[Tensor, Tensor]:
        """Cells (M, D) of a block and those that share a face with it, relative to the block's lowest,
        and their centres (M, D) in metres from its corner."""
        side = self.block_side
        block = torch.tensor(list(itertools.product(range(side), repeat=dim)), device=self.device)
        unit = side * torch.eye(dim, dtype=torch.int64, device=self.device)
        shifts = torch.cat([torch.zeros_like(unit[:1]), unit, -unit])
        cells = (shifts[:, None] + block).flatten(0, 1)
        return cells, (cells.double() + 0.5) * self.resolution

    @staticmethod
    def _of_like_size(count: Tensor, n_query: int) -> list[Tensor]:
        """Blocks in groups whose sizes differ by at most half, each small enough to work on at once."""
        groups = []
        level = torch.log2(count.double()).mul(2).ceil()
        for size in level.unique():
            members = (level == size).nonzero().squeeze(1)
            n = int(count[members].max())
            groups += members.split(max(1, _NUMBERS_AT_ONCE // (n * (n + 2 * n_query))))
        return groups

    def _fuse(self, cells: Tensor, mean: Tensor, variance: Tensor) -> None:
        """Bayesian committee machine (Tresp 2000): precisions add, less the prior's."""
        variance = variance.clamp_min(1e-9 * self.variance)
        precision = (1 / variance - 1 / self.variance).clamp_min(0)
        rows = self._table.open(cells)
        fused = torch.zeros_like(self._table.values, dtype=torch.float64)
        fused.index_add_(0, rows, torch.stack([mean / variance, precision], 1))
        self._table.values += fused.float()

    # -- answering --------------------------------------------------------------------------------

    def _answer(self, query: Tensor) -> Tensor:
        if self._table.keys.shape[0] == 0:
            return query.new_full((query.shape[0],), 0.5)
        rows, stored = self._table.find(query)
        weighted = self._table.values[rows, 0].double()
        theta = torch.sigmoid(self.gain * self.min_variance * weighted)
        return torch.where(stored & self._known()[rows], theta, 0.5)

    def _known(self) -> Tensor:
        """Cells (N,) that were predicted with enough certainty."""
        precision = self._table.values[:, 1].double() + 1 / self.max_variance
        return precision >= 1 / self.known_variance

    # -- keeping ----------------------------------------------------------------------------------

    def _serialized(self) -> bytes:
        """Cells, and their fused mean over variance and precision, as float32."""
        facts = {name: getattr(self, name) for name in _FACTS}
        tensors = {**self._table.packed(), "fused": self._table.values}
        return pack_tensors(tensors, _FILE_KIND, _FILE_VERSION, **facts)

    @classmethod
    def load(cls, path: str | Path) -> GPMap:
        """Read a map that `save` wrote. Raises `DataError` if it is not one."""
        made, tensors = cls._opened(path, _FILE_KIND, _FILE_VERSION)
        made._table.fill(tensors, path)
        fused = require(tensors, "fused", (made._table.keys.shape[0], 2), torch.float32, path)
        if bool((fused[:, 1] < 0).any()):
            raise DataError(f"{path}: fused holds negative precisions; the file is damaged.")
        made._table.values = fused
        return made

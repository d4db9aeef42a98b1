"""Local Gaussian processes of occupancy, fused on a grid."""

from __future__ import annotations

import itertools
import math

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, check_number, check_whole
from gmmtorch.experiments.baselines.cell_table import CellMap
from gmmtorch.experiments.baselines.samples import thinned_samples
from gmmtorch.linalg import safe_cholesky
from gmmtorch.occupancy import MEMORY_LIMIT, check_length, check_resolution, optional_length
from gmmtorch.scan import Scan

_CHUNK_NUMBERS = 1 << 23
_MAX_SAMPLES_PER_BLOCK = 2048


def matern_kernel(a: Tensor, b: Tensor, length: float, variance: float) -> Tensor:
    """Matérn-3/2 covariance (…, N, M) of points a (…, N, D) and b (…, M, D).

    variance · (1 + √3 d/length) exp(−√3 d/length)
    """
    r = math.sqrt(3) * torch.cdist(a, b, compute_mode="donot_use_mm_for_euclid_dist") / length
    return variance * (1 + r) * torch.exp(-r)


def gp_regression(
    points: Tensor,
    values: Tensor,
    is_sample: Tensor,
    query: Tensor,
    *,
    length: float,
    variance: float,
    noise: float,
) -> tuple[Tensor, Tensor]:
    """Mean (B, M) and variance (B, M) of M predictions of each of B separate zero-mean Gaussian processes
    (Rasmussen & Williams 2006, algorithm 2.1).

    Samples have positions (B, N, D) and values (B, N); padding, where is_sample (B, N) is False, has no
    influence. Predictions are at the query (B, M, D). length: of the Matérn-3/2 kernel (m); variance: of the
    process; noise: variance of a measurement.
    """
    both = is_sample[:, :, None] & is_sample[:, None, :]
    covariance = torch.where(both, matern_kernel(points, points, length, variance), 0.0)
    covariance.diagonal(dim1=-2, dim2=-1).add_(torch.where(is_sample, noise, 1.0))
    factor = safe_cholesky(covariance, "the covariance of a block's samples")
    cross = matern_kernel(points, query, length, variance) * is_sample[:, :, None]
    targets = torch.cat([cross, (values * is_sample)[:, :, None]], 2)
    solved = torch.linalg.solve_triangular(factor, targets, upper=False)
    cross, target = solved[:, :, :-1], solved[:, :, -1:]
    return (cross * target).sum(1), variance - cross.square().sum(1)


class GPMap(CellMap):
    """Cells that fuse the predictions of one Gaussian process per block of cells and scan.

    Occupancy by least-squares classification of samples labelled ±1 (O'Callaghan & Ramos 2012), made
    local as in Wang & Englot 2016 (la3dm's GPOctoMap). The thinned samples of a scan in one block train a
    Matérn-3/2 process. It predicts the cells of its block and of the blocks that share a face with it. A
    Bayesian committee machine fuses the predictions of all processes and scans,

        1/σ² = Σⱼ (1/σⱼ² − 1/s²) + 1/max_variance,   m/σ² = Σⱼ mⱼ/σⱼ²,   θ = logistic(γ · m/σ² · min_variance)

    where s² is the variance of the process. A cell whose σ² is above `known_variance` is unknown, as in
    la3dm, and has θ = ½ exactly.

    Args:
        resolution: side of a cell (m).
        length: of the kernel (m).
        variance: of the process, la3dm's sf2.
        noise: variance of a label.
        gain: γ of the logistic function, la3dm's l.
        min_variance: variance at which γ has its full effect.
        max_variance: of a cell without predictions.
        known_variance: largest variance of a known cell.
        block_side: cells along the side of a block; 4 is la3dm's block_depth of 3.
        free_resolution: spacing of the free samples of a beam (m).
        ds_resolution: side of the cubes in which a scan's samples are merged (m); default the resolution.
        max_range: beams that end beyond it (m) are dropped; None: no limit.
        memory_limit: largest size of the cells, bytes.
    """

    file_kind = "gmmtorch.gp_map"
    _content = "fused"  # mean over variance, and precision
    _first_positive = 1

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
        self.variance = check_number("variance", variance, above=True)
        self.noise = check_number("noise", noise, above=True)
        self.gain = check_number("gain", gain, above=True)
        self.min_variance = check_number("min_variance", min_variance, above=True)
        self.max_variance = check_number("max_variance", max_variance, above=True)
        self.known_variance = check_number("known_variance", known_variance, above=True)
        self.block_side = check_whole("block_side", block_side, 1)
        self.free_resolution = check_length("free_resolution", free_resolution)
        self.ds_resolution = check_length(
            "ds_resolution", self.resolution if ds_resolution is None else ds_resolution
        )
        self.max_range = optional_length("max_range", max_range)
        self.memory_limit = memory_limit
        self._start(2, torch.device("cpu"))

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
                f"{self.block_side} cells of {self.resolution} m, more than {_MAX_SAMPLES_PER_BLOCK:,}; use "
                "a coarser ds_resolution, or a smaller block_side."
            )
        inner, around = self._cells_around(scan.dim)
        # In metres from the block's corner, so that positions far from the origin stay exact.
        samples = samples - (blocks[block] * self.block_side) * self.resolution
        values = torch.where(is_hit, 1.0, -1.0).double()
        order = torch.argsort(block, stable=True)
        start = torch.cumsum(count, 0) - count
        for group in self._groups(count, around.shape[0]):
            slot = torch.arange(int(count[group].max()), device=self.device)
            is_sample = slot < count[group][:, None]
            chosen = order[(start[group][:, None] + slot).clamp_max(order.shape[0] - 1)]
            mean, variance = gp_regression(
                samples[chosen],
                values[chosen],
                is_sample,
                around.expand(group.shape[0], -1, -1),
                length=self.length,
                variance=self.variance,
                noise=self.noise,
            )
            cells = (blocks[group] * self.block_side)[:, None] + inner
            self._fuse(cells.flatten(0, 1), mean.flatten(), variance.flatten())

    def _cells_around(self, dim: int) -> tuple[Tensor, Tensor]:
        """Cells of a block and of the blocks that share a face with it.

        Returns the cells (M, D) relative to the block's lowest cell, and their centres (M, D) in metres
        from the block's corner.
        """
        side = self.block_side
        block = torch.tensor(list(itertools.product(range(side), repeat=dim)), device=self.device)
        unit = side * torch.eye(dim, dtype=torch.int64, device=self.device)
        shifts = torch.cat([torch.zeros_like(unit[:1]), unit, -unit])
        cells = (shifts[:, None] + block).flatten(0, 1)
        return cells, (cells.double() + 0.5) * self.resolution

    @staticmethod
    def _groups(count: Tensor, n_query: int) -> list[Tensor]:
        """Blocks in groups of similar sample counts (within a factor of √2) and limited total size."""
        groups = []
        level = torch.log2(count.double()).mul(2).ceil()
        for size in level.unique():
            members = (level == size).nonzero().squeeze(1)
            n = int(count[members].max())
            groups += members.split(max(1, _CHUNK_NUMBERS // (n * (n + 2 * n_query))))
        return groups

    def _fuse(self, cells: Tensor, mean: Tensor, variance: Tensor) -> None:
        """Bayesian committee machine (Tresp 2000): adds the precisions and subtracts the prior's."""
        variance = variance.clamp_min(1e-9 * self.variance)
        precision = (1 / variance - 1 / self.variance).clamp_min(0)
        rows = self._table.open(cells)
        fused = torch.zeros_like(self._table.values, dtype=torch.float64)
        fused.index_add_(0, rows, torch.stack([mean / variance, precision], 1))
        self._table.values += fused.float()

    def _answer(self, query: Tensor) -> Tensor:
        weighted, precision = self._table.at(query).unbind(1)
        known = precision + 1 / self.max_variance >= 1 / self.known_variance
        return torch.where(known, torch.sigmoid(self.gain * self.min_variance * weighted), 0.5)

"""Evidence: hits and misses of every cell of a grid, and the occupancy that follows from them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.errors import check_prior as check_prior
from gmmtorch.occupancy.grid import VoxelGrid
from gmmtorch.occupancy.voxels.ray_traversal import CHUNK_VISITS, traverse


class CellClass(IntEnum):
    """What a cell is called once the dead band is applied."""

    UNKNOWN = -1
    FREE = 0
    OCCUPIED = 1


def occupancy_probability(hits: Tensor, misses: Tensor, prior: float = 1.0) -> Tensor:
    """θ = (H + N_p)/(H + M + 2N_p), thesis (3.9); ½ where there is no evidence at all.

    Raises `InvalidArgumentError` when the prior count N_p is negative or not finite.
    """
    check_prior(prior)
    total = hits + misses + 2 * prior
    return torch.where(total > 0, (hits + prior) / total.clamp_min(torch.finfo(total.dtype).tiny), 0.5)


def bernoulli_variance(probability: Tensor) -> Tensor:
    """θ(1 − θ): ¼ for an unknown cell, 0 for a certain one."""
    return probability * (1 - probability)


def bernoulli_entropy(probability: Tensor) -> Tensor:
    """−θ log₂ θ − (1−θ) log₂(1−θ) in bits: 1 for an unknown cell."""
    return -(
        torch.xlogy(probability, probability) + torch.xlogy(1 - probability, 1 - probability)
    ) / math.log(2)


def classify(probability: Tensor, variance_threshold: float) -> Tensor:
    """Dead band of thesis (3.10): `CellClass` values (int8) of probabilities, any shape.

    With variance threshold v a cell is occupied above ½(1 + √(1−4v)), free below ½(1 − √(1−4v)),
    else unknown. Raises `InvalidArgumentError` unless 0 < v ≤ ¼, the largest variance there is.
    """
    if not 0 < variance_threshold <= 0.25:
        raise InvalidArgumentError(
            f"variance_threshold={variance_threshold} must lie in (0, 0.25]; "
            "0.25 leaves no dead band, the thesis shows 0.06."
        )
    half_width = 0.5 * math.sqrt(1 - 4 * variance_threshold)
    label = torch.full_like(probability, CellClass.UNKNOWN, dtype=torch.int8)
    label[probability > 0.5 + half_width] = int(CellClass.OCCUPIED)
    label[probability < 0.5 - half_width] = int(CellClass.FREE)
    return label


@dataclass(frozen=True)
class Evidence:
    """Expected number of rays that ended in each cell (`hits`) and passed through it (`misses`).

    Both have the grid's shape and are float64.
    """

    grid: VoxelGrid
    hits: Tensor
    misses: Tensor

    @classmethod
    def empty(cls, grid: VoxelGrid, device: torch.device | str | None = None) -> Evidence:
        zeros = torch.zeros(grid.shape, dtype=torch.float64, device=device)
        return cls(grid, zeros, zeros.clone())

    def probability(self, prior: float = 1.0) -> Tensor:
        """Occupancy θ of every cell, (3.9)."""
        return occupancy_probability(self.hits, self.misses, prior)

    def variance(self, prior: float = 1.0) -> Tensor:
        """θ(1−θ) of every cell."""
        return bernoulli_variance(self.probability(prior))

    def entropy(self, prior: float = 1.0) -> Tensor:
        """Entropy of every cell in bits."""
        return bernoulli_entropy(self.probability(prior))

    def classify(self, variance_threshold: float = 0.06, prior: float = 1.0) -> Tensor:
        """Occupied, free or unknown by the dead band of (3.10), as int8 `CellClass` values."""
        return classify(self.probability(prior), variance_threshold)

    def lookup(self, points: Tensor, prior: float = 1.0) -> Tensor:
        """Occupancy (M,) of the cells that hold the world points (M, D); exactly ½ outside the grid."""
        cell, inside = self.grid.flat_index(points)
        theta = occupancy_probability(self.hits.flatten()[cell], self.misses.flatten()[cell], prior)
        return torch.where(inside, theta, torch.full_like(theta, 0.5))

    def add_rays(
        self,
        origins: Tensor,
        ends: Tensor,
        weights: Tensor | None = None,
        is_hit: Tensor | None = None,
        chunk_visits: int = CHUNK_VISITS,
        compiled: bool = False,
    ) -> None:
        """Count rays: a hit in the cell of each end, a miss in every cell passed on the way to it.

        Args:
            origins: (R, D) sensor positions, world metres.
            ends: (R, D) where the rays end.
            weights: (R,) how many rays each stands for; 1 if not given.
            is_hit: (R,) False for rays that met no surface: misses only. All True if not given.
            chunk_visits: voxel visits worked on at once; bounds the memory, not the result.
            compiled: see `traverse`.
        """
        starts, stops = self.grid.to_units(origins), self.grid.to_units(ends)
        misses = self.misses.view(-1)
        ones = torch.ones((), dtype=torch.float64, device=misses.device)
        weights = None if weights is None else weights.double()
        for visit in traverse(starts, stops, self.grid.shape, chunk_visits, compiled=compiled):
            source = ones.expand(visit.voxel.shape) if weights is None else weights[visit.ray]
            misses.scatter_add_(0, visit.voxel, source)
        cell, counted = self.grid.flat_index(ends)
        if is_hit is not None:
            counted = counted & is_hit
        source = torch.ones_like(cell, dtype=torch.float64) if weights is None else weights
        self.hits.view(-1).scatter_add_(0, cell[counted], source[counted])

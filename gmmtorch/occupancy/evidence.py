"""Evidence: hits and misses of the cells of a grid, and the occupancy that follows from them, thesis (3.9).

`occupancy_probability` has the formula. It is in `kernels`, whose fused loops use it too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike, as_tensor
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.errors import check_prior as check_prior
from gmmtorch.kernels import bernoulli_entropy as bernoulli_entropy
from gmmtorch.kernels import chunk_elements, count_in_grid
from gmmtorch.kernels import occupancy_probability as occupancy_probability
from gmmtorch.occupancy.calibrator import Calibration
from gmmtorch.occupancy.grid import VoxelGrid
from gmmtorch.occupancy.voxels.cells import flat_index

Rule = Calibration | float
"""How a probability follows from evidence: calibrated, or with a count N_p by the thesis's (3.9)."""


def probability(hits: Tensor, misses: Tensor, side: float, dim: int, rule: Rule) -> Tensor:
    """Probabilities that cubes of a side (m) with hits and misses of any shape are occupied.

    Maps, exports, viewers and planners all take them from here.
    """
    if isinstance(rule, Calibration):
        return rule.probability(hits, misses, side, dim)
    return occupancy_probability(hits, misses, rule)


class CellClass(IntEnum):
    """Classes of cells by their occupancy."""

    UNKNOWN = -1
    FREE = 0
    OCCUPIED = 1


def classify(probability: ArrayLike, variance_threshold: float) -> Tensor:
    """`CellClass` values (int8) of probabilities, any shape, with the dead band of thesis (3.10).

    With the variance threshold v a cell is occupied above ½(1 + √(1 − 4v)), free below ½(1 − √(1 − 4v)), and
    unknown between. Raises `InvalidArgumentError` unless 0 < v ≤ ¼, the largest possible variance.
    """
    if not 0 < variance_threshold <= 0.25:
        raise InvalidArgumentError(
            f"variance_threshold={variance_threshold} must lie in (0, 0.25]; "
            "0.25 means no dead band, the thesis uses 0.06."
        )
    half_width = 0.5 * math.sqrt(1 - 4 * variance_threshold)
    return Thresholds(0.5 - half_width, 0.5 + half_width).classify(probability)


@dataclass(frozen=True)
class Thresholds:
    """θ < `free` is free, θ > `occupied` is occupied, else unknown. The defaults are map_server's."""

    free: float = 0.196
    occupied: float = 0.65

    def __post_init__(self) -> None:
        if not 0 <= self.free <= self.occupied <= 1:  # NaN compares false
            raise InvalidArgumentError(
                f"free_thresh={self.free}, occupied_thresh={self.occupied} must be probabilities, "
                "and the first must not exceed the second."
            )

    def classify(self, probability: ArrayLike) -> Tensor:
        """`CellClass` values (int8) of probabilities, any shape."""
        theta = as_tensor(probability, "probability")
        label = torch.full_like(theta, CellClass.UNKNOWN, dtype=torch.int8)
        label[theta > self.occupied] = int(CellClass.OCCUPIED)
        label[theta < self.free] = int(CellClass.FREE)
        return label


@dataclass(frozen=True, repr=False)
class Evidence:
    """Expected number of rays that end in each cell of a grid (`hits`) and that pass through it (`misses`).

    Both have the shape of the grid, and are float64. `rule` says how probabilities follow from them: (3.9)
    with N_p = 1 for counted rays, that of the map for its evidence. Raises `InvalidArgumentError` for another
    shape.
    """

    grid: VoxelGrid
    hits: Tensor
    misses: Tensor
    rule: Rule = 1.0

    def __post_init__(self) -> None:
        for name in ("hits", "misses"):
            value = as_tensor(getattr(self, name), name, torch.float64)
            if tuple(value.shape) != self.grid.shape:
                raise InvalidArgumentError(
                    f"{name} has shape {tuple(value.shape)}; the grid has {self.grid.shape} cells."
                )
            object.__setattr__(self, name, value)

    def __repr__(self) -> str:
        seen = int(((self.hits != 0) | (self.misses != 0)).sum())
        return (
            f"Evidence({seen} of {self.grid.n_cells} cells seen, {float(self.hits.sum()):.6g} hits, "
            f"{float(self.misses.sum()):.6g} misses, {self.hits.nbytes + self.misses.nbytes} bytes, "
            f"{_about(self.rule)}, {self.hits.device}, {self.grid})"
        )

    @classmethod
    def empty(cls, grid: VoxelGrid, device: torch.device | str | None = None) -> Evidence:
        """No evidence in any cell of a grid."""
        zeros = torch.zeros(grid.shape, dtype=torch.float64, device=device)
        return cls(grid, zeros, zeros.clone())

    def probability(self, prior: float | None = None) -> Tensor:
        """Occupancy θ of each cell, by the rule; or (3.9) with a count N_p."""
        return self._theta(self.hits, self.misses, prior)

    def variance(self, prior: float | None = None) -> Tensor:
        """θ(1 − θ) of each cell: ¼ for an unknown cell, 0 for a certain cell."""
        theta = self.probability(prior)
        return theta * (1 - theta)

    def entropy(self, prior: float | None = None) -> Tensor:
        """Entropy of each cell in bits."""
        return bernoulli_entropy(self.probability(prior))

    def classify(self, variance_threshold: float = 0.06, prior: float | None = None) -> Tensor:
        """`CellClass` values (int8) of all cells, with the dead band of (3.10)."""
        return classify(self.probability(prior), variance_threshold)

    def lookup(self, points: ArrayLike, prior: float | None = None) -> Tensor:
        """Occupancy (M,) of the cells that contain points (M, D), world metres; ½ outside the grid."""
        cell, inside = self.grid.flat_index(as_tensor(points, "points", device=self.hits.device))
        theta = self._theta(self.hits.flatten()[cell], self.misses.flatten()[cell], prior)
        return torch.where(inside, theta, torch.full_like(theta, 0.5))

    def _theta(self, hits: Tensor, misses: Tensor, prior: float | None) -> Tensor:
        rule = self.rule if prior is None else prior
        return probability(hits, misses, self.grid.resolution, self.grid.dim, rule)

    def add_rays(
        self,
        origins: ArrayLike,
        ends: ArrayLike,
        weights: ArrayLike | None = None,
        is_hit: ArrayLike | None = None,
    ) -> None:
        """Count rays: one hit in the cell of each end, one miss in every other cell that the ray passes.

        Args:
            origins: (R, D) sensor origins, world metres.
            ends: (R, D) ends of the rays, world metres.
            weights: (R,) number of rays that each row counts for; 1 if not given.
            is_hit: (R,) bool, False for no-return beams, which add only misses. All True if not given.

        Raises `InvalidArgumentError` for shapes that do not match.
        """
        origins, ends, weights, is_hit = checked_rays(
            origins, ends, weights, is_hit, self.grid.dim, self.misses.device
        )
        size = chunk_elements(self.misses.device)
        for begin in range(0, len(ends), size):
            part = slice(begin, begin + size)
            starts, stops = self.grid.to_units(origins[part]), self.grid.to_units(ends[part])
            counts = None if weights is None else weights[part]
            count_in_grid(self.misses.view(-1), starts, stops, self.grid.shape, counts)
            cell, counted = flat_index(stops.floor(), self.grid.shape)
            if is_hit is not None:
                counted = counted & is_hit[part]
            added = counted.double() if counts is None else counts * counted
            self.hits.view(-1).scatter_add_(0, cell, added)


def _about(rule: Rule) -> str:
    if not isinstance(rule, Calibration):
        return f"prior {rule:g}"
    n = rule.n_predicted
    return f"calibrated by {n} predictions" if n else "calibrated by the sensor model alone"


def checked_rays(
    origins: ArrayLike,
    ends: ArrayLike,
    weights: ArrayLike | None,
    is_hit: ArrayLike | None,
    dim: int,
    device: torch.device,
) -> tuple[Tensor, Tensor, Tensor | None, Tensor | None]:
    """The arguments of `Evidence.add_rays` as tensors on a device: positions and weights in float64.

    Raises `InvalidArgumentError` for shapes that do not match.
    """
    starts = as_tensor(origins, "origins", torch.float64, device).detach()
    stops = as_tensor(ends, "ends", torch.float64, device).detach()
    counts = None if weights is None else as_tensor(weights, "weights", torch.float64, device)
    hits = None if is_hit is None else as_tensor(is_hit, "is_hit", torch.bool, device)
    n = len(stops) if stops.ndim else 0
    for name, value, expected in (
        ("origins", starts, (n, dim)),
        ("ends", stops, (n, dim)),
        ("weights", counts, (n,)),
        ("is_hit", hits, (n,)),
    ):
        if value is not None and tuple(value.shape) != expected:
            raise InvalidArgumentError(f"{name} has shape {tuple(value.shape)}; expected {expected}.")
    return starts, stops, counts, hits

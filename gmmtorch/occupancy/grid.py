"""VoxelGrid: a regular grid of cubic cells (squares in 2D), and the rasterization of a map on it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, MemoryLimitError
from gmmtorch.errors import check_resolution as check_resolution

BYTES_PER_CELL = 16
"""Bytes of the hits and misses of one cell, float64 each."""

MEMORY_LIMIT = 4 << 30
"""Default limit of the bytes of evidence of one grid."""

_CELLS_PER_CALL = 1 << 16


@dataclass(frozen=True)
class VoxelGrid:
    """A grid of `shape` cells of side `resolution` (m), with its lowest corner at `origin` (m, world frame).

    Cell (i, j[, k]) is the half-open cube origin + resolution·[i, i+1) × …; flat indices are row-major.

    Raises:
        InvalidArgumentError: a resolution that is not above zero, a shape without cells, or an origin that is
            not finite or has another dimension than the shape.
    """

    origin: tuple[float, ...]
    resolution: float
    shape: tuple[int, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "origin", tuple(float(x) for x in self.origin))  # also accepts a tensor
        if any(int(n) != n for n in self.shape):
            raise InvalidArgumentError(f"shape={self.shape} must be whole numbers of cells.")
        object.__setattr__(self, "shape", tuple(int(n) for n in self.shape))
        object.__setattr__(self, "resolution", check_resolution(self.resolution))
        if len(self.origin) != len(self.shape) or len(self.shape) not in (2, 3):
            raise InvalidArgumentError(
                f"origin={self.origin} and shape={self.shape} must both have 2 or both have 3 entries."
            )
        if not all(math.isfinite(x) for x in self.origin):
            raise InvalidArgumentError(f"origin={self.origin} must be finite metres.")
        if min(self.shape) < 1:
            raise InvalidArgumentError(f"shape={self.shape} must have at least one cell along each axis.")

    @property
    def dim(self) -> int:
        return len(self.shape)

    @property
    def n_cells(self) -> int:
        return math.prod(self.shape)

    @classmethod
    def covering(
        cls,
        low: Sequence[float] | Tensor,
        high: Sequence[float] | Tensor,
        resolution: float,
        memory_limit: int = MEMORY_LIMIT,
    ) -> VoxelGrid:
        """The smallest grid that contains the box [low, high] (m), with planes at multiples of `resolution`.

        Raises `MemoryLimitError` if its evidence would take more than `memory_limit` bytes; the message
        names the bytes and a resolution that fits.
        """
        resolution = check_resolution(resolution)
        low, high = [float(x) for x in low], [float(x) for x in high]
        if (
            len(low) != len(high)
            or not all(math.isfinite(x) for x in (*low, *high))
            or any(b < a for a, b in zip(low, high, strict=True))
        ):
            raise InvalidArgumentError(f"low={low}, high={high} is not a box of finite metres.")
        first, shape = _covering_cells(low, high, resolution)
        n_bytes = math.prod(shape) * BYTES_PER_CELL
        if n_bytes > memory_limit:
            size = " × ".join(f"{b - a:.1f}" for a, b in zip(low, high, strict=True))
            raise MemoryLimitError(
                f"resolution={resolution} m over a box of {size} m takes {' × '.join(map(str, shape))} "
                f"cells = {n_bytes:,} bytes, above the limit of {memory_limit:,}; a resolution of "
                f"{_fitting_resolution(low, high, resolution, memory_limit):.3g} m or more fits."
            )
        return cls(tuple(i * resolution for i in first), resolution, shape)

    def to_units(self, points: Tensor) -> Tensor:
        """Points (M, D), world metres, in grid units, float64: cell (i, j, k) is [i, i+1) × …"""
        origin = torch.tensor(self.origin, dtype=torch.float64, device=points.device)
        return (points.double() - origin) / self.resolution

    def flat_index(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Flat cell index (M,) of points (M, D), world metres, and whether each is inside; else index 0."""
        cell = self.to_units(points).floor()
        shape = torch.tensor(self.shape, dtype=torch.float64, device=points.device)
        inside = ((cell >= 0) & (cell < shape)).all(1)
        cell = torch.where(inside[:, None], cell, torch.zeros_like(cell)).long()
        flat = cell[:, 0]
        for axis in range(1, self.dim):
            flat = flat * self.shape[axis] + cell[:, axis]
        return flat, inside

    def centers(self, device: torch.device | str | None = None) -> Tensor:
        """Centres of all cells (n_cells, D), world metres, float64, row-major."""
        axes = [
            o + (torch.arange(n, dtype=torch.float64, device=device) + 0.5) * self.resolution
            for o, n in zip(self.origin, self.shape, strict=True)
        ]
        return torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, self.dim)


def _covering_cells(
    low: list[float], high: list[float], resolution: float
) -> tuple[list[int], tuple[int, ...]]:
    """Lowest cell of the box, and the number of cells along each axis."""
    first = [math.floor(x / resolution) for x in low]
    return first, tuple(math.floor(x / resolution) + 1 - i for x, i in zip(high, first, strict=True))


def _fitting_resolution(low: list[float], high: list[float], resolution: float, memory_limit: int) -> float:
    """A coarser resolution, rounded to three digits, at which the evidence of the box fits the limit."""
    while math.prod(_covering_cells(low, high, resolution)[1]) * BYTES_PER_CELL > memory_limit:
        resolution = float(f"{resolution * 1.05:.3g}")
    return resolution


def rasterize(
    answer: Callable[[Tensor], Tensor],
    grid: VoxelGrid,
    on_event: Callable[[str, int, int | None], object] = lambda stage, done, total: None,
) -> Tensor:
    """Probability of each cell, float64, in the shape of the grid: `answer` at the centres of the cells.

    Args:
        answer: maps points (M, D), world metres, to probabilities (M,). It is called for some cells at a
            time.
        on_event: is called with ("cells", done, total) after each call.
    """
    found = torch.empty(grid.n_cells, dtype=torch.float64)
    shape = torch.tensor(grid.shape)
    origin = torch.tensor(grid.origin, dtype=torch.float64)
    stride = torch.cat([shape.flip(0).cumprod(0).flip(0)[1:], torch.ones(1, dtype=torch.int64)])
    on_event("cells", 0, grid.n_cells)
    for first in range(0, grid.n_cells, _CELLS_PER_CALL):
        flat = torch.arange(first, min(first + _CELLS_PER_CALL, grid.n_cells))
        index = flat[:, None] // stride % shape
        found[flat] = answer(origin + (index.double() + 0.5) * grid.resolution).detach().cpu().double()
        on_event("cells", int(flat[-1]) + 1, grid.n_cells)
    return found.view(grid.shape)

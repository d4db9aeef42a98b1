"""VoxelGrid: a regular grid of cubic cells (squares in 2D), and the rasterization of a map on it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike, as_tensor
from gmmtorch.errors import InvalidArgumentError, MemoryLimitError
from gmmtorch.errors import check_resolution as check_resolution
from gmmtorch.occupancy.voxels.cells import flat_index

BYTES_PER_CELL = 16
"""Bytes of the hits and misses of one cell, float64 each."""

MEMORY_LIMIT = 4 << 30
"""Default limit of the bytes of evidence of one grid."""

_CELLS_PER_CALL = 1 << 16


@dataclass(frozen=True, repr=False)
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
        origin, shape = (
            as_tensor(value, name, torch.float64).flatten().tolist()
            for name, value in (("origin", self.origin), ("shape", self.shape))
        )
        object.__setattr__(self, "origin", tuple(origin))
        if not all(n.is_integer() for n in shape):
            raise InvalidArgumentError(f"shape={self.shape} must be whole numbers of cells.")
        object.__setattr__(self, "shape", tuple(int(n) for n in shape))
        object.__setattr__(self, "resolution", check_resolution(self.resolution))
        if len(self.origin) != len(self.shape) or len(self.shape) not in (2, 3):
            raise InvalidArgumentError(
                f"origin={self.origin} and shape={self.shape} must both have 2 or both have 3 entries."
            )
        if not all(math.isfinite(x) for x in self.origin):
            raise InvalidArgumentError(f"origin={self.origin} must be finite metres.")
        if min(self.shape) < 1:
            raise InvalidArgumentError(f"shape={self.shape} must have at least one cell along each axis.")

    def __repr__(self) -> str:
        cells = " × ".join(map(str, self.shape))
        corners = zip("xyz", self.origin, self.shape, strict=False)
        sides = (f"{axis} {o:.4g} to {o + n * self.resolution:.4g}" for axis, o, n in corners)
        return f"VoxelGrid({cells} cells of {self.resolution:g} m, {', '.join(sides)} m)"

    @property
    def dim(self) -> int:
        """2 or 3."""
        return len(self.shape)

    @property
    def n_cells(self) -> int:
        """Number of all cells."""
        return math.prod(self.shape)

    @classmethod
    def covering(
        cls, low: ArrayLike, high: ArrayLike, resolution: float, memory_limit: int = MEMORY_LIMIT
    ) -> VoxelGrid:
        """The smallest grid that contains the box [low, high] (m), with planes at multiples of `resolution`.

        Raises `MemoryLimitError` if its evidence would take more than `memory_limit` bytes; the message
        names the bytes and a resolution that fits.
        """
        resolution = check_resolution(resolution)
        low, high = (
            as_tensor(value, name, torch.float64).flatten().tolist()
            for name, value in (("low", low), ("high", high))
        )
        are_finite = len(low) == len(high) and all(math.isfinite(x) for x in (*low, *high))
        if not are_finite or any(b < a for a, b in zip(low, high, strict=True)):
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

    def to_units(self, points: ArrayLike) -> Tensor:
        """Points (M, D), world metres, in grid units, float64: cell (i, j, k) is [i, i+1) × …"""
        points = as_tensor(points, "points", torch.float64)
        if points.ndim != 2 or points.shape[1] != self.dim:
            raise InvalidArgumentError(
                f"points has shape {tuple(points.shape)}; expected (M, {self.dim}), as the grid has."
            )
        origin = torch.tensor(self.origin, dtype=torch.float64, device=points.device)
        return (points - origin) / self.resolution

    def flat_index(self, points: ArrayLike) -> tuple[Tensor, Tensor]:
        """Flat cell index (M,) of points (M, D), world metres, and whether each is inside; else index 0."""
        return flat_index(self.to_units(points).floor(), self.shape)

    def check_memory(self, memory_limit: int) -> None:
        """Raise `MemoryLimitError` if the evidence of all cells takes more than `memory_limit` bytes."""
        n_bytes = self.n_cells * BYTES_PER_CELL
        if n_bytes > memory_limit:
            raise MemoryLimitError(
                f"The evidence of a grid of {' × '.join(map(str, self.shape))} cells takes {n_bytes:,} bytes,"
                f" more than memory_limit={memory_limit:,}; raise memory_limit, or take a smaller grid or a "
                "larger resolution."
            )

    def centers(self, device: torch.device | str | None = None, cells: range | None = None) -> Tensor:
        """Centres (M, D) of cells, world metres, float64; `cells`: their flat indices, None: all."""
        cells = range(self.n_cells) if cells is None else cells
        flat = torch.arange(cells.start, min(cells.stop, self.n_cells), device=device)
        index = torch.stack(torch.unravel_index(flat, self.shape), 1)
        origin = torch.tensor(self.origin, dtype=torch.float64, device=device)
        return origin + (index.double() + 0.5) * self.resolution


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
    on_event("cells", 0, grid.n_cells)
    for first in range(0, grid.n_cells, _CELLS_PER_CALL):
        centers = grid.centers(cells=range(first, first + _CELLS_PER_CALL))
        found[first : first + len(centers)] = answer(centers).detach().cpu().double()
        on_event("cells", first + len(centers), grid.n_cells)
    return found.view(grid.shape)

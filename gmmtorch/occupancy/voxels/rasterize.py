"""A map asked about every cell of a grid, some at a time."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from gmmtorch.occupancy.grid import VoxelGrid

_CELLS_AT_ONCE = 1 << 16


def rasterize(
    answer: Callable[[Tensor], Tensor],
    grid: VoxelGrid,
    on_event: Callable[[str, int, int | None], object] = lambda stage, done, total: None,
) -> Tensor:
    """Probability, of the grid's shape, of every cell: what `answer` says of its centres (M, D) → (M,)."""
    found = torch.empty(grid.n_cells, dtype=torch.float64)
    shape = torch.tensor(grid.shape)
    origin = torch.tensor(grid.origin, dtype=torch.float64)
    stride = torch.cat([shape.flip(0).cumprod(0).flip(0)[1:], torch.ones(1, dtype=torch.int64)])
    on_event("cells", 0, grid.n_cells)
    for first in range(0, grid.n_cells, _CELLS_AT_ONCE):
        flat = torch.arange(first, min(first + _CELLS_AT_ONCE, grid.n_cells))
        index = flat[:, None] // stride % shape
        found[flat] = answer(origin + (index.double() + 0.5) * grid.resolution).detach().cpu().double()
        on_event("cells", int(flat[-1]) + 1, grid.n_cells)
    return found.view(grid.shape)

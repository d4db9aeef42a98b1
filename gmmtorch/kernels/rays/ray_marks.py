"""Marks the cells that rays cross in a dense grid of bits."""

from __future__ import annotations

import torch
from torch import Tensor

from gmmtorch.kernels.choice import is_fused
from gmmtorch.kernels.compiler import FusedKernel
from gmmtorch.kernels.rays.ray_traversal import grid_arguments, row_major_strides, traverse
from gmmtorch.kernels.rays.ray_walk import PARAMETERS, walk

# All items of a launch set the same bit, so that it does not matter which of them writes last.
_KERNEL = FusedKernel(
    "mark_cells_of_rays",
    PARAMETERS + ", const bool* is_hit, int64 bit, int32* marks",
    walk("marks[voxel] |= (int32_t)bit;")
    + """
    if (!is_hit[item]) return;
    int64_t end = 0;
    for (int a = 0; a < 3; ++a) {
        const double cell = floor(ends[3 * item + a]) - lows[a];
        if (!(cell >= 0.0 && cell < size[a])) return;
        end += stride[a] * (int64_t)cell;
    }
    marks[end] |= (int32_t)bit;
    """,
)


def mark_cells_of_rays(
    marks: Tensor, starts: Tensor, stops: Tensor, is_hit: Tensor, low: Tensor, bit: int
) -> None:
    """Sets a bit of the cells that rays leave or hit, in place; cells outside the grid do not count.

    Args:
        marks: (nx, ny, nz) int32, contiguous. low: (3,) int64, its lowest cell.
        starts, stops: (R, 3) float64, in cells. is_hit: (R,) bool, whether a ray hits the cell it ends in.
        bit: a power of two.
    """
    shape = tuple(marks.shape)
    strides = row_major_strides(shape)
    if is_fused(marks, starts, stops, is_hit, low):
        grid = grid_arguments(starts, stops, shape, strides, low)
        _KERNEL(len(stops), *grid, is_hit.contiguous(), bit, marks, device=marks.device)
        return
    flat = marks.view(-1)
    for visit in traverse(starts, stops, shape, low=low):
        flat[visit.voxel] |= bit
    ends = stops[is_hit].floor().long() - low
    inside = ((ends >= 0) & (ends < torch.tensor(shape, device=ends.device))).all(1)
    flat[(ends[inside] * torch.tensor(strides, device=ends.device)).sum(1)] |= bit

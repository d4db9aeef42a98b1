"""Counting of rays: adds the weight of each ray to every voxel that it leaves, in a grid or in blocks; and
marks of the cells that rays cross.

The fused kernels keep no list of visits. On a CPU those that count walk eight rays side by side, fetch the
memory of a voxel when a walk meets it, and add to it up to 256 visits later, so that the walks do not wait.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.kernels.choice import is_fused
from gmmtorch.kernels.compiler import CPU_LANES, FusedKernel
from gmmtorch.kernels.rays.ray_traversal import CHUNK_VISITS, rays_argument, row_major_strides, traverse

_SOURCE = "rays/ray_counting.h"
_IN_GRID = FusedKernel(_SOURCE, "count_rays_in_grid", shares=True)
_IN_BLOCKS = {
    dtype: FusedKernel(_SOURCE, f"count_rays_in_blocks<{kind}>", shares=True)
    for dtype, kind in ((torch.float64, "double"), (torch.float32, "float"))
}
_MARK = FusedKernel(_SOURCE, "mark_rays")
_MARK_BITS = FusedKernel(_SOURCE, "mark_cells_of_rays")


def count_in_grid(
    counts: Tensor,
    starts: Tensor,
    ends: Tensor,
    shape: tuple[int, ...],
    weights: Tensor | None = None,
    *,
    low: Tensor | None = None,
    chunk_visits: int = CHUNK_VISITS,
) -> None:
    """Add the weight of each ray to `counts`, a dense grid, at every voxel that it leaves.

    Args:
        counts: (voxels,) float64, row-major.
        starts, ends, shape, low: see `traverse`.
        weights: (R,); ones if not given.
        chunk_visits: of the twin, see `traverse`.
    """
    weights = None if weights is None else weights.double().contiguous()
    starts, ends = starts.double(), ends.double()
    if is_fused(counts, starts, ends, weights, low):
        rays = rays_argument(starts, ends, shape, row_major_strides(shape), low)
        n_items = _n_items(len(starts), counts.device)
        _IN_GRID(n_items, len(starts), *rays, weights, counts, device=counts.device)
        return
    one = torch.ones((), dtype=torch.float64, device=counts.device)
    for visit in traverse(starts, ends, shape, chunk_visits, low=low):
        source = one.expand(visit.voxel.shape) if weights is None else weights[visit.ray]
        counts.scatter_add_(0, visit.voxel, source)


class BlockTable(NamedTuple):
    """A box of blocks of voxels, each side padded to a power of two, and where each block is stored.

    first: index in the counts of the first voxel of each block, −1 if it is not stored; row-major. low: (D,)
    lowest block, float64. bits: of the block's coordinate along each axis. local_bits: of the voxel's
    coordinate in its block. open: stores the blocks with these indices (M,) and enters them in `first`.
    """

    first: Tensor
    low: Tensor
    bits: tuple[int, ...]
    local_bits: int
    open: Callable[[Tensor], None]


def count_in_blocks(
    counts: Callable[[], Tensor],
    table: BlockTable,
    starts: Tensor,
    ends: Tensor,
    weights: Tensor | None,
    *,
    chunk_visits: int = CHUNK_VISITS,
) -> None:
    """Add the weight of each ray at every voxel that it leaves; stores the blocks of these voxels.

    Args:
        counts: gives the counts (cells,), float32 or float64. `table.open` can replace them.
        table: contains the starts and the ends.
        starts, ends: (R, D) in voxels.
        weights: (R,); ones if not given.
        chunk_visits: of the twin, see `traverse`.
    """
    starts, ends = starts.double(), ends.double()
    weights = None if weights is None else weights.to(counts().dtype).contiguous()
    low = table.low * (1 << table.local_bits)
    if is_fused(counts(), starts, ends, weights):
        _count_in_blocks_fused(counts, table, starts, ends, weights, low)
        return
    bits = tuple(b + table.local_bits for b in table.bits)
    one = torch.ones((), dtype=counts().dtype, device=starts.device)
    shape, strides = tuple(1 << b for b in bits), packed_strides(bits)
    for visit in traverse(starts, ends, shape, chunk_visits, strides, low):
        block, place = _split(visit.voxel, table.bits, table.local_bits)
        first = table.first.index_select(0, block)
        if int(first.min()) < 0:
            table.open(block[first < 0].long().unique())
            first = table.first.index_select(0, block)
        source = one.expand(first.shape) if weights is None else weights[visit.ray]
        counts().scatter_add_(0, first.add_(place), source)


def _count_in_blocks_fused(
    counts: Callable[[], Tensor],
    table: BlockTable,
    starts: Tensor,
    ends: Tensor,
    weights: Tensor | None,
    low: Tensor,
) -> None:
    device, side, dim = starts.device, 1 << table.local_bits, len(table.bits)
    n_rays = starts.shape[0]
    # A walk over blocks finds those to store. Division by a power of two is exact, and `unit` keeps the tie
    # rule of the voxels, so that the walk over voxels meets the same blocks.
    marked = torch.zeros_like(table.first, dtype=torch.bool)
    shape = tuple(1 << b for b in table.bits)
    strides = packed_strides(table.bits)
    rays = rays_argument(starts / side, ends / side, shape, strides, table.low, unit=1 / side)
    _MARK(n_rays, *rays, marked, device=device)
    new = (marked & (table.first < 0)).nonzero().squeeze(1)
    if new.numel():
        table.open(new)
    bits = tuple(b + table.local_bits for b in table.bits)
    rays = rays_argument(starts, ends, tuple(1 << b for b in bits), packed_strides(bits), low)
    shifts = [shift for shift, _ in _fields(bits)]
    above = [shift for shift, _ in _fields(table.bits)]
    mask2 = (1 << bits[2]) - 1 if dim == 3 else 0
    fields = [table.local_bits, shifts[0], shifts[1], (1 << bits[1]) - 1, mask2, above[0], above[1]]
    kernel = _IN_BLOCKS[counts().dtype]
    n_items = _n_items(n_rays, device)
    kernel(n_items, n_rays, *rays, table.first, *fields, weights, counts(), device=device)


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
        rays = rays_argument(starts, stops, shape, strides, low)
        _MARK_BITS(len(stops), *rays, is_hit.contiguous(), bit, marks, device=marks.device)
        return
    flat = marks.view(-1)
    for visit in traverse(starts, stops, shape, low=low):
        flat[visit.voxel] |= bit
    ends = stops[is_hit].floor().long() - low
    inside = ((ends >= 0) & (ends < torch.tensor(shape, device=ends.device))).all(1)
    flat[(ends[inside] * torch.tensor(strides, device=ends.device)).sum(1)] |= bit


def _n_items(n_rays: int, device: torch.device) -> int:
    """On a CPU an item is a group of rays that are walked side by side; on CUDA it is a ray."""
    return -(-n_rays // CPU_LANES) if device.type == "cpu" else n_rays


def _split(voxel: Tensor, block_bits: tuple[int, ...], local_bits: int) -> tuple[Tensor, Tensor]:
    """Block in the table, and place in the block, (V,) each, of packed cell indices (V,).

    The field of each axis is cut into block bits and local bits; each kind is packed again.
    """
    bits = tuple(b + local_bits for b in block_bits)
    packed = voxel.int() if sum(bits) < 31 else voxel
    side_mask = (1 << local_bits) - 1
    block, place = packed >> local_bits & ((1 << block_bits[-1]) - 1), packed & side_mask
    for axis in range(len(bits) - 2, -1, -1):
        shift, width = _fields(bits)[axis][0], block_bits[axis]
        above = sum(block_bits[axis + 1 :])
        block = block | ((packed >> (shift + local_bits - above)) & (((1 << width) - 1) << above))
        low = local_bits * (len(bits) - 1 - axis)
        place = place | ((packed >> (shift - low)) & (side_mask << low))
    return block, place


def packed_strides(bits: tuple[int, ...]) -> list[int]:
    """Strides of a packed index whose axes have these bits; the last axis is lowest."""
    return [1 << shift for shift, _ in _fields(bits)]


def _fields(bits: tuple[int, ...]) -> list[tuple[int, int]]:
    """(shift, width) of each axis in a packed index; the last axis is lowest."""
    return [(sum(bits[axis + 1 :]), bits[axis]) for axis in range(len(bits))]

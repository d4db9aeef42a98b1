"""Counting of rays: adds the weight of each ray to every voxel that it leaves, in a grid or in blocks.

The fused kernels keep no list of visits. On a CPU they fetch the memory of a voxel when the walk meets it and
add to it up to 256 visits later, so that the walk does not wait.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.kernels.choice import is_fused
from gmmtorch.kernels.compiler import FusedKernel
from gmmtorch.kernels.rays.ray_traversal import CHUNK_VISITS, grid_arguments, row_major_strides, traverse
from gmmtorch.kernels.rays.ray_walk import PARAMETERS, walk


def _counting(place: str) -> str:
    """C++ that adds the weight of ray `item` to *(place), an expression of `voxel`, for each visit."""
    return f"""
    const auto weight = weights ? weights[item] : 1;
#if defined(__CUDA_ARCH__)
    {walk(f"GMM_ADD({place}, weight);")}
#else
    decltype(counts) waiting[256];
    int n_waiting = 0;
    {
        walk(f'''
    waiting[n_waiting] = {place};
    __builtin_prefetch(waiting[n_waiting], 1);
    if (++n_waiting == 256) {{
        for (int i = 0; i < 256; ++i) *waiting[i] += weight;
        n_waiting = 0;
    }}
    ''')
    }
    for (int i = 0; i < n_waiting; ++i) *waiting[i] += weight;
#endif
"""


_IN_GRID = FusedKernel(
    "count_rays_in_grid",
    PARAMETERS + ", const double* weights, double* counts",
    _counting("counts + voxel"),
    shares=True,
)

_BLOCK_PARAMETERS = (
    ", const int64* stored_at, int64 local_bits, int64 shift0, int64 shift1, int64 mask1, int64 mask2,"
    " int64 above0, int64 above1"
)
_PLACE_IN_BLOCK = """
    const int64_t z_bits = dim == 3 ? local_bits : 0, in_block = ((int64_t)1 << local_bits) - 1;
    const int64_t x_mask = in_block << (local_bits + z_bits), y_mask = in_block << z_bits;
    const int64_t z_mask = mask2 & in_block, x_down = shift0 - local_bits - z_bits, y_down = shift1 - z_bits;
    const int64_t local_mask = (in_block << shift0) | (in_block << shift1) | z_mask;
    int64_t block = -1;
    decltype(counts) base = counts;
    auto place_of = [&](int64_t voxel) {
        if ((voxel & ~local_mask) != block) {
            block = voxel & ~local_mask;
            const int64_t x = block >> shift0, y = (block >> shift1) & mask1, z = block & mask2;
            base = counts + stored_at[
                ((x >> local_bits) << above0) | ((y >> local_bits) << above1) | (z >> local_bits)];
        }
        return base + (((voxel >> x_down) & x_mask) | ((voxel >> y_down) & y_mask) | (voxel & z_mask));
    };
"""
_IN_BLOCKS = {
    dtype: FusedKernel(
        f"count_rays_in_blocks_{kind}",
        PARAMETERS + _BLOCK_PARAMETERS + f", const {kind}* weights, {kind}* counts",
        _PLACE_IN_BLOCK + _counting("place_of(voxel)"),
        shares=True,
    )
    for dtype, kind in ((torch.float64, "double"), (torch.float32, "float"))
}
_MARK = FusedKernel("mark_rays", PARAMETERS + ", bool* marked", walk("marked[voxel] = true;"))


def count_in_grid(
    counts: Tensor,
    starts: Tensor,
    ends: Tensor,
    shape: tuple[int, ...],
    weights: Tensor | None = None,
    *,
    low: Tensor | None = None,
    chunk_visits: int = CHUNK_VISITS,
    compiled: bool = False,
) -> None:
    """Add the weight of each ray to `counts`, a dense grid, at every voxel that it leaves.

    Args:
        counts: (voxels,) float64, row-major.
        starts, ends, shape, low: see `traverse`.
        weights: (R,); ones if not given.
        chunk_visits, compiled: of the twin, see `traverse`.
    """
    weights = None if weights is None else weights.double().contiguous()
    starts, ends = starts.double(), ends.double()
    if is_fused(counts, starts, ends, weights, low):
        grid = grid_arguments(starts, ends, shape, row_major_strides(shape), low)
        _IN_GRID(starts.shape[0], *grid, weights, counts, device=counts.device)
        return
    one = torch.ones((), dtype=torch.float64, device=counts.device)
    for visit in traverse(starts, ends, shape, chunk_visits, compiled=compiled, low=low):
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
    compiled: bool = False,
) -> None:
    """Add the weight of each ray at every voxel that it leaves; stores the blocks of these voxels.

    Args:
        counts: gives the counts (cells,), float32 or float64. `table.open` can replace them.
        table: contains the starts and the ends.
        starts, ends: (R, D) in voxels.
        weights: (R,); ones if not given.
        chunk_visits, compiled: of the twin, see `traverse`.
    """
    starts, ends = starts.double(), ends.double()
    weights = None if weights is None else weights.to(counts().dtype).contiguous()
    low = table.low * (1 << table.local_bits)
    if is_fused(counts(), starts, ends, weights):
        _count_in_blocks_fused(counts, table, starts, ends, weights, low)
        return
    bits = tuple(b + table.local_bits for b in table.bits)
    one = torch.ones((), dtype=counts().dtype, device=starts.device)
    split = _compiled_split() if compiled else _split
    shape, strides = tuple(1 << b for b in bits), packed_strides(bits)
    for visit in traverse(starts, ends, shape, chunk_visits, strides, compiled, low):
        block, place = split(visit.voxel, table.bits, table.local_bits)
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
    blocks = grid_arguments(starts / side, ends / side, shape, packed_strides(table.bits), table.low)
    _MARK(n_rays, *blocks[:-1], 1 / side, marked, device=device)
    new = (marked & (table.first < 0)).nonzero().squeeze(1)
    if new.numel():
        table.open(new)
    bits = tuple(b + table.local_bits for b in table.bits)
    voxels = grid_arguments(starts, ends, tuple(1 << b for b in bits), packed_strides(bits), low)
    shifts = [shift for shift, _ in _fields(bits)]
    above = [shift for shift, _ in _fields(table.bits)]
    mask2 = (1 << bits[2]) - 1 if dim == 3 else 0
    fields = [table.local_bits, shifts[0], shifts[1], (1 << bits[1]) - 1, mask2, above[0], above[1]]
    kernel = _IN_BLOCKS[counts().dtype]
    kernel(n_rays, *voxels, table.first, *fields, weights, counts(), device=device)


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


@functools.cache
def _compiled_split() -> Callable[..., tuple[Tensor, Tensor]]:
    compiled: Callable[..., tuple[Tensor, Tensor]] = torch.compile(_split, dynamic=True)
    return compiled


def packed_strides(bits: tuple[int, ...]) -> list[int]:
    """Strides of a packed index whose axes have these bits; the last axis is lowest."""
    return [1 << shift for shift, _ in _fields(bits)]


def _fields(bits: tuple[int, ...]) -> list[tuple[int, int]]:
    """(shift, width) of each axis in a packed index; the last axis is lowest."""
    return [(sum(bits[axis + 1 :]), bits[axis]) for axis in range(len(bits))]

"""Counting of rays: adds the weight of each ray to every voxel that it leaves, in a grid or in blocks.

The fused kernels keep no list of visits. On a CPU they walk eight rays side by side, fetch the memory of a
voxel when a walk meets it, and add to it up to 256 visits later, so that the walks do not wait.
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
from gmmtorch.kernels.rays.ray_walk import PARAMETERS, walk, walk_lanes
from gmmtorch.kernels.simd import CPU_LANES

_WAITING = 256  # visits


def _counting(kind: str, place: str, place_in_lane: str) -> str:
    """C++ that adds the weight of each ray to the count, of type `kind`, of each voxel that it leaves.

    `place` is the place in the counts of a `voxel`, and `place_in_lane` that of the voxel in lane `l`.
    """
    add = "for (int i = 0; i < n_waiting; ++i) counts[waiting[i]] += added[i];"
    visits = f"""
        for (int l = 0; l < LANES; ++l) {{
            waiting[n_waiting] = {place_in_lane};
            added[n_waiting] = weight[l];
            __builtin_prefetch(counts + waiting[n_waiting], 1);
            n_waiting += active[l] != 0;
        }}
        if (n_waiting > {_WAITING - CPU_LANES}) {{
            {add}
            n_waiting = 0;
        }}
    """
    return f"""
    auto count_ray = [=](const int64_t item) {{
        const {kind} weight = weights ? weights[item] : 1;
        {walk(f"GMM_ADD(counts + {place}, weight);")}
    }};
#if defined(__CUDA_ARCH__)
    count_ray(item);
#else
    const int64_t ray0 = item * {CPU_LANES};
    {kind} weight[{CPU_LANES}], added[{_WAITING}];
    int64_t waiting[{_WAITING}];
    int n_waiting = 0;
    for (int l = 0; l < {CPU_LANES}; ++l)
        weight[l] = weights && ray0 + l < n_rays ? weights[ray0 + l] : 1;
    {walk_lanes(visits, one_ray="count_ray(ray);")}
    {add}
#endif
"""


_IN_GRID = FusedKernel(
    "count_rays_in_grid",
    "int64 n_rays, " + PARAMETERS + ", const double* weights, double* counts",
    _counting("double", "voxel", "voxel[l]"),
    shares=True,
)

_BLOCK_PARAMETERS = (
    ", const int64* stored_at, int64 local_bits, int64 shift0, int64 shift1, int64 mask1, int64 mask2,"
    " int64 above0, int64 above1"
)
_PLACE_IN_BLOCK = """
    const int64_t z_bits = dim == 3 ? local_bits : 0, in_block = ((int64_t)1 << local_bits) - 1;
    auto block_of = [=](auto voxel) {
        return (((voxel >> shift0) >> local_bits) << above0)
            | ((((voxel >> shift1) & mask1) >> local_bits) << above1) | ((voxel & mask2) >> local_bits);
    };
    auto place_of = [=](auto voxel) {
        return (((voxel >> shift0) & in_block) << (local_bits + z_bits))
            | (((voxel >> shift1) & in_block) << z_bits) | (voxel & mask2 & in_block);
    };
"""
_IN_BLOCKS = {
    dtype: FusedKernel(
        f"count_rays_in_blocks_{kind}",
        "int64 n_rays, " + PARAMETERS + _BLOCK_PARAMETERS + f", const {kind}* weights, {kind}* counts",
        _PLACE_IN_BLOCK
        + _counting(
            kind,
            "stored_at[block_of(voxel)] + place_of(voxel)",
            "stored_at[block_of(voxel)[l]] + place_of(voxel)[l]",
        ),
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
        n_items = _n_items(len(starts), counts.device)
        _IN_GRID(n_items, len(starts), *grid, weights, counts, device=counts.device)
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
    n_items = _n_items(n_rays, device)
    kernel(n_items, n_rays, *voxels, table.first, *fields, weights, counts(), device=device)


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

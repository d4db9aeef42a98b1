"""Traversal of a voxel grid by rays: voxels that are listed, counted, in a grid or in blocks, and marked.

The fused kernels step from voxel to voxel (`ray_walk.h`). Those that count keep no list of visits. On a CPU
they walk eight rays side by side, fetch the memory of a voxel when a walk meets it, and add to it up to 256
visits later, so that the walks do not wait. The twin enumerates plane crossings, without a stepping loop and
without a sort.

A straight segment leaves one voxel at each grid plane that it crosses. The planes crossed along one axis
are an arithmetic progression, so all crossings of all rays along that axis fit one flat tensor. The voxel
that is left follows from the plane on this axis, and from `floor` on the others. Each voxel that a ray
passes through, except the one that it ends in, is left exactly once.

Coordinates are in grid units: voxel (i, j, k) is [i, i+1) × [j, j+1) × [k, k+1). If a ray crosses two
planes at the same point, it crosses the plane of the lower axis first. Crossings closer than rounding can
distinguish count as the same point, so that both axes take the same decision.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.kernels.choice import is_fused
from gmmtorch.kernels.chunks import chunked
from gmmtorch.kernels.compiler import CPU_LANES, FusedKernel, templated

_SOURCE = "rays/ray_counting.h"
TIE = 1e-13
"""Distance of crossings that count as one point, relative to the terms: a few hundred times their rounding
error."""
_CHUNK_VISITS = 1 << 18  # visits in one pass: they fit a core's cache


Visits = tuple[Tensor, Tensor]
"""Voxels that rays leave: flat voxel index (V,) and ray index (V,), both int64."""


class _Rays(NamedTuple):
    """Rays mirrored so that no direction component is negative; the grid is [0, size); (R, D) each."""

    start: Tensor
    delta: Tensor
    first: Tensor  # index of the start voxel
    last: Tensor  # index of the end voxel
    flipped: Tensor  # which axes were mirrored


def _mirrored(starts: Tensor, ends: Tensor, low: Tensor, size: Tensor) -> _Rays:
    delta = ends - starts
    flipped = delta < 0
    # The floor is taken before the grid's corner is subtracted, so that rounding cannot change the voxel.
    # Under x → −x voxel i = [i, i+1) becomes (−i−1, −i], closed on the other side. This matches the tie
    # rule: a mirrored ray that starts on a plane still has to cross that plane.
    first, last = starts.floor() - low, ends.floor() - low
    start = starts - low
    return _Rays(
        torch.where(flipped, size - start, start),
        delta.abs(),
        torch.where(flipped, size - 1 - first, first),
        torch.where(flipped, size - 1 - last, last),
        flipped,
    )


def _planes_inside(rays: _Rays, size: Tensor, axis: int) -> tuple[Tensor, Tensor]:
    """First crossing and number of crossings on `axis` that can touch the grid, (R,) each.

    Crossing k goes from mirrored voxel first+k to first+k+1. Crossings outside the grid on this axis are
    left out. For the other axes, an interval is kept that contains all crossings inside the grid. So the
    work is bounded by the size of the grid, however long the ray is.
    """
    first, last = rays.first[:, axis], rays.last[:, axis]
    begin = first.clamp_min(0)
    stop = torch.minimum(size[axis], last)  # crossings leave voxels begin … stop−1
    for other in range(rays.start.shape[1]):
        if other == axis:
            continue
        step = rays.delta[:, other]
        ratio = rays.delta[:, axis] / step
        enter = rays.start[:, axis] - rays.start[:, other] * ratio
        leave = rays.start[:, axis] + (size[other] - rays.start[:, other]) * ratio
        slack = 2 + 1e-9 * (enter.abs() + leave.abs())  # a loose bound; `_crossings` masks exactly
        moving = (step > 0) & torch.isfinite(enter) & torch.isfinite(leave)
        begin = torch.where(moving, torch.maximum(begin, (enter - slack).floor()), begin)
        stop = torch.where(moving, torch.minimum(stop, (leave + slack).ceil()), stop)
        first_o = rays.first[:, other]
        parallel_outside = (step == 0) & ((first_o < 0) | (first_o >= size[other]))
        stop = torch.where(parallel_outside, begin, stop)
    return begin - first, (stop - begin).clamp_min(0).long()


def _crossings(rays: _Rays, shape: tuple[int, ...], strides: list[int], axis: int, masked: bool) -> Visits:
    """All voxels left through planes of `axis`, in the grid if `masked`.

    Crossing k of a ray is at plane first + k + 1 and leaves voxel first + k. On another axis it is at
    (a + k·b)/step. `a` includes the slack of the tie rule: a plane of a lower axis, which is crossed first in
    a tie, counts as crossed slightly before the ray reaches it; a plane of a higher axis slightly after.
    """
    size, stride = (
        torch.tensor(values, dtype=torch.float64, device=rays.start.device) for values in (shape, strides)
    )
    signed = torch.where(rays.flipped, -stride, stride)  # mirrored voxel i is size − 1 − i
    start, delta, first, last = (part.unbind(1) for part in rays[:4])
    if masked:
        skipped, count = _planes_inside(rays, size, axis)
    else:
        skipped, count = torch.zeros_like(start[axis]), (last[axis] - first[axis]).long()
    ray = torch.repeat_interleave(count)

    def each(values: Tensor) -> Tensor:
        return values.contiguous().index_select(0, ray)

    before = torch.cumsum(count, 0) - count - skipped.long()
    k = torch.arange(len(ray), device=ray.device).sub(each(before)).double()
    base = signed[:, axis] * first[axis] + (rays.flipped * stride * (size - 1)).sum(1)
    voxel = torch.addcmul(each(base), k, each(signed[:, axis]))
    step, to_first = each(delta[axis]), first[axis] + 1 - start[axis]  # from the start to the first plane
    inside = torch.ones_like(ray, dtype=torch.bool)
    for other in range(len(shape)):
        if other == axis:
            continue
        slack = _slack(rays, axis, other) * (1 if other < axis else -1)
        a = start[other] * delta[axis] + to_first * delta[other] + slack
        position = torch.addcmul(each(a), k, each(delta[other])).div_(step)
        index = position.floor_() if other < axis else position.ceil_().sub_(1)
        index = torch.clamp(index, each(first[other]), each(last[other]))
        if masked:
            inside &= (index >= 0) & (index < shape[other])
        voxel = torch.addcmul(voxel, index, each(signed[:, other]))
    voxel = voxel.long()
    return (voxel[inside], ray[inside]) if masked else (voxel, ray)


def _slack(rays: _Rays, axis: int, other: int) -> Tensor:
    """Largest distance (R,) between crossings of two axes that count as one, times the product of their
    steps: the same for (axis, other) and (other, axis), so that both take the same decision."""
    size_a = rays.start[:, axis].abs() + rays.delta[:, axis] + 1
    size_o = rays.start[:, other].abs() + rays.delta[:, other] + 1
    return TIE * (size_o * rays.delta[:, axis] + size_a * rays.delta[:, other])


def row_major_strides(shape: tuple[int, ...]) -> list[int]:
    """Strides of a row-major flat index, one for each axis."""
    strides = [1] * len(shape)
    for axis in range(len(shape) - 2, -1, -1):
        strides[axis] = strides[axis + 1] * shape[axis + 1]
    return strides


def traverse(
    starts: Tensor,
    ends: Tensor,
    shape: tuple[int, ...],
    chunk_visits: int = _CHUNK_VISITS,
    strides: list[int] | None = None,
    low: Tensor | None = None,
) -> Iterator[Visits]:
    """Voxels that each segment passes through and leaves; the voxel that it ends in is not included.

    Args:
        starts: (R, D) starts of the segments in grid units, finite.
        ends: (R, D) ends of the segments in grid units, finite.
        shape: voxels along each axis; voxels outside are left out.
        chunk_visits: approximate number of visits in each chunk.
        strides: strides of the flat voxel index, one for each axis; row-major if not given.
        low: (D,) index of the grid's lowest voxel, which has the flat index 0; zeros if not given.

    Yields:
        `Visits`. Each voxel occurs once for each ray; the order of visits and chunks is arbitrary.
    """
    if starts.shape[0] == 0:
        return
    starts, ends = starts.double(), ends.double()
    strides = strides or row_major_strides(shape)
    if not is_fused(starts, ends, low):
        yield from _batched(starts, ends, shape, chunk_visits, strides, low)
        return
    rays, device = rays_argument(starts, ends, shape, strides, low), starts.device
    counts = torch.empty(len(starts), dtype=torch.int64, device=device)
    _COUNT_VISITS(len(starts), *rays, counts)
    stops = torch.cumsum(counts, 0)
    cuts = _chunk_bounds(counts, chunk_visits)
    sizes = stops[torch.tensor(cuts[1:], device=device) - 1].tolist()
    for begin, stop, before, after in zip(cuts, cuts[1:], [0, *sizes], sizes, strict=False):
        if after > before:
            listed = functools.partial(_listed, rays, stops, {begin: before, stop: after}, begin)
            yield from chunked(stop - begin, stop - begin, listed)


def rays_argument(
    starts: Tensor,
    ends: Tensor,
    shape: tuple[int, ...],
    strides: list[int],
    low: Tensor | None,
    unit: float = 1.0,
) -> list[Tensor | float]:
    """The fields of `Rays` of `ray_walk.h`. unit: 1/n if n finer voxels make a voxel and ties are theirs."""
    dim = len(shape)
    low = starts.new_zeros(dim) if low is None else low.double()
    sizes, pad = [*shape, *[1] * (3 - dim)], [0] * (3 - dim)
    return [starts, ends, low, dim, *sizes, *strides, *pad, TIE, unit]


_COUNT_VISITS = FusedKernel(_SOURCE, "count_visits")
_LIST_VISITS = FusedKernel(_SOURCE, "list_visits")


def _listed(
    rays: list[Tensor | float], stops: Tensor, known: dict[int, int], begin: int, part: slice
) -> Visits:
    """Visits of a run of rays; `known`: how many visits come before a ray, where Python has this number."""
    first, last = begin + part.start, begin + part.stop
    before, after = (known[ray] if ray in known else int(stops[ray - 1]) for ray in (first, last))
    voxel, ray = torch.empty(2, after - before, dtype=torch.int64, device=stops.device)
    _LIST_VISITS(last - first, first, stops, voxel, ray, *rays)
    return voxel, ray


def _batched(
    starts: Tensor,
    ends: Tensor,
    shape: tuple[int, ...],
    chunk_visits: int,
    strides: list[int],
    low: Tensor | None,
) -> Iterator[Visits]:
    """The twin: enumerates plane crossings in batches."""
    size = torch.tensor(shape, dtype=torch.float64, device=starts.device)
    lowest = torch.zeros_like(size) if low is None else low.double()
    rays = _mirrored(starts, ends, lowest, size)
    fits = ((rays.first >= 0) & (rays.last < size)).all(1)
    # A ray that leaves the grid visits at most sum(shape) of its voxels.
    visits = torch.minimum((rays.last - rays.first).sum(1), size.sum() + 4 * len(shape))
    for begin, stop in itertools.pairwise(_chunk_bounds(visits, chunk_visits)):
        masked = not bool(fits[begin:stop].all())
        for axis in range(len(shape)):
            crossings = functools.partial(_crossings_of, rays, begin, shape, strides, axis, masked)
            yield from (found for found in chunked(stop - begin, stop - begin, crossings) if len(found[0]))


def _crossings_of(
    rays: _Rays, begin: int, shape: tuple[int, ...], strides: list[int], axis: int, masked: bool, part: slice
) -> Visits:
    """`_crossings` of a run of rays that starts at `begin`."""
    first, last = begin + part.start, begin + part.stop
    some = _Rays(*(field[first:last] for field in rays))
    voxel, ray = _crossings(some, shape, strides, axis, masked)
    return voxel, ray + first if first else ray


def _chunk_bounds(visits: Tensor, chunk_visits: int) -> list[int]:
    """Cut points [0, …, R] between runs of rays with about `chunk_visits` visits each."""
    chunk = (torch.cumsum(visits, 0) / chunk_visits).floor()
    cuts = (chunk[1:] != chunk[:-1]).nonzero().squeeze(1) + 1
    return [0, *cuts.tolist(), visits.shape[0]]


_IN_GRID = templated(_SOURCE, "count_rays_in_grid", (torch.float64, torch.int32), shares=True)
_CELLS_A_RAY = 16
"""For more rays than a grid has cells / 16, a GPU counts in whole numbers of half the size, which fit better
into its cache, and adds these to the counts."""
_IN_BLOCKS = templated(_SOURCE, "count_rays_in_blocks", (torch.float64, torch.float32), shares=True)
_MARK = FusedKernel(_SOURCE, "mark_rays")
_MARK_BITS = FusedKernel(_SOURCE, "mark_cells_of_rays")


def count_in_grid(
    counts: Tensor,
    starts: Tensor,
    ends: Tensor,
    shape: tuple[int, ...],
    weights: Tensor | None = None,
    low: Tensor | None = None,
) -> None:
    """Add the weight of each ray to `counts`, a dense grid, at every voxel that it leaves.

    Args:
        counts: (voxels,) float64, row-major.
        starts, ends, shape, low: see `traverse`.
        weights: (R,); ones if not given.
    """
    weights = None if weights is None else weights.double()
    starts, ends = starts.double(), ends.double()
    if is_fused(counts, starts, ends, weights, low):
        rays = rays_argument(starts, ends, shape, row_major_strides(shape), low)
        n_rays, is_gpu = len(starts), counts.device.type != "cpu"
        many = is_gpu and weights is None and counts.numel() < _CELLS_A_RAY * n_rays < _CELLS_A_RAY << 31
        added = torch.zeros_like(counts, dtype=torch.int32) if many else counts
        n_items = _n_items(n_rays, counts.device)
        _IN_GRID[added.dtype](n_items, n_rays, *rays, weights, added)
        if many:
            counts += added
        return
    one = torch.ones((), dtype=torch.float64, device=counts.device)
    for voxel, ray in traverse(starts, ends, shape, low=low):
        counts.scatter_add_(0, voxel, one.expand(voxel.shape) if weights is None else weights[ray])


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
    counts: Callable[[], Tensor], table: BlockTable, starts: Tensor, ends: Tensor, weights: Tensor | None
) -> None:
    """Add the weight of each ray at every voxel that it leaves; stores the blocks of these voxels.

    Args:
        counts: gives the counts (cells,), float32 or float64. `table.open` can replace them.
        table: contains the starts and the ends.
        starts, ends: (R, D) in voxels.
        weights: (R,); ones if not given.
    """
    starts, ends = starts.double(), ends.double()
    weights = None if weights is None else weights.to(counts().dtype)
    low, bits = table.low * (1 << table.local_bits), tuple(b + table.local_bits for b in table.bits)
    shape, strides = tuple(1 << b for b in bits), packed_strides(bits)
    if is_fused(counts(), starts, ends, weights):
        _open_blocks_of_rays(table, starts, ends)
        rays = rays_argument(starts, ends, shape, strides, low)
        shifts, above = ([shift for shift, _ in _fields(widths)[:2]] for widths in (bits, table.bits))
        masks = shape[1] - 1, shape[2] - 1 if len(shape) == 3 else 0
        fields = table.local_bits, *shifts, *masks, *above
        n_rays, n_items = len(starts), _n_items(len(starts), starts.device)
        _IN_BLOCKS[counts().dtype](n_items, n_rays, *rays, table.first, *fields, weights, counts())
        return
    one = torch.ones((), dtype=counts().dtype, device=starts.device)
    for voxel, ray in traverse(starts, ends, shape, strides=strides, low=low):
        block, place = _split(voxel, table.bits, table.local_bits)
        first = table.first.index_select(0, block)
        if int(first.min()) < 0:
            table.open(block[first < 0].long().unique())
            first = table.first.index_select(0, block)
        source = one.expand(first.shape) if weights is None else weights[ray]
        counts().scatter_add_(0, first.add_(place), source)


def _open_blocks_of_rays(table: BlockTable, starts: Tensor, ends: Tensor) -> None:
    """Stores the blocks that rays leave, by a walk over blocks.

    Division by a power of two is exact, and `unit` keeps the tie rule of the voxels, so that the walk over
    voxels meets the same blocks.
    """
    marked, side = torch.zeros_like(table.first, dtype=torch.bool), 1 << table.local_bits
    shape, strides = tuple(1 << b for b in table.bits), packed_strides(table.bits)
    rays = rays_argument(starts / side, ends / side, shape, strides, table.low, unit=1 / side)
    _MARK(len(starts), *rays, marked)
    new = (marked & (table.first < 0)).nonzero().squeeze(1)
    if new.numel():
        table.open(new)


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
        _MARK_BITS(len(stops), *rays, is_hit, bit, marks)
        return
    flat = marks.view(-1)
    for voxel, _ in traverse(starts, stops, shape, low=low):
        flat[voxel] |= bit
    ends = stops[is_hit].floor().long() - low
    inside = ((ends >= 0) & (ends < torch.tensor(shape, device=ends.device))).all(1)
    flat[(ends[inside] * torch.tensor(strides, device=ends.device)).sum(1)] |= bit


def _n_items(n_rays: int, device: torch.device) -> int:
    """On a CPU an item is a group of rays that are walked side by side; on CUDA it is a ray."""
    return -(-n_rays // CPU_LANES) if device.type == "cpu" else n_rays


def _split(voxel: Tensor, block_bits: tuple[int, ...], local_bits: int) -> tuple[Tensor, Tensor]:
    """Block in the table, and place in the block, (V,) each, of packed cell indices (V,)."""
    bits = tuple(b + local_bits for b in block_bits)
    packed = voxel.int() if sum(bits) < 31 else voxel
    block, place = torch.zeros_like(packed), torch.zeros_like(packed)
    for shift, width in _fields(bits):
        cell = packed >> shift & ((1 << width) - 1)
        block = block << (width - local_bits) | cell >> local_bits
        place = place << local_bits | cell & ((1 << local_bits) - 1)
    return block, place


def packed_strides(bits: tuple[int, ...]) -> list[int]:
    """Strides of a packed index whose axes have these bits; the last axis is lowest."""
    return [1 << shift for shift, _ in _fields(bits)]


def _fields(bits: tuple[int, ...]) -> list[tuple[int, int]]:
    """(shift, width) of each axis in a packed index; the last axis is lowest."""
    return [(sum(bits[axis + 1 :]), bits[axis]) for axis in range(len(bits))]

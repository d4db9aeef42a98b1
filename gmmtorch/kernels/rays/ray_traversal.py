"""Traversal of a voxel grid by rays. The fused kernel steps from voxel to voxel (`ray_walk.h`).
Its twin enumerates plane crossings, without a stepping loop and without a sort.

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
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.kernels.choice import is_fused
from gmmtorch.kernels.chunks import chunked
from gmmtorch.kernels.compiler import FusedKernel

TIE = 1e-13
"""Distance of crossings that count as one point, relative to the terms: a few hundred times their rounding
error."""
CHUNK_VISITS = 1 << 18
"""Voxel visits in one pass: they fit a core's cache."""


class Visits(NamedTuple):
    """Voxels that rays leave: flat voxel index (V,) and ray index (V,), both int64."""

    voxel: Tensor
    ray: Tensor


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
        slack = 2 + 1e-9 * (enter.abs() + leave.abs())  # a loose bound; `_voxels_left` masks exactly
        moving = (step > 0) & torch.isfinite(enter) & torch.isfinite(leave)
        begin = torch.where(moving, torch.maximum(begin, (enter - slack).floor()), begin)
        stop = torch.where(moving, torch.minimum(stop, (leave + slack).ceil()), stop)
        first_o = rays.first[:, other]
        parallel_outside = (step == 0) & ((first_o < 0) | (first_o >= size[other]))
        stop = torch.where(parallel_outside, begin, stop)
    return begin - first, (stop - begin).clamp_min(0).long()


class _Progression(NamedTuple):
    """Constants (R,) of the crossings of rays along an axis: crossing k leaves voxel base + k·stride."""

    begin: Tensor  # position of the ray's crossing 0 in the flat tensor
    base: Tensor
    stride: Tensor
    step: Tensor  # |direction| along the axis


class _Other(NamedTuple):
    """Constants of each ray along another axis, (R,) each: its position at crossing k is (a + k·b)/step.

    `a` includes the slack of the tie rule. A plane of a lower axis, which is crossed first in a tie, counts
    as crossed slightly before the ray reaches it; a plane of a higher axis slightly after.
    """

    a: Tensor
    b: Tensor
    first: Tensor
    last: Tensor
    stride: Tensor
    size: int
    is_lower_axis: bool


def _voxels_left(
    ray: Tensor, along: _Progression, others: list[_Other], masked: bool
) -> tuple[Tensor, Tensor | None]:
    """Voxel (V,) that each crossing leaves and, if `masked`, whether it is in the grid (V,)."""
    k = torch.arange(ray.shape[0], device=ray.device).sub(along.begin.index_select(0, ray)).double()
    voxel = torch.addcmul(along.base.index_select(0, ray), k, along.stride.index_select(0, ray))
    step = along.step.index_select(0, ray)
    inside: Tensor | None = None
    for other in others:
        position = torch.addcmul(other.a.index_select(0, ray), k, other.b.index_select(0, ray)).div_(step)
        index = position.floor_() if other.is_lower_axis else position.ceil_().sub_(1)
        index = torch.clamp(index, other.first.index_select(0, ray), other.last.index_select(0, ray))
        if masked:
            within = (index >= 0) & (index < other.size)
            inside = within if inside is None else inside & within
        voxel = torch.addcmul(voxel, index, other.stride.index_select(0, ray))
    return voxel.long(), inside


def _crossings(rays: _Rays, shape: tuple[int, ...], strides: list[int], axis: int, masked: bool) -> Visits:
    """All voxels left through planes of `axis`."""
    device = rays.start.device
    size = torch.tensor(shape, dtype=torch.float64, device=device)
    if masked:
        skipped, count = _planes_inside(rays, size, axis)
    else:
        skipped = torch.zeros_like(rays.start[:, axis])
        count = (rays.last[:, axis] - rays.first[:, axis]).long()
    ray = torch.repeat_interleave(count)
    stride_t = torch.tensor(strides, dtype=torch.float64, device=device)
    signed = torch.where(rays.flipped, -stride_t, stride_t)  # mirrored voxel i is size − 1 − i
    shift = (rays.flipped * stride_t * (size - 1)).sum(1)
    step = rays.delta[:, axis]
    # Along this axis crossing k is at plane first + k + 1 and leaves voxel first + k.
    along = _Progression(
        begin=torch.cumsum(count, 0) - count - skipped.long(),
        base=signed[:, axis] * rays.first[:, axis] + shift,
        stride=signed[:, axis].contiguous(),
        step=step.contiguous(),
    )
    to_first = rays.first[:, axis] + 1 - rays.start[:, axis]  # from the start to the first plane
    others = [
        _Other(
            a=rays.start[:, other] * step
            + to_first * rays.delta[:, other]
            + _slack(rays, axis, other) * (1 if other < axis else -1),
            b=rays.delta[:, other].contiguous(),
            first=rays.first[:, other].contiguous(),
            last=rays.last[:, other].contiguous(),
            stride=signed[:, other].contiguous(),
            size=shape[other],
            is_lower_axis=other < axis,
        )
        for other in range(len(shape))
        if other != axis
    ]
    voxel, inside = _voxels_left(ray, along, others, masked)
    return Visits(voxel, ray) if inside is None else Visits(voxel[inside], ray[inside])


def _slack(rays: _Rays, axis: int, other: int) -> Tensor:
    """Largest distance (R,) between crossings of two axes that count as one, times the product of their
    steps.

    It is the same for (axis, other) and (other, axis), so that both take the same decision.
    """
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
    chunk_visits: int = CHUNK_VISITS,
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
    if is_fused(starts, ends, low):
        yield from _fused(starts, ends, shape, chunk_visits, strides, low)
    else:
        yield from _batched(starts, ends, shape, chunk_visits, strides, low)


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
    low = starts.new_zeros(dim) if low is None else low.double().contiguous()
    sizes, pad = [*shape, *[1] * (3 - dim)], [0] * (3 - dim)
    return [starts.contiguous(), ends.contiguous(), low, dim, *sizes, *strides, *pad, TIE, unit]


_COUNT_VISITS = FusedKernel("rays/ray_counting.h", "count_visits")
_LIST_VISITS = FusedKernel("rays/ray_counting.h", "list_visits")


def _fused(
    starts: Tensor,
    ends: Tensor,
    shape: tuple[int, ...],
    chunk_visits: int,
    strides: list[int],
    low: Tensor | None,
) -> Iterator[Visits]:
    device = starts.device
    rays = rays_argument(starts, ends, shape, strides, low)
    counts = torch.empty(starts.shape[0], dtype=torch.int64, device=device)
    _COUNT_VISITS(starts.shape[0], *rays, counts, device=device)
    stops = torch.cumsum(counts, 0)
    cuts = _chunk_bounds(counts, chunk_visits)
    sizes = stops[torch.tensor(cuts[1:], device=device) - 1].tolist()
    for begin, stop, before, after in zip(cuts, cuts[1:], [0, *sizes], sizes, strict=False):
        if after > before:
            listed = functools.partial(_listed, rays, stops, {begin: before, stop: after}, begin)
            yield from chunked(stop - begin, stop - begin, listed)


def _listed(
    rays: list[Tensor | float], stops: Tensor, known: dict[int, int], begin: int, part: slice
) -> Visits:
    """Visits of a run of rays; `known`: how many visits come before a ray, where Python has this number."""
    first, last = begin + part.start, begin + part.stop
    before, after = (known[ray] if ray in known else int(stops[ray - 1]) for ray in (first, last))
    visits = Visits(*torch.empty(2, after - before, dtype=torch.int64, device=stops.device))
    _LIST_VISITS(last - first, first, stops, *visits, *rays, device=stops.device)
    return visits


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
            yield from (found for found in chunked(stop - begin, stop - begin, crossings) if len(found.voxel))


def _crossings_of(
    rays: _Rays,
    begin: int,
    shape: tuple[int, ...],
    strides: list[int],
    axis: int,
    masked: bool,
    part: slice,
) -> Visits:
    """`_crossings` of a run of rays that starts at `begin`."""
    first, last = begin + part.start, begin + part.stop
    some = _Rays(*(field[first:last] for field in rays))
    found = _crossings(some, shape, strides, axis, masked)
    return Visits(found.voxel, found.ray + first if first else found.ray)


def _chunk_bounds(visits: Tensor, chunk_visits: int) -> list[int]:
    """Cut points [0, …, R] between runs of rays with about `chunk_visits` visits each."""
    chunk = (torch.cumsum(visits, 0) / chunk_visits).floor()
    cuts = (chunk[1:] != chunk[:-1]).nonzero().squeeze(1) + 1
    return [0, *cuts.tolist(), visits.shape[0]]

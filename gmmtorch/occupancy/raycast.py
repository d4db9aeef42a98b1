"""Ray casting through a voxel grid by enumerating plane crossings: no stepping loop, no sort.

A straight segment leaves one voxel at each grid plane that it crosses. For each axis the planes
crossed are an arithmetic progression, so all crossings of all rays along one axis are one flat
tensor; the voxel that is left follows from the plane on that axis and from `floor` on the others.
Every voxel that a ray passes through, save the one it ends in, is left exactly once.

Coordinates here are *grid units*: voxel (i, j, k) is [i, i+1) × [j, j+1) × [k, k+1).
Where a ray crosses two planes in the same point it crosses the lower axis first.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor

CHUNK_VISITS = 1 << 18
"""Voxel visits worked on at once: small enough to stay in a core's cache, whatever the ray count."""


class Visits(NamedTuple):
    """Voxels left by rays: flat voxel index (V,) and the ray that left it (V,), both int64."""

    voxel: Tensor
    ray: Tensor


class _Rays(NamedTuple):
    """Rays mirrored so that every direction component is ≥ 0 (shapes (R, D))."""

    start: Tensor
    delta: Tensor
    first: Tensor  # index of the start voxel
    last: Tensor  # index of the end voxel
    flipped: Tensor  # which axes were mirrored


def _mirrored(starts: Tensor, ends: Tensor) -> _Rays:
    first, last = starts.floor(), ends.floor()
    delta = ends - starts
    flipped = delta < 0
    # Voxel i = [i, i+1) becomes (−i−1, −i] under x → −x: closed on the other side, which is what
    # the tie rule below wants, since a mirrored start on a plane has that plane still to cross.
    mirror = lambda x: torch.where(flipped, -x, x)  # noqa: E731
    mirror_index = lambda i: torch.where(flipped, -i - 1, i)  # noqa: E731
    return _Rays(mirror(starts), delta.abs(), mirror_index(first), mirror_index(last), flipped)


def _planes_inside(rays: _Rays, shape: Tensor, axis: int) -> tuple[Tensor, Tensor]:
    """First crossing and number of crossings on `axis` that can touch the grid, each (R,).

    Crossing k goes from mirrored voxel first+k to first+k+1. Those whose voxel lies outside the
    grid on this axis are cut off; on the other axes an interval of crossings that certainly
    contains every inside one is kept, so work is bounded by the grid however long the ray is.
    """
    size = shape[axis]
    low = torch.where(rays.flipped[:, axis], -size, torch.zeros_like(size))
    first, last = rays.first[:, axis], rays.last[:, axis]
    begin = torch.maximum(low, first)
    stop = torch.minimum(low + size, last)  # crossings leave voxels begin … stop−1
    for other in range(rays.start.shape[1]):
        if other == axis:
            continue
        low_o = torch.where(rays.flipped[:, other], -shape[other], torch.zeros_like(size))
        step = rays.delta[:, other]
        ratio = rays.delta[:, axis] / step
        enter = rays.start[:, axis] + (low_o - rays.start[:, other]) * ratio
        leave = rays.start[:, axis] + (low_o + shape[other] - rays.start[:, other]) * ratio
        slack = 2 + 1e-9 * (enter.abs() + leave.abs())  # only a bound: the mask decides
        moving = (step > 0) & torch.isfinite(enter) & torch.isfinite(leave)
        begin = torch.where(moving, torch.maximum(begin, (enter - slack).floor()), begin)
        stop = torch.where(moving, torch.minimum(stop, (leave + slack).ceil()), stop)
        parallel_outside = (step == 0) & (
            (rays.first[:, other] < low_o) | (rays.first[:, other] >= low_o + shape[other])
        )
        stop = torch.where(parallel_outside, begin, stop)
    return begin - first, (stop - begin).clamp_min(0).long()


class _Progression(NamedTuple):
    """Per-ray constants of an axis's crossings, (R,) each: crossing k leaves voxel base + k·stride."""

    begin: Tensor  # flat index of the ray's crossing 0
    base: Tensor
    stride: Tensor
    step: Tensor  # |direction| along the axis


class _Other(NamedTuple):
    """Per-ray constants of another axis, (R,) each: its position at crossing k is (a + k·b)/step."""

    a: Tensor
    b: Tensor
    first: Tensor
    last: Tensor
    stride: Tensor
    low: Tensor  # the grid's lowest index, mirrored like the ray
    size: int
    is_lower_axis: bool


def _voxels_left(
    ray: Tensor, along: _Progression, others: list[_Other], masked: bool
) -> tuple[Tensor, Tensor | None]:
    """Voxel (V,) that each crossing leaves, and, if `masked`, whether it lies in the grid."""
    k = torch.arange(ray.shape[0], device=ray.device).sub(along.begin.index_select(0, ray)).double()
    voxel = torch.addcmul(along.base.index_select(0, ray), k, along.stride.index_select(0, ray))
    step = along.step.index_select(0, ray)
    inside: Tensor | None = None
    for other in others:
        # Scaled by step, the two terms of the position are exact for coordinates of up to 24
        # significant bits, so that ties fall as the rule says.
        position = torch.addcmul(other.a.index_select(0, ray), k, other.b.index_select(0, ray)).div_(step)
        # Planes of a lower axis are crossed first in a tie, those of a higher axis afterwards.
        index = position.floor_() if other.is_lower_axis else position.ceil_().sub_(1)
        index = torch.clamp(index, other.first.index_select(0, ray), other.last.index_select(0, ray))
        if masked:
            low = other.low.index_select(0, ray)
            within = (index >= low) & (index < low + other.size)
            inside = within if inside is None else inside & within
        voxel = torch.addcmul(voxel, index, other.stride.index_select(0, ray))
    return voxel.long(), inside


@functools.cache
def _compiled_voxels_left() -> Callable[..., tuple[Tensor, Tensor | None]]:
    compiled: Callable[..., tuple[Tensor, Tensor | None]] = torch.compile(_voxels_left, dynamic=True)
    return compiled


def _crossings(
    rays: _Rays, shape: tuple[int, ...], strides: list[int], axis: int, masked: bool, compiled: bool
) -> Visits:
    """Every voxel left through a plane of `axis`."""
    device = rays.start.device
    size = torch.tensor(shape, dtype=torch.float64, device=device)
    if masked:
        offset, count = _planes_inside(rays, size, axis)
    else:
        offset = torch.zeros_like(rays.start[:, axis])
        count = (rays.last[:, axis] - rays.first[:, axis]).long()
    ray = torch.repeat_interleave(count)
    signed = torch.where(rays.flipped, -1.0, 1.0).double() * torch.tensor(
        strides, dtype=torch.float64, device=device
    )  # mirrored index i is voxel i, or −i−1 where flipped
    shift = (rays.flipped * signed).sum(1)
    step = rays.delta[:, axis]
    # Along this axis the plane of crossing k is first + k + 1, and the voxel left is first + k.
    along = _Progression(
        begin=torch.cumsum(count, 0) - count - offset.long(),
        base=signed[:, axis] * rays.first[:, axis] + shift,
        stride=signed[:, axis].contiguous(),
        step=step.contiguous(),
    )
    to_first = rays.first[:, axis] + 1 - rays.start[:, axis]  # from the start to the first plane
    others = [
        _Other(
            a=rays.start[:, other] * step + to_first * rays.delta[:, other],
            b=rays.delta[:, other].contiguous(),
            first=rays.first[:, other].contiguous(),
            last=rays.last[:, other].contiguous(),
            stride=signed[:, other].contiguous(),
            low=-size[other] * rays.flipped[:, other],
            size=shape[other],
            is_lower_axis=other < axis,
        )
        for other in range(len(shape))
        if other != axis
    ]
    voxel, inside = (_compiled_voxels_left() if compiled else _voxels_left)(ray, along, others, masked)
    return Visits(voxel, ray) if inside is None else Visits(voxel[inside], ray[inside])


def row_major_strides(shape: tuple[int, ...]) -> list[int]:
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
    compiled: bool = False,
) -> Iterator[Visits]:
    """Voxels passed through and left by each segment, the end voxel excluded.

    Args:
        starts: (R, D) segment starts in grid units, finite.
        ends: (R, D) segment ends in grid units, finite.
        shape: voxels along each axis; voxels outside are not reported.
        chunk_visits: about how many visits each yielded chunk holds.
        strides: of the flat voxel index, one for each axis; row-major if not given.
        compiled: enumerate with torch.compile: the same voxels several times faster, after some
            tens of seconds for its first use in a process. Needs a C++ compiler.

    Yields:
        `Visits` of flat voxel indices and ray indices. Within a ray each voxel occurs once;
        chunks and the order within them carry no meaning.
    """
    if starts.shape[0] == 0:
        return
    rays = _mirrored(starts.double(), ends.double())
    size = torch.tensor(shape, dtype=torch.float64, device=starts.device)
    strides = strides or row_major_strides(shape)
    low = torch.where(rays.flipped, -size, torch.zeros_like(size))
    fits = ((rays.first >= low) & (rays.last < low + size)).all(1)
    # A ray that leaves the grid visits at most sum(shape) of its voxels.
    visits = torch.minimum((rays.last - rays.first).sum(1), size.sum() + 4 * len(shape))
    for begin, stop in itertools.pairwise(_chunk_bounds(visits, chunk_visits)):
        part = _Rays(*(field[begin:stop] for field in rays))
        masked = not bool(fits[begin:stop].all())
        for axis in range(len(shape)):
            chunk = _crossings(part, shape, strides, axis, masked, compiled)
            if chunk.voxel.numel():
                yield Visits(chunk.voxel, chunk.ray + begin if begin else chunk.ray)


def _chunk_bounds(visits: Tensor, chunk_visits: int) -> list[int]:
    """Cut points [0, …, R] such that each run of rays makes about `chunk_visits` visits."""
    chunk = (torch.cumsum(visits, 0) / chunk_visits).floor()
    cuts = (chunk[1:] != chunk[:-1]).nonzero().squeeze(1) + 1
    return [0, *cuts.tolist(), visits.shape[0]]

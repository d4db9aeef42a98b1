"""CellEvidence: hits and misses of a few cells of an unbounded lattice, as one frame or message brings."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, MemoryLimitError
from gmmtorch.occupancy.grid import BYTES_PER_CELL, MEMORY_LIMIT, check_resolution
from gmmtorch.occupancy.voxels.ray_traversal import Visits, row_major_strides, traverse

_FARTHEST = 2.0**32  # cells from the world's origin: within, the ray casting's sums are exact

_CHUNK_VISITS = 1 << 16  # fastest where cores share a cache


class CellEvidence(NamedTuple):
    """cells (C, 3) int64, distinct: cell c is the cube [c, c + 1) times the resolution, world frame;
    hits (C,) and misses (C,), float32: rays that end in each, and that pass through it."""

    cells: Tensor
    hits: Tensor
    misses: Tensor

    @classmethod
    def empty(cls, device: torch.device | str | None = None) -> CellEvidence:
        zero = torch.zeros(0, device=device)
        return cls(torch.zeros(0, 3, dtype=torch.int64, device=device), zero, zero)


class Box(NamedTuple):
    """Lattice cells from `low` (3,) up to but without `high` (3,), int64."""

    low: Tensor
    high: Tensor

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple((self.high - self.low).tolist())


def in_cells(points: Tensor, resolution: float, name: str = "points") -> Tensor:
    """World points (…, 3), metres, in units of the lattice, float64.

    Raises `InvalidArgumentError` where they are not finite, or too far to tell the cells apart.
    """
    units = points.double() / check_resolution(resolution)
    # Not `>=`: NaN must fail, too.
    if units.numel() and not bool(units.abs().max() < _FARTHEST):
        raise InvalidArgumentError(
            f"{name} must be finite and less than 2**32 cells of resolution={resolution} m from the world's "
            "origin; drop such points, or take coarser cells."
        )
    return units


def common(one: Box, other: Box) -> Box | None:
    """The cells that are in both boxes; None if there are none."""
    found = Box(torch.maximum(one.low, other.low), torch.minimum(one.high, other.high))
    return found if bool((found.low < found.high).all()) else None


def cast_evidence(
    origins: Tensor,
    ends: Tensor,
    is_hit: Tensor,
    resolution: float,
    box: Box,
    weights: Tensor | None = None,
    free_until: Tensor | None = None,
    struck: tuple[Tensor, Tensor] | None = None,
) -> CellEvidence:
    """Evidence of rays in the cells of a box: what lies outside is trimmed off (thesis Fig 4.2).

    A ray misses every cell that it passes through and leaves, and hits the one that it ends in; a ray
    that is no hit speaks of the cells before its end alone. What a cell gets does not depend on the box.

    Args:
        origins: (R, 3) or (3,), metres. ends: (R, 3). is_hit: (R,) bool. weights: (R,); ones if not given.
        resolution: side (m) of the cells.
        free_until: (R, 3), metres, on the way to the ends: misses are counted no further, nor in the cell
            that this is in. At the ends if not given.
        struck: (H, 3) places, metres, and (H,) weights of the hits, where these are drawn more densely than
            the rays that are followed. The ends of rays that are hits if not given.

    Raises:
        InvalidArgumentError: rays that are not finite, or end 2³² cells or more from the world's origin.
        MemoryLimitError: rays that span too many cells of the box.
    """
    starts, stops = in_cells(origins, resolution, "origins"), in_cells(ends, resolution, "ends")
    starts = starts.expand_as(stops)
    until = None if free_until is None else in_cells(free_until, resolution, "free_until")
    places = None if struck is None else in_cells(struck[0], resolution, "struck")
    passage = passage_of(starts, stops, box, until, places)
    if passage is None:
        return CellEvidence.empty(ends.device)
    window, block = passage.window, passage.block
    n_bytes = math.prod(block.shape) * BYTES_PER_CELL
    if n_bytes > MEMORY_LIMIT:
        raise MemoryLimitError(
            f"resolution={resolution} m over rays that span {' × '.join(map(str, window.shape))} cells takes "
            f"{n_bytes:,} bytes, above the limit of {MEMORY_LIMIT:,}; take coarser cells or a smaller box."
        )
    weight = torch.ones_like(stops[:, 0]) if weights is None else weights.double()
    misses = torch.zeros(math.prod(block.shape), dtype=torch.float64, device=ends.device)
    for visit in passage.visits:
        misses.scatter_add_(0, visit.voxel, weight.index_select(0, visit.ray))
    misses = misses.view(block.shape)
    if block is not window:
        misses = misses[1:-1, 1:-1, 1:-1]
    if places is None or struck is None:
        places, counts = stops[is_hit], weight[is_hit]
    else:
        counts = struck[1].double()
    flat, inside = flat_index(places.floor().long() - window.low, window.shape)
    hits = weight.new_zeros(math.prod(window.shape)).index_add_(0, flat[inside], counts[inside])
    return from_dense(window.low, hits.view(window.shape), misses)


class Passage(NamedTuple):
    """Rays through a box. window: the cells of the box among which they go; block: the cells that
    `visits` number row-major, which is the window, or that with one more cell on each side."""

    window: Box
    block: Box
    visits: Iterator[Visits]


def passage_of(
    starts: Tensor, stops: Tensor, box: Box, until: Tensor | None = None, others: Tensor | None = None
) -> Passage | None:
    """The cells of a box that rays (R, 3), in grid units, leave; None if they do not come to it. They are
    followed no further than `until` (R, 3), if that is given. The window has room for `others` (H, 3).

    Rays that leave the box are cut half a cell outside it. So no cell of the box is cut, and none is
    entered or left elsewhere than without a box, but for rounding: that stays far below what the
    traversal takes for one point, as places are taken from the corner of the window.
    """
    if len(stops) == 0:
        return None
    places = [x for x in (starts, stops, others) if x is not None and len(x)]
    both = torch.stack([x.amin(0) for x in places] + [x.amax(0) for x in places]).floor().long()
    lowest, highest = both.amin(0), both.amax(0) + 1
    window = Box(torch.maximum(lowest, box.low), torch.minimum(highest, box.high))
    if bool((window.low >= window.high).any()):
        return None
    stops = stops if until is None else until
    if torch.equal(window.low, lowest) and torch.equal(window.high, highest):
        visits = traverse(starts, stops, window.shape, _CHUNK_VISITS, low=window.low)
        return Passage(window, window, visits)
    block = Box(window.low - 1, window.high + 1)
    first, last = shares_near(starts, stops, stops, window)
    near = (first <= last).nonzero().squeeze(1)
    start, stop = _relative(starts[near], block.low), _relative(stops[near], block.low)
    way, first, last = stop - start, first[near, None], last[near, None]
    cut_start = torch.where(first > 0, start + first * way, start)
    cut_stop = torch.where(last < 1, start + last * way, stop)
    cut = traverse(cut_start, cut_stop, block.shape, _CHUNK_VISITS)
    return Passage(window, block, (Visits(visit.voxel, near[visit.ray]) for visit in cut))


def _relative(units: Tensor, low: Tensor) -> Tensor:
    """units − low, in the same cell even where rounding would put it on the next plane."""
    return torch.minimum(units - low, (units.floor() - low + 1) * (1 - 2.0**-53))


def from_dense(low: Tensor, hits: Tensor, misses: Tensor) -> CellEvidence:
    """The cells of a dense block (nx, ny, nz) with lowest cell `low` (3,) that have any evidence."""
    _, ny, nz = hits.shape
    flat = ((hits > 0) | (misses > 0)).flatten().nonzero().squeeze(1)
    column = flat // nz
    cells = torch.stack([column // ny, column % ny, flat % nz], 1)
    return CellEvidence(
        cells + low,
        hits.flatten().index_select(0, flat).float(),
        misses.flatten().index_select(0, flat).float(),
    )


def united(parts: Iterable[CellEvidence]) -> CellEvidence:
    """The sum of several, each cell once."""
    parts = [part for part in parts if len(part.cells)]
    if not parts:
        return CellEvidence.empty()
    if len(parts) == 1:
        return parts[0]
    cells = torch.cat([part.cells for part in parts])
    low = cells.amin(0)
    shape = tuple((cells.amax(0) - low + 1).tolist())
    if math.prod(shape) >= 2**62:
        raise InvalidArgumentError(f"Evidence that spans {shape} cells cannot be united; take coarser cells.")
    strides = torch.tensor(row_major_strides(shape), device=cells.device)
    key, row = torch.unique(((cells - low) * strides).sum(1), return_inverse=True)
    sums = [
        torch.zeros(len(key), device=cells.device).index_add_(0, row, torch.cat([part[i] for part in parts]))
        for i in (1, 2)
    ]
    size = torch.tensor(shape, device=cells.device)
    return CellEvidence(key[:, None] // strides % size + low, *sums)


def flat_index(local: Tensor, shape: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    """Row-major index (C,) of cells (C, 3) of a block of `shape`, 0 where outside, and which are inside."""
    nx, ny, nz = shape
    x, y, z = local.unbind(1)
    # Axis by axis: reductions over a dimension of three are slow.
    inside = (x >= 0) & (x < nx) & (y >= 0) & (y < ny) & (z >= 0) & (z < nz)
    return torch.where(inside, (x * ny + y) * nz + z, 0), inside


def shares_near(apex: Tensor, low: Tensor, high: Tensor, box: Box) -> tuple[Tensor, Tensor]:
    """Between which shares (R,) of the way the hulls of a point (R, 3) and of a block [low, high], (R, 3)
    each, are within half a cell of a box: the first is above the last of those that never are.

    All in grid units. At a share t the hull is [a + t(low − a), a + t(high − a)], so that each side of
    the box bounds t. A ray is the hull of its start and its end.
    """
    first, last = torch.zeros_like(apex[:, 0]), torch.ones_like(apex[:, 0])
    lowest, highest = box.low.tolist(), box.high.tolist()
    for axis in range(3):
        start = apex[:, axis]
        for bound, side, sign in ((highest, low, 1.0), (lowest, high, -1.0)):
            room = sign * (bound[axis] - start) + 0.5
            slope = sign * (side[:, axis] - start)  # t · slope ≤ room
            share = room / slope
            last = torch.where(slope > 0, torch.minimum(last, share), last)
            first = torch.where(slope < 0, torch.maximum(first, share), first)
            last = torch.where((slope == 0) & (room < 0), -1.0, last)
    return first, last

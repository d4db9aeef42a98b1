"""Ray casting into a box of the lattice: the evidence of rays, and the cells that they leave."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike, as_tensor
from gmmtorch.errors import MemoryLimitError
from gmmtorch.kernels import count_in_grid
from gmmtorch.occupancy.grid import BYTES_PER_CELL, MEMORY_LIMIT
from gmmtorch.occupancy.voxels.cells import Box, CellEvidence, flat_index, intersection, to_lattice


def cast_evidence(
    origins: ArrayLike,
    ends: ArrayLike,
    is_hit: ArrayLike,
    resolution: float,
    box: Box,
    weights: ArrayLike | None = None,
    hit_places: tuple[ArrayLike, ArrayLike] | None = None,
) -> CellEvidence:
    """Evidence of rays in the cells of a box; rays are trimmed to the box (thesis Fig 4.2).

    A ray adds a miss to each cell that it passes through and leaves, and a hit to the cell that it ends in. A
    no-return beam adds no hit. The evidence of a cell does not depend on the box.

    Args:
        origins: (R, 3) or (3,), world metres.
        ends: (R, 3), world metres.
        is_hit: (R,) bool, False for no-return beams.
        resolution: side (m) of the cells.
        weights: (R,); ones if not given.
        hit_places: points (H, 3), world metres, and weights (H,) of the hits, if hits are sampled more
            densely than rays. By default the ends of the rays with `is_hit`.

    Raises:
        InvalidArgumentError: a point that is not finite, or 2³² cells or more from the world's origin.
        MemoryLimitError: the rays span too many cells of the box.
    """
    starts, stops = to_lattice(origins, resolution, "origins"), to_lattice(ends, resolution, "ends")
    starts = starts.expand_as(stops)
    places = None if hit_places is None else to_lattice(hit_places[0], resolution, "hit_places")
    rays = rays_in_box(starts, stops, box, others=places)
    if rays is None:
        return CellEvidence.empty(stops.device)
    window, block = rays.window, rays.block
    n_bytes = math.prod(block.shape) * BYTES_PER_CELL
    if n_bytes > MEMORY_LIMIT:
        raise MemoryLimitError(
            f"resolution={resolution} m over rays that span {' × '.join(map(str, window.shape))} cells takes "
            f"{n_bytes:,} bytes, above the limit of {MEMORY_LIMIT:,}; use coarser cells or a smaller box."
        )
    weight = torch.ones_like(stops[:, 0])
    if weights is not None:
        weight = as_tensor(weights, "weights", torch.float64, stops.device)
    misses = torch.zeros(block.shape, dtype=torch.float64, device=stops.device)
    of_rays = weight if rays.ray is None else weight.index_select(0, rays.ray)
    count_in_grid(misses.view(-1), rays.starts, rays.stops, block.shape, of_rays, rays.low)
    if block is not window:
        misses = misses[1:-1, 1:-1, 1:-1]
    if places is None or hit_places is None:
        struck = as_tensor(is_hit, "is_hit", torch.bool, stops.device)
        places, counts = stops[struck], weight[struck]
    else:
        counts = as_tensor(hit_places[1], "hit_places[1]", torch.float64, stops.device)
    flat, inside = flat_index(places.floor().long() - window.low, window.shape)
    hits = weight.new_zeros(math.prod(window.shape)).index_add_(0, flat[inside], counts[inside])
    return CellEvidence.from_dense(window.low, hits.view(window.shape), misses)


class RaysInBox(NamedTuple):
    """Rays through a box of cells.

    window: the part of the box that the rays span. block: the cells in which rays are counted: the window,
    or the window with a margin of one cell. starts, stops: (r, 3) in cells, cut near the window. low:
    (3,) lowest cell of the block, None if the coordinates are relative to it. ray: (r,) indices of the rays
    given, None if these are all.
    """

    window: Box
    block: Box
    starts: Tensor
    stops: Tensor
    low: Tensor | None
    ray: Tensor | None


def rays_in_box(
    starts: Tensor, stops: Tensor, box: Box, until: Tensor | None = None, others: Tensor | None = None
) -> RaysInBox | None:
    """The cells of a box that rays (R, 3) leave on the way to `stops`, or to `until` (R, 3) if given.

    All coordinates are in cells. The window also covers the part of the box that `others` (H, 3) span. None
    if the window is empty.

    Rays that leave the box are cut half a cell outside it. So no cell of the box is cut, and rays enter and
    leave cells where they do without the box, up to rounding. Rounding stays below the tie tolerance of the
    traversal, because coordinates are relative to the corner of the window.
    """
    if len(stops) == 0:
        return None
    places = [x for x in (starts, stops, others) if x is not None and len(x)]
    corners = torch.stack([x.amin(0) for x in places] + [x.amax(0) for x in places]).floor().long()
    lowest, highest = corners.amin(0), corners.amax(0) + 1
    window = intersection(Box(lowest, highest), box)
    if window is None:
        return None
    stops = stops if until is None else until
    if torch.equal(window.low, lowest) and torch.equal(window.high, highest):
        return RaysInBox(window, window, starts, stops, window.low, None)
    block = Box(window.low - 1, window.high + 1)
    first, last = near_interval(starts, stops, stops, window)
    near = (first <= last).nonzero().squeeze(1)
    start, stop = _relative(starts[near], block.low), _relative(stops[near], block.low)
    way, first, last = stop - start, first[near, None], last[near, None]
    cut_start = torch.where(first > 0, start + first * way, start)
    cut_stop = torch.where(last < 1, start + last * way, stop)
    return RaysInBox(window, block, cut_start, cut_stop, None, near)


def _relative(units: Tensor, low: Tensor) -> Tensor:
    """units − low, kept in the same cell where rounding would move it to the next plane."""
    return torch.minimum(units - low, (units.floor() - low + 1) * (1 - 2.0**-53))


def near_interval(apex: Tensor, low: Tensor, high: Tensor, box: Box) -> tuple[Tensor, Tensor]:
    """Interval [first, last] of t, (R,) each, in which a hull is within half a cell of a box.

    The hull of an apex a (R, 3) and a block [low, high], (R, 3) each, is at t the box
    [a + t(low − a), a + t(high − a)], so that each side of the given box bounds t. With low = high it is the
    segment from a to that point. The interval is empty (last < first) if the hull is never near. All in
    cells.
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

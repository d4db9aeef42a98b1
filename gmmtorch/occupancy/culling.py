"""Culling: the cells and faces of a grid, and the boxes, that a cone can meet.

All tests are conservative: a cell that is left out has no evidence; a cell that is kept can have none.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.linalg import ragged_index
from gmmtorch.occupancy.cones import CUTOFF, Cones, WhitenedCones, cone_bounds, outside_cone
from gmmtorch.occupancy.grid import VoxelGrid

Pairs = tuple[Tensor, Tensor]
"""Indices of boxes and indices of cones, (P,) int64 each."""


_PAIRS_AT_ONCE = 1 << 18  # pairs of a box and a cone that are tested in one pass


def candidate_pairs(cones: Cones, low: Tensor, high: Tensor, cutoff: float = CUTOFF) -> Iterator[Pairs]:
    """All pairs of a box [low, high], (M, D) each, and a cone that can meet, by testing all pairs."""
    if not len(cones.counts) or not len(low):
        return
    cones = Cones(*(part.detach() for part in cones))
    low, high = low.detach().double(), high.detach().double()
    below, above = cone_bounds(cones, cutoff)
    white = WhitenedCones.of(cones)
    for rows in torch.arange(len(low), device=low.device).split(max(1, _PAIRS_AT_ONCE // len(cones.counts))):
        met = (low[rows, None] <= above).all(-1) & (high[rows, None] >= below).all(-1)
        box, cone = met.nonzero(as_tuple=True)
        box = rows[box]
        part = white.take(cone)
        center, side = 0.5 * (low[box] + high[box]).T, (high[box] - low[box]).T
        ray, offset = part.apply(center - part.origin), part.apply(center - part.mean)
        edges = part.matrix.transpose(0, 1) * side[:, None]
        kept = (~outside_cone(ray, offset, edges, cutoff)).nonzero().squeeze(1)
        yield box[kept], cone[kept]


def in_chunks(pairs: Iterable[Pairs], size: int) -> Iterator[Pairs]:
    """The same pairs in chunks of at most `size`."""
    for box, cone in pairs:
        yield from zip(box.split(size), cone.split(size), strict=True)


class FaceRows(NamedTuple):
    """R rectangles of faces, each in one plane of a grid, that the rays of a cone can cross.

    cone (R,): index of the cone. plane (R,): index of the grid plane. forward (R,) bool: whether rays cross
    it in the positive direction of the axis. first, number (R, D−1): lowest cell and number of cells along
    the other axes, in their order.
    """

    cone: Tensor
    plane: Tensor
    forward: Tensor
    first: Tensor
    number: Tensor


def face_rows(cones: Cones, grid: VoxelGrid, cutoff: float = CUTOFF) -> Iterator[FaceRows]:
    """Faces that the rays of each cone can cross: those perpendicular to each axis in turn.

    In the plane at c of axis a, the cone extends along another axis b over s_b + (c − s_a) m, where m lies
    between the slopes of the two tangents from the sensor origin s to the projection of the component's
    ellipsoid on the axes (a, b).
    """
    sensor = grid.to_units(cones.origins).detach()
    mean = grid.to_units(cones.means).detach()
    covariance = cones.covariances.detach().double() * (cutoff / grid.resolution) ** 2
    spread = covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    below, above = torch.minimum(sensor, mean - spread), torch.maximum(sensor, mean + spread)
    for axis in range(grid.dim):
        yield _rows_of_axis(sensor, mean, covariance, (below, above), grid, axis)


def _rows_of_axis(
    sensor: Tensor,
    mean: Tensor,
    covariance: Tensor,
    bounds: tuple[Tensor, Tensor],
    grid: VoxelGrid,
    axis: int,
) -> FaceRows:
    """Rows perpendicular to `axis`; sensor, mean, covariance times cutoff², and bounds, in cells."""
    below, above = bounds
    n = grid.shape[axis]
    # Forward: planes 1 … n above the sensor origin, each the upper face of a cell; backward: 0 … n − 1.
    begin = torch.stack([sensor[:, axis].floor() + 1, below[:, axis].floor() + 1])
    stop = torch.stack([above[:, axis].ceil(), sensor[:, axis].ceil()])
    begin = torch.stack([begin[0].clamp(1, n + 1), begin[1].clamp(0, n)]).long()
    stop = torch.stack([stop[0].clamp(1, n + 1), stop[1].clamp(0, n)]).long()
    planes = (stop - begin).clamp_min(0).flatten()
    row, within = ragged_index(planes)
    plane = within + begin.flatten()[row]
    cone, forward = row % len(sensor), row < len(sensor)
    height = plane - sensor[cone, axis]
    first, count = [], []
    for other in range(grid.dim):
        if other == axis:
            continue
        slopes = _tangent_slopes(mean - sensor, covariance, axis, other)
        ends = sensor[cone, other] + height * torch.stack(slopes)[:, cone]
        low = torch.maximum(ends.amin(0), below[cone, other])
        high = torch.minimum(ends.amax(0), above[cone, other])
        size = grid.shape[other]
        lowest = low.floor().clamp(0, size).long()
        first.append(lowest)
        count.append((high.ceil().clamp(0, size).long() - lowest).clamp_min(0))
    return FaceRows(cone, plane, forward, torch.stack(first, 1), torch.stack(count, 1))


def _tangent_slopes(toward: Tensor, scaled: Tensor, a: int, b: int) -> tuple[Tensor, Tensor]:
    """Slopes m = db/da (C,) of the two tangents from the sensor origin to the ellipse of k²Σ (`scaled`).

    They solve (d_b − m d_a)² = k²(Σ_bb − 2mΣ_ab + m²Σ_aa) and are infinite where the ellipse extends to the
    sensor origin or behind it along axis a.
    """
    da, db = toward[:, a], toward[:, b]
    square = da * da - scaled[:, a, a]
    middle = da * db - scaled[:, a, b]
    rest = db * db - scaled[:, b, b]
    bounded = square > 1e-9 * da * da
    square = torch.where(bounded, square, 1.0)
    root = (middle * middle - square * rest).clamp_min(0).sqrt()
    slack = 1e-9 * (1 + middle.abs() / square + root / square)
    infinite = torch.full_like(root, torch.inf)
    low = torch.where(bounded, (middle - root) / square - slack, -infinite)
    high = torch.where(bounded, (middle + root) / square + slack, infinite)
    return low, high


class BallRows(NamedTuple):
    """Boxes of cells around R ellipsoids: cone (R,); lowest cell `first` and `number` of cells, (R, D)."""

    cone: Tensor
    first: Tensor
    number: Tensor


def ball_rows(cones: Cones, grid: VoxelGrid, cutoff: float = CUTOFF) -> BallRows:
    """Cells that the ellipsoid of each cone can meet; cones of no-return beams have none."""
    cone = (~cones.max_range).nonzero().squeeze(1)
    mean = grid.to_units(cones.means[cone].detach())
    variance = cones.covariances[cone].detach().double().diagonal(dim1=-2, dim2=-1)
    spread = cutoff / grid.resolution * variance.sqrt()
    size = torch.tensor(grid.shape, dtype=torch.float64, device=mean.device)
    low = (mean - spread).floor().clamp(mean.new_zeros(()), size).long()
    high = (mean + spread).ceil().clamp(mean.new_zeros(()), size).long()
    return BallRows(cone, low, high - low)


def cells_in_chunks(first: Tensor, count: Tensor, size: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Row (P,) and cell indices (K, P) of all cells of R boxes of cells, in chunks of `size`.

    Args:
        first, count: (R, K), lowest cell and number of cells of each box along each axis.
    """
    per_row = count.prod(1)
    ends = torch.cumsum(per_row, 0)
    total = int(ends[-1]) if len(ends) else 0
    for begin in range(0, total, size):
        flat = torch.arange(begin, min(begin + size, total), device=ends.device)
        row = torch.searchsorted(ends, flat, right=True)
        local = flat - (ends - per_row)[row]
        cells = []
        for axis in reversed(range(first.shape[1])):
            cells.append(first[row, axis] + local % count[row, axis])
            local = local // count[row, axis]
        yield row, torch.stack(cells[::-1])

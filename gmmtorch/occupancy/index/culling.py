"""Culling: which cells and which faces of a grid a component's cone can reach at all.

Everything here errs on the safe side: what is left out has no evidence, what is kept may have none.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.occupancy.cones import CUTOFF, Cones, whitening
from gmmtorch.occupancy.forms.cone.mahalanobis import outside_cone
from gmmtorch.occupancy.grid import VoxelGrid

Pairs = tuple[Tensor, Tensor]
"""Indices of boxes and of cones, (P,) int64 each."""


class Whitened(NamedTuple):
    """What every pair with a cone needs of it, coordinates first, float64.

    matrix (D, D, C): W; mean, origin (D, C): world; toward (D, C): W(μ − s); log_norm (C,): log √det 2πΣ.
    """

    matrix: Tensor
    mean: Tensor
    origin: Tensor
    toward: Tensor
    log_norm: Tensor

    @classmethod
    def of(cls, cones: Cones) -> Whitened:
        inverse, log_norm = whitening(cones.covariances)
        mean, origin = cones.means.double().T, cones.origins.double().T
        matrix = inverse.permute(1, 2, 0).contiguous()
        return cls(matrix, mean, origin, (matrix * (mean - origin)).sum(1), log_norm)

    def take(self, cone: Tensor) -> Whitened:
        return Whitened(*(part.index_select(-1, cone) for part in self))

    def apply(self, vector: Tensor) -> Tensor:
        """W v: (D, P) → (D, P)."""
        return (self.matrix * vector[None]).sum(1)


def reach(cones: Cones, cutoff: float = CUTOFF) -> tuple[Tensor, Tensor]:
    """Lowest and highest corners (C, D) of the box around each cone: its ellipsoid and its sensor."""
    means, origins = cones.means.double(), cones.origins.double()
    deviation = cutoff * cones.covariances.double().diagonal(dim1=-2, dim2=-1).sqrt()
    return torch.minimum(origins, means - deviation), torch.maximum(origins, means + deviation)


def candidate_pairs(
    cones: Cones, low: Tensor, high: Tensor, cutoff: float = CUTOFF, chunk_pairs: int = 1 << 18
) -> Iterator[Pairs]:
    """Every box and cone that can meet, by trying all: boxes [low, high], (M, D) each."""
    if not len(cones.counts) or not len(low):
        return
    cones = Cones(*(part.detach() for part in cones))
    low, high = low.detach().double(), high.detach().double()
    below, above = reach(cones, cutoff)
    white = Whitened.of(cones)
    for rows in torch.arange(len(low), device=low.device).split(max(1, chunk_pairs // len(cones.counts))):
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
    """The same pairs, at most `size` at once."""
    for box, cone in pairs:
        yield from zip(box.split(size), cone.split(size), strict=True)


class FaceRows(NamedTuple):
    """Rectangles of faces, each on one plane of a grid, that a cone can cross outwards.

    cone (R,); plane (R,): index of the grid plane; forward (R,) bool: crossed in the direction of the
    axis; first, number (R, D−1): lowest cell and how many there are along the other axes, in their order.
    """

    cone: Tensor
    plane: Tensor
    forward: Tensor
    first: Tensor
    number: Tensor


def face_rows(cones: Cones, grid: VoxelGrid, axis: int, cutoff: float = CUTOFF) -> FaceRows:
    """Faces across `axis` that each cone can cross.

    On the plane at c the cone reaches s_b + (c − s_a) m along another axis b, m between the slopes of
    the tangents from the sensor to the ellipse that is the component's shadow on the plane (a, b).
    """
    device = cones.means.device
    sensor = grid.to_units(cones.origins).detach()
    mean = grid.to_units(cones.means).detach()
    covariance = cones.covariances.detach().double() * (cutoff / grid.resolution) ** 2
    spread = covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    below, above = torch.minimum(sensor, mean - spread), torch.maximum(sensor, mean + spread)
    n = grid.shape[axis]
    # Forward: planes 1 … n above the sensor, each closing the cell before it; backward: 0 … n − 1.
    begin = torch.stack([sensor[:, axis].floor() + 1, below[:, axis].floor() + 1])
    stop = torch.stack([above[:, axis].ceil(), sensor[:, axis].ceil()])
    begin = torch.stack([begin[0].clamp(1, n + 1), begin[1].clamp(0, n)]).long()
    stop = torch.stack([stop[0].clamp(1, n + 1), stop[1].clamp(0, n)]).long()
    planes = (stop - begin).clamp_min(0).flatten()
    row = torch.repeat_interleave(planes)
    plane = torch.arange(len(row), device=device) - (torch.cumsum(planes, 0) - planes - begin.flatten())[row]
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
    """Slopes db/da (C,) of the two tangents from the sensor to the ellipse of k²Σ, `scaled`.

    Infinite where the ellipse reaches beside or behind the sensor along axis a. They solve
    (d_b − m d_a)² = k²(Σ_bb − 2mΣ_ab + m²Σ_aa).
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
    """Boxes of cells around the ellipsoids of components: cone (R,); first, number (R, D)."""

    cone: Tensor
    first: Tensor
    number: Tensor


def ball_rows(cones: Cones, grid: VoxelGrid, cutoff: float = CUTOFF) -> BallRows:
    """Cells in which points of each cone can lie; cones that met no surface have none."""
    cone = (~cones.max_range).nonzero().squeeze(1)
    mean = grid.to_units(cones.means[cone].detach())
    variance = cones.covariances[cone].detach().double().diagonal(dim1=-2, dim2=-1)
    spread = cutoff / grid.resolution * variance.sqrt()
    size = torch.tensor(grid.shape, dtype=torch.float64, device=mean.device)
    low = (mean - spread).floor().clamp(mean.new_zeros(()), size).long()
    high = (mean + spread).ceil().clamp(mean.new_zeros(()), size).long()
    return BallRows(cone, low, high - low)


def cells_in_chunks(first: Tensor, count: Tensor, size: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Row (P,) and indices (K, P) of every cell of boxes of cells first, count (R, K), `size` at once."""
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

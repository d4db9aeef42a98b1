"""Exact evidence of one component in one box: the reference for every form of evidence.

Implements the angular form of the thesis's appendix (5.1-5.3). Along each direction from the sensor the
component is a Gaussian of the distance, whose integrals inside and behind the box have a closed form. The
integral over the directions (one angle in 2D, two in 3D) uses Gauss-Legendre rules that are refined until two
of them agree. This file shares no code with the forms of evidence, and is much slower than they are.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.occupancy import Cones

TOLERANCE = 1e-9
"""Largest difference of two rules on one interval of directions, in rays per ray of the cone."""

_REACH = 8.5  # standard deviations from the mean where the density is zero in float64
_STEPS = (0.0, 0.5, 1.0, 1.7, 2.5, 3.5, 4.5, 6.0, _REACH)  # interval limits, in standard deviations
_ORDERS = 7, 10
_MAX_DEPTH = 40
_CHUNK = 1 << 11  # directions in 3D whose inner integrals are computed together


class _Scenes(NamedTuple):
    """P boxes seen from their sensors, in whitened coordinates, where the component is a unit normal.

    The world direction of a whitened direction w is L F w (m). F is a rotation that puts the mean at distance
    p (P,) on the first axis. matrix: L F (P, D, D). low, high: corners relative to the sensor (m), (P, D).
    corners: whitened corners (P, 2^D, D). edges: whitened end points of the box's edges (P, E, 2, D).
    """

    matrix: Tensor
    distance: Tensor
    low: Tensor
    high: Tensor
    corners: Tensor
    edges: Tensor

    def take(self, index: Tensor) -> _Scenes:
        return _Scenes(*(part[index] for part in self))


def angular_evidence(
    cones: Cones, low: Tensor, high: Tensor, tolerance: float = TOLERANCE
) -> tuple[Tensor, Tensor]:
    """Hits (P,) and misses (P,) of each cone in its own box, in rays per ray of the cone.

    There is no cutoff: components keep their tails. `counts` and `max_range` of the cones are ignored.

    Args:
        cones: P cones, one for each box.
        low, high: (P, D) corners, world metres.
        tolerance: see `TOLERANCE`. Two rules can agree by chance, so the largest error over thousands of
            boxes is about 1e-7.

    Raises:
        InvalidArgumentError: the numbers of cones and boxes differ.
    """
    if not len(cones.means) == len(low) == len(high):
        raise InvalidArgumentError(
            f"low has {len(low)} and high {len(high)} boxes for {len(cones.means)} cones; give one box for "
            "each cone."
        )
    scenes = _scenes(cones, low.double(), high.double())
    start, stop = _limit(scenes.distance, math.pi)
    breaks = torch.cat([_graded(scenes.distance, math.pi), _azimuths(scenes.corners)], 1)
    breaks = breaks.clamp(start[:, None], stop[:, None]).sort(1).values
    around = _circle if cones.dim == 2 else functools.partial(_slices, tolerance=tolerance)
    value = _integrate(lambda x, row: around(scenes, x, row), breaks, torch.full_like(start, tolerance))
    return value[:, 0], value[:, 1]


def _scenes(cones: Cones, low: Tensor, high: Tensor) -> _Scenes:
    origins = cones.origins.double()
    factor = torch.linalg.cholesky(cones.covariances.double())
    mean = torch.linalg.solve_triangular(factor, (cones.means.double() - origins)[:, :, None], upper=False)
    dim = cones.dim
    frame = torch.linalg.qr(torch.cat([mean, torch.eye(dim).to(mean).expand(len(mean), dim, dim)], 2)).Q
    ahead = (frame[:, :, :1] * mean).sum(1, keepdim=True) < 0
    frame = torch.where(ahead, -frame, frame)  # the evidence is the same for a reflection
    matrix = factor @ frame
    low, high = low - origins, high - origins
    bits = torch.tensor(list(itertools.product((0, 1), repeat=dim)), device=low.device)
    world = torch.where(bits == 1, high[:, None], low[:, None])
    corners = torch.linalg.solve(matrix, world.transpose(1, 2)).transpose(1, 2)
    pairs = [(a, b) for a in range(2**dim) for b in range(a) if (a ^ b).bit_count() == 1]
    edges = corners[:, torch.tensor(pairs, device=low.device)]
    return _Scenes(matrix, mean.squeeze(2).norm(dim=1), low, high, corners, edges)


def _limit(distance: Tensor, widest: float) -> tuple[Tensor, Tensor]:
    """Angles from the mean between which the density is not zero, at most ±`widest`."""
    far = torch.asin((_REACH / distance.clamp_min(_REACH)).clamp_max(1.0))
    angle = torch.where(distance > _REACH, far, widest)
    return -angle, angle


def _graded(distance: Tensor, widest: float) -> Tensor:
    """Interval limits (P, B), in angles from the mean, for a unit normal at `distance` (P,)."""
    steps = distance.new_tensor(_STEPS)
    angles = torch.asin((steps / distance.clamp_min(1e-9)[:, None]).clamp_max(1.0))
    ends = torch.stack(_limit(distance, widest), 1)
    return torch.cat([angles, -angles[:, 1:], ends], 1)


def _azimuths(corners: Tensor) -> Tensor:
    return torch.atan2(corners[..., 1], corners[..., 0])


def _circle(scenes: _Scenes, angle: Tensor, row: Tensor) -> Tensor:
    """Hits and misses per radian in 2D, for angles (Q, n): (Q, n, 2)."""
    direction = torch.stack([angle.cos(), angle.sin()], 2)
    return _along(scenes, direction, angle.sin() ** 2, row)


def _slices(scenes: _Scenes, azimuth: Tensor, row: Tensor, tolerance: float) -> Tensor:
    """Hits and misses per radian of azimuth in 3D, (Q, n, 2): integrals over the elevation."""
    n_rows, n_nodes = azimuth.shape
    azimuth, row = azimuth.flatten(), row.repeat_interleave(n_nodes)
    parts = zip(azimuth.split(_CHUNK), row.split(_CHUNK), strict=True)
    return torch.cat([_half_planes(scenes, a, r, tolerance) for a, r in parts]).view(n_rows, n_nodes, 2)


def _half_planes(scenes: _Scenes, azimuth: Tensor, row: Tensor, tolerance: float) -> Tensor:
    """∫ … cos β dβ over the elevation β in half-planes (Q,) through the polar axis: (Q, 2)."""
    elevations, crossed = _elevations(scenes.edges[row], azimuth)
    value = azimuth.new_zeros(len(azimuth), 2)
    met = crossed.nonzero().squeeze(1)
    azimuth, row, elevations = azimuth[met], row[met], elevations[met]
    distance = scenes.distance[row]
    start, stop = _limit(distance, 0.5 * math.pi)
    breaks = torch.cat([_graded(distance, 0.5 * math.pi), elevations], 1)
    breaks = breaks.clamp(start[:, None], stop[:, None]).sort(1).values

    def density(elevation: Tensor, which: Tensor) -> Tensor:
        turn, up = azimuth[which, None], elevation
        direction = torch.stack([up.cos() * turn.cos(), up.cos() * turn.sin(), up.sin()], 2)
        off = up.sin() ** 2 + (up.cos() * turn.sin()) ** 2
        return _along(scenes, direction, off, row[which]) * up.cos()[..., None]

    return value.index_copy(0, met, _integrate(density, breaks, tolerance * distance.clamp_min(1.0)))


def _elevations(edges: Tensor, azimuth: Tensor) -> tuple[Tensor, Tensor]:
    """Elevations (Q, E) at which edges (Q, E, 2, 3) cross the half-planes at `azimuth` (Q,), 0 where they
    do not; and a mask (Q,) of the half-planes that an edge crosses."""
    normal = torch.stack([-azimuth.sin(), azimuth.cos()], 1)
    toward = torch.stack([azimuth.cos(), azimuth.sin()], 1)
    side = (edges[..., :2] * normal[:, None, None]).sum(3)
    change = side[..., 0] - side[..., 1]
    share = side[..., 0] / torch.where(change == 0, 1.0, change)
    point = edges[..., 0, :] + share[..., None] * (edges[..., 1, :] - edges[..., 0, :])
    ahead = (point[..., :2] * toward[:, None]).sum(2)
    crossed = (share >= 0) & (share <= 1) & (change != 0) & (ahead > 0)
    return torch.where(crossed, torch.atan2(point[..., 2], ahead), 0.0), crossed.any(1)


def _along(scenes: _Scenes, direction: Tensor, off: Tensor, row: Tensor) -> Tensor:
    """Hits and misses per unit of directions (Q, n, D); off (Q, n): squared sine of the angle to the mean.

    With b = p cos(angle), both are (2π)^{−D/2} e^{−½(p² − b²)} ∫ t^{D−1} e^{−½(t − b)²} dt: hits between
    the points where the ray enters and leaves the box, misses behind the box.
    """
    dim = direction.shape[2]
    world = torch.einsum("qij,qnj->qni", scenes.matrix[row], direction)
    world = torch.where(world.abs() < 1e-300, 1e-300, world)
    first = scenes.low[row][:, None] / world
    second = scenes.high[row][:, None] / world
    enter = torch.minimum(first, second).amax(2).clamp_min(0)
    leave = torch.maximum(first, second).amin(2)
    met = leave > enter
    distance = scenes.distance[row][:, None]
    mean = distance * direction[..., 0]
    peak = torch.exp(-0.5 * distance**2 * off) / (2 * math.pi) ** (0.5 * dim) * met
    whole = _moment(torch.full_like(mean, torch.inf), mean, dim)
    end = _moment(leave, mean, dim)
    return torch.stack([end - _moment(enter, mean, dim), whole - end], 2) * peak[..., None]


def _moment(t: Tensor, mean: Tensor, dim: int) -> Tensor:
    """An antiderivative of t^{D−1} e^{−½(t − b)²}."""
    error = math.sqrt(math.pi / 2) * torch.erf((t - mean) / math.sqrt(2))
    t = t.clamp_max(1e150)
    gaussian = torch.exp(-0.5 * (t - mean) ** 2)
    if dim == 2:
        return mean * error - gaussian
    return (mean * mean + 1) * error - (t + mean) * gaussian


@functools.cache
def _rule(order: int) -> tuple[Tensor, Tensor]:
    """Gauss-Legendre nodes and weights on [0, 1]."""
    nodes, weights = np.polynomial.legendre.leggauss(order)
    return torch.as_tensor((nodes + 1) / 2), torch.as_tensor(weights / 2)


def _integrate(function: Callable[[Tensor, Tensor], Tensor], breaks: Tensor, tolerance: Tensor) -> Tensor:
    """Integral (R, 2) from the first to the last of the sorted breaks (R, B).

    Halves the intervals on which two rules differ by more than the tolerance (R,).

    Args:
        function: x (Q, n) and the row index (Q,) of each interval → (Q, n, 2).
    """
    rules = [tuple(part.to(breaks) for part in _rule(order)) for order in _ORDERS]
    n = breaks.shape[1] - 1
    low, high = breaks[:, :-1].flatten(), breaks[:, 1:].flatten()
    row = torch.arange(len(breaks), device=breaks.device).repeat_interleave(n)
    total = breaks.new_zeros(len(breaks), 2)
    kept = (high > low).nonzero().squeeze(1)
    low, high, row = low[kept], high[kept], row[kept]
    for depth in range(_MAX_DEPTH):
        if not len(row):
            break
        width = high - low
        values = []
        for nodes, weights in rules:
            parts = function(low[:, None] + width[:, None] * nodes, row)
            values.append(torch.einsum("qnc,n->qc", parts, weights) * width[:, None])
        agree = ((values[1] - values[0]).abs().amax(1) <= tolerance[row]) | (depth == _MAX_DEPTH - 1)
        total.index_add_(0, row[agree], values[1][agree])
        low, high, row = low[~agree], high[~agree], row[~agree]
        middle = 0.5 * (low + high)
        low, high, row = torch.cat([low, middle]), torch.cat([middle, high]), row.repeat(2)
    return total

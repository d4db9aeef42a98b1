"""Point evidence: hits and misses of the cube around a point from the cones near it; see `PointForm`. And the
lists of the cones whose hulls can give evidence near a place, see `occupancy.cone_index`.

The fused kernel walks the list of cones of each point, tests whether the point is within the cutoff, and
evaluates those that are. Its twin evaluates blocks of points.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.kernels.choice import is_fused
from gmmtorch.kernels.compiler import CPU_LANES, squad_size, templated
from gmmtorch.linalg import ragged_index

_SQRT_HALF_PI = math.sqrt(math.pi / 2)


class PointTable(NamedTuple):
    """The quantities that pairs of a point and a cone need, in the axes V of the component, float64.

    rows: (C, D² + 5D + 4), for each cone V row by row, μ, s, Vᵀ(μ − s), the diagonal of VᵀΣV, 1/(that +
        h²/12), and h²/12 |μ − s|², the logarithm of the largest hit, N, and N without no-return beams.
    tilts: (C, D(D − 1)/2), the off-diagonal entries of VᵀΣV if gradients pass through them, otherwise (C, 0).
        They are zero.
    """

    rows: Tensor
    tilts: Tensor


_GLANCES = templated("evidence/point_evidence.h", "glance_at", (2, 3))


def glances(rows: Tensor, dim: int, resolution: float, cutoff: float) -> Tensor:
    """(C, 2D + 5) float32, what the quick tests of fused kernels read, of `PointTable.rows`."""
    found = rows.new_empty(len(rows), 2 * dim + 5, dtype=torch.float32)
    _GLANCES[dim](len(rows), rows, resolution, cutoff, found)
    return found


_EVIDENCE = templated("evidence/point_evidence.h", "point_evidence", (2, 3))


def listed_evidence(
    points: Tensor,
    order: Tensor,
    bucket: Tensor,
    lists: tuple[Tensor, Tensor],
    rows: Tensor,
    glanced: Tensor,
    resolution: float,
    cutoff: float,
    found: tuple[Tensor, Tensor],
) -> None:
    """Adds hits and misses of the points in `order` to `found`, (M,) float64 each, by the fused kernel.

    Cones are added one after the other, so that two calls with parts of the lists equal one with both.

    Args:
        points: (M, D) float64.
        order: (R,) int64, rows of points, of which neighbours follow each other.
        bucket: (M,) int64, the list of each point; −1 for points without evidence.
        lists: starts (B + 1,), int64, and entries, int32, of the lists of cones.
        rows: see `PointTable.rows`. glanced: see `glances`.
    """
    lanes = CPU_LANES if points.device.type == "cpu" else 1
    given = points, order, bucket, len(order), *lists, rows, glanced
    _EVIDENCE[points.shape[1]](-(-len(order) // lanes), *given, resolution, cutoff, *found)


_GROUPED = templated("evidence/point_evidence.h", "grouped_evidence", (2, 3))
GROUP = 64
"""Neighbouring points whose cones are found together, as in `point_evidence.h`."""


def grouped_evidence(
    points: Tensor,
    order: Tensor,
    boxes: tuple[Tensor, Tensor],
    rows: Tensor,
    glanced: Tensor,
    resolution: float,
    cutoff: float,
    found: tuple[Tensor, Tensor],
) -> None:
    """`listed_evidence` of all cones: points are compared with each. boxes: low, high (G, D) of each `GROUP`
    of points."""
    device, n_groups = points.device, len(boxes[0])
    n_items = -(-n_groups // CPU_LANES) if device.type == "cpu" else n_groups * squad_size(device)
    given = points, order, len(order), *boxes, rows, glanced, len(rows), resolution, cutoff
    _GROUPED[points.shape[1]](n_items, *given, *found)


def pair_evidence(
    points: Tensor, block: Tensor, rows: Tensor, tilts: Tensor, cone: Tensor, resolution: float, cutoff: float
) -> tuple[Tensor, Tensor]:
    """Hits and misses (B, R) of R pairs of a block (R,) of points (D, B, b) and a cone (R,) of a table."""
    dim = points.shape[0]
    h = resolution
    columns = rows[cone].T.contiguous().unbind()
    axes = [columns[i * dim : (i + 1) * dim] for i in range(dim)]  # axes[i][j]: entry i of axis j
    mean, origin, seen, variances = (columns[dim * dim + i * dim :][:dim] for i in range(4))
    widening, log_scale, counts, surface = columns[-4:]
    oblique = tilts[cone].unbind(1)

    x = [axis[:, block] for axis in points]
    offset = [a - m for a, m in zip(x, mean, strict=True)]
    ray = [a - s for a, s in zip(x, origin, strict=True)]
    size = [r.abs() for r in ray]
    at_sensor = functools.reduce(torch.maximum, size) <= 0.5 * h  # the cube contains the sensor origin
    y = [sum_of(axes[i][j] * offset[i] for i in range(dim)) for j in range(dim)]
    # There all rays pass. The closed form is not used; it is kept finite for the sake of gradients.
    z = [torch.where(at_sensor, 1.0, a + b) for a, b in zip(y, seen, strict=True)]
    squared_distance = torch.where(at_sensor, 1.0, sum_of(r * r for r in ray))
    breadth = torch.where(at_sensor, 1.0, sum_of(size))

    sharp = [1 / (v + h * h / 12) for v in variances]
    squared = _product(y, y, sharp, oblique)
    hit = (torch.exp(log_scale - 0.5 * squared) * (cutoff**2 - squared).clamp(0, 1)).clamp_max(1)

    kappa = widening / squared_distance
    sharp = [1 / (v + kappa) for v in variances]
    aa, bb = _product(z, z, sharp, oblique), _product(y, z, sharp, oblique)
    across = [a - bb / aa * b for a, b in zip(y, z, strict=True)]
    squared = _product(across, across, sharp, oblique)
    length = aa.sqrt()
    along = bb / length
    leaving = along + 0.5 * h * length / breadth
    determinant = functools.reduce(torch.mul, sharp)
    peak = torch.exp(-0.5 * squared) * (determinant / (2 * math.pi * aa) ** dim).sqrt()
    flux = peak * tail_moment(leaving, length - along, dim) * breadth * h ** (dim - 1)
    inside = (cutoff**2 - squared - leaving.clamp_min(0) ** 2).clamp(0, 1)
    miss = torch.minimum(torch.where(at_sensor, 1.0, flux * inside), 1 - hit)
    return hit * surface, miss * counts


def _product(v: list[Tensor], w: list[Tensor], sharp: list[Tensor], tilts: Sequence[Tensor]) -> Tensor:
    """vᵀ(VᵀΣV + κI)⁻¹w, to first order in the off-diagonal entries `tilts`, which are zero."""
    dim = len(v)
    product = sum_of(g * a * b for g, a, b in zip(sharp, v, w, strict=True))
    pairs = [(i, j) for i in range(dim) for j in range(i + 1, dim)] if tilts else []
    for (i, j), tilt in zip(pairs, tilts, strict=True):
        product = product - tilt * sharp[i] * sharp[j] * (v[i] * w[j] + v[j] * w[i])
    return product


def tail_moment(along: Tensor, depth: Tensor, dim: int) -> Tensor:
    """∫_a^∞ (w + b)^{D−1} e^{−w²/2} dw, the radial integral of the rays that end beyond a point; any shape.

    All lengths are in the deviations of one ray, measured from its point nearest to the mean: a (`along`)
    is the position of the query, and −b (`depth`) that of the sensor origin. With Q = √(π/2) erfc(a/√2) and
    g = e^{−a²/2} the integral is b Q + g in 2D and (b² + 1) Q + (2b + a) g in 3D.
    """
    tail = _SQRT_HALF_PI * torch.special.erfc(along * math.sqrt(0.5))
    edge = torch.exp(-0.5 * along * along)
    if dim == 2:
        return depth * tail + edge
    return (depth * depth + 1) * tail + (2 * depth + along) * edge


def sum_of(terms: Iterable[Tensor]) -> Tensor:
    """Sum of tensors, in order; unlike `sum` it does not start with an integer 0."""
    return functools.reduce(torch.add, terms)


_FEW_POINTS = "evidence/few_points.h"
_NEAR_FEW = templated(_FEW_POINTS, "few_points_near", (2, 3))
_OF_FEW = templated(_FEW_POINTS, "few_points_evidence", (2, 3))
_VIEWS_AT_ONCE = 4096


def few_points_evidence(
    views: tuple[Tensor, ...], points: Tensor, sides: Sequence[float], cutoff: float, widest: float
) -> tuple[Tensor, Tensor]:
    """Hits and misses (S, 2, M) of the cubes of some sides (m) at a few points (M, D), float64, from all
    viewpoints; and the number of pairs of a point and a viewpoint (), near enough to give evidence.

    Needs no index. Evidence differs from that of lists by the rounding of its sums, and of the axes.

    Args:
        views: means, covariances, max_range, origins, seen_by, seen_from, seen_count, as in `Components`.
        widest: distance (m) by which the largest cube widens a cone that it is as far away as.
    """
    n, dim = points.shape
    device = points.device
    means, covariances, max_range, origins, by, seen_from, count = views
    counts = torch.empty_like(by)
    tested = means, covariances, origins, by, seen_from, points, n, widest, cutoff
    _NEAR_FEW[dim](len(by), *tested, counts)
    found = points.new_zeros(len(sides), 2, n)
    lengths = torch.tensor(list(sides), dtype=torch.float64).to(device, non_blocking=True)
    parts = 1 if device.type == "cpu" else n
    for chosen in counts.nonzero().squeeze(1).split(_VIEWS_AT_ONCE):
        each = points.new_empty(len(chosen), *found.shape)
        given = means, covariances, max_range, origins, by, seen_from, count, points, n
        rows = chosen, *given, lengths, len(sides), cutoff, parts, each
        _OF_FEW[dim](len(chosen) * parts, *rows)
        found += each.sum(0)
    return found, counts.sum()


_NEAR = templated("evidence/near_lists.h", "near_lists", (2, 3))
_PARTS_OF_LISTS = 32  # of a list, on a device with many threads


class Lists(NamedTuple):
    """Lists of cones: list i holds `entries[starts[i] : starts[i + 1]]`. starts int64, entries int32."""

    starts: Tensor
    entries: Tensor

    @classmethod
    def of(cls, lengths: Tensor, entries: Tensor) -> Lists:
        """Lists of these lengths, one after the other."""
        return cls(torch.cat([lengths.new_zeros(1), lengths.cumsum(0)]), entries)

    def lengths(self) -> Tensor:
        """Number of cones in each list."""
        return self.starts[1:] - self.starts[:-1]

    def taken(self, lists: Tensor) -> tuple[Tensor, Tensor]:
        """All entries of some lists (T,), in order: position in `lists` (P,) and cone (P,), int64."""
        begin = self.starts[lists]
        place, within = ragged_index(self.starts[lists + 1] - begin)
        return place, self.entries[begin[place] + within].long()


def near_lists(
    table: Tensor,
    given: Lists,
    lists: Tensor,
    centers: Tensor,
    radii: Tensor,
    cube_reach: float,
    spread: float,
    cutoff: float,
) -> Lists:
    """For each ball (T,), those cones of its list that can give evidence to a cube centred in the ball.

    Args:
        table: (C, n) float64, a row for each cone, which begins as `PointTable.rows` up to the variances.
        lists: (T,) a list of `given` for each ball. Balls of one list that follow each other share its cost.
        centers, radii: (T, D), (T,) of the balls, float64.
        cube_reach: from the centre of a cube to its corners; spread: see `Hulls`; metres.
        cutoff: Mahalanobis distance at which a component ends.
    """
    lengths = given.lengths()[lists]
    if is_fused(table, given.entries, lists, centers):
        ends = lengths.cumsum(0)
        firsts, n_entries = ends - lengths, int(ends[-1]) if len(ends) else 0
        near = torch.empty(n_entries, dtype=torch.bool, device=table.device)
        counts, n = torch.zeros_like(radii), len(lists)
        lanes, parts = (CPU_LANES, 1) if table.device.type == "cpu" else (1, _PARTS_OF_LISTS)
        balls = lists, firsts, centers, radii, n, cube_reach, spread
        rest = table.shape[1], cutoff, parts, near, counts
        _NEAR[centers.shape[1]](-(-n // lanes) * parts, table, *given, *balls, *rest)
        counts = counts.long()
        shift = torch.repeat_interleave(given.starts[lists] - firsts, counts)
        return Lists.of(counts, given.entries[near.nonzero().squeeze(1) + shift])
    ball, cone = given.taken(lists)
    near = _near_cone(table.T, cone, centers[ball], radii[ball], cube_reach, spread, cutoff)
    return Lists.of(torch.bincount(ball[near], minlength=len(lists)), cone[near].int())


def _near_cone(
    table: Tensor,
    cone: Tensor,
    centers: Tensor,
    radius: Tensor,
    cube_reach: float,
    spread: float,
    cutoff: float,
) -> Tensor:
    """Whether each cone (P,) meets its ball; the twin. The cones are columns of the table.

    Let y, within R of the centre x, lie on the segment from the sensor origin s to a point p of the
    ellipsoid E. Then the ray from s through x passes, beyond x, within R |p − s|/|y − s| ≤ β of p, with β =
    R·far/(|x − s| − R). So from x on this ray meets the sum of E and a ball of radius β. The ellipsoid (1 +
    ε)E + (1 + 1/ε)β²I contains that sum for every ε > 0. The test uses two values of ε, which are tight
    along the two longest axes. In the smoothed case E is widened first.
    """
    dim = centers.shape[1]
    columns = [column[cone] for column in table[: dim * dim + 4 * dim]]
    mean, origin, _, variances = (columns[dim * dim + i * dim :][:dim] for i in range(4))
    squares = [cutoff**2 * variance.clamp_min(0) for variance in variances]
    whole = sum_of((m - s).square() for m, s in zip(mean, origin, strict=True)).sqrt()
    far = whole + squares[-1].sqrt()
    axes = [columns[i * dim : (i + 1) * dim] for i in range(dim)]  # axes[i][j]: entry i of axis j
    x = centers.unbind(1)
    ray = [a - s for a, s in zip(x, origin, strict=True)]
    offset = [a - m for a, m in zip(x, mean, strict=True)]
    y = [sum_of(axes[i][j] * offset[i] for i in range(dim)) for j in range(dim)]
    z = [sum_of(axes[i][j] * ray[i] for i in range(dim)) for j in range(dim)]
    distance = sum_of(r * r for r in ray).sqrt()
    reach = radius if spread > 0 else radius + cube_reach
    clear = (distance - reach).clamp_min(1e-12)
    widened = (spread * (whole / clear).clamp_min(1)) ** 2  # added variance, of the rays and of the component
    far = far + widened.sqrt()
    beta = far * reach / clear
    near = distance <= far + reach
    for axis in (-1, -2):
        ratio = (beta / (squares[axis] + widened).sqrt().clamp_min(1e-12)).clamp(1e-6, 1e6)
        added = (1 + ratio) * widened + (1 + 1 / ratio) * beta**2
        weight = [1 / ((1 + ratio) * square + added) for square in squares]
        cc = sum_of(w * a * a for w, a in zip(weight, y, strict=True))
        bb = sum_of(w * a * b for w, a, b in zip(weight, y, z, strict=True))
        aa = sum_of(w * b * b for w, b in zip(weight, z, strict=True))
        # Squared Mahalanobis distance to the inflated ellipsoid, at x or at the nearest point of the ray
        # beyond x.
        near = near & (cc - bb.clamp_max(0) ** 2 / aa.clamp_min(1e-300) < 1 + 1e-6)
    # The bound does not hold where the cube contains the sensor origin: these cones count as near.
    return near | (distance <= (reach + cube_reach) * (1 + 1e-9))

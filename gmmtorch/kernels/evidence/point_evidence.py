"""Point evidence: hits and misses of the cube around a point from the cones near it; see `PointForm`.

The fused kernel walks the list of cones of each point, tests whether the point is within the cutoff, and
evaluates those that are. Its twin evaluates blocks of points. Their evidence differs by at most 10⁻¹² of the
count of a cone, for each cone.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.kernels.compiler import FusedKernel
from gmmtorch.kernels.simd import CPU_LANES, SIMD

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


_BODY = """
    const double h = resolution, limit = cutoff * cutoff;
    const int64_t begin = item * LANES, stop = GMM_MIN(begin + LANES, n_points);
    vec x[DIM], hits, misses, number = (vec)(-1.0);
    for (int l = 0; l < LANES; ++l) {
        const int64_t point = order[GMM_MIN(begin + l, stop - 1)];
        for (int a = 0; a < DIM; ++a) set(x[a], l, points[point * DIM + a]);
        set(hits, l, hits_out[point]);
        set(misses, l, misses_out[point]);
        if (begin + l < stop) set(number, l, (double)bucket[point]);
    }
    for (int first = 0; first < LANES; ++first) {  // each bucket of these points once
        const double mine = get(number, first);
        if (mine < 0.0 || (first > 0 && get(number, first - 1) == mine)) continue;
        const mask active = number == mine;
        const int64_t list = (int64_t)mine;
        for (int64_t entry = starts[list]; entry < starts[list + 1]; ++entry) {
            const double* cone = table + entries[entry] * WIDTH;
            GMM_FETCH(table + entries[GMM_MIN(entry + 6, starts[list + 1] - 1)] * WIDTH, WIDTH);
            const double *mean = cone + DIM * DIM, *origin = mean + DIM, *seen = origin + DIM;
            const double *variance = seen + DIM, *fixed = variance + DIM, *rest = fixed + DIM;
            vec y[DIM], z[DIM], ray[DIM];
            vec squared_distance = (vec)(0.0), squared = (vec)(0.0), turn = (vec)(0.0);
            double seen_squared = 0.0;
            for (int j = 0; j < DIM; ++j) {
                const double toward = mean[j] - origin[j];
                ray[j] = x[j] - origin[j];
                squared_distance += ray[j] * ray[j];
                turn += toward * ray[j];
                seen_squared += toward * toward;
            }
            // The mean is farther from the ray than the cutoff for the largest variance: a quick test.
            const double widest = seen_squared * (1.0 - 1e-14) - limit * (variance[DIM - 1] + h * h / 12.0);
            const mask near = widest * squared_distance - turn * turn <= GMM_MAX(limit, 9.0) * rest[0];
            if (!any(active & near)) continue;
            for (int j = 0; j < DIM; ++j) {
                y[j] = (vec)(0.0);
                for (int i = 0; i < DIM; ++i) y[j] += cone[i * DIM + j] * (x[i] - mean[i]);
                z[j] = y[j] + seen[j];
                squared += fixed[j] * y[j] * y[j];
            }
            const vec kappa = rest[0] / squared_distance;
            vec wide[DIM], sharp[DIM];
            for (int j = 0; j < DIM; ++j) wide[j] = variance[j] + kappa;
            vec determinant;
            SHARPEN
            vec aa = (vec)(0.0), bb = (vec)(0.0), cc = (vec)(0.0);
            for (int j = 0; j < DIM; ++j) {
                aa += sharp[j] * z[j] * z[j];
                bb += sharp[j] * y[j] * z[j];
                cc += sharp[j] * y[j] * y[j];
            }
            vec breadth = (vec)(0.0), extent = (vec)(0.0);
            for (int j = 0; j < DIM; ++j) {
                const vec size = ray[j] < 0.0 ? -ray[j] : ray[j];
                breadth += size;
                extent = size > extent ? size : extent;
            }
            const mask at_sensor = extent <= 0.5 * h;
            // Conservative: squares of differences lose digits, which the second term allows for.
            const vec room = (limit * (1.0 + 1e-9) + 1e-9 * cc) * aa;
            const mask passes = (cc * aa - bb * bb < room) & !((bb > 0.0) & (bb * bb > room));
            const mask strikes = squared < limit;
            if (!any(active & (at_sensor | passes | strikes))) continue;
            vec hit = (vec)(0.0);
            if (any(active & strikes)) {
                vec fade = limit - squared;
                fade = fade < 0.0 ? (vec)(0.0) : fade > 1.0 ? (vec)(1.0) : fade;
                hit = expo(rest[1] - 0.5 * squared) * fade;
                hit = hit > 1.0 ? (vec)(1.0) : hit;
            }
            vec miss = (vec)(0.0);
            if (any(active & passes)) {
                const vec length = root(aa), share = bb / aa;
                vec across = (vec)(0.0);
                for (int j = 0; j < DIM; ++j) {
                    const vec part = y[j] - share * z[j];
                    across += sharp[j] * part * part;
                }
                const vec along = share * length, leaving = along + 0.5 * h * length / breadth;
                const vec beyond = leaving > 0.0 ? leaving : (vec)(0.0);
                vec fade = limit - across - beyond * beyond;
                fade = fade < 0.0 ? (vec)(0.0) : fade > 1.0 ? (vec)(1.0) : fade;
                const vec edge = expo(-0.5 * leaving * leaving);
                const vec ratio = edge * mills(leaving < 0.0 ? -leaving : leaving);
                const vec tail = leaving < 0.0 ? 2.5066282746310002 - ratio : ratio;
                const vec depth = length - along;
                MOMENT
                const vec peak = expo(-0.5 * across) * root(determinant) / NORM;
                miss = peak * moment * breadth * AREA * fade;
            }
            miss = at_sensor ? (vec)(1.0) : miss;
            miss = miss < 1.0 - hit ? miss : 1.0 - hit;
            hits += active ? hit * rest[3] : (vec)(0.0);
            misses += active ? miss * rest[2] : (vec)(0.0);
        }
    }
    for (int l = 0; l < LANES; ++l)
        if (begin + l < stop) {
            const int64_t point = order[begin + l];
            hits_out[point] = get(hits, l);
            misses_out[point] = get(misses, l);
        }
"""
_BY_DIM = {
    2: {
        "SHARPEN": "determinant = 1.0 / (wide[0] * wide[1]); sharp[0] = wide[1] * determinant;"
        " sharp[1] = wide[0] * determinant;",
        "MOMENT": "const vec moment = depth * tail + edge;",
        "NORM": "(6.283185307179586 * aa)",
        "AREA": "h",
    },
    3: {
        "SHARPEN": "const vec pair = wide[0] * wide[1]; determinant = 1.0 / (pair * wide[2]);"
        " sharp[2] = pair * determinant; const vec third = wide[2] * determinant;"
        " sharp[0] = wide[1] * third; sharp[1] = wide[0] * third;",
        "MOMENT": "const vec moment = (depth * depth + 1.0) * tail + (2.0 * depth + along_end) * edge;",
        "NORM": "(15.749609945722419 * aa * length)",
        "AREA": "h * h",
    },
}


def _kernel(dim: int) -> FusedKernel:
    body = _BODY
    for name, text in _BY_DIM[dim].items():
        body = body.replace(name, text)
    body = body.replace("along_end", "leaving")
    body = body.replace("WIDTH", str(dim * dim + 5 * dim + 4)).replace("DIM", str(dim))
    return FusedKernel(
        f"point_evidence_{dim}d",
        "const double* points, const int64* order, const int64* bucket, int64 n_points, const int64* starts,"
        " const int32* entries, const double* table, double resolution, double cutoff, double* hits_out,"
        " double* misses_out",
        SIMD + body,
    )


_KERNELS = {dim: _kernel(dim) for dim in (2, 3)}


def listed_evidence(
    points: Tensor,
    order: Tensor,
    bucket: Tensor,
    lists: tuple[Tensor, Tensor],
    rows: Tensor,
    resolution: float,
    cutoff: float,
    found: Tensor,
) -> None:
    """Adds hits and misses of the points in `order` to `found` (2, M), float64, by the fused kernel.

    Cones are added one after the other, so that two calls with parts of the lists equal one with both.

    Args:
        points: (M, D) float64.
        order: (R,) int64, rows of points, of which neighbours follow each other.
        bucket: (M,) int64, the list of each point; −1 for points without evidence.
        lists: starts (B + 1,), int64, and entries, int32, of the lists of cones.
        rows: see `PointTable.rows`.
    """
    lanes = CPU_LANES if points.device.type == "cpu" else 1
    _KERNELS[points.shape[1]](
        (order.shape[0] + lanes - 1) // lanes,
        points.contiguous(),
        order,
        bucket,
        order.shape[0],
        *lists,
        rows,
        resolution,
        cutoff,
        *found,
        device=points.device,
    )


def pair_evidence(
    points: Tensor,
    block: Tensor,
    rows: Tensor,
    tilts: Tensor,
    cone: Tensor,
    resolution: float,
    cutoff: float,
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


@functools.cache
def compiled_pair_evidence() -> Callable[..., tuple[Tensor, Tensor]]:
    compiled: Callable[..., tuple[Tensor, Tensor]] = torch.compile(pair_evidence, dynamic=True)
    return compiled


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

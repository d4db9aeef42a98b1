"""Components rounded to the codec's lattice and restored; the twins are in `mapping.codec.lattice`.

A fused kernel computes one component in one item, with the operations of the twin in the same order, each
of them rounded: its results equal the twin's to the bit. Replicas compare bits.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.kernels.compiler import FusedKernel

DIMENSIONS = (2, 3)

_RESTORED = """
    typedef union { double x; int64_t bits; } Both;
    struct Place { int64_t order, steps[DIM], shear[PAIRS]; double slope[PAIRS], mean[DIM]; };
    // 2^e, and the factor 2^(steps / per_octave).
    auto two_to = [](int64_t e) { Both both; both.bits = (e + 1023) << 52; return both.x; };
    auto floor_of = [](int64_t a, int64_t b) { return a / b - (a % b < 0); };
    auto power = [&](int64_t steps) {
        const int64_t whole = floor_of(steps, per_octave);
        return roots[steps - whole * per_octave] * two_to(whole);
    };
    auto exponent = [&](int64_t steps) { return floor_of(steps, per_octave) - precision; };
    // The component at a place, and whether the place is within bounds.
    auto restored = [&](const Place& p, double* m, double* c) {
        const int64_t* axis = orders + p.order * DIM;
        double v[DIM], lower[DIM][DIM];
        bool valid = p.steps[0] <= most_steps && p.steps[0] - p.steps[DIM - 1] <= most_ratio;
        for (int a = 0; a < DIM; ++a) {
            v[a] = power(2 * p.steps[a]);
            m[axis[a]] = p.mean[a] * two_to(exponent(p.steps[a]));
            valid = valid && fabs(m[axis[a]]) <= farthest;
        }
        for (int f = 0; f < PAIRS; ++f) valid = valid && fabs(p.slope[f]) <= steepest;
        lower[0][0] = v[0];
        lower[1][0] = p.slope[0] * v[0];
        lower[1][1] = p.slope[0] * lower[1][0] + v[1];
        if (DIM == 3) {
            const double s = p.slope[PAIRS / 2], t = p.slope[PAIRS - 1];
            lower[DIM - 1][0] = s * v[0];
            lower[DIM - 1][1] = s * lower[1][0] + t * v[1];
            lower[DIM - 1][DIM - 1] = s * lower[DIM - 1][0] + t * t * v[1] + v[DIM - 1];
        }
        for (int a = 0; a < DIM; ++a) {
            for (int b = 0; b <= a; ++b)
                c[axis[a] * DIM + axis[b]] = c[axis[b] * DIM + axis[a]] = lower[a][b];
            valid = valid && lower[a][a] <= most_variance;
        }
        return valid;
    };
"""
_ROUNDED = """
    // The steps of a deviation, from the variance.
    auto to_steps = [&](double variance) {
        Both both;
        both.x = variance;
        const int64_t e = ((both.bits >> 52) & 0x7FF) - 1022;
        both.bits = (both.bits & 0xFFFFFFFFFFFFFll) | (1022ll << 52);
        int64_t steps = (e - 1) * (per_octave / 2);
        for (int64_t i = 0; i < per_octave / 2; ++i) steps += both.x >= bounds[i];
        return steps;
    };
    auto clamped = [](double x, double low, double high) { return GMM_MIN(GMM_MAX(x, low), high); };

    // The nearest place of a component (m, c) with this order of its axes.
    auto rounded = [&](const double* m, const double* c, int64_t order) {
        Place p;
        p.order = order;
        const int64_t* axis = orders + order * DIM;
        auto at = [&](int a, int b) { return c[axis[a] * DIM + axis[b]]; };
        const double least = power(2 * least_steps);
        double v[DIM], l[PAIRS];
        v[0] = GMM_MAX(at(0, 0), least);
        const double floor = GMM_MAX(v[0] * power(-2 * most_ratio), least);
        l[0] = at(1, 0) / v[0];
        v[1] = GMM_MAX(at(1, 1) - l[0] * l[0] * v[0], floor);
        if (DIM == 3) {
            l[PAIRS / 2] = at(DIM - 1, 0) / v[0];
            l[PAIRS - 1] = (at(DIM - 1, 1) - l[PAIRS / 2] * at(1, 0)) / v[1];
            const double rest = at(DIM - 1, DIM - 1) - l[PAIRS / 2] * l[PAIRS / 2] * v[0];
            v[DIM - 1] = GMM_MAX(rest - l[PAIRS - 1] * l[PAIRS - 1] * v[1], floor);
        }
        for (int a = 0; a < DIM; ++a) {
            int64_t steps = to_steps(v[a]);
            if (a > 0) steps = GMM_MIN(GMM_MAX(steps, p.steps[0] - most_ratio), p.steps[a - 1]);
            p.steps[a] = GMM_MAX(steps, least_steps);
        }
        auto to_shear = [&](int pair, int row, int column, double value) {
            const int64_t e = exponent(p.steps[row] - p.steps[column]);
            p.shear[pair] = (int64_t)rint(clamped(value, -steepest, steepest) * two_to(-e));
            p.slope[pair] = (double)p.shear[pair] * two_to(e);
        };
        to_shear(0, 1, 0, l[0]);
        if (DIM == 3) {
            to_shear(PAIRS / 2, DIM - 1, 0, l[PAIRS / 2] + l[PAIRS - 1] * (p.slope[0] - l[0]));
            to_shear(PAIRS - 1, DIM - 1, 1, l[PAIRS - 1]);
        }
        double wanted = m[axis[0]], error[DIM];
        for (int a = 0; a < DIM; ++a) {
            if (a == 1) wanted = m[axis[1]] - p.slope[0] * error[0];
            if (a == 2)
                wanted = m[axis[DIM - 1]] - p.slope[PAIRS / 2] * error[0] - p.slope[PAIRS - 1] * error[1];
            const int64_t e = exponent(p.steps[a]);
            p.mean[a] = rint(wanted * two_to(-e));
            error[a] = wanted - p.mean[a] * two_to(e);
        }
        return p;
    };
    // The place that is exactly a component, of the first `n` axis orders; order n if there is none.
    auto exact = [&](const double* m, const double* c, int64_t n) {
        Place p;
        for (int64_t order = 0; order < n; ++order) {
            const double variance = c[orders[order * DIM] * (DIM + 1)];
            const int64_t steps = to_steps(GMM_MAX(variance, 1e-300));
            if (power(2 * GMM_MIN(GMM_MAX(steps, least_steps), most_steps)) != variance) continue;
            p = rounded(m, c, order);
            double mean[DIM], covariance[DIM * DIM];
            bool same = restored(p, mean, covariance);
            for (int a = 0; a < DIM; ++a) same = same && mean[a] == m[a];
            for (int f = 0; f < DIM * DIM; ++f) same = same && covariance[f] == c[f];
            if (same) return p;
        }
        p.order = n;
        return p;
    };
"""
_BODY = """
    const double *m = means + item * DIM, *c = covariances + item * DIM * DIM;
    bool good = true;  // false for NaN
    for (int a = 0; a < DIM; ++a) good = good && fabs(m[a]) <= farthest;
    for (int f = 0; f < DIM * DIM; ++f) good = good && fabs(c[f]) <= most_variance;
    if (!good) {
        *beyond = true;
        return;
    }
    Place place = exact(m, c, n_orders);
    if (place.order == n_orders) {
        // Complete pivoting: next is the axis with the largest remaining variance.
        int first = 0, second = 0;
        double rest[DIM];
        for (int a = 1; a < DIM; ++a)
            if (c[a * (DIM + 1)] > c[first * (DIM + 1)]) first = a;
        for (int a = 0; a < DIM; ++a) {
            const double column = c[a * DIM + first];
            rest[a] = c[a * (DIM + 1)] - column * column / GMM_MAX(c[first * (DIM + 1)], 1e-300);
        }
        rest[first] = -HUGE_VAL;
        for (int a = 1; a < DIM; ++a)
            if (rest[a] > rest[second]) second = a;
        int64_t order = 0;
        for (int64_t i = n_orders - 1; i >= 0; --i)
            if (orders[i * DIM] == first && orders[i * DIM + 1] == second) order = i;
        place = rounded(m, c, order);
        double mean[DIM], covariance[DIM * DIM];
        if (!restored(place, mean, covariance)) {
            *beyond = true;
            return;
        }
        // If several axis orders restore the same component, the first is used.
        const Place earlier = exact(mean, covariance, order);
        if (earlier.order < order) place = earlier;
    }
    axis_order[item] = place.order;
    for (int a = 0; a < DIM; ++a) {
        deviation[item * DIM + a] = place.steps[a];
        mean_steps[item * DIM + a] = (int64_t)place.mean[a];
    }
    for (int f = 0; f < PAIRS; ++f) shear[item * PAIRS + f] = place.shear[f];
"""


_RESTORING = """
    Place p;
    p.order = axis_order[item];
    for (int a = 0; a < DIM; ++a) {
        p.steps[a] = deviation[item * DIM + a];
        p.mean[a] = (double)mean_steps[item * DIM + a];
    }
    for (int a = 1, f = 0; a < DIM; ++a)
        for (int b = 0; b < a; ++b, ++f)
            p.slope[f] = (double)shear[item * PAIRS + f] * two_to(exponent(p.steps[a] - p.steps[b]));
    restored(p, means + item * DIM, covariances + item * DIM * DIM);
"""


def _kernels(name: str, parameters: str, body: str) -> dict[int, FusedKernel]:
    constants = (
        "int64 n_orders, const int64* orders, const double* roots, const double* bounds, int64 per_octave,"
        " int64 precision, int64 least_steps, int64 most_steps, int64 most_ratio, double steepest,"
        " double farthest, double most_variance, "
    )
    return {
        dim: FusedKernel(
            f"lattice_{name}_{dim}d",
            constants + parameters,
            body.replace("PAIRS", str(dim * (dim - 1) // 2)).replace("DIM", str(dim)),
            rounds_each=True,
        )
        for dim in DIMENSIONS
    }


_PLACES = "int64* axis_order, int64* deviation, int64* shear, int64* mean_steps"
_ROUNDINGS = _kernels(
    "rounding",
    f"const double* means, const double* covariances, {_PLACES}, bool* beyond",
    _RESTORED + _ROUNDED + _BODY,
)
_RESTORINGS = _kernels("restoring", f"{_PLACES}, double* means, double* covariances", _RESTORED + _RESTORING)


class LatticeConstants(NamedTuple):
    """The lattice, by the names of `mapping.codec.lattice`.

    orders (O, D): axis orders. roots: 2^(i / per_octave). bounds: mantissas in [½, 1) at which the steps of a
    deviation change, in rising order.
    """

    orders: Tensor
    roots: Tensor
    bounds: Tensor
    per_octave: int
    precision: int
    least_deviation: int
    largest_deviation: int
    largest_ratio: int
    steepest: float
    farthest: float
    largest_variance: float


def lattice_rounding(
    means: Tensor, covariances: Tensor, constants: LatticeConstants
) -> tuple[Tensor, Tensor, Tensor, Tensor] | None:
    """Axis order (K,), deviation (K, D), shear (K, D(D−1)/2) and mean (K, D) of the nearest lattice points.

    Returns None if a component is, or would be, out of bounds.

    Args:
        means (K, D), covariances (K, D, D): float64.
    """
    n, dim = means.shape
    axis_order = torch.empty(n, dtype=torch.int64, device=means.device)
    deviation, steps = axis_order.new_empty(n, dim), axis_order.new_empty(n, dim)
    shear = axis_order.new_empty(n, dim * (dim - 1) // 2)
    beyond = torch.zeros(1, dtype=torch.bool, device=means.device)
    given = means.contiguous(), covariances.contiguous()
    made = axis_order, deviation, shear, steps
    lattice = len(constants.orders), *constants
    _ROUNDINGS[dim](n, *lattice, *given, *made, beyond, device=means.device)
    return None if bool(beyond) else made


def lattice_restoring(
    axis_order: Tensor, deviation: Tensor, shear: Tensor, mean: Tensor, constants: LatticeConstants
) -> tuple[Tensor, Tensor]:
    """Means (K, D) and covariances (K, D, D), float64,, of lattice points."""
    n, dim = mean.shape
    means = torch.empty(n, dim, dtype=torch.float64, device=mean.device)
    covariances = means.new_empty(n, dim, dim)
    places = [part.contiguous() for part in (axis_order, deviation, shear, mean)]
    lattice = len(constants.orders), *constants
    _RESTORINGS[dim](n, *lattice, *places, means, covariances, device=mean.device)
    return means, covariances

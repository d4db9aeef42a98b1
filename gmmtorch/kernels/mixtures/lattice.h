// Components rounded to the codec's lattice and restored. An item is a component.
#pragma once

#include "../device.h"

namespace gmm {

// As in lattice_rounding.py.
struct Lattice {
    int64_t n_orders;
    const int64_t* orders;
    const double* roots;
    const double* bounds;
    int64_t per_octave;
    int64_t precision;
    int64_t least_steps;
    int64_t most_steps;
    int64_t most_ratio;
    double steepest;
    double farthest;
    double most_variance;
};

template <int DIM>
constexpr int PAIRS = DIM * (DIM - 1) / 2;

template <int DIM>
struct Place {
    int64_t order, steps[DIM], shear[PAIRS<DIM>];
    double slope[PAIRS<DIM>], mean[DIM];
};

union Bits {
    double x;
    int64_t bits;
};

// 2^e.
GMM_INLINE double two_to(int64_t e) {
    Bits both;
    both.bits = (e + 1023) << 52;
    return both.x;
}

GMM_INLINE int64_t floor_of(int64_t a, int64_t b) { return a / b - (a % b < 0); }

// 2^(steps / per_octave).
GMM_INLINE double power(const Lattice& lattice, int64_t steps) {
    const int64_t whole = floor_of(steps, lattice.per_octave);
    return lattice.roots[steps - whole * lattice.per_octave] * two_to(whole);
}

GMM_INLINE int64_t exponent(const Lattice& lattice, int64_t steps) {
    return floor_of(steps, lattice.per_octave) - lattice.precision;
}

// The steps of a deviation, from the variance.
GMM_INLINE int64_t to_steps(const Lattice& lattice, double variance) {
    Bits both;
    both.x = variance;
    const int64_t e = ((both.bits >> 52) & 0x7FF) - 1022;
    both.bits = (both.bits & 0xFFFFFFFFFFFFFll) | (1022ll << 52);
    int64_t steps = (e - 1) * (lattice.per_octave / 2);
    for (int64_t i = 0; i < lattice.per_octave / 2; ++i) steps += both.x >= lattice.bounds[i];
    return steps;
}

// Writes the component at a place; whether the place is within bounds.
template <int DIM>
GMM_INLINE bool restored(const Lattice& lattice, const Place<DIM>& p, double* m, double* c) {
    const int64_t* axis = lattice.orders + p.order * DIM;
    double v[DIM], lower[DIM][DIM];
    bool valid = p.steps[0] <= lattice.most_steps && p.steps[0] - p.steps[DIM - 1] <= lattice.most_ratio;
    for (int a = 0; a < DIM; ++a) {
        v[a] = power(lattice, 2 * p.steps[a]);
        m[axis[a]] = p.mean[a] * two_to(exponent(lattice, p.steps[a]));
        valid = valid && fabs(m[axis[a]]) <= lattice.farthest;
    }
    for (int f = 0; f < PAIRS<DIM>; ++f) valid = valid && fabs(p.slope[f]) <= lattice.steepest;
    lower[0][0] = v[0];
    lower[1][0] = p.slope[0] * v[0];
    lower[1][1] = p.slope[0] * lower[1][0] + v[1];
    if (DIM == 3) {
        const double s = p.slope[PAIRS<DIM> / 2], t = p.slope[PAIRS<DIM> - 1];
        lower[DIM - 1][0] = s * v[0];
        lower[DIM - 1][1] = s * lower[1][0] + t * v[1];
        lower[DIM - 1][DIM - 1] = s * lower[DIM - 1][0] + t * t * v[1] + v[DIM - 1];
    }
    for (int a = 0; a < DIM; ++a) {
        for (int b = 0; b <= a; ++b) c[axis[a] * DIM + axis[b]] = c[axis[b] * DIM + axis[a]] = lower[a][b];
        valid = valid && lower[a][a] <= lattice.most_variance;
    }
    return valid;
}

// The nearest place of a component (m, c) with this order of its axes.
template <int DIM>
GMM_INLINE Place<DIM> rounded(const Lattice& lattice, const double* m, const double* c, int64_t order) {
    Place<DIM> p;
    p.order = order;
    const int64_t* axis = lattice.orders + order * DIM;
    auto at = [&](int a, int b) { return c[axis[a] * DIM + axis[b]]; };
    const double least = power(lattice, 2 * lattice.least_steps);
    double v[DIM], l[PAIRS<DIM>];
    v[0] = maximum(at(0, 0), least);
    const double floor = maximum(v[0] * power(lattice, -2 * lattice.most_ratio), least);
    l[0] = at(1, 0) / v[0];
    v[1] = maximum(at(1, 1) - l[0] * l[0] * v[0], floor);
    if (DIM == 3) {
        l[PAIRS<DIM> / 2] = at(DIM - 1, 0) / v[0];
        l[PAIRS<DIM> - 1] = (at(DIM - 1, 1) - l[PAIRS<DIM> / 2] * at(1, 0)) / v[1];
        const double rest = at(DIM - 1, DIM - 1) - l[PAIRS<DIM> / 2] * l[PAIRS<DIM> / 2] * v[0];
        v[DIM - 1] = maximum(rest - l[PAIRS<DIM> - 1] * l[PAIRS<DIM> - 1] * v[1], floor);
    }
    for (int a = 0; a < DIM; ++a) {
        int64_t steps = to_steps(lattice, v[a]);
        if (a > 0) steps = minimum(maximum(steps, p.steps[0] - lattice.most_ratio), p.steps[a - 1]);
        p.steps[a] = maximum(steps, lattice.least_steps);
    }
    auto to_shear = [&](int pair, int row, int column, double value) {
        const int64_t e = exponent(lattice, p.steps[row] - p.steps[column]);
        p.shear[pair] =
            (int64_t)rint(minimum(maximum(value, -lattice.steepest), lattice.steepest) * two_to(-e));
        p.slope[pair] = (double)p.shear[pair] * two_to(e);
    };
    to_shear(0, 1, 0, l[0]);
    if (DIM == 3) {
        to_shear(PAIRS<DIM> / 2, DIM - 1, 0, l[PAIRS<DIM> / 2] + l[PAIRS<DIM> - 1] * (p.slope[0] - l[0]));
        to_shear(PAIRS<DIM> - 1, DIM - 1, 1, l[PAIRS<DIM> - 1]);
    }
    double wanted = m[axis[0]], error[DIM];
    for (int a = 0; a < DIM; ++a) {
        if (a == 1) wanted = m[axis[1]] - p.slope[0] * error[0];
        if (a == 2)
            wanted =
                m[axis[DIM - 1]] - p.slope[PAIRS<DIM> / 2] * error[0] - p.slope[PAIRS<DIM> - 1] * error[1];
        const int64_t e = exponent(lattice, p.steps[a]);
        p.mean[a] = rint(wanted * two_to(-e));
        error[a] = wanted - p.mean[a] * two_to(e);
    }
    return p;
}

// The place that is exactly a component, of the first `n` axis orders; order n if there is none.
template <int DIM>
GMM_INLINE Place<DIM> exact(const Lattice& lattice, const double* m, const double* c, int64_t n) {
    Place<DIM> p;
    for (int64_t order = 0; order < n; ++order) {
        const double variance = c[lattice.orders[order * DIM] * (DIM + 1)];
        const int64_t steps = to_steps(lattice, maximum(variance, 1e-300));
        if (power(lattice, 2 * minimum(maximum(steps, lattice.least_steps), lattice.most_steps)) != variance)
            continue;
        p = rounded<DIM>(lattice, m, c, order);
        double mean[DIM], covariance[DIM * DIM];
        bool same = restored<DIM>(lattice, p, mean, covariance);
        for (int a = 0; a < DIM; ++a) same = same && mean[a] == m[a];
        for (int f = 0; f < DIM * DIM; ++f) same = same && covariance[f] == c[f];
        if (same) return p;
    }
    p.order = n;
    return p;
}

template <int DIM>
GMM_KERNEL lattice_rounding(int64_t item, Lattice lattice, const double* means, const double* covariances,
                            int64_t* axis_order, int64_t* deviation, int64_t* shear, int64_t* mean_steps,
                            bool* beyond) {
    const double *m = means + item * DIM, *c = covariances + item * DIM * DIM;
    bool good = true;  // false for NaN
    for (int a = 0; a < DIM; ++a) good = good && fabs(m[a]) <= lattice.farthest;
    for (int f = 0; f < DIM * DIM; ++f) good = good && fabs(c[f]) <= lattice.most_variance;
    if (!good) {
        *beyond = true;
        return;
    }
    Place<DIM> place = exact<DIM>(lattice, m, c, lattice.n_orders);
    if (place.order == lattice.n_orders) {
        // Complete pivoting: next is the axis with the largest remaining variance.
        int first = 0, second = 0;
        double rest[DIM];
        for (int a = 1; a < DIM; ++a)
            if (c[a * (DIM + 1)] > c[first * (DIM + 1)]) first = a;
        for (int a = 0; a < DIM; ++a) {
            const double column = c[a * DIM + first];
            rest[a] = c[a * (DIM + 1)] - column * column / maximum(c[first * (DIM + 1)], 1e-300);
        }
        rest[first] = -HUGE_VAL;
        for (int a = 1; a < DIM; ++a)
            if (rest[a] > rest[second]) second = a;
        int64_t order = 0;
        for (int64_t i = lattice.n_orders - 1; i >= 0; --i)
            if (lattice.orders[i * DIM] == first && lattice.orders[i * DIM + 1] == second) order = i;
        place = rounded<DIM>(lattice, m, c, order);
        double mean[DIM], covariance[DIM * DIM];
        if (!restored<DIM>(lattice, place, mean, covariance)) {
            *beyond = true;
            return;
        }
        // If several axis orders restore the same component, the first is used.
        const Place<DIM> earlier = exact<DIM>(lattice, mean, covariance, order);
        if (earlier.order < order) place = earlier;
    }
    axis_order[item] = place.order;
    for (int a = 0; a < DIM; ++a) {
        deviation[item * DIM + a] = place.steps[a];
        mean_steps[item * DIM + a] = (int64_t)place.mean[a];
    }
    for (int f = 0; f < PAIRS<DIM>; ++f) shear[item * PAIRS<DIM> + f] = place.shear[f];
}

template <int DIM>
GMM_KERNEL lattice_restoring(int64_t item, Lattice lattice, const int64_t* axis_order,
                             const int64_t* deviation, const int64_t* shear, const int64_t* mean_steps,
                             double* means, double* covariances) {
    Place<DIM> p;
    p.order = axis_order[item];
    if (p.order < 0 || p.order >= lattice.n_orders) {
        for (int a = 0; a < DIM; ++a) means[item * DIM + a] = HUGE_VAL;
        for (int f = 0; f < DIM * DIM; ++f) covariances[item * DIM * DIM + f] = HUGE_VAL;
        return;
    }
    for (int a = 0; a < DIM; ++a) {
        p.steps[a] = deviation[item * DIM + a];
        p.mean[a] = (double)mean_steps[item * DIM + a];
    }
    for (int a = 1, f = 0; a < DIM; ++a)
        for (int b = 0; b < a; ++b, ++f)
            p.slope[f] =
                (double)shear[item * PAIRS<DIM> + f] * two_to(exponent(lattice, p.steps[a] - p.steps[b]));
    restored<DIM>(lattice, p, means + item * DIM, covariances + item * DIM * DIM);
}

}  // namespace gmm

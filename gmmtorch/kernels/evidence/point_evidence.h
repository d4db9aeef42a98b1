// Point evidence: hits and misses of the cubes around points from the cones near them.
#pragma once

#include "../lanes.h"

namespace gmm {

// Writes the inverses of DIM numbers, with one division; returns their product.
template <int DIM>
GMM_INLINE vec sharpen(const vec* wide, vec* sharp) {
    const vec pair = wide[0] * wide[1];
    if (DIM == 2) {
        const vec product = 1.0 / pair;
        sharp[0] = wide[1] * product;
        sharp[1] = wide[0] * product;
        return product;
    }
    const vec product = 1.0 / (pair * wide[DIM - 1]), third = wide[DIM - 1] * product;
    sharp[0] = wide[1] * third;
    sharp[1] = wide[0] * third;
    sharp[DIM - 1] = pair * product;
    return product;
}

// Adds the evidence of a cone, with a row as in `PointTable`, to the cubes of side h at points x that are
// active. limit: the square of the cutoff.
template <int DIM>
GMM_INLINE void add_evidence(const double* cone, const vec* x, double h, double limit, mask active, vec& hits,
                             vec& misses) {
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
    // The mean is farther than the cutoff for the largest variance from the ray beyond x: a quick test.
    const double widest = seen_squared * (1.0 - 1e-14) - limit * (variance[DIM - 1] + h * h / 12.0);
    const vec over = squared_distance * (1.0 - 1e-14) > turn ? squared_distance - turn : (vec)(0.0);
    mask near = widest * squared_distance - turn * turn + over * over <= limit * rest[0];
    near |= squared_distance <= 0.26 * DIM * h * h;  // the cube may contain the sensor origin
    if (!any(active & near)) return;
    for (int j = 0; j < DIM; ++j) {
        y[j] = (vec)(0.0);
        for (int i = 0; i < DIM; ++i) y[j] += cone[i * DIM + j] * (x[i] - mean[i]);
        z[j] = y[j] + seen[j];
        squared += fixed[j] * y[j] * y[j];
    }
    const vec kappa = rest[0] / squared_distance;
    vec wide[DIM], sharp[DIM];
    for (int j = 0; j < DIM; ++j) wide[j] = variance[j] + kappa;
    const vec determinant = sharpen<DIM>(wide, sharp);
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
    if (!any(active & (at_sensor | passes | strikes))) return;
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
        const vec moment =
            DIM == 2 ? depth * tail + edge : (depth * depth + 1.0) * tail + (2.0 * depth + leaving) * edge;
        const vec norm = DIM == 2 ? 6.283185307179586 * aa : 15.749609945722419 * aa * length;
        const vec peak = expo(-0.5 * across) * root(determinant) / norm;
        miss = peak * moment * breadth * h * (DIM == 2 ? 1.0 : h) * fade;
    }
    miss = at_sensor ? (vec)(1.0) : miss;
    miss = miss < 1.0 - hit ? miss : 1.0 - hit;
    hits += active ? hit * rest[3] : (vec)(0.0);
    misses += active ? miss * rest[2] : (vec)(0.0);
}

// An item is LANES points. The cones of a table have rows as in `PointTable`.
template <int DIM>
GMM_KERNEL point_evidence(int64_t item, const double* points, const int64_t* order, const int64_t* bucket,
                          int64_t n_points, const int64_t* starts, const int32_t* entries,
                          const double* table, double resolution, double cutoff, double* hits_out,
                          double* misses_out) {
    constexpr int WIDTH = DIM * DIM + 5 * DIM + 4;
    const double h = resolution, limit = cutoff * cutoff;
    const int64_t begin = item * LANES, stop = minimum(begin + LANES, n_points);
    vec x[DIM], hits, misses, number = (vec)(-1.0);
    for (int l = 0; l < LANES; ++l) {
        const int64_t point = order[minimum(begin + l, stop - 1)];
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
            fetch(table + entries[minimum(entry + 6, starts[list + 1] - 1)] * WIDTH, WIDTH);
            add_evidence<DIM>(cone, x, h, limit, active, hits, misses);
        }
    }
    for (int l = 0; l < LANES; ++l)
        if (begin + l < stop) {
            const int64_t point = order[begin + l];
            hits_out[point] = get(hits, l);
            misses_out[point] = get(misses, l);
        }
}

}  // namespace gmm

// Evidence of the cubes at a few points, of several sides, from all viewpoints of a map.
#pragma once

#include "../jacobi.h"
#include "point_evidence.h"

namespace gmm {

// An item counts the points to whose cubes a viewpoint may give evidence: inside a box around its cone, and
// near a ball around its component.
template <int DIM>
GMM_KERNEL few_points_near(int64_t item, const double* means, const double* covariances,
                           const double* origins, const int64_t* seen_by, const int64_t* seen_from,
                           const double* points, int64_t n_points, double widest, double cutoff,
                           int64_t* counts) {
    const double *mean = means + seen_by[item] * DIM, *origin = origins + seen_from[item] * DIM;
    const double* covariance = covariances + seen_by[item] * DIM * DIM;
    double low[DIM], high[DIM], radius = 0.0;
    for (int a = 0; a < DIM; ++a) {
        const double extent = cutoff * sqrt(covariance[a * DIM + a]);
        low[a] = minimum(mean[a] - extent, origin[a]) - widest;
        high[a] = maximum(mean[a] + extent, origin[a]) + widest;
        radius += extent * extent;
    }
    radius = sqrt(radius);
    int64_t n = 0;
    for (int64_t i = 0; i < n_points; ++i) {
        const double* x = points + i * DIM;
        bool inside = true;
        double square = 0.0, along = 0.0, distance = 0.0, offset = 0.0;
        for (int a = 0; a < DIM; ++a) {
            inside = inside && x[a] >= low[a] && x[a] <= high[a];
            const double ray = x[a] - origin[a], y = x[a] - mean[a];
            square += ray * ray, along += ray * y, distance += (y - ray) * (y - ray), offset += y * y;
        }
        if (!inside) continue;
        square = maximum(square, 1e-12);
        // The cube seen from a sensor at range r is as wide as widest · distance / r at the component.
        const double ball = radius + widest * sqrt(maximum(distance / square, 1.0));
        const double reach = 1.001 * ball * ball * square;
        const bool ahead = along <= 0.0 || along * along <= reach;
        n += (ahead && offset * square - along * along <= reach) || square <= widest * widest;
    }
    counts[item] = n;
}

// An item is a part of the points, for one of the `chosen` viewpoints. Sets found[item][side][hit or miss].
template <int DIM>
GMM_KERNEL few_points_evidence(int64_t item, const int64_t* chosen, const double* means,
                               const double* covariances, const bool* max_range, const double* origins,
                               const int64_t* seen_by, const int64_t* seen_from, const double* seen_count,
                               const double* points, int64_t n_points, const double* sides, int64_t n_sides,
                               double cutoff, int64_t parts, double* found) {
    constexpr int WIDTH = DIM * DIM + 5 * DIM + 4;
    const int64_t row = item / parts, view = chosen[row], by = seen_by[view];
    double c[DIM][DIM], v[DIM][DIM], cone[WIDTH], own[DIM], square = 0.0;
    double *mean = cone + DIM * DIM, *origin = mean + DIM, *seen = origin + DIM;
    double *variance = seen + DIM, *fixed = variance + DIM, *rest = fixed + DIM;
    for (int a = 0; a < DIM; ++a)
        for (int b = 0; b < DIM; ++b) c[a][b] = covariances[(by * DIM + a) * DIM + b];
    diagonalize<DIM>(c, v);
    for (int a = 0; a < DIM; ++a) {
        mean[a] = means[by * DIM + a], origin[a] = origins[seen_from[view] * DIM + a];
        square += (mean[a] - origin[a]) * (mean[a] - origin[a]);
    }
    for (int a = 0; a < DIM; ++a) {  // axes in the order of their variances
        int rank = 0;
        for (int b = 0; b < DIM; ++b) rank += c[b][b] < c[a][a] || (c[b][b] == c[a][a] && b < a);
        own[rank] = c[a][a], seen[rank] = 0.0;
        for (int i = 0; i < DIM; ++i) {
            cone[i * DIM + rank] = v[i][a];
            seen[rank] += v[i][a] * (mean[i] - origin[i]);
        }
    }
    rest[2] = seen_count[view], rest[3] = max_range[by] ? 0.0 : rest[2];
    for (int64_t side = 0; side < n_sides; ++side) {
        const double h = sides[side], spread = h * h / 12.0;
        rest[0] = spread * square, rest[1] = DIM * log(h);
        for (int a = 0; a < DIM; ++a) {
            variance[a] = maximum(own[a], 1e-12 * h * h);
            fixed[a] = 1.0 / (variance[a] + spread);
            rest[1] -= 0.5 * log(6.283185307179586 * (variance[a] + spread));
        }
        double* values = found + (row * n_sides + side) * 2 * n_points;
        for (int64_t begin = item % parts * LANES; begin < n_points; begin += parts * LANES) {
            vec x[DIM], hits = (vec)(0.0), misses = (vec)(0.0);
            for (int l = 0; l < LANES; ++l)
                for (int a = 0; a < DIM; ++a)
                    set(x[a], l, points[minimum(begin + l, n_points - 1) * DIM + a]);
            const double limit = cutoff * cutoff;
            Pairs<DIM> pairs;
            const mask found = meeting<DIM>(cone, x, h, limit, pairs);
            if (any(found)) {
                evaluate<DIM>(pairs, h, limit, hits, misses);
                hits = found ? hits : (vec)(0.0), misses = found ? misses : (vec)(0.0);
            }
            for (int l = 0; l < LANES && begin + l < n_points; ++l) {
                values[begin + l] = get(hits, l);
                values[n_points + begin + l] = get(misses, l);
            }
        }
    }
}

}  // namespace gmm

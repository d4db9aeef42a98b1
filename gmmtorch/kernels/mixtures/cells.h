// Points summed into cells, and a hash table that numbers cells.
#pragma once

#include "../device.h"

namespace gmm {

constexpr int KEY_BITS = 20;  // of one cell coordinate in a key

// Where the search for a key starts in a table of n_places, a power of two.
GMM_INLINE int64_t first_place(int64_t key, int64_t n_places) {
    const uint64_t hash = (uint64_t)key * 0x9E3779B97F4A7C15ull;
    return (int64_t)((hash ^ (hash >> 32)) & (uint64_t)(n_places - 1));
}

// The place of the number of a key, or a free place, which holds -1.
template <typename Number>
GMM_INLINE int64_t found_place(int64_t key, const Number* places, int64_t n_places, const int64_t* keys) {
    int64_t at = first_place(key, n_places);
    while (places[at] >= 0 && keys[places[at]] != key) at = (at + 1) & (n_places - 1);
    return at;
}

// One item numbers the cells of all points, in the order of their first points, and sums the points. The
// cells have a side of `finest`, divided by the first of the falling `factors` that gives at most max_cells;
// by bisection.
template <int DIM>
GMM_KERNEL cell_moments(int64_t, const double* points, const double* weight, int64_t n_points, double finest,
                        int64_t most_along, const double* factors, int64_t max_cells, int64_t n_places,
                        int64_t* places, int64_t* keys, int64_t* member, double* sums, int64_t* n_cells) {
    constexpr int WIDTH = n_features(DIM);
    double low[DIM], extent = 0.0;
    for (int a = 0; a < DIM; ++a) {
        double high = low[a] = points[a];
        for (int64_t i = 1; i < n_points; ++i) {
            low[a] = minimum(low[a], points[i * DIM + a]);
            high = maximum(high, points[i * DIM + a]);
        }
        extent = maximum(extent, high - low[a]);
    }
    double side = maximum(extent / (double)most_along, finest);
    if (!(side > 0.0)) side = 1.0;  // equal points share one cell
    auto found = [&](double factor) {
        int64_t n_found = 0, last = -1;
        for (int64_t i = 0; i < n_places; ++i) places[i] = -1;
        for (int64_t i = 0; i < n_points; ++i) {
            int64_t key = 0;
            for (int a = 0; a < DIM; ++a)
                key = (key << KEY_BITS) | (int64_t)((points[i * DIM + a] - low[a]) / side * factor);
            if (key == last) {
                member[i] = member[i - 1];
                continue;
            }
            const int64_t at = found_place(key, places, n_places, keys);
            if (places[at] < 0) {
                if (n_found == max_cells) return (int64_t)0;
                places[at] = n_found;
                keys[n_found++] = key;
            }
            last = key;
            member[i] = places[at];
        }
        return n_found;
    };
    int64_t too_fine = 0, enough = 0, tried = 0;
    for (double cells = 1.0; cells < extent / side + 2.0; cells *= 2.0) enough += 3;  // one cell at the end
    *n_cells = found(factors[0]);
    if (*n_cells == 0) {
        while (enough - too_fine > 1) {
            tried = (too_fine + enough) / 2;
            *n_cells = found(factors[tried]);
            (*n_cells ? enough : too_fine) = tried;
        }
        if (tried != enough) *n_cells = found(factors[enough]);
    }
    for (int64_t i = 0; i < n_points; ++i) {
        const double *x = points + i * DIM, p = weight[i];
        double* sum = sums + member[i] * WIDTH;
        sum[0] += p;
        int f = 1 + DIM;
        for (int a = 0; a < DIM; ++a) {
            sum[1 + a] += p * x[a];
            for (int b = a; b < DIM; ++b, ++f) sum[f] += p * (x[a] * x[b]);
        }
    }
}

// One item puts cells into an order: mean features and weights; and members get the new numbers.
GMM_KERNEL sorted_cells(int64_t, const int64_t* order, int64_t n_cells, int64_t width, const double* sums,
                        int64_t n_points, int64_t* number, int64_t* member, double* features,
                        double* weight) {
    for (int64_t c = 0; c < n_cells; ++c) {
        const double* sum = sums + order[c] * width;
        for (int64_t f = 0; f < width; ++f) features[c * width + f] = sum[f] / sum[0];
        weight[c] = sum[0];
        number[order[c]] = c;
    }
    for (int64_t i = 0; i < n_points; ++i) member[i] = number[member[i]];
}

// One item numbers all keys, in the order of their first occurrences.
GMM_KERNEL distinct_keys(int64_t, const int64_t* keys, int64_t n_keys, int64_t* place, int64_t n_places,
                         int64_t* distinct, int64_t* number, int64_t* n_distinct) {
    int64_t found = 0;
    for (int64_t i = 0; i < n_keys; ++i) {
        const int64_t key = keys[i];
        const int64_t at = found_place(key, place, n_places, distinct);
        if (place[at] < 0) {
            place[at] = found;
            distinct[found++] = key;
        }
        number[i] = place[at];
    }
    *n_distinct = found;
}

}  // namespace gmm

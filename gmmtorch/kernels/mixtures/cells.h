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

// The number of a cell, which is its place on CUDA; -1 beyond max_cells. Sets the n sums of a new one to
// zero.
GMM_INLINE int64_t cell_number(int64_t key, int64_t max_cells, int64_t n_places, int32_t* places,
                               int64_t* keys, int64_t* n_cells, double* sums, int64_t n) {
#if defined(__CUDA_ARCH__)
    // Threads claim places of `keys`, which are -1 as long as they are free. Their sums are zero.
    typedef unsigned long long word;
    int64_t at = first_place(key, n_places);
    for (int64_t tried = 0; tried < n_places; ++tried, at = (at + 1) & (n_places - 1)) {
        const int64_t found = (int64_t)atomicCAS((word*)(keys + at), ~0ull, (word)key);
        if (found == key) return at;
        if (found < 0) return (int64_t)atomicAdd((word*)n_cells, 1ull) < max_cells ? at : (int64_t)-1;
    }
    atomicAdd((word*)n_cells, (word)max_cells + 1);
    return -1;
#else
    // Cells are numbered in the order of their first points. A free place holds -1.
    const int64_t at = found_place(key, places, n_places, keys);
    if (places[at] >= 0) return (int64_t)places[at];
    if (*n_cells >= max_cells) {
        *n_cells = max_cells + 1;
        return -1;
    }
    const int64_t made = (*n_cells)++;
    places[at] = (int32_t)made;
    keys[made] = key;
    for (int64_t f = 0; f < n; ++f) sums[made * n + f] = 0.0;
    return made;
#endif
}

// Sums points into their cells. Of the falling `factors` of a coordinate, the first is tried; then bisection
// finds the next that gives at most max_cells. The last of them gives one cell.
template <int DIM>
GMM_KERNEL cell_moments(int64_t item, Team team, const double* points, const double* weight, int64_t n_points,
                        const double* low, const double* high, double finest, double most_along,
                        const double* factors, int64_t max_cells, int64_t n_places, int32_t* places,
                        int64_t* keys, int64_t* member, double* sums, int64_t* n_cells) {
    constexpr int WIDTH = n_features(DIM);
    double extent = 0.0;
    for (int a = 0; a < DIM; ++a) extent = maximum(extent, high[a] - low[a]);
    double side = maximum(extent / most_along, finest);
    side = side > 0.0 ? side : 1.0;  // equal points share one cell
    auto fits = [&](double factor) {
        if (item == 0) *n_cells = 0;
        for (int64_t i = item; i < n_places; i += team.n)
            if (places)
                places[i] = -1;
            else
                keys[i] = -1;
        meet(team);
        int64_t last = -1, number = 0;
        for (int64_t i = item; i < n_points && *(volatile int64_t*)n_cells <= max_cells; i += team.n) {
            int64_t key = 0;
            for (int a = 0; a < DIM; ++a)
                key = (key << KEY_BITS) | (int64_t)((points[i * DIM + a] - low[a]) / side * factor);
            if (key != last) number = cell_number(key, max_cells, n_places, places, keys, n_cells, sums, 0);
            last = key;
            member[i] = number;
        }
        meet(team);
        const bool found = *(volatile int64_t*)n_cells <= max_cells;
        meet(team);
        return found;
    };
    int64_t too_fine = 0, enough = 0, tried = 0;
    for (double cells = 1.0; cells < extent / side + 2.0; cells *= 2.0) enough += 3;
    if (!fits(factors[0])) {
        while (enough - too_fine > 1) {
            tried = (too_fine + enough) / 2;
            (fits(factors[tried]) ? enough : too_fine) = tried;
        }
        if (tried != enough) fits(factors[enough]);
    }
    for (int64_t i = item; i < n_points; i += team.n) {
        const double *x = points + i * DIM, p = weight ? weight[i] : 1.0;
        double* sum = sums + member[i] * WIDTH;
        add(sum, p);
        int f = 1 + DIM;
        for (int a = 0; a < DIM; ++a) {
            add(sum + 1 + a, p * x[a]);
            for (int b = a; b < DIM; ++b, ++f) add(sum + f, p * (x[a] * x[b]));
        }
    }
}

// An item is a cell of `order`: its mean features, its weight, and its rank in this order.
GMM_KERNEL mean_features(int64_t item, const int64_t* order, const double* sums, int64_t width,
                         double* features, double* weight, int64_t* rank) {
    const double* sum = sums + order[item] * width;
    for (int64_t f = 0; f < width; ++f) features[item * width + f] = sum[f] / sum[0];
    weight[item] = sum[0];
    rank[order[item]] = item;
}

// An item is a point. Adds to the sums of its cell one, its values less `middle`, and their products; nothing
// if one of the values is not finite.
template <typename Real>
GMM_KERNEL value_sums(int64_t item, const Real* values, int64_t n_columns, const int64_t* member,
                      const double* middle, double* sums) {
    const Real* own = values + item * n_columns;
    for (int64_t a = 0; a < n_columns; ++a)
        if (!(fabs((double)own[a]) < HUGE_VAL)) return;
    double* sum = sums + member[item] * (1 + n_columns + n_columns * (n_columns + 1) / 2);
    add(sum, 1.0);
    for (int64_t a = 0, f = 1 + n_columns; a < n_columns; ++a) {
        const double value = own[a] - middle[a];
        add(sum + 1 + a, value);
        for (int64_t b = a; b < n_columns; ++b, ++f) add(sum + f, value * (own[b] - middle[b]));
    }
}

// An item is a point: the number of its cell, of 32 along each axis of the box, on a Morton curve.
template <int DIM>
GMM_KERNEL curve_keys(int64_t item, const double* points, const double* low, const double* high,
                      int16_t* keys) {
    double side = 1e-300;
    for (int a = 0; a < DIM; ++a) side = maximum(side, high[a] - low[a]);
    const double scale = 31.99 * (1.0 / side);
    int64_t key = 0;
    for (int a = 0; a < DIM; ++a) {
        const int64_t cell = (int64_t)((points[item * DIM + a] - low[a]) * scale);
        const int64_t within = minimum(maximum(cell, (int64_t)0), (int64_t)31);
        for (int b = 0; b < 5; ++b) key |= (within >> b & 1) << (b * DIM + a);
    }
    keys[item] = (int16_t)key;
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

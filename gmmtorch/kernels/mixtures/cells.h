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

// One item sums all points into their cells, which are numbered in the order of their first points.
template <int DIM>
GMM_KERNEL cell_moments(int64_t, const double* points, const double* weight, int64_t n_points,
                        const double* low, double side, double factor, int64_t max_cells, int64_t n_places,
                        int64_t* places, int64_t* keys, int64_t* member, double* sums, int64_t* n_cells) {
    constexpr int WIDTH = n_features(DIM);
    int64_t n_found = 0, last = -1, number = 0;
    for (int64_t i = 0; i < n_points; ++i) {
        const double* x = points + i * DIM;
        int64_t key = 0;
        for (int a = 0; a < DIM; ++a) key = (key << KEY_BITS) | (int64_t)((x[a] - low[a]) / side * factor);
        if (key != last) {
            const int64_t at = found_place(key, places, n_places, keys);
            if (places[at] < 0) {
                if (n_found == max_cells) {
                    *n_cells = max_cells + 1;
                    return;
                }
                places[at] = n_found;
                keys[n_found++] = key;
            }
            last = key;
            number = places[at];
        }
        member[i] = number;
        const double p = weight ? weight[i] : 1.0;
        double* sum = sums + number * WIDTH;
        sum[0] += p;
        int f = 1 + DIM;
        for (int a = 0; a < DIM; ++a) {
            sum[1 + a] += p * x[a];
            for (int b = a; b < DIM; ++b, ++f) sum[f] += p * (x[a] * x[b]);
        }
    }
    *n_cells = n_found;
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

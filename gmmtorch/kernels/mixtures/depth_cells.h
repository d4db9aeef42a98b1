// Depth images summed into cells.
#pragma once

#include "../lanes.h"
#include "cells.h"

namespace gmm {

// Cells from the reference point in which points can lie, and the side of a patch in pixels.
constexpr double REACH = (double)(1 << (KEY_BITS - 1));
constexpr int PATCH = 4;

// The columns of a row of LANES patches, in which n_left pixels are left. Fetches the same part of
// `next_row`.
template <typename Real>
GMM_INLINE void load_columns(const Real* row, int64_t column_step, int64_t n_left,
                             [[maybe_unused]] const Real* next_row, vec* of_columns) {
    for (int u = 0; u < PATCH; ++u) of_columns[u] = (vec)(0.0);
#if defined(GMM_VECTORS)
    if (n_left >= PATCH * LANES && column_step == 1) {
        // Column u of eight patches, from four vectors of columns.
        typedef Real loose __attribute__((ext_vector_type(8), aligned(alignof(Real))));
        vec x[4];
        const loose* given = (const loose*)row;
        for (int i = 0; i < 4; ++i) {
            x[i] = __builtin_convertvector(given[i], vec);
            if (next_row) __builtin_prefetch(next_row + LANES * i);
        }
        const vec a0 = __builtin_shufflevector(x[0], x[1], 0, 4, 8, 12, 1, 5, 9, 13);
        const vec a1 = __builtin_shufflevector(x[2], x[3], 0, 4, 8, 12, 1, 5, 9, 13);
        const vec a2 = __builtin_shufflevector(x[0], x[1], 2, 6, 10, 14, 3, 7, 11, 15);
        const vec a3 = __builtin_shufflevector(x[2], x[3], 2, 6, 10, 14, 3, 7, 11, 15);
        of_columns[0] = __builtin_shufflevector(a0, a1, 0, 1, 2, 3, 8, 9, 10, 11);
        of_columns[1] = __builtin_shufflevector(a0, a1, 4, 5, 6, 7, 12, 13, 14, 15);
        of_columns[2] = __builtin_shufflevector(a2, a3, 0, 1, 2, 3, 8, 9, 10, 11);
        of_columns[3] = __builtin_shufflevector(a2, a3, 4, 5, 6, 7, 12, 13, 14, 15);
        return;
    }
#endif
    for (int u = 0; u < PATCH; ++u)
        for (int l = 0; l < LANES; ++l) {
            const int64_t place = PATCH * l + u;
            if (place < n_left) set(of_columns[u], l, (double)row[place * column_step]);
        }
}

// An image and how it is seen, in a row of 20 numbers of eight bytes, as in cell_sums.py.
template <typename Real>
struct DepthImage {
    const Real* depth;
    int64_t n_rows;
    int64_t n_columns;
    int64_t row_step;
    int64_t column_step;
    double rays[12];
    double max_range;
    double deepest;
    double farthest_whole;
};

// Adds the blocks of LANES patches item, item + n_items, ... of an image.
template <typename Real>
GMM_INLINE void add_image(const DepthImage<Real>& view, int64_t image, int64_t n_images, int64_t item,
                          int64_t n_items, int64_t max_cells, int64_t n_places, int32_t* places,
                          int64_t* keys, double* sums, double* counts, int64_t* n_cells) {
    constexpr int WIDTH = n_features(3);
    const double *a = view.rays, *b = a + 3, *c = a + 6, *t = a + 9;
    const Real* depth = view.depth;
    const int64_t n_rows = view.n_rows, n_columns = view.n_columns;
    const int64_t row_step = view.row_step, column_step = view.column_step;
    const double max_range = view.max_range, deepest = view.deepest, farthest_whole = view.farthest_whole;
    double now[3] = {0.5, 0.5, 0.5};
    int64_t number = -1;
    bool overflows = *n_cells > max_cells;
    // The number of a cell, or -1 beyond max_cells.
    auto number_of = [&](const double* cell) {
        int64_t key = 0;
        for (int i = 0; i < 3; ++i) key = (key << KEY_BITS) | (int64_t)(cell[i] + REACH);
        const int64_t known = *n_cells;
        const int64_t made = cell_number(key, max_cells, n_places, places, keys, n_cells, sums, WIDTH);
#if !defined(__CUDA_ARCH__)
        if (made >= known)  // a new one
            for (int64_t i = 0; i < n_images; ++i) counts[made * n_images + i] = 0.0;
#endif
        return made;
    };
    // Adds n points in a cell, with these sums of features about its corner.
    auto add_points = [&](const double* cell, double n, const double* features) {
        if (cell[0] != now[0] || cell[1] != now[1] || cell[2] != now[2]) {
            for (int i = 0; i < 3; ++i) now[i] = cell[i];
            number = number_of(cell);
            overflows = overflows || number < 0;
        }
        if (overflows) return;
        add(sums + number * WIDTH, n);
        for (int f = 1; f < WIDTH; ++f) add(sums + number * WIDTH + f, features[f]);
        add(counts + number * n_images + image, n);
    };
    const int64_t n_across = (n_columns + PATCH * LANES - 1) / (PATCH * LANES);
    const int64_t n_blocks = n_across * ((n_rows + PATCH - 1) / PATCH);
    for (int64_t block = item; block < n_blocks && !overflows; block += n_items) {
        const int64_t row = PATCH * (block / n_across), column = PATCH * LANES * (block % n_across);
        const Real* corner = depth + row * row_step + column * column_step;
        const int64_t n_rows_here = minimum((int64_t)PATCH, n_rows - row);
        vec n = (vec)(0.0), near = (vec)(1e300), far = (vec)(0.0);
        vec s[3], m[6];  // sums of z, uz, vz, and of zz, uzz, vzz, uuzz, uvzz, vvzz
        for (int f = 0; f < 3; ++f) s[f] = (vec)(0.0);
        for (int f = 0; f < 6; ++f) m[f] = (vec)(0.0);
        for (int64_t v = 0; v < n_rows_here; ++v) {
            vec z0 = (vec)(0.0), z1 = z0, y0 = z0, y1 = z0, y2 = z0;
            vec of_columns[PATCH];
            const Real* now_row = corner + v * row_step;
            load_columns(now_row, column_step, n_columns - column,
                         row + 2 * PATCH > n_rows ? nullptr : now_row + PATCH * row_step, of_columns);
            for (int u = 0; u < PATCH; ++u) {
                vec z = of_columns[u];
                const mask good = (z > 0.0) & (z < max_range);  // false for NaN
                z = good ? z : (vec)(0.0);
                n += good ? (vec)(1.0) : (vec)(0.0);
                near = (good & (z < near)) ? z : near;
                far = z > far ? z : far;
                const vec zz = z * z;
                z0 += z, z1 += z * (double)u;
                y0 += zz, y1 += zz * (double)u, y2 += zz * (double)(u * u);
            }
            const double w = (double)v;
            s[0] += z0, s[1] += z1, s[2] += z0 * w;
            m[0] += y0, m[1] += y1, m[2] += y0 * w, m[3] += y2, m[4] += y1 * w, m[5] += y0 * (w * w);
        }
        if (!any(n > 0.0)) continue;
        const mask is_whole = (far - near <= deepest) & (far <= farthest_whole) & (n > 0.0);
        const vec whole = is_whole ? (vec)(1.0) : (vec)(0.0);
        vec ray[3], lane, first[3], second[6], shift[3], cell[3], features[WIDTH], beyond = (vec)(0.0);
        for (int l = 0; l < LANES; ++l) set(lane, l, (double)(column + PATCH * l));
        for (int i = 0; i < 3; ++i) {
            ray[i] = a[i] + lane * b[i] + (double)row * c[i];
            first[i] = ray[i] * s[0] + b[i] * s[1] + c[i] * s[2];
            const vec mean = first[i] / n + t[i];
            cell[i] = down(mean);
            shift[i] = t[i] - cell[i];
            const mask within = (mean > -REACH) & (mean < REACH);
            beyond = within ? beyond : (vec)(1.0);
            features[1 + i] = first[i] + n * shift[i];
        }
        overflows = overflows || any((beyond > 0.0) & is_whole);
        if (overflows) break;
        for (int j = 0; j < 3; ++j) {
            const vec z = m[0] * ray[j] + m[1] * b[j] + m[2] * c[j];
            const vec u = m[1] * ray[j] + m[3] * b[j] + m[4] * c[j];
            const vec v = m[2] * ray[j] + m[4] * b[j] + m[5] * c[j];
            for (int i = 0; i <= j; ++i) second[i * (5 - i) / 2 + j] = ray[i] * z + b[i] * u + c[i] * v;
        }
        for (int i = 0, f = 4; i < 3; ++i)
            for (int j = i; j < 3; ++j, ++f)
                features[f] = second[f - 4] + first[i] * shift[j] + shift[i] * features[1 + j];
        for (int l = 0; l < LANES && !overflows; ++l) {
            if (get(n, l) == 0.0) continue;
            double p[WIDTH], corner_of[3];
            if (get(whole, l) > 0.0) {
                for (int i = 0; i < 3; ++i) corner_of[i] = get(cell[i], l);
                for (int f = 1; f < WIDTH; ++f) p[f] = get(features[f], l);
                add_points(corner_of, get(n, l), p);
                continue;
            }
            const int64_t begin = PATCH * l, end = minimum(begin + PATCH, n_columns - column);
            for (int64_t v = 0; v < n_rows_here && !overflows; ++v)
                for (int64_t u = begin; u < end && !overflows; ++u) {
                    const double z = (double)corner[v * row_step + u * column_step];
                    if (!(z > 0.0 && z < max_range)) continue;
                    double x[3];
                    for (int i = 0; i < 3; ++i) {
                        const double q = z * (a[i] + (double)(column + u) * b[i] + (double)(row + v) * c[i]);
                        const double at = q + t[i];
                        if (!(fabs(at) < REACH)) overflows = true;
                        corner_of[i] = floor(at);
                        x[i] = p[1 + i] = q + (t[i] - corner_of[i]);
                    }
                    for (int i = 0, f = 4; i < 3; ++i)
                        for (int j = i; j < 3; ++j, ++f) p[f] = x[i] * x[j];
                    if (!overflows) add_points(corner_of, 1.0, p);
                }
        }
    }
    if (overflows) *n_cells = max_cells + 1;
}

// Adds images, rows of `views`, to cells. On a CPU one item adds all of them; on CUDA n_items add each.
template <typename Real>
GMM_KERNEL depth_cells(int64_t item, const int64_t* views, int64_t n_images, int64_t n_items,
                       int64_t max_cells, int64_t n_places, int32_t* places, int64_t* keys, double* sums,
                       double* counts, int64_t* n_cells) {
#if defined(__CUDA_ARCH__)
    const int64_t begin = item / n_items, end = begin + 1;
#else
    const int64_t begin = 0, end = n_images;
#endif
    const DepthImage<Real>* all = (const DepthImage<Real>*)views;
    for (int64_t image = begin; image < end; ++image)
        add_image<Real>(all[image], image, n_images, item % n_items, n_items, max_cells, n_places, places,
                        keys, sums, counts, n_cells);
}

// An image and its camera, in a row of 10 numbers of eight bytes, as in cell_sums.py.
template <typename Real>
struct RangeImage {
    const Real* depth;
    int64_t n_rows;
    int64_t n_columns;
    int64_t row_step;
    int64_t column_step;
    double fx;
    double fy;
    double cx;
    double cy;
    double max_range;
};

// An item is a row of an image, of n_items at most: the sum of the ranges of its pixels, and their number.
template <typename Real>
GMM_KERNEL range_sums(int64_t item, const int64_t* views, int64_t n_items, double* sums) {
    const RangeImage<Real>& view = ((const RangeImage<Real>*)views)[item / n_items];
    const int64_t row = item % n_items;
    double sum = 0.0, n = 0.0;
    if (row < view.n_rows) {
        const Real* depth = view.depth + row * view.row_step;
        const double y = ((double)row - view.cy) / view.fy;
        for (int64_t begin = 0; begin < view.n_columns; begin += LANES) {
            vec z = (vec)(0.0), x = z;
            for (int l = 0; l < LANES && begin + l < view.n_columns; ++l) {
                set(z, l, (double)depth[(begin + l) * view.column_step]);
                set(x, l, ((double)(begin + l) - view.cx) / view.fx);
            }
            const mask good = (z > 0.0) & (z < view.max_range);  // false for NaN
            const vec length = root(x * x + y * y + 1.0);
            const vec range = good ? z * length : (vec)(0.0);
            const vec one = good ? (vec)(1.0) : (vec)(0.0);
            for (int l = 0; l < LANES; ++l) sum += get(range, l), n += get(one, l);
        }
    }
    sums[2 * item] = sum, sums[2 * item + 1] = n;
}

// An item copies a cell to its place in `order`: its lowest corner, from its key, its sums and its counts.
GMM_KERNEL ordered_cells(int64_t item, const int64_t* order, const int64_t* keys, const double* sums,
                         const double* counts, int64_t n_images, double* corners, double* ordered,
                         double* seen) {
    constexpr int WIDTH = n_features(3);
    const int64_t cell = order[item], key = keys[cell];
    for (int a = 0; a < 3; ++a)
        corners[item * 3 + a] = (double)((key >> ((2 - a) * KEY_BITS)) & ((1 << KEY_BITS) - 1)) - REACH;
    for (int f = 0; f < WIDTH; ++f) ordered[item * WIDTH + f] = sums[cell * WIDTH + f];
    for (int64_t i = 0; i < n_images; ++i) seen[item * n_images + i] = counts[cell * n_images + i];
}

// An item is a cell: its mean features about the center, in metres.
GMM_KERNEL cell_features(int64_t item, const double* corners, const double* sums, const double* center,
                         double side, double* features) {
    constexpr int WIDTH = n_features(3);
    const double* sum = sums + item * WIDTH;
    double *found = features + item * WIDTH, mean[3], d[3];
    found[0] = 1.0;
    for (int a = 0; a < 3; ++a) {
        mean[a] = sum[1 + a] / sum[0], d[a] = corners[item * 3 + a] - center[a];
        found[1 + a] = (mean[a] + d[a]) * side;
    }
    for (int a = 0, f = 4; a < 3; ++a)
        for (int b = a; b < 3; ++b, ++f)
            found[f] = (sum[f] / sum[0] + mean[a] * d[b] + d[a] * mean[b] + d[a] * d[b]) * (side * side);
}

}  // namespace gmm

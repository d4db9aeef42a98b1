// Points compared with range images.
#pragma once

#include "../lanes.h"

namespace gmm {

// An item is a motion. Counts the points in front of the surface of any image, and those that no image shows.
template <int DIM>
GMM_KERNEL range_views(int64_t item, const double* points, int64_t n_points, const double* rotations,
                       const double* translations, const double* turns, const double* shifts,
                       int64_t n_images, const double* nearest, const double* farthest, int64_t across,
                       int64_t high, double cell, double margin, double share, double* counts) {
    const double *turn = rotations + item * DIM * DIM, *shift = translations + item * DIM;
    const double size = (double)(across * high), infinity = 1e300;
    int64_t n_free = 0, n_unknown = 0;
    for (int64_t begin = 0; begin < n_points; begin += LANES) {
        vec place[DIM];
        for (int i = 0; i < DIM; ++i) place[i] = (vec)(shift[i]);
        for (int j = 0; j < DIM; ++j) {
            vec given;
            for (int l = 0; l < LANES; ++l)
                set(given, l, points[j * n_points + minimum(begin + l, n_points - 1)]);
            for (int i = 0; i < DIM; ++i) place[i] = fused((vec)(turn[i * DIM + j]), given, place[i]);
        }
        vec is_free = (vec)(0.0), is_known = (vec)(0.0);  // one or zero
        for (int64_t image = 0; image < n_images && any(is_free == 0.0); ++image) {
            vec at[DIM], square = (vec)(0.0);
            for (int i = 0; i < DIM; ++i) {
                at[i] = (vec)(shifts[image * DIM + i]);
                for (int j = 0; j < DIM; ++j)
                    at[i] = fused((vec)(turns[(image * DIM + i) * DIM + j]), place[j], at[i]);
                square = fused(at[i], at[i], square);
            }
            const vec distance = root(square);
            vec pixel = nearby(arctangent(at[1], at[0]) / cell);
            pixel = pixel < 0.0 ? pixel + (double)across : pixel;
            pixel = pixel >= (double)across ? (vec)(0.0) : pixel;
            if (DIM == 3) {
                vec sine = at[DIM - 1] / (distance < 1e-9 ? (vec)(1e-9) : distance);
                sine = sine < -1.0 ? (vec)(-1.0) : sine > 1.0 ? (vec)(1.0) : sine;
                const vec cosine = root((1.0 - sine) * (1.0 + sine));
                const vec row = down((arctangent(sine, cosine) + 1.5707963267948966) / cell);
                pixel += (double)across * (row >= (double)high ? (vec)(high - 1.0) : row);
            }
            const auto place_of = integer(pixel >= 0.0 && pixel < size ? pixel : (vec)(0.0));  // 0 if NaN
            vec near, far;
            for (int l = 0; l < LANES; ++l) {
                set(near, l, nearest[image * across * high + get(place_of, l)]);
                set(far, l, farthest[image * across * high + get(place_of, l)]);
            }
            const vec tolerance = margin + share * distance;
            is_free = near < infinity && distance < near - tolerance ? (vec)(1.0) : is_free;
            is_known = near < infinity && distance <= far + tolerance ? (vec)(1.0) : is_known;
        }
        for (int l = 0; l < LANES && begin + l < n_points; ++l) {
            n_free += get(is_free, l) > 0.0;
            n_unknown += get(is_known, l) == 0.0;
        }
    }
    counts[2 * item] = (double)n_free;
    counts[2 * item + 1] = (double)n_unknown;
}

}  // namespace gmm

// Lists of the cones whose hulls can give evidence near a place.
#pragma once

#include "../lanes.h"

namespace gmm {

// An item is a part of the lists of LANES balls. Sets for each entry of their lists whether it is near.
template <int DIM>
GMM_KERNEL near_lists(int64_t item, const double* rows, const int64_t* starts, const int32_t* entries,
                      const int64_t* lists, const int64_t* firsts, const double* centers, const double* radii,
                      int64_t n_balls, double cube_reach, double spread, int64_t width, double cutoff,
                      int64_t parts, bool* near, double* counts) {
    constexpr int READ = DIM * DIM + 4 * DIM, AHEAD = 6;
    const int64_t begin = item / parts * LANES, stop = minimum(begin + LANES, n_balls), part = item % parts;
    vec x[DIM], ball, number = (vec)(-1.0);
    double n_near[LANES];
    for (int l = 0; l < LANES; ++l) {
        const int64_t i = minimum(begin + l, stop - 1);
        for (int a = 0; a < DIM; ++a) set(x[a], l, centers[i * DIM + a]);
        set(ball, l, radii[i]);
        if (begin + l < stop) set(number, l, (double)lists[i]);
        n_near[l] = 0.0;
    }
    const vec reach = spread > 0.0 ? ball : ball + cube_reach;
    for (int first = 0; first < LANES; ++first) {  // each list of these balls once
        const double mine = get(number, first);
        if (mine < 0.0 || (first > 0 && get(number, first - 1) == mine)) continue;
        const mask active = number == mine;
        int last = first;
        while (last + 1 < LANES && get(number, last + 1) == mine) ++last;
        const int64_t list = (int64_t)mine, from = starts[list];
        for (int64_t at = from + part; at < starts[list + 1]; at += parts) {
            const double* row = rows + entries[at] * width;
            fetch(rows + entries[minimum(at + AHEAD * parts, starts[list + 1] - 1)] * width, READ);
            const double *mean = row + DIM * DIM, *origin = mean + DIM, *variance = mean + 3 * DIM;
            double squares[DIM], mm = 0.0;
            vec ray[DIM], along = (vec)(0.0), square = (vec)(0.0);
            for (int j = 0; j < DIM; ++j) {
                squares[j] = cutoff * cutoff * maximum(variance[j], 0.0);
                mm += (mean[j] - origin[j]) * (mean[j] - origin[j]);
                ray[j] = x[j] - origin[j];
                square += ray[j] * ray[j];
                along += (mean[j] - origin[j]) * ray[j];
            }
            // A quick test: the ray beyond x passes the mean, or ends before it, within the longest half axis
            // of the ellipsoid.
            const double whole = root(mm), longest = root(squares[DIM - 1]);
            const vec distance = root(square);
            vec clear = distance - reach;
            clear = clear < 1e-12 ? (vec)(1e-12) : clear;
            const vec closeness = 1.0 / clear;
            vec widened = whole * closeness;
            widened = spread * (widened < 1.0 ? (vec)(1.0) : widened);
            const vec far = whole + longest + widened, beta = far * reach * closeness;
            const vec within = longest + widened + beta;
            const vec over = square * (1.0 - 1e-14) > along ? square - along : (vec)(0.0);
            mask close = (mm * (1.0 - 1e-14) - within * within) * square + over * over <= along * along;
            close &= distance <= far + reach;
            widened *= widened;
            vec y[DIM], z[DIM];
            if (any(active & close)) {
                for (int j = 0; j < DIM; ++j) {
                    y[j] = z[j] = (vec)(0.0);
                    for (int i = 0; i < DIM; ++i) {
                        y[j] += row[i * DIM + j] * (x[i] - mean[i]);
                        z[j] += row[i * DIM + j] * ray[i];
                    }
                }
            }
            for (int axis = DIM - 1; axis >= DIM - 2 && any(active & close); --axis) {
                vec ratio = root(squares[axis] + widened);
                ratio = beta / (ratio < 1e-12 ? (vec)(1e-12) : ratio);
                ratio = ratio < 1e-6 ? (vec)(1e-6) : ratio > 1e6 ? (vec)(1e6) : ratio;
                const vec more = 1.0 + ratio, added = more * widened + (1.0 + 1.0 / ratio) * beta * beta;
                vec aa = (vec)(0.0), bb = (vec)(0.0), cc = (vec)(0.0);
                for (int j = 0; j < DIM; ++j) {
                    const vec weight = 1.0 / (more * squares[j] + added);
                    aa += weight * z[j] * z[j];
                    bb += weight * y[j] * z[j];
                    cc += weight * y[j] * y[j];
                }
                bb = bb > 0.0 ? (vec)(0.0) : bb;
                aa = aa < 1e-300 ? (vec)(1e-300) : aa;
                close &= cc - bb * bb / aa < 1.0 + 1e-6;
            }
            close |= distance <= (reach + cube_reach) * (1.0 + 1e-9);
            const vec found = close ? (vec)(1.0) : (vec)(0.0);
            for (int l = first; l <= last; ++l) {
                const double is_near = get(found, l);
                near[firsts[begin + l] + at - from] = is_near > 0.0;
                n_near[l] += is_near;
            }
        }
    }
    for (int l = 0; l < LANES && begin + l < stop; ++l)
        if (n_near[l] > 0.0) add(counts + begin + l, n_near[l]);
}

}  // namespace gmm

// Which points components explain, and the share of each component in them.
#pragma once

#include "../device.h"

namespace gmm {

// An item is a point, tested against all components, a few dozen at a time.
template <int DIM>
GMM_KERNEL explained_points(int64_t item, const double* points, const bool* frees, const double* table,
                            int64_t n, const bool* near, double limit, double least, double* gained,
                            bool* found) {
    constexpr int AT_ONCE = 64, MOST = 64;
    double squares[AT_ONCE], shares[MOST], total = 0.0;
    int64_t of[MOST], n_found = 0;
    double point[DIM];
    for (int a = 0; a < DIM; ++a) point[a] = points[item * DIM + a];
    const bool asks = frees != nullptr && frees[item];
    for (int pass = 0; pass < 2; ++pass) {
        if (pass == 1 && n_found <= MOST) break;
        for (int64_t begin = 0; begin < n; begin += AT_ONCE) {
            const int64_t m = minimum(n - begin, (int64_t)AT_ONCE);
            const double* means = table + begin;
            const double* rows = table + DIM * n + begin;
            for (int64_t i = 0; i < m; ++i) {
                double square = 0.0;
                for (int r = 0; r < DIM; ++r) {
                    double white = 0.0;
                    for (int c = 0; c <= r; ++c)
                        white += rows[(r * DIM + c) * n + i] * (point[c] - means[c * n + i]);
                    square += white * white;
                }
                squares[i] = square;
            }
            for (int64_t i = 0; i < m; ++i) {
                if (!(squares[i] < limit) || (asks && !near[begin + i])) continue;
                const double share = 1.0 / maximum(squares[i], least);
                if (pass == 1)
                    add(gained + begin + i, share / total);
                else {
                    if (n_found < MOST) {
                        of[n_found] = begin + i;
                        shares[n_found] = share;
                    }
                    ++n_found;
                    total += share;
                }
            }
        }
    }
    found[item] = n_found > 0;
    if (n_found <= MOST)
        for (int64_t i = 0; i < n_found; ++i) add(gained + of[i], shares[i] / total);
}

}  // namespace gmm

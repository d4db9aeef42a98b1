// Entropy of cells: what additions of evidence remove, and what one miss more on each ray would remove.
#pragma once

#include "ray_walk.h"

namespace gmm {

// Entropy in bits of a cell with h hits and m misses, its probability within [clamp, 1 - clamp].
template <typename Number>
GMM_INLINE Number entropy(Number h, Number m, Number prior, Number clamp) {
    const Number total = h + m + 2 * prior;
    Number p = total > 0 ? (h + prior) / total : (Number)0.5;
    p = minimum(maximum(p, clamp), 1 - clamp);
    const Number q = 1 - p;
    const Number bits = (p > 0 ? p * log(p) : 0) + (q > 0 ? q * log(q) : 0);
    return bits * (Number)-1.4426950408889634;
}

// An item is a run of cells, whose sums are: all, those of chosen cells, and chosen cells without evidence.
GMM_KERNEL entropy_removed(int64_t item, int64_t n_cells, int64_t run, const float* hits, const float* misses,
                           const float* more_hits, const float* more_misses, const bool* chosen, double prior,
                           double clamp, double* sums) {
    const int64_t stop = minimum(n_cells, (item + 1) * run);
    const float lowest = (float)clamp, highest = 1.0f - lowest, each = (float)prior;
    // Most cells are unknown or certain: their entropies need no logarithm.
    const float of_unknown = entropy(0.0f, 0.0f, each, lowest);
    const float of_free = entropy(0.0f, 1e30f, each, lowest);
    const float of_occupied = entropy(1e30f, 0.0f, each, lowest);
    auto bits_of = [&](float h, float m) {
        if (h + m == 0.0f) return of_unknown;
        const float p = (h + each) / (h + m + 2 * each);
        return p <= lowest ? of_free : p >= highest ? of_occupied : entropy(h, m, each, lowest);
    };
    double all = 0.0, some = 0.0, n_new = 0.0;
    for (int64_t c = item * run; c < stop; ++c) {
        const float h = hits[c], m = misses[c];
        const float gone = bits_of(h, m) - bits_of(h + more_hits[c], m + more_misses[c]);
        all += gone;
        if (chosen[c]) {
            some += gone;
            if (h + m == 0.0f) n_new += 1.0;
        }
    }
    sums[3 * item] = all;
    sums[3 * item + 1] = some;
    sums[3 * item + 2] = n_new;
}

// The table has the bits of each voxel, NaN where they are not computed yet.
GMM_KERNEL reduction_along_rays(int64_t item, Rays rays, const float* hits, const float* misses, double prior,
                                double observed, double mark, double* table, double* sums) {
    double sum = 0.0;
    const double of_unknown = entropy(0.0, 0.0, prior, 0.0) - entropy(0.0, 1.0, prior, 0.0);
    walk(rays, item, [&](int64_t voxel) {
        double bits = table[voxel];
        if (bits != bits) {
            const double h = hits[voxel], m = misses[voxel];
            bits = of_unknown;
            if (h + m > 0.0) bits = entropy(h, m, prior, 0.0) - entropy(h, m + 1.0, prior, 0.0);
            if (h + m < observed) bits += mark;
            table[voxel] = bits;
        }
        sum += bits;
    });
    sums[item] = sum;
}

}  // namespace gmm

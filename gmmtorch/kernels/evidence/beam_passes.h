// Beams of one sensor that pass through components, and that end on them.
#pragma once

#include "../device.h"

namespace gmm {

// As in beam_passes.py, but with the square of `through`.
struct PassLimits {
    double through;
    double reach;
    double margin;
    double grazing;
    double explained;
};

// An item is a component.
template <int DIM>
GMM_KERNEL beam_passes(int64_t item, const double* whitening, const double* offsets, const double* radii,
                       const double* thinnest, const double* directions, const double* lengths,
                       const bool* is_hit, int64_t n_beams, PassLimits limits, double* passed,
                       double* returned) {
    const double *w = whitening + item * DIM * DIM, *v = offsets + item * DIM;
    const double radius = radii[item], widest = limits.grazing * thinnest[item];
    double distance = 0.0, wv[DIM];
    for (int i = 0; i < DIM; ++i) {
        distance += v[i] * v[i];
        wv[i] = 0.0;
        for (int j = 0; j < DIM; ++j) wv[i] += w[i * DIM + j] * v[j];
    }
    const double square = radius * radius;
    double n_passed = 0.0, n_returned = 0.0;
    for (int64_t n = 0; n < n_beams; ++n) {
        const double* d = directions + n * DIM;
        double along = 0.0;
        for (int i = 0; i < DIM; ++i) along += d[i] * v[i];
        if (along < -radius || distance - along * along > square || lengths[n] < along - radius) continue;
        double aa = 0.0, ab = 0.0, bb = 0.0;
        for (int i = 0; i < DIM; ++i) {
            double wd = 0.0;
            for (int j = 0; j < DIM; ++j) wd += w[i * DIM + j] * d[j];
            aa += wd * wd;
            ab += wd * wv[i];
        }
        const double nearest = ab / aa, spread = 1.0 / sqrt(aa);
        for (int i = 0; i < DIM; ++i) {
            double rest = wv[i];
            for (int j = 0; j < DIM; ++j) rest -= nearest * w[i * DIM + j] * d[j];
            bb += rest * rest;
        }
        const double beyond = (lengths[n] - nearest) / spread;
        if (bb >= limits.through) continue;
        if (is_hit[n] && bb + beyond * beyond < limits.explained) n_returned += 1.0;
        if (spread <= widest && nearest > limits.reach * spread
            && nearest + limits.reach * spread + limits.margin < lengths[n])
            n_passed += 1.0;
    }
    passed[item] = n_passed;
    returned[item] = n_returned;
}

}  // namespace gmm

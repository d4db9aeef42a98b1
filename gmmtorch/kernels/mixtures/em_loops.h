// Whole runs of EM, in phases. In each phase a worker takes every n-th piece of the work; the workers meet
// after each, and all of them decide in the same way which phase is next. `wide`: LANES rows at a time, on a
// CPU.
#pragma once

#include "e_step.h"
#include "m_step.h"

namespace gmm {

constexpr int64_t MERGED =
    256;  // numbers that the sums of all workers are merged into, before they are added

// The sum of every step-th number, in four chains, so that additions overlap.
GMM_INLINE double sum_of_every(const double* numbers, int64_t begin, int64_t stop, int64_t step) {
    double a = 0.0, b = 0.0, c = 0.0, d = 0.0;
    int64_t i = begin;
    for (; i + 3 * step < stop; i += 4 * step) {
        a += numbers[i], b += numbers[i + step];
        c += numbers[i + 2 * step], d += numbers[i + 3 * step];
    }
    for (; i < stop; i += step) a += numbers[i];
    return (a + b) + (c + d);
}

// Two sums over all rows, the log-likelihood and the number of points, from those of each worker.
struct RowSums {
    double* own;     // (2, n)
    double* merged;  // (2, MERGED)
};

GMM_INLINE void merge(RowSums sums, int64_t item, int64_t n) {
    for (int64_t i = item; i < 2 * MERGED; i += n)
        sums.merged[i] = sum_of_every(sums.own + i / MERGED * n, i % MERGED, n, MERGED);
}

// A mixture in memory: weights, means and covariances, one after the other.
template <int DIM>
struct Mixture {
    double *weights, *means, *covariances;
    GMM_INLINE Mixture(double* tables, int64_t n, int64_t which)
        : weights(tables + which * n * (1 + DIM + DIM * DIM)), means(weights + n),
          covariances(means + n * DIM) {}
};

enum State : int64_t { RUNNING, ENDED, IMPOSSIBLE };

struct ExactTables {
    double* mixtures;  // the present one and the next, in turns
    double* masses;
    double* natural;
    double* statistics;  // and the two sums over all rows
    double* partial;     // statistics of each part of the rows
    double* norms;       // and peaks, if wide
    double* scratch;
    int64_t* near;
    bool* lost;
};

// Exact EM on rows of features. state IMPOSSIBLE: a covariance is not positive definite, or, if it is
// guarded, the natural parameters or the statistics lose digits; the mixture is the one before this
// iteration.
//
// Progress is read from `before` and written to `after`: phase, iterations, state, which mixture is the
// present one, whether an M-step made it, and its bound.
template <int DIM, bool WIDE>
GMM_KERNEL exact_em(int64_t item, Team team, const double* features, const double* weight, int64_t n_rows,
                    int64_t n_components, int64_t n_padded, int64_t n_parts, double reg_covar, double tol,
                    double last_bound, int64_t n_iter, bool guarded, int64_t n_phases, const double* before,
                    double* after, double* bounds, ExactTables t, RowSums sums) {
    constexpr int WIDTH = n_features(DIM);
    constexpr double EPS = 2.220446049250313e-16, LOST = 1e-6;
    enum Phase : int64_t { NATURAL, ROWS, SUMS, GATHER, MAXIMIZE, FINISH };
    int64_t phase = (int64_t)before[0], n_done = (int64_t)before[1], state = (int64_t)before[2];
    int64_t which = (int64_t)before[3], is_made = (int64_t)before[4];
    double last = n_done ? before[5] : last_bound;
    const int64_t n = team.n, k_all = n_components;
    double* total = t.statistics + k_all * WIDTH;
    for (int64_t left = n_phases; left > 0 && state == RUNNING; --left) {
        Mixture<DIM> now(t.mixtures, k_all, which), next(t.mixtures, k_all, 1 - which);
        if ((phase == NATURAL || phase == FINISH) && item < n_padded) {
            const double mass = !is_made ? 1.0 : sum_of_every(t.masses, 0, k_all, 1);
            for (int64_t k = item; k < n_padded; k += n) {
                double* w = t.natural + k * WIDTH;
                if (k >= k_all) {
                    w[0] = -1e300;
                    continue;
                }
                if (is_made) now.weights[k] = t.masses[k] / mass;
                if (phase == FINISH) continue;
                natural_parameters<DIM>(k, now.weights, now.means, now.covariances, t.natural, t.lost);
                double size = 0.0;
                for (int i = 0; i < DIM; ++i) size += w[1 + i] * now.means[k * DIM + i];
                if (guarded && now.weights[k] > 0.0 && size * EPS > LOST) *t.lost = true;
            }
        }
        if (phase == ROWS) {
            double value = 0.0, points = 0.0;
            if (WIDE) {
                const int64_t n_sums = k_all * WIDTH * LANES, begin = n_rows * item / n_parts;
                const int64_t stop = n_rows * (item + 1) / n_parts;
                double *own = t.partial + item * n_padded * WIDTH * LANES, *peaks = t.norms + n_rows;
                for (int64_t i = 0; i < n_sums; ++i) own[i] = 0.0;
                e_step<DIM>(item, features, n_rows, t.natural, n_padded, n_parts, weight, t.scratch, t.near,
                            t.partial, peaks, t.norms);
                vec both = (vec)(0.0);
                for (int64_t row = begin; row < stop; row += LANES) {
                    vec peak = (vec)(0.0), norm = (vec)(1.0), p = (vec)(0.0);
                    for (int l = 0; l < LANES && row + l < stop; ++l) {
                        set(peak, l, peaks[row + l]), set(norm, l, t.norms[row + l]);
                        set(p, l, weight[row + l]);
                        points += weight[row + l];
                    }
                    both += p * (peak + logarithm(norm));
                }
                for (int l = 0; l < LANES; ++l) value += get(both, l);
            } else {
                for (int64_t row = item; row < n_rows; row += n) {
                    row_norms<DIM>(row, features, n_rows, t.natural, k_all, n_parts, t.norms, nullptr);
                    value += weight[row] * t.norms[row];
                    points += weight[row];
                }
            }
            sums.own[item] = value, sums.own[n + item] = points;
        }
        if (phase == SUMS) {
            merge(sums, item, n);
            for (int64_t i = item; i < n_parts * k_all && !WIDE; i += n)
                component_sums<DIM>(i, features, n_rows, t.natural, k_all, n_parts, weight, t.norms,
                                    t.partial);
        }
        if (phase == GATHER) {
            for (int64_t i = item; i < k_all * WIDTH; i += n) {
                double sum = 0.0;
                if (WIDE)
                    for (int64_t part = 0; part < n_parts; ++part)
                        for (int l = 0; l < LANES; ++l)
                            sum += t.partial[(part * n_padded * WIDTH + i) * LANES + l];
                else
                    sum = sum_of_every(t.partial, i, n_parts * k_all * WIDTH, k_all * WIDTH);
                t.statistics[i] = sum;
            }
            for (int64_t i = item; i < 2; i += n)
                total[i] = sum_of_every(sums.merged + i * MERGED, 0, MERGED, 1);
        }
        if (phase == MAXIMIZE)
            for (int64_t k = item; k < k_all; k += n) {
                const double *s = t.statistics + k * WIDTH, *covariance = next.covariances + k * DIM * DIM;
                m_step<DIM>(k, t.statistics, now.means, now.covariances, false, reg_covar, nullptr, nullptr,
                            0.0, t.masses, next.means, next.covariances, nullptr, nullptr, nullptr, nullptr);
                if (!guarded || !(t.masses[k] > 0.0)) continue;
                double second = 0.0;
                for (int f = 1; f < WIDTH; ++f) second = maximum(second, fabs(s[f]));
                second /= maximum(s[0], 1e-300);
                if (EPS * second > LOST * least_eigenvalue<DIM>(covariance)) *t.lost = true;
            }
        meet(team);
        if ((phase == NATURAL || phase == MAXIMIZE) && *t.lost) {
            state = IMPOSSIBLE;
        } else if (phase == FINISH) {
            state = ENDED;
        } else if (phase == MAXIMIZE) {
            const double bound = total[0] / total[1];
            const bool has_converged = fabs(bound - last) < tol;
            if (item == 0) bounds[n_done] = bound;
            last = bound, n_done += 1, which = 1 - which, is_made = 1;
            phase = has_converged || n_done == n_iter ? FINISH : NATURAL;
        } else {
            phase += 1;
        }
    }
    if (item > 0) return;
    const double progress[6] = {(double)phase, (double)n_done,  (double)state,
                                (double)which, (double)is_made, last};
    for (int i = 0; i < 6; ++i) after[i] = progress[i];
}

}  // namespace gmm

// Whole fits of small tables: an item is a run of k-means or of EM.
#pragma once

#include "e_step.h"

namespace gmm {

GMM_INLINE double sum_of_lanes(vec v) {
    double sum = 0.0;
    for (int l = 0; l < LANES; ++l) sum += get(v, l);
    return sum;
}

// Eight points from a row on, one in each lane; lanes past the last one repeat it.
GMM_INLINE void load_points(const double* points, int64_t row, int64_t stop, int64_t dim, vec* x) {
    for (int l = 0; l < LANES; ++l) {
        const double* given = points + minimum(row + l, stop - 1) * dim;
        for (int64_t f = 0; f < dim; ++f) set(x[f], l, given[f]);
    }
}

// A step of k-means: the nearest center of each point, the squared distance to it, and the weight and the sum
// of the points of each center. n_centers: a multiple of four. bias: -|center|^2 / 2.
GMM_INLINE void nearest_centers(const double* points, const double* weight, int64_t n_rows, int64_t dim,
                                const double* centers, const double* bias, int64_t n_centers, vec* x,
                                int64_t* nearest, double* distance, double* sums) {
    for (int64_t i = 0; i < n_centers * (dim + 1); ++i) sums[i] = 0.0;
    for (int64_t row = 0; row < n_rows; row += LANES) {
        load_points(points, row, n_rows, dim, x);
        vec square = (vec)(0.0), peak = (vec)(-1e300), first = (vec)(0.0);
        for (int64_t f = 0; f < dim; ++f) square = fused(x[f], x[f], square);
        auto compare = [&](int64_t k, vec product) {
            first = product > peak ? (vec)((double)k) : first;
            peak = product > peak ? product : peak;
        };
        for (int64_t k = 0; k < n_centers; k += 4) {
            const double *p = centers + k * dim, *q = p + dim, *r = q + dim, *s = r + dim;
            vec a = (vec)(bias[k]), b = (vec)(bias[k + 1]), c = (vec)(bias[k + 2]), d = (vec)(bias[k + 3]);
            for (int64_t f = 0; f < dim; ++f) {
                a = fused(x[f], (vec)(p[f]), a);
                b = fused(x[f], (vec)(q[f]), b);
                c = fused(x[f], (vec)(r[f]), c);
                d = fused(x[f], (vec)(s[f]), d);
            }
            compare(k, a), compare(k + 1, b), compare(k + 2, c), compare(k + 3, d);
        }
        for (int l = 0; l < LANES && row + l < n_rows; ++l) {
            const int64_t i = row + l, k = (int64_t)get(first, l);
            const double *given = points + i * dim, p = weight[i];
            double* sum = sums + k * (dim + 1);
            nearest[i] = k;
            distance[i] = maximum(0.0, get(square, l) - 2.0 * get(peak, l));
            sum[0] += p;
            for (int64_t f = 0; f < dim; ++f) sum[1 + f] += p * given[f];
        }
    }
}

// Lloyd's iterations; without any, the nearest centers alone. centers: of an item n_padded, a multiple of
// four, whose last ones count for nothing.
GMM_KERNEL lloyd_runs(int64_t item, const double* points, const double* weight, int64_t n_rows, int64_t dim,
                      int64_t n_centers, int64_t n_padded, int64_t max_iter, double least_shift,
                      double* centers, double* scratch, int64_t* nearest, double* distance, bool* done) {
    double *bias = scratch + dim * LANES, *sums = bias + n_padded;
    centers += item * n_padded * dim, nearest += item * n_rows, distance += item * n_rows;
    auto assign = [&]() {
        for (int64_t k = 0; k < n_padded; ++k) {
            double square = k < n_centers ? 0.0 : 2e300;
            for (int64_t f = 0; f < dim; ++f) square += centers[k * dim + f] * centers[k * dim + f];
            bias[k] = -0.5 * square;
        }
        nearest_centers(points, weight, n_rows, dim, centers, bias, n_padded, (vec*)scratch, nearest,
                        distance, sums);
    };
    if (!max_iter) assign();
    for (int64_t step = 0; step < max_iter && !done[item]; ++step) {
        assign();
        double shift = 0.0;
        bool is_full = true;
        for (int64_t k = 0; k < n_centers; ++k) {
            const double* sum = sums + k * (dim + 1);
            is_full = is_full && sum[0] > 0.0;
            for (int64_t f = 0; f < dim && sum[0] > 0.0; ++f) {
                const double mean = sum[1 + f] / sum[0], move = mean - centers[k * dim + f];
                shift += move * move;
                centers[k * dim + f] = mean;
            }
        }
        done[item] = is_full && shift <= least_shift;
        for (int64_t k = 0; k < n_centers && !is_full; ++k) {
            if (sums[k * (dim + 1)] > 0.0) continue;
            int64_t far = 0;
            for (int64_t i = 1; i < n_rows; ++i) far = distance[i] > distance[far] ? i : far;
            for (int64_t f = 0; f < dim; ++f) centers[k * dim + f] = points[far * dim + f];
            distance[far] = -1.0;
        }
    }
}

// Writes the inverse (n, n) of the lower Cholesky factor of a matrix, with rows of zeros up to a multiple of
// four; factor (n, n) is overwritten. Returns half the log-determinant, NaN without a factor.
GMM_INLINE double whitening(const double* matrix, int64_t n, double* factor, double* inverse) {
    double half_log_det = 0.0;
    for (int64_t j = 0; j < n; ++j)
        for (int64_t i = j; i < n; ++i) {
            double s = matrix[i * n + j];
            for (int64_t k = 0; k < j; ++k) s -= factor[i * n + k] * factor[j * n + k];
            if (i == j && !(s > 0.0 && s < HUGE_VAL)) return NAN;
            factor[i * n + j] = i == j ? sqrt(s) : s / factor[j * n + j];
            if (i == j) half_log_det += log(factor[j * n + j]);
        }
    for (int64_t i = 0; i < (n + 3) / 4 * 4 * n; ++i) inverse[i] = 0.0;
    for (int64_t i = 0; i < n; ++i)
        for (int64_t k = 0; k <= i; ++k) {
            const double* lower = inverse + k * n;
            const double own = k < i ? -factor[i * n + k] / factor[i * n + i] : 1.0 / factor[i * n + i];
            if (k == i) inverse[i * n + i] = own;
            for (int64_t j = 0; j <= k && k < i; ++j) inverse[i * n + j] += own * lower[j];
        }
    return half_log_det;
}

// Iterations of EM, until the mean log-likelihood changes by less than tol from the one before.
//
// kind: 0 full, 1 tied, 2 diagonal, 3 spherical covariances, in the shape of their type; the parameters are
// overwritten. With log_weights, these replace the logarithms of the weights. With labels there is no
// iteration, but the moments of each label. state: 0 if iterations are left, 1 converged, 2 if an iteration
// is impossible: a covariance is not positive definite, or the log-likelihood not finite.
GMM_KERNEL em_runs(int64_t item, const double* points, const double* weight, int64_t n_rows, int64_t dim,
                   int64_t n_components, int64_t kind, double reg_covar, double tol, int64_t max_iter,
                   const double* log_weights, const int64_t* labels, double* scratch, double* counts,
                   double* weights, double* means, double* covariances, double* last_bound, double* bounds,
                   double* entropy, int64_t* n_done, int64_t* state) {
    const int64_t n_blocks = (n_rows + LANES - 1) / LANES, n_own = kind == 1 ? 1 : n_components;
    const bool is_matrix = kind < 2;
    const int64_t size = is_matrix ? dim * dim : kind == 2 ? dim : 1;
    const int64_t padded = is_matrix ? (dim + 3) / 4 * 4 * dim : dim;
    vec *x = (vec*)scratch, *p = x + n_blocks * dim, *gamma = p + n_blocks,
        *d = gamma + n_components * n_blocks;
    vec* sums = d + dim;
    double *factor = (double*)(sums + (is_matrix ? dim * dim : dim)), *whiten = factor + dim * dim;
    double* constant = whiten + n_own * padded;
    counts += item * n_components, weights += item * n_components, means += item * n_components * dim;
    covariances += item * n_own * size;
    double n_points = 0.0;
    for (int64_t b = 0; b < n_blocks; ++b) {
        load_points(points, b * LANES, n_rows, dim, x + b * dim);
        p[b] = (vec)(0.0);
        for (int64_t i = b * LANES; i < minimum((b + 1) * LANES, n_rows); ++i)
            set(p[b], (int)(i % LANES), weight[i]);
        n_points += sum_of_lanes(p[b]);
    }

    auto factorize = [&]() {
        for (int64_t k = 0; k < n_components; ++k) {
            double half_log_det = 0.0;
            if (is_matrix) {
                half_log_det = k < n_own ? whitening(covariances + k * size, dim, factor, whiten + k * padded)
                                         : factor[0];
                if (kind == 1) factor[0] = half_log_det;
            }
            for (int64_t f = 0; f < dim && !is_matrix; ++f) {
                const double variance = covariances[k * size + (kind == 2 ? f : 0)];
                half_log_det += variance > 0.0 && variance < HUGE_VAL ? 0.5 * log(variance) : NAN;
                whiten[k * dim + f] = 1.0 / sqrt(variance);
            }
            const double given = log_weights ? log_weights[k] : weights[k] > 0.0 ? log(weights[k]) : -1e30;
            constant[k] = given - half_log_det - 0.5 * dim * 1.8378770664093453;
            if (!(constant[k] < HUGE_VAL)) return false;
        }
        return true;
    };

    // The squared Mahalanobis distance of eight rows x from component k.
    auto squared = [&](const vec* x, int64_t k) {
        const double *mean = means + k * dim, *w = whiten + (kind == 1 ? 0 : k) * padded;
        vec a = (vec)(0.0), b = (vec)(0.0);
        if (!is_matrix) {
            for (int64_t f = 0; f < dim; ++f) {
                const vec z = (x[f] - mean[f]) * w[f];
                a = fused(z, z, a);
            }
            return a;
        }
        for (int64_t f = 0; f < dim; ++f) d[f] = x[f] - mean[f];
        for (int64_t r = 0; r < dim; r += 4, w += 4 * dim) {
            vec s = (vec)(0.0), t = s, u = s, v = s;
            for (int64_t f = 0; f < minimum(r + 4, dim); ++f) {
                s = fused(d[f], (vec)(w[f]), s);
                t = fused(d[f], (vec)(w[dim + f]), t);
                u = fused(d[f], (vec)(w[2 * dim + f]), u);
                v = fused(d[f], (vec)(w[3 * dim + f]), v);
            }
            a = fused(s, s, fused(t, t, a));
            b = fused(u, u, fused(v, v, b));
        }
        return a + b;
    };

    auto expect = [&]() {
        vec value = (vec)(0.0), spread = (vec)(0.0);
        for (int64_t b = 0; b < n_blocks; ++b) {
            vec peak = (vec)(-HUGE_VAL), norm = (vec)(0.0), under = (vec)(0.0);
            for (int64_t k = 0; k < n_components; ++k) {
                const vec logit = constant[k] - 0.5 * squared(x + b * dim, k);
                peak = logit > peak ? logit : peak;
                gamma[k * n_blocks + b] = logit;
            }
            for (int64_t k = 0; k < n_components; ++k) {
                const vec away = gamma[k * n_blocks + b] - peak;
                const vec term = away > -SKIPPED ? expo(away) : (vec)(0.0);
                norm += term;
                under = away > -SKIPPED ? fused(term, away, under) : under;
                gamma[k * n_blocks + b] = term;
            }
            const vec share = p[b] / norm, log_norm = logarithm(norm);
            for (int64_t k = 0; k < n_components; ++k) gamma[k * n_blocks + b] *= share;
            value = fused(p[b], peak + log_norm, value);
            spread += p[b] * log_norm - share * under;
        }
        entropy[item] = sum_of_lanes(spread);
        return sum_of_lanes(value);
    };

    // A variance, 0 if it is only the rounding of the mean.
    auto variance = [&](vec sum, double count, const double* mean) {
        const double value = sum_of_lanes(sum) / count, rounding = mean ? 1e-15 * *mean : 0.0;
        return value > rounding * rounding ? value : 0.0;
    };

    // A covariance from the sums of products about a mean.
    auto write = [&](double* covariance, double count, const double* mean) {
        for (int64_t f = 0; f < dim && is_matrix; ++f)
            for (int64_t g = 0; g <= f; ++g) {
                vec* sum = sums + f * dim + g;
                covariance[f * dim + g] = covariance[g * dim + f] =
                    f == g ? variance(*sum, count, mean ? mean + f : nullptr) + reg_covar
                           : sum_of_lanes(*sum) / count;
            }
        if (kind == 3) covariance[0] = reg_covar;
        for (int64_t f = 0; f < dim && !is_matrix; ++f) {
            const double value = variance(sums[f], count, mean + f);
            if (kind == 2) covariance[f] = value + reg_covar;
            if (kind == 3) covariance[0] += value / dim;
        }
    };

    auto maximize = [&]() {
        const double eps = 2.220446049250313e-15;
        const int64_t n_sums = is_matrix ? dim * dim : dim;
        double total = 0.0;
        for (int64_t i = 0; i < n_sums; ++i) sums[i] = (vec)(0.0);
        for (int64_t k = 0; k < n_components; ++k) {
            const vec* own = gamma + k * n_blocks;
            double* mean = means + k * dim;
            vec mass = (vec)(0.0);
            for (int64_t b = 0; b < n_blocks; ++b) mass += own[b];
            counts[k] = sum_of_lanes(mass);
            total += counts[k] + eps;
            if (!labels && !(counts[k] > eps)) continue;  // its mean and covariance stay
            for (int64_t f = 0; f < dim; ++f) d[f] = (vec)(0.0);
            for (int64_t b = 0; b < n_blocks; ++b) {
                if (!any(own[b] > 0.0)) continue;
                for (int64_t f = 0; f < dim; ++f) d[f] = fused(own[b], x[b * dim + f], d[f]);
            }
            for (int64_t f = 0; f < dim; ++f) mean[f] = sum_of_lanes(d[f]) / maximum(counts[k], eps);
            for (int64_t i = 0; i < n_sums && kind != 1; ++i) sums[i] = (vec)(0.0);
            for (int64_t b = 0; b < n_blocks; ++b) {
                if (!any(own[b] > 0.0)) continue;
                for (int64_t f = 0; f < dim; ++f) {
                    d[f] = x[b * dim + f] - mean[f];
                    const vec scaled = own[b] * d[f];
                    if (!is_matrix) sums[f] = fused(scaled, d[f], sums[f]);
                    vec* row = sums + f * dim;
                    for (int64_t g = 0; g <= f && is_matrix; ++g) row[g] = fused(scaled, d[g], row[g]);
                }
            }
            if (kind != 1) write(covariances + k * size, counts[k] + eps, mean);
        }
        if (kind == 1) write(covariances, total, nullptr);
        for (int64_t k = 0; k < n_components; ++k)
            weights[k] = labels || counts[k] > eps ? (counts[k] + eps) / total : 0.0;
    };

    if (labels) {
        for (int64_t i = 0; i < n_components * n_blocks; ++i) gamma[i] = (vec)(0.0);
        for (int64_t i = 0; i < n_rows; ++i)
            set(gamma[labels[item * n_rows + i] * n_blocks + i / LANES], (int)(i % LANES), weight[i]);
        maximize();
        return;
    }
    for (n_done[item] = 0; n_done[item] < max_iter && !state[item]; ++n_done[item]) {
        state[item] = factorize() ? 0 : 2;
        const double bound = state[item] ? NAN : expect() / n_points;
        if (!(bound > -HUGE_VAL && bound < HUGE_VAL)) {
            state[item] = 2;
            return;
        }
        maximize();
        state[item] = fabs(bound - last_bound[item]) < tol;
        last_bound[item] = bounds[item * max_iter + n_done[item]] = bound;
    }
}

}  // namespace gmm

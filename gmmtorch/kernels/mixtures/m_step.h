// M-step of EM with its extrapolation, and natural parameters. An item is a component.
#pragma once

#include "../jacobi.h"

namespace gmm {

template <int DIM>
GMM_KERNEL natural_parameters(int64_t item, const double* weights, const double* means,
                              const double* covariances, double* natural, bool* failed) {
    constexpr int WIDTH = n_features(DIM);
    const double *c = covariances + item * DIM * DIM, weight = weights[item];
    double l[DIM][DIM], inverse[DIM][DIM], half_log_det = 0.0, across = 0.0;
    bool good = weight >= 0.0;
    for (int j = 0; j < DIM; ++j)
        for (int i = j; i < DIM; ++i) {
            double s = c[i * DIM + j];
            for (int k = 0; k < j; ++k) s -= l[i][k] * l[j][k];
            good = good && (i > j || (s > 0.0 && s < HUGE_VAL));
            l[i][j] = i == j ? sqrt(s) : s / l[j][j];
            if (i == j) half_log_det += log(l[j][j]);
        }
    if (!good) {
        *failed = true;
        natural[item * WIDTH] = -1e300;
        for (int f = 1; f < WIDTH; ++f) natural[item * WIDTH + f] = 0.0;
        return;
    }
    for (int j = 0; j < DIM; ++j)
        for (int i = j; i < DIM; ++i) {
            double s = i == j ? 1.0 : 0.0;
            for (int k = j; k < i; ++k) s -= l[i][k] * inverse[k][j];
            inverse[i][j] = s / l[i][i];
        }
    double* w = natural + item * WIDTH;
    for (int a = 0; a < DIM; ++a) w[1 + a] = 0.0;
    for (int a = 0, f = 1 + DIM; a < DIM; ++a)
        for (int b = a; b < DIM; ++b, ++f) {
            double p = 0.0;
            for (int k = b; k < DIM; ++k) p += inverse[k][a] * inverse[k][b];
            w[f] = a == b ? -0.5 * p : -p;
            if (!means) continue;
            w[1 + a] += p * means[item * DIM + b];
            if (a != b) w[1 + b] += p * means[item * DIM + a];
        }
    if (means)
        for (int a = 0; a < DIM; ++a) across += w[1 + a] * means[item * DIM + a];
    const double log_weight = weight > 0.0 ? log(weight) : -1e30;
    w[0] = log_weight - half_log_det - 0.5 * (DIM * 1.8378770664093453 + across);
}

template <int DIM>
GMM_INLINE double least_eigenvalue(const double* matrix) {
    double x[DIM][DIM], axes[DIM][DIM];
    for (int a = 0; a < DIM; ++a)
        for (int b = 0; b < DIM; ++b) x[a][b] = matrix[a * DIM + b];
    diagonalize<DIM>(x, axes);
    double least = x[0][0];
    for (int a = 1; a < DIM; ++a) least = minimum(least, x[a][a]);
    return least;
}

template <int DIM>
GMM_KERNEL m_step(int64_t item, const double* statistics, const double* means, const double* covariances,
                  bool about_means, double reg_covar, const double* last, const double* last_means,
                  double share, double* em_masses, double* em_means, double* em_covariances,
                  double* new_masses, double* new_means, double* new_covariances, bool* trusted) {
    constexpr int WIDTH = n_features(DIM);
    const double* s = statistics + item * WIDTH;
    // Mass, mean and covariance of sums; what was there and no mass, if there are no points.
    auto maximized = [&](const double* sums, double* mass, double* mean, double* covariance) {
        const double eps = 2.220446049250313e-15, count = sums[0] + eps;
        const bool alive = !means || sums[0] > eps;
        *mass = alive ? count : 0.0;
        for (int a = 0; a < DIM; ++a) {
            mean[a] = alive && !about_means ? 0.0 : means[item * DIM + a];
            if (alive) mean[a] += sums[1 + a] / count;
        }
        const double* c = covariances + item * DIM * DIM;
        for (int a = 0, f = 1 + DIM; a < DIM; ++a)
            for (int b = a; b < DIM; ++b, ++f) {
                double x = sums[f] / count - (sums[1 + a] / count) * (sums[1 + b] / count);
                if (a == b) x = maximum(x, 0.0) + reg_covar;
                covariance[a * DIM + b] = alive ? x : c[a * DIM + b];
                covariance[b * DIM + a] = alive ? x : c[b * DIM + a];
            }
    };
    double* em_covariance = em_covariances + item * DIM * DIM;
    maximized(s, em_masses + item, em_means + item * DIM, em_covariance);
    if (!last) return;
    const double* old = last + item * WIDTH;
    double ahead[WIDTH], shift[DIM], before[WIDTH];
    for (int a = 0; a < DIM; ++a) shift[a] = last_means[item * DIM + a] - means[item * DIM + a];
    before[0] = old[0];
    for (int a = 0, f = 1 + DIM; a < DIM; ++a) {
        before[1 + a] = old[1 + a] + old[0] * shift[a];
        for (int b = a; b < DIM; ++b, ++f)
            before[f] = old[f] + old[1 + a] * shift[b] + shift[a] * (old[1 + b] + old[0] * shift[b]);
    }
    const bool heavy = s[0] + share * (s[0] - before[0]) > 0.2 * s[0];
    for (int f = 0; f < WIDTH; ++f) ahead[f] = heavy ? s[f] + share * (s[f] - before[f]) : s[f];
    double *mean = new_means + item * DIM, *covariance = new_covariances + item * DIM * DIM;
    maximized(ahead, new_masses + item, mean, covariance);
    trusted[item] = heavy && least_eigenvalue<DIM>(covariance) > 0.3 * least_eigenvalue<DIM>(em_covariance);
    if (trusted[item]) return;
    for (int a = 0; a < DIM; ++a) mean[a] = em_means[item * DIM + a];
    for (int f = 0; f < DIM * DIM; ++f) covariance[f] = em_covariance[f];
}

// Features about a center, of a point, or from the features of a cell.
template <int DIM, typename Number>
GMM_INLINE void local_features(bool are_points, const Number* given, const double* center, Number* x) {
    Number offset[DIM];
    for (int i = 0; i < DIM; ++i) offset[i] = are_points ? given[i] - center[i] : (Number)(-center[i]);
    x[0] = are_points ? (Number)(1.0) : given[0];
    for (int i = 0, f = 1 + DIM; i < DIM; ++i) {
        x[1 + i] = are_points ? offset[i] : given[1 + i] + given[0] * offset[i];
        for (int n = i; n < DIM; ++n, ++f)
            x[f] = are_points ? offset[i] * offset[n]
                              : given[f] + given[1 + i] * offset[n]
                                    + offset[i] * (given[1 + n] + given[0] * offset[n]);
    }
}

// One item: weight, mean and covariance of the rows of each label. Second moments are about the label's mean,
// because pieces may be thin and far apart.
template <int DIM>
GMM_KERNEL label_moments(int64_t, const double* rows, bool are_points, const double* weight,
                         const int64_t* labels, int64_t n_rows, int64_t n_labels, double reg_covar,
                         double* sums, double* weights, double* means, double* covariances) {
    constexpr int WIDTH = n_features(DIM);
    const int64_t width = are_points ? DIM : WIDTH;
    double x[WIDTH], total = 0.0;
    const double origin[DIM] = {};
    for (int64_t i = 0; i < n_rows; ++i) {
        const int64_t k = labels[i];
        local_features<DIM>(are_points, rows + i * width, origin, x);
        weights[k] += weight[i] * x[0];
        for (int a = 0; a < DIM; ++a) means[k * DIM + a] += weight[i] * x[1 + a];
    }
    for (int64_t i = 0; i < n_labels * DIM; ++i) means[i] /= maximum(weights[i / DIM], 1e-300);
    for (int64_t i = 0; i < n_rows; ++i) {
        const int64_t k = labels[i];
        local_features<DIM>(are_points, rows + i * width, means + k * DIM, x);
        for (int f = 0; f < WIDTH; ++f) sums[k * WIDTH + f] += weight[i] * x[f];
    }
    for (int64_t k = 0; k < n_labels; ++k) {
        double* mean = means + k * DIM;
        double offset[DIM];
        for (int a = 0; a < DIM; ++a) offset[a] = mean[a];
        m_step<DIM>(k, sums, nullptr, nullptr, false, reg_covar, nullptr, nullptr, 0.0, weights, means,
                    covariances, nullptr, nullptr, nullptr, nullptr);
        for (int a = 0; a < DIM; ++a) mean[a] += offset[a];
        total += weights[k];
    }
    for (int64_t k = 0; k < n_labels; ++k) weights[k] /= total;
}

}  // namespace gmm

// Pairs of components within reach of each other, and their overlap under rigid motions.
#pragma once

#include "../lanes.h"

namespace gmm {

// An item is a component of the source under one motion, tested against all of the target.
template <int DIM>
GMM_KERNEL near_pairs(int64_t item, const double* moved, const double* shapes, const double* reaches,
                      int64_t n_source, const double* targets, const double* covariances, int64_t n_target,
                      double scale, double wide, bool* near) {
    const double *x = moved + item * DIM, *shape = shapes + item * DIM * DIM;
    const double reach = reaches[item % n_source];
    bool* row = near + item * n_target;
    for (int64_t j = 0; j < n_target; ++j) {
        const double* other = targets + j * (DIM + 1);  // mean, reach
        double d[DIM], square = 0.0;
        for (int i = 0; i < DIM; ++i) {
            d[i] = x[i] - other[i];
            square += d[i] * d[i];
        }
        const double sum = reach + other[DIM];
        row[j] = false;
        if (square > sum * sum) continue;
        double along = wide * square;  // d'Md: d'M⁻¹d is at least (d'd)² / d'Md
        for (int r = 0; r < DIM; ++r)
            for (int c = 0; c < DIM; ++c)
                along += scale * d[r] * d[c] * (shape[r * DIM + c] + covariances[(j * DIM + r) * DIM + c]);
        if (square * square > along) continue;
        double root_of[DIM][DIM], y[DIM], quadratic = 0.0;  // of scale (A + S) + wide I
        for (int c = 0; c < DIM; ++c) {
            for (int r = c; r < DIM; ++r) {
                double rest = scale * (shape[r * DIM + c] + covariances[(j * DIM + r) * DIM + c]);
                if (r == c) rest += wide;
                for (int k = 0; k < c; ++k) rest -= root_of[r][k] * root_of[c][k];
                root_of[r][c] = r == c ? sqrt(rest) : rest / root_of[c][c];
            }
            y[c] = d[c];
            for (int k = 0; k < c; ++k) y[c] -= root_of[c][k] * y[k];
            y[c] /= root_of[c][c];
            quadratic += y[c] * y[c];
        }
        row[j] = quadratic <= 1.0;
    }
}

// An item is a part of the pairs, LANES of one motion at a time.
template <int DIM>
GMM_KERNEL pair_overlap(int64_t item, const int64_t* motion, const int64_t* source, const int64_t* target,
                        int64_t n_pairs, int64_t n_parts, int64_t n_motions, int64_t n_source,
                        const double* levers, const double* moved, const double* translations,
                        const double* means, const double* covariances, const double* source_weights,
                        const double* target_weights, double* sums) {
    constexpr int TURNS = DIM * (DIM - 1) / 2, FREE = DIM + TURNS, N_SUMS = 1 + FREE + FREE * (FREE + 1);
    constexpr double NORM = DIM == 2 ? 0.15915494309189535 : 0.06349363593424097;  // (2 pi)^(-DIM/2)
    const int64_t begin = n_pairs * item / n_parts, stop = n_pairs * (item + 1) / n_parts;
    vec sum[N_SUMS];
    for (int s = 0; s < N_SUMS; ++s) sum[s] = (vec)(0.0);
    for (int64_t pair = begin; pair < stop;) {
        const int64_t b = motion[pair];
        int64_t lanes = 0;
        vec l[DIM], d[DIM], a[DIM][DIM], c[DIM][DIM], weight = (vec)(0.0);
        for (int lane = 0; lane < LANES; ++lane) {  // as many pairs of one motion; the last one repeats
            const bool follows = pair + lane < stop && motion[pair + lane] == b;
            if (lane == lanes && follows) ++lanes;
            const int64_t at = pair + minimum((int64_t)lane, lanes - 1), i = source[at], j = target[at];
            const int64_t row = b * n_source + i;
            const double *lever = levers + row * DIM, *shape = moved + row * DIM * DIM;
            for (int r = 0; r < DIM; ++r) {
                set(l[r], lane, lever[r]);
                set(d[r], lane, lever[r] + translations[b * DIM + r] - means[j * DIM + r]);
                for (int q = r; q < DIM; ++q) {
                    set(a[r][q], lane, shape[r * DIM + q]);
                    set(c[r][q], lane, shape[r * DIM + q] + covariances[(j * DIM + r) * DIM + q]);
                }
            }
            if (lane < lanes) set(weight, lane, source_weights[i] * target_weights[j]);
        }
        vec root_of[DIM][DIM], inverse[DIM][DIM], w[DIM][DIM], scale = (vec)(1.0);
        for (int j = 0; j < DIM; ++j) {  // Cholesky's factor, and its inverse
            for (int i = j; i < DIM; ++i) {
                vec rest = c[j][i];
                for (int k = 0; k < j; ++k) rest -= root_of[i][k] * root_of[j][k];
                root_of[i][j] = i == j ? root(rest) : rest / root_of[j][j];
            }
            scale *= root_of[j][j];
        }
        for (int j = 0; j < DIM; ++j) {
            inverse[j][j] = 1.0 / root_of[j][j];
            for (int i = j + 1; i < DIM; ++i) {
                vec rest = (vec)(0.0);
                for (int k = j; k < i; ++k) rest += root_of[i][k] * inverse[k][j];
                inverse[i][j] = -rest / root_of[i][i];
            }
        }
        for (int i = 0; i < DIM; ++i)
            for (int j = i; j < DIM; ++j) {
                w[i][j] = (vec)(0.0);
                for (int k = j; k < DIM; ++k) w[i][j] += inverse[k][i] * inverse[k][j];
                w[j][i] = w[i][j];
                a[j][i] = a[i][j];
            }
        vec pull[DIM], arm[DIM], matched[DIM][DIM], square = (vec)(0.0);
        for (int i = 0; i < DIM; ++i) {
            pull[i] = (vec)(0.0);
            for (int j = 0; j < DIM; ++j) pull[i] += w[i][j] * d[j];
            square += d[i] * pull[i];
        }
        for (int i = 0; i < DIM; ++i) {
            arm[i] = l[i];
            for (int j = 0; j < DIM; ++j) {
                arm[i] -= a[i][j] * pull[j];
                matched[i][j] = (vec)(0.0);
                for (int k = 0; k < DIM; ++k) matched[i][j] += a[i][k] * w[k][j];
            }
        }
        vec slope[FREE], jacobian[DIM][TURNS], change[TURNS][DIM][DIM], information[FREE][FREE];
        for (int i = 0; i < DIM; ++i) slope[i] = -pull[i];
        for (int k = 0; k < TURNS; ++k) {  // G_k x = (-x_j, x_i) in the rows (i, j)
            const int i = DIM == 2 ? 0 : (k + 1) % DIM, j = DIM == 2 ? 1 : (k + 2) % DIM;
            slope[DIM + k] = pull[i] * arm[j] - pull[j] * arm[i] + matched[j][i] - matched[i][j];
            vec swept[DIM][DIM];
            for (int r = 0; r < DIM; ++r) {
                jacobian[r][k] = r == i ? -l[j] : r == j ? l[i] : (vec)(0.0);
                for (int q = 0; q < DIM; ++q) swept[r][q] = r == i ? -a[j][q] : r == j ? a[i][q] : (vec)(0.0);
            }
            for (int r = 0; r < DIM; ++r)
                for (int q = 0; q < DIM; ++q) {
                    change[k][r][q] = (vec)(0.0);
                    for (int m = 0; m < DIM; ++m) change[k][r][q] += w[r][m] * (swept[m][q] + swept[q][m]);
                }
        }
        for (int i = 0; i < DIM; ++i) {
            for (int j = 0; j < DIM; ++j) information[i][j] = w[i][j];
            for (int k = 0; k < TURNS; ++k) {
                vec product = (vec)(0.0);
                for (int j = 0; j < DIM; ++j) product += w[i][j] * jacobian[j][k];
                information[i][DIM + k] = product;
            }
        }
        for (int k = 0; k < TURNS; ++k)
            for (int m = k; m < TURNS; ++m) {
                vec product = (vec)(0.0), trace = (vec)(0.0);
                for (int i = 0; i < DIM; ++i) {
                    product += jacobian[i][k] * information[i][DIM + m];
                    for (int j = 0; j < DIM; ++j) trace += change[k][i][j] * change[m][j][i];
                }
                information[DIM + k][DIM + m] = product + 0.5 * trace;
            }
        const vec share = weight * expo(-0.5 * square) * NORM / scale;
        sum[0] += share;
        int place = 1;
        for (int i = 0; i < FREE; ++i) sum[place++] += share * slope[i];
        for (int i = 0; i < FREE; ++i)
            for (int j = i; j < FREE; ++j) sum[place++] += share * information[i][j];
        for (int i = 0; i < FREE; ++i)
            for (int j = i; j < FREE; ++j) sum[place++] += share * slope[i] * slope[j];
        pair += lanes;
        if (pair < stop && motion[pair] == b) continue;
        double* out = sums + (item * n_motions + b) * N_SUMS;
        for (int s = 0; s < N_SUMS; ++s) {
            for (int lane = 0; lane < LANES; ++lane) out[s] += get(sum[s], lane);
            sum[s] = (vec)(0.0);
        }
    }
}

}  // namespace gmm

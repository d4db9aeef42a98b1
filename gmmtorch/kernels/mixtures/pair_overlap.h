// Pairs of components within reach of each other, and their overlap under rigid motions.
#pragma once

#include "../lanes.h"
#include "rigid_steps.h"

namespace gmm {

// The components of one mixture at one level of blur. Their means are in rising order of `low`, by at most
// `spread` (m) below the first coordinate.
struct Level {
    int64_t n;
    double spread;
    double *weights, *means, *covariances, *reaches, *thinnest, *low;
};

// R x, or R S Rᵀ.
template <int DIM>
GMM_INLINE void turned(const double* rotation, const double* x, double* y) {
    for (int i = 0; i < DIM; ++i) {
        y[i] = 0.0;
        for (int j = 0; j < DIM; ++j) y[i] += rotation[i * DIM + j] * x[j];
    }
}

template <int DIM>
GMM_INLINE void turned_shape(const double* rotation, const double* shape, double* found) {
    double half[DIM][DIM];  // R S
    for (int i = 0; i < DIM; ++i)
        for (int j = 0; j < DIM; ++j) {
            half[i][j] = 0.0;
            for (int k = 0; k < DIM; ++k) half[i][j] += rotation[i * DIM + k] * shape[k * DIM + j];
        }
    for (int i = 0; i < DIM; ++i)
        for (int j = 0; j < DIM; ++j) {
            double sum = 0.0;
            for (int k = 0; k < DIM; ++k) sum += half[i][k] * rotation[j * DIM + k];
            found[i * DIM + j] = sum;
        }
}

// Lists the components of the target near a component i of the source under a motion, the first `width` of
// them, and returns their number: with the difference d of their means, |d| is at most the sum of their
// reaches and the slack, and d'M⁻¹d at most 1 for M = scale (A + S) + wide I. widest: of the target's
// reaches.
template <int DIM>
GMM_INLINE int64_t list_near(const double* pose, const Level& source, int64_t i, const Level& target,
                             double slack, double widest, double scale, double wide, int64_t width,
                             int32_t* list) {
    double x[DIM], shape[DIM * DIM];
    turned<DIM>(pose, source.means + i * DIM, x);
    for (int k = 0; k < DIM; ++k) x[k] += pose[DIM * DIM + k];
    turned_shape<DIM>(pose, source.covariances + i * DIM * DIM, shape);
    const double reach = source.reaches[i] + slack;
    const double from = x[0] - reach - widest - target.spread, to = x[0] + reach + widest + target.spread;
    int64_t first = 0, last = target.n, count = 0;
    while (first < last) {  // the first one at `from` or beyond
        const int64_t middle = (first + last) / 2;
        if (target.low[middle] < from)
            first = middle + 1;
        else
            last = middle;
    }
    for (int64_t j = first; j < target.n && target.low[j] <= to; ++j) {
        const double *mean = target.means + j * DIM, *other = target.covariances + j * DIM * DIM;
        double d[DIM], square = 0.0;
        for (int k = 0; k < DIM; ++k) {
            d[k] = x[k] - mean[k];
            square += d[k] * d[k];
        }
        const double sum = reach + target.reaches[j];
        if (square > sum * sum) continue;
        double along = wide * square;  // d'Md: d'M⁻¹d is at least (d'd)² / d'Md
        for (int r = 0; r < DIM; ++r)
            for (int c = 0; c < DIM; ++c)
                along += scale * d[r] * d[c] * (shape[r * DIM + c] + other[r * DIM + c]);
        if (square * square > along) continue;
        double root_of[DIM][DIM], quadratic = 0.0;
        for (int r = 0; r < DIM; ++r)
            for (int c = 0; c <= r; ++c)
                root_of[r][c] = scale * (shape[r * DIM + c] + other[r * DIM + c]) + (r == c ? wide : 0.0);
        factorise<DIM>(root_of, 0.0);
        solve_lower<DIM>(root_of, d);
        for (int k = 0; k < DIM; ++k) quadratic += d[k] * d[k];
        if (!(quadratic <= 1.0)) continue;
        if (count < width) list[count] = (int32_t)j;
        ++count;
    }
    return count;
}

CUDA_CALLABLE constexpr int n_overlap_sums(int dim) { return 1 + n_free(dim) * (n_free(dim) + 2); }

// Sums over the pairs of the components begin … stop − 1 of the source under one motion: s = π_i π_j N,
// s ∂log N, the upper triangles of s times the information, and of s ∂log N ∂log N'. lists: `width` places
// for each component, of which `counts` are used. moved: room for R μ and R S R' of each.
template <int DIM>
GMM_INLINE void pair_sums(const double* pose, const Level& source, const Level& target, int64_t begin,
                          int64_t stop, const int32_t* lists, int64_t width, const int64_t* counts,
                          double* moved, double* sums) {
    constexpr int TURNS = DIM * (DIM - 1) / 2, FREE = DIM + TURNS, N_SUMS = n_overlap_sums(DIM);
    constexpr double NORM = DIM == 2 ? 0.15915494309189535 : 0.06349363593424097;  // (2 pi)^(-DIM/2)
    for (int64_t i = begin; i < stop; ++i) {
        turned<DIM>(pose, source.means + i * DIM, moved + i * n_of_pose(DIM));
        turned_shape<DIM>(pose, source.covariances + i * DIM * DIM, moved + i * n_of_pose(DIM) + DIM);
    }
    vec sum[N_SUMS];
    for (int s = 0; s < N_SUMS; ++s) sum[s] = (vec)(0.0);
    int64_t row = begin, next = 0, i = -1, j = -1;
    while (true) {
        bool is_any = false;
        vec l[DIM], d[DIM], a[DIM][DIM], c[DIM][DIM], weight = (vec)(0.0);
        for (int lane = 0; lane < LANES; ++lane) {  // as many pairs; the last one repeats
            while (row < stop && next >= counts[row]) {
                ++row;
                next = 0;
            }
            if (row < stop) {
                i = row;
                j = lists[row * width + next++];
                set(weight, lane, source.weights[i] * target.weights[j]);
                is_any = true;
            }
            if (!is_any) break;
            const double *lever = moved + i * n_of_pose(DIM), *shape = lever + DIM;
            for (int r = 0; r < DIM; ++r) {
                set(l[r], lane, lever[r]);
                set(d[r], lane, lever[r] + pose[DIM * DIM + r] - target.means[j * DIM + r]);
                for (int q = r; q < DIM; ++q) {
                    set(a[r][q], lane, shape[r * DIM + q]);
                    set(c[r][q], lane, shape[r * DIM + q] + target.covariances[(j * DIM + r) * DIM + q]);
                }
            }
        }
        if (!is_any) break;
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
    }
    for (int s = 0; s < N_SUMS; ++s) {
        sums[s] = 0.0;
        for (int lane = 0; lane < LANES; ++lane) sums[s] += get(sum[s], lane);
    }
}

}  // namespace gmm

// Factors of small matrices, and steps on rigid motions, for searches of the best motion.
#pragma once

#include "../device.h"

namespace gmm {

// A rigid motion x -> R x + t in memory: R row by row, then t.
CUDA_CALLABLE constexpr int n_of_pose(int dim) { return dim * dim + dim; }

// Degrees of freedom: a shift and a turn.
CUDA_CALLABLE constexpr int n_free(int dim) { return dim + dim * (dim - 1) / 2; }

// The lower Cholesky factor of a matrix, in its place; false if a pivot is not above `least`, which then
// stands for it.
template <int N>
GMM_INLINE bool factorise(double (&a)[N][N], double least) {
    bool is_good = true;
    for (int c = 0; c < N; ++c)
        for (int r = c; r < N; ++r) {
            double rest = a[r][c];
            for (int k = 0; k < c; ++k) rest -= a[r][k] * a[c][k];
            if (r == c) is_good = is_good && rest > least;
            a[r][c] = r == c ? sqrt(rest > least ? rest : least) : rest / a[c][c];
        }
    return is_good;
}

// Solves L x = b, or Lᵀ x = b, in the place of b.
template <int N>
GMM_INLINE void solve_lower(const double (&root)[N][N], double (&b)[N]) {
    for (int i = 0; i < N; ++i) {
        for (int k = 0; k < i; ++k) b[i] -= root[i][k] * b[k];
        b[i] /= root[i][i];
    }
}

template <int N>
GMM_INLINE void solve_upper(const double (&root)[N][N], double (&b)[N]) {
    for (int i = N - 1; i >= 0; --i) {
        for (int k = i + 1; k < N; ++k) b[i] -= root[k][i] * b[k];
        b[i] /= root[i][i];
    }
}

// Adds up the sums of the parts of each of n motions.
template <typename Climb>
GMM_INLINE void add_parts(int64_t item, const Team& team, int64_t n, int64_t n_parts, const double* partial,
                          Climb* climbs) {
    constexpr int N_SUMS = Climb::N_SUMS;
    for (int64_t piece = item; piece < n * N_SUMS; piece += team.n) {
        double sum = 0.0;
        for (int64_t part = 0; part < n_parts; ++part)
            sum += partial[(piece / N_SUMS * n_parts + part) * N_SUMS + piece % N_SUMS];
        climbs[piece / N_SUMS].sums[piece % N_SUMS] = sum;
    }
}

// The motion after a step in the frame of the world, as `Pose.moved` defines it.
template <int DIM>
GMM_INLINE void move(const double* pose, const double* step, double* moved) {
    constexpr int TURNS = n_free(DIM) - DIM;
    double cross[DIM][DIM] = {{0.0}}, square = 0.0;
    for (int k = 0; k < TURNS; ++k) {  // G_k x = (-x_j, x_i) in the rows (i, j)
        const int i = DIM == 2 ? 0 : (k + 1) % DIM, j = DIM == 2 ? 1 : (k + 2) % DIM;
        cross[i][j] = -step[DIM + k];
        cross[j][i] = step[DIM + k];
        square += step[DIM + k] * step[DIM + k];
    }
    const bool is_small = square < 1e-8;
    const double angle = sqrt(square), half = sin(0.5 * angle);
    const double first = is_small ? 1.0 - square / 6.0 : sin(angle) / angle;
    const double second = is_small ? 0.5 - square / 24.0 : 2.0 * half * half / square;
    double turn[DIM][DIM];
    for (int i = 0; i < DIM; ++i)
        for (int j = 0; j < DIM; ++j) {
            turn[i][j] = first * cross[i][j] + (i == j ? 1.0 : 0.0);
            for (int k = 0; k < DIM; ++k) turn[i][j] += second * cross[i][k] * cross[k][j];
        }
    for (int i = 0; i < DIM; ++i) {
        for (int j = 0; j < DIM; ++j) {
            double sum = 0.0;
            for (int k = 0; k < DIM; ++k) sum += turn[i][k] * pose[k * DIM + j];
            moved[i * DIM + j] = sum;
        }
        moved[DIM * DIM + i] = pose[DIM * DIM + i] + step[i];
    }
}

// How far apart two motions move places at a distance from the origin, at most about.
template <int DIM>
GMM_INLINE double pose_gap(const double* one, const double* other, double distance) {
    double shift = 0.0, turn = 0.0;
    for (int i = 0; i < n_of_pose(DIM); ++i)
        (i < DIM * DIM ? turn : shift) += (one[i] - other[i]) * (one[i] - other[i]);
    return sqrt(shift) + distance * sqrt(0.5 * turn);
}

}  // namespace gmm

// Sums over the points of a scan that is aligned with a mixture, or laid over a raster.
#pragma once

#include "../device.h"

namespace gmm {

// An item is a part of the points under one motion.
template <int DIM>
GMM_KERNEL point_alignment(int64_t item, const double* points, int64_t n_points, int64_t n_parts,
                           const double* rotations, const double* translations, const double* low,
                           double side, const int64_t* shape, const int64_t* starts, const int32_t* entries,
                           const double* means, const double* precisions, const double* normals,
                           double behind, double farthest, double outliers, double explained, double* sums) {
    constexpr int TURNS = DIM * (DIM - 1) / 2, FREE = DIM + TURNS, N_SUMS = 2 + FREE + FREE * (FREE + 1);
    const int64_t motion = item / n_parts, part = item % n_parts;
    const double *turn = rotations + motion * DIM * DIM, *shift = translations + motion * DIM;
    double sum[N_SUMS] = {0.0};
    for (int64_t n = n_points * part / n_parts; n < n_points * (part + 1) / n_parts; ++n) {
        double lever[DIM], pull[DIM] = {0.0}, weight[DIM][DIM] = {{0.0}}, spread[DIM][DIM] = {{0.0}};
        double total = outliers;
        for (int i = 0; i < DIM; ++i) {
            lever[i] = 0.0;
            for (int j = 0; j < DIM; ++j) lever[i] += turn[i * DIM + j] * points[n * DIM + j];
        }
        int64_t bucket = 0;
        bool listed = true;
        for (int i = 0; i < DIM; ++i) {
            const double cell = floor((lever[i] + shift[i] - low[i]) / side);
            listed = listed && cell >= 0.0 && cell < (double)shape[i];
            bucket = bucket * shape[i] + (listed ? (int64_t)cell : 0);
        }
        const int64_t begin = listed ? starts[bucket] : 0, stop = listed ? starts[bucket + 1] : 0;
        for (int64_t at = begin; at < stop; ++at) {
            const double *mean = means + entries[at] * DIM, *normal = normals + entries[at] * DIM;
            const double* precision = precisions + entries[at] * DIM * DIM;
            double height_above = 0.0;  // of the sensor over the face
            for (int i = 0; i < DIM; ++i) height_above += normal[i] * (shift[i] - mean[i]);
            if (height_above < -behind) continue;
            double d[DIM], p[DIM], square = 0.0;
            for (int i = 0; i < DIM; ++i) d[i] = lever[i] + shift[i] - mean[i];
            for (int i = 0; i < DIM; ++i) {
                p[i] = 0.0;
                for (int j = 0; j < DIM; ++j) p[i] += precision[i * DIM + j] * d[j];
                square += d[i] * p[i];
            }
            if (square > farthest) continue;
            const double height = exp(-0.5 * square);
            total += height;
            for (int i = 0; i < DIM; ++i) {
                pull[i] += height * p[i];
                for (int j = i; j < DIM; ++j) {
                    weight[i][j] += height * precision[i * DIM + j];
                    spread[i][j] += height * p[i] * p[j];
                }
            }
        }
        if (total == outliers) continue;  // no component is near: all sums stay as they are
        for (int i = 0; i < DIM; ++i) pull[i] /= total;
        for (int i = 0; i < DIM; ++i)
            for (int j = i; j < DIM; ++j) {
                weight[i][j] = weight[j][i] = weight[i][j] / total;
                spread[i][j] = spread[j][i] = weight[i][j] - spread[i][j] / total + pull[i] * pull[j];
            }
        double jacobian[DIM][FREE] = {{0.0}};
        for (int i = 0; i < DIM; ++i) jacobian[i][i] = 1.0;
        for (int k = 0; k < TURNS; ++k) {  // G_k x = (-x_j, x_i) in the rows (i, j)
            const int i = DIM == 2 ? 0 : (k + 1) % DIM, j = DIM == 2 ? 1 : (k + 2) % DIM;
            jacobian[i][DIM + k] = -lever[j];
            jacobian[j][DIM + k] = lever[i];
        }
        sum[0] += log(total / outliers);
        sum[1] += total > explained ? 1.0 : 0.0;
        int place = 2;
        for (int k = 0; k < FREE; ++k) {
            double slope = 0.0;
            for (int i = 0; i < DIM; ++i) slope -= jacobian[i][k] * pull[i];
            sum[place++] += slope;
        }
        for (int which = 0; which < 2; ++which)
            for (int k = 0; k < FREE; ++k) {
                double column[DIM];
                for (int i = 0; i < DIM; ++i) {
                    column[i] = 0.0;
                    for (int j = 0; j < DIM; ++j)
                        column[i] += (which ? spread[i][j] : weight[i][j]) * jacobian[j][k];
                }
                for (int m = k; m < FREE; ++m) {
                    double entry = 0.0;
                    for (int i = 0; i < DIM; ++i) entry += jacobian[i][m] * column[i];
                    sum[place++] += entry;
                }
            }
    }
    for (int s = 0; s < N_SUMS; ++s) sums[item * N_SUMS + s] = sum[s];
}

// An item is a placement of the scan: a heading and a shift in whole cells.
GMM_KERNEL raster_sums(int64_t item, const int64_t* cells, int64_t n_points, const int64_t* heading,
                       const int64_t* shift, const float* raster, int64_t nx, int64_t ny, int64_t nz,
                       double outside, double* sums) {
    const int64_t* cell = cells + heading[item] * n_points * 3;
    const int64_t x0 = shift[3 * item], y0 = shift[3 * item + 1], z0 = shift[3 * item + 2];
    double sum = 0.0;
    for (int64_t n = 0; n < n_points; ++n, cell += 3) {
        const int64_t x = cell[0] + x0, y = cell[1] + y0, z = cell[2] + z0;
        const bool inside = x >= 0 && x < nx && y >= 0 && y < ny && z >= 0 && z < nz;
        sum += inside ? (double)raster[(x * ny + y) * nz + z] : outside;
    }
    sums[item] = sum;
}

}  // namespace gmm

// Cells cut into flat pieces, level by level.
#pragma once

#include "../jacobi.h"

namespace gmm {

// As in cell_sums.py.
struct CutRule {
    int64_t n_levels;
    int64_t limit;
    double thickness;
    double length;
    double min_weight;
    double min_weight_thick;
    double outlier_gap;
    double thickness_priority;
};

// One item cuts all levels. A piece p has sums[p], work[p] (mean, direction, least weight, priority), and
// halves[2 p] and halves[2 p + 1]: weight, position and its square along the direction.
template <int DIM>
GMM_KERNEL piece_cuts(int64_t, const double* points, const double* features, const double* weight,
                      int64_t n_rows, CutRule rule, double* sums, double* work, double* halves, double* along,
                      int64_t* number, int64_t* labels, int64_t* n_pieces) {
    constexpr int WIDTH = n_features(DIM);
    auto bits = [](double x) {
        union {
            double x;
            uint64_t bits;
        } both;
        both.x = x;
        return both.bits;
    };
    int64_t n = 1;
    for (int64_t i = 0; i < n_rows; ++i) labels[i] = 0;
    for (int64_t level = 0; level < rule.n_levels; ++level) {
        for (int64_t f = 0; f < n * WIDTH; ++f) sums[f] = 0.0;
        for (int64_t f = 0; f < n * 6; ++f) halves[f] = 0.0;
        for (int64_t i = 0; i < n_rows; ++i) {
            double* sum = sums + labels[i] * WIDTH;
            const double *x = points + i * DIM, *given = features + i * WIDTH, p = weight[i];
            sum[0] += p;
            for (int a = 0; a < DIM; ++a) sum[1 + a] += p * given[1 + a];
            for (int f = 1 + DIM; f < WIDTH; ++f) sum[f] += p * given[f];
        }
        for (int64_t piece = 0; piece < n; ++piece) {
            const double* sum = sums + piece * WIDTH;
            double* own = work + piece * (2 * DIM + 2);
            const double count = maximum(sum[0], 1e-300);
            double c[DIM][DIM], v[DIM][DIM];
            for (int a = 0; a < DIM; ++a) own[a] = sum[1 + a] / count;
            for (int a = 0, f = 1 + DIM; a < DIM; ++a)
                for (int b = a; b < DIM; ++b, ++f) c[a][b] = c[b][a] = sum[f] / count - own[a] * own[b];
            diagonalize<DIM>(c, v);
            int longest = 0, shortest = 0, widest = 0;
            for (int a = 1; a < DIM; ++a) {
                if (c[a][a] > c[longest][longest]) longest = a;
                if (c[a][a] < c[shortest][shortest]) shortest = a;
            }
            for (int a = 1; a < DIM; ++a)
                if (fabs(v[a][longest]) > fabs(v[widest][longest])) widest = a;
            const double sign = v[widest][longest] < 0.0 ? -1.0 : 1.0;
            for (int a = 0; a < DIM; ++a) own[DIM + a] = sign * v[a][longest];
            const double thin = maximum(c[shortest][shortest], 0.0), wide = c[longest][longest];
            const double thick = sqrt(thin), reach = sqrt(maximum(wide, 0.0));
            own[2 * DIM] = thick > 2.0 * rule.thickness ? rule.min_weight_thick : rule.min_weight;
            const bool wanted = (thick > rule.thickness || reach > rule.length) && reach > 0.0;
            const bool heavy = count >= 2.0 * own[2 * DIM];
            own[2 * DIM + 1] = wanted && heavy ? count * (wide + rule.thickness_priority * thin) : -1.0;
        }
        for (int64_t i = 0; i < n_rows; ++i) {
            const double *x = points + i * DIM, *own = work + labels[i] * (2 * DIM + 2);
            double at = 0.0;
            for (int a = 0; a < DIM; ++a) at += (x[a] - own[a]) * own[DIM + a];
            along[i] = at;
            double* half = halves + (2 * labels[i] + (at > 0.0)) * 3;
            half[0] += weight[i], half[1] += weight[i] * at, half[2] += weight[i] * (at * at);
        }
        int64_t n_cut = 0;
        for (int64_t piece = 0; piece < n; ++piece) {
            double *own = work + piece * (2 * DIM + 2), *half = halves + piece * 6;
            const double few = minimum(half[0], half[3]);
            const double low = half[1] / maximum(half[0], 1e-300), high = half[4] / maximum(half[3], 1e-300);
            const double* more = half[3] > half[0] ? half + 3 : half;
            const double mean = more == half ? low : high, gap = high - low;
            const double variance = more[2] / maximum(more[0], 1e-300) - mean * mean;
            const bool outlier = gap > rule.outlier_gap && gap > 6.0 * sqrt(maximum(variance, 0.0));
            if (!(few > 0.0 && (few >= own[2 * DIM] || outlier))) own[2 * DIM + 1] = -1.0;
            n_cut += own[2 * DIM + 1] >= 0.0;
        }
        // While there are few pieces, the limit allows to halve all of them.
        const int64_t at_once = 4 * n <= rule.limit ? n : (n + 1) / 2;
        int64_t allowed = rule.limit < 0 ? n_cut : minimum(rule.limit - n, at_once);
        if (allowed <= 0 || n_cut == 0) break;
        uint64_t least = 0, above = 0x7FF0000000000000ull;  // bits of a priority: enough pieces have `least`
        while (n_cut > allowed && above - least > 1) {
            const uint64_t middle = least + (above - least) / 2;
            int64_t enough = 0;
            for (int64_t piece = 0; piece < n; ++piece) {
                const double priority = work[piece * (2 * DIM + 2) + 2 * DIM + 1];
                enough += priority >= 0.0 && bits(priority) >= middle;
            }
            if (enough >= allowed)
                least = middle;
            else
                above = middle;
        }
        int64_t n_above = 0, n_new = n;
        for (int64_t piece = 0; piece < n; ++piece) {
            const double priority = work[piece * (2 * DIM + 2) + 2 * DIM + 1];
            n_above += priority >= 0.0 && bits(priority) > least;
        }
        for (int64_t piece = 0; piece < n; ++piece) {
            double* own = work + piece * (2 * DIM + 2);
            const double priority = own[2 * DIM + 1];
            bool cut = priority >= 0.0 && bits(priority) >= least;
            if (cut && n_cut > allowed && bits(priority) == least) cut = n_above++ < allowed;
            number[piece] = cut ? n_new++ : -1;
        }
        for (int64_t i = 0; i < n_rows; ++i)
            if (along[i] > 0.0 && number[labels[i]] >= 0) labels[i] = number[labels[i]];
        n = n_new;
    }
    *n_pieces = n;
}

}  // namespace gmm

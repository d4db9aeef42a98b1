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

// From the sums of a piece: its mean, its longest direction, the least weight of a half, and the priority of
// a cut, -1 if none is wanted.
template <int DIM>
GMM_INLINE void measure_piece(const double* sum, const CutRule& rule, double* own) {
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

// Whether a cut leaves enough points: `half` has the weight, the position and its square of both halves.
GMM_INLINE bool is_supported(const double* half, double least, const CutRule& rule) {
    const double few = minimum(half[0], half[3]);
    const double low = half[1] / maximum(half[0], 1e-300), high = half[4] / maximum(half[3], 1e-300);
    const double* more = half[3] > half[0] ? half + 3 : half;
    const double mean = more == half ? low : high, gap = high - low;
    const double variance = more[2] / maximum(more[0], 1e-300) - mean * mean;
    const bool outlier = gap > rule.outlier_gap && gap > 6.0 * sqrt(maximum(variance, 0.0));
    return few > 0.0 && (few >= least || outlier);
}

// The most cuts of a level of n pieces. While there are few pieces, the limit allows to halve all of them.
GMM_INLINE int64_t allowed_cuts(int64_t n, const CutRule& rule) {
    return minimum(rule.limit - n, 4 * n <= rule.limit ? n : (n + 1) / 2);
}

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
            measure_piece<DIM>(sum, rule, own);
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
            if (!is_supported(half, own[2 * DIM], rule)) own[2 * DIM + 1] = -1.0;
            n_cut += own[2 * DIM + 1] >= 0.0;
        }
        const int64_t allowed = rule.limit < 0 ? n_cut : allowed_cuts(n, rule);
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

// Adds to a sum of whole numbers, whose result does not depend on the order of the items.
GMM_INLINE void add_whole(int64_t* place, double value) {
#if defined(__CUDA_ARCH__)
    atomicAdd((unsigned long long*)place, (unsigned long long)(int64_t)rint(value));
#else
    *place += (int64_t)rint(value);
#endif
}

struct CutTables {
    double* work;  // of a piece as in `piece_cuts`, without its priority
    double* priority;
    double* along;    // of a row
    int64_t* sums;    // of a piece, in whole numbers; 0 at the start
    int64_t* halves;  // the same
    int64_t* cut;     // whether a piece is cut
    int64_t* number;  // of its new half, or -1
    int64_t* labels;  // of a row; 0 at the start
};

// The same cuts by many workers, in phases. Sums are whole multiples of 1/scales: of features, then of the
// halves. `before` and `after`: phase, level, number of pieces, whether all is done.
template <int DIM>
GMM_KERNEL team_cuts(int64_t item, Team team, const double* points, const double* features,
                     const double* weight, int64_t n_rows, CutRule rule, const double* scales, CutTables t,
                     int64_t n_phases, const int64_t* before, int64_t* after) {
    constexpr int WIDTH = n_features(DIM), OWN = 2 * DIM + 1;
    enum Phase : int64_t { ROWS, PIECES, HALVES, SUPPORT, CHOICE, NUMBERS, NEXT };
    int64_t phase = before[0], level = before[1], n = before[2], done = before[3];
    for (int64_t left = n_phases; left > 0 && !done; --left) {
        if (phase == ROWS)
            for (int64_t i = item; i < n_rows; i += team.n) {
                if (level > 0 && t.along[i] > 0.0 && t.number[t.labels[i]] >= 0)
                    t.labels[i] = t.number[t.labels[i]];
                int64_t* sum = t.sums + t.labels[i] * WIDTH;
                add_whole(sum, weight[i] * scales[0]);
                for (int f = 1; f < WIDTH; ++f)
                    add_whole(sum + f, weight[i] * features[i * WIDTH + f] * scales[f]);
            }
        if (phase == PIECES)
            for (int64_t piece = item; piece < n; piece += team.n) {
                double sum[WIDTH], own[OWN + 1];
                for (int f = 0; f < WIDTH; ++f) {
                    sum[f] = (double)t.sums[piece * WIDTH + f] / scales[f];
                    t.sums[piece * WIDTH + f] = 0;
                }
                measure_piece<DIM>(sum, rule, own);
                for (int f = 0; f < OWN; ++f) t.work[piece * OWN + f] = own[f];
                t.priority[piece] = own[OWN];
            }
        if (phase == HALVES)
            for (int64_t i = item; i < n_rows; i += team.n) {
                const double* own = t.work + t.labels[i] * OWN;
                double at = 0.0;
                for (int a = 0; a < DIM; ++a) at += (points[i * DIM + a] - own[a]) * own[DIM + a];
                t.along[i] = at;
                int64_t* half = t.halves + (2 * t.labels[i] + (at > 0.0)) * 3;
                add_whole(half, weight[i] * scales[WIDTH]);
                add_whole(half + 1, weight[i] * at * scales[WIDTH + 1]);
                add_whole(half + 2, weight[i] * (at * at) * scales[WIDTH + 2]);
            }
        if (phase == SUPPORT)
            for (int64_t piece = item; piece < n; piece += team.n) {
                double half[6];
                for (int f = 0; f < 6; ++f) {
                    half[f] = (double)t.halves[piece * 6 + f] / scales[WIDTH + f % 3];
                    t.halves[piece * 6 + f] = 0;
                }
                if (!is_supported(half, t.work[piece * OWN + 2 * DIM], rule)) t.priority[piece] = -1.0;
            }
        if (phase == CHOICE)
            for (int64_t piece = item; piece < n; piece += team.n) {
                const double mine = t.priority[piece];
                int64_t rank = 0;
                for (int64_t other = 0; rule.limit >= 0 && mine >= 0.0 && other < n; ++other)
                    rank += t.priority[other] > mine || (t.priority[other] == mine && other < piece);
                t.cut[piece] = mine >= 0.0 && (rule.limit < 0 || rank < allowed_cuts(n, rule));
            }
        if (phase == NUMBERS)
            for (int64_t piece = item; piece < n; piece += team.n) {
                int64_t n_before = n;
                for (int64_t other = 0; other < piece; ++other) n_before += t.cut[other];
                t.number[piece] = t.cut[piece] ? n_before : -1;
            }
        if (phase == NEXT) {
            int64_t n_new = n;
            for (int64_t piece = n - 1; piece >= 0 && n_new == n; --piece)
                if (t.cut[piece]) n_new = t.number[piece] + 1;
            done = n_new == n;
            n = n_new, ++level, phase = ROWS;
            continue;
        }
        meet(team);
        done = phase == ROWS && level == rule.n_levels;
        ++phase;
    }
    if (item == 0) after[0] = phase, after[1] = level, after[2] = n, after[3] = done;
}

}  // namespace gmm

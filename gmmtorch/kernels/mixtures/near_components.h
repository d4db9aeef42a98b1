// The components that can matter to a block of rows that follow each other in space.
#pragma once

#include "e_step.h"

namespace gmm {

constexpr int ROWS = 64;        // of a block, at most
constexpr int CANDIDATES = 8;   // for the likeliest component of a row
constexpr double DOUBT = 1e-3;  // nats by which rounding may change a bound

// Rows and components of an E-step. Natural parameters of rows beyond n_components are impossible.
struct Given {
    const double* features;
    const double* weight;
    int64_t n_rows;
    const double* natural;
    const double* table;
    int64_t n_components;
    int64_t n_padded;
    int64_t n_parts;
};

// Component k in column k of a table: c, the mean and W, upper triangular, so that its logit at x is
// c - |W (x - mean)|^2 / 2. c is NaN where no such W exists, and -HUGE_VAL in columns without a component.
template <int DIM>
GMM_KERNEL component_table(int64_t item, const double* natural, int64_t n_components, int64_t n_padded,
                           double* table) {
    double column[n_features(DIM)] = {};
    double *mean = column + 1, *factor = column + 1 + DIM;
    column[0] = -HUGE_VAL;
    if (item < n_components) {
        const double* w = natural + item * n_features(DIM);
        double root[DIM][DIM], z[DIM];
        column[0] = w[0];
        int f = 1 + DIM;
        for (int i = 0; i < DIM; ++i)
            for (int j = i; j < DIM; ++j, ++f) {
                double sum = i == j ? -2.0 * w[f] : -w[f];
                for (int p = 0; p < i; ++p) sum -= root[p][i] * root[p][j];
                if (i == j && !(sum > 0.0)) column[0] = NAN;
                root[i][j] = i == j ? sqrt(sum) : sum / root[i][i];
                factor[f - 1 - DIM] = root[i][j];
            }
        for (int i = 0; i < DIM; ++i) {
            z[i] = w[1 + i];
            for (int p = 0; p < i; ++p) z[i] -= root[p][i] * z[p];
            z[i] /= root[i][i];
            column[0] += 0.5 * z[i] * z[i];
        }
        for (int i = DIM - 1; i >= 0; --i) {
            mean[i] = z[i];
            for (int j = i + 1; j < DIM; ++j) mean[i] -= root[i][j] * mean[j];
            mean[i] /= root[i][i];
        }
    }
    for (int f = 0; f < n_features(DIM); ++f) table[f * n_padded + item] = column[f];
}

// The rows from begin to stop, the box of their points, center and half sides; and whether a row is a cell,
// with a scatter of its own, rather than a point.
template <int DIM>
struct Block {
    int64_t begin, stop;
    double center[DIM], half[DIM];
    bool has_cells;
};

// What the threads of a squad share while they look for components.
template <int DIM>
struct Search {
    double extents[THREADS][2 * DIM + 1], score[THREADS * LANES];
    int64_t which[THREADS * LANES], count[THREADS];
};

template <int DIM>
GMM_INLINE Block<DIM> block_of_rows(Squad squad, Search<DIM>& shared, const Given& given, int64_t begin,
                                    int64_t stop) {
    constexpr int WIDTH = n_features(DIM), N = 2 * DIM + 1;
    double own[N];
    for (int i = 0; i < N; ++i) own[i] = i < 2 * DIM ? -HUGE_VAL : 0.0;
    for (int64_t row = begin + squad.lane; row < stop; row += squad.n) {
        const double* x = given.features + row * WIDTH + 1;
        for (int i = 0, f = DIM; i < DIM; f += DIM - i, ++i) {
            own[i] = maximum(own[i], x[i]);
            own[DIM + i] = maximum(own[DIM + i], -x[i]);
            if (x[f] - x[i] * x[i] > 1e-14 * x[f]) own[2 * DIM] = 1.0;
        }
    }
    for (int i = 0; i < N; ++i) shared.extents[squad.lane][i] = own[i];
    reduce(squad, squad.n, 1, [&](int a, int b) {
        for (int i = 0; i < N; ++i)
            shared.extents[a][i] = maximum(shared.extents[a][i], shared.extents[b][i]);
    });
    Block<DIM> block = {begin, stop, {}, {}, shared.extents[0][2 * DIM] > 0.0};
    for (int i = 0; i < DIM; ++i) {
        const double high = shared.extents[0][i], low = -shared.extents[0][DIM + i];
        block.center[i] = 0.5 * (low + high);
        block.half[i] = maximum(high - block.center[i], block.center[i] - low);
    }
    return block;
}

// The least number of the threads, for all of them.
template <int DIM>
GMM_INLINE double least_of(Squad squad, Search<DIM>& shared, double own) {
    meet(squad);
    shared.score[squad.lane] = own;
    reduce(squad, squad.n, 1,
           [&](int a, int b) { shared.score[a] = minimum(shared.score[a], shared.score[b]); });
    return shared.score[0];
}

// Writes an upper bound of the logits of each component in the block, from the box in the component's
// whitened axes. Returns a number that the largest logit of each row exceeds or equals: each row is compared
// with CANDIDATES that are likely at the block's center.
template <int DIM>
GMM_INLINE double bound_logits(Squad squad, Search<DIM>& shared, const Given& given, const Block<DIM>& block,
                               double* upper) {
    constexpr int WIDTH = n_features(DIM);
    const vec* column = (const vec*)given.table;
    const int64_t stride = given.n_padded / LANES;
    vec best = (vec)(-HUGE_VAL), which = (vec)(0.0);
    for (int64_t v = squad.lane; v < stride; v += squad.n) {
        vec offset[DIM], nearest = (vec)(0.0), middle = (vec)(0.0);
        for (int i = 0; i < DIM; ++i) offset[i] = block.center[i] - column[(1 + i) * stride + v];
        for (int i = 0, f = 1 + DIM; i < DIM; ++i) {
            vec y = (vec)(0.0), reach = (vec)(0.0);
            for (int j = i; j < DIM; ++j, ++f) {
                const vec w = column[f * stride + v];
                y = fused(w, offset[j], y);
                reach = fused(absolute(w), (vec)(block.half[j]), reach);
            }
            vec gap = absolute(y) - reach;
            gap = gap > 0.0 ? gap : (vec)(0.0);
            nearest = fused(gap, gap, nearest);
            middle = fused(y, y, middle);
        }
        ((vec*)upper)[v] = column[v] - 0.5 * nearest;
        middle = column[v] - 0.5 * middle;
        vec number = (vec)(0.0);
        for (int l = 0; l < LANES; ++l) set(number, l, (double)(v * LANES + l));
        which = middle > best ? number : which;
        best = middle > best ? middle : best;
    }
    for (int l = 0; l < LANES; ++l) {
        shared.score[squad.lane * LANES + l] = get(best, l);
        shared.which[squad.lane * LANES + l] = (int64_t)get(which, l);
    }
    reduce(squad, squad.n * LANES, CANDIDATES, [&](int a, int b) {
        if (!(shared.score[b] > shared.score[a])) return;
        shared.score[a] = shared.score[b];
        shared.which[a] = shared.which[b];
    });
    const int n_candidates = minimum(squad.n * LANES, CANDIDATES);
    vec x[WIDTH], least = (vec)(HUGE_VAL);
    for (int64_t row = block.begin + squad.lane * LANES; row < block.stop; row += squad.n * LANES) {
        load_rows<WIDTH>(given.features, [&](int l) { return minimum(row + l, block.stop - 1); }, x);
        vec peak = (vec)(-HUGE_VAL);
        for (int c = 0; c < n_candidates; ++c) {
            const double* w = given.natural + shared.which[c] * WIDTH;
            vec logit = x[0] * w[0];
            for (int f = 1; f < WIDTH; ++f) logit = fused(x[f], (vec)(w[f]), logit);
            peak = logit > peak ? logit : peak;
        }
        least = peak < least ? peak : least;
    }
    return least_of(squad, shared, -largest(-least));
}

// Lists, in order, the components that can have a logit of at least `peak` - SKIPPED; returns their number.
template <int DIM>
GMM_INLINE int64_t list_components(Squad squad, Search<DIM>& shared, const Given& given, const double* upper,
                                   double peak, int64_t* listed) {
    const double cutoff = peak - SKIPPED - DOUBT - 1e-12 * fabs(peak);
    const int64_t n_steps = given.n_padded / LANES;
    const int64_t first = n_steps * squad.lane / squad.n, last = n_steps * (squad.lane + 1) / squad.n;
    auto each = [&](auto use) {
        for (int64_t v = first; v < last; ++v) {
            const vec bound = ((const vec*)upper)[v];
            if (!any((bound >= cutoff) | (bound != bound))) continue;
            for (int64_t k = v * LANES; k < minimum((v + 1) * LANES, given.n_components); ++k)
                if (!(upper[k] < cutoff)) use(k);
        }
    };
    int64_t place = 0, n_listed = 0;
    if (squad.n > 1) {
        int64_t own = 0;
        each([&](int64_t) { ++own; });
        shared.count[squad.lane] = own;
        meet(squad);
        for (int t = 0; t < squad.n; ++t) {
            if (t == squad.lane) place = n_listed;
            n_listed += shared.count[t];
        }
    }
    each([&](int64_t k) { listed[place++] = k; });
    meet(squad);
    return squad.n > 1 ? n_listed : place;
}

}  // namespace gmm

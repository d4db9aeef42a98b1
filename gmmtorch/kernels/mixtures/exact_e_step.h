// E-step of exact EM. On a CPU, vectors of rows compute with the components near a block of rows; on a GPU,
// the threads of a squad share a block.
#pragma once

#include "near_components.h"

namespace gmm {

// An item is a part of the rows with sums of its own. Without a table, each block lists all components.
template <int DIM>
GMM_KERNEL e_step(int64_t item, Given given, double* scratch, int64_t* numbers, double* partial,
                  double* peaks, double* norms) {
    constexpr int WIDTH = n_features(DIM);
    const int64_t begin = given.n_rows * item / given.n_parts;
    const int64_t stop = given.n_rows * (item + 1) / given.n_parts, n_padded = given.n_padded;
    const Squad squad = squad_of(item);
    vec* logits = (vec*)scratch + item * (n_padded + n_padded / LANES);
    double* upper = (double*)(logits + n_padded);
    int64_t *near = numbers + item * 2 * n_padded, *listed = near + n_padded;
    vec* sums = (vec*)(partial + item * n_padded * WIDTH * LANES);
    vec x[WIDTH];
    Search<DIM> search;
    int64_t n_listed = 0, n_whole = given.table ? 0 : given.n_rows;  // next blocks that list all components
    auto of = [&](int64_t place) { return given.natural + listed[place] * WIDTH; };
    auto of_all = [&](int64_t k) { return given.natural + k * WIDTH; };
    for (int64_t first = begin; first < stop; first += ROWS) {
        const int64_t last = minimum(first + ROWS, stop);
        const bool lists_all = n_whole > 0;
        if (lists_all) {
            n_whole -= 1;
            for (n_listed = 0; n_listed < given.n_components; ++n_listed) listed[n_listed] = n_listed;
        } else {
            const Block<DIM> block = block_of_rows(squad, search, given, first, last);
            const double peak = bound_logits(squad, search, given, block, upper);
            n_listed = list_components(squad, search, given, upper, peak, listed);
            if (2 * n_listed > given.n_components) n_whole = 8;  // rows in no order: searches do not pay
        }
        while (n_listed % 4) listed[n_listed++] = given.n_components;
        for (int64_t row = first; row < last; row += LANES) {
            const int64_t lane_rows = minimum((int64_t)LANES, last - row);
            load_rows<WIDTH>(
                given.features, [&](int l) { return row + minimum((int64_t)l, lane_rows - 1); }, x);
            const vec peak = lists_all ? find_logits<WIDTH>(x, n_listed, of_all, logits)
                                       : find_logits<WIDTH>(x, n_listed, of, logits);
            vec norm = (vec)(0.0), p = (vec)(0.0);
            for (int l = 0; l < lane_rows; ++l) set(p, l, given.weight[row + l]);
            int64_t n_near = 0;
            for (int64_t place = 0; place < n_listed; ++place) {
                const vec under = logits[place] - peak;
                if (!any(under > -SKIPPED)) continue;
                const vec term = under > -SKIPPED ? expo(under) : (vec)(0.0);
                norm += term;
                logits[n_near] = term;  // n_near is at most the place
                near[n_near++] = listed[place];
            }
            const vec share = p / norm;
            for (int64_t place = 0; place < n_near; ++place) {
                vec* sum = sums + near[place] * WIDTH;
                const vec gamma = logits[place] * share;
                for (int f = 0; f < WIDTH; ++f) sum[f] = fused(gamma, x[f], sum[f]);
            }
            for (int l = 0; l < lane_rows; ++l) {
                peaks[row + l] = get(peak, l);
                norms[row + l] = get(norm, l);
            }
        }
    }
}

template <int DIM>
GMM_KERNEL most_likely(int64_t item, const double* features, int64_t n_rows, const double* natural,
                       int64_t n_components, int64_t n_parts, int64_t* likeliest) {
    constexpr int WIDTH = n_features(DIM);
    const int64_t begin = n_rows * item / n_parts, stop = n_rows * (item + 1) / n_parts;
    vec x[WIDTH];
    for (int64_t row = begin; row < stop; row += LANES) {
        const int64_t lane_rows = minimum((int64_t)LANES, stop - row);
        load_rows<WIDTH>(features, [&](int l) { return row + minimum((int64_t)l, lane_rows - 1); }, x);
        vec peak = (vec)(-1e300), first = (vec)(0.0);
        auto compare = [&](double k, vec logit) {
            first = logit > peak ? (vec)(k) : first;
            peak = logit > peak ? logit : peak;
        };
        auto of = [&](int64_t k) { return natural + k * WIDTH; };
        each_four_logits<WIDTH>(x, n_components, of, [&](int64_t k, vec a, vec b, vec c, vec d) {
            compare((double)k, a), compare((double)(k + 1), b);
            compare((double)(k + 2), c), compare((double)(k + 3), d);
        });
        for (int l = 0; l < lane_rows; ++l) likeliest[row + l] = (int64_t)get(first, l);
    }
}

// A row and a component of a block: in float64, features and natural parameters.
template <int DIM, typename Real>
struct Form {
    static constexpr int N = n_features(DIM);
    double w[N];

    GMM_INLINE static void load(const double* features, const Block<DIM>&, double* x) {
        for (int f = 0; f < N; ++f) x[f] = features[f];
    }
    GMM_INLINE void place(const Given& given, int64_t k, const Block<DIM>&, double) {
        for (int f = 0; f < N; ++f) w[f] = given.natural[k * N + f];
    }
    GMM_INLINE double logit(const double* x) const {
        double sum = x[0] * w[0];
        for (int f = 1; f < N; ++f) sum = fma(x[f], w[f], sum);
        return sum;
    }
    GMM_INLINE static void add(double gamma, const double* x, double* sums) {
        for (int f = 0; f < N; ++f) sums[f] = fma(gamma, x[f], sums[f]);
    }
    GMM_INLINE static void add_to(const Block<DIM>&, const double* own, double* sums) {
        for (int f = 0; f < N; ++f) sums[f] += own[f];
    }
};

// In float32, a point x about the block's center, and the logit c - |W x + b|^2 / 2 above a reference that
// the largest logit of no row is below.
//
// With u = 2^-24: W, x and b are rounded once and W x + b in at most DIM steps, so its entry i has an error
// of at most e_i = (DIM + 3) u (|b_i| + r_i), where r_i is the largest |W x|_i in the box. A pair counts only
// if its logit exceeds -SKIPPED, thus |W x + b|^2 <= s = 2 (c + SKIPPED). The error of its logit is at most
// sqrt(s) |e| + |e|^2 / 2 + 2 u (s + |c|), which `place` returns. A block in which it can exceed FAINT is
// computed in float64. Sums of a block, of features of x, have a relative error of at most (ROWS + 3) u more.
constexpr double FAINT = 1.0 / 1024.0;  // nats

template <int DIM>
struct Form<DIM, float> {
    static constexpr int N = DIM;
    float c, b[DIM], w[DIM * (DIM + 1) / 2];

    GMM_INLINE static void load(const double* features, const Block<DIM>& block, float* x) {
        for (int i = 0; i < DIM; ++i) x[i] = (float)(features[1 + i] - block.center[i]);
    }
    GMM_INLINE double place(const Given& given, int64_t k, const Block<DIM>& block, double reference) {
        constexpr double u = 1.0 / 16777216.0;
        const double* column = given.table + k;
        const double constant = column[0] - reference, s = 2.0 * maximum(constant + SKIPPED, 0.0);
        double offset[DIM], squared = 0.0;
        for (int i = 0; i < DIM; ++i) offset[i] = block.center[i] - column[(1 + i) * given.n_padded];
        for (int i = 0, f = 0; i < DIM; ++i) {
            double at = 0.0, reach = 0.0;
            for (int j = i; j < DIM; ++j, ++f) {
                const double entry = column[(1 + DIM + f) * given.n_padded];
                at += entry * offset[j];
                reach += fabs(entry) * block.half[j];
                w[f] = (float)entry;
            }
            b[i] = (float)at;
            const double error = (DIM + 3) * u * (fabs(at) + reach);
            squared += error * error;
        }
        c = (float)constant;
        return sqrt(s * squared) + 0.5 * squared + 2.0 * u * (s + fabs(constant));
    }
    GMM_INLINE float logit(const float* x) const {
        float sum = 0.0f;
        for (int i = 0, f = 0; i < DIM; ++i) {
            float y = b[i];
            for (int j = i; j < DIM; ++j, ++f) y = fmaf(w[f], x[j], y);
            sum = fmaf(y, y, sum);
        }
        return fmaf(-0.5f, sum, c);
    }
    GMM_INLINE static void add(float gamma, const float* x, float* sums) {
        sums[0] += gamma;
        for (int i = 0, f = 1 + DIM; i < DIM; ++i) {
            const float part = gamma * x[i];
            sums[1 + i] += part;
            for (int j = i; j < DIM; ++j, ++f) sums[f] = fmaf(part, x[j], sums[f]);
        }
    }
    GMM_INLINE static void add_to(const Block<DIM>& block, const float* own, double* sums) {
        const double* at = block.center;
        sums[0] += own[0];
        for (int i = 0, f = 1 + DIM; i < DIM; ++i) {
            const double first = own[1 + i] + own[0] * at[i];
            sums[1 + i] += first;
            for (int j = i; j < DIM; ++j, ++f) sums[f] += own[f] + at[i] * own[1 + j] + first * at[j];
        }
    }
};

// Whether float32 is accurate enough for the listed components.
template <int DIM>
GMM_INLINE bool fits_float32(Squad squad, Search<DIM>& shared, const Given& given, const Block<DIM>& block,
                             const int64_t* listed, int64_t n_listed, double reference) {
    double fits = block.has_cells ? 0.0 : 1.0;
    for (int64_t place = squad.lane; place < n_listed; place += squad.n) {
        Form<DIM, float> form;
        if (!(form.place(given, listed[place], block, reference) < FAINT)) fits = 0.0;
    }
    return least_of(squad, shared, fits) > 0.0;
}

// The rows of a block and a tile of components, which the threads of a squad share.
template <int DIM, typename Real>
struct Tile {
    Form<DIM, Real> forms[ROWS];
    Real x[ROWS][Form<DIM, Real>::N], peak[ROWS], norm[ROWS], weight[ROWS];
};

// The E-step of a block: a thread first takes a row and all components, then a component and all rows.
// Nothing is stored for a pair.
template <int DIM, typename Real>
GMM_INLINE void sum_block(Squad squad, Search<DIM>& search, Tile<DIM, Real>& tile, const Given& given,
                          const Block<DIM>& block, const double* upper, int64_t* listed, int64_t n_listed,
                          double reference, double* sums, double* norms) {
    constexpr int WIDTH = n_features(DIM), N = Form<DIM, Real>::N;
    const int n_rows = (int)(block.stop - block.begin);
    const double zero = sizeof(Real) == 4 ? reference : 0.0;  // of the logits
    meet(squad);
    for (int r = squad.lane; r < n_rows; r += squad.n) {
        Form<DIM, Real>::load(given.features + (block.begin + r) * WIDTH, block, tile.x[r]);
        tile.weight[r] = (Real)given.weight[block.begin + r];
        tile.peak[r] = (Real)(reference - zero);
        tile.norm[r] = 0;
    }
    for (int64_t first = 0; first < n_listed; first += ROWS) {
        const int n = (int)minimum(n_listed - first, (int64_t)ROWS);
        meet(squad);
        for (int i = squad.lane; i < n; i += squad.n)
            tile.forms[i].place(given, listed[first + i], block, reference);
        meet(squad);
        for (int r = squad.lane; r < n_rows; r += squad.n) {
            Real x[N], peak = tile.peak[r], norm = tile.norm[r];
            for (int i = 0; i < N; ++i) x[i] = tile.x[r][i];
            for (int i = 0; i < n; ++i) {
                const Real logit = tile.forms[i].logit(x), above = logit - peak;
                if (!(above > (Real)-SKIPPED)) continue;
                const Real term = exp(above > 0 ? -above : above);
                norm = above > 0 ? norm * term + 1 : norm + term;
                peak = above > 0 ? logit : peak;
            }
            tile.peak[r] = peak;
            tile.norm[r] = norm;
        }
    }
    double least = HUGE_VAL;
    for (int r = squad.lane; r < n_rows; r += squad.n) {
        const double norm = (double)tile.peak[r] + log((double)tile.norm[r]);
        tile.norm[r] = (Real)norm;
        norms[block.begin + r] = zero + norm;
        least = minimum(least, zero + norm);
    }
    least = least_of(squad, search, least);
    n_listed = list_components(squad, search, given, upper, least, listed);
    for (int64_t place = squad.lane; place < n_listed; place += squad.n) {
        const int64_t k = listed[place];
        Form<DIM, Real> form;
        Real own[WIDTH] = {};
        form.place(given, k, block, reference);
        for (int r = 0; r < n_rows; ++r) {
            const Real under = form.logit(tile.x[r]) - tile.norm[r];
            if (!(under > (Real)-SKIPPED)) continue;
            form.add(exp(under) * tile.weight[r], tile.x[r], own);
        }
        Form<DIM, Real>::add_to(block, own, sums + k * WIDTH);
    }
    meet(squad);
}

// A squad takes a part of the rows, block after block, with sums of its own.
template <int DIM, typename Real>
GMM_KERNEL e_step_in_blocks(int64_t item, Given given, double* scratch, int64_t* numbers, double* partial,
                            double* norms) {
    const Squad squad = squad_of(item);
    GMM_SHARED Search<DIM> search;
    GMM_SHARED union {
        Tile<DIM, double> in_float64;
        Tile<DIM, Real> in_float32;
    } tile;
    double* upper = scratch + squad.item * given.n_padded;
    int64_t* listed = numbers + squad.item * given.n_padded;
    double* sums = partial + squad.item * given.n_components * n_features(DIM);
    const int64_t n_blocks = (given.n_rows + ROWS - 1) / ROWS;
    const int64_t end = n_blocks * (squad.item + 1) / given.n_parts;
    for (int64_t number = n_blocks * squad.item / given.n_parts; number < end; ++number) {
        const int64_t begin = number * ROWS, stop = minimum(begin + ROWS, given.n_rows);
        const Block<DIM> block = block_of_rows(squad, search, given, begin, stop);
        const double peak = bound_logits(squad, search, given, block, upper);
        const int64_t n = list_components(squad, search, given, upper, peak, listed);
        if constexpr (sizeof(Real) == 4) {
            if (fits_float32(squad, search, given, block, listed, n, peak)) {
                sum_block(squad, search, tile.in_float32, given, block, upper, listed, n, peak, sums, norms);
                continue;
            }
        }
        sum_block(squad, search, tile.in_float64, given, block, upper, listed, n, peak, sums, norms);
    }
}

}  // namespace gmm

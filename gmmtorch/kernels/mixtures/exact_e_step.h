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

// Sums of features of points A x + t, from those of points x.
template <int DIM>
GMM_INLINE void move_sums(const double (&A)[DIM][DIM], const double* t, double* sums) {
    double first[DIM], half[DIM][DIM], second[DIM][DIM];
    for (int i = 0, f = 1 + DIM; i < DIM; ++i)
        for (int j = i; j < DIM; ++j, ++f) second[i][j] = second[j][i] = sums[f];
    for (int i = 0; i < DIM; ++i) {
        first[i] = 0.0;
        for (int j = 0; j < DIM; ++j) {
            first[i] += A[i][j] * sums[1 + j];
            half[i][j] = 0.0;
            for (int p = 0; p < DIM; ++p) half[i][j] += A[i][p] * second[p][j];
        }
    }
    for (int i = 0, f = 1 + DIM; i < DIM; ++i)
        for (int j = i; j < DIM; ++j, ++f) {
            sums[f] = first[i] * t[j] + t[i] * first[j] + sums[0] * t[i] * t[j];
            for (int p = 0; p < DIM; ++p) sums[f] += half[i][p] * A[j][p];
        }
    for (int i = 0; i < DIM; ++i) sums[1 + i] = first[i] + sums[0] * t[i];
}

// A component of the table.
template <int DIM>
struct Whitening {
    double constant, mean[DIM], factor[DIM][DIM];

    GMM_INLINE Whitening(const double* table, int64_t n_padded, int64_t k) {
        const double* at = table + k;
        constant = *at;
        for (int i = 0; i < DIM; ++i) mean[i] = *(at += n_padded);
        for (int i = 0; i < DIM; ++i)
            for (int j = 0; j < DIM; ++j) factor[i][j] = j < i ? 0.0 : *(at += n_padded);
    }

    // Sums of features of points x become those of W (x - mean).
    GMM_INLINE void whiten(double* sums) const {
        double t[DIM];
        for (int i = 0; i < DIM; ++i) {
            t[i] = 0.0;
            for (int j = i; j < DIM; ++j) t[i] -= factor[i][j] * mean[j];
        }
        if (constant == constant) move_sums(factor, t, sums);
    }

    GMM_INLINE void restore(double* sums) const {
        double inverse[DIM][DIM] = {};
        for (int j = 0; j < DIM; ++j)
            for (int i = j; i >= 0; --i) {
                double sum = i == j ? 1.0 : 0.0;
                for (int p = i + 1; p <= j; ++p) sum -= factor[i][p] * inverse[p][j];
                inverse[i][j] = sum / factor[i][i];
            }
        if (constant == constant) move_sums(inverse, mean, sums);
    }
};

// A row and a component of a block: in float64, features and natural parameters.
template <int DIM, typename Real>
struct Form {
    static constexpr int WIDTH = n_features(DIM), N = WIDTH;
    double w[WIDTH];

    GMM_INLINE static void load(const double* features, const Block<DIM>&, double* x) {
        for (int f = 0; f < WIDTH; ++f) x[f] = features[f];
    }
    GMM_INLINE void place(const Given& given, int64_t k, const Block<DIM>&, double) {
        for (int f = 0; f < WIDTH; ++f) w[f] = given.natural[k * WIDTH + f];
    }
    GMM_INLINE double logit(const double* x) const {
        double sum = x[0] * w[0];
        for (int f = 1; f < WIDTH; ++f) sum = fma(x[f], w[f], sum);
        return sum;
    }
    GMM_INLINE void add(double gamma, const double* x, double* sums) const {
        for (int f = 0; f < WIDTH; ++f) sums[f] = fma(gamma, x[f], sums[f]);
    }
};

// In float32, a point x about the block's center, and the logit c - |W x + b|^2 / 2 above a reference that
// the largest logit of no row is below.
//
// With u = 2^-24: W, x and b are rounded once and W x + b in at most DIM steps, so its entry i has an error
// of at most e_i = (DIM + 3) u (|b_i| + r_i), where r_i is the largest |W x|_i in the box. A pair counts only
// if its logit exceeds -SKIPPED, thus |W x + b|^2 <= s = 2 (c + SKIPPED). The error of its logit is at most
// sqrt(s) |e| + |e|^2 / 2 + 2 u (s + |c|), which `place` returns. A block in which it can exceed FAINT is
// computed in float64.
constexpr double FAINT = 1.0 / 1024.0;  // nats

template <int DIM>
struct Form<DIM, float> {
    static constexpr int WIDTH = n_features(DIM), N = DIM;
    float c, b[DIM], w[DIM][DIM];

    GMM_INLINE static void load(const double* features, const Block<DIM>& block, float* x) {
        for (int i = 0; i < DIM; ++i) x[i] = (float)(features[1 + i] - block.center[i]);
    }
    GMM_INLINE double place(const Given& given, int64_t k, const Block<DIM>& block, double reference) {
        constexpr double u = 1.0 / 16777216.0;
        const Whitening<DIM> own(given.table, given.n_padded, k);
        const double constant = own.constant - reference;
        const double most = 2.0 * maximum(constant + SKIPPED, 0.0);
        double squared = 0.0;
        for (int i = 0; i < DIM; ++i) {
            double at = 0.0, reach = 0.0;
            for (int j = i; j < DIM; ++j) {
                at += own.factor[i][j] * (block.center[j] - own.mean[j]);
                reach += fabs(own.factor[i][j]) * block.half[j];
                w[i][j] = (float)own.factor[i][j];
            }
            b[i] = (float)at;
            const double error = (DIM + 3) * u * (fabs(at) + reach);
            squared += error * error;
        }
        c = (float)constant;
        return sqrt(most * squared) + 0.5 * squared + 2.0 * u * (most + fabs(constant));
    }
    GMM_INLINE void whitened(const float* x, float* y) const {
        for (int i = 0; i < DIM; ++i) {
            y[i] = b[i];
            for (int j = i; j < DIM; ++j) y[i] = fmaf(w[i][j], x[j], y[i]);
        }
    }
    GMM_INLINE float logit(const float* x) const {
        float y[DIM], sum = 0.0f;
        whitened(x, y);
        for (int i = 0; i < DIM; ++i) sum = fmaf(y[i], y[i], sum);
        return fmaf(-0.5f, sum, c);
    }
    // Adds features of W x + b.
    GMM_INLINE void add(float gamma, const float* x, float* sums) const {
        float y[DIM];
        whitened(x, y);
        sums[0] += gamma;
        for (int i = 0, f = 1 + DIM; i < DIM; ++i) {
            sums[1 + i] = fmaf(gamma, y[i], sums[1 + i]);
            for (int j = i; j < DIM; ++j, ++f) sums[f] = fmaf(gamma * y[i], y[j], sums[f]);
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
// Nothing is stored for a pair. With `whitens`, sums are those in the components' whitened coordinates.
template <int DIM, typename Real>
GMM_INLINE void sum_block(Squad squad, Search<DIM>& search, Tile<DIM, Real>& tile, const Given& given,
                          const Block<DIM>& block, const double* upper, int64_t* listed, int64_t n_listed,
                          double reference, bool whitens, double* sums, double* norms) {
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
        double found[WIDTH];
        for (int f = 0; f < WIDTH; ++f) found[f] = own[f];
        if (whitens) Whitening<DIM>(given.table, given.n_padded, k).whiten(found);
        for (int f = 0; f < WIDTH; ++f) sums[k * WIDTH + f] += found[f];
    }
    meet(squad);
}

// A squad takes a part of the rows, block after block, with sums of its own; for float32, in the components'
// whitened coordinates.
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
                sum_block(squad, search, tile.in_float32, given, block, upper, listed, n, peak, false, sums,
                          norms);
                continue;
            }
        }
        sum_block(squad, search, tile.in_float64, given, block, upper, listed, n, peak, sizeof(Real) == 4,
                  sums, norms);
    }
}

// Sums in whitened coordinates become those of features.
template <int DIM>
GMM_KERNEL restore_sums(int64_t item, const double* table, int64_t n_padded, double* sums) {
    Whitening<DIM>(table, n_padded, item).restore(sums + item * n_features(DIM));
}

}  // namespace gmm

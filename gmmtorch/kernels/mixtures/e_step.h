// E-step of exact EM.
#pragma once

#include "../lanes.h"

namespace gmm {

constexpr double SKIPPED = 37.0;  // nats below a row's largest term: K e^-37 is below 1e-12 of it

// Features of one row in each lane.
template <int WIDTH, typename Real, typename RowOf>
GMM_INLINE void load_rows(const Real* features, RowOf row_of, vec* x) {
    for (int l = 0; l < LANES; ++l) {
        const Real* given = features + row_of(l) * WIDTH;
        for (int f = 0; f < WIDTH; ++f) set(x[f], l, (double)given[f]);
    }
}

// Calls use(k, a, b, c, d) with the logits of four components from k on, for features x and natural
// parameters: what four components share is loaded once.
template <int WIDTH, typename Use>
GMM_INLINE void each_four_logits(const vec* x, const double* natural, int64_t n_components, Use use) {
    for (int64_t k = 0; k < n_components; k += 4) {
        const double* w = natural + k * WIDTH;
        vec a = x[0] * w[0], b = x[0] * w[WIDTH], c = x[0] * w[2 * WIDTH], d = x[0] * w[3 * WIDTH];
        for (int f = 1; f < WIDTH; ++f) {
            a = fused(x[f], (vec)(w[f]), a);
            b = fused(x[f], (vec)(w[WIDTH + f]), b);
            c = fused(x[f], (vec)(w[2 * WIDTH + f]), c);
            d = fused(x[f], (vec)(w[3 * WIDTH + f]), d);
        }
        use(k, a, b, c, d);
    }
}

// Writes the logits of all components; returns the largest.
template <int WIDTH>
GMM_INLINE vec find_logits(const vec* x, const double* natural, int64_t n_components, vec* logits) {
    vec peak = (vec)(-1e300);
    each_four_logits<WIDTH>(x, natural, n_components, [&](int64_t k, vec a, vec b, vec c, vec d) {
        logits[k] = a, logits[k + 1] = b, logits[k + 2] = c, logits[k + 3] = d;
        a = a > b ? a : b;
        c = c > d ? c : d;
        a = a > c ? a : c;
        peak = a > peak ? a : peak;
    });
    return peak;
}

// An item is a part of the rows, LANES at a time, with sums of its own.
template <int DIM>
GMM_KERNEL e_step(int64_t item, const double* features, int64_t n_rows, const double* natural,
                  int64_t n_components, int64_t n_parts, const double* weight, double* scratch, int64_t* near,
                  double* partial, double* peaks, double* norms) {
    constexpr int WIDTH = n_features(DIM);
    const int64_t begin = n_rows * item / n_parts, stop = n_rows * (item + 1) / n_parts;
    vec* logits = (vec*)(scratch + item * n_components * LANES);
    vec* sums = (vec*)(partial + item * n_components * WIDTH * LANES);
    vec x[WIDTH];
    for (int64_t row = begin; row < stop; row += LANES) {
        const int64_t lane_rows = minimum((int64_t)LANES, stop - row);
        load_rows<WIDTH>(features, [&](int l) { return row + minimum((int64_t)l, lane_rows - 1); }, x);
        const vec peak = find_logits<WIDTH>(x, natural, n_components, logits);
        vec norm = (vec)(0.0), p = (vec)(0.0);
        for (int l = 0; l < lane_rows; ++l) set(p, l, weight[row + l]);
        int64_t n_near = 0;
        for (int64_t k = 0; k < n_components; ++k) {
            const vec under = logits[k] - peak;
            if (!any(under > -SKIPPED)) continue;
            const vec term = under > -SKIPPED ? expo(under) : (vec)(0.0);
            norm += term;
            logits[n_near] = term;  // n_near is at most k
            near[item * n_components + n_near++] = k;
        }
        const vec share = p / norm;
        for (int64_t place = 0; place < n_near; ++place) {
            vec* sum = sums + near[item * n_components + place] * WIDTH;
            const vec gamma = logits[place] * share;
            for (int f = 0; f < WIDTH; ++f) sum[f] = fused(gamma, x[f], sum[f]);
        }
        for (int l = 0; l < lane_rows; ++l) {
            peaks[row + l] = get(peak, l);
            norms[row + l] = get(norm, l);
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
        each_four_logits<WIDTH>(x, natural, n_components, [&](int64_t k, vec a, vec b, vec c, vec d) {
            compare((double)k, a), compare((double)(k + 1), b);
            compare((double)(k + 2), c), compare((double)(k + 3), d);
        });
        for (int l = 0; l < lane_rows; ++l) likeliest[row + l] = (int64_t)get(first, l);
    }
}

// On a GPU, an item of the first kernel is a row, and sums over its components.
template <int DIM>
GMM_KERNEL row_norms(int64_t item, const double* features, int64_t n_rows, const double* natural,
                     int64_t n_components, int64_t n_parts, double* norms, int64_t* likeliest) {
    constexpr int WIDTH = n_features(DIM);
    double x[WIDTH];
    for (int f = 0; f < WIDTH; ++f) x[f] = features[item * WIDTH + f];
    auto logit = [&](int64_t k) {
        const double* w = natural + k * WIDTH;
        double sum = x[0] * w[0];
        for (int f = 1; f < WIDTH; ++f) sum = fma(x[f], w[f], sum);
        return sum;
    };
    double peak = -1e300, norm = 0.0;
    int64_t first = 0;
    for (int64_t k = 0; k < n_components; ++k) {
        const double value = logit(k);
        if (value > peak) peak = value, first = k;
    }
    if (likeliest) {
        likeliest[item] = first;
        return;
    }
    for (int64_t k = 0; k < n_components; ++k) {
        const double under = logit(k) - peak;
        if (under > -SKIPPED) norm += exp(under);
    }
    norms[item] = peak + log(norm);
}

// On a GPU, an item of the second kernel is a component and a part of the rows, over which it sums.
template <int DIM>
GMM_KERNEL component_sums(int64_t item, const double* features, int64_t n_rows, const double* natural,
                          int64_t n_components, int64_t n_parts, const double* weight, const double* norms,
                          double* partial) {
    constexpr int WIDTH = n_features(DIM);
    const int64_t part = item / n_components, k = item % n_components;
    const int64_t begin = n_rows * part / n_parts, stop = n_rows * (part + 1) / n_parts;
    double w[WIDTH], sum[WIDTH];
    for (int f = 0; f < WIDTH; ++f) w[f] = natural[k * WIDTH + f], sum[f] = 0.0;
    for (int64_t row = begin; row < stop; ++row) {
        const double* x = features + row * WIDTH;  // the same for all threads of a warp, but for part
        double under = x[0] * w[0];
        for (int f = 1; f < WIDTH; ++f) under = fma(x[f], w[f], under);
        under -= norms[row];
        if (!(under > -SKIPPED)) continue;
        const double gamma = exp(under) * weight[row];
        for (int f = 0; f < WIDTH; ++f) sum[f] = fma(gamma, x[f], sum[f]);
    }
    for (int f = 0; f < WIDTH; ++f) partial[item * WIDTH + f] = sum[f];
}

}  // namespace gmm

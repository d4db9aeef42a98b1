// Logits of rows and components, for the E-steps of exact and truncated EM.
#pragma once

#include "../lanes.h"

namespace gmm {

constexpr double SKIPPED = 37.0;  // nats below a row's largest term: K e^-37 is below 1e-12 of it

// Calls use(n, a, b, c, d) with the logits of four components from the n-th on, for features x; of(n) gives
// the natural parameters of the n-th component. What four components share is loaded once.
template <int WIDTH, typename Of, typename Use>
GMM_INLINE void each_four_logits(const vec* x, int64_t n_components, Of of, Use use) {
    for (int64_t n = 0; n < n_components; n += 4) {
        const double *u = of(n), *v = of(n + 1), *w = of(n + 2), *z = of(n + 3);
        vec a = x[0] * u[0], b = x[0] * v[0], c = x[0] * w[0], d = x[0] * z[0];
        for (int f = 1; f < WIDTH; ++f) {
            a = fused(x[f], (vec)(u[f]), a);
            b = fused(x[f], (vec)(v[f]), b);
            c = fused(x[f], (vec)(w[f]), c);
            d = fused(x[f], (vec)(z[f]), d);
        }
        use(n, a, b, c, d);
    }
}

// Writes the logits of all components; returns the largest.
template <int WIDTH, typename Of>
GMM_INLINE vec find_logits(const vec* x, int64_t n_components, Of of, vec* logits) {
    vec peak = (vec)(-1e300);
    each_four_logits<WIDTH>(x, n_components, of, [&](int64_t n, vec a, vec b, vec c, vec d) {
        logits[n] = a, logits[n + 1] = b, logits[n + 2] = c, logits[n + 3] = d;
        a = a > b ? a : b;
        c = c > d ? c : d;
        a = a > c ? a : c;
        peak = a > peak ? a : peak;
    });
    return peak;
}

}  // namespace gmm

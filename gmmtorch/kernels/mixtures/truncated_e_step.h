// E-step of truncated EM, and the choice of its candidates. An item is a part of the groups.
#pragma once

#include "e_step.h"

namespace gmm {

template <int DIM, typename Real>
GMM_KERNEL truncated(int64_t item, const Real* features, const Real* weight, const int64_t* begin,
                     const double* centers, int64_t n_groups, int64_t n_components, int64_t n_candidates,
                     int64_t n_padded, int64_t n_parts, const int64_t* candidates, const double* own,
                     const double* means, double* scratch, double* natural, double* statistics, double* value,
                     int64_t* likeliest) {
    constexpr int WIDTH = n_features(DIM);
    const int64_t first_group = n_groups * item / n_parts, last_group = n_groups * (item + 1) / n_parts;
    vec* logits = (vec*)scratch + item * n_padded * (WIDTH + 2);
    vec* sums = logits + n_padded;
    double* out = statistics + item * n_components * WIDTH;
    vec x[WIDTH], total = (vec)(0.0);
    for (int64_t g = first_group; g < last_group; ++g) {
        if (begin[g] == begin[g + 1]) continue;
        const double* center = centers + g * DIM;
        for (int64_t j = 0; j < n_padded; ++j) {
            double* w = natural + (item * n_padded + j) * WIDTH;
            for (int f = 0; f < WIDTH; ++f) w[f] = 0.0;
            w[0] = -1e300;
            if (j >= n_candidates) continue;
            const int64_t k = candidates[g * n_candidates + j];
            const double* given = own + k * WIDTH;
            double offset[DIM], across = 0.0;
            for (int i = 0; i < DIM; ++i) offset[i] = means[k * DIM + i] - center[i];
            int f = 1 + DIM;
            for (int i = 0; i < DIM; ++i)
                for (int n = i; n < DIM; ++n, ++f) {  // -Q_ii/2, and -Q_in for both
                    w[f] = given[f];
                    if (i == n) {
                        w[1 + i] -= 2.0 * given[f] * offset[i];
                    } else {
                        w[1 + i] -= given[f] * offset[n];
                        w[1 + n] -= given[f] * offset[i];
                    }
                }
            for (int i = 0; i < DIM; ++i) across += w[1 + i] * offset[i];
            w[0] = given[0] - 0.5 * across;
        }
        for (int64_t j = 0; j < n_padded * WIDTH; ++j) sums[j] = (vec)(0.0);
        for (int64_t row = begin[g]; row < begin[g + 1]; row += LANES) {
            vec norm = (vec)(0.0), p;
            for (int l = 0; l < LANES; ++l) set(p, l, (double)weight[row + l]);
            if (!likeliest && !any(p > 0.0)) continue;  // slots without rows
            load_rows<WIDTH>(features, [&](int l) { return row + l; }, x);
            const double* first = natural + item * n_padded * WIDTH;
            auto of = [first](int64_t j) { return first + j * WIDTH; };
            const vec peak = find_logits<WIDTH>(x, n_padded, of, logits);
            if (likeliest) {
                vec best = (vec)(0.0);
                for (int64_t j = n_candidates - 1; j >= 0; --j)
                    best = logits[j] == peak ? (vec)((double)j) : best;
                for (int l = 0; l < LANES; ++l)
                    likeliest[row + l] = candidates[g * n_candidates + (int64_t)get(best, l)];
            }
            for (int64_t j = 0; j < n_candidates; ++j) {
                const vec under = logits[j] - peak;
                logits[j] = (vec)(0.0);
                if (!any(under > -SKIPPED)) continue;
                logits[j] = under > -SKIPPED ? expo(under) : (vec)(0.0);
                norm += logits[j];
            }
            const vec share = p / norm;
            for (int64_t j = 0; j < n_candidates; ++j) {
                if (!any(logits[j] > 0.0)) continue;
                const vec gamma = logits[j] * share;
                for (int f = 0; f < WIDTH; ++f) sums[j * WIDTH + f] = fused(gamma, x[f], sums[j * WIDTH + f]);
            }
            total += p * (peak + logarithm(norm));
        }
        for (int64_t j = 0; j < n_candidates; ++j) {  // about the component's mean
            const int64_t k = candidates[g * n_candidates + j];
            double s[WIDTH], shift[DIM];
            for (int f = 0; f < WIDTH; ++f) {
                s[f] = 0.0;
                for (int l = 0; l < LANES; ++l) s[f] += get(sums[j * WIDTH + f], l);
            }
            for (int i = 0; i < DIM; ++i) shift[i] = center[i] - means[k * DIM + i];
            int f = 1 + DIM;
            for (int i = 0; i < DIM; ++i)
                for (int n = i; n < DIM; ++n, ++f)
                    s[f] += s[1 + i] * shift[n] + shift[i] * s[1 + n] + s[0] * shift[i] * shift[n];
            for (int i = 0; i < DIM; ++i) s[1 + i] += s[0] * shift[i];
            for (f = 0; f < WIDTH; ++f) out[k * WIDTH + f] += s[f];
        }
    }
    double sum = 0.0;
    for (int l = 0; l < LANES; ++l) sum += get(total, l);
    value[item] = sum;
}

// A component is compared with the samples of a group only if an upper bound of its logits shows that it can
// be a candidate: log(weight density at the mean) - (distance - radius)^2 / (2 variance), for the ball around
// the samples. The candidates are exact.
template <int DIM, typename Real>
GMM_KERNEL candidates(int64_t item, const Real* features, const Real* weight, const int64_t* begin,
                      const double* centers, int64_t n_groups, int64_t n_components, int64_t n_candidates,
                      int64_t n_padded, int64_t n_parts, const int64_t* slots, int64_t n_samples,
                      const double* natural, const double* bounds, double* scratch, double* scores,
                      int64_t* candidates) {
    constexpr int WIDTH = n_features(DIM);
    const int64_t first_group = n_groups * item / n_parts, last_group = n_groups * (item + 1) / n_parts;
    vec* logits = (vec*)scratch + item * n_padded * 3;
    double *upper = (double*)(logits + n_padded), *best = upper + n_padded;
    int64_t *listed = (int64_t*)(best + n_padded), *found = listed + n_padded;
    double *score = scores + item * n_candidates, reach = 32.0;  // nats below the largest bound
    for (int64_t k = 0; k < n_padded; ++k) best[k] = -HUGE_VAL;
    // Puts x of component k into a row of the largest ones, in which place `worst` is replaced next.
    auto insert = [&](double x, int64_t k, int64_t first, int64_t& n, int64_t& worst, int64_t* names) {
        const int64_t place = n < n_candidates ? n++ : worst;
        if (names) names[place] = k;
        score[place] = x;
        if (n < n_candidates) return;
        worst = first;
        for (int64_t j = first + 1; j < n_candidates; ++j)
            if (score[j] < score[worst] || (names && score[j] == score[worst] && names[j] > names[worst]))
                worst = j;
    };
    vec x[WIDTH];
    for (int64_t g = first_group; g < last_group; ++g) {
        const double* center = centers + g * DIM;
        int64_t n_found = 0;
        for (int64_t sample = 0; sample < n_samples && begin[g] < begin[g + 1]; sample += LANES) {
            const int64_t* of_group = slots + g * n_samples;
            load_rows<WIDTH>(
                features, [&](int l) { return of_group[minimum(sample + l, n_samples - 1)]; }, x);
            vec squared = (vec)(0.0), top = (vec)(-1e300), peak = (vec)(-1e300);
            for (int i = 0; i < DIM; ++i) squared += x[1 + i] * x[1 + i];
            const double radius = sqrt(largest(squared));
            int f = 1 + DIM;
            for (int i = 0; i < DIM; ++i)
                for (int n = i; n < DIM; ++n, ++f)
                    x[f] += x[1 + i] * center[n] + center[i] * x[1 + n] + x[0] * (center[i] * center[n]);
            for (int i = 0; i < DIM; ++i) x[1 + i] += x[0] * center[i];
            for (int64_t k = 0; k < n_padded; k += LANES) {
                const vec* own = (const vec*)(bounds + k);
                vec gap = (vec)(0.0);
                for (int i = 0; i < DIM; ++i) {
                    const vec off = own[i * n_padded / LANES] - center[i];
                    gap += off * off;
                }
                gap = root(gap) - radius;
                gap = (gap > 0.0 ? gap : (vec)(0.0)) * own[(DIM + 1) * n_padded / LANES];
                const vec most = own[DIM * n_padded / LANES] - gap * gap;
                *(vec*)(upper + k) = most;
                top = most > top ? most : top;
            }
            const double most = largest(top);
            double below = HUGE_VAL, from = most - reach;
            int64_t n_listed = 0, n_best = 0, worst = 0;
            while (from < below) {
                for (int64_t k = 0; k < n_padded; k += LANES) {
                    const vec bound = *(const vec*)(upper + k);
                    if (!any((bound >= from) & (bound < below))) continue;
                    for (int l = 0; l < LANES; ++l) {
                        if (!(upper[k + l] >= from && upper[k + l] < below)) continue;
                        const double* w = natural + (k + l) * WIDTH;
                        vec logit = x[0] * w[0];
                        for (int i = 1; i < WIDTH; ++i) logit = fused(x[i], (vec)(w[i]), logit);
                        peak = logit > peak ? logit : peak;
                        logits[n_listed] = logit;
                        listed[n_listed++] = k + l;
                    }
                }
                n_best = worst = 0;
                for (int64_t j = 0; j < n_listed; ++j) {
                    const vec under = logits[j] - peak;
                    if (n_best == n_candidates && !any(under > score[worst])) continue;
                    insert(largest(under), j, 0, n_best, worst, nullptr);
                }
                // No component below `from` is more likely than the worst of the candidates.
                below = from;
                const bool enough = n_best == n_candidates;
                from = enough ? score[worst] - largest(-peak) - 1e-6 : most - 4.0 * (most - from);
                if (n_listed == n_padded) break;
            }
            reach = most - minimum(from, below);
            for (int64_t j = 0; j < n_listed; ++j) {
                double& own = best[listed[j]];
                if (own == -HUGE_VAL) found[n_found++] = listed[j];
                own = maximum(own, largest(logits[j] - peak));
            }
        }
        if (n_found == 0)  // no rows: any candidates
            for (int64_t k = 0; k < n_candidates; ++k) found[n_found++] = k;
        int64_t n_chosen = 1, worst = 0;
        int64_t* chosen = candidates + g * n_candidates;
        chosen[0] = g;
        for (int64_t j = 0; j < n_found; ++j) {
            const int64_t k = found[j];
            if (k != g && n_candidates > 1 && k < n_components) {  // of equal ones, the first is taken
                const bool first = n_chosen == n_candidates && best[k] == score[worst] && k < chosen[worst];
                if (n_chosen < n_candidates || best[k] > score[worst] || first)
                    insert(best[k], k, 1, n_chosen, worst, chosen);
            }
            best[k] = -HUGE_VAL;
        }
    }
}

}  // namespace gmm

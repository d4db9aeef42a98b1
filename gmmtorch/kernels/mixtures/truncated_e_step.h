// Groups of rows: those of one owner, a component, with the components that they are compared with. What
// truncated EM does with them, LANES rows at a time on a CPU, and with a thread for each row, pair or
// component on a GPU.
#pragma once

#include "e_step.h"
#include "m_step.h"

namespace gmm {

// values (N, D) of points, or (N, F) of cells, and weight (N,), in the order of the groups; row: where each
// was. group_of (N,): its group. begin (K + 1,): the first row of each group. candidates (K, m). pairs (K
// m,): the places of the candidates in the order of components, of which each begins at pair_begin (K + 1,).
struct Groups {
    double *values, *weight;
    int64_t *row, *group_of, *begin, *candidates, *pairs, *pair_begin;
};

struct GroupSizes {
    int64_t n_rows;
    bool are_points;
    int64_t n_components;
    int64_t n_candidates;
    int64_t n_samples;
};

// Natural parameters about a center, from those about the component's mean.
template <int DIM>
GMM_INLINE void local_parameters(const double* own, const double* mean, const double* center, double* w) {
    double offset[DIM], across = 0.0;
    for (int i = 0; i < DIM; ++i) offset[i] = mean[i] - center[i], w[1 + i] = 0.0;
    for (int i = 0, f = 1 + DIM; i < DIM; ++i)
        for (int n = i; n < DIM; ++n, ++f) {  // -Q_ii/2, and -Q_in for both
            w[f] = own[f];
            w[1 + i] -= own[f] * offset[n];
            w[1 + n] -= own[f] * offset[i];
        }
    for (int i = 0; i < DIM; ++i) across += w[1 + i] * offset[i];
    w[0] = own[0] - 0.5 * across;
}

// The logit of a row for a component, about its mean.
template <int DIM>
GMM_INLINE double logit_of(bool are_points, const double* given, const double* own, const double* mean,
                           double* x) {
    local_features<DIM>(are_points, given, mean, x);
    double sum = x[0] * own[0];
    for (int f = 1; f < n_features(DIM); ++f) sum = fma(x[f], own[f], sum);
    return sum;
}

template <int DIM>
GMM_INLINE void load_groups(const Groups& groups, bool are_points, int64_t row, int64_t last, vec* given) {
    for (int l = 0; l < LANES; ++l) {
        const int64_t place = minimum(row + l, last);
        if (are_points)
            for (int f = 0; f < DIM; ++f) set(given[f], l, groups.values[place * DIM + f]);
        else
            for (int f = 0; f < n_features(DIM); ++f)
                set(given[f], l, groups.values[place * n_features(DIM) + f]);
    }
}

CUDA_CALLABLE constexpr int64_t padded_candidates(int64_t n) { return (n + 3) / 4 * 4; }

// Adds the statistics (K, F) about the components' means of the groups of an item, and its log-likelihood and
// number of points to the two totals. owner: the most likely candidate of each row, or none.
template <int DIM>
GMM_INLINE void group_sums(int64_t item, int64_t n_items, GroupSizes sizes, Groups groups, const double* own,
                           const double* means, double* scratch, double* statistics, double* totals,
                           int64_t* owner) {
    constexpr int WIDTH = n_features(DIM);
    const int64_t m = sizes.n_candidates, n_padded = padded_candidates(m), n_groups = sizes.n_components;
    vec *logits = (vec*)scratch, *sums = logits + n_padded;
    double* natural = (double*)(sums + n_padded * WIDTH);
    auto of = [natural](int64_t j) { return natural + j * WIDTH; };
    vec given[WIDTH], x[WIDTH], total = (vec)(0.0);
    for (int64_t g = n_groups * item / n_items; g < n_groups * (item + 1) / n_items; ++g) {
        const int64_t stop = groups.begin[g + 1], *candidates = groups.candidates + g * m;
        if (groups.begin[g] == stop) continue;
        const double* center = means + g * DIM;
        for (int64_t j = 0; j < n_padded; ++j) {
            double* w = natural + j * WIDTH;
            if (j < m) {
                local_parameters<DIM>(own + candidates[j] * WIDTH, means + candidates[j] * DIM, center, w);
                continue;
            }
            for (int f = 0; f < WIDTH; ++f) w[f] = f == 0 ? -1e300 : 0.0;
        }
        for (int64_t j = 0; j < n_padded * WIDTH; ++j) sums[j] = (vec)(0.0);
        for (int64_t row = groups.begin[g]; row < stop; row += LANES) {
            const int64_t lane_rows = minimum((int64_t)LANES, stop - row);
            vec norm = (vec)(0.0), p = (vec)(0.0);
            for (int l = 0; l < lane_rows; ++l)
                set(p, l, groups.weight[row + l]), totals[1] += groups.weight[row + l];
            load_groups<DIM>(groups, sizes.are_points, row, stop - 1, given);
            local_features<DIM>(sizes.are_points, given, center, x);
            const vec peak = find_logits<WIDTH>(x, n_padded, of, logits);
            if (owner) {
                vec best = (vec)(0.0);
                for (int64_t j = m - 1; j >= 0; --j) best = logits[j] == peak ? (vec)((double)j) : best;
                for (int l = 0; l < lane_rows; ++l)
                    owner[groups.row[row + l]] = candidates[(int64_t)get(best, l)];
            }
            for (int64_t j = 0; j < m; ++j) {
                const vec under = logits[j] - peak;
                logits[j] = (vec)(0.0);
                if (!any(under > -SKIPPED)) continue;
                logits[j] = under > -SKIPPED ? expo(under) : (vec)(0.0);
                norm += logits[j];
            }
            const vec share = p / norm;
            for (int64_t j = 0; j < m; ++j) {
                if (!any(logits[j] > 0.0)) continue;
                const vec gamma = logits[j] * share;
                for (int f = 0; f < WIDTH; ++f) sums[j * WIDTH + f] = fused(gamma, x[f], sums[j * WIDTH + f]);
            }
            total += p * (peak + logarithm(norm));
        }
        for (int64_t j = 0; j < m; ++j) {
            const int64_t k = candidates[j];
            double s[WIDTH], moved[WIDTH], shift[DIM];
            for (int f = 0; f < WIDTH; ++f) {
                s[f] = 0.0;
                for (int l = 0; l < LANES; ++l) s[f] += get(sums[j * WIDTH + f], l);
            }
            for (int i = 0; i < DIM; ++i) shift[i] = means[k * DIM + i] - center[i];
            local_features<DIM>(false, s, shift, moved);
            for (int f = 0; f < WIDTH; ++f) statistics[k * WIDTH + f] += moved[f];
        }
    }
    for (int l = 0; l < LANES; ++l) totals[0] += get(total, l);
}

// The row of the sample `number` of a group: samples are evenly spaced, because adjacent rows of a scan are
// adjacent in space.
GMM_INLINE int64_t sample_of(const Groups& groups, int64_t g, int64_t number, int64_t n_samples) {
    const int64_t begin = groups.begin[g], count = groups.begin[g + 1] - begin;
    return begin + (2 * number + 1) * count / (2 * n_samples);
}

// What bounds the logits of a component: its mean, the logarithm of weight times density there, and √(1/2v)
// with v = ‖Σ²‖^½, at least the largest variance. limits (D + 2, padded).
template <int DIM>
GMM_INLINE void write_limits(int64_t k, int64_t n_components, int64_t n_padded, const double* own,
                             const double* means, const double* covariances, double* limits) {
    const double* c = covariances + k * DIM * DIM;
    double squares = 0.0;
    for (int i = 0; i < DIM * DIM && k < n_components; ++i) {
        double product = 0.0;
        for (int n = 0; n < DIM; ++n) product += c[i / DIM * DIM + n] * c[n * DIM + i % DIM];
        squares += product * product;
    }
    for (int i = 0; i < DIM; ++i) limits[i * n_padded + k] = k < n_components ? means[k * DIM + i] : 0.0;
    limits[DIM * n_padded + k] = k < n_components ? own[k * n_features(DIM)] : -1e300;
    limits[(DIM + 1) * n_padded + k] = k < n_components ? sqrt(0.5 / sqrt(sqrt(squares))) : 0.0;
}

// Chooses the most likely components for samples of each group of an item; its owner is one. A component is
// compared with samples only if an upper bound of its logits shows that it can be a candidate: log(weight
// density at the mean) - (distance - radius)^2 / (2 variance), for the ball around the samples. The
// candidates are exact.
template <int DIM>
GMM_INLINE void choose_candidates(int64_t item, int64_t n_items, GroupSizes sizes, Groups groups,
                                  int64_t n_padded, const double* own, const double* means,
                                  const double* limits, double* scratch) {
    constexpr int WIDTH = n_features(DIM);
    const int64_t n_groups = sizes.n_components, m = sizes.n_candidates, n_samples = sizes.n_samples;
    vec* logits = (vec*)scratch;
    double *upper = (double*)(logits + n_padded), *best = upper + n_padded;
    int64_t *listed = (int64_t*)(best + n_padded), *found = listed + n_padded;
    double *score = (double*)(found + n_padded), reach = 32.0;  // nats below the largest bound
    for (int64_t k = 0; k < n_padded; ++k) best[k] = -HUGE_VAL;
    // Puts x of component k into a row of the largest ones, in which place `worst` is replaced next.
    auto insert = [&](double x, int64_t k, int64_t first, int64_t& n, int64_t& worst, int64_t* names) {
        const int64_t place = n < m ? n++ : worst;
        if (names) names[place] = k;
        score[place] = x;
        if (n < m) return;
        worst = first;
        for (int64_t j = first + 1; j < m; ++j)
            if (score[j] < score[worst] || (names && score[j] == score[worst] && names[j] > names[worst]))
                worst = j;
    };
    vec given[WIDTH], x[WIDTH];
    for (int64_t g = n_groups * item / n_items; g < n_groups * (item + 1) / n_items; ++g) {
        const double* center = means + g * DIM;
        int64_t n_found = 0;
        for (int64_t sample = 0; sample < n_samples && groups.begin[g] < groups.begin[g + 1];
             sample += LANES) {
            for (int l = 0; l < LANES; ++l) {
                const int64_t row = sample_of(groups, g, minimum(sample + l, n_samples - 1), n_samples);
                const int64_t width = sizes.are_points ? DIM : WIDTH;
                for (int64_t f = 0; f < width; ++f) set(given[f], l, groups.values[row * width + f]);
            }
            local_features<DIM>(sizes.are_points, given, center, x);
            vec squared = (vec)(0.0), top = (vec)(-1e300), peak = (vec)(-1e300);
            for (int i = 0; i < DIM; ++i) squared += x[1 + i] * x[1 + i];
            const double radius = sqrt(largest(squared));
            for (int64_t k = 0; k < n_padded; k += LANES) {
                const vec* of = (const vec*)(limits + k);
                vec gap = (vec)(0.0);
                for (int i = 0; i < DIM; ++i) {
                    const vec off = of[i * n_padded / LANES] - center[i];
                    gap += off * off;
                }
                gap = root(gap) - radius;
                gap = (gap > 0.0 ? gap : (vec)(0.0)) * of[(DIM + 1) * n_padded / LANES];
                const vec most = of[DIM * n_padded / LANES] - gap * gap;
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
                        vec logit = (vec)(-1e300);
                        if (k + l < n_groups) {
                            double w[WIDTH];
                            local_parameters<DIM>(own + (k + l) * WIDTH, means + (k + l) * DIM, center, w);
                            logit = x[0] * w[0];
                            for (int i = 1; i < WIDTH; ++i) logit = fused(x[i], (vec)(w[i]), logit);
                        }
                        peak = logit > peak ? logit : peak;
                        logits[n_listed] = logit;
                        listed[n_listed++] = k + l;
                    }
                }
                n_best = worst = 0;
                for (int64_t j = 0; j < n_listed; ++j) {
                    const vec under = logits[j] - peak;
                    if (n_best == m && !any(under > score[worst])) continue;
                    insert(largest(under), j, 0, n_best, worst, nullptr);
                }
                // No component below `from` is more likely than the worst of the candidates.
                below = from;
                const bool enough = n_best == m;
                from = enough ? score[worst] - largest(-peak) - 1e-6 : most - 4.0 * (most - from);
                if (n_listed == n_padded) break;
            }
            reach = most - minimum(from, below);
            for (int64_t j = 0; j < n_listed; ++j) {
                double& so_far = best[listed[j]];
                if (so_far == -HUGE_VAL) found[n_found++] = listed[j];
                so_far = maximum(so_far, largest(logits[j] - peak));
            }
        }
        if (n_found == 0)  // no rows: any candidates
            for (int64_t k = 0; k < m; ++k) found[n_found++] = k;
        int64_t n_chosen = 1, worst = 0, *chosen = groups.candidates + g * m;
        chosen[0] = g;
        for (int64_t j = 0; j < n_found; ++j) {
            const int64_t k = found[j];
            if (k != g && m > 1 && k < n_groups) {  // of equal ones, the first is taken
                const bool first = n_chosen == m && best[k] == score[worst] && k < chosen[worst];
                if (n_chosen < m || best[k] > score[worst] || first)
                    insert(best[k], k, 1, n_chosen, worst, chosen);
            }
            best[k] = -HUGE_VAL;
        }
    }
}

// -- on a GPU -------------------------------------------------------------------------------------

// The sum of exponentials, relative to the largest one.
struct LogSum {
    double peak = -HUGE_VAL, norm = 0.0;

    GMM_INLINE bool add(double logit) {
        const double above = logit - peak;
        if (!(above > -SKIPPED)) return false;
        const double term = exp(above > 0.0 ? -above : above);
        norm = above > 0.0 ? norm * term + 1.0 : norm + term;
        peak = above > 0.0 ? logit : peak;
        return above > 0.0;
    }
};

// Of a row, the logarithm of the sum over its group's candidates. owner: gets the most likely one, unless
// null.
template <int DIM>
GMM_INLINE double row_norm(int64_t row, GroupSizes sizes, Groups groups, const double* own,
                           const double* means, int64_t* owner) {
    constexpr int WIDTH = n_features(DIM);
    const double* given = groups.values + row * (sizes.are_points ? DIM : WIDTH);
    const int64_t* candidates = groups.candidates + groups.group_of[row] * sizes.n_candidates;
    double x[WIDTH];
    LogSum sum;
    int64_t best = candidates[0];
    for (int64_t j = 0; j < sizes.n_candidates; ++j) {
        const int64_t k = candidates[j];
        if (sum.add(logit_of<DIM>(sizes.are_points, given, own + k * WIDTH, means + k * DIM, x))) best = k;
    }
    if (owner) owner[groups.row[row]] = best;
    return sum.peak + log(sum.norm);
}

// The statistics of a pair of group and candidate, about the candidate's mean.
template <int DIM>
GMM_INLINE void pair_sums(int64_t pair, GroupSizes sizes, Groups groups, const double* own,
                          const double* means, const double* norms, double* sums) {
    constexpr int WIDTH = n_features(DIM);
    const int64_t g = pair / sizes.n_candidates, k = groups.candidates[pair];
    double s[WIDTH], x[WIDTH];
    for (int f = 0; f < WIDTH; ++f) s[f] = 0.0;
    for (int64_t row = groups.begin[g]; row < groups.begin[g + 1]; ++row) {
        const double* given = groups.values + row * (sizes.are_points ? DIM : WIDTH);
        const double logit = logit_of<DIM>(sizes.are_points, given, own + k * WIDTH, means + k * DIM, x);
        const double under = logit - norms[row];
        if (!(under > -SKIPPED)) continue;
        const double gamma = exp(under) * groups.weight[row];
        for (int f = 0; f < WIDTH; ++f) s[f] = fma(gamma, x[f], s[f]);
    }
    for (int f = 0; f < WIDTH; ++f) sums[pair * WIDTH + f] = s[f];
}

// A short list of the largest scores and what has them; of equal ones, the first.
struct Best {
    double *scores, *names;
    int64_t most, n, worst;

    GMM_INLINE void replace(int64_t place, double score, double name) {
        scores[place] = score, names[place] = name;
        if (n < most) return;
        worst = 0;
        for (int64_t j = 1; j < most; ++j)
            if (scores[j] < scores[worst] || (scores[j] == scores[worst] && names[j] > names[worst]))
                worst = j;
    }
    GMM_INLINE void add(double score, double name) {
        if (n < most)
            n += 1, replace(n - 1, score, name);
        else if (score > scores[worst] || (score == scores[worst] && name < names[worst]))
            replace(worst, score, name);
    }
};

// The most likely components of one sample of a group, and how far below the likeliest they are.
template <int DIM>
GMM_INLINE void choose_for_sample(int64_t place, GroupSizes sizes, Groups groups, const double* own,
                                  const double* means, double* scores, double* names) {
    constexpr int WIDTH = n_features(DIM);
    const int64_t g = place / sizes.n_samples, m = sizes.n_candidates;
    if (groups.begin[g] == groups.begin[g + 1]) return;
    const int64_t row = sample_of(groups, g, place % sizes.n_samples, sizes.n_samples);
    const double* given = groups.values + row * (sizes.are_points ? DIM : WIDTH);
    Best best = {scores + place * m, names + place * m, m, 0, 0};
    double x[WIDTH], peak = -HUGE_VAL;
    for (int64_t k = 0; k < sizes.n_components; ++k) {
        const double logit = logit_of<DIM>(sizes.are_points, given, own + k * WIDTH, means + k * DIM, x);
        peak = maximum(peak, logit);
        best.add(logit, (double)k);
    }
    for (int64_t j = 0; j < m; ++j) best.scores[j] -= peak;
}

// The candidates of a group, from the lists of its samples. The owner is the first.
GMM_INLINE void merge_choices(int64_t g, GroupSizes sizes, Groups groups, const double* scores,
                              const double* names, double* scratch) {
    const int64_t m = sizes.n_candidates, n = groups.begin[g] < groups.begin[g + 1] ? sizes.n_samples * m : 0;
    int64_t* chosen = groups.candidates + g * m;
    Best best = {scratch + 2 * g * m, scratch + (2 * g + 1) * m, m - 1, 0, 0};
    for (int64_t i = g * sizes.n_samples * m; i < g * sizes.n_samples * m + n && m > 1; ++i) {
        int64_t known = 0;
        while (known < best.n && best.names[known] != names[i]) known += 1;
        if (names[i] == (double)g) continue;
        if (known == best.n)
            best.add(scores[i], names[i]);
        else if (scores[i] > best.scores[known])
            best.replace(known, scores[i], names[i]);
    }
    chosen[0] = g;
    for (int64_t j = 1; j < m; ++j)  // without rows, any candidates
        chosen[j] = n ? (int64_t)best.names[j - 1] : j - (j <= g);
}

}  // namespace gmm

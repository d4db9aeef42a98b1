// Whole runs of EM, in phases. In each phase a worker takes every n-th piece of the work; the workers meet
// after each, and all of them decide in the same way which phase is next. `wide`: LANES rows at a time, on a
// CPU.
#pragma once

#include "exact_e_step.h"
#include "truncated_e_step.h"

namespace gmm {

constexpr int64_t MERGED =
    256;  // numbers that the sums of all workers are merged into, before they are added

// The sum of every step-th number, in four chains, so that additions overlap.
GMM_INLINE double sum_of_every(const double* numbers, int64_t begin, int64_t stop, int64_t step) {
    double a = 0.0, b = 0.0, c = 0.0, d = 0.0;
    int64_t i = begin;
    for (; i + 3 * step < stop; i += 4 * step) {
        a += numbers[i], b += numbers[i + step];
        c += numbers[i + 2 * step], d += numbers[i + 3 * step];
    }
    for (; i < stop; i += step) a += numbers[i];
    return (a + b) + (c + d);
}

// The sum of the numbers of listed pairs.
GMM_INLINE double sum_of_pairs(const double* numbers, int64_t width, const int64_t* pairs, int64_t begin,
                               int64_t stop) {
    double a = 0.0, b = 0.0, c = 0.0, d = 0.0;
    int64_t i = begin;
    for (; i + 3 < stop; i += 4) {
        a += numbers[pairs[i] * width], b += numbers[pairs[i + 1] * width];
        c += numbers[pairs[i + 2] * width], d += numbers[pairs[i + 3] * width];
    }
    for (; i < stop; ++i) a += numbers[pairs[i] * width];
    return (a + b) + (c + d);
}

// Sums over all workers' shares of the rows, and over the components.
struct WorkerSums {
    double* own;     // (2, n): the log-likelihood and the number of points of each worker
    double* merged;  // (2, MERGED) of the same
    double* totals;  // (4, PARTS), see merge_masses
};

GMM_INLINE void merge(WorkerSums sums, int64_t item, int64_t n) {
    for (int64_t i = item; i < 2 * MERGED; i += n)
        sums.merged[i] = sum_of_every(sums.own + i / MERGED * n, i % MERGED, n, MERGED);
}

// In two steps, the masses of EM's own step and of the extrapolated one; and what the components whose
// extrapolation is trusted have of the latter, and the others of the former. masses (2, K), merged (4,
// PARTS).
constexpr int64_t PARTS = 64;

GMM_INLINE void merge_masses(const double* masses, const bool* trusted, int64_t n_components, int64_t item,
                             int64_t n, double* merged) {
    for (int64_t i = item; i < (trusted ? 4 : 1) * PARTS; i += n) {
        const int64_t which = i / PARTS;
        const double* own = masses + (which == 1 || which == 2) * n_components;
        double sum = 0.0;
        for (int64_t k = i % PARTS; k < n_components; k += PARTS)
            if (which < 2 || trusted[k] == (which == 2)) sum += own[k];
        merged[i] = sum;
    }
}

GMM_INLINE double merged_mass(const double* merged, int64_t which) {
    return sum_of_every(merged, which * PARTS, (which + 1) * PARTS, 1);
}

// A mixture in memory: weights, means and covariances, one after the other.
template <int DIM>
struct Mixture {
    double *weights, *means, *covariances;
    GMM_INLINE Mixture(double* tables, int64_t n, int64_t which)
        : weights(tables + which * n * (1 + DIM + DIM * DIM)), means(weights + n),
          covariances(means + n * DIM) {}
};

enum State : int64_t { RUNNING, ENDED, IMPOSSIBLE, PAUSED };

// On a GPU, of a row of features, the logarithm of the sum over all components.
template <int WIDTH>
GMM_INLINE double norm_of_row(const double* row, const double* natural, int64_t n_components) {
    double x[WIDTH];
    LogSum sum;
    for (int f = 0; f < WIDTH; ++f) x[f] = row[f];
    for (int64_t k = 0; k < n_components; ++k) {
        const double* w = natural + k * WIDTH;
        double logit = x[0] * w[0];
        for (int f = 1; f < WIDTH; ++f) logit = fma(x[f], w[f], logit);
        sum.add(logit);
    }
    return sum.peak + log(sum.norm);
}

// On a GPU, the statistics of a component over some rows.
template <int WIDTH>
GMM_INLINE void sums_of_rows(const double* features, const double* weight, const double* norms, int64_t begin,
                             int64_t stop, const double* natural, double* sums) {
    double w[WIDTH], sum[WIDTH];
    for (int f = 0; f < WIDTH; ++f) w[f] = natural[f], sum[f] = 0.0;
    for (int64_t row = begin; row < stop; ++row) {
        const double* x = features + row * WIDTH;  // the same for most threads of a warp
        double under = x[0] * w[0];
        for (int f = 1; f < WIDTH; ++f) under = fma(x[f], w[f], under);
        under -= norms[row];
        if (!(under > -SKIPPED)) continue;
        const double gamma = exp(under) * weight[row];
        for (int f = 0; f < WIDTH; ++f) sum[f] = fma(gamma, x[f], sum[f]);
    }
    for (int f = 0; f < WIDTH; ++f) sums[f] = sum[f];
}

struct ExactTables {
    double* mixtures;  // the present one and the next, in turns
    double* masses;
    double* natural;
    double* table;       // of a wide E-step that lists near components, or null
    double* statistics;  // and the two sums over all rows
    double* partial;     // statistics of each part of the rows
    double* norms;       // and peaks, if wide
    double* scratch;
    int64_t* near;
    bool* lost;
};

// Exact EM on rows of features. state IMPOSSIBLE: a covariance is not positive definite, or, if it is
// guarded, the natural parameters or the statistics lose digits; the mixture is the one before this
// iteration.
//
// Progress is read from `before` and written to `after`: phase, iterations, state, which mixture is the
// present one, whether an M-step made it, and its bound.
template <int DIM, bool WIDE>
GMM_KERNEL exact_em(int64_t item, Team team, const double* features, const double* weight, int64_t n_rows,
                    int64_t n_components, int64_t n_padded, int64_t n_parts, double reg_covar, double tol,
                    double last_bound, int64_t n_iter, bool guarded, int64_t n_phases, const double* before,
                    double* after, double* bounds, ExactTables t, WorkerSums sums) {
    constexpr int WIDTH = n_features(DIM);
    constexpr double EPS = 2.220446049250313e-16, LOST = 1e-6;
    enum Phase : int64_t { NATURAL, TABLE, ROWS, SUMS, GATHER, MAXIMIZE, MASSES, FINISH };
    int64_t phase = (int64_t)before[0], n_done = (int64_t)before[1], state = (int64_t)before[2];
    int64_t which = (int64_t)before[3], is_made = (int64_t)before[4];
    bool is_last = before[6] != 0.0;
    double last = n_done ? before[5] : last_bound;
    const int64_t n = team.n, k_all = n_components;
    double* total = t.statistics + k_all * WIDTH;
    for (int64_t left = n_phases; left > 0 && state == RUNNING; --left) {
        Mixture<DIM> now(t.mixtures, k_all, which), next(t.mixtures, k_all, 1 - which);
        if ((phase == NATURAL || phase == FINISH) && item < n_padded) {
            const double mass = is_made ? merged_mass(sums.totals, 0) : 1.0;
            for (int64_t k = item; k < n_padded; k += n) {
                double* w = t.natural + k * WIDTH;
                if (k >= k_all) {
                    w[0] = -1e300;
                    continue;
                }
                if (is_made) now.weights[k] = t.masses[k] / mass;
                if (phase == FINISH) continue;
                natural_parameters<DIM>(k, now.weights, now.means, now.covariances, t.natural, t.lost);
                double size = 0.0;
                for (int i = 0; i < DIM; ++i) size += w[1 + i] * now.means[k * DIM + i];
                if (guarded && now.weights[k] > 0.0 && size * EPS > LOST) *t.lost = true;
            }
        }
        if (phase == ROWS) {
            double value = 0.0, points = 0.0;
            if (WIDE) {
                const int64_t n_sums = k_all * WIDTH * LANES, begin = n_rows * item / n_parts;
                const int64_t stop = n_rows * (item + 1) / n_parts;
                double *own = t.partial + item * n_padded * WIDTH * LANES, *peaks = t.norms + n_rows;
                for (int64_t i = 0; i < n_sums; ++i) own[i] = 0.0;
                const Given given = {features, weight, n_rows, t.natural, t.table, k_all, n_padded, n_parts};
                e_step<DIM>(item, given, t.scratch, t.near, t.partial, peaks, t.norms);
                vec both = (vec)(0.0);
                for (int64_t row = begin; row < stop; row += LANES) {
                    vec peak = (vec)(0.0), norm = (vec)(1.0), p = (vec)(0.0);
                    for (int l = 0; l < LANES && row + l < stop; ++l) {
                        set(peak, l, peaks[row + l]), set(norm, l, t.norms[row + l]);
                        set(p, l, weight[row + l]);
                        points += weight[row + l];
                    }
                    both += p * (peak + logarithm(norm));
                }
                for (int l = 0; l < LANES; ++l) value += get(both, l);
            } else {
                for (int64_t row = item; row < n_rows; row += n) {
                    t.norms[row] = norm_of_row<WIDTH>(features + row * WIDTH, t.natural, k_all);
                    value += weight[row] * t.norms[row];
                    points += weight[row];
                }
            }
            sums.own[item] = value, sums.own[n + item] = points;
        }
        if (phase == SUMS) {
            merge(sums, item, n);
            for (int64_t i = item; i < n_parts * k_all && !WIDE; i += n)
                sums_of_rows<WIDTH>(features, weight, t.norms, n_rows * (i / k_all) / n_parts,
                                    n_rows * (i / k_all + 1) / n_parts, t.natural + i % k_all * WIDTH,
                                    t.partial + i * WIDTH);
        }
        if (phase == GATHER) {
            for (int64_t i = item; i < k_all * WIDTH; i += n) {
                double sum = 0.0;
                if (WIDE)
                    for (int64_t part = 0; part < n_parts; ++part)
                        for (int l = 0; l < LANES; ++l)
                            sum += t.partial[(part * n_padded * WIDTH + i) * LANES + l];
                else
                    sum = sum_of_every(t.partial, i, n_parts * k_all * WIDTH, k_all * WIDTH);
                t.statistics[i] = sum;
            }
            for (int64_t i = item; i < 2; i += n)
                total[i] = sum_of_every(sums.merged + i * MERGED, 0, MERGED, 1);
        }
        if (phase == MAXIMIZE)
            for (int64_t k = item; k < k_all; k += n) {
                const double *s = t.statistics + k * WIDTH, *covariance = next.covariances + k * DIM * DIM;
                m_step<DIM>(k, t.statistics, now.means, now.covariances, false, reg_covar, nullptr, nullptr,
                            0.0, t.masses, next.means, next.covariances, nullptr, nullptr, nullptr, nullptr);
                if (!guarded || !(t.masses[k] > 0.0)) continue;
                double second = 0.0;
                for (int f = 1; f < WIDTH; ++f) second = maximum(second, fabs(s[f]));
                second /= maximum(s[0], 1e-300);
                if (EPS * second > LOST * least_eigenvalue<DIM>(covariance)) *t.lost = true;
            }
        if (phase == MASSES) merge_masses(t.masses, nullptr, k_all, item, n, sums.totals);
        if (phase == TABLE)
            for (int64_t k = item; k < n_padded && WIDE && t.table; k += n)
                component_table<DIM>(k, t.natural, k_all, n_padded, t.table);
        meet(team);
        if ((phase == NATURAL || phase == MAXIMIZE) && *t.lost) {
            state = IMPOSSIBLE;
        } else if (phase == FINISH) {
            state = ENDED;
        } else if (phase == MAXIMIZE) {
            const double bound = total[0] / total[1];
            is_last = fabs(bound - last) < tol || n_done + 1 == n_iter;
            if (item == 0) bounds[n_done] = bound;
            last = bound, n_done += 1, which = 1 - which, is_made = 1, phase = MASSES;
        } else if (phase == MASSES) {
            phase = is_last ? FINISH : NATURAL;
        } else if (phase == NATURAL && !WIDE) {
            phase = ROWS;
        } else {
            phase += 1;
        }
    }
    if (item < n - 1) return;
    const double progress[7] = {(double)phase,   (double)n_done, (double)state,  (double)which,
                                (double)is_made, last,           (double)is_last};
    for (int i = 0; i < 7; ++i) after[i] = progress[i];
}

// A stable sort of n keys below n_bins, in four phases: counts of each part of the keys, the first place of
// each part in a bin, the first place of each bin, and the places.
struct Sort {
    const int64_t* keys;
    int64_t n, n_bins, n_parts;
    int64_t *counts, *begin;

    GMM_INLINE void count(int64_t item, int64_t n_items) {
        for (int64_t part = item; part < n_parts; part += n_items) {
            int64_t* own = counts + part * n_bins;
            for (int64_t bin = 0; bin < n_bins; ++bin) own[bin] = 0;
            for (int64_t i = n * part / n_parts; i < n * (part + 1) / n_parts; ++i) own[keys[i]] += 1;
        }
    }
    GMM_INLINE void offset(int64_t item, int64_t n_items) {
        int64_t* totals = counts + n_parts * n_bins;
        for (int64_t bin = item; bin < n_bins; bin += n_items) {
            int64_t before = 0;
            for (int64_t part = 0; part < n_parts; ++part) {
                const int64_t own = counts[part * n_bins + bin];
                counts[part * n_bins + bin] = before;
                before += own;
            }
            totals[bin] = before;
        }
    }
    GMM_INLINE void add(int64_t item, int64_t n_items) {
        const int64_t *totals = counts + n_parts * n_bins, stop = n_bins * (item + 1) / n_items;
        int64_t bin = n_bins * item / n_items, before = 0;
        if (bin == stop) return;
        for (int64_t i = 0; i < bin; ++i) before += totals[i];
        for (; bin < stop; before += totals[bin++]) begin[bin] = before;
        if (stop == n_bins) begin[n_bins] = before;
    }
    template <typename Use>
    GMM_INLINE void place(int64_t item, int64_t n_items, Use use) {
        for (int64_t part = item; part < n_parts; part += n_items)
            for (int64_t i = n * part / n_parts; i < n * (part + 1) / n_parts; ++i)
                use(i, begin[keys[i]] + counts[part * n_bins + keys[i]]++);
    }
};

struct TruncatedTables {
    double* mixtures;    // the present one, that of EM's own step, and the extrapolated one
    double* masses;      // of the last two
    double* natural;     // about the means
    double* statistics;  // about the means, and the two sums over all rows
    double* last;        // statistics of the step before, and the means that they are about
    double* partial;     // statistics of each worker, if wide; of each pair of group and candidate
    double* norms;       // of each row, if not wide
    double* limits;      // of the logits, if wide
    double* scratch;
    bool* flags;      // of each component, whether its extrapolation is trusted; and whether a step failed
    int64_t* owner;   // of each row
    int64_t* counts;  // of the sorts
    double* values;   // of two sets of groups, rows and weights
    int64_t* places;  // the rest of two sets of groups
};

// Truncated EM with its momentum; see `mixture.em.truncated`. state IMPOSSIBLE: a covariance is not positive
// definite, and natural parameters must be given before the next launch; PAUSED: after n_stop iterations,
// or, if it shares its rows with others, after each E-step.
template <int DIM, bool WIDE>
GMM_KERNEL truncated_em(int64_t item, Team team, const double* rows, const double* weight,
                        const int64_t* first_owner, const int64_t* first_candidates, GroupSizes sizes,
                        int64_t n_parts, double reg_covar, double tol, double previous_bound, int64_t n_iter,
                        int64_t n_bounds, int64_t n_stop, bool is_shared, int64_t n_phases,
                        const double* before, double* after, double* bounds, TruncatedTables t,
                        WorkerSums sums) {
    constexpr int WIDTH = n_features(DIM);
    enum Phase : int64_t {
        NATURAL,
        COUNT,
        OFFSET,
        ADD,
        PLACE,
        CHOOSE,
        MERGE,
        PAIR_COUNT,
        PAIR_OFFSET,
        PAIR_ADD,
        PAIR_PLACE,
        ROWS,
        SUMS,
        GATHER,
        DECIDE,
        MAXIMIZE,
        MASSES,
        FINISH
    };
    const int64_t n = team.n, n_rows = sizes.n_rows, k_all = sizes.n_components, m = sizes.n_candidates;
    const int64_t width = sizes.are_points ? DIM : WIDTH, padded = (k_all + LANES - 1) / LANES * LANES;
    int64_t phase = (int64_t)before[0], n_done = (int64_t)before[1], state = RUNNING;
    int64_t trying = (int64_t)before[3], accepted = (int64_t)before[4], n_sets = (int64_t)before[5];
    int64_t left = (int64_t)before[6], age = (int64_t)before[7];  // of these groups; of the momentum
    bool frozen = before[8] != 0.0, has_last = before[9] != 0.0, is_ahead = before[10] != 0.0;
    bool undo = before[11] != 0.0, is_made = before[12] != 0.0, converged = before[14] != 0.0;
    double last = n_done ? before[13] : previous_bound;
    double *total = t.statistics + k_all * WIDTH, *last_means = t.last + k_all * WIDTH;
    const Mixture<DIM> now(t.mixtures, k_all, 0), em(t.mixtures, k_all, 1), ahead(t.mixtures, k_all, 2);
    bool* failed = t.flags + k_all;
    auto set_of = [&](int64_t which) {
        Groups set;
        set.values = t.values + which * n_rows * (width + 1);
        set.weight = set.values + n_rows * width;
        set.row = t.places + which * (2 * n_rows + 2 * (k_all + 1) + 2 * k_all * m);
        set.group_of = set.row + n_rows;
        set.begin = set.group_of + n_rows;
        set.candidates = set.begin + k_all + 1;
        set.pairs = set.candidates + k_all * m;
        set.pair_begin = set.pairs + k_all * m;
        return set;
    };
    auto step_back = [&]() { undo = true, is_ahead = has_last = false, age = 0; };
    for (int64_t more = n_phases; more > 0 && state == RUNNING; --more) {
        const Groups set = set_of(trying);
        Sort by_owner = {n_sets > 1 ? t.owner : first_owner, n_rows, k_all, n_parts, t.counts, set.begin};
        Sort by_component = {set.candidates, k_all * m, k_all, n_parts, t.counts, set.pair_begin};
        if ((phase == NATURAL || phase == FINISH) && item < k_all) {
            const double em_mass = is_made ? merged_mass(sums.totals, 0) : 1.0;
            const double mass = is_ahead ? merged_mass(sums.totals, 1) : 1.0;
            const double whole = merged_mass(sums.totals, 2) / mass + merged_mass(sums.totals, 3) / em_mass;
            for (int64_t k = item; k < k_all; k += n) {
                const bool from_em = phase == NATURAL && undo, to_em = phase == FINISH && !is_made;
                for (int i = 0; i < DIM && (from_em || to_em); ++i)
                    (from_em ? now : em).means[k * DIM + i] = (from_em ? em : now).means[k * DIM + i];
                for (int i = 0; i < DIM * DIM && (from_em || to_em); ++i)
                    (from_em ? now : em).covariances[k * DIM * DIM + i] =
                        (from_em ? em : now).covariances[k * DIM * DIM + i];
                if (phase == FINISH) {
                    em.weights[k] = is_made ? t.masses[k] / em_mass : now.weights[k];
                    continue;
                }
                if (is_made) now.weights[k] = t.masses[k] / em_mass;
                if (is_ahead)
                    now.weights[k] = (t.flags[k] ? t.masses[k_all + k] / mass : now.weights[k]) / whole;
                natural_parameters<DIM>(k, now.weights, nullptr, now.covariances, t.natural, failed);
            }
        }
        if (phase == FINISH)
            for (int64_t g = item; g < k_all; g += n)
                for (int64_t i = set_of(accepted).begin[g]; i < set_of(accepted).begin[g + 1]; ++i)
                    t.owner[set_of(accepted).row[i]] = g;
        if (phase == COUNT) {
            by_owner.count(item, n);
            for (int64_t k = item; k < padded && WIDE; k += n)
                write_limits<DIM>(k, k_all, padded, t.natural, now.means, now.covariances, t.limits);
        }
        if (phase == OFFSET) by_owner.offset(item, n);
        if (phase == ADD) by_owner.add(item, n);
        if (phase == PLACE)
            by_owner.place(item, n, [&](int64_t row, int64_t place) {
                for (int64_t f = 0; f < width; ++f) set.values[place * width + f] = rows[row * width + f];
                set.weight[place] = weight[row], set.row[place] = row;
                if (!WIDE) set.group_of[place] = by_owner.keys[row];
            });
        const int64_t n_choices = k_all * sizes.n_samples * m;
        const bool is_given = k_all == m || (n_sets == 1 && first_candidates);
        if (phase == CHOOSE && is_given) {
            for (int64_t i = item; i < k_all * m; i += n)
                set.candidates[i] = n_sets == 1 && first_candidates ? first_candidates[i] : i % m;
        } else if (phase == CHOOSE && WIDE) {
            choose_candidates<DIM>(item, n, sizes, set, padded, t.natural, now.means, t.limits, t.scratch);
        } else if (phase == CHOOSE) {
            for (int64_t i = item; i < k_all * sizes.n_samples; i += n)
                choose_for_sample<DIM>(i, sizes, set, t.natural, now.means, t.scratch, t.scratch + n_choices);
        }
        if (phase == MERGE && !is_given)
            for (int64_t g = item; g < k_all; g += n)
                merge_choices(g, sizes, set, t.scratch, t.scratch + n_choices, t.scratch + 2 * n_choices);
        if (phase == PAIR_COUNT) by_component.count(item, n);
        if (phase == PAIR_OFFSET) by_component.offset(item, n);
        if (phase == PAIR_ADD) by_component.add(item, n);
        if (phase == PAIR_PLACE)
            by_component.place(item, n, [&](int64_t pair, int64_t place) { set.pairs[place] = pair; });
        if (phase == ROWS) {
            double found[2] = {0.0, 0.0}, *own = t.partial + item * k_all * WIDTH;
            int64_t* owner = left == 1 && !frozen ? t.owner : nullptr;
            for (int64_t i = 0; i < k_all * WIDTH && WIDE; ++i) own[i] = 0.0;
            if (WIDE)
                group_sums<DIM>(item, n, sizes, set, t.natural, now.means, t.scratch, own, found, owner);
            for (int64_t row = item; row < n_rows && !WIDE; row += n) {
                t.norms[row] = row_norm<DIM>(row, sizes, set, t.natural, now.means, owner);
                found[0] += set.weight[row] * t.norms[row];
                found[1] += set.weight[row];
            }
            sums.own[item] = found[0], sums.own[n + item] = found[1];
        }
        if (phase == SUMS) {
            merge(sums, item, n);
            for (int64_t pair = item; pair < k_all * m && !WIDE; pair += n)
                pair_sums<DIM>(pair, sizes, set, t.natural, now.means, t.norms, t.partial);
        }
        if (phase == GATHER) {
            for (int64_t i = item; i < k_all * WIDTH; i += n) {
                double sum = 0.0;
                const int64_t k = i / WIDTH, f = i % WIDTH;
                for (int64_t part = 0; part < n && WIDE; ++part) sum += t.partial[part * k_all * WIDTH + i];
                if (!WIDE)
                    sum = sum_of_pairs(t.partial + f, WIDTH, set.pairs, set.pair_begin[k],
                                       set.pair_begin[k + 1]);
                t.statistics[i] = sum;
            }
            for (int64_t i = item; i < 2; i += n)
                total[i] = sum_of_every(sums.merged + i * MERGED, 0, MERGED, 1);
        }
        const double share = has_last ? (double)age / (double)(age + 3) : 0.0;
        if (phase == MAXIMIZE)
            for (int64_t k = item; k < k_all; k += n) {
                m_step<DIM>(k, t.statistics, now.means, now.covariances, true, reg_covar,
                            share > 0.0 ? t.last : nullptr, last_means, share, t.masses, em.means,
                            em.covariances, t.masses + k_all, ahead.means, ahead.covariances, t.flags);
                const Mixture<DIM>& next = share > 0.0 ? ahead : em;
                for (int f = 0; f < WIDTH; ++f) t.last[k * WIDTH + f] = t.statistics[k * WIDTH + f];
                for (int i = 0; i < DIM; ++i) last_means[k * DIM + i] = now.means[k * DIM + i];
                for (int i = 0; i < DIM; ++i) now.means[k * DIM + i] = next.means[k * DIM + i];
                for (int i = k * DIM * DIM; i < (k + 1) * DIM * DIM; ++i)
                    now.covariances[i] = next.covariances[i];
            }
        if (phase == MASSES) merge_masses(t.masses, t.flags, k_all, item, n, sums.totals);
        if (phase != DECIDE) meet(team);
        const double bound = total[0] / total[1];
        if (phase == NATURAL) {
            undo = false;
            phase = ROWS;
            if (left == 0 && !frozen) {
                trying = n_sets ? 1 - accepted : 0;
                left = n_sets < 5 ? 2 + (n_sets > 0) + (n_sets > 2) : 8;
                n_sets += 1, phase = COUNT;
            }
            if (*failed) state = IMPOSSIBLE;
        } else if (phase == (WIDE ? CHOOSE : PAIR_PLACE)) {
            phase = n_iter ? ROWS : FINISH;
        } else if (phase == GATHER) {
            phase = DECIDE;
            if (is_shared) state = PAUSED;
        } else if (phase == DECIDE) {
            if (n_done == 0 || !(bound < last)) {
                accepted = trying, left -= 1, phase = MAXIMIZE;
            } else if (is_ahead) {
                step_back();  // the next pass tries the new groups once more from there
                phase = NATURAL;
            } else if (trying != accepted) {
                trying = accepted, frozen = true, phase = ROWS;
            } else {
                converged = true,
                phase = FINISH;  // EM's own step gains less than rounding or regularisation loses
            }
        } else if (phase == MAXIMIZE) {
            const bool was_ahead = is_ahead, has_converged = fabs(bound - last) < tol;
            if (item == 0) bounds[n_done % n_bounds] = bound;
            age += has_last, has_last = true, is_ahead = share > 0.0, is_made = true;
            last = bound, n_done += 1;
            converged = has_converged && !was_ahead;
            if (has_converged && was_ahead) step_back();  // decide by EM's own step
            phase = MASSES;
        } else if (phase == MASSES) {
            phase = converged || n_done == n_iter ? FINISH : NATURAL;
            if (phase == NATURAL && n_done == n_stop) state = PAUSED;
        } else if (phase == FINISH) {
            state = ENDED;
        } else {
            phase += 1;
        }
    }
    if (item < n - 1) return;
    const double progress[15] = {
        (double)phase,    (double)n_done, (double)state,   (double)trying, (double)accepted,
        (double)n_sets,   (double)left,   (double)age,     (double)frozen, (double)has_last,
        (double)is_ahead, (double)undo,   (double)is_made, last,           (double)converged};
    for (int i = 0; i < 15; ++i) after[i] = progress[i];
}

}  // namespace gmm

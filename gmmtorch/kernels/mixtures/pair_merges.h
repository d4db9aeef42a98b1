// A mixture reduced in rounds that merge many pairs of near components. An item is a worker of the team. The
// twin, which states the rule, is mixture/reduction.py.
#pragma once

#include "../lanes.h"
#include "../selection.h"

namespace gmm {

// K components; order: their rows along an axis.
struct Mixture {
    int64_t k;
    const int64_t* order;
    const double* weights;
    const double* means;
    const double* covariances;
};

// When merging ends, and where a component looks for partners: among its nearest `neighbors`. block: rows
// that have a common box, a multiple of eight.
struct MergeRule {
    int64_t least;
    double limit;
    bool is_hellinger;
    int64_t neighbors;
    int64_t block;
};

// At the first given row of each component that is left, its values and the number of its members. lead (K,):
// that row of each given one. failed: 1 if a
// covariance is not positive definite.
struct Merged {
    double* left_weights;
    double* left_means;
    double* left_covariances;
    int64_t* members;
    int64_t* lead;
    int* failed;
};

GMM_INLINE void lower(int64_t* place, int64_t value) {
#if defined(__CUDA_ARCH__)
    atomicMin((long long*)place, (long long)value);
#else
    *place = minimum(*place, value);
#endif
}

// The weighted Gaussian of two, by the operations of `merge_pairs`.
template <int DIM>
struct Gaussian {
    double weight, mean[DIM], covariance[DIM * DIM];

    GMM_INLINE void join(double w, const double* m, const double* c) {
        const double total = weight + w, b = total > 0 ? w / total : 0.5, a = 1 - b;
        double offset[DIM];
        for (int x = 0; x < DIM; ++x) offset[x] = m[x] - mean[x];
        for (int x = 0; x < DIM; ++x)
            for (int y = 0; y < DIM; ++y) {
                double& own = covariance[x * DIM + y];
                own = (a * own + b * c[x * DIM + y]) + a * b * offset[x] * offset[y];
            }
        for (int x = 0; x < DIM; ++x) mean[x] = mean[x] + b * offset[x];
        weight = total;
    }
};

// ½ log|C|, and dᵀC⁻¹d; `good` becomes false if C is not positive definite.
template <int DIM>
GMM_INLINE double half_log_det(const double* c, const double* d, double& squared, bool& good) {
    double l[DIM][DIM], pivot[DIM], y[DIM], det = 1.0;
    squared = 0.0;
    for (int i = 0; i < DIM; ++i) {
        y[i] = d[i], pivot[i] = c[i * (DIM + 1)];
        for (int j = 0; j < i; ++j) {
            double x = c[i * DIM + j];
            for (int q = 0; q < j; ++q) x -= l[i][q] * l[j][q] * pivot[q];
            l[i][j] = x / pivot[j];
            pivot[i] -= l[i][j] * x;
            y[i] -= l[i][j] * y[j];
        }
        good = good && pivot[i] > 0;
        det *= pivot[i];
        squared += y[i] * y[i] / pivot[i];
    }
    good = good && det > 1e-280 && det < 1e280;
    return 0.5 * log(det);
}

template <int DIM>
struct Rounds {
    static constexpr int64_t MOST = 0x7FFFFFFFFFFFFFFF;
    static constexpr uint64_t SPREAD = 0x9E3779B97F4A7C15, BACK = 0xF1DE83E19937733D;  // their product is 1

    Team team;
    Mixture given;
    MergeRule rule;
    Merged out;
    int64_t item, k, slots, block, n_blocks, stride;
    double *place, *weight, *mean, *covariance, *half, *reach, *box, *distance, *costs;
    int64_t *owner, *members, *first, *best, *code, *near;
    int* counts;

    // scratch: (K + 2 blocks) (3 + 3 D + D² + 2 S) numbers, and K (5 + S) whole ones, S = neighbors. place
    // (D, stride): means, or infinity if nothing is left in a row.
    GMM_INLINE void begin(double* scratch, int64_t* whole) {
        k = given.k, slots = rule.neighbors, block = rule.block;
        n_blocks = (k + block - 1) / block;
        stride = n_blocks * block, place = scratch, weight = place + DIM * stride, mean = weight + k,
        covariance = mean + k * DIM, half = covariance + k * DIM * DIM;
        reach = half + k, box = reach + k, distance = box + (k + block) * DIM, costs = distance + k * slots;
        owner = whole, members = owner + k, first = members + k, best = first + k, code = best + k;
        near = code + k;
        for (int64_t i = item; i < k; i += team.n) {
            const int64_t row = given.order[i];
            owner[i] = i, members[i] = 1, first[i] = row, weight[i] = given.weights[row];
            for (int x = 0; x < DIM; ++x) mean[i * DIM + x] = given.means[row * DIM + x];
            for (int x = 0; x < DIM * DIM; ++x)
                covariance[i * DIM * DIM + x] = given.covariances[row * DIM * DIM + x];
            reach[i] = HUGE_VAL;
            measure(i);
        }
    }

    GMM_INLINE void measure(int64_t i) {
        double squared;
        bool good = true;
        half[i] = half_log_det<DIM>(covariance + i * DIM * DIM, mean + i * DIM, squared, good);
        if (!good) *out.failed = 1;
    }

    GMM_INLINE Gaussian<DIM> joined(int64_t a, int64_t b) const {
        Gaussian<DIM> g;
        g.weight = weight[a];
        for (int x = 0; x < DIM; ++x) g.mean[x] = mean[a * DIM + x];
        for (int x = 0; x < DIM * DIM; ++x) g.covariance[x] = covariance[a * DIM * DIM + x];
        g.join(weight[b], mean + b * DIM, covariance + b * DIM * DIM);
        return g;
    }

    GMM_INLINE double cost(int64_t a, int64_t b) {
        bool good = true;
        double squared, found;
        if (rule.is_hellinger) {
            double middle[DIM * DIM], offset[DIM];
            for (int x = 0; x < DIM * DIM; ++x)
                middle[x] = (covariance[a * DIM * DIM + x] + covariance[b * DIM * DIM + x]) / 2;
            for (int x = 0; x < DIM; ++x) offset[x] = mean[a * DIM + x] - mean[b * DIM + x];
            const double log_det = half_log_det<DIM>(middle, offset, squared, good);
            const double log_overlap = minimum((half[a] + half[b]) / 2 - log_det - squared / 8, 0.0);
            found = log_overlap > -1e-4 ? -log_overlap * (1 + log_overlap / 2 * (1 + log_overlap / 3))
                                        : 1 - exp(log_overlap);
        } else {
            const Gaussian<DIM> both = joined(a, b);
            const double log_det = half_log_det<DIM>(both.covariance, both.mean, squared, good);
            found = weight[a] * (log_det - half[a]) + weight[b] * (log_det - half[b]);
        }
        if (!good) *out.failed = 1;
        return maximum(found, 0.0);
    }

    // The box around the components that are left of each block.
    GMM_INLINE void bound_blocks() {
        for (int64_t b = item; b < n_blocks; b += team.n) {
            double *low = box + 2 * b * DIM, *high = low + DIM;
            for (int x = 0; x < DIM; ++x) low[x] = HUGE_VAL, high[x] = -HUGE_VAL;
            for (int64_t i = b * block; i < (b + 1) * block; ++i) {
                const bool is_left = i < given.k && owner[i] == i;
                for (int x = 0; x < DIM; ++x) {
                    const double m = is_left ? mean[i * DIM + x] : HUGE_VAL;
                    place[x * stride + i] = m;
                    low[x] = minimum(low[x], m);
                    if (is_left) high[x] = maximum(high[x], m);
                }
            }
        }
        for (int64_t i = item; i < given.k; i += team.n) best[i] = code[i] = MOST;
        for (int64_t i = item; i < DIGITS * 256; i += team.n) counts[i] = 0;
    }

    GMM_INLINE static int64_t gap(int64_t i, int64_t j) { return j > i ? j - i : i - j; }

    // The nearest components of component i within reach, in no order; returns their number. Of equally near
    // ones those whose rows are near: many components at one place then have many partners.
    GMM_INLINE int64_t nearest(int64_t i) {
        double *far = distance + i * slots, farthest = reach[i];  // of those found, once there are enough
        const double* m = mean + i * DIM;
        int64_t *row = near + i * slots, n = 0, last = 0;  // where the farthest one is
        const int64_t own = i / block;
        for (int64_t step = 0; step < 2 * n_blocks; ++step) {
            const int64_t b = own + (step % 2 ? (step + 1) / 2 : -step / 2);
            if (b < 0 || b >= n_blocks) continue;
            const double* low = box + 2 * b * DIM;
            double apart = 0.0;
            for (int x = 0; x < DIM; ++x) {
                const double d = maximum(maximum(low[x] - m[x], m[x] - low[DIM + x]), 0.0);
                apart += d * d;
            }
            if (!(apart <= farthest)) continue;
            for (int64_t begin = b * block; begin < (b + 1) * block; begin += LANES) {
                vec squares = (vec)(0.0);
                for (int x = 0; x < DIM; ++x) {
                    const vec y = *(const vec*)(place + x * stride + begin) - m[x];
                    squares += y * y;
                }
                if (!any(squares <= farthest)) continue;
                for (int lane = 0; lane < LANES; ++lane) {
                    const double d = get(squares, lane);
                    const int64_t j = begin + lane;
                    if (!(d <= farthest) || j == i || d == HUGE_VAL) continue;
                    if (n == slots && d == farthest && gap(i, j) >= gap(i, row[last])) continue;
                    const int64_t at = n < slots ? n++ : last;
                    far[at] = d, row[at] = j;
                    if (n < slots) continue;
                    last = 0;
                    for (int64_t s = 1; s < slots; ++s)
                        if (far[s] > far[last] || (far[s] == far[last] && gap(i, row[s]) > gap(i, row[last])))
                            last = s;
                    farthest = far[last];
                }
            }
        }
        for (int64_t s = n; s < slots; ++s) row[s] = -1;
        if (n == slots) reach[i] = 1.5 * farthest;  // of the next round, most probably
        return n;
    }

    // The partners of component i, and what merges with them cost.
    GMM_INLINE void search(int64_t i) {
        int64_t *row = near + i * slots, n = 0;
        while ((n = nearest(i)) < slots && reach[i] < HUGE_VAL) reach[i] = HUGE_VAL;
        for (int64_t s = 0; s < n; ++s) {
            const double c = cost(minimum(i, row[s]), maximum(i, row[s]));
            costs[i * slots + s] = c;
            if (!(c <= rule.limit)) row[s] = -1;
            if (row[s] >= 0) lower(best + i, bits_of(c)), lower(best + row[s], bits_of(c));
        }
    }

    // Of the pairs of component i that cost least for one of both, the code: a bijection, in no order.
    GMM_INLINE void encode(int64_t i) {
        for (int64_t s = 0; s < slots; ++s) {
            const int64_t j = near[i * slots + s];
            if (j < 0) continue;
            const int64_t bits = bits_of(costs[i * slots + s]);
            const uint64_t pair = (uint64_t)(minimum(i, j) << 32 | maximum(i, j));
            if (best[i] == bits) lower(code + i, (int64_t)(pair * SPREAD));
            if (best[j] == bits) lower(code + j, (int64_t)(pair * SPREAD));
        }
    }

    // The partner of the lower row i of a pair that both prefer; −1 for others.
    GMM_INLINE int64_t partner(int64_t i) const {
        if (best[i] == MOST) return -1;
        const int64_t pair = (int64_t)((uint64_t)code[i] * BACK), j = pair & 0xFFFFFFFF;
        return pair >> 32 == i && code[j] == code[i] && best[j] == best[i] ? j : -1;
    }

    // The cost and the code of the pair of row i, which order pairs; whether both prefer it.
    GMM_INLINE bool number(int64_t i, uint64_t& high, uint64_t& low) const {
        high = (uint64_t)best[i], low = (uint64_t)code[i] ^ (1ull << 63);
        return partner(i) >= 0;
    }

    GMM_INLINE void merge(int64_t a, int64_t b) {
        const Gaussian<DIM> both = joined(a, b);
        weight[a] = both.weight;
        for (int x = 0; x < DIM; ++x) mean[a * DIM + x] = both.mean[x];
        for (int x = 0; x < DIM * DIM; ++x) covariance[a * DIM * DIM + x] = both.covariance[x];
        owner[b] = a, members[a] += members[b], first[a] = minimum(first[a], first[b]);
        measure(a);
    }

    GMM_INLINE void run() {
        while (k > rule.least) {
            meet(team);
            bound_blocks();
            meet(team);
            for (int64_t i = item; i < given.k; i += team.n)
                if (owner[i] == i) search(i);
            meet(team);
            if (*out.failed) return;
            for (int64_t i = item; i < given.k; i += team.n)
                if (owner[i] == i) encode(i);
            meet(team);
            Cut cut;
            const int64_t n_merges = select_smallest(
                team, item, given.k, counts, cut,
                [&](int64_t n_pairs) { return minimum((n_pairs + 1) / 2, k - rule.least); },
                [&](int64_t i, uint64_t& high, uint64_t& low) { return number(i, high, low); });
            if (n_merges == 0) break;
            for (int64_t i = item; i < given.k; i += team.n) {
                uint64_t high, low;
                if (number(i, high, low) && cut.has(high, low)) merge(i, partner(i));
            }
            k -= n_merges;
        }
        meet(team);
        for (int64_t i = item; i < given.k; i += team.n) {
            int64_t root = i;
            while (owner[root] != root) root = owner[root];
            const int64_t row = first[root];
            out.lead[given.order[i]] = row;
            if (root != i) continue;
            out.left_weights[row] = weight[i], out.members[row] = members[i];
            for (int x = 0; x < DIM; ++x) out.left_means[row * DIM + x] = mean[i * DIM + x];
            for (int x = 0; x < DIM * DIM; ++x)
                out.left_covariances[row * DIM * DIM + x] = covariance[i * DIM * DIM + x];
        }
    }
};

template <int DIM>
GMM_KERNEL pair_merges(int64_t item, Team team, Mixture mixture, MergeRule rule, Merged merged,
                       double* scratch, int64_t* whole, int* counts) {
    Rounds<DIM> rounds;
    rounds.team = team, rounds.given = mixture, rounds.rule = rule, rounds.out = merged;
    rounds.item = item, rounds.counts = counts;
    rounds.begin(scratch, whole);
    rounds.run();
}

}  // namespace gmm

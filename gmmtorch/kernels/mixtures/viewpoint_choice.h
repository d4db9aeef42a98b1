// Which viewpoints components keep. An item is a worker of the team. The twin, which states the rule, is
// mapping/learning/merging.py.
#pragma once

#include "../selection.h"

namespace gmm {

// K components; E viewpoints: order (E,) sorts their components `by`; as in `Components`.
struct Viewpoints {
    int64_t k;
    int64_t e;
    const int64_t* order;
    const int64_t* by;
    const int64_t* from;
    const double* count;
    const double* origins;
    int64_t n_origins;
    const double* support;
};

// gain (E,): of those that a component chooses, √count · distance; ∞ of the first, −1 of the others. nearest
// (E,): scratch. scaled (E,): counts of those that are kept add up to the support. is_kept (E,). is_used
// (S,): zeros at first. sizes: how many are kept, and used; zeros at first.
struct Choice {
    double* gain;
    double* nearest;
    double* scaled;
    bool* is_kept;
    bool* is_used;
    int* sizes;
};

// The first viewpoint, in order, of component i or a later one.
GMM_INLINE int64_t first_of(const Viewpoints& v, int64_t i) {
    int64_t low = 0, high = v.e;
    while (low < high) {
        const int64_t middle = (low + high) / 2;
        if (v.by[v.order[middle]] < i)
            low = middle + 1;
        else
            high = middle;
    }
    return low;
}

template <int DIM>
GMM_INLINE void choose(const Viewpoints& v, Choice c, int64_t i, int64_t most) {
    const int64_t begin = first_of(v, i), end = first_of(v, i + 1);
    for (int64_t t = begin; t < end; ++t) c.gain[v.order[t]] = -1.0, c.nearest[v.order[t]] = 1.0;
    for (int64_t step = 0; step < most; ++step) {
        double score = -1.0;
        int64_t best = -1;
        for (int64_t t = begin; t < end; ++t) {
            const int64_t e = v.order[t];
            const double own = sqrt(v.count[e]) * c.nearest[e];
            if (v.count[e] > 0 && c.gain[e] < 0 && own > score) score = own, best = e;
        }
        if (best < 0) return;
        c.gain[best] = step == 0 ? HUGE_VAL : score;
        for (int64_t t = begin; t < end; ++t) {
            const int64_t e = v.order[t];
            double d = 0.0;
            for (int x = 0; x < DIM; ++x) {
                const double y = v.origins[v.from[e] * DIM + x] - v.origins[v.from[best] * DIM + x];
                d += y * y;
            }
            c.nearest[e] = step == 0 ? sqrt(d) : minimum(c.nearest[e], sqrt(d));
        }
    }
}

// most: of a component; limit: of all.
template <int DIM>
GMM_KERNEL viewpoint_choice(int64_t item, Team team, Viewpoints viewpoints, Choice choice, int64_t most,
                            int64_t limit, int* counts) {
    const Viewpoints& v = viewpoints;
    for (int64_t i = item; i < v.k; i += team.n) choose<DIM>(v, choice, i, most);
    meet(team);
    // The largest gains; of equal ones the first rows.
    auto number = [&](int64_t e, uint64_t& high, uint64_t& low) {
        high = ~(uint64_t)bits_of(choice.gain[e]), low = (uint64_t)e;
        return choice.gain[e] >= 0;
    };
    Cut cut{~0ull, ~0ull};
    if (limit < v.e)
        select_smallest(team, item, v.e, counts, cut, [&](int64_t n) { return minimum(n, limit); }, number);
    int n_kept = 0, n_used = 0;
    for (int64_t i = item; i < v.k; i += team.n) {
        const int64_t begin = first_of(v, i), end = first_of(v, i + 1);
        double total = 0.0;
        for (int64_t t = begin; t < end; ++t) {
            const int64_t e = v.order[t];
            uint64_t high, low;
            choice.is_kept[e] = number(e, high, low) && cut.has(high, low);
            if (!choice.is_kept[e]) continue;
            total += v.count[e];
            choice.is_used[v.from[e]] = true;
            ++n_kept;
        }
        const double share = v.support[i] / maximum(total, 2.2250738585072014e-308);
        for (int64_t t = begin; t < end; ++t) choice.scaled[v.order[t]] = v.count[v.order[t]] * share;
    }
    meet(team);
    for (int64_t i = item; i < v.n_origins; i += team.n) n_used += choice.is_used[i];
    if (n_kept > 0) add(choice.sizes, n_kept);
    if (n_used > 0) add(choice.sizes + 1, n_used);
}

}  // namespace gmm

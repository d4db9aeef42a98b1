// Adaptive quadrature over rectangles, faces of a grid or cross-sections of its cells: panels, and their
// rules.
#pragma once

#include "../lanes.h"

namespace gmm {

struct Quadrature {
    double cutoff;
    double limit[4];  // largest variation of a panel for Gauss-Legendre rules of 1, 2, 3 and 4 nodes
};

// Nodes of the Gauss-Legendre rules with 1 to 4 nodes on [-1/2, 1/2], by the order of the rule; and their
// weights.
GMM_INLINE double rule_node(int order, int i) {
    const double nodes[4][4] = {
        {0.0, 0.0, 0.0, 0.0},
        {-0.28867513459481287, 0.28867513459481287, 0.0, 0.0},
        {-0.3872983346207417, 0.0, 0.3872983346207417, 0.0},
        {-0.43056815579702629, -0.16999052179242813, 0.16999052179242813, 0.43056815579702629}};
    return nodes[order][i];
}

GMM_INLINE double rule_weight(int order, int i) {
    const double weights[4][4] = {
        {1.0, 0.0, 0.0, 0.0},
        {0.5, 0.5, 0.0, 0.0},
        {0.2777777777777778, 0.4444444444444444, 0.2777777777777778, 0.0},
        {0.17392742256872693, 0.32607257743127307, 0.32607257743127307, 0.17392742256872693}};
    return weights[order][i];
}

// The order of the rule for panels that are ready, the highest that one of them needs.
GMM_INLINE int rule_order(mask ready, vec change, const double* limit) {
    return any(ready & (change > limit[2]))   ? 3
           : any(ready & (change > limit[1])) ? 2
           : any(ready & (change > limit[0])) ? 1
                                              : 0;
}

// Whole rectangles, and the panels of those that are cut. A panel has a place and a size along two edges, in
// parts of these.
struct Panels {
    static constexpr int MOST = LANES * 15 * 27;  // that wait: 27 levels down to the smallest

    int64_t n_waiting = 0, next = 0, waiting_for[MOST];
    double waiting[MOST][4];
    vec base[2], scale[2], is_used;  // of the panels in the lanes
    int64_t index[LANES];            // the rectangle of each
    int n_used;                      // of the lanes

    // Puts the next panels into the lanes; whether there is one of n rectangles.
    GMM_INLINE bool take(int64_t n) {
        if (n_waiting == 0 && next >= n) return false;
        vec base0 = (vec)(0.0), base1 = base0, scale0 = (vec)(1.0), scale1 = scale0, used = base0;
        for (n_used = 0; n_used < LANES; ++n_used) {
            if (n_waiting > 0) {
                --n_waiting;
                index[n_used] = waiting_for[n_waiting];
                set(base0, n_used, waiting[n_waiting][0]);
                set(base1, n_used, waiting[n_waiting][1]);
                set(scale0, n_used, waiting[n_waiting][2]);
                set(scale1, n_used, waiting[n_waiting][3]);
            } else if (next < n) {
                index[n_used] = next++;
            } else {
                break;
            }
            set(used, n_used, 1.0);
        }
        base[0] = base0, base[1] = base1, scale[0] = scale0, scale[1] = scale1, is_used = used;
        return true;
    }

    // Whether the integrand varies little enough on each panel.
    GMM_INLINE mask are_fine(const vec* change, double limit) const {
        return ((change[0] <= limit) & (change[1] <= limit)) | (scale[0] < 1e-15) | (scale[1] < 1e-15);
    }

    // Cuts the coarse panels into up to four parts along each edge.
    GMM_INLINE void split(mask coarse, const vec* change, double limit) {
        if (!any(coarse)) return;
        const vec cut = coarse ? (vec)(1.0) : (vec)(0.0);
        for (int l = 0; l < LANES; ++l) {
            if (get(cut, l) == 0.0) continue;
            const double ratio0 = ceil(get(change[0], l) / limit), ratio1 = ceil(get(change[1], l) / limit);
            const int parts0 = (int)minimum(maximum(ratio0, 1.0), 4.0);
            const int parts1 = (int)minimum(maximum(ratio1, 1.0), 4.0);
            for (int p = 0; p < parts0; ++p)
                for (int q = 0; q < parts1; ++q) {
                    if (n_waiting >= MOST) break;  // not reached: panels end at 1e-15
                    double* panel = waiting[n_waiting];
                    waiting_for[n_waiting++] = index[l];
                    panel[0] = get(base[0], l) + get(scale[0], l) * ((p + 0.5) / parts0 - 0.5);
                    panel[1] = get(base[1], l) + get(scale[1], l) * ((q + 0.5) / parts1 - 0.5);
                    panel[2] = get(scale[0], l) / parts0;
                    panel[3] = get(scale[1], l) / parts1;
                }
        }
    }
};

}  // namespace gmm

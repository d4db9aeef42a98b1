// The steps of a tree search over motions, as in exploration.planning.tree_search.
#pragma once

#include "path_clearance.h"

namespace gmm {

// Node n has row n in each table; children of a node are a list in the order of their making.
struct MotionTree {
    int64_t* links;    // (most, 11): see below
    double* values;    // (most, 4): total, information, value, metres to the goal
    double* states;    // (most, 7)
    double* ends;      // (most, n_actions, 7)
    double* after;     // (most, n_actions), metres to the goal, or random
    bool* clear;       // (most, n_actions)
    int32_t* untried;  // (most, n_actions), motions in the order of trial
    float* residuals;  // (most, n_blocks)
    int64_t* opened;   // (most,), nodes that were opened last
    int64_t* counts;   // nodes, nodes that were opened last
    double* scale;     // the largest return found
    int64_t n_actions;
    int64_t n_blocks;
    int64_t deepest;
    double exploration;
    double widening;
    double discount;
    double weight;  // of a metre of progress
    double aims;    // 1 with a goal, otherwise 0
};

enum Link { PARENT, ACTION, DEPTH, VISITS, TRIED, UNTRIED, CLOSED, SHUT, CHILD, LAST, NEXT, N_LINKS };
enum Value { TOTAL, INFORMATION, RETURN, METRES, N_VALUES };

// One item: sets the values of the newest n nodes, and finds which motions can follow them. row: of each
// node's view in gains and lefts, or null.
GMM_KERNEL open_nodes(int64_t, MotionTree tree, Library library, FreeSpace space, const double* longest,
                      double spacing, int64_t n, bool is_last, const int64_t* row, const float* gains,
                      const float* lefts) {
    const int64_t begin = tree.counts[0] - n, n_motions = tree.n_actions;
    for (int64_t node = begin; node < begin + n; ++node) {
        int64_t* link = tree.links + N_LINKS * node;
        double* value = tree.values + N_VALUES * node;
        const double* above = tree.values + N_VALUES * link[PARENT];
        double gain = 0.0;
        if (row) {
            const float* own = gains + row[node - begin] * tree.n_blocks;
            const float* left = lefts + row[node - begin] * tree.n_blocks;
            const float* before = tree.residuals + link[PARENT] * tree.n_blocks;
            float* rest = tree.residuals + node * tree.n_blocks;
            for (int64_t block = 0; block < tree.n_blocks; ++block) {
                gain += own[block] * before[block];
                rest[block] = before[block] * left[block];
            }
        }
        const double later = pow(tree.discount, (double)(link[DEPTH] - 1));
        value[INFORMATION] = above[INFORMATION] + gain;
        value[RETURN] = above[RETURN] + later * (gain + tree.weight * (above[METRES] - value[METRES]));
        *tree.scale = maximum(*tree.scale, value[RETURN]);
        for (int64_t each = node; each >= 0; each = tree.links[N_LINKS * each + PARENT])
            tree.values[N_VALUES * each + TOTAL] += value[RETURN];
        link[CLOSED] = is_last || link[DEPTH] == tree.deepest;
    }
    int64_t n_open = 0;
    for (int64_t depth = 1; depth < tree.deepest && !is_last; ++depth) {
        const int64_t first = n_open;
        double step = 0.0, turn = 0.0;
        for (int64_t node = begin; node < begin + n; ++node) {
            const int64_t* link = tree.links + N_LINKS * node;
            if (link[DEPTH] != depth) continue;
            tree.opened[n_open++] = node;
            step = maximum(step, longest[2 * link[ACTION]]);
            turn = maximum(turn, longest[2 * link[ACTION] + 1]);
        }
        const int64_t n_parts = maximum((int64_t)1, (int64_t)ceil(step / (spacing - step * turn / 4)));
        const int64_t time = minimum(depth * library.n_steps, space.n_times - 1);
        for (int64_t i = first; i < n_open; ++i) {
            const int64_t node = tree.opened[i], follows = tree.links[N_LINKS * node + ACTION];
            const double* start = tree.states + 7 * node;
            const double start_turn[2] = {cos(start[3]), sin(start[3])};
            for (int64_t motion = 0; motion < n_motions; ++motion) {
                const double* last =
                    library.paths + ((follows * n_motions + motion + 1) * library.n_steps - 1) * 7;
                double* end = tree.ends + (node * n_motions + motion) * 7;
                moved(start, start_turn, last, end);
                end[3] = last[3] + start[3];
                for (int a = 4; a < 7; ++a) end[a] = last[a];
                const double end_turn[2] = {cos(end[3]), sin(end[3])};
                tree.clear[node * n_motions + motion] = is_clear(library, space, motion, follows, start,
                                                                 start_turn, end, end_turn, n_parts, time);
            }
        }
    }
    tree.counts[1] = n_open;
}

// A new node below another.
GMM_INLINE int64_t child_of(const MotionTree& tree, int64_t parent, int64_t action, int64_t turn) {
    const int64_t node = tree.counts[0]++;
    int64_t *link = tree.links + N_LINKS * node, *above = tree.links + N_LINKS * parent;
    const int64_t made[N_LINKS] = {parent, action, above[DEPTH] + 1, 0, 0, 0, 0, turn, -1, -1, -1};
    for (int i = 0; i < N_LINKS; ++i) link[i] = made[i];
    (above[CHILD] < 0 ? above[CHILD] : tree.links[N_LINKS * above[LAST] + NEXT]) = node;
    above[LAST] = node;
    for (int64_t each = node; each >= 0; each = tree.links[N_LINKS * each + PARENT])
        tree.links[N_LINKS * each + VISITS] += 1;
    const double* end = tree.ends + (parent * tree.n_actions + action) * 7;
    for (int a = 0; a < 7; ++a) tree.states[7 * node + a] = end[a];
    double* value = tree.values + N_VALUES * node;
    for (int i = 0; i < N_VALUES; ++i) value[i] = 0.0;
    value[METRES] = tree.aims * tree.after[parent * tree.n_actions + action];
    return node;
}

// The child with the largest upper confidence bound that is neither exhausted nor waiting, or -1.
GMM_INLINE int64_t promising(const MotionTree& tree, int64_t node, int64_t turn) {
    const double c = tree.exploration * *tree.scale;
    const double log_visits = log((double)maximum(tree.links[N_LINKS * node + VISITS], (int64_t)1));
    int64_t best = -1;
    double best_score = -HUGE_VAL;
    for (int64_t child = tree.links[N_LINKS * node + CHILD]; child >= 0;) {
        const int64_t* link = tree.links + N_LINKS * child;
        if (!link[CLOSED] && link[SHUT] != turn) {
            const double visits = (double)link[VISITS];
            const double bound = c * sqrt(log_visits / visits);
            const double score = tree.values[N_VALUES * child + TOTAL] / visits + bound;
            if (score > best_score) {
                best = child;
                best_score = score;
            }
        }
        child = link[NEXT];
    }
    return best;
}

// One item: orders the motions that can follow the nodes opened last, and makes up to `most` leaves in round
// `turn`, or the one by `action` below the newest node if it can follow. The number of nodes tells how many.
GMM_KERNEL choose_leaves(int64_t, MotionTree tree, const double* orders, int64_t most, int64_t turn,
                         int64_t action) {
    const int64_t n_motions = tree.n_actions, newest = tree.counts[0] - 1;
    for (int64_t i = 0; i < tree.counts[1]; ++i) {
        const int64_t node = tree.opened[i];
        int64_t* link = tree.links + N_LINKS * node;
        int32_t* untried = tree.untried + node * n_motions;
        double* order = tree.after + node * n_motions;
        int64_t n = 0;
        for (int64_t motion = 0; motion < n_motions; ++motion) {
            order[motion] = orders[i * n_motions + motion];
            if (!tree.clear[node * n_motions + motion]) continue;
            int64_t place = n++;
            for (; place > 0 && order[untried[place - 1]] > order[motion]; --place)
                untried[place] = untried[place - 1];
            untried[place] = (int32_t)motion;
        }
        link[TRIED] = 0;
        link[UNTRIED] = n;
        link[CLOSED] = n == 0;
    }
    tree.counts[1] = 0;
    if (action >= 0) {
        int64_t* link = tree.links + N_LINKS * newest;
        int32_t* untried = tree.untried + newest * n_motions;
        int64_t place = 0;
        while (place < link[UNTRIED] && untried[place] != action) ++place;
        if (link[CLOSED] || place == link[UNTRIED]) return;
        for (; place + 1 < link[UNTRIED]; ++place) untried[place] = untried[place + 1];
        link[UNTRIED] -= 1;
        child_of(tree, newest, action, turn);
        return;
    }
    int64_t node = 0;
    for (int64_t n = 0; n < most && !tree.links[CLOSED] && tree.links[SHUT] != turn;) {
        int64_t* link = tree.links + N_LINKS * node;
        const bool is_untried = link[TRIED] < link[UNTRIED];
        int64_t n_children = 0;
        for (int64_t c = link[CHILD]; c >= 0; c = tree.links[N_LINKS * c + NEXT]) ++n_children;
        const bool widens = node == 0 || (double)n_children < tree.widening * sqrt((double)link[VISITS]);
        const int64_t child = is_untried && widens ? -1 : promising(tree, node, turn);
        if (child >= 0) {
            node = child;
        } else if (is_untried) {
            child_of(tree, node, tree.untried[node * n_motions + link[TRIED]++], turn);
            node = 0;
            ++n;
        } else {
            link[SHUT] = turn;
            link[CLOSED] = 1;
            for (int64_t c = link[CHILD]; c >= 0; c = tree.links[N_LINKS * c + NEXT])
                if (!tree.links[N_LINKS * c + CLOSED]) link[CLOSED] = 0;
            node = 0;
        }
    }
}

}  // namespace gmm

// Motions that stay in passable cells and keep clear of other robots, alone and in a search tree.
#pragma once

#include "../device.h"

namespace gmm {

// Motions from the origin with yaw 0, by the motion that they follow, and how a robot comes to rest after
// each.
struct Library {
    int64_t n_motions;
    int64_t n_steps;
    int64_t n_stops;
    const double* paths;
    const double* stops;
};

// Passable cells, with n_parts checked points on each step, and other robots.
struct FreeSpace {
    const bool* passable;
    const int64_t* low;
    int64_t nx;
    int64_t ny;
    int64_t nz;
    double resolution;
    const double* peers;
    int64_t n_peers;
    int64_t n_times;
    double separation;
};

// Moves a state from the origin with yaw 0 to a pose with the cosine and sine of its yaw.
GMM_INLINE void moved(const double* pose, const double* turn, const double* state, double* place) {
    place[0] = pose[0] + turn[0] * state[0];
    place[0] = place[0] - turn[1] * state[1];
    place[1] = pose[1] + turn[1] * state[0];
    place[1] = place[1] + turn[0] * state[1];
    place[2] = state[2] + pose[2];
}

// Whether a motion from a start to an end is clear; `first`: of the peers' places, that of its first step.
GMM_INLINE bool is_clear(const Library& library, const FreeSpace& space, int64_t motion, int64_t follows,
                         const double* start, const double* start_turn, const double* end,
                         const double* end_turn, int64_t n_parts, int64_t first) {
    const int64_t n_steps = library.n_steps, n_stops = library.n_stops, n_path = n_steps + n_stops;
    const double* path = library.paths + (follows * library.n_motions + motion) * n_steps * 7;
    const double* stop = library.stops + motion * n_stops * 7;
    auto position = [&](int64_t k, double* place) {  // after k steps
        if (k == 0)
            for (int a = 0; a < 3; ++a) place[a] = start[a];
        else if (k > n_steps)
            moved(end, end_turn, stop + (k - n_steps - 1) * 7, place);
        else
            moved(start, start_turn, path + (k - 1) * 7, place);
    };
    auto distance = [](const double* a, const double* b) {
        const double x = a[0] - b[0], y = a[1] - b[1], z = a[2] - b[2];
        return sqrt(x * x + y * y + z * z);
    };
    auto is_passable = [&](const double* place) {
        const int64_t x = (int64_t)floor(place[0] / space.resolution) - space.low[0];
        const int64_t y = (int64_t)floor(place[1] / space.resolution) - space.low[1];
        const int64_t z = (int64_t)floor(place[2] / space.resolution) - space.low[2];
        if (x < 0 || y < 0 || z < 0 || x >= space.nx || y >= space.ny || z >= space.nz) return false;
        return space.passable[(x * space.ny + y) * space.nz + z];
    };
    bool is_still = true, is_safe = is_passable(start);
    double here[3], before[3], next[3], between[3];
    position(0, before);
    for (int64_t k = 1; k <= n_path && (is_still || is_safe); ++k) {
        position(k, here);
        for (int a = 0; a < 3; ++a) is_still = is_still && here[a] == start[a];
        for (int64_t part = 1; part <= n_parts && is_safe; ++part) {
            const double share = (double)part / (double)n_parts;
            for (int a = 0; a < 3; ++a)
                between[a] = part == n_parts ? here[a] : before[a] + (here[a] - before[a]) * share;
            is_safe = is_passable(between);
        }
        for (int a = 0; a < 3; ++a) before[a] = here[a];
    }
    // A robot that is too close to another may move if it is never closer than by staying.
    const int64_t n_left = space.n_times - first, n = maximum(n_path, n_left);
    for (int64_t peer = 0; peer < space.n_peers && is_safe && !is_still; ++peer) {
        const double* route = space.peers + peer * space.n_times * 3;
        position(0, before);
        position(1, here);
        double step = distance(here, before), others_step = 0.0;
        for (int64_t k = 0; k < n && is_safe; ++k) {
            const double* there = route + 3 * (first + minimum(k, n_left - 1));
            const double* then = route + 3 * (first + minimum(k + 1, n_left - 1));
            const double others_next = k + 1 < n ? distance(then, there) : 0.0;
            double required = space.separation + maximum(others_step, others_next);
            others_step = others_next;
            if (k < n_path) {
                position(k + 1, here);
                double next_step = 0.0;
                if (k + 1 < n_path) {
                    position(k + 2, next);
                    next_step = distance(next, here);
                }
                required += maximum(step, next_step) / 2.0;
                step = next_step;
            }
            is_safe = distance(here, there) >= minimum(required, distance(start, there));
        }
    }
    return is_safe || is_still;
}

// An item is one motion from one state.
GMM_KERNEL motions_are_clear(int64_t item, Library library, FreeSpace space, const int64_t* follows,
                             const double* starts, const double* start_turns, const double* ends,
                             const double* end_turns, int64_t n_parts, int64_t first, bool* clear) {
    const int64_t row = item / library.n_motions, motion = item % library.n_motions;
    clear[item] = is_clear(library, space, motion, follows[row], starts + 7 * row, start_turns + 2 * row,
                           ends + 7 * item, end_turns + 2 * item, n_parts, first);
}

}  // namespace gmm

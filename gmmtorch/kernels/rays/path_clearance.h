// Motions that stay in passable cells and keep clear of other robots.
#pragma once

#include "../device.h"

namespace gmm {

// An item is one motion from one state.
GMM_KERNEL motions_are_clear(int64_t item, int64_t n_motions, int64_t n_steps, int64_t n_stops,
                             const double* paths, const double* stops, const int64_t* follows,
                             const double* starts, const double* start_turns, const double* ends,
                             const double* end_turns, const bool* passable, const int64_t* low, int64_t nx,
                             int64_t ny, int64_t nz, double resolution, int64_t n_parts, const double* peers,
                             int64_t n_peers, int64_t n_times, int64_t first, double separation,
                             bool* clear) {
    const int64_t row = item / n_motions, motion = item % n_motions, n_path = n_steps + n_stops;
    const double* path = paths + (follows[row] * n_motions + motion) * n_steps * 7;
    const double* stop = stops + motion * n_stops * 7;
    const double* start = starts + row * 7;
    const double* end = ends + item * 7;
    auto position = [&](int64_t k, double* place) {  // after k steps
        const bool stops_now = k > n_steps;
        const double* pose = stops_now ? end : start;
        const double* turn = stops_now ? end_turns + 2 * item : start_turns + 2 * row;
        if (k == 0) {
            for (int a = 0; a < 3; ++a) place[a] = pose[a];
            return;
        }
        const double* moved = stops_now ? stop + (k - n_steps - 1) * 7 : path + (k - 1) * 7;
        place[0] = pose[0] + turn[0] * moved[0];
        place[0] = place[0] - turn[1] * moved[1];
        place[1] = pose[1] + turn[1] * moved[0];
        place[1] = place[1] + turn[0] * moved[1];
        place[2] = moved[2] + pose[2];
    };
    auto distance = [](const double* a, const double* b) {
        const double x = a[0] - b[0], y = a[1] - b[1], z = a[2] - b[2];
        return sqrt(x * x + y * y + z * z);
    };
    auto is_passable = [&](const double* place) {
        const int64_t x = (int64_t)floor(place[0] / resolution) - low[0];
        const int64_t y = (int64_t)floor(place[1] / resolution) - low[1];
        const int64_t z = (int64_t)floor(place[2] / resolution) - low[2];
        if (x < 0 || y < 0 || z < 0 || x >= nx || y >= ny || z >= nz) return false;
        return passable[(x * ny + y) * nz + z];
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
    const int64_t n_left = n_times - first, n = maximum(n_path, n_left);
    for (int64_t peer = 0; peer < n_peers && is_safe && !is_still; ++peer) {
        const double* route = peers + peer * n_times * 3;
        position(0, before);
        position(1, here);
        double step = distance(here, before), others_step = 0.0;
        for (int64_t k = 0; k < n && is_safe; ++k) {
            const double* there = route + 3 * (first + minimum(k, n_left - 1));
            const double* then = route + 3 * (first + minimum(k + 1, n_left - 1));
            const double others_next = k + 1 < n ? distance(then, there) : 0.0;
            double required = separation + maximum(others_step, others_next);
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
    clear[item] = is_safe || is_still;
}

}  // namespace gmm

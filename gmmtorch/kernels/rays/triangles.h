// The first triangle along a ray, and the distance to the nearest one, in a tree of boxes.
#pragma once

#include "../lanes.h"

namespace gmm {

// Node n has two children: boxes (lowest, highest corner of the one, then of the other) and children[2 n],
// children[2 n + 1]. A child ~t, below zero, is triangle t, with a corner and two edges. The last node is the
// root.
struct TriangleTree {
    const double* boxes;
    const int32_t* children;
    const double* corners;
    int64_t n_nodes;
};

constexpr int DEEPEST = 128;                           // as in triangles.py
constexpr double EDGE_SLACK = 1.4210854715202004e-14;  // 64 epsilon, as in triangles.py
constexpr double BOX_SLACK = 1.0 + 3.6e-15;            // rounding of 16 epsilon
constexpr double LEAST_STEP = 1e-200;

// An item is a ray, or eight rays side by side on a CPU. Rays that are not finite hit nothing.
GMM_KERNEL first_hits(int64_t item, int64_t n_rays, const double* origins, int64_t stride,
                      const double* directions, TriangleTree tree, double* distances) {
    vec o[3], d[3], inverse[3], best = (vec)(HUGE_VAL), length = (vec)(0.0);
    const int64_t first = item * LANES;
    for (int a = 0; a < 3; ++a) {
        o[a] = d[a] = (vec)(0.0);
        for (int l = 0; l < LANES; ++l) {
            const int64_t ray = minimum(first + l, n_rays - 1);
            set(o[a], l, origins[ray * stride + a]);
            set(d[a], l, directions[3 * ray + a]);
        }
        best = absolute(o[a]) + absolute(d[a]) < HUGE_VAL ? best : (vec)(-1.0);
        length += absolute(d[a]);
        const vec step = absolute(d[a]) < LEAST_STEP ? (vec)(LEAST_STEP) : d[a];  // no 0 · ∞ below
        inverse[a] = 1.0 / step;
    }
    const mask is_ray = best > 0.0;
    int32_t stack[DEEPEST];
    vec entries[DEEPEST];
    int n_stack = 0;
    int64_t node = tree.n_nodes - 1;
    while (true) {
        vec enter[2];
        bool meets[2];
        for (int side = 0; side < 2; ++side) {
            const double* box = tree.boxes + 12 * node + 6 * side;
            vec in = (vec)(0.0), out = best;
            for (int a = 0; a < 3; ++a) {
                const vec low = (box[a] - o[a]) * inverse[a], high = (box[3 + a] - o[a]) * inverse[a];
                const vec near = low < high ? low : high, far = low < high ? high : low;
                in = near > in ? near : in;
                out = far < out ? far : out;
            }
            enter[side] = in;
            meets[side] = any(in <= out * BOX_SLACK);
            const int64_t child = tree.children[2 * node + side];
            if (child >= 0 || !meets[side]) continue;
            meets[side] = false;
            const double* c = tree.corners + 10 * ~child;  // Möller & Trumbore 1997
            vec t[3], p[3], q[3];
            for (int a = 0; a < 3; ++a) t[a] = o[a] - c[a];
            const double *e = c + 3, *f = c + 6;
            for (int a = 0; a < 3; ++a) {
                const int b = (a + 1) % 3, g = (a + 2) % 3;
                p[a] = d[b] * f[g] - d[g] * f[b];
                q[a] = t[b] * e[g] - t[g] * e[b];
            }
            const vec steep = p[0] * e[0] + p[1] * e[1] + p[2] * e[2];
            const vec sign = steep < 0.0 ? (vec)(-1.0) : (vec)(1.0);
            const vec u = (t[0] * p[0] + t[1] * p[1] + t[2] * p[2]) * sign;
            const vec v = (d[0] * q[0] + d[1] * q[1] + d[2] * q[2]) * sign;
            const vec w = (q[0] * f[0] + q[1] * f[1] + q[2] * f[2]) * sign, size = steep * sign;
            const vec apart = absolute(t[0]) + absolute(t[1]) + absolute(t[2]) + c[9];
            const vec slack = EDGE_SLACK * c[9] * length * apart;
            mask hits = u >= -slack;
            hits &= v >= -slack;
            hits &= u + v <= size + slack;
            hits &= size > 4.0 * slack;
            const vec there = w / size;
            hits &= there > 0.0;
            hits &= there < best;
            best = hits ? there : best;
        }
        if (meets[0] && meets[1]) {
            // The nearer one first, as the ray in the middle sees it.
            const int near = get(enter[1], LANES / 2) < get(enter[0], LANES / 2);
            entries[n_stack] = enter[1 - near];
            stack[n_stack++] = tree.children[2 * node + 1 - near];
            node = tree.children[2 * node + near];
            continue;
        }
        if (meets[0] || meets[1]) {
            node = tree.children[2 * node + (meets[1] ? 1 : 0)];
            continue;
        }
        while (n_stack > 0 && !any(entries[n_stack - 1] <= best)) --n_stack;
        if (n_stack == 0) break;
        node = stack[--n_stack];
    }
    best = is_ray ? best : (vec)(HUGE_VAL);
    for (int l = 0; l < LANES && first + l < n_rays; ++l) distances[first + l] = get(best, l);
}

GMM_INLINE double dot3(const double* a, const double* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

// Square of the distance from the origin to the segment from `a` along `e`.
GMM_INLINE double square_to_segment(const double* a, const double* e) {
    const double ee = dot3(e, e), share = ee > 0.0 ? -dot3(a, e) / ee : 0.0;
    const double s = minimum(maximum(share, 0.0), 1.0);
    const double x[3] = {a[0] + s * e[0], a[1] + s * e[1], a[2] + s * e[2]};
    return dot3(x, x);
}

GMM_INLINE void cross3(const double* a, const double* b, double* c) {
    for (int i = 0; i < 3; ++i) c[i] = a[(i + 1) % 3] * b[(i + 2) % 3] - a[(i + 2) % 3] * b[(i + 1) % 3];
}

// Square of the distance from a point to a triangle: to its plane inside, otherwise to an edge.
GMM_INLINE double square_to_triangle(const double* point, const double* corner) {
    const double *e = corner + 3, *f = corner + 6;
    double a[3], b[3], g[3], n[3], x[3], y[3];
    for (int i = 0; i < 3; ++i) {
        a[i] = corner[i] - point[i];
        b[i] = a[i] + e[i];
        g[i] = f[i] - e[i];
    }
    cross3(e, f, n);
    cross3(a, e, x);
    cross3(f, a, y);
    const double nn = dot3(n, n), u = dot3(x, n), v = dot3(y, n);
    if (nn > 0.0 && u >= 0.0 && v >= 0.0 && u + v <= nn) {
        const double high = dot3(a, n);
        return high * high / nn;
    }
    const double along = minimum(square_to_segment(a, e), square_to_segment(a, f));
    return minimum(along, square_to_segment(b, g));
}

// An item is a point, finite.
GMM_KERNEL nearest_triangles(int64_t item, const double* points, TriangleTree tree, double* distances) {
    const double* point = points + 3 * item;
    double best = HUGE_VAL, squares[DEEPEST];
    int32_t stack[DEEPEST];
    int n_stack = 0;
    int64_t node = tree.n_nodes - 1;
    while (true) {
        double square[2];
        for (int side = 0; side < 2; ++side) {
            const double* box = tree.boxes + 12 * node + 6 * side;
            square[side] = 0.0;
            for (int a = 0; a < 3; ++a) {
                const double gap = maximum(maximum(box[a] - point[a], point[a] - box[3 + a]), 0.0);
                square[side] += gap * gap;
            }
            const int64_t child = tree.children[2 * node + side];
            if (child >= 0) continue;
            if (square[side] < best)
                best = minimum(best, square_to_triangle(point, tree.corners + 10 * ~child));
            square[side] = HUGE_VAL;
        }
        const int near = square[1] < square[0];
        if (square[near] < best) {
            if (square[1 - near] < best) {
                squares[n_stack] = square[1 - near];
                stack[n_stack++] = tree.children[2 * node + 1 - near];
            }
            node = tree.children[2 * node + near];
            continue;
        }
        while (n_stack > 0 && squares[n_stack - 1] >= best) --n_stack;
        if (n_stack == 0) break;
        node = stack[--n_stack];
    }
    distances[item] = sqrt(best);
}

}  // namespace gmm

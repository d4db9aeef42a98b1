// The walk of rays through a voxel grid: one ray, or eight at a time.
//
// It is the stepping loop of Amanatides & Woo, with the tie rule of the twin in ray_traversal.py. Crossing k
// of an axis is at t = from + k·inverse on the ray. Crossings of two axes are one point if their t differ by
// at most the sum of the axes' slacks. Then the plane of the lower axis is crossed first. Rays that are not
// finite, or start 2^50 voxels or more from zero, leave nothing.
#pragma once

#include "../lanes.h"

namespace gmm {

constexpr double FARTHEST = 1125899906842624.0;  // voxels are exact to there

struct Rays {
    const double* starts;  // (R, dim), in voxels
    const double* ends;
    const double* lows;  // (dim,), the grid's lowest voxel
    int64_t dim;
    int64_t size[3];    // voxels of the grid along each axis, 1 for the third axis of a 2D grid
    int64_t stride[3];  // of the flat index, 0 for the third axis of a 2D grid
    double tie;         // distance of crossings that count as one point, relative to the terms
    double unit;        // 1, or 1/n if n finer voxels make a voxel and ties are theirs
};

// Rays in lanes, mirrored so that they ascend.
template <typename Lanes>
struct Start {
    typedef typename Lanes::vec vec;
    typedef typename Lanes::mask mask;
    typedef typename Lanes::whole whole;

    vec first[3], count[3], origin[3], away[3], inverse[3], from[3], slack[3];
    whole step[3], corner;
    mask fits, meets_grid;  // whether the ray is all inside the grid, and whether it can meet the grid

    // The rays ray0 ... in the lanes, up to n_rays.
    GMM_INLINE Start(const Rays& rays, int64_t ray0, int64_t n_rays) {
        corner = (whole)(0);
        fits = meets_grid = (vec)(0.0) == (vec)(0.0);  // all true
        for (int a = 0; a < 3; ++a) {
            vec s = (vec)(0.0), e = (vec)(0.0);
            const double low = a < rays.dim ? rays.lows[a] : 0.0, size = (double)rays.size[a];
            for (int l = 0; l < Lanes::LANES && a < rays.dim; ++l) {
                const bool is_ray = ray0 + l < n_rays;
                set(s, l, is_ray ? rays.starts[(ray0 + l) * rays.dim + a] : HUGE_VAL);
                set(e, l, is_ray ? rays.ends[(ray0 + l) * rays.dim + a] : HUGE_VAL);
            }
            meets_grid &= absolute(s) < FARTHEST;  // not if it is NaN
            meets_grid &= absolute(e) < HUGE_VAL;
            vec delta = e - s, begin = down(s) - low, end = down(e) - low;
            s -= low;
            const mask falls = delta < 0.0;  // mirrored, so that every ray ascends
            s = falls ? size - s : s;
            begin = falls ? size - 1.0 - begin : begin;
            end = falls ? size - 1.0 - end : end;
            step[a] = falls ? (whole)(-rays.stride[a]) : (whole)(rays.stride[a]);
            corner += falls ? (whole)(rays.stride[a] * (rays.size[a] - 1)) : (whole)(0);
            fits &= begin >= 0.0;
            fits &= end < size;
            meets_grid &= end >= 0.0;
            meets_grid &= begin < size;
            delta = absolute(delta);  // also of −0
            first[a] = begin;
            count[a] = end - begin;
            origin[a] = s;
            away[a] = delta;
            inverse[a] = 1.0 / delta;
            slack[a] = rays.tie * (absolute(s) + delta + rays.unit) * inverse[a];
            slack[a] = slack[a] < 1e200 ? slack[a] : (vec)(1e200);
            const mask is_flat = !(inverse[a] < 1e290);  // the ray crosses one plane of this axis at most
            from[a] = is_flat ? (vec)(0.5) : (begin + 1.0 - s) * inverse[a];
            inverse[a] = is_flat ? (vec)(0.0) : inverse[a];
        }
        fits &= meets_grid;
    }
};

// Where the walks of rays are. Its fields are no arrays, so that they stay in registers.
template <typename Lanes>
struct Walk {
    typedef typename Lanes::vec vec;
    typedef typename Lanes::mask mask;
    typedef typename Lanes::whole whole;

    const vec n0, n1, n2, inverse0, inverse1, inverse2;
    const vec from0, from1, from2, wide1;
    const whole step0, step1, step2;
    vec c0, c1, c2;      // crossings of each axis so far
    vec early0, early1;  // the first time at which a crossing of axis 0 or 1 can be taken
    vec late1, late2;    // the last time of a crossing of axis 1 or 2
    whole voxel;

    // After some crossings of each axis.
    GMM_INLINE Walk(const Start<Lanes>& s, whole voxel, vec c0, vec c1, vec c2)
        : n0(s.count[0]), n1(s.count[1]), n2(s.count[2]), inverse0(s.inverse[0]), inverse1(s.inverse[1]),
          inverse2(s.inverse[2]), from0(s.from[0] - s.slack[0]), from1(s.from[1] - s.slack[1]),
          from2(s.from[2] + s.slack[2]), wide1(2.0 * s.slack[1]), step0(s.step[0]), step1(s.step[1]),
          step2(s.step[2]), c0(c0), c1(c1), c2(c2), voxel(voxel) {
        find_times();
    }

    GMM_INLINE void find_times() {
        early0 = c0 < n0 ? from0 + c0 * inverse0 : (vec)(HUGE_VAL);
        early1 = c1 < n1 ? from1 + c1 * inverse1 : (vec)(HUGE_VAL);
        late1 = early1 + wide1;
        late2 = c2 < n2 ? from2 + c2 * inverse2 : (vec)(HUGE_VAL);
    }

    // Enters the next voxel, in one lane.
    GMM_INLINE void advance() {
        if (early0 <= late1 && early0 <= late2) {
            c0 += 1.0;
            voxel += step0;
            early0 = c0 < n0 ? from0 + c0 * inverse0 : HUGE_VAL;
        } else if (early1 <= late2) {
            c1 += 1.0;
            voxel += step1;
            early1 = c1 < n1 ? from1 + c1 * inverse1 : HUGE_VAL;
            late1 = early1 + wide1;
        } else {
            c2 += 1.0;
            voxel += step2;
            late2 = c2 < n2 ? from2 + c2 * inverse2 : HUGE_VAL;
        }
    }

    // Enters the next voxel in the active lanes.
    GMM_INLINE void advance(mask active) {
        const mask on0 = active & (early0 <= late1) & (early0 <= late2);
        const mask on1 = active & ~on0 & (early1 <= late2), on2 = active & ~(on0 | on1);
        c0 = on0 ? c0 + 1.0 : c0;
        c1 = on1 ? c1 + 1.0 : c1;
        c2 = on2 ? c2 + 1.0 : c2;
        voxel += (on0 & step0) | (on1 & step1) | (on2 & step2);
        find_times();
    }
};

// Calls visit(voxel) for each voxel, its flat index, that a ray leaves.
template <typename Visit>
GMM_INLINE void walk(const Rays& rays, int64_t ray, Visit visit) {
    const Start<OneLane> start(rays, ray, ray + 1);
    if (start.fits) {
        int64_t first = start.corner;
        for (int a = 0; a < 3; ++a) first += start.step[a] * (int64_t)start.first[a];
        Walk<OneLane> now(start, first, 0.0, 0.0, 0.0);
        for (int64_t left = (int64_t)(now.n0 + now.n1 + now.n2); left > 0; --left) {
            visit(now.voxel);
            now.advance();
        }
    } else if (start.meets_grid) {
        double skip = 0.0, crossed[3] = {0.0, 0.0, 0.0};  // what lies more than two voxels before the grid
        for (int a = 0; a < 3; ++a)
            if (start.count[a] > 0.0) {
                const double near = -2.0 - rays.tie * (fabs(start.origin[a]) + start.away[a]);
                skip = maximum(skip, (near - start.origin[a]) * start.inverse[a]);
            }
        for (int a = 0; a < 3; ++a)
            if (skip > 0.0 && start.count[a] > 0.0) {
                const double planes = ceil(start.origin[a] + skip * start.away[a]) - start.first[a] - 1.0;
                crossed[a] = minimum(maximum(planes, 0.0), start.count[a]);
            }
        Walk<OneLane> now(start, 0, crossed[0], crossed[1], crossed[2]);
        const double size0 = (double)rays.size[0], size1 = (double)rays.size[1], size2 = (double)rays.size[2];
        while (now.c0 < now.n0 || now.c1 < now.n1 || now.c2 < now.n2) {
            const double i = start.first[0] + now.c0, j = start.first[1] + now.c1,
                         k = start.first[2] + now.c2;
            if (i >= size0 || j >= size1 || k >= size2) break;
            if (i >= 0.0 && j >= 0.0 && k >= 0.0)
                visit(start.corner + now.step0 * (int64_t)i + now.step1 * (int64_t)j
                      + now.step2 * (int64_t)k);
            now.advance();
        }
    }
}

#if defined(GMM_VECTORS)
// Walks the rays from ray0 on, one in each lane, up to n_rays. Calls visit(voxels, active) for the voxels
// that the rays of the active lanes leave, and visit_alone(ray) for each ray that is not all inside the grid.
template <typename Visit, typename VisitAlone>
GMM_INLINE void walk_lanes(const Rays& rays, int64_t ray0, int64_t n_rays, Visit visit,
                           VisitAlone visit_alone) {
    const Start<EightLanes> start(rays, ray0, n_rays);
    for (int l = 0; l < LANES; ++l)
        if (start.meets_grid[l] && !start.fits[l]) visit_alone(ray0 + l);
    const vec zero = (vec)(0.0);
    EightLanes::whole first = start.corner;
    for (int a = 0; a < 3; ++a) first += start.step[a] * integer(start.fits ? start.first[a] : zero);
    Walk<EightLanes> now(start, first, zero, zero, zero);
    const vec left = start.fits ? now.n0 + now.n1 + now.n2 : zero;
    for (double n = 0.0; n < largest(left); n += 1.0) {
        const mask active = left > n;
        visit(now.voxel, active);
        now.advance(active);
    }
}
#endif

}  // namespace gmm

// Point evidence: hits and misses of the cubes around points from the cones near them.
#pragma once

#include "near_lists.h"

namespace gmm {

// Writes the inverses of DIM numbers, with one division; returns their product.
template <int DIM>
GMM_INLINE vec sharpen(const vec* wide, vec* sharp) {
    const vec pair = wide[0] * wide[1];
    if (DIM == 2) {
        const vec product = 1.0 / pair;
        sharp[0] = wide[1] * product;
        sharp[1] = wide[0] * product;
        return product;
    }
    const vec product = 1.0 / (pair * wide[DIM - 1]), third = wide[DIM - 1] * product;
    sharp[0] = wide[1] * third;
    sharp[1] = wide[0] * third;
    sharp[DIM - 1] = pair * product;
    return product;
}

// What the evidence of pairs of a point and a cone follows from. A pair is a lane of each vector.
template <int DIM>
struct Pairs {
    vec y[DIM], z[DIM], sharp[DIM], squared, aa, bb, determinant, breadth, at_sensor;
    vec log_scale, count, surface;
};

// A quick test of a cone: its mean is farther than the cutoff for the largest variance from the ray beyond x.
template <int DIM>
struct Quick {
    double origin[DIM], toward[DIM], widest, limit, cube;

    GMM_INLINE Quick(const double* cone, double h, double squared_cutoff) {
        const double *mean = cone + DIM * DIM, *variance = mean + 3 * DIM, *rest = variance + 2 * DIM;
        double seen_squared = 0.0;
        for (int j = 0; j < DIM; ++j) {
            origin[j] = mean[DIM + j];
            toward[j] = mean[j] - origin[j];
            seen_squared += toward[j] * toward[j];
        }
        widest = seen_squared * (1.0 - 1e-14) - squared_cutoff * (variance[DIM - 1] + h * h / 12.0);
        limit = squared_cutoff * rest[0];
        cube = 0.26 * DIM * h * h;  // a nearer cube may contain the sensor origin
    }

    // Whether the cone may give evidence at x.
    GMM_INLINE mask passes(const vec* x) const {
        vec square = (vec)(0.0), turn = (vec)(0.0);
        for (int j = 0; j < DIM; ++j) {
            const vec ray = x[j] - origin[j];
            square += ray * ray;
            turn += toward[j] * ray;
        }
        vec over = square * (1.0 - 1e-14) - turn;
        over = over > 0.0 ? over : (vec)(0.0);
        return (widest * square - turn * turn + over * over <= limit) | (square <= cube);
    }
};

// At which of the points x a cone, with a row as in `PointTable`, gives evidence to cubes of side h, and the
// pairs. limit: the square of the cutoff.
template <int DIM>
GMM_INLINE mask meeting(const double* cone, const vec* x, double h, double limit, Pairs<DIM>& pairs) {
    const double *mean = cone + DIM * DIM, *origin = mean + DIM, *seen = origin + DIM;
    const double *variance = seen + DIM, *fixed = variance + DIM, *rest = fixed + DIM;
    vec ray[DIM], squared_distance = (vec)(0.0);
    for (int j = 0; j < DIM; ++j) {
        ray[j] = x[j] - origin[j];
        squared_distance += ray[j] * ray[j];
    }
    vec *y = pairs.y, *z = pairs.z, *sharp = pairs.sharp, squared = (vec)(0.0);
    for (int j = 0; j < DIM; ++j) {
        y[j] = (vec)(0.0);
        for (int i = 0; i < DIM; ++i) y[j] += cone[i * DIM + j] * (x[i] - mean[i]);
        z[j] = y[j] + seen[j];
        squared += fixed[j] * y[j] * y[j];
    }
    const vec kappa = rest[0] / squared_distance;
    vec wide[DIM];
    for (int j = 0; j < DIM; ++j) wide[j] = variance[j] + kappa;
    pairs.determinant = sharpen<DIM>(wide, sharp);
    vec aa = (vec)(0.0), bb = (vec)(0.0), cc = (vec)(0.0);
    for (int j = 0; j < DIM; ++j) {
        aa += sharp[j] * z[j] * z[j];
        bb += sharp[j] * y[j] * z[j];
        cc += sharp[j] * y[j] * y[j];
    }
    vec breadth = (vec)(0.0), extent = (vec)(0.0);
    for (int j = 0; j < DIM; ++j) {
        const vec size = ray[j] < 0.0 ? -ray[j] : ray[j];
        breadth += size;
        extent = size > extent ? size : extent;
    }
    const mask at_sensor = extent <= 0.5 * h;
    pairs.squared = squared, pairs.aa = aa, pairs.bb = bb, pairs.breadth = breadth;
    pairs.at_sensor = at_sensor ? (vec)(1.0) : (vec)(0.0);
    pairs.log_scale = (vec)(rest[1]), pairs.count = (vec)(rest[2]), pairs.surface = (vec)(rest[3]);
    // Conservative: squares of differences lose digits, which the second term allows for.
    const vec room = (limit * (1.0 + 1e-9) + 1e-9 * cc) * aa;
    const mask passes = (cc * aa - bb * bb < room) & !((bb > 0.0) & (bb * bb > room));
    return at_sensor | passes | (squared < limit);
}

// Hits and misses of pairs.
template <int DIM>
GMM_INLINE void evaluate(const Pairs<DIM>& pairs, double h, double limit, vec& hits, vec& misses) {
    const vec *y = pairs.y, *z = pairs.z, *sharp = pairs.sharp;
    const vec squared = pairs.squared, aa = pairs.aa, breadth = pairs.breadth;
    vec hit = (vec)(0.0);
    if (any(squared < limit)) {
        vec fade = limit - squared;
        fade = fade < 0.0 ? (vec)(0.0) : fade > 1.0 ? (vec)(1.0) : fade;
        hit = expo(pairs.log_scale - 0.5 * squared) * fade;
        hit = hit > 1.0 ? (vec)(1.0) : hit;
    }
    const vec length = root(aa), share = pairs.bb / aa;
    vec across = (vec)(0.0);
    for (int j = 0; j < DIM; ++j) {
        const vec part = y[j] - share * z[j];
        across += sharp[j] * part * part;
    }
    const vec along = share * length, leaving = along + 0.5 * h * length / breadth;
    const vec beyond = leaving > 0.0 ? leaving : (vec)(0.0);
    vec fade = limit - across - beyond * beyond;
    fade = fade < 0.0 ? (vec)(0.0) : fade > 1.0 ? (vec)(1.0) : fade;
    const vec edge = expo(-0.5 * leaving * leaving);
    const vec ratio = edge * mills(leaving < 0.0 ? -leaving : leaving);
    const vec tail = leaving < 0.0 ? 2.5066282746310002 - ratio : ratio;
    const vec depth = length - along;
    const vec moment =
        DIM == 2 ? depth * tail + edge : (depth * depth + 1.0) * tail + (2.0 * depth + leaving) * edge;
    const vec norm = DIM == 2 ? 6.283185307179586 * aa : 15.749609945722419 * aa * length;
    const vec peak = expo(-0.5 * across) * root(pairs.determinant) / norm;
    vec miss = peak * moment * breadth * h * (DIM == 2 ? 1.0 : h) * fade;
    miss = pairs.at_sensor > 0.0 ? (vec)(1.0) : miss;
    miss = miss < 1.0 - hit ? miss : 1.0 - hit;
    hits = hit * pairs.surface;
    misses = miss * pairs.count;
}

// Pairs that wait until they fill a vector, because few lanes of one have evidence. Those of a point are
// added in the order in which they come.
template <int DIM>
struct Held {
    double h, limit, *hits, *misses;
    int64_t point[LANES];
    int n = 0;
    Pairs<DIM> pairs;

    // Takes the pairs of a cone and the points at x, with these numbers, at which it gives evidence. active:
    // bits of points.
    GMM_INLINE void take(const double* cone, const vec* x, unsigned active, const int64_t* numbers) {
        Pairs<DIM> others;
        for (unsigned found = active & bits(meeting<DIM>(cone, x, h, limit, others)); found;) {
            const int from = take_lowest(found);
            for (int i = 0; i < (int)(sizeof(Pairs<DIM>) / sizeof(vec)); ++i)
                ((double*)&pairs)[i * LANES + n] = ((const double*)&others)[i * LANES + from];
            point[n++] = numbers[from];
            if (n == LANES) add_all();
        }
    }

    GMM_INLINE void add_all() {
        vec hit, miss;
        if (n > 0) evaluate<DIM>(pairs, h, limit, hit, miss);
        for (int i = 0; i < n; ++i) {
            hits[point[i]] += get(hit, i);
            misses[point[i]] += get(miss, i);
        }
        n = 0;
    }
};

// The bits of the first n lanes.
GMM_INLINE unsigned first_bits(int64_t n) {
    return (1u << minimum(maximum(n, (int64_t)0), (int64_t)LANES)) - 1;
}

constexpr int GROUP = 64;  // neighbouring points

// An item is LANES groups of points, with boxes lows, highs: on CUDA those of a block, one of each thread.
// Adds the evidence of all cones. Each is first compared with a ball around each group.
template <int DIM>
GMM_KERNEL grouped_evidence(int64_t item, const double* points, const int64_t* order, int64_t n_points,
                            const double* lows, const double* highs, const double* table, int64_t n_cones,
                            double resolution, double cutoff, double* hits_out, double* misses_out) {
    constexpr int WIDTH = DIM * DIM + 5 * DIM + 4, PARTS = GROUP / LANES;
    const double h = resolution, limit = cutoff * cutoff;
    const double spread = cutoff * h * 0.28867513459481287, cube_reach = 0.5 * h * sqrt((double)DIM);
    const Squad squad = squad_of(item);
    const int64_t begin = squad.item * LANES * GROUP;
    vec x[GROUP / THREADS][DIM], center[DIM], reach = (vec)(0.0);
    for (int l = 0; l < LANES; ++l) {
        const int64_t group = minimum(begin / GROUP + l, (n_points - 1) / GROUP);
        for (int a = 0; a < DIM; ++a)
            set(center[a], l, 0.5 * (lows[group * DIM + a] + highs[group * DIM + a]));
        for (int i = 0; i < GROUP; ++i) {
            const double* point = points + order[minimum(group * GROUP + i, n_points - 1)] * DIM;
            const int part = l * PARTS + i / LANES;
            double square = 0.0;
            for (int a = 0; a < DIM; ++a) {
                const double offset = point[a] - get(center[a], l);
                square += offset * offset;
                if (part % THREADS == squad.lane) set(x[part / THREADS][a], i % LANES, point[a]);
            }
            set(reach, l, maximum(get(reach, l), square));
        }
    }
    reach = root(reach);
    const unsigned used = first_bits((n_points - begin + GROUP - 1) / GROUP);
    Held<DIM> held{h, limit, hits_out, misses_out};
    GMM_SHARED unsigned near[THREADS];
    for (int64_t first = 0; first < n_cones; first += THREADS) {
        const double* row = table + minimum(first + squad.lane, n_cones - 1) * WIDTH;
        Sight<DIM> sight;
        mask close = sees<DIM>(row, center, reach, spread, cutoff, sight);
        close |= sight.distance <= (reach + cube_reach) * (1.0 + 1e-9);
        meet(squad);
        near[squad.lane] = bits(close) & used;
        meet(squad);
        for (int i = 0; i < THREADS && first + i < n_cones; ++i)
            for (unsigned left = near[i]; left;) {
                const int l = take_lowest(left);
                const double* cone = table + (first + i) * WIDTH;
                const vec(*places)[DIM] = x + l * PARTS / THREADS;
                const Quick<DIM> quick(cone, h, limit);
                unsigned passing = 0;
                for (int j = 0; j < PARTS / THREADS; ++j)
                    passing |= (unsigned)any(quick.passes(places[j])) << j;
                while (passing) {
                    const int j = take_lowest(passing);
                    const int64_t at = begin + l * GROUP + (squad.lane + j * THREADS) * LANES;
                    held.take(cone, places[j], first_bits(n_points - at), order + at);
                }
            }
    }
    held.add_all();
}

// An item is LANES points. The cones of a table have rows as in `PointTable`.
template <int DIM>
GMM_KERNEL point_evidence(int64_t item, const double* points, const int64_t* order, const int64_t* bucket,
                          int64_t n_points, const int64_t* starts, const int32_t* entries,
                          const double* table, double resolution, double cutoff, double* hits_out,
                          double* misses_out) {
    constexpr int WIDTH = DIM * DIM + 5 * DIM + 4;
    const double h = resolution, limit = cutoff * cutoff;
    const int64_t begin = item * LANES, stop = minimum(begin + LANES, n_points);
    vec x[DIM], number = (vec)(-1.0);
    for (int l = 0; l < LANES; ++l) {
        const int64_t point = order[minimum(begin + l, stop - 1)];
        for (int a = 0; a < DIM; ++a) set(x[a], l, points[point * DIM + a]);
        if (begin + l < stop) set(number, l, (double)bucket[point]);
    }
    Held<DIM> held{h, limit, hits_out, misses_out};
    for (int first = 0; first < LANES; ++first) {  // each bucket of these points once
        const double mine = get(number, first);
        if (mine < 0.0 || (first > 0 && get(number, first - 1) == mine)) continue;
        const unsigned active = bits(number == mine);
        const int64_t list = (int64_t)mine;
        for (int64_t entry = starts[list]; entry < starts[list + 1]; ++entry) {
            const double* cone = table + entries[entry] * WIDTH;
            fetch(table + entries[minimum(entry + 6, starts[list + 1] - 1)] * WIDTH, WIDTH);
            const unsigned passing = active & bits(Quick<DIM>(cone, h, limit).passes(x));
            if (passing) held.take(cone, x, passing, order + begin);
        }
    }
    held.add_all();
}

}  // namespace gmm

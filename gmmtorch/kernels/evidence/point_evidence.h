// Point evidence: hits and misses of the cubes around points from the cones near them.
#pragma once

#include "../lanes.h"

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
    vec squared, aa, share, across, determinant, breadth, at_sensor, log_scale, count, surface;
};

// Sets what quick tests of a cone read, in single precision. With t = mean - s, the cutoff c and the largest
// variance v: s relative to the first mean, t, |t|^2, 1/|t|^2, W, B = c^2 (v + h^2/12) and L = c^2 h^2/12
// |t|^2. If the cone gives evidence at x = s + u, then d^2 <= B + L/|u|^2, where d is the distance of the
// mean from the nearest point p of the ray beyond x; and x is within d |u|/|p - s| of the segment from s to
// the mean. Because of |t|^2 <= |p - s|^2 + d^2 this is at most the root of 9/8 (B + c^2 h^2/12), if |u|^2 is
// at least 9 c^2 h^2/12; a nearer x is within |u|. So x is within W of the segment.
template <int DIM>
GMM_KERNEL glance_at(int64_t item, const double* table, double resolution, double cutoff, float* glances) {
    const double* cone = table + item * (DIM * DIM + 5 * DIM + 4);
    const double *mean = cone + DIM * DIM, *origin = mean + DIM, *variance = mean + 3 * DIM;
    float* row = glances + item * (2 * DIM + 5);
    double seen = 0.0, away = 0.0;
    for (int a = 0; a < DIM; ++a) {
        const double from = origin[a] - table[DIM * DIM + a], toward = mean[a] - origin[a];
        row[a] = (float)from;
        row[DIM + a] = (float)toward;
        away += from * from;
        seen += toward * toward;
    }
    const double limit = cutoff * cutoff, cube = resolution * resolution / 12.0;
    const double widest = limit * variance[DIM - 1];
    const double reach = 1.125 * widest + (9.0 * limit + 3.0 * DIM) * cube;
    const bool is_far = !(away + seen < 1e18);  // squares leave the range of the type: every point passes
    row[2 * DIM] = (float)seen;
    row[2 * DIM + 1] = (float)(1.0 / maximum(seen, 1e-30));
    row[2 * DIM + 2] = is_far ? INFINITY : (float)(1.0001 * root(reach) + 1e-5 * root(seen));
    row[2 * DIM + 3] = is_far ? INFINITY : (float)(1.001 * (widest + limit * cube));
    row[2 * DIM + 4] = is_far ? INFINITY : (float)(1.001 * limit * cube * seen);
}

// Quick tests of a cone, with a row of `glance_at`. F(x) is |u| times the distance of the mean from the ray
// beyond x. extent: of points x, from the first mean; with `slack` and `side` it allows for the rounding of
// positions, as 5e-6 does for that of F^2.
template <int DIM>
struct Glance {
    const float *origin, *toward, *rest;
    float linear, constant, cube;

    GMM_INLINE Glance(const float* row, double h, double extent)
        : origin(row), toward(row + DIM), rest(row + 2 * DIM) {
        const float slack = extent < 1e9 ? (float)(2e-9 * extent * extent) : INFINITY;
        const float side = (float)(h + 2e-6 * extent);
        linear = rest[0] * (1.0f - 5e-6f) - rest[3] - slack;
        constant = rest[4] + rest[0] * slack;
        cube = 0.26f * DIM * side * side;  // a nearer cube may contain the sensor origin
    }

    // Whether the cone may give evidence at x.
    GMM_INLINE unsigned reaches(const single* x) const {
        single square = (single)(0.0f), turn = square;
        for (int j = 0; j < DIM; ++j) {
            const single ray = x[j] - origin[j];
            square += ray * ray;
            turn += toward[j] * ray;
        }
        single over = square - turn;
        over = over > 0.0f ? over : (single)(0.0f);
        const single missed = square * (linear - 5e-6f * square) - turn * turn + over * over;
        return bits(!(missed > constant) | (square <= cube));
    }

    // Whether it may give evidence within a distance of x.
    GMM_INLINE unsigned reaches(const single* x, single distance) const {
        single ray[DIM], part = (single)(0.0f), square = part;
        for (int j = 0; j < DIM; ++j) {
            ray[j] = x[j] - origin[j];
            part += toward[j] * ray[j];
        }
        part *= rest[1];
        part = part < 0.0f ? (single)(0.0f) : part > 1.0f ? (single)(1.0f) : part;
        for (int j = 0; j < DIM; ++j) {
            const single across = ray[j] - part * toward[j];
            square += across * across;
        }
        const single within = distance + rest[2];
        return bits(!(square > within * within));
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
    vec y[DIM], z[DIM], sharp[DIM], squared = (vec)(0.0), across = squared;
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
    const vec share = bb / aa;
    for (int j = 0; j < DIM; ++j) {
        const vec part = y[j] - share * z[j];
        across += sharp[j] * part * part;
    }
    pairs.squared = squared, pairs.aa = aa, pairs.share = share, pairs.across = across;
    pairs.breadth = breadth;
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
    const vec squared = pairs.squared, aa = pairs.aa, across = pairs.across, breadth = pairs.breadth;
    vec hit = (vec)(0.0);
    if (any(squared < limit)) {
        vec fade = limit - squared;
        fade = fade < 0.0 ? (vec)(0.0) : fade > 1.0 ? (vec)(1.0) : fade;
        hit = expo(pairs.log_scale - 0.5 * squared) * fade;
        hit = hit > 1.0 ? (vec)(1.0) : hit;
    }
    const vec length = root(aa);
    const vec along = pairs.share * length, leaving = along + 0.5 * h * length / breadth;
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
// Adds the evidence of all cones. Each is first compared with balls around the groups, then with the points
// of those that it may reach.
template <int DIM>
GMM_KERNEL grouped_evidence(int64_t item, const double* points, const int64_t* order, int64_t n_points,
                            const double* lows, const double* highs, const double* table,
                            const float* glances, int64_t n_cones, double resolution, double cutoff,
                            double* hits_out, double* misses_out) {
    constexpr int WIDTH = DIM * DIM + 5 * DIM + 4, SHORT = 2 * DIM + 5, PARTS = GROUP / LANES / THREADS;
    const Squad squad = squad_of(item);
    const int64_t begin = squad.item * LANES * GROUP;
    const double* reference = table + DIM * DIM;
    double extent = 0.0;
    single x[LANES][PARTS][DIM], center[DIM], reach = (single)(0.0f);
    for (int l = 0; l < LANES; ++l) {
        const int64_t group = minimum(begin / GROUP + l, (n_points - 1) / GROUP);
        double middle[DIM], widest = 0.0, away = 0.0;
        for (int a = 0; a < DIM; ++a) {
            middle[a] = 0.5 * (lows[group * DIM + a] + highs[group * DIM + a]);
            set(center[a], l, (float)(middle[a] - reference[a]));
            away += (middle[a] - reference[a]) * (middle[a] - reference[a]);
        }
        for (int i = 0; i < GROUP; ++i) {
            const double* point = points + order[minimum(group * GROUP + i, n_points - 1)] * DIM;
            const int part = i / LANES;
            double square = 0.0;
            for (int a = 0; a < DIM; ++a) {
                square += (point[a] - middle[a]) * (point[a] - middle[a]);
                if (part % THREADS == squad.lane)
                    set(x[l][part / THREADS][a], i % LANES, (float)(point[a] - reference[a]));
            }
            widest = maximum(widest, square);
        }
        set(reach, l, (float)root(widest));
        extent = maximum(extent, root(away) + root(widest));
    }
    reach = 1.0001f * reach + (float)(2e-6 * extent);
    const unsigned used = first_bits((n_points - begin + GROUP - 1) / GROUP);
    Held<DIM> held{resolution, cutoff * cutoff, hits_out, misses_out};
    GMM_SHARED unsigned near[THREADS];
    for (int64_t first = 0; first < n_cones; first += THREADS) {
        const float* row = glances + minimum(first + squad.lane, n_cones - 1) * SHORT;
        meet(squad);
        near[squad.lane] = Glance<DIM>(row, resolution, extent).reaches(center, reach) & used;
        meet(squad);
        for (int i = 0; i < THREADS && first + i < n_cones; ++i) {
            const double* cone = table + (first + i) * WIDTH;
            const Glance<DIM> glance(glances + (first + i) * SHORT, resolution, extent);
            vec some[DIM] = {};  // of the points that it may reach
            int64_t numbers[LANES];
            int n = 0;
            for (unsigned left = near[i]; left;) {
                const int l = take_lowest(left);
                for (int j = 0; j < PARTS; ++j) {
                    unsigned found = glance.reaches(x[l][j]);
                    if (!found) continue;
                    const int64_t at = begin + l * GROUP + (squad.lane + j * THREADS) * LANES;
                    for (found &= first_bits(n_points - at); found;) {
                        const int64_t point = order[at + take_lowest(found)];
                        for (int a = 0; a < DIM; ++a) set(some[a], n, points[point * DIM + a]);
                        numbers[n++] = point;
                        if (n == LANES) held.take(cone, some, first_bits(n), numbers), n = 0;
                    }
                }
            }
            if (n > 0) held.take(cone, some, first_bits(n), numbers);
        }
    }
    held.add_all();
}

// An item is LANES points. The cones of a table have rows as in `PointTable`.
template <int DIM>
GMM_KERNEL point_evidence(int64_t item, const double* points, const int64_t* order, const int64_t* bucket,
                          int64_t n_points, const int64_t* starts, const int32_t* entries,
                          const double* table, const float* glances, double resolution, double cutoff,
                          double* hits_out, double* misses_out) {
    constexpr int WIDTH = DIM * DIM + 5 * DIM + 4, SHORT = 2 * DIM + 5;
    const int64_t begin = item * LANES, stop = minimum(begin + LANES, n_points);
    vec x[DIM], number = (vec)(-1.0);
    for (int l = 0; l < LANES; ++l) {
        const int64_t point = order[minimum(begin + l, stop - 1)];
        for (int a = 0; a < DIM; ++a) set(x[a], l, points[point * DIM + a]);
        if (begin + l < stop) set(number, l, (double)bucket[point]);
    }
    vec away = (vec)(0.0);
    single near_x[DIM];
    for (int a = 0; a < DIM; ++a) {
        const vec offset = x[a] - table[DIM * DIM + a];
        away += offset * offset;
        near_x[a] = narrow(offset);
    }
    const double extent = root(largest(away));
    Held<DIM> held{resolution, cutoff * cutoff, hits_out, misses_out};
    for (int first = 0; first < LANES; ++first) {  // each bucket of these points once
        const double mine = get(number, first);
        if (mine < 0.0 || (first > 0 && get(number, first - 1) == mine)) continue;
        const unsigned active = bits(number == mine);
        const int64_t list = (int64_t)mine;
        for (int64_t entry = starts[list]; entry < starts[list + 1]; ++entry) {
            const int64_t cone = entries[entry], ahead = entries[minimum(entry + 6, starts[list + 1] - 1)];
            fetch((const double*)(glances + ahead * SHORT), SHORT / 2);
            const Glance<DIM> glance(glances + cone * SHORT, resolution, extent);
            const unsigned passing = active & glance.reaches(near_x);
            if (passing) held.take(table + cone * WIDTH, x, passing, order + begin);
        }
    }
    held.add_all();
}

}  // namespace gmm

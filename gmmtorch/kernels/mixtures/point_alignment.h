// Sums over the points of a scan that is aligned with a mixture, or laid over a raster.
#pragma once

#include "../lanes.h"
#include "rigid_steps.h"

namespace gmm {

constexpr double STILL = 1e-9;  // metres: a shorter step changes nothing

// The surfaces that a scan is aligned with, listed by the cells of a lattice; see `NearLists` and
// `alignment_sums`.
struct Aligned {
    const double* low;
    double side;
    const int64_t* shape;
    const int64_t* starts;
    const int32_t* entries;
    const double* surfaces;
    double behind;
    double farthest;
    double outliers;
    double explained;
};

// Lists the boxes that hold each cell of a lattice. A worker lists those of its pieces, which are strips
// along the second axis of the cells of one first coordinate.
template <int DIM>
GMM_KERNEL box_lists(int64_t item, Team team, const int64_t* first, const int64_t* last, int64_t n_boxes,
                     int64_t n_x, int64_t n_y, int64_t high, int64_t n_strips, int64_t* totals,
                     int64_t* starts, int32_t* entries) {
    const int64_t n_pieces = n_x * n_strips;
    for (int fills = 0; fills < 2; ++fills) {
        for (int64_t piece = item; piece < n_pieces; piece += team.n) {
            const int64_t x = piece / n_strips, strip = piece % n_strips;
            const int64_t from = n_y * strip / n_strips, to = n_y * (strip + 1) / n_strips;
            int64_t* ends = starts + 1 + x * n_y * high;  // of the lists of these cells; first, their lengths
            int64_t total = 0;
            for (int64_t before = 0; before < piece && fills; ++before) total += totals[before];
            for (int64_t cell = from * high; cell < to * high; ++cell) {
                const int64_t length = ends[cell];
                ends[cell] = total;
                total += fills ? length : 0;
            }
            for (int64_t k = 0; k < n_boxes; ++k) {
                const int64_t *lowest = first + k * DIM, *highest = last + k * DIM;
                if (x < lowest[0] || x > highest[0]) continue;
                const int64_t bottom = DIM == 3 ? lowest[DIM - 1] : 0, top = DIM == 3 ? highest[DIM - 1] : 0;
                for (int64_t y = maximum(from, lowest[1]); y < to && y <= highest[1]; ++y)
                    for (int64_t z = bottom; z <= top; ++z) {
                        int64_t& end = ends[y * high + z];
                        if (fills) entries[end] = (int32_t)k;
                        ++end;
                        ++total;
                    }
            }
            if (!fills) totals[piece] = total;
        }
        meet(team);
    }
    if (item == 0) starts[0] = 0;
}

// Numbers of a surface: its mean, its normal, the upper triangle of its precision, and zeros up to a whole
// number of quadruples.
CUDA_CALLABLE constexpr int n_of_surface(int dim) { return (2 * dim + dim * (dim + 1) / 2 + 3) / 4 * 4; }

CUDA_CALLABLE constexpr int n_alignment_sums(int dim) { return 2 + n_free(dim) * (n_free(dim) + 2); }

// Sums over the points begin … stop - 1 under one motion: log(1 + q/outliers), whether q is above the height
// of an explained point, the gradient, and the upper triangles of the complete and of the observed
// information. Without derivatives the first one alone.
template <int DIM, bool DERIVES>
GMM_INLINE void point_sums(const double* pose, const double* points, int64_t begin, int64_t stop,
                           const Aligned& target, double* sums) {
    const double* shift = pose + DIM * DIM;
    constexpr int TURNS = n_free(DIM) - DIM, N_SUMS = DERIVES ? n_alignment_sums(DIM) : 1;
    constexpr int N_NUMBERS = n_of_surface(DIM);
    vec sum[N_SUMS];
    for (int s = 0; s < N_SUMS; ++s) sum[s] = (vec)(0.0);
    for (int64_t n = begin; n < stop; n += LANES) {
        vec l[DIM], at[DIM], pull[DIM], weight[DIM][DIM], spread[DIM][DIM], total = (vec)(target.outliers);
        for (int i = 0; i < DIM; ++i) {
            vec x[DIM];
            for (int j = 0; j < DIM; ++j) {
                weight[i][j] = spread[i][j] = (vec)(0.0);
                for (int lane = 0; lane < LANES; ++lane)
                    set(x[j], lane, points[minimum(n + lane, stop - 1) * DIM + j]);
            }
            l[i] = pull[i] = (vec)(0.0);
            for (int j = 0; j < DIM; ++j) l[i] = fused((vec)(pose[i * DIM + j]), x[j], l[i]);
            at[i] = l[i] + shift[i];
        }
        int64_t next[LANES], last[LANES], most = 0;
        for (int lane = 0; lane < LANES; ++lane) {
            int64_t bucket = 0;
            bool is_listed = n + lane < stop;
            for (int i = 0; i < DIM; ++i) {
                const double cell = floor((get(at[i], lane) - target.low[i]) / target.side);
                is_listed = is_listed && cell >= 0.0 && cell < (double)target.shape[i];
                bucket = bucket * target.shape[i] + (is_listed ? (int64_t)cell : 0);
            }
            next[lane] = is_listed ? target.starts[bucket] : 0;
            last[lane] = is_listed ? target.starts[bucket + 1] : 0;
            most = maximum(most, last[lane] - next[lane]);
        }
        for (; most > 0; --most) {
            vec surface[N_NUMBERS], precision[DIM][DIM], is_there = (vec)(0.0);
            int64_t row[LANES];
            for (int lane = 0; lane < LANES; ++lane) {
                const bool is_more = next[lane] < last[lane];
                row[lane] = is_more ? target.entries[next[lane]] : 0;
                set(is_there, lane, is_more ? 1.0 : 0.0);
                next[lane] += is_more;
            }
            load_rows<N_NUMBERS>(target.surfaces, [&](int l) { return row[l]; }, surface);
            const vec *mean = surface, *normal = surface + DIM, *triangle = surface + 2 * DIM;
            for (int i = 0; i < DIM; ++i)
                for (int j = i; j < DIM; ++j) precision[i][j] = *triangle++;
            vec above = (vec)(0.0), square = (vec)(0.0), d[DIM], p[DIM];  // above: the sensor over the face
            for (int i = 0; i < DIM; ++i) {
                above = fused(normal[i], shift[i] - mean[i], above);
                d[i] = at[i] - mean[i];
            }
            for (int i = 0; i < DIM; ++i) {
                p[i] = (vec)(0.0);
                for (int j = 0; j < DIM; ++j)
                    p[i] = fused(precision[minimum(i, j)][maximum(i, j)], d[j], p[i]);
                square = fused(d[i], p[i], square);
            }
            vec height = expo(-0.5 * square) * is_there;
            height = above < -target.behind ? (vec)(0.0) : height;
            height = square > target.farthest ? (vec)(0.0) : height;
            total += height;
            for (int i = 0; i < DIM && DERIVES; ++i) {
                pull[i] = fused(height, p[i], pull[i]);
                for (int j = i; j < DIM; ++j) {
                    weight[i][j] = fused(height, precision[i][j], weight[i][j]);
                    spread[i][j] = fused(height * p[i], p[j], spread[i][j]);
                }
            }
        }
        sum[0] += logarithm(total / target.outliers);
        if (!DERIVES) continue;
        sum[1] += total > target.explained ? (vec)(1.0) : (vec)(0.0);
        const vec share = 1.0 / total;
        for (int i = 0; i < DIM; ++i) {
            pull[i] *= share;
            sum[2 + i] -= pull[i];
        }
        for (int i = 0; i < DIM; ++i)
            for (int j = i; j < DIM; ++j) {
                weight[i][j] = weight[j][i] = weight[i][j] * share;
                spread[i][j] = spread[j][i] = weight[i][j] - spread[i][j] * share + pull[i] * pull[j];
            }
        for (int k = 0; k < TURNS; ++k) {  // a point moves by G_k x = (-x_j, x_i) in the rows (i, j)
            const int i = DIM == 2 ? 0 : (k + 1) % DIM, j = DIM == 2 ? 1 : (k + 2) % DIM;
            sum[2 + DIM + k] += l[j] * pull[i] - l[i] * pull[j];
        }
        int place = 2 + DIM + TURNS;
        for (int which = 0; which < 2; ++which) {
            const auto& w = which ? spread : weight;
            vec turned[DIM][TURNS];  // W G_k x
            for (int k = 0; k < TURNS; ++k) {
                const int i = DIM == 2 ? 0 : (k + 1) % DIM, j = DIM == 2 ? 1 : (k + 2) % DIM;
                for (int r = 0; r < DIM; ++r) turned[r][k] = w[r][j] * l[i] - w[r][i] * l[j];
            }
            for (int r = 0; r < DIM; ++r) {
                for (int q = r; q < DIM; ++q) sum[place++] += w[r][q];
                for (int k = 0; k < TURNS; ++k) sum[place++] += turned[r][k];
            }
            for (int k = 0; k < TURNS; ++k) {
                const int i = DIM == 2 ? 0 : (k + 1) % DIM, j = DIM == 2 ? 1 : (k + 2) % DIM;
                for (int m = k; m < TURNS; ++m) sum[place++] += turned[j][m] * l[i] - turned[i][m] * l[j];
            }
        }
    }
    for (int s = 0; s < N_SUMS; ++s) {
        sums[s] = 0.0;
        for (int lane = 0; lane < LANES; ++lane) sums[s] += get(sum[s], lane);
    }
}

// An item is a motion.
template <int DIM>
GMM_KERNEL point_scores(int64_t item, const double* points, int64_t n_points, const double* rotations,
                        const double* translations, Aligned target, double* scores) {
    double pose[n_of_pose(DIM)];
    for (int i = 0; i < n_of_pose(DIM); ++i)
        pose[i] = i < DIM * DIM ? rotations[item * DIM * DIM + i] : translations[item * DIM + i - DIM * DIM];
    point_sums<DIM, false>(pose, points, 0, n_points, target, scores + item);
}

// The climb from one start: the motion, its sums, and whether the last step was short; then what is not a
// result.
template <int DIM>
struct Aligning {
    static constexpr int FREE = n_free(DIM), N_SUMS = n_alignment_sums(DIM);
    double pose[n_of_pose(DIM)], score, n_explained, slope[FREE], complete[FREE][FREE], observed[FREE][FREE];
    double settled, trial[n_of_pose(DIM)], sums[N_SUMS], share, length;
};

// Takes the trial if its score is not worse.
template <int DIM>
GMM_INLINE void absorb(Aligning<DIM>& climb, bool is_start, double settled) {
    constexpr int FREE = n_free(DIM);
    const bool is_better = is_start || climb.sums[0] >= climb.score;
    climb.settled = !is_start && climb.length < settled;
    if (!is_start) climb.share = is_better ? minimum(2.0 * climb.share, 1.0) : climb.share / 4.0;
    if (!is_better) return;
    for (int i = 0; i < n_of_pose(DIM); ++i) climb.pose[i] = climb.trial[i];
    climb.score = climb.sums[0];
    climb.n_explained = climb.sums[1];
    for (int i = 0; i < FREE; ++i) climb.slope[i] = climb.sums[2 + i];
    int place = 2 + FREE;
    for (int i = 0; i < FREE; ++i)
        for (int j = i; j < FREE; ++j, ++place) {
            climb.complete[i][j] = climb.complete[j][i] = climb.sums[place];
            climb.observed[i][j] = climb.observed[j][i] = climb.sums[place + FREE * (FREE + 1) / 2];
        }
}

// The next trial: Newton's step, or that of EM where the observed information has too little curvature, which
// moves no point by more than about `longest`.
template <int DIM>
GMM_INLINE void advance(Aligning<DIM>& climb, double farthest, double longest) {
    constexpr int FREE = n_free(DIM);
    constexpr double SADDLE = 0.05, RIDGE = 1e-9;
    double root[FREE][FREE], observed[FREE][FREE], complete[FREE][FREE], step[FREE], unit[FREE], square = 0.0;
    double ridge = 1e-12;
    for (int i = 0; i < FREE; ++i) unit[i] = i < DIM ? 1.0 : 1.0 / farthest;
    for (int i = 0; i < FREE; ++i)
        for (int j = 0; j <= i; ++j) {
            complete[i][j] = climb.complete[i][j] * unit[i] * unit[j];
            observed[i][j] = climb.observed[i][j] * unit[i] * unit[j];
        }
    for (int i = 0; i < FREE; ++i) ridge = maximum(ridge, complete[i][i]);
    for (int i = 0; i < FREE; ++i) {
        complete[i][i] += RIDGE * ridge;
        step[i] = climb.slope[i] * unit[i];
        for (int j = 0; j <= i; ++j) root[i][j] = observed[i][j] - SADDLE * complete[i][j];
    }
    const bool is_curved = factorise<FREE>(root, 0.0);
    for (int i = 0; i < FREE; ++i)
        for (int j = 0; j <= i; ++j) root[i][j] = is_curved ? observed[i][j] : complete[i][j];
    factorise<FREE>(root, 0.0);
    solve_lower<FREE>(root, step);
    solve_upper<FREE>(root, step);
    for (int i = 0; i < FREE; ++i) square += step[i] * step[i];
    const double share = longest / maximum(sqrt(square), longest) * climb.share;
    for (int i = 0; i < FREE; ++i) step[i] *= share * unit[i];
    climb.length = sqrt(square) * share;
    move<DIM>(climb.pose, step, climb.trial);
}

// Climbs the score from all motions. A step that lowers it is taken back, and the next one is shorter. space:
// an `Aligning` for each motion, of which the first part is the result, then the sums of parts of the points.
template <int DIM>
GMM_KERNEL alignment(int64_t item, Team team, const double* points, int64_t n_points, int64_t n_parts,
                     int64_t n_motions, const double* rotations, const double* translations, Aligned target,
                     double settled, int64_t max_steps, double* space) {
    constexpr int POSE = n_of_pose(DIM), N_SUMS = n_alignment_sums(DIM);
    Aligning<DIM>* climbs = (Aligning<DIM>*)space;
    double *partial = (double*)(climbs + n_motions), farthest = 1e-9;
    for (int64_t n = 0; n < n_points; ++n) {
        double square = 0.0;
        for (int i = 0; i < DIM; ++i) square += points[n * DIM + i] * points[n * DIM + i];
        farthest = maximum(farthest, square);
    }
    farthest = maximum(sqrt(farthest), 1e-9);
    for (int64_t b = item; b < n_motions; b += team.n) {
        for (int i = 0; i < POSE; ++i)
            climbs[b].trial[i] =
                i < DIM * DIM ? rotations[b * DIM * DIM + i] : translations[b * DIM + i - DIM * DIM];
        climbs[b].share = climbs[b].length = 1.0;
    }
    meet(team);
    bool is_settled = false;
    for (int64_t step = 0; step <= max_steps && !is_settled; ++step) {
        for (int64_t piece = item; piece < n_motions * n_parts; piece += team.n) {
            const int64_t b = piece / n_parts, part = piece % n_parts;
            if (climbs[b].length >= STILL)
                point_sums<DIM, true>(climbs[b].trial, points, n_points * part / n_parts,
                                      n_points * (part + 1) / n_parts, target, partial + piece * N_SUMS);
        }
        meet(team);
        add_parts(item, team, n_motions, n_parts, partial, climbs);
        meet(team);
        for (int64_t b = item; b < n_motions; b += team.n) {
            Aligning<DIM>& climb = climbs[b];
            if (climb.length < STILL) continue;
            absorb<DIM>(climb, step == 0, settled);
            advance<DIM>(climb, farthest, target.behind);
        }
        meet(team);
        is_settled = true;
        for (int64_t b = 0; b < n_motions; ++b) is_settled = is_settled && climbs[b].settled;
    }
}

// Where a scan is expected; see `Prior`.
struct Expected {
    const double* places;
    const double* turned;
    int64_t n;
    double share;
    double cell;
    double distance;
    double angle;
    double max_step;
    double max_turn;
    double tail;
    double never;
};

constexpr int LISTED = 128;  // points whose places in a raster are listed at a time

// An item is a heading, with the shifts from first[item] on, each in steps of a stride of 2^level cells.
// The raster has stride × stride parts of nx × ny cells, so that a point under all shifts stays in one part.
// Without an expected place a bound is the sum. Only points that some shifts take out of the raster are
// looked for at each shift.
GMM_KERNEL raster_sums(int64_t item, const int64_t* cells, int64_t n_points, const int64_t* first,
                       const int64_t* shift, const float* raster, int64_t level, int64_t nx, int64_t ny,
                       double outside, Expected prior, double* bounds) {
    const int64_t begin = first[item], stop = first[item + 1];
    if (begin == stop) return;
    const int64_t stride = (int64_t)1 << level, size[2] = {nx, ny};
    int64_t low[2] = {shift[2 * begin], shift[2 * begin + 1]}, high[2] = {low[0], low[1]};
    for (int64_t at = begin; at < stop; ++at) {
        bounds[at] = 0.0;
        for (int i = 0; i < 2; ++i) {
            low[i] = minimum(low[i], shift[2 * at + i]);
            high[i] = maximum(high[i], shift[2 * at + i]);
        }
    }
    for (int64_t from = 0; from < n_points; from += LISTED) {
        int64_t inside[LISTED], edge[LISTED], at_edge[LISTED][2];
        int n_inside = 0, n_edge = 0;
        double away = 0.0;
        for (int64_t n = from; n < n_points && n < from + LISTED; ++n) {
            int64_t whole[2], part = 0;
            bool is_inside = true, is_away = false;
            for (int i = 0; i < 2; ++i) {
                const int64_t cell = cells[(item * n_points + n) * 2 + i];
                whole[i] = cell >> level;
                part = (part << level) + (cell & (stride - 1));
                is_inside = is_inside && whole[i] + low[i] >= 0 && whole[i] + high[i] < size[i];
                is_away = is_away || whole[i] + high[i] < 0 || whole[i] + low[i] >= size[i];
            }
            const int64_t place = (part * nx + whole[0]) * ny + whole[1];
            if (is_inside) {
                inside[n_inside++] = place;
            } else if (is_away) {
                away += outside;
            } else {
                edge[n_edge] = place;
                at_edge[n_edge][0] = whole[0];
                at_edge[n_edge++][1] = whole[1];
            }
        }
        for (int64_t at = begin; at < stop; ++at) {
            const float* place = raster + (shift[2 * at] * ny + shift[2 * at + 1]);
            double sums[4] = {away};  // which do not wait for each other
            int n = 0;
            for (; n + 4 <= n_inside; n += 4)
                for (int i = 0; i < 4; ++i) sums[i] += (double)place[inside[n + i]];
            for (; n < n_inside; ++n) sums[0] += (double)place[inside[n]];
            for (n = 0; n < n_edge; ++n) {
                const uint64_t x = at_edge[n][0] + shift[2 * at], y = at_edge[n][1] + shift[2 * at + 1];
                sums[n & 3] += x < (uint64_t)nx && y < (uint64_t)ny ? (double)place[edge[n]] : outside;
            }
            bounds[at] += sums[0] + sums[1] + sums[2] + sums[3];
        }
    }
    if (!prior.n) return;
    const double width = (double)stride, half = 0.5 * (width - 1.0);
    const double away = (width - 1.0) * prior.cell * sqrt(0.5);
    const double *places = prior.places, *last = places + 2 * (prior.n - 1);
    for (int64_t from = begin; from < stop; from += LANES) {
        vec middle[2], sum, least = (vec)(1e300), is_near = (vec)(0.0);
        for (int l = 0; l < LANES; ++l) {
            const int64_t at = minimum(from + l, stop - 1);
            set(sum, l, bounds[at]);
            for (int i = 0; i < 2; ++i)
                set(middle[i], l, last[i] + (width * (double)shift[2 * at + i] + half) * prior.cell);
        }
        for (int64_t b = 0; b < prior.n; ++b) {
            const double off = prior.turned[item * prior.n + b], turned = off / prior.angle;
            const vec x = middle[0] - places[2 * b], y = middle[1] - places[2 * b + 1];
            vec gap = root(x * x + y * y) - away;
            gap = gap > 0.0 ? gap : (vec)(0.0);
            if (off <= prior.max_turn) is_near = gap <= prior.max_step ? (vec)(1.0) : is_near;
            const vec shifted = gap / prior.distance, square = shifted * shifted + turned * turned;
            least = square < least ? square : least;
        }
        vec bound = prior.share * sum - prior.tail * logarithm(1.0 + least / (2.0 * prior.tail));
        bound = is_near > 0.0 ? bound : bound - prior.never;
        for (int l = 0; l < LANES && from + l < stop; ++l) bounds[from + l] = get(bound, l);
    }
}

}  // namespace gmm

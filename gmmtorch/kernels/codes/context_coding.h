// Components in an adaptive binary range coder, written or read. An item is a batch. The twin, with the
// meaning of every context, is mapping/codec/context_model.py: both do the same operations in the same order.
#pragma once

#include "../mixtures/lattice.h"
#include "coded_batch.h"
#include "range_coder.h"

namespace gmm {

// Walks through the components of a batch, each value in place: written, or read into arrays of zeros.
template <int DIM, bool WRITES>
struct Walk {
    static constexpr int FEW = 16;

    Batch b;
    Scratch s;
    RangeCoder<WRITES> c;
    int64_t offset, nearest;
    int64_t level_begin[24], n_waiting, work;  // of the tree of origins and its heap; items taken from it
    int levels;
    bool is_slow, is_round;   // whether the component is near a sphere around its only origin
    double eye[DIM], radius;  // of that sphere; 0: not known
    int64_t eye_at;           // that origin's index, or that of the component before

    GMM_INLINE int64_t slots(int field, int64_t context, int64_t size = 32) const {
        return c.s.first_slot[field] + context * size;
    }

    GMM_INLINE void check(bool valid) { c.good = c.good && valid; }

    GMM_INLINE void id(int64_t i) {
        int64_t* own = b.ids + 2 * i;
        bool same = false;
        if (i > 0) same = c.bit(slots(Field::ROBOT, 1), own[0] == own[-2]);
        own[0] = same ? own[-2] : c.whole(slots(Field::ROBOT, 0), own[0], 0);
        const int64_t next = same ? own[-1] + 1 : 0;
        own[1] = next + c.whole(slots(Field::NUMBER, same), own[1] - next, 0);
        for (int a = 0; a < 2; ++a) check(own[a] <= 1ll << 61 && own[a] >= -(1ll << 61));
    }

    GMM_INLINE void origin(int64_t i) {
        for (int a = 0; a < DIM; ++a) {
            int64_t* own = b.origins + i * DIM + a;
            const int64_t before = i > 0 ? own[-DIM] : 0;
            *own = before + c.whole(slots(Field::ORIGIN, a + 3 * (i > 0)), *own - before, 0);
            check(*own <= 1ll << 36 && *own >= -(1ll << 36));
        }
    }

    // The bit that halves a block along axis a: which half is nearer to the plane of the component before?
    GMM_INLINE int64_t halving(int64_t i, const int64_t* corner, const int64_t* width, int a) const {
        if (i == 0) return 5;
        const double *n = s.normal + (i - 1) * DIM, *m = s.place + (i - 1) * DIM;
        const int64_t* d = b.deviation + (i - 1) * DIM;
        if (d[DIM - 2] - d[DIM - 1] < 4 || fabs(n[a]) < 0.25) return 5;
        const double side = two_to(b.side);
        double apart = 0.0;
        for (int x = 0; x < DIM; ++x)
            apart = apart + n[x] * (((double)corner[x] + 0.5 * (double)width[x]) * side - m[x]);
        const double quarter = n[a] * (0.25 * (double)width[a] * side);
        const double nearer = fabs(apart - quarter) - fabs(apart + quarter), most = 2.0 * fabs(quarter);
        return nearer < -0.75 * most   ? 0
               : nearer < -0.25 * most ? 1
               : nearer <= 0.25 * most ? 2
               : nearer <= 0.75 * most ? 3
                                       : 4;
    }

    // The cell of a mean: the highest level at which it leaves the block of the cell before, then its place
    // there.
    GMM_INLINE void cell(int64_t i, int64_t flag) {
        uint64_t before[DIM], now[DIM], differs = 0;
        for (int a = 0; a < DIM; ++a) {
            int64_t old = 0;
            if (i > 0)
                old = s.cell[(i - 1) * DIM + a];
            else if (b.n_origins > 0)
                old = b.side >= -8 ? b.origins[a] >> (b.side + 8) : b.origins[a] * (1ll << (-8 - b.side));
            before[a] = (uint64_t)(old + offset);
            now[a] = WRITES ? (uint64_t)(s.cell[i * DIM + a] + offset) : 0;
            differs |= before[a] ^ now[a];
        }
        int64_t level = 0;
        if (WRITES)
            while (differs >> level) ++level;
        level = c.number(slots(Field::LEVEL, i > 0 ? flag : 2), level);
        check(level <= 52);
        if (!c.good) return;
        int64_t corner[DIM], width[DIM];
        for (int a = 0; a < DIM; ++a)
            corner[a] = (int64_t)((before[a] >> level) << level), width[a] = 1ll << level;
        if (level > 0) {
            int64_t old = 0, digit = 0;
            for (int a = 0; a < DIM; ++a) {
                old = old << 1 | ((before[a] >> (level - 1)) & 1);
                digit = digit << 1 | ((now[a] >> (level - 1)) & 1);
            }
            digit = c.tree(slots(Field::DIGIT, old, 8), DIM, digit);
            check(digit != old);
            for (int a = 0; a < DIM; ++a) {
                width[a] >>= 1;
                corner[a] += ((digit >> (DIM - 1 - a)) & 1) * width[a];
            }
        }
        for (int a = 0; a < DIM; ++a) corner[a] -= offset;
        for (int64_t l = level - 2; l >= 0; --l)
            for (int a = 0; a < DIM; ++a) {
                const int64_t context = halving(i, corner, width, a) + 6 * (level >= 4);
                width[a] >>= 1;
                corner[a] += c.bit(slots(Field::LOWER, context, 1), (now[a] >> l) & 1) * width[a];
            }
        const double reach = 2.0 * 134217728.0 * two_to(-b.side);
        for (int a = 0; a < DIM; ++a) {
            s.cell[i * DIM + a] = corner[a];
            check(fabs((double)corner[a]) <= reach);
        }
    }

    // The two nearest of the last 64 components before i, and the squared distance (m²) of the nearest.
    GMM_INLINE double neighbours(int64_t i, int64_t& first, int64_t& second) const {
        double least = HUGE_VAL, next = HUGE_VAL;
        first = second = i > 64 ? i - 64 : 0;
        const double side = two_to(b.side);
        for (int64_t t = first; t < i; ++t) {
            double apart = 0.0;
            for (int a = 0; a < DIM; ++a) {
                const double x = s.place[t * DIM + a] - ((double)s.cell[i * DIM + a] + 0.5) * side;
                apart = apart + x * x;
            }
            if (apart < least)
                next = least, second = first, least = apart, first = t;
            else if (apart < next)
                next = apart, second = t;
        }
        if (next == HUGE_VAL) second = first;
        return least;
    }

    GMM_INLINE void deviations(int64_t i, int64_t j, int64_t k, int64_t flag) {
        const int64_t *x = b.deviation + j * DIM, *y = b.deviation + k * DIM;
        int64_t* d = b.deviation + i * DIM;
        const int64_t unit = 1 + b.coarse;
        auto whole = [&](int64_t slot, int64_t value, int64_t side) {
            return unit * c.whole(slot, value / unit, side);
        };
        auto number = [&](int64_t slot, int64_t value) { return unit * c.number(slot, value / unit); };
        if (i == 0) {
            d[0] = whole(slots(Field::WIDE, 2 + flag), d[0], 0);
            if (DIM == 3) d[1] = d[0] - number(slots(Field::RATIO, 10 + flag), d[0] - d[1]);
            d[DIM - 1] = d[DIM - 2] - number(slots(Field::THIN, 6 + flag), d[DIM - 2] - d[DIM - 1]);
        } else {
            const int64_t wide = floor_of(x[0] + y[0], 2 * unit) * unit;
            d[0] = wide + whole(slots(Field::WIDE, flag), d[0] - wide, 0);
            if (DIM == 3) {
                const int64_t ratio = (x[0] - x[1] + y[0] - y[1]) >> 2;
                d[1] = d[0] - number(slots(Field::RATIO, flag * 5 + minimum(ratio, (int64_t)4)), d[0] - d[1]);
            }
            const int64_t thin = minimum(floor_of(x[DIM - 1] + y[DIM - 1], 2 * unit) * unit, d[DIM - 2]);
            const int64_t apart = x[DIM - 1] > y[DIM - 1] ? x[DIM - 1] - y[DIM - 1] : y[DIM - 1] - x[DIM - 1];
            const int64_t context = flag * 3 + minimum(apart / 3, (int64_t)2);
            d[DIM - 1] = thin + whole(slots(Field::THIN, context), d[DIM - 1] - thin, thin == d[DIM - 2]);
        }
        for (int a = 0; a < DIM; ++a) check(d[a] <= 80 && d[a] >= -80 && (a == 0 || d[a] <= d[a - 1]));
        check(d[0] - d[DIM - 1] <= 80);
    }

    // log2 of the step of a mean with this deviation, or of a shear with this ratio of deviations.
    GMM_INLINE int64_t step_of(int64_t d) const { return floor_of(d, 4) - 2 + 2 * b.coarse; }

    GMM_INLINE double slope_of(int64_t i, int pair, int row, int column) {
        const int64_t* d = b.deviation + i * DIM;
        const double value = (double)b.shear[i * PAIRS<DIM> + pair] * two_to(step_of(d[row] - d[column]));
        check(fabs(value) <= 2.0);
        return value;
    }

    // The slopes of the last axis along the others, as on the plane of component j; whether it has one.
    GMM_INLINE bool plane(int64_t i, int64_t j, const int* axis, double* given) const {
        const int64_t *d = b.deviation + i * DIM, *e = b.deviation + j * DIM;
        const double* n = s.normal + j * DIM;
        if (i == 0 || e[DIM - 2] - e[DIM - 1] < 4 || d[DIM - 2] - d[DIM - 1] < 2) return false;
        return slopes_of(n, axis, given);
    }

    // Those on the plane with this normal.
    GMM_INLINE bool slopes_of(const double* n, const int* axis, double* given) const {
        double most = 0.0;
        for (int a = 0; a < DIM; ++a) most = maximum(most, fabs(n[a]));
        bool gentle = fabs(n[axis[DIM - 1]]) > 0.25 * most;
        for (int a = 0; a < DIM - 1 && gentle; ++a) given[a] = -n[axis[a]] / n[axis[DIM - 1]];
        for (int a = 0; a < DIM - 1; ++a) gentle = gentle && fabs(given[a]) <= 2.0;
        for (int a = 0; a < DIM - 1; ++a) given[a] = gentle ? given[a] : 0.0;
        return gentle;
    }

    // The shears, near the given slopes; `own` becomes the slopes. Returns how far they are from those given.
    GMM_INLINE int64_t shears(int64_t i, int64_t j, int64_t flag, bool flat, const double* given,
                              double* own) {
        const int64_t *d = b.deviation + i * DIM, *e = b.deviation + j * DIM;
        int64_t* l = b.shear + i * PAIRS<DIM>;
        int64_t off = 0;
        double turn = 0.0;
        if (DIM == 3) {
            const int64_t finer = -floor_of(d[1] - d[0], 4);
            l[0] = c.whole(slots(Field::TURN, flag * 8 + minimum(finer, (int64_t)7)), l[0], 0);
            turn = slope_of(i, 0, 1, 0);
            const int64_t step = step_of(d[DIM - 1] - d[1]), fine = minimum(-step / 2 + b.coarse, (int64_t)6);
            const int64_t about = (int64_t)floor(given[1] * two_to(-step) + 0.5);
            int64_t context = flat ? 7 + fine * 3 + minimum((e[1] - e[DIM - 1]) / 6, (int64_t)2) : fine;
            context = is_round ? 56 + flat * 7 + fine : flag * 28 + context;
            off = c.whole(slots(Field::TILT, context), l[PAIRS<DIM> - 1] - about,
                          (about > 0) + 2 * (about < 0));
            l[PAIRS<DIM> - 1] = about + off;
            own[1] = slope_of(i, PAIRS<DIM> - 1, DIM - 1, 1);
            if (!c.good) return 0;
        }
        const int64_t step = step_of(d[DIM - 1] - d[0]), fine = minimum(-step / 2 + b.coarse, (int64_t)6);
        const int64_t about = (int64_t)floor((given[0] + own[1] * turn) * two_to(-step) + 0.5);
        const int64_t context = (is_round ? 84 : flag * 42 + flat * 21) + fine * 3
                                + minimum((off < 0 ? -off : off) / 2, (int64_t)2);
        const int64_t rest =
            c.whole(slots(Field::SLOPE, context), l[PAIRS<DIM> / 2] - about, (about > 0) + 2 * (about < 0));
        l[PAIRS<DIM> / 2] = about + rest;
        own[0] = slope_of(i, PAIRS<DIM> / 2, DIM - 1, 0) - own[1] * turn;
        return DIM == 2 ? rest : off;
    }

    // By how much a component with this distance from the origin is before the sphere on which its points
    // are.
    GMM_INLINE double sagitta(const int64_t* d, double distance) const {
        return (two_to(floor_of(d[0], 2)) + two_to(floor_of(d[DIM - 2], 2))) / (2.0 * distance);
    }

    // The mean in its cell: freely along the component; across it near the plane of component j, or the
    // sphere.
    GMM_INLINE void mean(int64_t i, int64_t j, int64_t flag, const int* axis, double apart, bool flat,
                         const double* given, const double* own, int64_t off) {
        const int64_t* d = b.deviation + i * DIM;
        const double size = two_to(2 * floor_of(d[0], 4));
        double across = flat ? s.place[j * DIM + axis[DIM - 1]] : 0.0, squares = 0.0;
        for (int a = 0; a < DIM; ++a) {
            const int64_t exponent = step_of(d[a]), where = s.cell[i * DIM + axis[a]];
            const int64_t width = maximum(b.side - exponent, (int64_t)0),
                          coarser = maximum(exponent - b.side, (int64_t)0);
            check((where & ((1ll << coarser) - 1)) == 0);
            const int64_t base = coarser > 0 ? where >> coarser : where * (1ll << width);
            int64_t inside = WRITES ? b.mean[i * DIM + a] - base : 0;
            const bool guessed = is_round ? radius > 0.0 : flat;
            if (a == DIM - 1 && guessed && width > 0) {
                const double corner = (double)where * two_to(b.side), top = (double)((1ll << width) - 1);
                if (is_round) {
                    const double near = radius - sagitta(d, radius);
                    const double rise = sqrt(maximum(near * near - squares, 0.0)), o = eye[axis[a]];
                    across = o + (corner + 0.5 * two_to(b.side) < o ? -rise : rise);
                }
                const double wanted = floor((across - corner) * two_to(-exponent) + 0.5);
                const int64_t guess = (int64_t)minimum(maximum(wanted, 0.0), top);
                const int64_t rise = guess, fall = (int64_t)top - guess;
                const int64_t far = apart < size ? 0 : apart < 4.0 * size ? 1 : apart < 9.0 * size ? 2 : 3;
                const int64_t turned = minimum((off < 0 ? -off : off) / 3, (int64_t)3);
                const bool is_in = wanted >= 0.0 && wanted <= top;
                const int64_t there = is_round ? 64 + is_in * 4 + minimum(width, (int64_t)3)
                                               : ((flag * 2 + is_in) * 4 + far) * 4 + turned;
                const int64_t edge = minimum(rise, fall) > 7 ? 0 : rise < fall ? 1 : 2;
                inside = guess + c.whole(slots(Field::ACROSS, there), inside - guess, edge);
                check(inside >= 0 && inside <= (int64_t)top);
            } else {
                inside = c.raw(width, inside);
            }
            b.mean[i * DIM + a] = base + inside;
            const double place = (double)(base + inside) * two_to(exponent);
            s.place[i * DIM + axis[a]] = place;
            squares = squares + (place - eye[axis[a]]) * (place - eye[axis[a]]);
            if (a < DIM - 1 && flat)
                across = across + 0.5 * (given[a] + own[a]) * (place - s.place[j * DIM + axis[a]]);
        }
    }

    GMM_INLINE void look_from(int64_t origin) {
        eye_at = origin;
        for (int a = 0; a < DIM; ++a)
            eye[a] = origin < b.n_origins ? (double)b.origins[origin * DIM + a] * 0.00390625 : 0.0;
    }

    // Whether component i has one viewpoint, which begins at `begin`, and then which: most often that of the
    // component before.
    GMM_INLINE bool only_eye(int64_t i, int64_t begin) {
        if (!b.coarse || b.n_origins == 0 || begin >= b.n_seen) return false;
        const int64_t n = b.n_origins, seen = WRITES ? b.seen_from[begin] : 0;
        const bool one = WRITES && b.n_viewpoints[i] == 1;
        check(seen >= 0 && seen < n);
        if (!c.good) return false;
        if (!c.bit(slots(Field::EYE, 0), one && seen == eye_at)) {
            if (!c.bit(slots(Field::EYE, 0) + 1, one)) return false;
            const int64_t ahead = c.number(slots(Field::EYE, 1), (seen - eye_at - 1 + n) % n);
            check(ahead < n - 1);
            if (!c.good) return false;
            look_from((eye_at + 1 + ahead) % n);
        }
        b.n_viewpoints[i] = 1, b.seen_from[begin] = eye_at, b.share[begin] = 0;
        return true;
    }

    GMM_INLINE void component(int64_t i, bool has_eye) {
        int64_t flag = b.max_range[i], k;
        int64_t& j = nearest;
        const int64_t last = i > 0 ? b.max_range[i - 1] : 0;
        flag = c.bit(slots(Field::FLAG, 2 * last + (i > 1 ? b.max_range[i - 2] : 0), 1), flag);
        b.max_range[i] = flag;
        is_round = DIM == 3 && flag && has_eye;
        cell(i, flag);
        if (!c.good) return;
        const double apart = neighbours(i, j, k);
        const int64_t near =
            i > 0 ? (flag * 2 + (b.axis_order[j] == b.axis_order[k])) * 6 + b.axis_order[j] : 24 + flag;
        const int64_t order = c.tree(slots(Field::ORDER, near, 8), DIM == 3 ? 3 : 1, b.axis_order[i]);
        b.axis_order[i] = order;
        check(order < (DIM == 3 ? 6 : 2));
        deviations(i, j, k, flag);
        if (!c.good) return;
        const int64_t* d = b.deviation + i * DIM;
        // The lexicographic permutations of the axes.
        int axis[DIM];
        axis[0] = (int)(DIM == 3 ? order / 2 : order);
        axis[DIM - 1] = DIM == 2 ? 1 - axis[0] : order % 2 ? (axis[0] == 0 ? 1 : 0) : (axis[0] == 2 ? 1 : 2);
        if (DIM == 3) axis[1] = 3 - axis[0] - axis[DIM - 1];

        double given[DIM], own[DIM];  // slopes of the last axis along the others
        for (int a = 0; a < DIM; ++a) given[a] = own[a] = 0.0;
        if (is_round) {
            mean(i, j, flag, axis, apart, false, given, own, 0);
            if (!c.good) return;
            double ray[DIM], squares = 0.0;
            for (int a = 0; a < DIM; ++a) {
                ray[a] = s.place[i * DIM + a] - eye[a];
                squares = squares + ray[a] * ray[a];
            }
            const double distance = sqrt(squares);
            radius = distance > 0.0 ? distance + sagitta(d, distance) : 0.0;
            shears(i, j, flag, slopes_of(ray, axis, given), given, own);
            if (!c.good) return;
        } else {
            const bool flat = apart < 64.0 * two_to(2 * floor_of(d[0], 4)) && plane(i, j, axis, given);
            const int64_t off = shears(i, j, flag, flat, given, own);
            if (!c.good) return;
            mean(i, j, flag, axis, apart, flat, given, own, off);
        }
        s.normal[i * DIM + axis[DIM - 1]] = 1.0;
        for (int a = 0; a < DIM - 1; ++a) s.normal[i * DIM + axis[a]] = -own[a];
        points(i, j, k, flag);
    }

    GMM_INLINE void points(int64_t i, int64_t j, int64_t k, int64_t flag) {
        auto area = [&](int64_t t) {
            return b.deviation[t * DIM] + (DIM == 3 ? b.deviation[t * DIM + 1] : 0);
        };
        int64_t about = 0;
        if (i > 0) {
            const int64_t both = b.count[j] + b.count[k];
            about = (((both - area(j) - area(k)) >> 1) + area(i) + (both >> 1)) >> 1;
        }
        const int64_t unit = 1 + b.coarse, context = flag + 2 * (i == 0);
        about = floor_of(about, unit) * unit;
        b.count[i] =
            about + unit * c.whole(slots(Field::COUNT, context), floor_of(b.count[i] - about, unit), 0);
        if (b.coarse && b.count[i] == -42) b.count[i] = -41;  // no count
        check(b.count[i] >= -41 && b.count[i] <= 160);
    }

    // Whether slot x of the heap comes before slot y: boxes before the origins that may be in them.
    GMM_INLINE bool before(int64_t x, int64_t y) const {
        if (s.distance[x] != s.distance[y]) return s.distance[x] < s.distance[y];
        const int64_t one = s.waiting[x], other = s.waiting[y], n = b.n_origins;
        return one < n && other < n ? s.leaf[one] < s.leaf[other] : one > other;
    }

    GMM_INLINE void swap_slots(int64_t x, int64_t y) {
        const double distance = s.distance[x];
        const int64_t item = s.waiting[x];
        s.distance[x] = s.distance[y], s.waiting[x] = s.waiting[y];
        s.distance[y] = distance, s.waiting[y] = item;
    }

    GMM_INLINE void push(double distance, int64_t item) {
        int64_t at = n_waiting++;
        s.distance[at] = distance, s.waiting[at] = item;
        for (; at > 0 && before(at, (at - 1) / 2); at = (at - 1) / 2) swap_slots(at, (at - 1) / 2);
    }

    GMM_INLINE int64_t pop() {
        const int64_t item = s.waiting[0];
        swap_slots(0, --n_waiting);
        for (int64_t at = 0, child = 1; child < n_waiting; at = child, child = 2 * at + 1) {
            if (child + 1 < n_waiting && before(child + 1, child)) ++child;
            if (!before(child, at)) break;
            swap_slots(child, at);
        }
        ++work;
        return item;
    }

    // The origins along a Morton curve of 2^16 cells an axis are the leaves of a tree; eight items after one
    // another have a box around them in the next level.
    GMM_INLINE void grow_tree() {
        const int64_t n = b.n_origins;
        int64_t low[DIM], extent = 1;
        for (int a = 0; a < DIM && n > 0; ++a) {
            int64_t high = low[a] = b.origins[a];
            for (int64_t t = 1; t < n; ++t) {
                low[a] = minimum(low[a], b.origins[t * DIM + a]);
                high = maximum(high, b.origins[t * DIM + a]);
            }
            extent = maximum(extent, high - low[a]);
        }
        n_waiting = 0;
        for (int64_t t = 0; t < n; ++t) {
            int64_t key = 0;
            for (int bit = 15; bit >= 0; --bit)
                for (int a = 0; a < DIM; ++a)
                    key = key << 1 | (((b.origins[t * DIM + a] - low[a]) * 65535 / extent >> bit) & 1);
            s.leaf[t] = t;
            push((double)key, t);
        }
        for (int64_t t = 0; t < n; ++t) s.row[t] = pop();
        for (int64_t t = 0; t < n; ++t) {
            s.leaf[t] = s.row[t], s.row[t] = 0;
            for (int x = 0; x < 2 * DIM; ++x) s.box[t * 2 * DIM + x] = b.origins[s.leaf[t] * DIM + x % DIM];
        }
        levels = 1, level_begin[0] = 0, level_begin[1] = n, work = 0;
        while (level_begin[levels] - level_begin[levels - 1] > 1) {
            const int64_t begin = level_begin[levels - 1], end = level_begin[levels];
            level_begin[++levels] = end + (end - begin + 7) / 8;
            for (int64_t t = begin; t < end; ++t) {
                int64_t *box = s.box + (end + (t - begin) / 8) * 2 * DIM, *own = s.box + t * 2 * DIM;
                const bool is_first = (t - begin) % 8 == 0;
                for (int a = 0; a < DIM; ++a) {
                    box[a] = is_first ? own[a] : minimum(box[a], own[a]);
                    box[DIM + a] = is_first ? own[DIM + a] : maximum(box[DIM + a], own[DIM + a]);
                }
            }
        }
    }

    // An item of the tree waits for its turn, with its squared distance (m²) from component i. Rounding keeps
    // the order of numbers, so no origin is nearer than its box.
    GMM_INLINE void wait(int64_t i, int64_t item) {
        const int64_t *low = s.box + item * 2 * DIM, *high = low + DIM;
        double apart = 0.0;
        for (int a = 0; a < DIM; ++a) {
            const double place = s.place[i * DIM + a];
            const double below = (double)low[a] * 0.00390625 - place;
            const double above = place - (double)high[a] * 0.00390625;
            const double x = maximum(maximum(below, above), 0.0);
            apart = apart + x * x;
        }
        push(apart, item);
    }

    // The next origin by distance from component i, and index; −1 if none is left.
    GMM_INLINE int64_t next_origin(int64_t i) {
        while (n_waiting > 0) {
            const int64_t item = pop();
            if (item < b.n_origins) return s.leaf[item];
            int level = 1;
            while (item >= level_begin[level + 1]) ++level;
            const int64_t begin = level_begin[level - 1] + 8 * (item - level_begin[level]);
            for (int64_t t = begin; t < minimum(begin + 8, level_begin[level]); ++t) wait(i, t);
        }
        return -1;
    }

    // The places (n,), in rising order, that the origins of component i have among all by distance, and these
    // origins. Their heap would give the same, but takes longer if there are few origins.
    GMM_INLINE void count_places(int64_t i, const int64_t* seen, int64_t n, int64_t* place, int64_t* origin) {
        for (int64_t t = 0; t < b.n_origins; ++t) {
            double apart = 0.0;
            for (int a = 0; a < DIM; ++a) {
                const double x = (double)b.origins[t * DIM + a] * 0.00390625 - s.place[i * DIM + a];
                apart = apart + x * x;
            }
            s.distance[t] = apart;
        }
        for (int64_t q = 0; q < n; ++q) {
            const double own = s.distance[seen[q]];
            int64_t nearer = 0, at = q;
            for (int64_t t = 0; t < b.n_origins; ++t) nearer += s.distance[t] < own;
            for (int64_t t = 0; t < seen[q]; ++t) nearer += s.distance[t] == own;
            for (; at > 0 && place[at - 1] > nearer; --at)
                place[at] = place[at - 1], origin[at] = origin[at - 1];
            place[at] = nearer, origin[at] = seen[q];
        }
        work += level_begin[levels];
    }

    // The viewpoints of component i, which begin at `begin`, nearest first; returns where they end.
    GMM_INLINE int64_t viewpoints(int64_t i, int64_t j, int64_t begin) {
        const int64_t known = i > 0 ? minimum(b.n_viewpoints[j], (int64_t)3) : 0;
        const int64_t n = c.number(slots(Field::VIEWS, b.max_range[i] * 4 + known), b.n_viewpoints[i]);
        b.n_viewpoints[i] = n;
        check(n <= b.n_origins && begin + n <= b.n_seen);
        if (!c.good || n == 0) return begin;
        int64_t* seen = b.seen_from + begin;
        int64_t* share = b.share + begin;
        if (WRITES) {
            for (int64_t q = 0; q < n; ++q) check(seen[q] >= 0 && seen[q] < b.n_origins);
            if (!c.good) return begin;
            for (int64_t q = 0; q < n; ++q) s.row[seen[q]] = q + 1;
        }
        int64_t place[FEW], origin[FEW], left = b.n_origins;
        const bool are_few = WRITES && n <= FEW && b.n_origins <= 32 * FEW;
        n_waiting = 0;
        if (are_few)
            count_places(i, seen, n, place, origin);
        else
            wait(i, level_begin[levels] - 1);
        bool is_largest = false;  // whether a share of the largest was among them
        for (int64_t q = 0; q < n; ++q) {
            int64_t rank = 0, found = 0;
            check(left >= n - q);
            if (are_few)
                rank = place[q] - (q > 0 ? place[q - 1] + 1 : 0), found = origin[q];
            else if (WRITES)
                while (c.good && (found = next_origin(i)) >= 0 && s.row[found] == 0) ++rank;
            if (left > n - q) rank = c.number(slots(Field::RANK, minimum(n - q, (int64_t)4) - 1), rank);
            check(rank >= 0 && rank < left);
            is_slow = work > c.out.most_steps * (c.at + 4096);
            check(!is_slow && found >= 0);
            if (!c.good) return begin;
            if (!WRITES)
                for (int64_t r = 0; r <= rank; ++r) found = next_origin(i);
            left -= rank + 1;
            int64_t part = WRITES ? share[s.row[found] - 1] : 0;
            if (n > 1 && (q < n - 1 || is_largest))
                part = c.number(slots(Field::SHARE, 2 * (n > 2) + is_largest), part);
            check(part <= 15);
            is_largest = is_largest || part == 0;
            if (!WRITES) seen[q] = found, share[q] = part;
        }
        if (WRITES)
            for (int64_t q = 0; q < n; ++q) s.row[seen[q]] = 0;
        return begin + n;
    }

    GMM_INLINE int64_t run() {
        offset = 0;
        for (int64_t x = 6; x <= 28; x += 2) offset += 1ll << (x - b.side);
        c.begin();
        for (int64_t i = 0; i < b.k && c.good; ++i) id(i);
        for (int64_t i = 0; i < b.n_origins && c.good; ++i) origin(i);
        is_round = false, radius = 0.0;
        look_from(0);
        if (c.good) grow_tree();
        int64_t seen = 0;
        for (int64_t i = 0; i < b.k && c.good; ++i) {
            const bool has_eye = only_eye(i, seen);
            if (c.good) component(i, has_eye);
            if (c.good) seen = has_eye ? seen + 1 : viewpoints(i, nearest, seen);
        }
        check(seen == b.n_seen);
        return is_slow ? -2 : c.end();
    }
};

template <int DIM, bool WRITES>
GMM_KERNEL context_coding(int64_t, Batch batch, Chances chances, Scratch scratch, Stream stream) {
    Walk<DIM, WRITES> walk{batch, scratch, {chances, stream, 0, 0, 0, 0, 0, 0, false, true}};
    *stream.result = walk.run();
}

}  // namespace gmm

// The rigid motion that maximises the overlap of two mixtures, from coarse to fine, in one launch. What all
// workers need to decide, such as sums over components, each computes for itself: they need not wait.
#pragma once

#include "../jacobi.h"
#include "pair_overlap.h"

namespace gmm {

constexpr int KEPT = 4;            // motions that go on from one level to the next,
constexpr double LEAST = 0.7;      // with this share of the best score at least
constexpr int SECOND_CHANCE = 2;   // the level where a single start is tried once more
constexpr double COARSELY = 0.05;  // blurs: the tolerance of all levels but the last
constexpr double THINNEST = 1e-6;  // blur, in radii
constexpr double CUTOFF = 4.0;     // deviations beyond which a pair is left out
constexpr double SLACK = 0.5;      // thicknesses that components may move before pairs are listed again
constexpr double LEAST_CURVATURE = 0.05;
constexpr double LONGEST = 1.0;  // step, in Mahalanobis distances,
constexpr double THICKNESSES = 4.0;

// A mixture as it is given, and its components about its mean.
struct Given {
    int64_t n;
    const double *given_weights, *given_means, *covariances;
    double *weights, *means, *least, *largest, *cells;  // eigenvalues of the covariances; cells of a level
    int64_t* next;                                      // component of the same cell; -1: none
    int64_t* is_first;                                  // of its cell
    double total, radius, centre[3];
};

// The climb from one start.
template <int DIM>
struct Climb {
    static constexpr int FREE = n_free(DIM), N_SUMS = n_overlap_sums(DIM);
    double pose[n_of_pose(DIM)], trial[n_of_pose(DIM)], listed[n_of_pose(DIM)];
    double score, slope[FREE], information[FREE][FREE], scatter[FREE][FREE], sums[N_SUMS];
    double share, length, active, strayed, worth;
};

GMM_INLINE double* taken(double*& space, int64_t n) {
    space += n;
    return space - n;
}

// Writes the lower median of n values; all workers call it and then meet.
GMM_INLINE void find_median(int64_t item, const Team& team, int64_t n, const double* values, double* median) {
    for (int64_t i = item; i < n; i += team.n) {
        int64_t rank = 0;
        for (int64_t j = 0; j < n; ++j) rank += values[j] < values[i] || (values[j] == values[i] && j < i);
        if (rank == (n - 1) / 2) *median = values[i];
    }
}

// Squared deviations of a covariance, the least one and the largest one, and √ of the product of all but the
// least: what a component covers.
template <int DIM>
GMM_INLINE double extents(const double* covariance, double* least, double* largest) {
    double a[DIM][DIM], axes[DIM][DIM], all = 1.0;
    for (int i = 0; i < DIM; ++i)
        for (int j = 0; j < DIM; ++j) a[i][j] = covariance[maximum(i, j) * DIM + minimum(i, j)];
    diagonalize<DIM>(a, axes);
    int thin = 0;
    *largest = 0.0;
    for (int i = 0; i < DIM; ++i) {
        if (a[i][i] < a[thin][thin]) thin = i;
        *largest = maximum(*largest, a[i][i]);
    }
    for (int i = 0; i < DIM; ++i)
        if (i != thin) all *= maximum(a[i][i], 0.0);
    *least = maximum(a[thin][thin], 0.0);
    return sqrt(all);
}

// The total weight, the mean, and the radius of the mixture about it.
template <int DIM>
GMM_INLINE void measure(Given& mixture) {
    double rough[DIM] = {0.0}, spread = 0.0;  // far from the origin, the mean keeps its digits
    for (int64_t i = 0; i < mixture.n; ++i) {
        mixture.total += mixture.weights[i];
        for (int k = 0; k < DIM; ++k) rough[k] += mixture.given_means[i * DIM + k];
    }
    for (int k = 0; k < DIM; ++k) rough[k] /= (double)mixture.n;
    for (int64_t i = 0; i < mixture.n; ++i)
        for (int k = 0; k < DIM; ++k)
            mixture.centre[k] += mixture.weights[i] * (mixture.given_means[i * DIM + k] - rough[k]);
    for (int k = 0; k < DIM; ++k) mixture.centre[k] = rough[k] + mixture.centre[k] / mixture.total;
    for (int64_t i = 0; i < mixture.n; ++i)
        for (int k = 0; k < DIM; ++k) {
            const double x = mixture.given_means[i * DIM + k] - mixture.centre[k];
            spread += mixture.weights[i] * (x * x + mixture.covariances[(i * DIM + k) * DIM + k]);
        }
    mixture.radius = sqrt(spread / mixture.total);
}

// Joins the components of each cell of side `blur` in a list.
template <int DIM>
GMM_INLINE void link_cells(int64_t item, Team& team, const Given& mixture, double blur) {
    for (int64_t i = item; i < mixture.n; i += team.n) {
        mixture.is_first[i] = 1;
        for (int k = 0; k < DIM; ++k) mixture.cells[i * DIM + k] = floor(mixture.means[i * DIM + k] / blur);
    }
    meet(team);
    for (int64_t i = item; i < mixture.n; i += team.n) {
        const double* cell = mixture.cells + i * DIM;
        mixture.next[i] = -1;
        for (int64_t j = i + 1; j < mixture.n && mixture.cells[j * DIM] == cell[0]; ++j) {
            bool is_same = true;
            for (int k = 1; k < DIM; ++k) is_same = is_same && mixture.cells[j * DIM + k] == cell[k];
            if (!is_same) continue;
            mixture.next[i] = j;
            mixture.is_first[j] = 0;
            break;
        }
    }
    meet(team);
}

// The mixture with ½ blur² I added to every covariance; if it is merged, of one component for each cell.
template <int DIM>
GMM_INLINE void make_level(int64_t item, const Team& team, const Given& mixture, double blur, bool is_merged,
                           Level& level) {
    const double wide = 0.5 * blur * blur;
    int64_t place = 0, counted = 0;  // cells that begin before a component
    for (int64_t i = item; i < mixture.n; i += team.n) {
        double* low = level.low;
        if (is_merged) {
            for (; counted < i; ++counted) place += mixture.is_first[counted];
            if (!mixture.is_first[i]) continue;
        } else {
            place = i;
        }
        double *mean = level.means + place * DIM, *shape = level.covariances + place * DIM * DIM;
        double weight = 0.0, members = 0.0, largest;
        for (int64_t j = i; j >= 0; j = is_merged ? mixture.next[j] : -1, ++members)
            weight += mixture.weights[j];
        for (int k = 0; k < DIM; ++k) mean[k] = 0.0;
        for (int k = 0; k < DIM * DIM; ++k) shape[k] = k % (DIM + 1) ? 0.0 : wide;
        for (int64_t j = i; j >= 0; j = is_merged ? mixture.next[j] : -1) {
            const double share = weight > 0.0 ? mixture.weights[j] / weight : 1.0 / members;
            for (int k = 0; k < DIM; ++k) mean[k] += share * mixture.means[j * DIM + k];
        }
        for (int64_t j = i; j >= 0; j = is_merged ? mixture.next[j] : -1) {
            const double share = weight > 0.0 ? mixture.weights[j] / weight : 1.0 / members;
            double d[DIM];
            for (int k = 0; k < DIM; ++k) d[k] = mixture.means[j * DIM + k] - mean[k];
            for (int k = 0; k < DIM * DIM; ++k)
                shape[k] += share * (mixture.covariances[j * DIM * DIM + k] + d[k / DIM] * d[k % DIM]);
        }
        level.weights[place] = weight / mixture.total;
        low[place] = is_merged ? mixture.cells[i * DIM] * blur : mean[0];
        if (is_merged) {
            extents<DIM>(shape, level.thinnest + place, &largest);
        } else {
            largest = mixture.largest[i] + wide;
            level.thinnest[place] = mixture.least[i] + wide;
        }
        level.reaches[place] = CUTOFF * sqrt(maximum(largest, 0.0));
    }
    level.spread = is_merged ? 1.001 * blur : 0.0;
    level.n = is_merged ? 0 : mixture.n;
    if (is_merged)
        for (int64_t i = 0; i < mixture.n; ++i) level.n += mixture.is_first[i];
}

// Takes the trial if its score is better.
template <int DIM>
GMM_INLINE void absorb(Climb<DIM>& climb, bool is_start, double tolerance) {
    constexpr int FREE = n_free(DIM);
    const double *sums = climb.sums, total = sums[0], scale = maximum(total, 1e-300), score = log(total);
    const bool is_better = is_start || score > climb.score;
    if (is_better) {
        for (int i = 0; i < n_of_pose(DIM); ++i) climb.pose[i] = climb.trial[i];
        climb.score = score;
        for (int i = 0; i < FREE; ++i) climb.slope[i] = sums[1 + i] / scale;
        int place = 1 + FREE;
        for (int i = 0; i < FREE; ++i)
            for (int j = i; j < FREE; ++j, ++place) {
                climb.information[i][j] = climb.information[j][i] = sums[place] / scale;
                climb.scatter[i][j] = climb.scatter[j][i] =
                    sums[place + FREE * (FREE + 1) / 2] / scale - climb.slope[i] * climb.slope[j];
            }
    }
    if (is_start) {
        climb.active = total > 0.0;
        return;
    }
    climb.active = climb.active && climb.length > tolerance;
    climb.share = is_better ? minimum(2.0 * climb.share, 1.0) : climb.share / 4.0;
}

// The next trial: a step of Newton with the absolute values of the curvatures, in coordinates in which the
// information is the identity. unit: metres of a step in a shift, and radians of one in a turn.
template <int DIM>
GMM_INLINE void propose(Climb<DIM>& climb, double radius, double thickness) {
    constexpr int FREE = n_free(DIM);
    double step[FREE] = {0.0}, square = 0.0;
    if (climb.active) {
        double root[FREE][FREE], missing[FREE][FREE], axes[FREE][FREE], slope[FREE], ridge = 1e-12;
        double unit[FREE];
        for (int i = 0; i < FREE; ++i) {
            unit[i] = i < DIM ? 1.0 : 1.0 / radius;
            slope[i] = climb.slope[i] * unit[i];
            ridge = maximum(ridge, climb.information[i][i] * unit[i] * unit[i]);
        }
        ridge *= 1e-9;
        for (int i = 0; i < FREE; ++i)
            for (int j = 0; j < FREE; ++j) {
                root[i][j] = climb.information[i][j] * unit[i] * unit[j] + (i == j ? ridge : 0.0);
                missing[i][j] = climb.scatter[i][j] * unit[i] * unit[j];
            }
        factorise<FREE>(root, 1e-3 * ridge);
        for (int pass = 0; pass < 2; ++pass) {  // L⁻¹ S L⁻ᵀ
            for (int j = 0; j < FREE; ++j) solve_lower<FREE>(root, missing[j]);
            for (int i = 0; i < FREE; ++i)
                for (int j = i + 1; j < FREE; ++j) {
                    const double other = missing[i][j];
                    missing[i][j] = pass ? 0.5 * (other + missing[j][i]) : missing[j][i];
                    missing[j][i] = pass ? missing[i][j] : other;
                }
        }
        diagonalize<FREE>(missing, axes);
        solve_lower<FREE>(root, slope);
        double part[FREE], moves = 0.0;
        for (int k = 0; k < FREE; ++k) {
            part[k] = 0.0;
            for (int i = 0; i < FREE; ++i) part[k] += axes[i][k] * slope[i];
            part[k] /= maximum(fabs(1.0 - missing[k][k]), LEAST_CURVATURE);
            moves += part[k] * part[k];
        }
        moves = maximum(sqrt(moves), LONGEST);
        for (int i = 0; i < FREE; ++i)
            for (int k = 0; k < FREE; ++k) step[i] += axes[i][k] * part[k] * (LONGEST / moves);
        solve_upper<FREE>(root, step);
        for (int i = 0; i < FREE; ++i) square += step[i] * step[i];
        const double longest = THICKNESSES * thickness;
        const double share = longest / maximum(sqrt(square), longest) * climb.share;
        for (int i = 0; i < FREE; ++i) step[i] *= share * unit[i];
        climb.length = sqrt(square) * share;
    }
    move<DIM>(climb.pose, step, climb.trial);
}

// A motion of the source about its mean to the target about its own as a matrix in the world, its rotation
// orthonormal to rounding.
template <int DIM>
GMM_INLINE void world(const double* pose, const double* here, const double* there, double* matrix) {
    for (int i = 0; i < DIM; ++i) {
        double shift = pose[DIM * DIM + i] + there[i];
        for (int j = 0; j < DIM; ++j) {
            double turn = 1.5 * pose[i * DIM + j];  // R (3 I - R'R) / 2
            for (int k = 0; k < DIM; ++k)
                for (int l = 0; l < DIM; ++l)
                    turn -= 0.5 * pose[i * DIM + k] * pose[l * DIM + k] * pose[l * DIM + j];
            matrix[i * (DIM + 1) + j] = turn;
            shift -= turn * here[j];
        }
        matrix[i * (DIM + 1) + DIM] = shift;
    }
    for (int j = 0; j <= DIM; ++j) matrix[DIM * (DIM + 1) + j] = j == DIM ? 1.0 : 0.0;
}

// The components are in rising order of their first coordinate. found: KEPT rows of a pose, the same as a
// matrix in the world, the log score, whether the climb converged, 1/√ of the least eigenvalue of the Hessian
// of a step in metres, and the Hessian; then their number, the evaluations, the radius, the logarithm of both
// mixtures' overlaps with themselves, and whether lists of pairs are full.
template <int DIM>
GMM_KERNEL registration(int64_t item, Team team, int64_t n_source, const double* source_weights,
                        const double* source_means, const double* source_covariances, int64_t n_target,
                        const double* target_weights, const double* target_means,
                        const double* target_covariances, int64_t n_starts, const double* rotations,
                        const double* translations, bool by_area, double coarsest, double finest,
                        double tolerance, int64_t max_iterations, int64_t n_parts, int64_t capacity,
                        double* space, int64_t* whole, int32_t* lists, double* found) {
    constexpr int POSE = n_of_pose(DIM), FREE = n_free(DIM), N_SUMS = n_overlap_sums(DIM);
    constexpr int WORLD = (DIM + 1) * (DIM + 1), WIDTH = POSE + WORLD + 3 + FREE * FREE;
    typedef Climb<DIM> State;
    Given given[2] = {{n_source, source_weights, source_means, source_covariances},
                      {n_target, target_weights, target_means, target_covariances}};
    Level levels[2];
    double *medians = taken(space, 6), *last_row = found + KEPT * WIDTH;  // least, largest, and of a level
    for (int m = 0; m < 2; ++m) {
        const int64_t n = given[m].n;
        given[m].weights = taken(space, n);
        given[m].means = taken(space, n * DIM);
        given[m].least = taken(space, n);
        given[m].largest = taken(space, n);
        given[m].cells = taken(space, n * DIM);
        given[m].next = whole + 2 * m * n_source;
        given[m].is_first = given[m].next + n;
        levels[m].weights = taken(space, n);
        levels[m].means = taken(space, n * DIM);
        levels[m].covariances = taken(space, n * DIM * DIM);
        levels[m].reaches = taken(space, n);
        levels[m].thinnest = taken(space, n);
        levels[m].low = taken(space, n);
        for (int64_t i = item; i < n; i += team.n) {
            const double covered =
                extents<DIM>(given[m].covariances + i * DIM * DIM, given[m].least + i, given[m].largest + i);
            given[m].weights[i] = by_area ? covered : given[m].given_weights[i];
        }
    }
    const int64_t most = maximum(n_starts, (int64_t)KEPT + 1), n_rows = maximum(most * n_source, n_target);
    int64_t* counts = whole + 2 * (n_source + n_target);
    State* climbs = (State*)taken(space, most * (int64_t)(sizeof(State) / 8));
    double *partial = taken(space, most * n_parts * N_SUMS), *moved = taken(space, n_rows * POSE);
    meet(team);
    for (int m = 0; m < 2; ++m) {
        measure<DIM>(given[m]);
        for (int64_t i = item; i < given[m].n; i += team.n)
            for (int k = 0; k < DIM; ++k)
                given[m].means[i * DIM + k] = given[m].given_means[i * DIM + k] - given[m].centre[k];
        find_median(item, team, given[m].n, given[m].least, medians + m);
        find_median(item, team, given[m].n, given[m].largest, medians + 2 + m);
    }
    if (item == 0) last_row[5] = 0.0;
    meet(team);
    const double radius = minimum(given[0].radius, given[1].radius);
    const double thin = sqrt(minimum(medians[0], medians[1]));
    const double last_blur = maximum(finest < 0.0 ? thin : finest, THINNEST * radius);
    double blur = coarsest > 0.0 ? coarsest : radius / 8.0, thickness[2];
    int64_t n_kept = 0, n_evaluated = 0;
    int self = -1;  // the mixture that is compared with itself, after the last level
    for (int number = 0; self < 2; ++number) {
        const bool is_last = !(blur > 1.4142135623730951 * maximum(last_blur, thin));
        if (is_last) blur = last_blur;
        for (int m = 0; m < 2 && self < 0; ++m) {
            const bool is_merged = blur > sqrt(maximum(medians[2 + m], 0.0));
            if (is_merged) link_cells<DIM>(item, team, given[m], blur);
            make_level<DIM>(item, team, given[m], blur, is_merged, levels[m]);
            meet(team);
            if (is_merged) {
                find_median(item, team, levels[m].n, levels[m].thinnest, medians + 4 + m);
                meet(team);
            }
            thickness[m] = sqrt(maximum(is_merged ? medians[4 + m] : medians[m] + 0.5 * blur * blur, 0.0));
        }
        const Level &source = levels[self < 0 ? 0 : self], &target = levels[self < 0 ? 1 : self];
        const double thick = self < 0 ? thickness[0] + thickness[1] : 2.0 * thickness[self];
        const double slack = SLACK * thick, scale = 1.2 * CUTOFF * CUTOFF, wide = 6.0 * slack * slack;
        double size = 0.0, widest = 0.0;
        for (int64_t i = 0; i < source.n; ++i) {
            double square = 0.0;
            for (int k = 0; k < DIM; ++k) square += source.means[i * DIM + k] * source.means[i * DIM + k];
            size = maximum(size, sqrt(square) + source.reaches[i]);
        }
        for (int64_t j = 0; j < target.n; ++j) widest = maximum(widest, target.reaches[j]);
        const bool is_again = number == SECOND_CHANCE && n_starts == 1 && !(coarsest > 0.0) && self < 0;
        const int64_t n_old = number == 0 ? n_starts : n_kept, n = self < 0 ? n_old + is_again : 1;
        for (int64_t b = item; b < n; b += team.n) {
            State& climb = climbs[b];
            const int64_t start = number == 0 ? b : 0;
            for (int i = 0; i < POSE; ++i) {
                if (self >= 0)
                    climb.trial[i] = i < DIM * DIM && i % (DIM + 1) == 0 ? 1.0 : 0.0;
                else if (number > 0 && b < n_old)
                    climb.trial[i] = found[b * WIDTH + i];
                else if (i < DIM * DIM)
                    climb.trial[i] = rotations[start * DIM * DIM + i];
                else {
                    const int k = i - DIM * DIM;
                    double x = translations[start * DIM + k];
                    for (int j = 0; j < DIM; ++j)
                        x += rotations[(start * DIM + k) * DIM + j] * given[0].centre[j];
                    climb.trial[i] = x - given[1].centre[k];
                }
            }
            climb.active = climb.share = 1.0;
        }
        meet(team);
        const double accuracy = is_last ? tolerance : maximum(tolerance, COARSELY * blur);
        const int64_t limit = self < 0 ? max_iterations : 0, width = minimum(capacity / n_rows, target.n);
        bool is_any = true, is_listed = false;
        for (int64_t step = 0; is_any && step <= limit; ++step) {
            if (!is_listed) {
                for (int64_t piece = item; piece < n * source.n; piece += team.n) {
                    State& climb = climbs[piece / source.n];
                    if (!climb.active) continue;
                    const int64_t count = list_near<DIM>(climb.trial, source, piece % source.n, target, slack,
                                                         widest, scale, wide, width, lists + piece * width);
                    if (count > width) last_row[5] = 1.0;
                    counts[piece] = minimum(count, width);
                }
                for (int64_t b = item; b < n; b += team.n)
                    for (int i = 0; i < POSE; ++i) climbs[b].listed[i] = climbs[b].trial[i];
                meet(team);
            }
            for (int64_t piece = item; piece < n * n_parts; piece += team.n) {
                const int64_t b = piece / n_parts, part = piece % n_parts, row = b * source.n;
                if (climbs[b].active)
                    pair_sums<DIM>(climbs[b].trial, source, target, source.n * part / n_parts,
                                   source.n * (part + 1) / n_parts, lists + row * width, width, counts + row,
                                   moved + row * POSE, partial + piece * N_SUMS);
            }
            meet(team);
            add_parts(item, team, n, n_parts, partial, climbs);
            meet(team);
            for (int64_t b = item; b < n; b += team.n) {
                State& climb = climbs[b];
                if (climb.active) absorb<DIM>(climb, step == 0, accuracy);
                propose<DIM>(climb, radius, thick);
                climb.strayed = pose_gap<DIM>(climb.trial, climb.listed, size) > slack;
            }
            meet(team);
            is_any = false;
            is_listed = true;
            for (int64_t b = 0; b < n; ++b) {
                is_any = is_any || climbs[b].active;
                is_listed = is_listed && !climbs[b].strayed;
            }
            n_evaluated += self < 0;
        }
        if (self >= 0) {
            if (item == 0) last_row[3 + self] = climbs[0].score;
        } else {  // the best motions by falling score, without those near a better one or far below the best
            double best = climbs[0].score;
            for (int64_t b = 1; b < n; ++b) best = maximum(best, climbs[b].score);
            for (int64_t b = item; b < n; b += team.n) {
                climbs[b].worth = climbs[b].score >= best + log(LEAST);
                for (int64_t a = 0; a < n; ++a) {
                    const bool leads =
                        climbs[a].score > climbs[b].score || (climbs[a].score == climbs[b].score && a < b);
                    if (leads && pose_gap<DIM>(climbs[a].pose, climbs[b].pose, radius) < 0.5 * thick)
                        climbs[b].worth = 0.0;
                }
            }
            meet(team);
            n_kept = 0;
            for (int64_t b = 0; b < n; ++b) n_kept += climbs[b].worth != 0.0;
            n_kept = minimum(n_kept, (int64_t)KEPT);
            for (int64_t b = item; b < n; b += team.n) {
                const State& climb = climbs[b];
                int64_t place = 0;
                for (int64_t a = 0; a < n; ++a)
                    place += climbs[a].worth != 0.0
                             && (climbs[a].score > climb.score || (climbs[a].score == climb.score && a < b));
                if (climb.worth == 0.0 || place >= KEPT) continue;
                double *row = found + place * WIDTH, *rest = row + POSE + WORLD;
                for (int i = 0; i < POSE; ++i) row[i] = climb.pose[i];
                world<DIM>(climb.pose, given[0].centre, given[1].centre, row + POSE);
                rest[0] = climb.score;
                rest[1] = climb.active == 0.0 && climb.score > -1e300;
                double hessian[FREE][FREE], axes[FREE][FREE], least = INFINITY;
                for (int i = 0; i < FREE; ++i)
                    for (int j = 0; j < FREE; ++j) {
                        hessian[i][j] = climb.information[i][j] - climb.scatter[i][j];
                        rest[3 + i * FREE + j] = hessian[i][j];
                        hessian[i][j] /= (i < DIM ? 1.0 : radius) * (j < DIM ? 1.0 : radius);
                    }
                diagonalize<FREE>(hessian, axes);
                for (int i = 0; i < FREE; ++i) least = minimum(least, hessian[i][i]);
                rest[2] = least > 0.0 ? 1.0 / sqrt(least) : INFINITY;
            }
        }
        if (is_last) ++self;
        blur /= 2.0;
        meet(team);
    }
    if (item > 0) return;
    last_row[0] = (double)n_kept;
    last_row[1] = (double)n_evaluated;
    last_row[2] = radius;
}

}  // namespace gmm

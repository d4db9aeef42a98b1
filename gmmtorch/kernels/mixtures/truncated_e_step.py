"""E-step of truncated EM, and the choice of its candidates; the twins are in `mixture.em.grouping`.

Both fused kernels run on the CPU and work on groups of rows. The first one makes the natural parameters of a
group's candidates about its center, walks the group's rows once, and moves the sums to the components' means:
nothing is stored for a pair of a row and a candidate. It computes in float64 from rows of either type. With
float64 rows, statistics differ from the twin's by at most 10⁻¹² of their largest entry.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.kernels.choice import is_fused
from gmmtorch.kernels.compiler import FusedKernel
from gmmtorch.kernels.mixtures.e_step import PRODUCTS, SKIPPED
from gmmtorch.kernels.simd import CPU_LANES, SIMD

DIMENSIONS = (1, 2, 3)


class GroupedRows(NamedTuple):
    """features (S, F) about the group's center, weight (S,): of S slots, float32 or float64. begin (G + 1,):
    first slot of each group, multiples of eight. centers: (G, D).
    """

    features: Tensor
    weight: Tensor
    begin: Tensor
    centers: Tensor


_LOAD = """
    for (int l = 0; l < LANES; ++l)
        for (int f = 0; f < WIDTH; ++f) set(x[f], l, (double)features[(SLOT) * WIDTH + f]);
"""
_LOGITS = """
    for (int64_t k = 0; k < PADDED; k += 4) {
        const double* w = NATURAL + k * WIDTH;
        PRODUCTS
        logits[k] = a, logits[k + 1] = b, logits[k + 2] = c, logits[k + 3] = d;
        a = a > b ? a : b;
        c = c > d ? c : d;
        a = a > c ? a : c;
        peak = a > peak ? a : peak;
    }
"""
_EXPECTATION = """
    const int64_t first_group = n_groups * item / n_parts, last_group = n_groups * (item + 1) / n_parts;
    vec* logits = (vec*)scratch + item * n_padded * (WIDTH + 2);
    vec* sums = logits + n_padded;
    double* local = (double*)(sums + n_padded * WIDTH);  // n_padded * LANES entries and more
    double* out = statistics + item * n_components * WIDTH;
    vec x[WIDTH], total = (vec)(0.0);
    for (int64_t g = first_group; g < last_group; ++g) {
        if (begin[g] == begin[g + 1]) continue;
        const double* center = centers + g * DIM;
        for (int64_t j = 0; j < n_padded; ++j) {
            double* w = natural + (item * n_padded + j) * WIDTH;
            for (int f = 0; f < WIDTH; ++f) w[f] = 0.0;
            w[0] = -1e300;
            if (j >= n_candidates) continue;
            const int64_t k = candidates[g * n_candidates + j];
            const double* given = own + k * WIDTH;
            double offset[DIM], across = 0.0;
            for (int i = 0; i < DIM; ++i) offset[i] = means[k * DIM + i] - center[i];
            int f = 1 + DIM;
            for (int i = 0; i < DIM; ++i)
                for (int n = i; n < DIM; ++n, ++f) {  // -Q_ii/2, and -Q_in for both
                    w[f] = given[f];
                    if (i == n) {
                        w[1 + i] -= 2.0 * given[f] * offset[i];
                    } else {
                        w[1 + i] -= given[f] * offset[n];
                        w[1 + n] -= given[f] * offset[i];
                    }
                }
            for (int i = 0; i < DIM; ++i) across += w[1 + i] * offset[i];
            w[0] = given[0] - 0.5 * across;
        }
        for (int64_t j = 0; j < n_padded * WIDTH; ++j) sums[j] = (vec)(0.0);
        for (int64_t row = begin[g]; row < begin[g + 1]; row += LANES) {
            vec peak = (vec)(-1e300), norm = (vec)(0.0), p;
            for (int l = 0; l < LANES; ++l) set(p, l, (double)weight[row + l]);
            if (!likeliest && !any(p > 0.0)) continue;  // slots without rows
            LOAD
            LOGITS
            if (likeliest) {
                vec best = (vec)(0.0);
                for (int64_t j = n_candidates - 1; j >= 0; --j)
                    best = logits[j] == peak ? (vec)((double)j) : best;
                for (int l = 0; l < LANES; ++l)
                    likeliest[row + l] = candidates[g * n_candidates + (int64_t)get(best, l)];
            }
            for (int64_t j = 0; j < n_candidates; ++j) {
                const vec under = logits[j] - peak;
                logits[j] = (vec)(0.0);
                if (!any(under > -SKIPPED)) continue;
                logits[j] = under > -SKIPPED ? expo(under) : (vec)(0.0);
                norm += logits[j];
            }
            const vec share = p / norm;
            for (int64_t j = 0; j < n_candidates; ++j) {
                if (!any(logits[j] > 0.0)) continue;
                const vec gamma = logits[j] * share;
                for (int f = 0; f < WIDTH; ++f) sums[j * WIDTH + f] = fused(gamma, x[f], sums[j * WIDTH + f]);
            }
            total += p * (peak + logarithm(norm));
        }
        for (int64_t j = 0; j < n_candidates; ++j) {  // about the component's mean
            const int64_t k = candidates[g * n_candidates + j];
            double s[WIDTH], shift[DIM];
            for (int f = 0; f < WIDTH; ++f) {
                s[f] = 0.0;
                for (int l = 0; l < LANES; ++l) s[f] += get(sums[j * WIDTH + f], l);
            }
            for (int i = 0; i < DIM; ++i) shift[i] = center[i] - means[k * DIM + i];
            int f = 1 + DIM;
            for (int i = 0; i < DIM; ++i)
                for (int n = i; n < DIM; ++n, ++f)
                    s[f] += s[1 + i] * shift[n] + shift[i] * s[1 + n] + s[0] * shift[i] * shift[n];
            for (int i = 0; i < DIM; ++i) s[1 + i] += s[0] * shift[i];
            for (f = 0; f < WIDTH; ++f) out[k * WIDTH + f] += s[f];
        }
    }
    double sum = 0.0;
    for (int l = 0; l < LANES; ++l) sum += get(total, l);
    value[item] = sum;
"""
_CHOICE = """
    // A component is compared with the samples of a group only if an upper bound of its logits shows that it
    // can be a candidate: log(weight density at the mean) - (distance - radius)^2 / (2 variance), for the
    // ball around the samples. The candidates are exact.
    const int64_t first_group = n_groups * item / n_parts, last_group = n_groups * (item + 1) / n_parts;
    vec* logits = (vec*)scratch + item * n_padded * 3;
    double *upper = (double*)(logits + n_padded), *best = upper + n_padded;
    int64_t *listed = (int64_t*)(best + n_padded), *found = listed + n_padded;
    double *score = scores + item * n_candidates, reach = 32.0;  // nats below the largest bound
    for (int64_t k = 0; k < n_padded; ++k) best[k] = -HUGE_VAL;
    // Puts x of component k into a row of the largest ones, in which place `worst` is replaced next.
    auto insert = [&](double x, int64_t k, int64_t first, int64_t& n, int64_t& worst, int64_t* names) {
        const int64_t place = n < n_candidates ? n++ : worst;
        if (names) names[place] = k;
        score[place] = x;
        if (n < n_candidates) return;
        worst = first;
        for (int64_t j = first + 1; j < n_candidates; ++j)
            if (score[j] < score[worst] || (names && score[j] == score[worst] && names[j] > names[worst]))
                worst = j;
    };
    vec x[WIDTH];
    for (int64_t g = first_group; g < last_group; ++g) {
        const double* center = centers + g * DIM;
        int64_t n_found = 0;
        for (int64_t sample = 0; sample < n_samples && begin[g] < begin[g + 1]; sample += LANES) {
            LOAD
            vec squared = (vec)(0.0), top = (vec)(-1e300), peak = (vec)(-1e300);
            for (int i = 0; i < DIM; ++i) squared += x[1 + i] * x[1 + i];
            const double radius = sqrt(largest(squared));
            int f = 1 + DIM;
            for (int i = 0; i < DIM; ++i)
                for (int n = i; n < DIM; ++n, ++f)
                    x[f] += x[1 + i] * center[n] + center[i] * x[1 + n] + x[0] * (center[i] * center[n]);
            for (int i = 0; i < DIM; ++i) x[1 + i] += x[0] * center[i];
            for (int64_t k = 0; k < n_padded; k += LANES) {
                const vec* own = (const vec*)(bounds + k);
                vec gap = (vec)(0.0);
                for (int i = 0; i < DIM; ++i) {
                    const vec off = own[i * n_padded / LANES] - center[i];
                    gap += off * off;
                }
                gap = root(gap) - radius;
                gap = (gap > 0.0 ? gap : (vec)(0.0)) * own[(DIM + 1) * n_padded / LANES];
                const vec most = own[DIM * n_padded / LANES] - gap * gap;
                *(vec*)(upper + k) = most;
                top = most > top ? most : top;
            }
            const double most = largest(top);
            double below = HUGE_VAL, from = most - reach;
            int64_t n_listed = 0, n_best = 0, worst = 0;
            while (from < below) {
                for (int64_t k = 0; k < n_padded; k += LANES) {
                    const vec bound = *(const vec*)(upper + k);
                    if (!any((bound >= from) & (bound < below))) continue;
                    for (int l = 0; l < LANES; ++l) {
                        if (!(upper[k + l] >= from && upper[k + l] < below)) continue;
                        const double* w = natural + (k + l) * WIDTH;
                        vec logit = x[0] * w[0];
                        for (int i = 1; i < WIDTH; ++i) logit = fused(x[i], (vec)(w[i]), logit);
                        peak = logit > peak ? logit : peak;
                        logits[n_listed] = logit;
                        listed[n_listed++] = k + l;
                    }
                }
                n_best = worst = 0;
                for (int64_t j = 0; j < n_listed; ++j) {
                    const vec under = logits[j] - peak;
                    if (n_best == n_candidates && !any(under > score[worst])) continue;
                    insert(largest(under), j, 0, n_best, worst, nullptr);
                }
                // No component below `from` is more likely than the worst of the candidates.
                below = from;
                const bool enough = n_best == n_candidates;
                from = enough ? score[worst] - largest(-peak) - SLACK : most - 4.0 * (most - from);
                if (n_listed == n_padded) break;
            }
            reach = most - GMM_MIN(from, below);
            for (int64_t j = 0; j < n_listed; ++j) {
                double& own = best[listed[j]];
                if (own == -HUGE_VAL) found[n_found++] = listed[j];
                own = GMM_MAX(own, largest(logits[j] - peak));
            }
        }
        if (n_found == 0)  // no rows: any candidates
            for (int64_t k = 0; k < n_candidates; ++k) found[n_found++] = k;
        int64_t n_chosen = 1, worst = 0;
        int64_t* chosen = candidates + g * n_candidates;
        chosen[0] = g;
        for (int64_t j = 0; j < n_found; ++j) {
            const int64_t k = found[j];
            if (k != g && n_candidates > 1 && k < n_components) {  // of equal ones, the first is taken
                const bool first = n_chosen == n_candidates && best[k] == score[worst] && k < chosen[worst];
                if (n_chosen < n_candidates || best[k] > score[worst] || first)
                    insert(best[k], k, 1, n_chosen, worst, chosen);
            }
            best[k] = -HUGE_VAL;
        }
    }
"""
_SLACK = 1e-6  # nats of rounding in a bound


def _kernel(name: str, body: str, parameters: str, dim: int, kind: str) -> FusedKernel:
    slot = "row + l" if name == "truncated" else "slots[g * n_samples + GMM_MIN(sample + l, n_samples - 1)]"
    natural = "(natural + item * n_padded * WIDTH)" if name == "truncated" else "natural"
    body = body.replace("LOAD", _LOAD.replace("SLOT", slot)).replace(
        "LOGITS", _LOGITS.replace("PRODUCTS", PRODUCTS)
    )
    body = body.replace("PADDED", "n_padded").replace("NATURAL", natural)
    body = body.replace("WIDTH", str(1 + dim + dim * (dim + 1) // 2)).replace("DIM", str(dim))
    rows = f"const {kind}* features, const {kind}* weight, const int64* begin, const double* centers,"
    sizes = " int64 n_groups, int64 n_components, int64 n_candidates, int64 n_padded, int64 n_parts, "
    return FusedKernel(
        f"{name}_{dim}d_{kind}",
        rows + sizes + parameters,
        SIMD + body.replace("SKIPPED", str(SKIPPED)).replace("SLACK", str(_SLACK)),
    )


def _kernels(name: str, body: str, parameters: str) -> dict[tuple[int, torch.dtype], FusedKernel]:
    kinds = {torch.float32: "float", torch.float64: "double"}
    return {(d, t): _kernel(name, body, parameters, d, k) for d in DIMENSIONS for t, k in kinds.items()}


_EXPECTATIONS = _kernels(
    "truncated",
    _EXPECTATION,
    "const int64* candidates, const double* own, const double* means, double* scratch, double* natural,"
    " double* statistics, double* value, int64* likeliest",
)
_CHOICES = _kernels(
    "candidates",
    _CHOICE,
    "const int64* slots, int64 n_samples, const double* natural, const double* bounds, double* scratch,"
    " double* scores, int64* candidates",
)


def is_truncated_e_step_fused(rows: GroupedRows, *others: Tensor) -> bool:
    """Whether the fused kernels compute with these groups."""
    fits = rows.features.device.type == "cpu" and rows.centers.shape[1] in DIMENSIONS
    return fits and is_fused(*rows, *others)


def fused_expectation(
    rows: GroupedRows, candidates: Tensor, own: Tensor, means: Tensor, want_likeliest: bool
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Statistics (K, F) about the components' means, Σ p log Σ exp (a scalar), and the most likely candidate
    (S,) of each slot, if requested.

    Args:
        candidates: (G, m). own: (K, F), natural parameters of the components about their own means.
        means: (K, D).
    """
    n_groups, m = candidates.shape
    k, width = own.shape
    n_parts, padded = _n_parts(n_groups), m + -m % 4
    scratch = own.new_empty(n_parts, padded * (width + 2), CPU_LANES)
    natural = own.new_empty(n_parts, padded, width)
    statistics, value = own.new_zeros(n_parts, k, width), own.new_empty(n_parts)
    likeliest = torch.empty(len(rows.weight), dtype=torch.int64) if want_likeliest else None
    sizes = n_groups, k, m, padded, n_parts
    given = candidates.contiguous(), own.contiguous(), means.contiguous()
    kernel = _EXPECTATIONS[rows.centers.shape[1], rows.features.dtype]
    kernel(n_parts, *rows, *sizes, *given, scratch, natural, statistics, value, likeliest, device=own.device)
    return statistics.sum(0), value.sum(), likeliest


def fused_candidates(
    rows: GroupedRows, slots: Tensor, natural: Tensor, bounds: Tensor, n_candidates: int
) -> Tensor:
    """The most likely `n_candidates` components (G, m) for the sampled slots (G, n) of each of the G groups.

    Component g is a candidate of group g. The order is arbitrary.

    Args:
        natural: (G, F), of the components. bounds (D + 2, G): their means; the logarithm of weight times
            density at the mean; and √(1/2v), v at least the largest variance.
    """
    k, width = natural.shape
    n_parts, padded = _n_parts(k), k + -k % CPU_LANES
    table = natural.new_zeros(padded, width)
    table[:k], table[k:, 0] = natural, -1e300
    padded_bounds = natural.new_zeros(bounds.shape[0], padded)
    padded_bounds[:, :k], padded_bounds[-2, k:] = bounds, -1e300
    scratch = natural.new_empty(n_parts, 3, padded, CPU_LANES)
    scores = natural.new_empty(n_parts, n_candidates)
    candidates = torch.empty(k, n_candidates, dtype=torch.int64)
    sizes = k, k, n_candidates, padded, n_parts
    kernel = _CHOICES[rows.centers.shape[1], rows.features.dtype]
    given = slots.contiguous(), slots.shape[1], table, padded_bounds
    kernel(n_parts, *rows, *sizes, *given, scratch, scores, candidates, device=natural.device)
    return candidates


def _n_parts(n_groups: int) -> int:
    return max(1, min(torch.get_num_threads(), n_groups))

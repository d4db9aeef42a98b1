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
    const int64_t first_group = n_groups * item / n_parts, last_group = n_groups * (item + 1) / n_parts;
    vec *logits = (vec*)scratch + 2 * item * n_padded, *best = logits + n_padded;
    vec x[WIDTH];
    for (int64_t g = first_group; g < last_group; ++g) {
        const double* center = centers + g * DIM;
        if (begin[g] == begin[g + 1])
            for (int64_t k = 0; k < n_padded; ++k) best[k] = (vec)(-1e300);
        for (int64_t sample = 0; sample < n_samples; sample += LANES) {
            if (begin[g] == begin[g + 1]) break;
            LOAD
            int f = 1 + DIM;
            for (int i = 0; i < DIM; ++i)
                for (int n = i; n < DIM; ++n, ++f)
                    x[f] += x[1 + i] * center[n] + center[i] * x[1 + n] + x[0] * (center[i] * center[n]);
            for (int i = 0; i < DIM; ++i) x[1 + i] += x[0] * center[i];
            vec peak = (vec)(-1e300);
            LOGITS
            if (sample == 0)
                for (int64_t k = 0; k < n_components; ++k) best[k] = logits[k] - peak;
            else
                for (int64_t k = 0; k < n_components; ++k) {
                    const vec under = logits[k] - peak;
                    best[k] = under > best[k] ? under : best[k];
                }
        }
        int64_t* chosen = candidates + g * n_candidates;
        double* score = scores + item * n_candidates;
        int64_t n_chosen = 1, worst = 0;
        chosen[0] = g;
        for (int64_t k = 0; k < n_components; ++k) {
            if (k == g) continue;
            if (n_chosen == n_candidates && (n_candidates == 1 || !any(best[k] > score[worst]))) continue;
            double largest = get(best[k], 0);
            for (int l = 1; l < LANES; ++l) largest = GMM_MAX(largest, get(best[k], l));
            const int64_t place = n_chosen < n_candidates ? n_chosen++ : worst;
            chosen[place] = k;
            score[place] = largest;
            if (n_chosen < n_candidates) continue;
            worst = 1;
            for (int64_t j = 2; j < n_candidates; ++j)
                if (score[j] < score[worst]) worst = j;
        }
    }
"""


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
        f"{name}_{dim}d_{kind}", rows + sizes + parameters, SIMD + body.replace("SKIPPED", str(SKIPPED))
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
    "const int64* slots, int64 n_samples, const double* natural, double* scratch, double* scores,"
    " int64* candidates",
)


def is_fused_on(rows: GroupedRows, *others: Tensor) -> bool:
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


def fused_candidates(rows: GroupedRows, slots: Tensor, natural: Tensor, n_candidates: int) -> Tensor:
    """The most likely `n_candidates` components (G, m) for the sampled slots (G, n) of each of the G groups.

    Component g is a candidate of group g. natural: (G, F), of the components. The order is arbitrary.
    """
    k, width = natural.shape
    n_parts, padded = _n_parts(k), k + -k % 4
    table = natural.new_zeros(padded, width)
    table[:k], table[k:, 0] = natural, -1e300
    scratch = natural.new_empty(n_parts, 2, padded, CPU_LANES)
    scores = natural.new_empty(n_parts, n_candidates)
    candidates = torch.empty(k, n_candidates, dtype=torch.int64)
    sizes = k, k, n_candidates, padded, n_parts
    kernel = _CHOICES[rows.centers.shape[1], rows.features.dtype]
    sampled = slots.contiguous(), slots.shape[1]
    kernel(n_parts, *rows, *sizes, *sampled, table, scratch, scores, candidates, device=natural.device)
    return candidates


def _n_parts(n_groups: int) -> int:
    return max(1, min(torch.get_num_threads(), n_groups))

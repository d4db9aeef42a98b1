"""Cells cut into flat pieces, level by level; the twin is in `mixture.em.partition`.

The fused kernel runs on the CPU, in one launch for all levels. Its pieces are those of the twin, except where
a decision depends on rounding: a point within rounding of a cut, or two directions of equal extent.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.kernels.choice import is_fused
from gmmtorch.kernels.compiler import FusedKernel

DIMENSIONS = (1, 2, 3)

_BODY = """
    // One item for all levels. A piece p has sums[p], work[p] (mean, direction, least weight, priority), and
    // halves[2 p] and halves[2 p + 1]: weight, position and its square along the direction.
    auto bits = [](double x) { union { double x; uint64_t bits; } both; both.x = x; return both.bits; };
    int64_t n = 1;
    for (int64_t i = 0; i < n_rows; ++i) labels[i] = 0;
    for (int64_t level = 0; level < n_levels; ++level) {
        for (int64_t f = 0; f < n * WIDTH; ++f) sums[f] = 0.0;
        for (int64_t f = 0; f < n * 6; ++f) halves[f] = 0.0;
        for (int64_t i = 0; i < n_rows; ++i) {
            double* sum = sums + labels[i] * WIDTH;
            const double *x = points + i * DIM, *given = features + i * WIDTH, p = weight[i];
            sum[0] += p;
            for (int a = 0; a < DIM; ++a) sum[1 + a] += p * given[1 + a];
            for (int f = 1 + DIM; f < WIDTH; ++f) sum[f] += p * given[f];
        }
        for (int64_t piece = 0; piece < n; ++piece) {
            const double* sum = sums + piece * WIDTH;
            double* own = work + piece * (2 * DIM + 2);
            const double count = GMM_MAX(sum[0], 1e-300);
            double c[DIM][DIM], v[DIM][DIM];
            for (int a = 0; a < DIM; ++a) own[a] = sum[1 + a] / count;
            for (int a = 0, f = 1 + DIM; a < DIM; ++a)
                for (int b = a; b < DIM; ++b, ++f) {
                    c[a][b] = c[b][a] = sum[f] / count - own[a] * own[b];
                    v[a][b] = v[b][a] = a == b ? 1.0 : 0.0;
                }
            for (int sweep = 0; sweep < 30; ++sweep) {  // Jacobi's rotations
                double off = 0.0, on = 0.0;
                for (int a = 0; a < DIM; ++a)
                    for (int b = 0; b < DIM; ++b) (a == b ? on : off) += c[a][b] * c[a][b];
                if (!(off > 1e-32 * on)) break;
                for (int a = 0; a < DIM; ++a)
                    for (int b = a + 1; b < DIM; ++b) {
                        if (c[a][b] == 0.0) continue;
                        const double w = (c[b][b] - c[a][a]) / (2.0 * c[a][b]);
                        const double t = (w < 0.0 ? -1.0 : 1.0) / (fabs(w) + sqrt(w * w + 1.0));
                        const double cosine = 1.0 / sqrt(t * t + 1.0), sine = t * cosine;
                        for (int k = 0; k < DIM; ++k) {
                            const double x = c[k][a], y = c[k][b];
                            c[k][a] = cosine * x - sine * y, c[k][b] = sine * x + cosine * y;
                        }
                        for (int k = 0; k < DIM; ++k) {
                            const double x = c[a][k], y = c[b][k];
                            c[a][k] = cosine * x - sine * y, c[b][k] = sine * x + cosine * y;
                        }
                        for (int k = 0; k < DIM; ++k) {
                            const double x = v[k][a], y = v[k][b];
                            v[k][a] = cosine * x - sine * y, v[k][b] = sine * x + cosine * y;
                        }
                    }
            }
            int longest = 0, shortest = 0, widest = 0;
            for (int a = 1; a < DIM; ++a) {
                if (c[a][a] > c[longest][longest]) longest = a;
                if (c[a][a] < c[shortest][shortest]) shortest = a;
            }
            for (int a = 1; a < DIM; ++a)
                if (fabs(v[a][longest]) > fabs(v[widest][longest])) widest = a;
            const double sign = v[widest][longest] < 0.0 ? -1.0 : 1.0;
            for (int a = 0; a < DIM; ++a) own[DIM + a] = sign * v[a][longest];
            const double thin = GMM_MAX(c[shortest][shortest], 0.0), wide = c[longest][longest];
            const double thick = sqrt(thin), reach = sqrt(GMM_MAX(wide, 0.0));
            own[2 * DIM] = thick > 2.0 * thickness ? min_weight_thick : min_weight;
            const bool wanted = (thick > thickness || reach > length) && reach > 0.0;
            const bool heavy = count >= 2.0 * own[2 * DIM];
            own[2 * DIM + 1] = wanted && heavy ? count * (wide + thickness_priority * thin) : -1.0;
        }
        for (int64_t i = 0; i < n_rows; ++i) {
            const double *x = points + i * DIM, *own = work + labels[i] * (2 * DIM + 2);
            double at = 0.0;
            for (int a = 0; a < DIM; ++a) at += (x[a] - own[a]) * own[DIM + a];
            along[i] = at;
            double* half = halves + (2 * labels[i] + (at > 0.0)) * 3;
            half[0] += weight[i], half[1] += weight[i] * at, half[2] += weight[i] * (at * at);
        }
        int64_t n_cut = 0;
        for (int64_t piece = 0; piece < n; ++piece) {
            double *own = work + piece * (2 * DIM + 2), *half = halves + piece * 6;
            const double few = GMM_MIN(half[0], half[3]);
            const double low = half[1] / GMM_MAX(half[0], 1e-300), high = half[4] / GMM_MAX(half[3], 1e-300);
            const double* more = half[3] > half[0] ? half + 3 : half;
            const double mean = more == half ? low : high, gap = high - low;
            const double variance = more[2] / GMM_MAX(more[0], 1e-300) - mean * mean;
            const bool outlier = gap > outlier_gap && gap > 6.0 * sqrt(GMM_MAX(variance, 0.0));
            if (!(few > 0.0 && (few >= own[2 * DIM] || outlier))) own[2 * DIM + 1] = -1.0;
            n_cut += own[2 * DIM + 1] >= 0.0;
        }
        // While there are few pieces, the limit allows to halve all of them.
        const int64_t at_once = 4 * n <= limit ? n : (n + 1) / 2;
        int64_t allowed = limit < 0 ? n_cut : GMM_MIN(limit - n, at_once);
        if (allowed <= 0 || n_cut == 0) break;
        uint64_t least = 0, above = 0x7FF0000000000000ull;  // bits of a priority: enough pieces have `least`
        while (n_cut > allowed && above - least > 1) {
            const uint64_t middle = least + (above - least) / 2;
            int64_t enough = 0;
            for (int64_t piece = 0; piece < n; ++piece) {
                const double priority = work[piece * (2 * DIM + 2) + 2 * DIM + 1];
                enough += priority >= 0.0 && bits(priority) >= middle;
            }
            if (enough >= allowed) least = middle; else above = middle;
        }
        int64_t n_above = 0, n_new = n;
        for (int64_t piece = 0; piece < n; ++piece) {
            const double priority = work[piece * (2 * DIM + 2) + 2 * DIM + 1];
            n_above += priority >= 0.0 && bits(priority) > least;
        }
        for (int64_t piece = 0; piece < n; ++piece) {
            double* own = work + piece * (2 * DIM + 2);
            const double priority = own[2 * DIM + 1];
            bool cut = priority >= 0.0 && bits(priority) >= least;
            if (cut && n_cut > allowed && bits(priority) == least) cut = n_above++ < allowed;
            number[piece] = cut ? n_new++ : -1;
        }
        for (int64_t i = 0; i < n_rows; ++i)
            if (along[i] > 0.0 && number[labels[i]] >= 0) labels[i] = number[labels[i]];
        n = n_new;
    }
    *n_pieces = n;
"""


def _kernel(dim: int) -> FusedKernel:
    body = _BODY.replace("WIDTH", str(1 + dim + dim * (dim + 1) // 2)).replace("DIM", str(dim))
    return FusedKernel(
        f"piece_cuts_{dim}d",
        "const double* points, const double* features, const double* weight, int64 n_rows, int64 n_levels,"
        " int64 limit, double thickness, double length, double min_weight, double min_weight_thick,"
        " double outlier_gap, double thickness_priority, double* sums, double* work, double* halves,"
        " double* along, int64* number, int64* labels, int64* n_pieces",
        body,
        shares=True,
    )


_KERNELS = {dim: _kernel(dim) for dim in DIMENSIONS}


class CutRule(NamedTuple):
    """When a piece is cut: the options of `FlatnessRule`, the most levels, and the weight of thickness in the
    priority of a cut. max_components: −1 for no limit."""

    n_levels: int
    max_components: int
    thickness: float
    length: float
    min_weight: float
    min_weight_thick: float
    outlier_gap: float
    thickness_priority: float


def are_piece_cuts_fused(points: Tensor, weight: Tensor, features: Tensor) -> bool:
    """Whether the fused kernel computes with these cells."""
    given = points, weight, features
    fits = points.device.type == "cpu" and points.shape[1] in DIMENSIONS
    return fits and all(tensor.dtype == torch.float64 for tensor in given) and is_fused(*given)


def piece_cuts(points: Tensor, weight: Tensor, features: Tensor, rule: CutRule) -> tuple[Tensor, int]:
    """The piece (N,) of each cell, and the number of pieces.

    Args:
        points (N, D), weight (N,), features (N, F): means, weights and mean features of the cells, float64,
            on the CPU. N ≥ 1.
    """
    n, width = features.shape
    most = n if rule.max_components < 0 else max(1, min(n, rule.max_components))
    sums, halves = points.new_empty(most, width), points.new_empty(most, 6)
    work, along = points.new_empty(most, 2 * points.shape[1] + 2), points.new_empty(n)
    number, labels = torch.empty(most, dtype=torch.int64), torch.empty(n, dtype=torch.int64)
    n_pieces = torch.empty(1, dtype=torch.int64)
    given = points.contiguous(), features.contiguous(), weight.contiguous(), n
    made = sums, work, halves, along, number, labels, n_pieces
    _KERNELS[points.shape[1]](1, *given, *rule, *made, device=points.device)
    return labels, int(n_pieces)

"""Overlap of pairs of components under rigid motions: sums of the terms of `registration.overlap`; its twin.

The fused kernel evaluates eight pairs at a time and keeps the sums of one motion. Sums differ from the twin's
by at most 10⁻¹¹ of their largest entry.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gmmtorch.kernels.compiler import FusedKernel
from gmmtorch.kernels.simd import CPU_LANES, SIMD

_GPU_PARTS = 1024  # of the pairs; each part has its own sums

_BODY = """
    const int64_t begin = n_pairs * item / n_parts, stop = n_pairs * (item + 1) / n_parts;
    vec sum[N_SUMS];
    for (int s = 0; s < N_SUMS; ++s) sum[s] = (vec)(0.0);
    for (int64_t pair = begin; pair < stop;) {
        const int64_t b = motion[pair];
        int64_t lanes = 0;
        vec l[DIM], d[DIM], a[DIM][DIM], c[DIM][DIM], weight = (vec)(0.0);
        for (int lane = 0; lane < LANES; ++lane) {  // as many pairs of one motion; the last one repeats
            const bool follows = pair + lane < stop && motion[pair + lane] == b;
            if (lane == lanes && follows) ++lanes;
            const int64_t at = pair + GMM_MIN((int64_t)lane, lanes - 1), i = source[at], j = target[at];
            const int64_t row = b * n_source + i;
            const double *lever = levers + row * DIM, *shape = moved + row * DIM * DIM;
            for (int r = 0; r < DIM; ++r) {
                set(l[r], lane, lever[r]);
                set(d[r], lane, lever[r] + translations[b * DIM + r] - means[j * DIM + r]);
                for (int q = r; q < DIM; ++q) {
                    set(a[r][q], lane, shape[r * DIM + q]);
                    set(c[r][q], lane, shape[r * DIM + q] + covariances[(j * DIM + r) * DIM + q]);
                }
            }
            if (lane < lanes) set(weight, lane, source_weights[i] * target_weights[j]);
        }
        vec root_of[DIM][DIM], inverse[DIM][DIM], w[DIM][DIM], scale = (vec)(1.0);
        for (int j = 0; j < DIM; ++j) {  // Cholesky's factor, and its inverse
            for (int i = j; i < DIM; ++i) {
                vec rest = c[j][i];
                for (int k = 0; k < j; ++k) rest -= root_of[i][k] * root_of[j][k];
                root_of[i][j] = i == j ? root(rest) : rest / root_of[j][j];
            }
            scale *= root_of[j][j];
        }
        for (int j = 0; j < DIM; ++j) {
            inverse[j][j] = 1.0 / root_of[j][j];
            for (int i = j + 1; i < DIM; ++i) {
                vec rest = (vec)(0.0);
                for (int k = j; k < i; ++k) rest += root_of[i][k] * inverse[k][j];
                inverse[i][j] = -rest / root_of[i][i];
            }
        }
        for (int i = 0; i < DIM; ++i)
            for (int j = i; j < DIM; ++j) {
                w[i][j] = (vec)(0.0);
                for (int k = j; k < DIM; ++k) w[i][j] += inverse[k][i] * inverse[k][j];
                w[j][i] = w[i][j];
                a[j][i] = a[i][j];
            }
        vec pull[DIM], arm[DIM], matched[DIM][DIM], square = (vec)(0.0);
        for (int i = 0; i < DIM; ++i) {
            pull[i] = (vec)(0.0);
            for (int j = 0; j < DIM; ++j) pull[i] += w[i][j] * d[j];
            square += d[i] * pull[i];
        }
        for (int i = 0; i < DIM; ++i) {
            arm[i] = l[i];
            for (int j = 0; j < DIM; ++j) {
                arm[i] -= a[i][j] * pull[j];
                matched[i][j] = (vec)(0.0);
                for (int k = 0; k < DIM; ++k) matched[i][j] += a[i][k] * w[k][j];
            }
        }
        vec slope[FREE], jacobian[DIM][TURNS], change[TURNS][DIM][DIM], information[FREE][FREE];
        for (int i = 0; i < DIM; ++i) slope[i] = -pull[i];
        for (int k = 0; k < TURNS; ++k) {  // G_k x = (-x_j, x_i) in the rows (i, j)
            const int i = DIM == 2 ? 0 : (k + 1) % DIM, j = DIM == 2 ? 1 : (k + 2) % DIM;
            slope[DIM + k] = pull[i] * arm[j] - pull[j] * arm[i] + matched[j][i] - matched[i][j];
            vec swept[DIM][DIM];
            for (int r = 0; r < DIM; ++r) {
                jacobian[r][k] = r == i ? -l[j] : r == j ? l[i] : (vec)(0.0);
                for (int q = 0; q < DIM; ++q)
                    swept[r][q] = r == i ? -a[j][q] : r == j ? a[i][q] : (vec)(0.0);
            }
            for (int r = 0; r < DIM; ++r)
                for (int q = 0; q < DIM; ++q) {
                    change[k][r][q] = (vec)(0.0);
                    for (int m = 0; m < DIM; ++m) change[k][r][q] += w[r][m] * (swept[m][q] + swept[q][m]);
                }
        }
        for (int i = 0; i < DIM; ++i) {
            for (int j = 0; j < DIM; ++j) information[i][j] = w[i][j];
            for (int k = 0; k < TURNS; ++k) {
                vec product = (vec)(0.0);
                for (int j = 0; j < DIM; ++j) product += w[i][j] * jacobian[j][k];
                information[i][DIM + k] = product;
            }
        }
        for (int k = 0; k < TURNS; ++k)
            for (int m = k; m < TURNS; ++m) {
                vec product = (vec)(0.0), trace = (vec)(0.0);
                for (int i = 0; i < DIM; ++i) {
                    product += jacobian[i][k] * information[i][DIM + m];
                    for (int j = 0; j < DIM; ++j) trace += change[k][i][j] * change[m][j][i];
                }
                information[DIM + k][DIM + m] = product + 0.5 * trace;
            }
        const vec share = weight * expo(-0.5 * square) * NORM / scale;
        sum[0] += share;
        int place = 1;
        for (int i = 0; i < FREE; ++i) sum[place++] += share * slope[i];
        for (int i = 0; i < FREE; ++i)
            for (int j = i; j < FREE; ++j) sum[place++] += share * information[i][j];
        for (int i = 0; i < FREE; ++i)
            for (int j = i; j < FREE; ++j) sum[place++] += share * slope[i] * slope[j];
        pair += lanes;
        if (pair < stop && motion[pair] == b) continue;
        double* out = sums + (item * n_motions + b) * N_SUMS;
        for (int s = 0; s < N_SUMS; ++s) {
            for (int lane = 0; lane < LANES; ++lane) out[s] += get(sum[s], lane);
            sum[s] = (vec)(0.0);
        }
    }
"""


def _kernel(dim: int) -> FusedKernel:
    free = dim + dim * (dim - 1) // 2
    body = _BODY.replace("N_SUMS", str(1 + free + free * (free + 1))).replace("FREE", str(free))
    body = body.replace("TURNS", str(free - dim)).replace("DIM", str(dim))
    return FusedKernel(
        f"pair_overlap_{dim}d",
        "const int64* motion, const int64* source, const int64* target, int64 n_pairs, int64 n_parts,"
        " int64 n_motions, int64 n_source, const double* levers, const double* moved,"
        " const double* translations, const double* means, const double* covariances,"
        " const double* source_weights, const double* target_weights, double* sums",
        SIMD + body.replace("NORM", repr((2 * torch.pi) ** (-dim / 2))),
    )


_KERNELS = {dim: _kernel(dim) for dim in (2, 3)}


def overlap_sums(
    pairs: tuple[Tensor, Tensor, Tensor],
    levers: Tensor,
    moved: Tensor,
    translations: Tensor,
    target: tuple[Tensor, Tensor],
    weights: tuple[Tensor, Tensor],
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Sums over the pairs of each of B motions.

    With s = π_i π_j N of a pair: Σ s (B,), Σ s ∂log N (B, F), Σ s times the information (B, F, F), and
    Σ s ∂log N ∂log Nᵀ (B, F, F), F = D + D(D−1)/2.

    Args:
        pairs: rows of the motion, the source and the target, (P,) each; fastest in the order of motions.
        levers: R μ_i (B, K, D). moved: R Σ_i Rᵀ (B, K, D, D). translations: (B, D).
        target: means (J, D) and covariances (J, D, D). weights: π of the source (K,) and of the target (J,).
    """
    n, dim = translations.shape
    free = dim + dim * (dim - 1) // 2
    on_cpu = levers.device.type == "cpu"
    most = torch.get_num_threads() if on_cpu else _GPU_PARTS
    n_parts = max(1, min(most, len(pairs[0]) // (8 * CPU_LANES)))
    n_triangle = free * (free + 1) // 2
    sums = levers.new_zeros(n_parts, n, 1 + free + 2 * n_triangle)
    counts = len(pairs[0]), n_parts, n, levers.shape[1]
    tensors = (levers, moved, translations, *target, *weights, sums)
    given = [part.contiguous() for part in (*pairs, *tensors)]
    _KERNELS[dim](n_parts, *given[:3], *counts, *given[3:], device=levers.device)
    total, slope, *triangles = sums.sum(0).split([1, free, n_triangle, n_triangle], 1)
    rows, columns = torch.triu_indices(free, free, device=levers.device)
    full = levers.new_zeros(2, n, free, free)
    full[:, :, rows, columns] = full[:, :, columns, rows] = torch.stack(triangles)
    return total[:, 0], slope, full[0], full[1]

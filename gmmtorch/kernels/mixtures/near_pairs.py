"""Pairs of components within reach of each other: those that the sums of `pair_overlap` run over.

The fused kernel tests all pairs, which is faster than a k-d tree for the few hundred components of a scan.
The twin is in `Ascent.pairs` of `registration.overlap`. Both give the same pairs, in another order.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gmmtorch.kernels.compiler import FusedKernel

MOST_TESTED = 1 << 24
"""Pairs above which a k-d tree is faster."""

_BODY = """
    const double *x = moved + item * DIM, *shape = shapes + item * DIM * DIM;
    const double reach = reaches[item % n_source];
    bool* row = near + item * n_target;
    for (int64_t j = 0; j < n_target; ++j) {
        const double* other = targets + j * (DIM + 1);  // mean, reach
        double d[DIM], square = 0.0;
        for (int i = 0; i < DIM; ++i) {
            d[i] = x[i] - other[i];
            square += d[i] * d[i];
        }
        const double sum = reach + other[DIM];
        row[j] = false;
        if (square > sum * sum) continue;
        double along = wide * square;  // d'Md: d'M⁻¹d is at least (d'd)² / d'Md
        for (int r = 0; r < DIM; ++r)
            for (int c = 0; c < DIM; ++c)
                along += scale * d[r] * d[c] * (shape[r * DIM + c] + covariances[(j * DIM + r) * DIM + c]);
        if (square * square > along) continue;
        double root_of[DIM][DIM], y[DIM], quadratic = 0.0;  // of scale (A + S) + wide I
        for (int c = 0; c < DIM; ++c) {
            for (int r = c; r < DIM; ++r) {
                double rest = scale * (shape[r * DIM + c] + covariances[(j * DIM + r) * DIM + c]);
                if (r == c) rest += wide;
                for (int k = 0; k < c; ++k) rest -= root_of[r][k] * root_of[c][k];
                root_of[r][c] = r == c ? sqrt(rest) : rest / root_of[c][c];
            }
            y[c] = d[c];
            for (int k = 0; k < c; ++k) y[c] -= root_of[c][k] * y[k];
            y[c] /= root_of[c][c];
            quadratic += y[c] * y[c];
        }
        row[j] = quadratic <= 1.0;
    }
"""
_KERNELS = {
    dim: FusedKernel(
        f"near_pairs_{dim}d",
        "const double* moved, const double* shapes, const double* reaches, int64 n_source,"
        " const double* targets, const double* covariances, int64 n_target, double scale, double wide,"
        " bool* near",
        _BODY.replace("DIM", str(dim)),
    )
    for dim in (2, 3)
}


def near_pairs(
    moved: Tensor,
    shapes: Tensor,
    reaches: tuple[Tensor, Tensor],
    means: Tensor,
    covariances: Tensor,
    scale: float,
    wide: float,
) -> Tensor:
    """Motion, source and target (3, P) of the pairs that are near.

    With the difference d of their means, |d| is at most the sum of their reaches, and dᵀM⁻¹d at most 1 for
    M = `scale` (A + Σ) + `wide` I.

    Args:
        moved: (B, K, D) means of the source under each motion. shapes: A (B, K, D, D).
        reaches: of the source (K,) and of the target (J,), metres. means, covariances: of the target.
    """
    n, k, dim = moved.shape
    device = moved.device
    targets = torch.cat([means, reaches[1][:, None]], 1)
    given = [part.contiguous() for part in (moved, shapes, reaches[0])]
    table = targets.contiguous(), covariances.contiguous(), len(means), scale, wide
    near = torch.empty(n, k, len(means), dtype=torch.bool, device=device)
    _KERNELS[dim](n * k, *given, k, *table, near, device=device)
    return near.nonzero().T.contiguous()

"""Which points components explain, and the share of each component in them: the sums of `count_explained`.

The fused kernel tests each point against all components, a few dozen at a time, and keeps no list of pairs.
Its twin is in `mapping.learning.novelty`.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gmmtorch.kernels.compiler import FusedKernel

_BODY = """
    constexpr int AT_ONCE = 64, MOST = 64;
    double squares[AT_ONCE], shares[MOST], total = 0.0;
    int64_t of[MOST], n_found = 0;
    double point[DIM];
    for (int a = 0; a < DIM; ++a) point[a] = points[item * DIM + a];
    const bool asks = frees != nullptr && frees[item];
    for (int pass = 0; pass < 2; ++pass) {
        if (pass == 1 && n_found <= MOST) break;
        for (int64_t begin = 0; begin < n; begin += AT_ONCE) {
            const int64_t m = GMM_MIN(n - begin, (int64_t)AT_ONCE);
            const double* means = table + begin;
            const double* rows = table + DIM * n + begin;
            for (int64_t i = 0; i < m; ++i) {
                double square = 0.0;
                for (int r = 0; r < DIM; ++r) {
                    double white = 0.0;
                    for (int c = 0; c <= r; ++c)
                        white += rows[(r * DIM + c) * n + i] * (point[c] - means[c * n + i]);
                    square += white * white;
                }
                squares[i] = square;
            }
            for (int64_t i = 0; i < m; ++i) {
                if (!(squares[i] < limit) || (asks && !near[begin + i])) continue;
                const double share = 1.0 / GMM_MAX(squares[i], least);
                if (pass == 1) GMM_ADD(gained + begin + i, share / total);
                else {
                    if (n_found < MOST) {
                        of[n_found] = begin + i;
                        shares[n_found] = share;
                    }
                    ++n_found;
                    total += share;
                }
            }
        }
    }
    found[item] = n_found > 0;
    if (n_found <= MOST)
        for (int64_t i = 0; i < n_found; ++i) GMM_ADD(gained + of[i], shares[i] / total);
"""


_KERNELS = {
    dim: FusedKernel(
        f"explained_points_{dim}d",
        "const double* points, const bool* frees, const double* table, int64 n, const bool* near,"
        " double limit, double least, double* gained, bool* found",
        _BODY.replace("DIM", str(dim)),
        shares=True,
    )
    for dim in (2, 3)
}


def explained_points(
    points: Tensor,
    means: Tensor,
    whitening: Tensor,
    limit: float,
    least: float,
    near: Tensor,
    frees: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """Sums (K,) of the shares of K components in the points (N, D) that they explain, and whether any
    component explains each point, (N,) bool.

    A component explains a point if its squared Mahalanobis distance d is below `limit`. The components that
    explain a point share it in proportion to 1/max(d, least).

    Args:
        means: (K, D), whitening: (K, D, D), lower triangular, float64; see `occupancy.cones.whitening`.
        near: (K,) bool, frees: (N,) bool: components that are not near explain no point that frees space.
            frees=None: no point does.

    The fused kernel differs from its twin by rounding.
    """
    k, dim = means.shape
    table = torch.cat([means.T, whitening.flatten(1).T]).contiguous()
    gained = torch.zeros(k, dtype=torch.float64, device=points.device)
    found = torch.empty(len(points), dtype=torch.bool, device=points.device)
    frees = None if frees is None else frees.contiguous()
    given = (table, k, near.contiguous(), limit, least, gained, found)
    _KERNELS[dim](len(points), points.double().contiguous(), frees, *given, device=points.device)
    return gained, found

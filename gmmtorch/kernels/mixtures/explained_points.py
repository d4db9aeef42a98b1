"""Which points components explain, and the share of each component in them: the sums of `count_explained`.

The fused kernel tests each point against all components, a few dozen at a time, and keeps no list of pairs.
Its twin is in `mapping.learning.association`.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gmmtorch.kernels.compiler import FusedKernel

_KERNELS = {
    dim: FusedKernel("mixtures/explained_points.h", f"explained_points<{dim}>", shares=True) for dim in (2, 3)
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

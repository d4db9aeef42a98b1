"""Pairs of components within reach of each other, and their overlap under rigid motions.

The twins are in `localization.registration.overlap`. The kernel of pairs tests all of them, which is faster
than a k-d tree for the few hundred components of a scan; it finds those of the twin, in another order. The
kernel of overlaps evaluates eight pairs at a time and keeps the sums of one motion. Sums differ from the
twin's by at most 10⁻¹¹ of their largest entry.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gmmtorch.kernels.compiler import CPU_LANES, FusedKernel

MOST_TESTED = 1 << 24
"""Pairs above which a k-d tree is faster."""

_GPU_PARTS = 1024  # of the pairs; each part has its own sums
_NEAR = {dim: FusedKernel("mixtures/pair_overlap.h", f"near_pairs<{dim}>") for dim in (2, 3)}
_OVERLAPS = {dim: FusedKernel("mixtures/pair_overlap.h", f"pair_overlap<{dim}>") for dim in (2, 3)}


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
    _NEAR[dim](n * k, *given, k, *table, near, device=device)
    return near.nonzero().T.contiguous()


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
    _OVERLAPS[dim](n_parts, *given[:3], *counts, *given[3:], device=levers.device)
    total, slope, *triangles = sums.sum(0).split([1, free, n_triangle, n_triangle], 1)
    rows, columns = torch.triu_indices(free, free, device=levers.device)
    full = levers.new_zeros(2, n, free, free)
    full[:, :, rows, columns] = full[:, :, columns, rows] = torch.stack(triangles)
    return total[:, 0], slope, full[0], full[1]

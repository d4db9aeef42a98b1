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

_KERNELS = {
    dim: FusedKernel("mixtures/piece_cuts.h", f"piece_cuts<{dim}>", shares=True) for dim in DIMENSIONS
}


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

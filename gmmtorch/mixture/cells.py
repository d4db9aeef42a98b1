"""Cell moments: many points summed into few cells before EM sees them.

A cell's mean feature gives its expected log-density exactly, so EM on cells has an exact M-step and
a bound that rises (see `em`); it costs what the cells cost, not what the points cost.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.mixture.em import quadratic_features

_FINEST = 1 << 20  # cells along the longest side


class Cells(NamedTuple):
    """features (C, F): mean feature of each cell; weight (C,): its points; member (N,): each point's cell."""

    features: Tensor
    weight: Tensor
    member: Tensor


def pool_into_cells(points: Tensor, max_cells: int) -> Cells:
    """Sum centred points (N, D), float64, into at most `max_cells` cubes of one size.

    No point is pooled when there are no more than `max_cells` of them. The side is the smallest
    of a doubling sequence, then refined once by √2, that keeps within the limit.
    """
    n = points.shape[0]
    features = quadratic_features(points)
    if n <= max_cells:
        ones = points.new_ones(n)
        return Cells(features, ones, torch.arange(n, device=points.device))
    low = points.amin(0)
    extent = float((points.amax(0) - low).max())
    if extent == 0:
        member = torch.zeros(n, dtype=torch.int64, device=points.device)
    else:
        member = _finest_cells(points - low, extent, max_cells)
    n_cells = int(member.max()) + 1
    sums = features.new_zeros(n_cells, features.shape[1]).index_add_(0, member, features)
    return Cells(sums / sums[:, :1], sums[:, 0].clone(), member)


def _finest_cells(offset: Tensor, extent: float, max_cells: int) -> Tensor:
    """Cell (N,) of each point, numbered 0 … C−1, on the finest grid with C ≤ max_cells."""
    level, count = 1, 0
    key = torch.zeros(offset.shape[0], dtype=torch.int64, device=offset.device)
    while level < _FINEST:
        trial = _keys(offset, extent / (2 * level))
        count = int(torch.unique(trial).numel())
        if count > max_cells:
            break
        level, key = 2 * level, trial
    trial = _keys(offset, extent / (2**0.5 * level))
    unique, member = torch.unique(trial, return_inverse=True)
    if unique.numel() <= max_cells:
        return member
    return torch.unique(key, return_inverse=True)[1]


def _keys(offset: Tensor, side: float) -> Tensor:
    cell = (offset / side).long()
    key = cell[:, 0]
    for axis in range(1, offset.shape[1]):
        key = key * (2 * _FINEST) + cell[:, axis]
    return key

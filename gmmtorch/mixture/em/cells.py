"""Cell moments: many points summed into few cells before EM sees them.

A cell's mean feature gives its expected log-density exactly, so EM on cells has an exact M-step and
a bound that rises (see `em`); it costs what the cells cost, not what the points cost.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.linalg import count_distinct, dense_ranks
from gmmtorch.mixture.em.exact import quadratic_features

_KEY_BITS = 20  # of a cell's coordinate within its key
_MOST_CELLS = (1 << _KEY_BITS) - 2  # along the longest side
_CHUNK_POINTS = 1 << 17


class Cells(NamedTuple):
    """features (C, F): mean feature of each cell; weight (C,): its points; member (N,): each point's cell."""

    features: Tensor
    weight: Tensor
    member: Tensor


def pool_into_cells(points: Tensor, max_cells: int, finest: float, weight: Tensor | None = None) -> Cells:
    """Sum centred points (N, D), float64, D ≤ 3, into at most `max_cells` cubes of one size.

    The cubes have side `finest` (m; the sensor's noise is a good choice), or one of a sequence,
    each a third of an octave coarser than the last, that just keeps within the limit. Nothing is
    pooled when there are no more than `max_cells` points. `weight` (N,): how many points each row
    stands for, above zero; one if not given.
    """
    n = points.shape[0]
    weight = points.new_ones(n) if weight is None else weight
    if n <= max_cells:
        return Cells(quadratic_features(points), weight, torch.arange(n, device=points.device))
    member, n_cells = dense_ranks(_cell_keys(points, max_cells, finest))
    n_features = 1 + points.shape[1] + points.shape[1] * (points.shape[1] + 1) // 2
    sums = points.new_zeros(n_cells, n_features)
    for part, cell, p in zip(*(t.split(_CHUNK_POINTS) for t in (points, member, weight)), strict=True):
        sums.index_add_(0, cell, quadratic_features(part) * p[:, None])
    return Cells(sums / sums[:, :1], sums[:, 0].clone(), member)


def _cell_keys(points: Tensor, max_cells: int, finest: float) -> Tensor:
    """A number (N,) for each point, the same for all points of a cell."""
    low = points.amin(0)
    extent = float((points.amax(0) - low).max())
    side = max(finest, extent / _MOST_CELLS) or 1.0  # one cell for equal points
    fine = (points - low) / side

    def keys(thirds: int) -> Tensor:
        return _pack((fine * 2 ** (-thirds / 3)).to(torch.int64))

    if count_distinct(keys(0)) <= max_cells:
        return keys(0)
    too_fine, enough = 0, 3 * math.ceil(math.log2(extent / side + 2))  # one cell at last
    while enough - too_fine > 1:
        middle = (too_fine + enough) // 2
        if count_distinct(keys(middle)) <= max_cells:
            enough = middle
        else:
            too_fine = middle
    return keys(enough)


def _pack(cells: Tensor) -> Tensor:
    key = cells[:, 0]
    for axis in range(1, cells.shape[1]):
        key = key << _KEY_BITS | cells[:, axis]
    return key

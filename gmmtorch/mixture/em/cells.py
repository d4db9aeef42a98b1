"""Cells: points summed into few cells before EM.

A cell's mean feature gives its expected log-density exactly, so EM on cells has an exact M-step and
an increasing bound (see `exact`). Its cost depends on the number of cells, not of points.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.linalg import count_distinct, dense_ranks
from gmmtorch.mixture.em.exact import quadratic_features

_KEY_BITS = 20  # bits of one cell coordinate in a key
_MAX_CELLS_ALONG = (1 << _KEY_BITS) - 2  # along the longest side
_CHUNK_POINTS = 1 << 17


class Cells(NamedTuple):
    """features (C, F): mean feature of each cell; weight (C,): its points; member (N,): cell of each
    point.
    """

    features: Tensor
    weight: Tensor
    member: Tensor


def pool_into_cells(points: Tensor, max_cells: int, finest: float, weight: Tensor | None = None) -> Cells:
    """Sum centred points (N, D), float64, D ≤ 3, into at most `max_cells` cubic cells of one size.

    The cells have side `finest` (m; the sensor's noise is a good choice). If that gives too many cells,
    the side grows in steps of a third of an octave until the limit holds. At most `max_cells` points are
    not pooled. `weight` (N,): number of points that each row stands for, above zero; default one.
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
    """A key (N,) for each point; points of one cell have the same key."""
    low = points.amin(0)
    extent = float((points.amax(0) - low).max())
    side = max(finest, extent / _MAX_CELLS_ALONG) or 1.0  # equal points share one cell
    fine = (points - low) / side

    def keys(thirds: int) -> Tensor:
        return _pack((fine * 2 ** (-thirds / 3)).to(torch.int64))

    if count_distinct(keys(0)) <= max_cells:
        return keys(0)
    too_fine, enough = 0, 3 * math.ceil(math.log2(extent / side + 2))  # the upper limit gives one cell
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

"""Cells: points summed into few cells before EM.

A cell's mean feature gives its expected log-density exactly, so EM on cells has an exact M-step and
an increasing bound (see `exact`). Its cost depends on the number of cells, not of points.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor

from gmmtorch.kernels import KEY_BITS, cell_moments, is_fused
from gmmtorch.linalg import dense_ranks
from gmmtorch.mixture.em.exact import quadratic_features

_MAX_CELLS_ALONG = (1 << KEY_BITS) - 2  # along the longest side
_CHUNK_POINTS = 1 << 17
T = TypeVar("T")


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
    low = points.amin(0)
    extent = (points.amax(0) - low).max()
    side = (extent / _MAX_CELLS_ALONG).clamp_min(finest)
    side = torch.where(side > 0, side, 1.0)  # equal points share one cell

    def pooled(thirds: int) -> tuple[Tensor, Tensor] | None:
        """Sums and members of cells of side · 2^(thirds/3); None if there are too many cells."""
        factor = 2 ** (-thirds / 3)
        if points.device.type == "cpu" and is_fused(points, weight):
            return cell_moments(points, weight, low, float(side), factor, max_cells)
        return _sums_by_key(points, weight, _pack(((points - low) / side * factor).long()), max_cells)

    found = pooled(0)
    if found is None:
        one_cell = 3 * math.ceil(math.log2(float(extent / side) + 2))
        found = coarsest_allowed(pooled, one_cell)[1]
    sums, member = found
    return Cells(sums / sums[:, :1], sums[:, 0].clone(), member)


def coarsest_allowed(pooled: Callable[[int], T | None], enough: int) -> tuple[int, T]:
    """The least step from 1 to `enough` that has a result, and the result, by bisection. Step 0 has none."""
    too_fine, best = 0, None
    while enough - too_fine > 1:
        middle = (too_fine + enough) // 2
        found = pooled(middle)
        if found is None:
            too_fine = middle
        else:
            enough, best = middle, found
    best = best or pooled(enough)
    assert best is not None
    return enough, best


def _sums_by_key(
    points: Tensor, weight: Tensor, keys: Tensor, max_cells: int
) -> tuple[Tensor, Tensor] | None:
    """The twin of `kernels.mixtures.cell_moments`: sums (C, F) over equal keys, and each point's cell."""
    member, n_cells = dense_ranks(keys)
    if n_cells > max_cells:
        return None
    sums = points.new_zeros(n_cells, quadratic_features(points[:1]).shape[1])
    for part, cell, p in zip(*(t.split(_CHUNK_POINTS) for t in (points, member, weight)), strict=True):
        sums.index_add_(0, cell, quadratic_features(part) * p[:, None])
    return sums, member


def _pack(cells: Tensor) -> Tensor:
    key = cells[:, 0]
    for axis in range(1, cells.shape[1]):
        key = key << KEY_BITS | cells[:, axis]
    return key

"""Cell moments: many points summed into few cells before EM sees them.

A cell's mean feature gives its expected log-density exactly, so EM on cells has an exact M-step and
a bound that rises (see `em`); it costs what the cells cost, not what the points cost.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.mixture.em import quadratic_features

_KEY_BITS = 20  # of a cell's coordinate within its key
_MOST_CELLS = (1 << _KEY_BITS) - 2  # along the longest side
_CHUNK_POINTS = 1 << 17


class Cells(NamedTuple):
    """features (C, F): mean feature of each cell; weight (C,): its points; member (N,): each point's cell."""

    features: Tensor
    weight: Tensor
    member: Tensor


def pool_into_cells(points: Tensor, max_cells: int, finest: float) -> Cells:
    """Sum centred points (N, D), float64, into at most `max_cells` cubes of one size.

    The cubes have side `finest` (m; the sensor's noise is a good choice), or the smallest of a
    sequence, each a third of an octave coarser than the last, that keeps within the limit. Nothing
    is pooled when there are no more than `max_cells` points.
    """
    n = points.shape[0]
    if n <= max_cells:
        ones = points.new_ones(n)
        return Cells(quadratic_features(points), ones, torch.arange(n, device=points.device))
    member, n_cells = _cell_members(points, max_cells, finest)
    n_features = 1 + points.shape[1] + points.shape[1] * (points.shape[1] + 1) // 2
    sums = points.new_zeros(n_cells, n_features)
    for part, cell in zip(points.split(_CHUNK_POINTS), member.split(_CHUNK_POINTS), strict=True):
        sums.index_add_(0, cell, quadratic_features(part))
    return Cells(sums / sums[:, :1], sums[:, 0].clone(), member)


def _cell_members(points: Tensor, max_cells: int, finest: float) -> tuple[Tensor, int]:
    """Cell (N,) of each point, numbered from 0, and how many cells there are."""
    low = points.amin(0)
    extent = float((points.amax(0) - low).max())
    side = max(finest, extent / _MOST_CELLS)
    fine = ((points - low) / side).long()
    # Sort the points once, at the finest level; coarser levels only merge its cells.
    keys, member = torch.unique(_pack(fine), return_inverse=True)
    fine = _unpack(keys, points.shape[1])
    merged, count, octaves = torch.arange(keys.numel(), device=points.device), keys.numel(), 0.0
    while count > max_cells:
        octaves += 1 / 3
        unique, merged = torch.unique(_pack((fine * 2.0**-octaves).long()), return_inverse=True)
        count = unique.numel()
    return merged[member], count


def _pack(cells: Tensor) -> Tensor:
    key = cells[:, 0]
    for axis in range(1, cells.shape[1]):
        key = key << _KEY_BITS | cells[:, axis]
    return key


def _unpack(keys: Tensor, dim: int) -> Tensor:
    mask = (1 << _KEY_BITS) - 1
    return torch.stack([(keys >> (_KEY_BITS * (dim - 1 - axis))) & mask for axis in range(dim)], 1)

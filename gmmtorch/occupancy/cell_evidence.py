"""CellEvidence: hits and misses of a few cells of an unbounded lattice, as one frame or message yields them."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.occupancy.grid import check_resolution
from gmmtorch.occupancy.raycast import row_major_strides, traverse


class CellEvidence(NamedTuple):
    """cells (C, 3) int64, distinct: cell c is the cube [c, c + 1) times the resolution, world frame;
    hits (C,) and misses (C,), float32: rays that end in each, and that pass through it."""

    cells: Tensor
    hits: Tensor
    misses: Tensor

    @classmethod
    def empty(cls, device: torch.device | str | None = None) -> CellEvidence:
        zero = torch.zeros(0, device=device)
        return cls(torch.zeros(0, 3, dtype=torch.int64, device=device), zero, zero)


class Box(NamedTuple):
    """Lattice cells from `low` (3,) up to but without `high` (3,), int64."""

    low: Tensor
    high: Tensor

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple((self.high - self.low).tolist())


def cast_evidence(
    origins: Tensor,
    ends: Tensor,
    is_hit: Tensor,
    resolution: float,
    box: Box,
    weights: Tensor | None = None,
) -> CellEvidence:
    """Evidence of rays in the cells of a box: what lies outside is trimmed off (thesis Fig 4.2).

    A ray misses every cell that it passes through and leaves, and hits the one that it ends in; a ray
    that is no hit speaks of the cells before its end alone. What a cell gets does not depend on the box.

    Args:
        origins: (R, 3) or (3,), metres. ends: (R, 3). is_hit: (R,) bool. weights: (R,); ones if not given.
        resolution: side (m) of the cells.
    """
    check_resolution(resolution)
    starts, stops = origins.double() / resolution, ends.double() / resolution
    starts = starts.expand_as(stops)
    window = _common(starts, stops, box)
    if window is None:
        return CellEvidence.empty(ends.device)
    low, shape = window.low, window.shape
    n_cells, strides = math.prod(shape), row_major_strides(shape)
    weight = torch.ones_like(stops[:, 0]) if weights is None else weights.double()
    misses = torch.zeros(n_cells, dtype=torch.float64, device=ends.device)
    for visit in traverse(starts, stops, shape, low=low):
        misses.index_add_(0, visit.voxel, weight.index_select(0, visit.ray))
    last = stops.floor().long() - low
    size = torch.tensor(shape, device=ends.device)
    struck = is_hit & ((last >= 0) & (last < size)).all(1)
    flat = (last[struck] * torch.tensor(strides, device=ends.device)).sum(1)
    hits = torch.zeros_like(misses).index_add_(0, flat, weight[struck])
    return from_dense(low, hits.view(shape), misses.view(shape))


def from_dense(low: Tensor, hits: Tensor, misses: Tensor) -> CellEvidence:
    """The cells of a dense block (nx, ny, nz) with lowest cell `low` (3,) that have any evidence."""
    cells = ((hits > 0) | (misses > 0)).nonzero()
    index = cells.unbind(1)
    return CellEvidence(cells + low, hits[index].float(), misses[index].float())


def united(parts: Iterable[CellEvidence]) -> CellEvidence:
    """The sum of several, each cell once."""
    parts = [part for part in parts if len(part.cells)]
    if not parts:
        return CellEvidence.empty()
    if len(parts) == 1:
        return parts[0]
    cells = torch.cat([part.cells for part in parts])
    low = cells.amin(0)
    shape = tuple((cells.amax(0) - low + 1).tolist())
    if math.prod(shape) >= 2**62:
        raise InvalidArgumentError(f"Evidence that spans {shape} cells cannot be united; take coarser cells.")
    strides = torch.tensor(row_major_strides(shape), device=cells.device)
    key, row = torch.unique(((cells - low) * strides).sum(1), return_inverse=True)
    sums = [
        torch.zeros(len(key), device=cells.device).index_add_(0, row, torch.cat([part[i] for part in parts]))
        for i in (1, 2)
    ]
    size = torch.tensor(shape, device=cells.device)
    return CellEvidence(key[:, None] // strides % size + low, *sums)


def _common(starts: Tensor, stops: Tensor, box: Box) -> Box | None:
    """The part of a box that rays, in grid units, can reach; None if they cannot."""
    if len(stops) == 0:
        return None
    both = torch.stack([starts.amin(0), starts.amax(0), stops.amin(0), stops.amax(0)]).floor().long()
    low = torch.maximum(both.amin(0), box.low.to(both))
    high = torch.minimum(both.amax(0) + 1, box.high.to(both))
    return Box(low, high) if bool((low < high).all()) else None

"""KeptEvidence: the evidence of the cells of a grid, kept from one state of a map to the next."""

from __future__ import annotations

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.occupancy.cone_index import ConeIndex
from gmmtorch.occupancy.cones import CUTOFF, Cones
from gmmtorch.occupancy.forms.point import PointEvidence, PointForm
from gmmtorch.occupancy.grid import VoxelGrid, check_resolution

_ENTRIES_PER_CONE = {2: 16, 3: 64}  # fewer than for one map: its lists are made again and again
_DENSE = 4  # times as many entries, after which the index is made anew
_MIXER = 0x1E3779B97F4A7C15


class KeptEvidence:
    """Evidence of the cells of a grid in the point form, for a map whose cones change.

    `update` evaluates the cells near cones that are new or gone since the last call, and the cells that the
    last grid did not have. With fused kernels its numbers are, to the bit, those of a `PointForm` of all
    cones at `centers`; the twins of the kernels differ by rounding.

    Args:
        resolution: side (m) of the cells, which lie at its multiples.
    """

    def __init__(self, resolution: float) -> None:
        self.resolution = check_resolution(resolution)
        self._rows: Tensor | None = None
        self._cutoff = 0.0
        self._index: ConeIndex
        self._first: Tensor
        self._hits: Tensor
        self._misses: Tensor
        self.n_evaluated = 0
        """Cells that the last call evaluated."""

    def update(self, cones: Cones, grid: VoxelGrid, cutoff: float = CUTOFF) -> PointEvidence:
        """Hits and misses, in the shape of the grid.

        Args:
            cones: all cones of the map now; must not change afterwards.
            grid: cells at multiples of the resolution.
            cutoff: Mahalanobis distance beyond which a component gives no evidence.
        """
        form = PointForm(cones, self.resolution, cutoff, indexed=False)
        form.index, changed = self._next_index(form, cones, cutoff)
        first = self._first_cell(grid, form.rows.device)
        points = self.centers(grid, form.rows.device)
        bucket = form.index.buckets(points)
        hits, misses = torch.zeros(2, *grid.shape, dtype=torch.float64, device=points.device)
        is_known = torch.zeros(grid.shape, dtype=torch.bool, device=points.device)
        if self._rows is not None:
            new, old = _overlap(first, grid.shape, self._first, self._hits.shape)
            hits[new], misses[new], is_known[new] = self._hits[old], self._misses[old], True
        is_empty = bucket < 0
        is_changed = torch.cat([changed, changed.new_zeros(1)])[bucket]  # of no bucket, −1: the last one
        asked = (~is_empty & (is_changed | ~is_known.flatten())).nonzero().squeeze(1)
        found = form(points[asked])
        for values, new_values in zip((hits, misses), found, strict=True):
            values.view(-1)[asked] = new_values
            values.view(-1)[is_empty] = 0
        self.n_evaluated = len(asked)
        self._rows, self._cutoff, self._index = form.rows, cutoff, form.index
        self._first, self._hits, self._misses = first, hits, misses
        return PointEvidence(hits, misses)

    def centers(self, grid: VoxelGrid, device: torch.device | None = None) -> Tensor:
        """Centres (M, D) of the cells of a grid: the same for a cell of any grid, to the bit."""
        flat = torch.arange(grid.n_cells, device=device)
        cell = torch.stack(torch.unravel_index(flat, grid.shape), 1) + self._first_cell(grid, device)
        return (cell.double() + 0.5) * self.resolution

    def _first_cell(self, grid: VoxelGrid, device: torch.device | None) -> Tensor:
        """The lowest cell (D,) of a grid, counted from the origin of the world."""
        units = torch.tensor(grid.origin, dtype=torch.float64, device=device) / self.resolution
        first = units.round()
        if grid.resolution != self.resolution or bool(((units - first).abs() > 1e-6).any()):
            raise InvalidArgumentError(
                f"grid={grid} must have cells at multiples of resolution={self.resolution} m; make it with "
                "VoxelGrid.covering."
            )
        return first.long()

    def _next_index(self, form: PointForm, cones: Cones, cutoff: float) -> tuple[ConeIndex, Tensor]:
        """The index of the cones, and which of its buckets (n_buckets,) have changed."""
        entries = _ENTRIES_PER_CONE[form.dim]
        if self._rows is not None and self._cutoff == cutoff and self._rows.shape[1] == form.rows.shape[1]:
            former = _former(self._rows, form.rows)
            index, changed = self._index.replaced(cones, former)
            if len(index.entries) <= _DENSE * entries * len(cones.counts):
                return index, changed
        self._rows = None
        index = ConeIndex(cones, self.resolution, cutoff, smoothed=True, entries_per_cone=entries)
        return index, torch.ones_like(index.keys, dtype=torch.bool)


def _former(old: Tensor, new: Tensor) -> Tensor:
    """For each row of `new` the number (C,) of an equal row of `old`, in rising order; −1: there is none."""
    mixer = torch.arange(1, new.shape[1] + 1, device=new.device) * _MIXER
    keys = []
    for rows in (old, new):
        bits = rows.view(torch.int64)
        keys.append((((bits >> 29) ^ bits) * mixer).sum(1))
    order = keys[0].argsort(stable=True)
    if not len(order):
        return torch.full_like(keys[1], -1)
    place = order[torch.searchsorted(keys[0][order], keys[1]).clamp_max(len(order) - 1)]
    is_same = (old.view(torch.int64)[place] == new.view(torch.int64)).all(1)
    place = torch.where(is_same, place, -1)
    before = torch.cat([place.new_full((1,), -1), place.cummax(0).values[:-1]])
    return torch.where(place > before, place, -1)


def _overlap(
    first: Tensor, shape: tuple[int, ...], other_first: Tensor, other_shape: tuple[int, ...]
) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    """The cells that two grids share, as slices of each, from the lowest cells and shapes of both."""
    shift = (other_first - first).tolist()
    mine, others = [], []
    for offset, size, other_size in zip(shift, shape, other_shape, strict=True):
        low, high = max(offset, 0), max(min(offset + other_size, size), max(offset, 0))
        mine.append(slice(low, high))
        others.append(slice(low - offset, high - offset))
    return tuple(mine), tuple(others)

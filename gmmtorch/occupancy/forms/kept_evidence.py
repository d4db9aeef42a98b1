"""KeptEvidence: the evidence of the cells of a grid, kept from one state of a map to the next."""

from __future__ import annotations

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.occupancy.cone_index import ConeIndex
from gmmtorch.occupancy.cones import CUTOFF, Cones, former_rows
from gmmtorch.occupancy.forms.point import PointEvidence, PointForm
from gmmtorch.occupancy.grid import VoxelGrid, check_resolution


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
        self._form: PointForm | None = None
        self._cones: Cones
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
        cones = cones.checked()
        form, changed = self._next_form(cones, cutoff)
        first = self._first_cell(grid, cones.means.device)
        points = self.centers(grid, cones.means.device)
        hits, misses = torch.zeros(2, *grid.shape, dtype=torch.float64, device=points.device)
        is_asked = torch.ones(grid.shape, dtype=torch.bool, device=points.device)
        if self._form is not None:
            new, old = _overlap(first, grid.shape, self._first, self._hits.shape)
            hits[new], misses[new], is_asked[new] = self._hits[old], self._misses[old], False
            index = ConeIndex(changed, self.resolution, cutoff, smoothed=True, smallest=True)
            is_asked |= (index.buckets(points) >= 0).view(grid.shape)
        asked = is_asked.flatten().nonzero().squeeze(1)
        found = form(points[asked])
        for values, new_values in zip((hits, misses), found, strict=True):
            values.view(-1)[asked] = new_values
        self.n_evaluated = len(asked)
        self._form, self._cones = form, cones
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

    def _next_form(self, cones: Cones, cutoff: float) -> tuple[PointForm, Cones]:
        """The form of the cones, and those that are new or gone."""
        if self._form is None or self._form.cutoff != cutoff or self._cones.dim != cones.dim:
            self._form = None
            return PointForm(cones, self.resolution, cutoff), cones
        former = former_rows(self._cones, cones)
        gone = torch.ones_like(self._cones.max_range)
        gone[former[former >= 0]] = False
        parts = zip(self._cones.taken(gone), cones.taken(former < 0), strict=True)
        return self._form.replaced(cones, former), Cones(*map(torch.cat, parts))


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

"""LocalMap: the cells around a robot as its planner reads them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from gmmtorch.occupancy.voxels.boxes import Box


@dataclass(frozen=True, eq=False)
class LocalMap:
    """A dense snapshot (nx, ny, nz) of the cells of the sliding map.

    low: (3,) int64, index of the lowest cell; cell c is [c, c + 1) · resolution, world frame.
    resolution: side (m) of the cells.
    occupancy: (nx, ny, nz) float32, with the planner's prior where nothing was observed.
    observed: bool, cells with any evidence.
    free: bool, known to be free.
    passable: bool, where the centre of the robot may be: all cells that its body touches are free.
    """

    low: Tensor
    resolution: float
    occupancy: Tensor
    observed: Tensor
    free: Tensor
    passable: Tensor

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(self.free.shape)

    @property
    def box(self) -> Box:
        return Box(self.low, self.low + torch.tensor(self.shape))

    @cached_property
    def _size(self) -> Tensor:
        return torch.tensor(self.shape)

    def cells_of(self, points: Tensor) -> Tensor:
        """Indices (..., 3) int64, relative to `low`, of the cells that contain points (..., 3), metres."""
        return (points / self.resolution).floor().long() - self.low

    def flat_index(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Flat row-major indices (...,) of points (..., 3), 0 where outside; and whether each is inside."""
        cell = self.cells_of(points)
        inside = ((cell >= 0) & (cell < self._size)).all(-1)
        _, ny, nz = self.shape
        flat = (cell[..., 0] * ny + cell[..., 1]) * nz + cell[..., 2]
        return torch.where(inside, flat, 0), inside

    def is_passable(self, points: Tensor) -> Tensor:
        """Whether the centre of the robot may be at points (..., 3), metres; False outside the map."""
        flat, inside = self.flat_index(points)
        return self.passable.view(-1)[flat] & inside

    def centers(self, cells: Tensor) -> Tensor:
        """Centres (..., 3), metres, of cells (..., 3) relative to `low`."""
        return (cells + self.low + 0.5).double() * self.resolution

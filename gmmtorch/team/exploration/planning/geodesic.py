"""Geodesic distance to a goal through space that is known to be free."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from gmmtorch.team.exploration.robot.mapper import LocalMap

COARSE = 2
"""Cells of the map along the side of a cell of the field."""
_AROUND = list(itertools.product((-1, 0, 1), repeat=3))
_CHECK_EVERY = 4  # rounds of the wave between two convergence checks


@dataclass(frozen=True, eq=False)
class DistanceField:
    """Distances to the nearest goal on a coarse lattice.

    metres: (nx, ny, nz) float32; inf if a cell has no way to a goal. origin: (3,) metres, world frame, the
    lattice's lowest corner. spacing: side of its cells (m).
    """

    origin: Tensor
    spacing: float
    metres: Tensor

    @classmethod
    def to(cls, local_map: LocalMap, goals: Tensor, offsets: Tensor | None = None) -> DistanceField:
        """Compute the distance to the nearest of goals (M, 3), metres; `offsets` (M,) are added to each goal.

        Goals outside the local map are ignored. Without a goal inside, all distances are inf.
        """
        _, inside = local_map.flat_index(goals)
        cells = local_map.cells_of(goals[inside])
        begin = torch.zeros(len(cells)) if offsets is None else offsets[inside]
        metres = geodesic(local_map.passable, cells, local_map.resolution, begin)
        origin = local_map.low.double() * local_map.resolution
        return cls(origin, COARSE * local_map.resolution, metres)

    def way(self, points: Tensor, n_cells: int) -> tuple[Tensor, Tensor]:
        """Return metres (...,) float64 from points (..., 3), and the points (..., 3) reached after `n_cells`
        cells of the shortest way.

        The metres are the smallest over the cell of a point and its 26 neighbours, so that a point between
        passable cells also has a way. Without a way, the reached point is the point itself.
        """
        metres, cell = self._entry(points)
        for _ in range(n_cells - 1):
            cell = self._onward[cell]
        _, ny, nz = self.metres.shape
        there = torch.stack([cell // (ny * nz), cell // nz % ny, cell % nz], -1)
        there = self.origin + (there + 0.5) * self.spacing
        return metres, torch.where(torch.isfinite(metres)[..., None], there, points)

    def _entry(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return metres (...,) from points, and the flat index (...,) of the first cell on each way."""
        size = torch.tensor(self.metres.shape, device=points.device)
        steps = torch.tensor(_AROUND, device=points.device)
        cell = ((points - self.origin) / self.spacing).floor().long().unsqueeze(-2) + steps
        inside = ((cell >= 0) & (cell < size)).all(-1)
        _, ny, nz = self.metres.shape
        flat = torch.where(inside, (cell[..., 0] * ny + cell[..., 1]) * nz + cell[..., 2], 0)
        step = self.origin + (cell + 0.5) * self.spacing - points.unsqueeze(-2)
        length = self.metres.view(-1)[flat].double().masked_fill_(~inside, math.inf) + step.norm(dim=-1)
        metres, first = length.min(-1)
        return metres, flat.gather(-1, first.unsqueeze(-1)).squeeze(-1)

    @cached_property
    def _onward(self) -> Tensor:
        """Flat index (n,) of the cell that follows each on its shortest way; a goal follows itself."""
        shape = tuple(n + 2 for n in self.metres.shape)
        inside = (slice(1, -1),) * 3
        padded = torch.full(shape, math.inf, device=self.metres.device)
        padded[inside] = self.metres / self.spacing
        best, onward = self.metres / self.spacing - 1e-4, torch.zeros_like(self.metres, dtype=torch.int64)
        _, ny, nz = self.metres.shape
        for dx, dy, dz in _AROUND:
            there = padded[1 + dx : shape[0] - 1 + dx, 1 + dy : shape[1] - 1 + dy, 1 + dz : shape[2] - 1 + dz]
            # A step a little too short: rounding cannot hide that it leads on.
            there = there + 0.999 * math.sqrt(dx * dx + dy * dy + dz * dz)
            nearer = there < best
            best = torch.where(nearer, there, best)
            onward.masked_fill_(nearer, (dx * ny + dy) * nz + dz)
        return onward.view(-1) + torch.arange(onward.numel(), device=onward.device)


def geodesic(
    passable: Tensor, sources: Tensor, resolution: float, offsets: Tensor, coarse: int = COARSE
) -> Tensor:
    """Metres (nx', ny', nz') float32 to the nearest source over passable cells `coarse` times as wide.

    Steps lead to the 26 neighbours and are as long as they look. A coarse cell is passable where at
    least half of its cells are: one cell is wide enough for a way, while what separates two of them is
    never thinner than the body of the robot, by which the passable cells were shrunk.
    Sources always count as passable. inf: cannot be reached.

    Args:
        passable: (nx, ny, nz) bool. sources: (M, 3) int64, cells of it.
        resolution: side (m) of its cells.
        offsets: (M,) metres, at least zero, that each source starts with.
        coarse: nx' = ⌈nx/coarse⌉.
    """
    open_cells = coarsened(passable, coarse)
    start = torch.full(open_cells.shape, math.inf, device=passable.device)
    index = (sources // coarse).unbind(1)
    flat = (index[0] * start.shape[1] + index[1]) * start.shape[2] + index[2]
    start.view(-1).scatter_reduce_(0, flat, offsets.to(start), "amin")
    open_cells[index] = True
    return _wave(open_cells, start / (coarse * resolution)) * (coarse * resolution)


def coarsened(passable: Tensor, coarse: int) -> Tensor:
    """Return coarse cells (⌈n/coarse⌉, …), bool, at least half of which is passable."""
    if coarse == 1:
        return passable.clone()
    count = passable.to(torch.int16)
    for axis in range(3):
        short = -count.shape[axis] % coarse
        if short:
            shape = list(count.shape)
            shape[axis] = short
            count = torch.cat([count, count.new_zeros(shape)], axis)
        count = count.unflatten(axis, (-1, coarse))
        count = sum((count.select(axis + 1, i) for i in range(1, coarse)), count.select(axis + 1, 0))
    return 2 * count >= coarse**3


def _wave(open_cells: Tensor, start: Tensor) -> Tensor:
    """Return the smallest number of cell widths to each cell: a wave spreads from `start` until it converges.

    The minimum over the 26 neighbours is computed axis by axis: edges from faces, corners from edges.
    Cells lie in one padded row, so that a shift is a slice.
    """
    inside = (slice(1, -1),) * 3
    shape = tuple(n + 2 for n in open_cells.shape)
    wall = torch.full(shape, math.inf, device=start.device)
    wall[inside] = torch.where(open_cells, 0.0, math.inf)
    width = torch.full_like(wall, math.inf)
    width[inside] = start
    wall, width = wall.view(-1), width.view(-1)
    strides = (shape[1] * shape[2], shape[2], 1)
    x, y, z, xy, xz, yz, xyz = (torch.full_like(width, math.inf) for _ in range(7))
    count = 0
    while True:
        count += 1
        for stride, out in zip(strides, (x, y, z), strict=True):
            _least_of_two(width, stride, out)
        _least_of_two(x, strides[1], xy)
        _least_of_two(x, strides[2], xz)
        _least_of_two(y, strides[2], yz)
        _least_of_two(xy, strides[2], xyz)
        face = torch.minimum(torch.minimum(x, y), z).add_(1)
        edge = torch.minimum(torch.minimum(xy, xz), yz).add_(math.sqrt(2))
        near = torch.minimum(torch.minimum(face, edge, out=face), xyz + math.sqrt(3), out=face)
        after = torch.minimum(near.add_(wall), width, out=near)
        if count % _CHECK_EVERY == 0 and torch.equal(after, width):
            return after.view(shape)[inside].contiguous()
        width = after


def _least_of_two(values: Tensor, stride: int, out: Tensor) -> None:
    torch.minimum(values[: -2 * stride], values[2 * stride :], out=out[stride:-stride])

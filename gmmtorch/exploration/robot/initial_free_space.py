"""The free space around a robot's start, and the way from there to open space."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from gmmtorch.exploration.planning.collision_checking import cells_in_sphere, feasible, passable_cells
from gmmtorch.exploration.planning.planner_interface import LEAST
from gmmtorch.exploration.planning.primitives import Primitives
from gmmtorch.exploration.robot.mapper import LocalMap
from gmmtorch.occupancy.voxels.boxes import Box
from gmmtorch.simulation.worlds.mesh_world import MeshWorld

_NEAR = 2.0
"""Metres from the start to the nearest place where the robot can take off, at most."""
_STEP = 0.05
"""Metres between the positions of the way there."""
_YAWS = 16
"""Headings tried at each place."""
_BATCH = 16
"""Places tried together."""


class Place(Protocol):
    """The part of a world that is needed here."""

    @property
    def mesh(self) -> MeshWorld: ...
    @property
    def resolution(self) -> float: ...
    @property
    def box(self) -> Box: ...
    @property
    def occupied(self) -> Tensor: ...
    @property
    def observable(self) -> Tensor: ...
    @property
    def robot_radius(self) -> float: ...


@dataclass(frozen=True, eq=False)
class InitialFreeSpace:
    """What a robot knows before its first frame.

    known_free: (K, 3) int64, free cells of the lattice.
    trail: (N, 3), metres, from the place where the robot can take off to its start; N = 1 if it can take off
        from its start.
    """

    known_free: Tensor
    trail: Tensor


def initial_free_space(world: Place, place: Tensor, primitives: Primitives) -> InitialFreeSpace | None:
    """The free space that a robot knows at its start (3,), metres; None if it cannot take off from there.

    The start must touch nothing. In open space the robot knows that the sphere up to the nearest surface is
    free. Near a surface that sphere is too small, and the camera sees nothing above, below or behind the
    robot: there it is given the free cells nearby. If its start is too narrow for its primitives, it is also
    given a straight, collision-free way from the nearest place that is not; it flies back along that way
    first.

    A robot cannot take off if none of its primitives is safe there even with a perfect map.
    """
    radius, resolution = world.robot_radius, world.resolution
    # The radius that a robot must know to be free in order to take off.
    needed = math.sqrt(3) * (radius + 2.5 * resolution)
    clear = float(world.mesh.clearance(place[None]).clamp_max(needed))
    sphere = cells_in_sphere(place, clear, resolution)
    truth = _truth(world, place, _NEAR + primitives.reach + needed)
    here = torch.cat([place.new_zeros(0, 3), place[None]])
    fits = bool(truth.is_passable(place))
    if fits and bool(_can_take_off(here, truth, primitives)[0]):
        if _is_passable_by(sphere, truth, radius, place):
            return InitialFreeSpace(sphere, here)
        return InitialFreeSpace(torch.cat([sphere, _free_near(place, needed, truth)]), here)
    if fits:
        return None
    there = _nearest_take_off(world, place, truth, primitives)
    if there is None:
        return None
    n = max(2, math.ceil(float((place - there).norm()) / _STEP) + 1)
    trail = torch.lerp(there, place, torch.linspace(0, 1, n, dtype=torch.float64)[:, None])
    return InitialFreeSpace(torch.cat([sphere, _free_near(there, needed, truth)]), trail)


def _truth(world: Place, place: Tensor, reach: float) -> LocalMap:
    """The perfect map of everything within `reach` metres of a place (3,)."""
    resolution = world.resolution
    low = torch.maximum(((place - reach) / resolution).floor().long(), world.box.low)
    high = torch.minimum(((place + reach) / resolution).floor().long() + 1, world.box.high)
    window = tuple(
        slice(int(a), int(b)) for a, b in zip(low - world.box.low, high - world.box.low, strict=True)
    )
    free = world.observable[window] & ~world.occupied[window]
    known = torch.ones_like(free)
    passable = passable_cells(free, world.robot_radius, resolution)
    return LocalMap(low, resolution, (~free).float(), known, free, passable)


def _is_passable_by(known_free: Tensor, truth: LocalMap, radius: float, place: Tensor) -> bool:
    """Whether a place (3,) is passable if only these cells (K, 3) are known to be free."""
    cells = known_free - truth.low
    inside = ((cells >= 0) & (cells < torch.tensor(truth.shape))).all(1)
    free = torch.zeros_like(truth.free)
    free[cells[inside].unbind(1)] = True
    flat, _ = truth.flat_index(place)
    return bool(passable_cells(free, radius, truth.resolution).view(-1)[flat])


def _free_near(place: Tensor, reach: float, truth: LocalMap) -> Tensor:
    """Free cells (K, 3) of the lattice that lie entirely within `reach` metres of a place (3,)."""
    cells = cells_in_sphere(place, reach, truth.resolution)
    flat, inside = truth.flat_index((cells + 0.5).double() * truth.resolution)
    return cells[truth.free.view(-1)[flat] & inside]


def _can_take_off(places: Tensor, truth: LocalMap, primitives: Primitives) -> Tensor:
    """Whether a robot at rest at each of the places (P, 3) can fly somewhere safely, at any heading."""
    yaw = torch.arange(_YAWS, dtype=torch.float64) * (2 * math.pi / _YAWS)
    states = torch.zeros(len(places), _YAWS, 7, dtype=torch.float64)
    states[..., :3], states[..., 3] = places[:, None], yaw
    states = states.view(-1, 7)
    paths = primitives.rollout(states)
    safe = feasible(paths, primitives.braking(paths[:, :, -1]), truth, start=states[:, None])
    leads = (paths[:, :, -1, :3] - states[:, None, :3]).norm(dim=-1) > LEAST
    return (safe & leads).view(len(places), _YAWS * len(primitives)).any(1)


def _nearest_take_off(world: Place, place: Tensor, truth: LocalMap, primitives: Primitives) -> Tensor | None:
    """The nearest centre (3,) of a cell from which a robot can take off, with a free straight way to a place
    (3,)."""
    centers = truth.centers(truth.passable.nonzero())
    off = (centers - place).norm(dim=1)
    centers = centers[off.argsort(stable=True)][: int((off <= _NEAR).sum())]
    for some in centers.split(_BATCH):
        n = math.ceil(_NEAR / _STEP) + 1
        share = torch.linspace(0, 1, n, dtype=torch.float64)[:, None]
        ways = place + share * (some[:, None] - place)
        room = world.mesh.clearance(ways.view(-1, 3)).view(len(some), n).amin(1)
        good = (room > world.robot_radius) & _can_take_off(some, truth, primitives)
        if bool(good.any()):
            return some[int(good.int().argmax())]
    return None

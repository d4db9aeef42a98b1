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
from gmmtorch.exploration.robot.local_map import LocalMap
from gmmtorch.occupancy.voxels.boxes import Box
from gmmtorch.simulation.worlds.mesh_world import MeshWorld

_NEAR = 2.0
"""Metres that a way to where a robot can fly off may be long."""
_STEP = 0.05
"""Metres between the positions of such a way."""
_YAWS = 16
_AT_ONCE = 16


class Place(Protocol):
    """What is asked of a world."""

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
    """What a robot is told when it is set down.

    known_free: (K, 3) int64, cells of the lattice that are free. trail: (N, 3), metres, from where it can
    fly off to where it stands: the way that it was carried, a single place where it can fly off at once.
    """

    known_free: Tensor
    trail: Tensor


def initial_free_space(world: Place, place: Tensor, primitives: Primitives) -> InitialFreeSpace | None:
    """How a robot gets off from a place (3,), where it touches nothing; None if it cannot.

    Where there is room, it knows the sphere around it to be free that reaches to the nearest surface. That
    says too little where a surface is near, and its camera sees nothing above, below or behind it. There
    whoever set it down has told it which cells are free, and carried it from the nearest place where the
    cells leave it room to fly off, straight and without touching anything: it goes back there first.

    A robot cannot get off if nothing that its primitives do there is safe even for one that knows all.
    """
    radius, resolution = world.robot_radius, world.resolution
    # As much as a robot needs to be sure of to fly off from where it was set down.
    needed = math.sqrt(3) * (radius + 2.5 * resolution)
    clear = float(world.mesh.clearance(place[None]).clamp_max(needed))
    sphere = cells_in_sphere(place, clear, resolution)
    truth = _truth(world, place, _NEAR + primitives.reach + needed)
    here = torch.cat([place.new_zeros(0, 3), place[None]])
    fits = bool(truth.is_passable(place))
    if fits and bool(_lead_off(here, truth, primitives)[0]):
        if _is_passable_by(sphere, truth, radius, place):
            return InitialFreeSpace(sphere, here)
        return InitialFreeSpace(torch.cat([sphere, _free_near(place, needed, truth)]), here)
    if fits:
        return None
    there = _nearest_way_off(world, place, truth, primitives)
    if there is None:
        return None
    n = max(2, math.ceil(float((place - there).norm()) / _STEP) + 1)
    trail = torch.lerp(there, place, torch.linspace(0, 1, n, dtype=torch.float64)[:, None])
    return InitialFreeSpace(torch.cat([sphere, _free_near(there, needed, truth)]), trail)


def _truth(world: Place, place: Tensor, reach: float) -> LocalMap:
    """What a robot would know that had seen everything within `reach` metres of a place (3,)."""
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
    """Whether a robot knows that it fits at a place (3,), by these cells (K, 3) alone."""
    cells = known_free - truth.low
    inside = ((cells >= 0) & (cells < torch.tensor(truth.shape))).all(1)
    free = torch.zeros_like(truth.free)
    free[cells[inside].unbind(1)] = True
    flat, _ = truth.flat_index(place)
    return bool(passable_cells(free, radius, truth.resolution).view(-1)[flat])


def _free_near(place: Tensor, reach: float, truth: LocalMap) -> Tensor:
    """Free cells (K, 3) of the lattice that lie wholly within `reach` metres of a place (3,)."""
    cells = cells_in_sphere(place, reach, truth.resolution)
    flat, inside = truth.flat_index((cells + 0.5).double() * truth.resolution)
    return cells[truth.free.view(-1)[flat] & inside]


def _lead_off(places: Tensor, truth: LocalMap, primitives: Primitives) -> Tensor:
    """Whether something that leads anywhere is safe, from rest at each of places (P, 3), at some yaw."""
    yaw = torch.arange(_YAWS, dtype=torch.float64) * (2 * math.pi / _YAWS)
    states = torch.zeros(len(places), _YAWS, 7, dtype=torch.float64)
    states[..., :3], states[..., 3] = places[:, None], yaw
    states = states.view(-1, 7)
    paths = primitives.rollout(states)
    safe = feasible(paths, primitives.braking(paths[:, :, -1]), truth, start=states[:, None])
    leads = (paths[:, :, -1, :3] - states[:, None, :3]).norm(dim=-1) > LEAST
    return (safe & leads).view(len(places), _YAWS * len(primitives)).any(1)


def _nearest_way_off(world: Place, place: Tensor, truth: LocalMap, primitives: Primitives) -> Tensor | None:
    """The nearest centre (3,) of a cell to fly off from, to which a robot at a place (3,) can be moved."""
    centers = truth.centers(truth.passable.nonzero())
    off = (centers - place).norm(dim=1)
    centers = centers[off.argsort(stable=True)][: int((off <= _NEAR).sum())]
    for some in centers.split(_AT_ONCE):
        n = math.ceil(_NEAR / _STEP) + 1
        share = torch.linspace(0, 1, n, dtype=torch.float64)[:, None]
        ways = place + share * (some[:, None] - place)
        room = world.mesh.clearance(ways.view(-1, 3)).view(len(some), n).amin(1)
        good = (room > world.robot_radius) & _lead_off(some, truth, primitives)
        if bool(good.any()):
            return some[int(good.int().argmax())]
    return None

"""Start poses of a team: chosen together in open space, or given by the user and checked."""

from __future__ import annotations

import math
from typing import Protocol

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, check_whole
from gmmtorch.exploration.planning.primitives import Primitives
from gmmtorch.exploration.robot.initial_free_space import Place, initial_free_space
from gmmtorch.exploration.world.navigable import viewpoints

_ROOMY = 1.0
"""Preferred distance (m) of a start from the nearest surface."""
_DOWN = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
_TRIES = 40
"""Number of places, or sets of places, that are tried before the search fails."""


class _World(Place, Protocol):
    """The part of `World` that start poses need."""

    @property
    def name(self) -> str: ...
    @property
    def navigable(self) -> Tensor: ...
    def centers(self, cells: Tensor) -> Tensor: ...


def start_poses(world: _World, n: int, spacing: float, at: Tensor | None, primitives: Primitives) -> Tensor:
    """Choose start poses (n, 4), x, y, z (m) and yaw (rad), in the navigable space near `at` (3,).

    The poses are at least `spacing` metres apart, and the robots never touch. If there is room, every pose is
    visible from the first, a metre from every surface, and at the same height. Yaw angles are spread evenly;
    the first robot looks towards the middle of the world. If `at` is None, robots start at the end that is
    farthest from the middle. Raises `InvalidArgumentError` if there is no room for n robots that can fly off.
    """
    check_whole("n", n, 1)
    if not (math.isfinite(spacing) and spacing >= 0):
        raise InvalidArgumentError(f"spacing={spacing} must be zero metres or more.")
    apart = max(spacing, 2 * world.robot_radius + world.resolution)
    anchor = _far_end(world) if at is None else at
    places = centers = world.centers(world.navigable.nonzero())
    found = _together(world, places, anchor, n, apart)
    if len(found) < n:
        robots = "1 robot that starts" if len(found) == 1 else f"{len(found)} robots that start"
        volume = len(centers) * world.resolution**3
        raise InvalidArgumentError(
            f"{world.name} has room for {robots} {apart:.4g} m apart, but team.size={n}. "
            f"Only {volume:.3g} m³ are navigable (away from surfaces and above a floor). "
            "Use fewer robots, or set team.start. If you expect more room, check that the mesh has a floor."
        )
    for _ in range(_TRIES):
        stuck = [place for place in found if initial_free_space(world, place, primitives) is None]
        if not stuck:
            ahead = centers.mean(0) - found[0]
            yaw = torch.atan2(ahead[1], ahead[0]) + torch.arange(n) * (2 * math.pi / n)
            return torch.cat([found, torch.remainder(yaw + math.pi, 2 * math.pi)[:, None] - math.pi], 1)
        places = places[(torch.cdist(places, torch.stack(stuck)) > 2 * world.resolution).all(1)]
        found = _together(world, places, anchor, n, apart)
        if len(found) < n:
            break
    raise InvalidArgumentError(
        f"{world.name}: found no start poses from which a team of team.size={n} can fly off, with "
        f"{_robot(world)}. Use a smaller radius, finer cells, slower or fewer robots, or set team.start."
    )


def check_start(world: _World, poses: Tensor, primitives: Primitives) -> Tensor:
    """Check that robots can start at poses (n, 4) and return them as float64.

    Raises `InvalidArgumentError` that names the first bad pose and a better place for it.
    """
    if poses.ndim != 2 or poses.shape[1] != 4 or len(poses) == 0:
        raise InvalidArgumentError(
            f"start poses have shape {tuple(poses.shape)}; expected (n, 4): x, y, z (m), yaw (rad); n ≥ 1."
        )
    poses = poses.detach().cpu().double()
    for i, pose in enumerate(poses):
        others = poses[:i, :3]
        if not bool(torch.isfinite(pose).all()):
            raise InvalidArgumentError(f"team.start[{i}]={_text(pose)} is not finite.")
        fault = _fault(world, others, pose[:3], primitives)
        if fault is not None:
            instead = _instead(world, others, pose, primitives)
            raise InvalidArgumentError(f"team.start[{i}]={_text(pose)} {fault}; {instead}.")
    return poses


def _fault(world: _World, others: Tensor, place: Tensor, primitives: Primitives) -> str | None:
    """Describe why a robot cannot start at a place (3,) beside robots at (N, 3); None if it can."""
    cell = (place / world.resolution).floor() - world.box.low
    if not bool(((cell >= 0) & (cell < torch.tensor(world.box.shape))).all()):
        low, high = (_text(end.double() * world.resolution) for end in world.box)
        return f"is outside the bounds of {world.name}, {low} to {high} m"
    clear = float(world.mesh.clearance(place[None]))
    near = f"is {clear:.2f} m from a surface"
    if clear <= world.robot_radius:
        return f"{near}, where a robot of robot.radius={world.robot_radius:g} m touches it"
    gap = (others - place).norm(dim=1)
    if bool((gap <= 2 * world.robot_radius).any()):
        return f"touches the robot of team.start[{int(gap.argmin())}]"
    launch = initial_free_space(world, place, primitives)
    flown = place if launch is None else launch.trail[0]
    if not bool(world.navigable[((flown / world.resolution).floor().long() - world.box.low).unbind()]):
        if not bool(torch.isfinite(world.mesh.distances(place, _DOWN[None])).all()):
            return f"has no surface of {world.name} below it, and robots fly above a floor"
        return (
            f"is not in the part of {world.name} that is flown in: it nearly touches a surface, is in a "
            "solid, or in another part, which world.bounds=[x0,y0,z0,x1,y1,z1] around that would choose"
        )
    if launch is None:
        return f"{near}, and no safe motion leads away from there with {_robot(world)}"
    return None


def _instead(world: _World, others: Tensor, pose: Tensor, primitives: Primitives) -> str:
    """Suggest the nearest valid place for a pose (4,) beside robots at (N, 3)."""
    places = world.centers(world.navigable.nonzero())
    places = places[(torch.cdist(places, others) > 2 * world.robot_radius).all(1)]
    places = places[(places - pose[:3]).norm(dim=1).argsort(stable=True)]
    for _ in range(_TRIES):
        if len(places) == 0:
            break
        if initial_free_space(world, places[0], primitives) is not None:
            return f"move it, for instance to {_text(torch.cat([places[0], pose[3:]]))}"
        places = places[(places - places[0]).norm(dim=1) > 2 * world.resolution]
    return "no better place is near; use a smaller radius, finer cells or slower robots"


def _robot(world: _World) -> str:
    return f"robot.radius={world.robot_radius:g} m in cells of world.resolution={world.resolution:g} m"


def _text(numbers: Tensor) -> str:
    return f"[{', '.join(f'{x:.4g}' for x in numbers.tolist())}]"


def _together(world: _World, places: Tensor, anchor: Tensor, n: int, apart: float) -> Tensor:
    """Choose up to n of places (P, 3) near an anchor (3,), at least `apart` metres from each other."""
    if len(places) == 0:
        return places
    off = (places - anchor).norm(dim=1)
    reach = float(off.min()) + 2 * apart * math.sqrt(n)
    found = _apart(world, places[off <= reach], anchor, n, apart)
    while len(found) < n and reach < float(off.max()):
        reach *= 2
        found = _apart(world, places[off <= reach], anchor, n, apart)
    return found


def _apart(world: _World, places: Tensor, anchor: Tensor, n: int, apart: float) -> Tensor:
    """Choose up to n of places (P, 3), P ≥ 1, best first: visible, roomy, level with the anchor and near
    it.
    """
    nearest = places[(places - anchor).norm(dim=1).argmin()]
    off = places - nearest
    distance = off.norm(dim=1)
    sight = world.mesh.distances(nearest, off / distance.clamp_min(1e-9)[:, None])
    hidden = (sight <= distance) & (distance > 0)
    # How many cells a place is closer to a surface than the preferred distance.
    cramped = ((_ROOMY - world.mesh.clearance(places)) / world.resolution).clamp_min(0).ceil()
    # A cramped place costs more than any distance; a hidden place costs more than a cramped one.
    cost = torch.hypot(distance, 2 * off[:, 2]) + 1e6 * cramped + 1e9 * hidden
    places = places[cost.argsort(stable=True)]
    chosen: list[Tensor] = []
    while len(places) and len(chosen) < n:
        chosen.append(places[0])
        places = places[(places - places[0]).norm(dim=1) >= apart]
    return torch.stack(chosen)


def _far_end(world: _World) -> Tensor:
    """Return a place (3,) far from the middle of the world: roomy and near the floor, if there is one."""
    places = world.centers(viewpoints(world.navigable, max(1, round(1.0 / world.resolution))))
    room = world.mesh.clearance(places)
    if bool((room < _ROOMY).all()):  # a cramped world: look at every navigable cell
        places = world.centers(world.navigable.nonzero())
        room = world.mesh.clearance(places)
    off = (places - places.mean(0))[:, :2].norm(dim=1)
    roomy = room >= min(_ROOMY, float(room.max()) - world.resolution / 2)
    low = roomy & (world.mesh.distances(places, _DOWN.expand_as(places)) < 2 * _ROOMY)
    return places[torch.where(low if bool(low.any()) else roomy, off, -1.0).argmax()]

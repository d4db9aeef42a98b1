"""Start poses of a team, chosen in open space or given by the user; and the free space around each start."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.team.exploration.planning.collision_checking import (
    LocalMap,
    cells_in_sphere,
    feasible,
    passable_cells,
)
from gmmtorch.team.exploration.planning.planner_interface import LEAST
from gmmtorch.team.exploration.planning.primitives import Primitives
from gmmtorch.team.exploration.world.world import World, viewpoints

_SPACING = 1.5  # metres between two starts
_ROOMY = 1.0  # preferred distance (m) of a start from the nearest surface
_DOWN = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
_TRIES = 40  # places, or sets of places, that are tried before the search fails
_NEAR = 2.0  # metres from the start to the nearest place where the robot can take off, at most
_STEP = 0.05  # metres between the positions of the way there
_YAWS, _BATCH = 16, 16  # headings tried at each place; places tried together


def start_poses(world: World, n: int, primitives: Primitives) -> Tensor:
    """Choose start poses (n, 4), x, y, z (m) and yaw (rad), in the navigable space.

    The poses are near the world's start, else at the end that is farthest from the middle, and 1.5 m apart.
    If there is room, every pose is visible from the first, a metre from every surface, and at one height.
    Yaw angles are spread evenly; the first robot looks towards the middle of the world. Raises
    `InvalidArgumentError` if there is no room for n robots that can fly off.
    """
    apart = max(_SPACING, 2 * world.robot_radius + world.resolution)
    anchor = _far_end(world) if world.start is None else world.start
    places = centers = world.centers(world.navigable.nonzero())
    found = _together(world, places, anchor, n, apart)
    if len(found) < n:
        robots = "1 robot that starts" if len(found) == 1 else f"{len(found)} robots that start"
        volume = len(centers) * world.resolution**3
        raise InvalidArgumentError(
            f"{world.name} has room for {robots} {apart:.4g} m apart, but ‹size›={n}. "
            f"Only {volume:.3g} m³ are navigable (away from surfaces and above a floor). "
            "Use fewer robots, or set ‹start›. If you expect more room, check that the mesh has a floor."
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
        f"{world.name}: found no start poses from which a team of ‹size›={n} can fly off, with "
        f"{_robot(world)}. Use a smaller radius, finer cells, slower or fewer robots, or set ‹start›."
    )


def check_start(world: World, poses: Tensor, primitives: Primitives) -> Tensor:
    """Check that robots can start at poses (n, 4), x, y, z (m) and yaw (rad), float64; return them. Raises
    `InvalidArgumentError` that names the first bad pose and a better place for it."""
    for i, pose in enumerate(poses):
        others = poses[:i, :3]
        if not bool(torch.isfinite(pose).all()):
            raise InvalidArgumentError(f"‹start›[{i}]={_text(pose)} is not finite.")
        fault = _fault(world, others, pose[:3], primitives)
        if fault is not None:
            instead = _instead(world, others, pose, primitives)
            raise InvalidArgumentError(f"‹start›[{i}]={_text(pose)} {fault}; {instead}.")
    return poses


def _fault(world: World, others: Tensor, place: Tensor, primitives: Primitives) -> str | None:
    """Describe why a robot cannot start at a place (3,) beside robots at (N, 3); None if it can."""
    cell = (place / world.resolution).floor() - world.box.low
    if not bool(((cell >= 0) & (cell < torch.tensor(world.box.shape))).all()):
        low, high = (_text(end.double() * world.resolution) for end in world.box)
        return f"is outside the bounds of {world.name}, {low} to {high} m"
    clear = float(world.mesh.clearance(place[None]))
    near = f"is {clear:.2f} m from a surface"
    if clear <= world.robot_radius:
        return f"{near}, where a robot of ‹radius›={world.robot_radius:g} m touches it"
    gap = (others - place).norm(dim=1)
    if bool((gap <= 2 * world.robot_radius).any()):
        return f"touches the robot of ‹start›[{int(gap.argmin())}]"
    launch = initial_free_space(world, place, primitives)
    flown = place if launch is None else launch.trail[0]
    if not bool(world.navigable[((flown / world.resolution).floor().long() - world.box.low).unbind()]):
        if not bool(torch.isfinite(world.mesh.distances(place, _DOWN[None])).all()):
            return f"has no surface of {world.name} below it, and robots fly above a floor"
        return (
            f"is not in the part of {world.name} that is flown in: it nearly touches a surface, is in a "
            "solid, or in another part, which ‹bounds›=[x0,y0,z0,x1,y1,z1] around that would choose"
        )
    if launch is None:
        return f"{near}, and no safe motion leads away from there with {_robot(world)}"
    return None


def _instead(world: World, others: Tensor, pose: Tensor, primitives: Primitives) -> str:
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


def _robot(world: World) -> str:
    return f"‹radius›={world.robot_radius:g} m in cells of ‹resolution›={world.resolution:g} m"


def _text(numbers: Tensor) -> str:
    return f"[{', '.join(f'{x:.4g}' for x in numbers.tolist())}]"


def _together(world: World, places: Tensor, anchor: Tensor, n: int, apart: float) -> Tensor:
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


def _apart(world: World, places: Tensor, anchor: Tensor, n: int, apart: float) -> Tensor:
    """Choose up to n of places (P, 3), P ≥ 1: first those visible, roomy, and level with a near anchor."""
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


def _far_end(world: World) -> Tensor:
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


@dataclass(frozen=True, eq=False)
class InitialFreeSpace:
    """What a robot knows before its first frame.

    known_free: (K, 3) int64, free cells of the lattice.
    trail: (N, 3), metres, from the place where the robot can take off to its start; N = 1 if it can take off
        from its start.
    """

    known_free: Tensor
    trail: Tensor


def initial_free_space(world: World, place: Tensor, primitives: Primitives) -> InitialFreeSpace | None:
    """The free space that a robot knows at its start (3,), metres; None if it cannot take off from there,
    because none of its primitives is safe even with a perfect map.

    The start must touch nothing. In open space the robot knows that the sphere up to the nearest surface is
    free. Near a surface that sphere is too small, and the camera sees nothing above, below or behind the
    robot: there it is given the free cells nearby. If its start is too narrow for its primitives, it is also
    given a straight way from the nearest place that is not, and flies back along that way first.
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


def _truth(world: World, place: Tensor, reach: float) -> LocalMap:
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


def _nearest_take_off(world: World, place: Tensor, truth: LocalMap, primitives: Primitives) -> Tensor | None:
    """The nearest cell centre (3,) with a straight way to a place (3,) from which a robot can take off."""
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

"""Where the robots of a team start: together in a roomy place, or where they are told, if they fit there."""

from __future__ import annotations

import math
from typing import Protocol

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, check_whole
from gmmtorch.exploration.observable import viewpoints
from gmmtorch.occupancy.cell_evidence import Box
from gmmtorch.simulation.mesh_world import MeshWorld

_ROOMY = 1.0
"""Metres from the nearest surface at which robots start, where the world has such places."""


class _Place(Protocol):
    """What is asked of a world."""

    @property
    def name(self) -> str: ...
    @property
    def mesh(self) -> MeshWorld: ...
    @property
    def resolution(self) -> float: ...
    @property
    def box(self) -> Box: ...
    @property
    def navigable(self) -> Tensor: ...
    @property
    def robot_radius(self) -> float: ...
    def centers(self, cells: Tensor) -> Tensor: ...


def start_poses(world: _Place, n: int, spacing: float, at: Tensor | None) -> Tensor:
    """Poses (n, 4), x, y, z (m) and yaw (rad), in the navigable space near a place (3,).

    They are at least `spacing` metres apart, and never touch; as far as there is room they are in sight of
    the first, a metre from every surface, and level with it. They look all around, the first towards the
    middle of the world. If `at` is None they start at the end that is farthest from its middle. Raises
    `InvalidArgumentError` where so many do not find room.
    """
    check_whole("n", n, 1)
    if not (math.isfinite(spacing) and spacing >= 0):
        raise InvalidArgumentError(f"spacing={spacing} must be zero metres or more.")
    apart = max(spacing, 2 * world.robot_radius + world.resolution)
    anchor = _far_end(world) if at is None else at
    centers = world.centers(world.navigable.nonzero())
    off = (centers - anchor).norm(dim=1)
    reach = float(off.min()) + 2 * apart * math.sqrt(n)
    found = _apart(world, centers[off <= reach], anchor, n, apart)
    while len(found) < n:
        if reach >= float(off.max()):
            raise InvalidArgumentError(
                f"{world.name} has room for {len(found)} robots that start {apart} m apart; {n} were asked "
                "for: take fewer, or a smaller spacing."
            )
        reach *= 2
        found = _apart(world, centers[off <= reach], anchor, n, apart)
    ahead = centers.mean(0) - found[0]
    yaw = torch.atan2(ahead[1], ahead[0]) + torch.arange(n) * (2 * math.pi / n)
    return torch.cat([found, torch.remainder(yaw + math.pi, 2 * math.pi)[:, None] - math.pi], 1)


def check_start(world: _Place, poses: Tensor) -> Tensor:
    """The poses (n, 4), float64, if robots can start there; else `InvalidArgumentError` names the first."""
    if poses.ndim != 2 or poses.shape[1] != 4 or len(poses) == 0:
        raise InvalidArgumentError(
            f"start poses have shape {tuple(poses.shape)}; expected (n, 4): x, y, z (m), yaw (rad); n ≥ 1."
        )
    poses = poses.detach().cpu().double()
    for i, pose in enumerate(poses):
        where = f"start pose {i} at ({', '.join(f'{x:.2f}' for x in pose[:3].tolist())})"
        if not bool(torch.isfinite(pose).all()):
            raise InvalidArgumentError(f"{where}, yaw {float(pose[3])}, is not finite.")
        cell = (pose[:3] / world.resolution).floor() - world.box.low
        if not bool(((cell >= 0) & (cell < torch.tensor(world.box.shape))).all()):
            low, high = ((end * world.resolution).tolist() for end in world.box)
            raise InvalidArgumentError(f"{where} is outside the bounds of {world.name}, {low} to {high} m.")
        room = float(world.mesh.clearance(pose[None, :3]))
        if room <= world.robot_radius:
            raise InvalidArgumentError(
                f"{where} is {room:.2f} m from a surface, where a robot of radius {world.robot_radius} m "
                "touches it; move it away."
            )
        if not bool(world.navigable[tuple(cell.long().tolist())]):
            raise InvalidArgumentError(
                f"{where} is not in the part of {world.name} that is flown in: it is in a solid, cut off, or "
                "nearly touches a surface; move it."
            )
        gap = (poses[:i, :3] - pose[:3]).norm(dim=1)
        if bool((gap <= 2 * world.robot_radius).any()):
            raise InvalidArgumentError(
                f"{where} touches the robot of start pose {int(gap.argmin())}; move it."
            )
    return poses


def _apart(world: _Place, places: Tensor, anchor: Tensor, n: int, apart: float) -> Tensor:
    """Up to n of places (P, 3), P ≥ 1, the best first: in sight, roomy, level with the anchor and near it."""
    nearest = places[(places - anchor).norm(dim=1).argmin()]
    off = places - nearest
    distance = off.norm(dim=1)
    sight = world.mesh.distances(nearest, off / distance.clamp_min(1e-9)[:, None])
    hidden = (sight <= distance) & (distance > 0)
    cramped = world.mesh.clearance(places) < _ROOMY
    # One kind of fault outweighs any distance, the worse kind the other.
    cost = torch.hypot(distance, 2 * off[:, 2]) + 1e6 * cramped + 1e9 * hidden
    places = places[cost.argsort(stable=True)]
    chosen: list[Tensor] = []
    while len(places) and len(chosen) < n:
        chosen.append(places[0])
        places = places[(places - places[0]).norm(dim=1) >= apart]
    return torch.stack(chosen)


def _far_end(world: _Place) -> Tensor:
    """A place (3,) far from the middle: roomy, and not high above the floor, if there is one."""
    places = world.centers(viewpoints(world.navigable, max(1, round(1.0 / world.resolution))))
    off = (places - places.mean(0))[:, :2].norm(dim=1)
    down = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
    roomy = world.mesh.clearance(places) >= _ROOMY
    low = roomy & (world.mesh.distances(places, down.expand_as(places)) < 2 * _ROOMY)
    good = low if bool(low.any()) else roomy if bool(roomy.any()) else torch.ones_like(roomy)
    return places[torch.where(good, off, -1.0).argmax()]

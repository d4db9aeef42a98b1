"""What planners share: task, plan, feasible primitives, and what a robot does that finds no motion."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor

from gmmtorch.kernels import is_fused
from gmmtorch.team.exploration.planning.collision_checking import (
    LocalMap,
    PeerTrajectories,
    clear_of,
    feasible,
    feasible_motions,
)
from gmmtorch.team.exploration.planning.journeys import Roadmap
from gmmtorch.team.exploration.planning.primitives import Primitives
from gmmtorch.team.sharing import ViewLibrary

LEAST = 0.05
"""Smallest displacement (m) that counts as motion."""


@dataclass(frozen=True, eq=False)
class PlanningTask:
    """The input of a planner.

    state: (7,), of the robot when the plan begins. peers: paths of the other robots.
    residual: (G,) float32, share of the information in each block of the local map that teammates' plans
    leave.
    now: time (s). generator: random numbers of the planner. trail: (N, 3), metres, recent positions,
    latest last.
    """

    state: Tensor
    local_map: LocalMap
    peers: PeerTrajectories
    residual: Tensor
    library: ViewLibrary
    roadmap: Roadmap
    now: float
    generator: torch.Generator
    trail: Tensor


@dataclass(frozen=True, eq=False)
class Plan:
    """The output of a planner.

    path: (S, 7), the states of the next primitive. braking: (B, 7), the states until rest after it.
    views: (n, 4), planned camera poses. value: expected return.
    kind: "explore", "travel", "wait", "retreat" or "boxed_in".
    """

    path: Tensor
    braking: Tensor
    views: Tensor
    value: float
    kind: str


class Planner(Protocol):
    """Chooses the next motion primitive. The robot flies the path to its end before it plans again."""

    def plan(self, task: PlanningTask) -> Plan: ...


def options(
    primitives: Primitives, states: Tensor, task: PlanningTask, *, after: int = 0, may_escape: bool = False
) -> tuple[Tensor, Tensor, Tensor]:
    """All primitives from states (N, 7) that are reached `after` so many primitives: paths (N, P, S, 7),
    braking (N, P, B, 7), and which are feasible (N, P).

    may_escape: a robot whose own cell is no longer passable may leave it, see `collision_checking.feasible`.
    """
    dynamics, here = primitives.dynamics, task.local_map
    paths, braking, follows = primitives.flights(states)
    steps = after * dynamics.n_steps
    if follows is not None and is_fused(here.passable) and not (may_escape and is_stuck(here, states)):
        safe = feasible_motions(primitives, follows, states, paths[:, :, -1], here, task.peers, steps)
        return paths, braking, safe
    safe = feasible(
        paths,
        braking,
        task.local_map,
        task.peers.later(steps) if after else task.peers,
        start=states[:, None],
        radius=dynamics.radius if may_escape else None,
    )
    return paths, braking, safe


def is_stuck(local_map: LocalMap, states: Tensor) -> bool:
    """Whether a robot in one of the states (N, 7) is in a cell that is not passable."""
    return not bool(local_map.is_passable(states[:, :3]).all())


_METRES = 0.8  # largest distance of one plan


def is_boxed_in(primitives: Primitives, task: PlanningTask) -> bool:
    """Return whether no primitive that moves the robot is feasible. Turning in place at rest always is."""
    paths, _, safe = options(primitives, task.state[None].double(), task, may_escape=True)
    leads = (paths[0, :, -1, :3] - task.state[:3]).norm(dim=1) > LEAST
    return not bool((safe[0] & leads).any())


class Waiting:
    """The fallback when no primitive is feasible: come to rest, then look around after some plans at rest.
    Stopping is safe because it is the braking of the last plan, which was feasible. A robot at rest that
    turns in place occupies no new space."""

    def __init__(self, primitives: Primitives, patience: int = 2) -> None:
        self._primitives, self._patience = primitives, patience
        self._last = -math.inf
        self._count = 0

    def plan(self, task: PlanningTask) -> Plan:
        """Rest, or turn in place after `patience` plans."""
        if task.now > self._last:  # a robot may plan several times at one time
            self._count, self._last = self._count + 1, task.now
        if bool(task.state[4:].any()) or self._count <= self._patience:
            return self.rest(task.state)
        in_place = (self._primitives.commands[:, :2] == 0).all(1)
        turns = self._primitives.commands[:, 2].where(in_place, 0)
        return self._standing(task.state, int(turns.argmax()))

    def boxed_in(self, task: PlanningTask) -> Plan | None:
        """Return a turn in place for a robot boxed in for more than `patience` plans; None for others."""
        if bool(task.state[4:6].any()) or not is_boxed_in(self._primitives, task):
            self.over()
            return None
        plan = self.plan(task)
        return replace(plan, kind="boxed_in") if self._count > self._patience else None

    def rest(self, state: Tensor) -> Plan:
        """Come to rest from a state (7,) and stay."""
        return self._standing(state, self._primitives.stop)

    def _standing(self, state: Tensor, primitive: int) -> Plan:
        path = self._primitives.rollout(state[None])[0, primitive]
        return Plan(path, self._primitives.braking(path[-1]), path[-1:, :4], 0.0, "wait")

    def over(self) -> None:
        """Reset the count: the robot moves again."""
        self._count = 0


def retreat(primitives: Primitives, task: PlanningTask) -> Plan | None:
    """Plan a flight back along the trail; None if the robot fits, moves, or can leave by a primitive.

    A cell nearby may become occupied in the map, so that no primitive is safe because all are longer than
    the gap. The trail is safe because the robot has flown it. The robot starts and ends at rest and
    covers s(t) = L (1 − cos πt/T)/2 of L metres.
    """
    if bool(task.state[4:].any()) or bool(task.local_map.is_passable(task.state[:3])):
        return None
    if not is_boxed_in(primitives, task):
        return None
    dynamics = primitives.dynamics
    longest = dynamics.acceleration * 2 * (dynamics.duration / math.pi) ** 2
    way = _back(task.trail, min(_METRES, longest))
    if way is None:
        return None
    n = dynamics.n_steps
    share = (1 - torch.cos(torch.arange(1, n + 1, dtype=torch.float64) * (math.pi / n))) / 2
    places = _along(way, share)
    if not bool(clear_of(places, task.peers, task.state[:3])):
        return None
    path = task.state.repeat(n, 1)
    path[:, :3] = places
    return Plan(path, path[-1:].clone(), path[-1:, :4], 0.0, "retreat")


def shortened(trail: Tensor, path: Tensor) -> Tensor:
    """Return the rest of a trail (N, 3), latest last, after a flight back along it by a path (S, 3)."""
    nearest = int((trail - path[-1]).norm(dim=1).argmin())
    return torch.cat([trail[:nearest], path[-1:]]) if nearest else path[-1:]


def _back(trail: Tensor, metres: float) -> Tensor | None:
    """Return the last `metres` of a trail (N, 3), from its end backwards; None if the trail is too short."""
    way = trail.flip(0)
    length = torch.cumsum((way[1:] - way[:-1]).norm(dim=1), 0)
    if len(length) == 0 or float(length[-1]) < LEAST:
        return None
    n = int((length < metres).sum())
    last = _along(way, torch.tensor([min(1.0, metres / float(length[-1]))], dtype=way.dtype))
    return torch.cat([way[: n + 1], last])


def _along(way: Tensor, share: Tensor) -> Tensor:
    """Return places (S, 3) at shares (S,) of the length of a way (N, 3)."""
    step = (way[1:] - way[:-1]).norm(dim=1)
    length = torch.cat([step.new_zeros(1), torch.cumsum(step, 0)])
    at = share * length[-1]
    leg = torch.searchsorted(length, at, right=True).clamp(1, len(way) - 1) - 1
    rest = (at - length[leg]) / step[leg].clamp_min(torch.finfo(step.dtype).tiny)
    return way[leg] + rest.clamp(0, 1)[:, None] * (way[leg + 1] - way[leg])

"""The interface of planners: the task, the plan, and the feasible motion primitives."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from gmmtorch.exploration.information.view_library import ViewLibrary
from gmmtorch.exploration.planning.collision_checking import feasible, feasible_motions
from gmmtorch.exploration.planning.coordination import PeerTrajectories
from gmmtorch.exploration.planning.primitives import Primitives
from gmmtorch.exploration.planning.roadmap import Roadmap
from gmmtorch.exploration.robot.mapper import LocalMap
from gmmtorch.kernels.choice import is_fused

LEAST = 0.05
"""Smallest displacement (m) that counts as motion."""


@dataclass(frozen=True, eq=False)
class PlanningTask:
    """The input of a planner.

    robot: number of the robot. state: (7,), its state when the plan begins. peers: paths of the other robots.
    residual: (G,) float32, share of the information in each block of the local map that teammates' plans
    leave.
    now: time (s). generator: random numbers of the planner. trail: (N, 3), metres, recent positions,
    latest last.
    """

    robot: int
    state: Tensor
    local_map: LocalMap
    peers: PeerTrajectories
    residual: Tensor
    library: ViewLibrary
    roadmap: Roadmap
    now: float
    generator: torch.Generator
    trail: Tensor = field(default_factory=lambda: torch.zeros(0, 3, dtype=torch.float64))


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


class Options(NamedTuple):
    """All primitives from N states. paths: (N, P, S, 7); braking: (N, P, B, 7); feasible: (N, P) bool."""

    paths: Tensor
    braking: Tensor
    feasible: Tensor


def options(
    primitives: Primitives, states: Tensor, task: PlanningTask, *, after: int = 0, may_escape: bool = False
) -> Options:
    """Roll out all primitives from states (N, 7) that are reached `after` so many primitives, and check them.

    may_escape: a robot whose own cell is no longer passable may leave it, see `collision_checking.feasible`.
    """
    dynamics = primitives.dynamics
    paths = primitives.rollout(states)
    braking = primitives.braking(paths[:, :, -1])
    safe = feasible(
        paths,
        braking,
        task.local_map,
        task.peers.later(after * dynamics.n_steps) if after else task.peers,
        start=states[:, None],
        radius=dynamics.radius if may_escape else None,
    )
    return Options(paths, braking, safe)


def continuations(
    primitives: Primitives, states: Tensor, task: PlanningTask, after: int
) -> tuple[Tensor, Tensor]:
    """The ends (N, P, 7) of all primitives from states (N, 7), and which primitives are feasible (N, P).

    Args:
        after: primitives of the robot before these states.
    """
    passable = task.local_map.passable
    continued = primitives.continued(states) if is_fused(passable, states) else None
    if continued is None:
        there = options(primitives, states, task, after=after)
        return there.paths[:, :, -1], there.feasible
    steps = after * primitives.dynamics.n_steps
    return continued[0].ends, feasible_motions(*continued, task.local_map, task.peers, steps)


def is_boxed_in(primitives: Primitives, task: PlanningTask) -> bool:
    """Return whether no primitive that moves the robot is feasible. Turning in place at rest always is."""
    here = options(primitives, task.state[None].double(), task, may_escape=True)
    leads = (here.paths[0, :, -1, :3] - task.state[:3]).norm(dim=1) > LEAST
    return not bool((here.feasible[0] & leads).any())


class Waiting:
    """The fallback when no primitive is feasible: come to rest, then look around after some plans at rest.

    Stopping is safe because it is the braking of the last plan, which was feasible. A robot at rest that
    turns in place occupies no new space.
    """

    def __init__(self, primitives: Primitives, patience: int = 2) -> None:
        self._primitives, self._patience = primitives, patience
        self._last = -math.inf
        self._count = 0

    def plan(self, task: PlanningTask) -> Plan:
        """Rest, or turn in place after `patience` plans."""
        if task.now > self._last:  # a robot may plan several times at one time
            self._count, self._last = self._count + 1, task.now
        at_rest = not bool(task.state[4:].any())
        if at_rest and self._count > self._patience:
            turn = self._primitives.commands.clone()
            turn[:, 2] = turn[:, 2].where((turn[:, :2] == 0).all(1), 0)
            path = self._primitives.rollout(task.state[None])[0, int(turn[:, 2].argmax())]
        else:
            return self.rest(task.state)
        return Plan(path, self._primitives.braking(path[-1]), path[-1:, :4], 0.0, "wait")

    def boxed_in(self, task: PlanningTask) -> Plan | None:
        """Return a turn in place for a robot at rest that was boxed in for longer than `patience` plans,
        or None.
        """
        if bool(task.state[4:6].any()) or not is_boxed_in(self._primitives, task):
            self.over()
            return None
        plan = self.plan(task)
        return replace(plan, kind="boxed_in") if self._count > self._patience else None

    def rest(self, state: Tensor) -> Plan:
        """Come to rest from a state (7,) and stay."""
        path = self._primitives.rollout(state[None])[0, self._primitives.stop]
        return Plan(path, self._primitives.braking(path[-1]), path[-1:, :4], 0.0, "wait")

    def over(self) -> None:
        """Reset the count: the robot moves again."""
        self._count = 0

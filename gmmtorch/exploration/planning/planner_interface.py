"""What every planner is asked, and what it answers."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from gmmtorch.exploration.information.view_library import ViewLibrary
from gmmtorch.exploration.planning.collision_checking import feasible
from gmmtorch.exploration.planning.peer_trajectories import PeerTrajectories
from gmmtorch.exploration.planning.primitives import Primitives
from gmmtorch.exploration.planning.roadmap import Roadmap
from gmmtorch.exploration.robot.local_map import LocalMap

LEAST = 0.05
"""Metres of a way that leads anywhere."""


@dataclass(frozen=True, eq=False)
class PlanningTask:
    """What a robot knows when it plans.

    robot: its number. state: (7,), where it will be when the plan begins. peers: of the others.
    residual: (G,) float32, information that teammates' plans leave in each block of the local map.
    now: (s). generator: of the planner's random choices. trail: (N, 3), metres, where the robot flew lately,
    the latest last.
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
    """path: (S, 7), the states of the next primitive. braking: (B, 7), how the robot comes to rest after it.

    views: (n, 4), poses from which it means to look on its way. value: the return that it expects.
    kind: "explore", "travel", "wait", "retreat" or "boxed_in".
    """

    path: Tensor
    braking: Tensor
    views: Tensor
    value: float
    kind: str


class Planner(Protocol):
    """Chooses the next primitive. Between two plans the robot flies the first one's path to its end."""

    def plan(self, task: PlanningTask) -> Plan: ...


class Options(NamedTuple):
    """All primitives from N states. paths: (N, P, S, 7); braking: (N, P, B, 7); feasible: (N, P) bool."""

    paths: Tensor
    braking: Tensor
    feasible: Tensor


def options(
    primitives: Primitives, states: Tensor, task: PlanningTask, *, after: int = 0, may_escape: bool = False
) -> Options:
    """What a robot can do from states (N, 7), `after` so many primitives, and which of it is safe.

    may_escape: a robot whose own cell is no longer passable may leave it, see `safety.feasible`.
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


def is_boxed_in(primitives: Primitives, task: PlanningTask) -> bool:
    """Whether nothing that leads anywhere is feasible; to turn in place always is, for a robot at rest."""
    here = options(primitives, task.state[None].double(), task, may_escape=True)
    leads = (here.paths[0, :, -1, :3] - task.state[:3]).norm(dim=1) > LEAST
    return not bool((here.feasible[0] & leads).any())


class Waiting:
    """What to do where nothing is feasible: come to rest, and after some plans at rest look around.

    The last plan's braking was feasible, and to stop from its end is that very motion. A robot at rest
    that turns in place takes up no other space than it does already.
    """

    def __init__(self, primitives: Primitives, patience: int = 2) -> None:
        self._primitives, self._patience = primitives, patience
        self._last = -math.inf
        self._count = 0

    def plan(self, task: PlanningTask) -> Plan:
        """Rest, or turn in place once patience is over."""
        if task.now > self._last:  # a robot may be asked several times at once
            self._count, self._last = self._count + 1, task.now
        at_rest = not bool(task.state[4:].any())
        if at_rest and self._count > self._patience:
            turn = self._primitives.commands.clone()
            turn[:, 2] = turn[:, 2].where((turn[:, :2] == 0).all(1), 0)
            path = self._primitives.rollout(task.state[None])[0, int(turn[:, 2].argmax())]
        else:
            return self.rest(task)
        return Plan(path, self._primitives.braking(path[-1]), path[-1:, :4], 0.0, "wait")

    def boxed_in(self, task: PlanningTask) -> Plan | None:
        """A look around for a robot that stands, boxed in for longer than its patience; else None."""
        if bool(task.state[4:6].any()) or not is_boxed_in(self._primitives, task):
            self.over()
            return None
        plan = self.plan(task)
        return replace(plan, kind="boxed_in") if self._count > self._patience else None

    def rest(self, task: PlanningTask) -> Plan:
        """Come to rest and stay there: there is nothing to do, for now."""
        path = self._primitives.rollout(task.state[None])[0, self._primitives.stop]
        return Plan(path, self._primitives.braking(path[-1]), path[-1:, :4], 0.0, "wait")

    def over(self) -> None:
        """The robot has found something to do."""
        self._count = 0

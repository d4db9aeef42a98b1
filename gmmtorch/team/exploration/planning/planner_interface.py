"""The interface of planners: the task, the plan, and the feasible motion primitives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from gmmtorch.kernels import is_fused
from gmmtorch.team.exploration.information.view_library import ViewLibrary
from gmmtorch.team.exploration.planning.collision_checking import feasible, feasible_motions
from gmmtorch.team.exploration.planning.coordination import PeerTrajectories
from gmmtorch.team.exploration.planning.primitives import Primitives
from gmmtorch.team.exploration.planning.roadmap import Roadmap
from gmmtorch.team.exploration.robot.mapper import LocalMap

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

"""Turns: a team plans together, one robot after another or at once, as its coordination has it."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Protocol

import torch
from torch import Tensor

from gmmtorch.exploration.mission.options import TeamOptions
from gmmtorch.exploration.planning.coordination import Coordination
from gmmtorch.exploration.planning.peer_trajectories import PeerTrajectories
from gmmtorch.exploration.planning.planner_interface import Plan


class Pilot(Protocol):
    """What is asked of a robot when its team plans, wherever it runs: see `Agent`."""

    @property
    def number(self) -> int: ...
    @property
    def braking(self) -> Tensor:
        """(B, 7), how it comes to rest after the path that it is on."""
        ...

    def listen(self, now: float) -> None: ...
    def survey(self, now: float) -> None: ...
    def propose(self, now: float, fixed: Collection[int], peers: PeerTrajectories) -> Plan: ...
    def settle(self) -> None: ...
    def tell_plan(self, now: float, number: int) -> None: ...
    def tell_views(self, now: float) -> None: ...


def take_turns(
    pilots: Sequence[Pilot],
    coordination: Coordination,
    options: TeamOptions,
    now: float,
    number: int,
    generator: torch.Generator,
) -> dict[int, Plan]:
    """Every robot's next plan, which it then follows, in the order in which they were settled.

    Fixed plans are told as soon as others plan after them, who wait for them as long as the network takes.

    Args:
        pilots: by number. number: of the plans. generator: of what the coordination draws.
    """
    for pilot in pilots:
        pilot.survey(now)
    told: set[int] = set()
    proposed: dict[int, Plan] = {}

    def tell(fixed: Collection[int]) -> None:
        for robot in fixed:
            if robot not in told:
                told.add(robot)
                pilots[robot].tell_plan(now, number)

    def plan_of(robot: int, fixed: dict[int, Plan]) -> Plan:
        tell(fixed)
        pilot = pilots[robot]
        pilot.listen(now + options.plan_slack * len(fixed))
        peers = _peer_trajectories(pilots, robot, fixed, proposed, coordination, options)
        proposed[robot] = pilot.propose(now, fixed, peers)
        return proposed[robot]

    plans = coordination.coordinate(range(len(pilots)), plan_of, generator)
    for robot in plans:
        pilots[robot].settle()
    tell(plans)
    for pilot in pilots:
        pilot.tell_views(now)
    return plans


def _peer_trajectories(
    pilots: Sequence[Pilot],
    robot: int,
    fixed: Mapping[int, Plan],
    proposed: Mapping[int, Plan],
    coordination: Coordination,
    options: TeamOptions,
) -> PeerTrajectories:
    """Where the others may be: on what they settled on or proposed, or braking if that may change."""
    is_final = coordination.name != "distributed_greedy"
    paths = []
    for other in pilots:
        if other.number == robot:
            continue
        plan = fixed.get(other.number, proposed.get(other.number))
        if plan is not None:
            paths.append(torch.cat([plan.path, plan.braking])[:, :3])
        if plan is None or not (is_final or other.number in fixed):
            paths.append(other.braking[:, :3])
    return PeerTrajectories.of(paths, 2 * options.dynamics.radius + options.margin)

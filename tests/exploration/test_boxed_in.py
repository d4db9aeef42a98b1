"""Boxed-in robots look around until there is room, and then fly."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import replace

import pytest
import torch
from exploration.rooms import SMALL, small_room
from exploration.voxel_worlds import PRIMITIVES, Explorer, hollow
from torch import Tensor

from gmmtorch.exploration.mission.mission import Mission
from gmmtorch.exploration.mission.team_setup import assemble
from gmmtorch.exploration.planning.coordination import PeerTrajectories
from gmmtorch.exploration.planning.planner_interface import Plan
from gmmtorch.exploration.planning.recovery import Waiting, is_boxed_in
from gmmtorch.exploration.robot.agent import Agent
from gmmtorch.exploration.robot.robot_state import StoppingRule
from gmmtorch.exploration.world.world import World

OPTIONS = replace(
    SMALL, framework="grid_isolated", size=1, duration=92.0, rate=0.5, rest=StoppingRule(0.5, window=32.0)
)
BOXED_UNTIL = 72.0  # seconds


def around(place: Tensor) -> PeerTrajectories:
    """Peers on all sides of a place (3,), so that every path comes closer to one of them."""
    sides = torch.cat([torch.eye(3), -torch.eye(3)]).double()
    return PeerTrajectories.of([(place + 0.5 * side)[None] for side in sides], 3.0)


# -- one plan ---------------------------------------------------------------------------------------------


def seen(explorer: Explorer) -> Explorer:
    """An explorer that knows the whole world."""
    explorer.misses[~explorer.solid] = 9.0
    explorer.hits[explorer.solid] = 9.0
    return explorer


def test_a_robot_is_boxed_in_if_it_can_only_turn() -> None:
    free = seen(Explorer.at(hollow(30, 20, 13), (3.0, 2.0, 1.2, 0.4)))
    generator = torch.Generator()
    assert not is_boxed_in(PRIMITIVES, free.task(generator))
    assert is_boxed_in(PRIMITIVES, free.task(generator, around(free.state[:3])))
    tight = seen(Explorer.at(hollow(9, 9, 9), (0.9, 0.9, 0.9, 0.4)))
    tight.start = torch.full((3,), -50.0, dtype=torch.float64)  # only observed cells are free
    assert bool(tight.local_map().is_passable(tight.state[:3]))
    assert is_boxed_in(PRIMITIVES, tight.task(generator))


def test_a_boxed_in_robot_waits_then_turns_until_it_is_free() -> None:
    explorer = seen(Explorer.at(hollow(30, 20, 13), (3.0, 2.0, 1.2, 0.0)))
    waiting, generator, shut = Waiting(PRIMITIVES), torch.Generator(), around(explorer.state[:3])
    for _ in range(2):
        plans = []
        for _ in range(12):
            plan = waiting.boxed_in(explorer.task(generator, shut))
            plans.append(plan)
            if plan is not None:
                assert plan.kind == "boxed_in"
                assert bool((plan.path[:, :3] == explorer.state[:3]).all())
                explorer.state = plan.path[-1].clone()
            explorer.now += 2.0
        assert [plan is None for plan in plans] == [True] * 2 + [False] * 10
        yaw = torch.cat([plan.path[:, 3] for plan in plans if plan is not None])
        assert float(yaw.max() - yaw.min()) > 6.2  # all the way round
        explorer.state[4:] = 0
        assert waiting.boxed_in(explorer.task(generator)) is None  # and the count of plans starts again


# -- a mission --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def world() -> World:
    return small_room()


def box_in(agent: Agent, until: float) -> None:
    """Puts peers on all sides of the robot until that time (s)."""
    propose = agent.propose

    def boxed(
        now: float, final: Collection[int], peers: PeerTrajectories, since: float | None = None
    ) -> Plan:
        return propose(now, final, around(agent.robot.position) if now < until else peers, since)

    agent.propose = boxed  # type: ignore[method-assign]


@pytest.mark.parametrize("planner", ["mcts", "frontier"])
def test_a_robot_flies_after_it_was_boxed_in_longer_than_the_window(world: World, planner: str) -> None:
    mission = assemble(world, replace(OPTIONS, planner=planner))
    box_in(mission.agents[0], BOXED_UNTIL)
    advance(mission, BOXED_UNTIL)
    (robot,) = mission.robots
    assert not robot.stopping.rests
    assert robot.path_length == 0
    assert robot.state[3] != mission.trajectories[0][0][3]
    advance(mission)
    assert robot.path_length > 1
    assert robot.collisions == 0


def advance(mission: Mission, until: float = math.inf) -> None:
    while not mission.is_over and mission.elapsed < until:
        mission.tick(mission.elapsed)

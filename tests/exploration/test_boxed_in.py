"""Robots that are shut in: they look around for as long as it takes, and fly once they are let out."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import replace

import pytest
import torch
from exploration.flying_robots import small_room
from exploration.furnished_room import SMALL
from exploration.voxel_worlds import PRIMITIVES, Explorer, hollow
from torch import Tensor

from gmmtorch.exploration.mission.mission import Mission
from gmmtorch.exploration.mission.team_setup import assemble
from gmmtorch.exploration.planning.peer_trajectories import PeerTrajectories
from gmmtorch.exploration.planning.planner_interface import Plan, Waiting, is_boxed_in
from gmmtorch.exploration.robot.agent import Agent
from gmmtorch.exploration.robot.stopping_criterion import StoppingRule
from gmmtorch.exploration.world.world import World

OPTIONS = replace(
    SMALL, framework="grid_isolated", size=1, duration=160.0, rate=0.5, rest=StoppingRule(0.5, window=40.0)
)
SHUT = 136.0  # seconds


def around(place: Tensor) -> PeerTrajectories:
    """Others on all sides of a place (3,): wherever it leads, a way comes closer to one of them."""
    sides = torch.cat([torch.eye(3), -torch.eye(3)]).double()
    return PeerTrajectories.of([(place + 0.5 * side)[None] for side in sides], 3.0)


# -- one plan ---------------------------------------------------------------------------------------------


def seen(explorer: Explorer) -> Explorer:
    """Of a world that is known, as it is."""
    explorer.misses[~explorer.solid] = 9.0
    explorer.hits[explorer.solid] = 9.0
    return explorer


def test_boxed_in_is_who_can_only_turn() -> None:
    free = seen(Explorer.at(hollow(30, 20, 13), (3.0, 2.0, 1.2, 0.4)))
    generator = torch.Generator()
    assert not is_boxed_in(PRIMITIVES, free.task(generator))
    assert is_boxed_in(PRIMITIVES, free.task(generator, around(free.state[:3])))
    tight = seen(Explorer.at(hollow(9, 9, 9), (0.9, 0.9, 0.9, 0.4)))
    tight.start = torch.full((3,), -50.0, dtype=torch.float64)  # nothing is free but what was seen to be
    assert bool(tight.local_map().is_passable(tight.state[:3]))
    assert is_boxed_in(PRIMITIVES, tight.task(generator))


def test_it_waits_a_little_and_then_looks_around_until_it_is_let_out() -> None:
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
        assert waiting.boxed_in(explorer.task(generator)) is None  # and its patience begins anew


def test_who_moves_is_not_boxed_in() -> None:
    explorer = seen(Explorer.at(hollow(30, 20, 13), (3.0, 2.0, 1.2, 0.0)))
    explorer.state[4] = 0.75
    waiting = Waiting(PRIMITIVES, patience=0)
    assert waiting.boxed_in(explorer.task(torch.Generator(), around(explorer.state[:3]))) is None


# -- a mission --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def world() -> World:
    return small_room()


def shut_in(agent: Agent, until: float) -> None:
    """Until then others are on all sides of it."""
    propose = agent.propose

    def boxed(
        now: float, final: Collection[int], peers: PeerTrajectories, since: float | None = None
    ) -> Plan:
        return propose(now, final, around(agent.robot.position) if now < until else peers, since)

    agent.propose = boxed  # type: ignore[method-assign]


@pytest.mark.parametrize("planner", ["mcts", "frontier"])
def test_shut_in_for_longer_than_the_window_and_let_out_it_flies(world: World, planner: str) -> None:
    mission = assemble(world, replace(OPTIONS, planner=planner))
    shut_in(mission.agents[0], SHUT)
    advance(mission, SHUT)
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


def test_who_could_have_flown_rests(world: World) -> None:
    """The same rule, of a robot that stands where nothing keeps it."""
    mission = assemble(world, OPTIONS)
    agent = mission.agents[0]

    def stand(
        now: float, final: Collection[int], peers: PeerTrajectories, since: float | None = None
    ) -> Plan:
        path = agent.robot.state[None].repeat(PRIMITIVES.dynamics.n_steps, 1)
        return Plan(path, path[-1:], path[-1:, :4], 0.0, "explore")

    agent.propose = stand  # type: ignore[method-assign]
    advance(mission)
    assert agent.robot.stopping.rests

"""Robots without a motion: back along the trail; boxed in, they look around until they can fly."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import replace
from typing import Any

import pytest
import torch
from exploration.rooms import SMALL, small_room
from exploration.voxel_worlds import PRIMITIVES, Explorer, hollow, surroundings_from, task_of
from torch import Tensor

from gmmtorch.team.exploration.mission.mission import Mission
from gmmtorch.team.exploration.mission.team_setup import assemble
from gmmtorch.team.exploration.planning.coordination import PeerTrajectories
from gmmtorch.team.exploration.planning.planner_interface import Plan, PlanningTask
from gmmtorch.team.exploration.planning.recovery import Waiting, is_boxed_in, retreat, shortened
from gmmtorch.team.exploration.robot.agent import Agent
from gmmtorch.team.exploration.robot.robot_state import StoppingRule
from gmmtorch.team.exploration.world.world import World

SHAPE = (40, 40, 20)
HERE = torch.tensor([4.1, 4.1, 2.1], dtype=torch.float64)


def corner(n: int = 20) -> Tensor:
    """A trail (n, 3) that comes along y, turns, and ends at HERE along x, a tenth of a metre a step."""
    way = HERE.repeat(n, 1)
    back = torch.arange(n - 1, -1, -1, dtype=torch.float64) / 10
    way[:, 0] -= back.clamp_max(0.5)
    way[:, 1] -= (back - 0.5).clamp_min(0)
    return way


def task(free: bool = False, trail: Tensor | None = None, **changes: Any) -> PlanningTask:
    """A robot at rest at HERE, in a world that it takes for occupied, or free."""
    state = torch.cat([HERE, torch.tensor([0.7, 0, 0, 0], dtype=torch.float64)])
    trail = corner() if trail is None else trail
    given = {"state": state, "local_map": surroundings_from(torch.full(SHAPE, free)), "trail": trail}
    return task_of(**{**given, **changes})


def test_recovery_flies_back_and_ends_at_rest() -> None:
    plan = retreat(PRIMITIVES, task())
    assert plan is not None
    assert plan.kind == "retreat"
    dynamics = PRIMITIVES.dynamics
    places = torch.cat([HERE[None], plan.path[:, :3]])
    assert len(plan.path) == dynamics.n_steps
    # Every place is on the trail: on the last half metre along x, or on what is along y before it.
    on_x = (places[:, 1] - HERE[1]).abs() < 1e-9
    on_y = (places[:, 0] - (HERE[0] - 0.5)).abs() < 1e-9
    assert bool((on_x | on_y).all())
    assert plan.path[-1, :3].tolist() == pytest.approx([3.6, 3.8, 2.1])
    speed = (places[1:] - places[:-1]).norm(dim=1) / dynamics.step
    rest = torch.zeros(1, dtype=speed.dtype)
    change = torch.cat([rest, speed, rest]).diff().abs() / dynamics.step
    assert float(speed.max()) < dynamics.speed
    assert float(change.max()) <= dynamics.acceleration
    assert bool((plan.path[:, 3] == 0.7).all())
    assert bool((plan.path[:, 4:] == 0).all())
    assert torch.equal(plan.braking, plan.path[-1:])


def test_repeated_recovery_returns_to_the_start_of_the_trail() -> None:
    trail, state = corner(), task().state
    first = trail[0]
    for _ in range(4):
        plan = retreat(PRIMITIVES, task(trail=trail, state=state))
        if plan is None:
            break
        trail, state = shortened(trail, plan.path[:, :3]), plan.path[-1]
    assert state[:3].tolist() == pytest.approx(first.tolist(), abs=1e-9)
    assert len(trail) == 1


@pytest.mark.parametrize("case", ["it fits", "it moves", "no trail", "somebody is there"])
def test_recovery_is_none_if_the_robot_can_leave(case: str) -> None:
    moving = torch.cat([HERE, torch.tensor([0.7, 0.4, 0, 0], dtype=torch.float64)])
    behind = corner()[-6] - torch.tensor([0.6, 0.0, 0.0])
    tasks = {
        "it fits": task(free=True),
        "it moves": task(state=moving),
        "no trail": task(trail=HERE[None]),
        "somebody is there": task(peers=PeerTrajectories.of([behind[None]])),
    }
    assert retreat(PRIMITIVES, tasks[case]) is None
    assert retreat(PRIMITIVES, task()) is not None


# -- boxed in ---------------------------------------------------------------------------------------

OPTIONS = replace(
    SMALL, framework="grid_isolated", size=1, duration=92.0, rate=0.5, rest=StoppingRule(0.5, window=32.0)
)
BOXED_UNTIL = 72.0  # seconds


def around(place: Tensor) -> PeerTrajectories:
    """Peers on all sides of a place (3,), so that every path comes closer to one of them."""
    sides = torch.cat([torch.eye(3), -torch.eye(3)]).double()
    return PeerTrajectories.of([(place + 0.5 * side)[None] for side in sides], 3.0)


def test_a_robot_is_boxed_in_if_it_can_only_turn() -> None:
    free = Explorer.at(hollow(30, 20, 13), (3.0, 2.0, 1.2, 0.4)).know_all()
    generator = torch.Generator()
    assert not is_boxed_in(PRIMITIVES, free.task(generator))
    assert is_boxed_in(PRIMITIVES, free.task(generator, around(free.state[:3])))
    tight = Explorer.at(hollow(9, 9, 9), (0.9, 0.9, 0.9, 0.4)).know_all()
    tight.start = torch.full((3,), -50.0, dtype=torch.float64)  # only observed cells are free
    assert bool(tight.local_map().is_passable(tight.state[:3]))
    assert is_boxed_in(PRIMITIVES, tight.task(generator))


def test_a_boxed_in_robot_waits_then_turns_until_it_is_free() -> None:
    explorer = Explorer.at(hollow(30, 20, 13), (3.0, 2.0, 1.2, 0.0)).know_all()
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

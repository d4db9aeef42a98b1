"""Robot: its path, its trail, its local map; when it rests; and what it does without a motion."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import replace
from typing import Any

import pytest
import torch
from exploration.rooms import SMALL, small_room
from exploration.voxel_worlds import PRIMITIVES, Explorer, hollow, surroundings_from, task_of
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.occupancy import Box, CellEvidence, RollingWindow
from gmmtorch.simulation.robot_camera import DepthCamera, DepthFrame
from gmmtorch.team.exploration import Agent, BeliefRule, Mission, TeamOptions, World
from gmmtorch.team.exploration.mission.trials import assemble
from gmmtorch.team.exploration.planning.collision_checking import PeerTrajectories, cells_in_sphere
from gmmtorch.team.exploration.planning.planner_interface import (
    Plan,
    PlanningTask,
    Waiting,
    is_boxed_in,
    retreat,
    shortened,
)
from gmmtorch.team.exploration.robot.agent import Robot, StoppingCriterion, StoppingRule
from gmmtorch.team.exploration.robot.mapper import GridMapper, Memo
from gmmtorch.team.exploration.world.scoring import BeliefMap
from gmmtorch.team.exploration.world.starts import InitialFreeSpace

BOX = Box(torch.tensor([0, 0, 0]), torch.tensor([32, 32, 16]))
WINDOW = (32, 32, 16)
START = torch.tensor([3.1, 3.1, 1.5, 0.3], dtype=torch.float64)


class Idle:
    """A planner that must not be called."""

    def plan(self, task: Any) -> Plan:
        raise AssertionError("A robot does not call its planner; its agent does.")


def robot(start_radius: float = 0.0) -> Robot:
    belief = BeliefMap(0.2, BOX, torch.ones(BOX.shape, dtype=torch.bool), BeliefRule())
    team = TeamOptions(framework="grid_shared", camera=DepthCamera(width=8, height=6))
    mapper = GridMapper(0, RollingWindow(0.2, WINDOW, 4), belief, team, Memo(8))
    mapper.center_on(START[:3])
    launch = InitialFreeSpace(cells_in_sphere(START[:3], start_radius, 0.2), START[None, :3])
    return Robot(0, START, mapper, Idle(), launch, StoppingRule())


def plan(path: Tensor) -> Plan:
    return Plan(path, path[-1:].clone(), path[-1:, :4], 1.0, "test")


def zigzag(n: int = 10) -> Tensor:
    """States (n, 7) of a path whose steps are 3, 4, 3, 4 … decimetres, along x and y."""
    path = torch.zeros(n, 7, dtype=torch.float64)
    step = torch.arange(1, n + 1)
    path[:, 0] = START[0] + 0.3 * ((step + 1) // 2)
    path[:, 1] = START[1] + 0.4 * (step // 2)
    path[:, 2] = START[2]
    path[:, 4] = step.double() / n
    return path


def test_path_length_is_the_sum_of_the_steps_and_a_robot_stays_at_the_end() -> None:
    one, path = robot(), zigzag()
    one.follow(plan(path))
    assert torch.equal(one.advance(0, 3), path[:3, :3])
    assert one.path_length == pytest.approx(0.3 + 0.4 + 0.3)
    assert torch.equal(one.state, path[2])
    assert one.advance(3, 13).shape == (7, 3)
    flown = one.path_length
    assert flown == pytest.approx(5 * 0.3 + 5 * 0.4)
    for _ in range(3):
        assert one.advance(13, 18).shape == (0, 3)
        assert one.path_length == flown
        assert torch.equal(one.state, path[-1])
    back = path.flip(0)[1:]  # the next plan starts there
    one.follow(plan(back))
    one.advance(0, 9)
    assert one.path_length == pytest.approx(2 * flown - 0.3)


# -- where it fits --------------------------------------------------------------------------------------


def everywhere(one: Robot, hits: float, misses: float) -> None:
    local = one.mapper.local
    local.add(
        CellEvidence.from_dense(local.box.low, torch.full(local.shape, hits), torch.full(local.shape, misses))
    )


def test_the_trail_contains_flown_positions_only() -> None:
    one, path = robot(), zigzag()
    one.follow(plan(torch.cat([path, path[-1:].expand(30, 7)])))
    one.advance(0, 40)
    assert torch.equal(one.trail, torch.cat([START[None, :3], path[:, :3]]))


def test_a_long_trail_loses_its_oldest_positions() -> None:
    one = robot()
    path = torch.zeros(500, 7, dtype=torch.float64)
    path[:, 0] = torch.arange(500) * 0.1
    one.follow(plan(path))
    one.advance(0, 500)
    assert torch.equal(one.trail, path[-len(one.trail) :, :3])
    assert len(one.trail) < 500


def test_a_retreat_shortens_the_trail() -> None:
    one, path = robot(), zigzag()
    one.follow(plan(path))
    one.advance(0, 10)
    back = path.flip(0)[1:5]
    one.follow(Plan(back, back[-1:], back[-1:, :4], 0.0, "retreat"))
    one.advance(0, 2)
    one.advance(2, 4)
    assert torch.equal(one.trail, torch.cat([START[None, :3], path[:6, :3]]))
    one.follow(plan(path[6:7]))
    one.advance(0, 1)
    assert torch.equal(one.trail, torch.cat([START[None, :3], path[:7, :3]]))


def test_recent_returns_are_obstacles() -> None:
    one = robot()
    everywhere(one, 0.0, 50.0)
    free = one.local_map(0.125, 0.3, WINDOW)
    wall = torch.tensor([[4.5, 3.1, 1.5], [4.5, 3.3, 1.5]], dtype=torch.float64)
    thin = torch.tensor([[2.1, 3.1, 1.5]], dtype=torch.float64)  # the end of an empty beam
    ends, is_hit = torch.cat([wall, thin]), torch.tensor([True, True, False])
    one._remember_returns(DepthFrame(START[:3], ends, is_hit, torch.arange(3)))
    found = one.local_map(0.125, 0.3, WINDOW)
    taken = free.free & ~found.free
    cells = (wall / 0.2).floor().long()
    assert (taken.nonzero() + found.low).tolist() == cells.tolist()
    # Every cell that is no longer passable is near a return, and those at it are not.
    lost = found.centers((free.passable & ~found.passable).nonzero())
    assert float(torch.cdist(lost, wall).amin(1).max()) < 0.3 + 2.5 * 0.2 * 3**0.5
    assert not bool(found.is_passable(wall).any())
    assert bool(found.is_passable(thin).all())
    # After twelve frames more it is forgotten; frames without returns do not count.
    nothing = DepthFrame(START[:3], ends[2:], is_hit[2:], torch.arange(1))
    for _ in range(20):
        one._remember_returns(nothing)
    assert not bool(one.local_map(0.125, 0.3, WINDOW).is_passable(wall).any())
    elsewhere = DepthFrame(START[:3], wall[:1] + 1.0, is_hit[:1], torch.arange(1))
    for _ in range(12):
        one._remember_returns(elsewhere)
    assert bool(one.local_map(0.125, 0.3, WINDOW).is_passable(wall).all())


def test_the_known_sphere_around_the_start_is_free() -> None:
    found = robot(start_radius=1.4).local_map(0.125, 0.3, WINDOW)
    centers = found.centers(found.free.nonzero())
    assert len(centers) > 100
    assert float((centers - START[:3]).norm(dim=1).max()) <= 1.4
    assert int(found.passable.sum()) > 1
    assert not bool(found.observed.any())


# -- when it rests ----------------------------------------------------------------------------------

GAINS = st.lists(st.floats(0, 100), min_size=1, max_size=60)


def first_rest_by_definition(gains: list[float], every: float, rule: StoppingRule) -> int | None:
    """The first note after which a robot without news rests."""
    times = [i * every for i in range(len(gains))]
    learned = [sum(gains[: i + 1]) for i in range(len(gains))]
    best = 0.0
    for i, now in enumerate(times):
        before = [j for j in range(i + 1) if times[j] <= now - rule.window]
        if before:
            gained = learned[i] - learned[max(before)]
            best = max(best, gained)
            if gained < rule.share * best:
                return i
    return None


@given(gains=GAINS, every=st.sampled_from([1.0, 2.0, 7.0]), share=st.sampled_from([0.0, 0.1, 0.6, 0.9]))
def test_a_robot_rests_when_the_rule_says_so(gains, every, share):
    rule = StoppingRule(share, window=10.0)
    returns, learned = StoppingCriterion(rule), 0.0
    expected = first_rest_by_definition(gains, every, rule)
    for i, gain in enumerate(gains):
        learned += gain
        returns.note(i * every, learned, known=learned)
        assert returns.rests == (expected is not None and i >= expected)
        if returns.rests:
            learned -= gain  # at rest it learns nothing, and so is not woken
            break


@given(
    gains=st.lists(st.tuples(st.integers(0, 100), st.booleans()), min_size=1, max_size=60),
    share=st.sampled_from([0.1, 0.9]),
)
def test_time_boxed_in_does_not_count(gains, share):
    rule = StoppingRule(share, window=10.0)
    returns, learned = StoppingCriterion(rule), 0.0
    told: list[float] = []  # of the notes that count
    since = 0.0
    for i, (gain, boxed_in) in enumerate(gains):
        boxed_in &= i > 0  # before the first note there was nothing
        learned, since = learned + gain, since + gain
        returns.note(100.0 + 2.0 * i, learned, known=0.0, boxed_in=boxed_in)
        if not boxed_in:
            told.append(since)
            since = 0.0
        assert returns.rests == (first_rest_by_definition(told, 2.0, rule) is not None)
        if returns.rests:
            break


def resting() -> StoppingCriterion:
    """At rest at 30 s, having learned 100 bits in its best 10 s, with 150 known."""
    returns = StoppingCriterion(StoppingRule(0.05, window=10.0))
    for now, learned in ((0, 0), (10, 100), (20, 110), (30, 110)):
        assert not returns.rests
        returns.note(now, learned, 40.0 + learned)
    assert returns.rests
    return returns


def test_news_wake_a_resting_robot_for_at_least_a_window():
    returns = resting()
    returns.note(32, 110, 170.0)
    assert returns.rests
    returns.note(34, 110, 175.0)
    assert not returns.rests
    for now in (36, 40, 45):
        returns.note(now, 110, 175.0)
        assert not returns.rests
    returns.note(46, 110, 175.0)
    assert returns.rests


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"share": -0.1}, "share=-0.1"),
        ({"share": 1.0}, "share=1.0"),
        ({"share": float("nan")}, "share=nan"),
        ({"window": 0.0}, "window=0.0"),
        ({"window": float("inf")}, "window=inf"),
    ],
)
def test_invalid_stopping_rules_are_rejected(options, message):
    with pytest.raises(InvalidArgumentError, match=message):
        StoppingRule(**options)


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

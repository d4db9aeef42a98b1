"""Robot: its path, its trail, its local map; and when it rests, by the rule over all notes."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.mapping.learning.rules import NoveltyRule
from gmmtorch.occupancy.voxels.boxes import Box
from gmmtorch.occupancy.voxels.cell_evidence import CellEvidence
from gmmtorch.occupancy.voxels.rolling_window import RollingWindow
from gmmtorch.simulation.sensors.depth_camera import DepthFrame
from gmmtorch.team.exploration.information.view_library import ViewLibrary
from gmmtorch.team.exploration.planning.collision_checking import cells_in_sphere
from gmmtorch.team.exploration.planning.planner_interface import Plan
from gmmtorch.team.exploration.planning.roadmap import Roadmap
from gmmtorch.team.exploration.robot.grid_mapper import GridMapper
from gmmtorch.team.exploration.robot.mapper import Memo
from gmmtorch.team.exploration.robot.robot_state import Robot, StoppingCriterion, StoppingRule
from gmmtorch.team.exploration.world.scoring import BeliefMap, BeliefRule
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
    mapper = GridMapper(
        0, RollingWindow(0.2, WINDOW, 4), belief, 8, NoveltyRule(resolution=0.2), Memo(8), True, 3
    )
    mapper.center_on(START[:3])
    launch = InitialFreeSpace(cells_in_sphere(START[:3], start_radius, 0.2), START[None, :3])
    return Robot(0, START, mapper, Idle(), ViewLibrary(0), Roadmap(), launch, StoppingRule())


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


def test_path_length_is_the_sum_of_the_steps() -> None:
    one, path = robot(), zigzag()
    one.follow(plan(path))
    assert torch.equal(one.advance(0, 3), path[:3, :3])
    assert one.path_length == pytest.approx(0.3 + 0.4 + 0.3)
    assert torch.equal(one.state, path[2])
    assert torch.equal(one.advance(3, 6), path[3:6, :3])
    assert one.path_length == pytest.approx(3 * 0.3 + 3 * 0.4)
    assert torch.equal(one.state, path[5])


def test_a_robot_stays_at_the_end_of_its_path() -> None:
    one, path = robot(), zigzag()
    one.follow(plan(path))
    one.advance(0, 8)
    assert one.advance(8, 13).shape == (2, 3)
    flown = one.path_length
    assert flown == pytest.approx(5 * 0.3 + 5 * 0.4)
    for _ in range(3):
        assert one.advance(13, 18).shape == (0, 3)
        assert one.path_length == flown
        assert torch.equal(one.state, path[-1])
    # The next plan starts there.
    back = path.flip(0)[1:]
    one.follow(plan(back))
    one.advance(0, 9)
    assert one.path_length == pytest.approx(2 * flown - 0.3)


def test_a_robot_without_a_plan_stays_at_its_start() -> None:
    one = robot()
    one.advance(0, 5)
    assert one.path_length == 0
    assert one.state.tolist() == [*START.tolist(), 0, 0, 0]


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


def test_a_zero_share_never_rests():
    returns = StoppingCriterion(StoppingRule(0.0, window=4.0))
    for now in range(50):
        returns.note(now, 0.0, 0.0)
    assert not returns.rests


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"share": -0.1}, "planner.rest=-0.1"),
        ({"share": 1.0}, "planner.rest=1.0"),
        ({"share": float("nan")}, "planner.rest=nan"),
        ({"window": 0.0}, "window=0.0"),
        ({"window": float("inf")}, "window=inf"),
    ],
)
def test_invalid_stopping_rules_are_rejected(options, message):
    with pytest.raises(InvalidArgumentError, match=message):
        StoppingRule(**options)

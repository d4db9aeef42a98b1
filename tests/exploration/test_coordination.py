"""Coordination on a toy with few choices; paths of peers; and the order of calls in a planning round."""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from exploration.rooms import plan_ahead
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.team.exploration.mission.mission import COORDINATIONS, coordinate, plan_together
from gmmtorch.team.exploration.mission.options import TeamOptions
from gmmtorch.team.exploration.planning.collision_checking import PeerTrajectories, clear_of, predicted_path
from gmmtorch.team.exploration.planning.planner_interface import Plan

Choices = list[list[frozenset[int]]]
"""Of each robot, the sets that it may cover."""


@dataclass(frozen=True)
class Cover:
    cells: frozenset[int]
    value: float


def planner_of(choices: Choices):
    """The best choice of a robot given the others', and a record of who was asked given whom."""
    asked: list[tuple[int, tuple[int, ...]]] = []

    def plan(robot: int, fixed: dict[int, Cover]) -> Cover:
        asked.append((robot, tuple(sorted(fixed))))
        taken = frozenset().union(*(cover.cells for cover in fixed.values()))
        best = max(choices[robot], key=lambda cells: len(cells - taken))
        return Cover(best, len(best - taken))

    return plan, asked


def covered(plans: dict[int, Cover]) -> int:
    return len(frozenset().union(*(cover.cells for cover in plans.values())))


def optimum(choices: Choices) -> int:
    return max(len(frozenset().union(*pick)) for pick in itertools.product(*choices))


teams = st.lists(
    st.lists(st.frozensets(st.integers(0, 11), max_size=5), min_size=1, max_size=4), min_size=1, max_size=4
)


@given(choices=teams, name=st.sampled_from(COORDINATIONS), seed=st.integers(0, 99), n=st.integers(1, 5))
def test_each_robot_gets_one_feasible_plan(choices, name, seed, n):
    plan, _ = planner_of(choices)
    plans = coordinate(name, len(choices), plan, torch.Generator().manual_seed(seed), n)
    assert sorted(plans) == list(range(len(choices)))
    assert all(cover.cells in choices[robot] for robot, cover in plans.items())


@given(choices=teams, n=st.integers(0, 2))
def test_greedy_covers_at_least_half_of_the_optimum(choices, n):
    generator = torch.Generator().manual_seed(0)
    for name, rounds in (("greedy", 1), ("distributed_greedy", len(choices) + n)):
        plan, _ = planner_of(choices)
        plans = coordinate(name, len(choices), plan, generator, rounds)
        assert 2 * covered(plans) >= optimum(choices)


@given(choices=teams)
def test_distributed_greedy_with_a_round_for_each_takes_the_best_gain_first(choices):
    plan, _ = planner_of(choices)
    left, taken = dict(enumerate(choices)), frozenset()
    expected = []
    while left:
        gains = {robot: max(len(cells - taken) for cells in sets) for robot, sets in left.items()}
        robot = max(sorted(gains), key=lambda r: gains[r])
        taken |= max(left.pop(robot), key=lambda cells: len(cells - taken))
        expected.append(robot)
    plans = coordinate("distributed_greedy", len(choices), plan, torch.Generator(), len(choices))
    assert list(plans) == expected
    assert covered(plans) == len(taken)


def test_coordination_passes_the_right_plans():
    choices: Choices = [[frozenset({robot})] for robot in range(4)]
    plan, asked = planner_of(choices)
    coordinate("greedy", 4, plan, torch.Generator())
    assert asked == [(0, ()), (1, (0,)), (2, (0, 1)), (3, (0, 1, 2))]
    plan, asked = planner_of(choices)
    coordinate("myopic", 4, plan, torch.Generator())
    assert asked == [(robot, ()) for robot in range(4)]
    plan, asked = planner_of(choices)
    coordinate("distributed_greedy", 4, plan, torch.Generator(), 2)
    assert asked == [*((robot, ()) for robot in range(4)), (2, (0, 1)), (3, (0, 1))]


@given(seed=st.integers(0, 200), n_rounds=st.integers(1, 4))
def test_random_partition_considers_all_earlier_rounds(seed, n_rounds):
    choices: Choices = [[frozenset({robot})] for robot in range(6)]
    drawn = torch.randint(n_rounds, (6,), generator=torch.Generator().manual_seed(seed)).tolist()
    plan, asked = planner_of(choices)
    coordinate("random_partition", 6, plan, torch.Generator().manual_seed(seed), n_rounds)
    order = sorted(range(6), key=lambda robot: drawn[robot])
    assert asked == [
        (robot, tuple(other for other in range(6) if drawn[other] < drawn[robot])) for robot in order
    ]


# -- paths of peers ---------------------------------------------------------------------------------

FINE = 20


def walk(n: int, generator: torch.Generator) -> Tensor:
    """A path (n, 3) whose steps change little by little."""
    push = torch.randn(n, 3, generator=generator, dtype=torch.float64) * 0.05
    return (push.cumsum(0)).cumsum(0) + torch.randn(3, generator=generator, dtype=torch.float64)


def at(path: Tensor, time: Tensor) -> Tensor:
    """Where paths (..., L, 3), positions at times 1 … L, are at times (T,): (..., T, 3)."""
    time = (time - 1).clamp(0, path.shape[-2] - 1)
    before = time.floor().long().clamp_max(max(path.shape[-2] - 2, 0))
    after = (before + 1).clamp_max(path.shape[-2] - 1)
    return torch.lerp(path[..., before, :], path[..., after, :], (time - before)[:, None])


@given(
    seed=st.integers(0, 10**6),
    n_path=st.integers(1, 12),
    lengths=st.lists(st.integers(1, 15), min_size=1, max_size=3),
    shift=st.floats(-0.5, 0.5),
)
def test_clear_paths_tolerate_early_and_late_peers(seed, n_path, lengths, shift):
    generator = torch.Generator().manual_seed(seed)
    others = [walk(n, generator) for n in lengths]
    paths = torch.stack([walk(n_path, generator) for _ in range(20)])
    clear = clear_of(paths, PeerTrajectories.of(others, 0.7))
    time = torch.arange(FINE, 16 * FINE, dtype=torch.float64) / FINE
    for other in others:
        apart = (at(paths, time) - at(other, time + shift)).norm(dim=-1).amin(1)
        assert bool((apart[clear] >= 0.7 - 1e-9).all())


def test_resting_place_of_a_peer_stays_occupied():
    waiting = torch.zeros(3, 3, dtype=torch.float64)
    coming = torch.linspace(6, 0.2, 15, dtype=torch.float64)[:, None] * torch.tensor([1.0, 0, 0])
    assert not bool(
        clear_of(waiting[None], PeerTrajectories.of([coming]))
    )  # it arrives after the path has ended
    assert not bool(clear_of(coming[None], PeerTrajectories.of([waiting])))  # it arrives where one rests
    aside = coming + torch.tensor([0, 1.0, 0])
    assert bool(clear_of(aside[None], PeerTrajectories.of([waiting])))


def test_robot_too_close_may_stay_or_move_away():
    other = torch.zeros(1, 3, dtype=torch.float64)
    start = torch.tensor([0.5, 0, 0], dtype=torch.float64)
    step = torch.arange(1, 6, dtype=torch.float64)[:, None] * torch.tensor([0.1, 0, 0])
    paths = torch.stack([start.expand(5, 3), start + step, start - step, start + step.roll(1, 1)])
    peers = PeerTrajectories.of([other])
    assert clear_of(paths, peers, start.expand(4, 3)).tolist() == [True, True, False, True]
    assert clear_of(paths, peers).tolist() == [False, False, False, False]


def test_later_shifts_the_paths():
    generator = torch.Generator().manual_seed(3)
    other = walk(8, generator)
    peers = PeerTrajectories.of([other, walk(5, generator)])
    assert torch.equal(peers.later(3).paths[0], other[3:])
    assert torch.equal(peers.later(50).paths[0], other[-1:])
    assert peers.paths.shape == (2, 8, 3)
    assert torch.equal(peers.paths[1, 4:], peers.paths[1, 4:5].expand(4, 3))


@pytest.mark.parametrize("paths", [torch.zeros(2, 3), torch.zeros(2, 0, 3), torch.full((1, 1, 3), math.nan)])
def test_peer_trajectories_reject_nonfinite_paths_and_bad_separations(paths):
    with pytest.raises(InvalidArgumentError, match="paths"):
        PeerTrajectories(paths)
    with pytest.raises(InvalidArgumentError, match="separation="):
        PeerTrajectories.of([], 0.0)


# -- plans that were heard --------------------------------------------------------------------------------


def test_a_predicted_path_is_the_rest_of_a_plan() -> None:
    def xs(age: float, step: float = 0.2, of: float = 0.2, n: int = 6) -> list[float]:
        ahead = predicted_path(plan_ahead(n, of), age, step)
        assert (ahead[:, 1:] == 0).all()
        return pytest.approx(ahead[:, 0].tolist())

    assert xs(0.0) == [1, 2, 3, 4, 5, 6]
    assert xs(0.4) == [3, 4, 5, 6]
    assert xs(0.45) == [3.25, 4.25, 5.25, 6]
    assert all(xs(age) == [6] for age in (1.2, 7.0, 1e9))
    assert xs(0.0, step=0.4) == [2, 4, 6]
    assert xs(0.1, of=0.4, n=3) == [0.75, 1.25, 1.75, 2.25, 2.75, 3]
    assert xs(0.1, n=1) == [1]


@given(
    n=st.integers(1, 40),
    of=st.floats(0.01, 2.0),
    step=st.floats(0.05, 1.0),
    age=st.floats(0.0, 30.0),
)
def test_a_predicted_path_is_where_a_robot_of_constant_speed_is(
    n: int, of: float, step: float, age: float
) -> None:
    ahead = predicted_path(plan_ahead(n, of), age, step)[:, 0]
    times = age + step * torch.arange(1, len(ahead) + 1, dtype=torch.float64)
    assert (times[-1] >= n * of - 1e-6) or len(ahead) == 1000
    there = (times / of).clamp_max(n) if n > 1 else torch.ones(len(ahead), dtype=torch.float64)
    assert torch.allclose(ahead, there, atol=1e-6)


N, NOW, NUMBER = 5, 40.0, 20
OPTIONS = TeamOptions(size=N, latency=0.02, jitter=0.004, margin=0.25)
every_coordination = pytest.mark.parametrize("name", COORDINATIONS)
seeds = pytest.mark.parametrize("seed", range(3))


def states(n: int, x: float) -> Tensor:
    path = torch.zeros(n, 7, dtype=torch.float64)
    path[:, 0] = x
    return path


class Recorder:
    """An agent whose n-th plan is at x = 100 r + n for robot r, and its braking 0.5 further."""

    def __init__(self, number: int, log: list[tuple[str, int, Any]], values: list[float]) -> None:
        self.number, self._log, self._values = number, log, values
        self.robot = SimpleNamespace(braking=states(2, -float(number + 1)))
        self.peers: list[PeerTrajectories] = []

    def _note(self, name: str, *about: Any) -> None:
        self._log.append((name, self.number, about))

    def listen(self, now: float) -> None:
        self._note("listen", now)

    def begin_planning(self, now: float) -> None:
        self._note("begin_planning", now)

    def propose(self, now: float, final: Collection[int], peers: PeerTrajectories) -> Plan:
        self._note("propose", now, sorted(final))
        self.peers.append(peers)
        x = 100.0 * self.number + len(self.peers)
        return Plan(states(3, x), states(1, x + 0.5), states(1, x)[:, :4], self._values.pop(0), "explore")

    def follow(self) -> None:
        self._note("follow")

    def send_plan(self, now: float, number: int) -> None:
        self._note("send_plan", now, number)

    def send_views(self, now: float) -> None:
        self._note("send_views", now)


def taken(
    name: str, seed: int, options: TeamOptions = OPTIONS
) -> tuple[list[Any], list[tuple[str, int, Any]], dict[int, Plan]]:
    log: list[tuple[str, int, Any]] = []
    drawn = torch.rand(N, 3, generator=torch.Generator().manual_seed(seed)).tolist()
    agents: list[Any] = [Recorder(number, log, values) for number, values in enumerate(drawn)]
    generator = torch.Generator().manual_seed(seed)
    plans = plan_together(agents, name, options, NOW, NUMBER, generator)
    return agents, log, plans


def calls(log: list[tuple[str, int, Any]], name: str) -> list[tuple[int, Any]]:
    return [(robot, about) for what, robot, about in log if what == name]


@every_coordination
@seeds
def test_all_robots_take_snapshots_before_planning_follow_their_last_proposal_and_send_views(name, seed):
    agents, log, plans = taken(name, seed)
    assert log[:N] == [("begin_planning", robot, (NOW,)) for robot in range(N)]
    assert log[-N:] == [("send_views", robot, (NOW,)) for robot in range(N)]
    assert calls(log, "follow") == [(robot, ()) for robot in plans]
    last = max(row for row, (what, *_) in enumerate(log) if what == "propose")
    assert min(row for row, (what, *_) in enumerate(log) if what == "follow") > last
    assert len(log) == 4 * N + 2 * len(calls(log, "propose"))
    for robot, plan in plans.items():
        assert plan.path[0, 0] == 100 * robot + len(agents[robot].peers)


@every_coordination
@seeds
def test_a_plan_is_sent_once_and_before_later_robots_listen(name: str, seed: int) -> None:
    _, log, plans = taken(name, seed)
    assert sorted(plans) == list(range(N))
    assert calls(log, "send_plan") == [(robot, (NOW, NUMBER)) for robot in plans]
    sent: list[int] = []
    for (what, robot, about), after in itertools.pairwise(log):
        if what == "send_plan":
            sent.append(robot)
        elif what == "listen":
            then, who, (now, fixed) = after
            assert (then, who, now) == ("propose", robot, NOW)  # the next call
            assert fixed == sorted(sent)  # exactly those whose plans it could hear
            assert robot not in fixed
            assert about == (pytest.approx(NOW + len(fixed) * OPTIONS.plan_slack),)
    assert OPTIONS.plan_slack > 2 * OPTIONS.latency


@every_coordination
@seeds
def test_peers_are_where_the_others_may_be(name: str, seed: int) -> None:
    """On the final plan; on the proposed plan, and braking while it may change; or braking without a plan."""
    agents, log, _ = taken(name, seed)
    n_proposed = dict.fromkeys(range(N), 0)
    for robot, (_, fixed) in calls(log, "propose"):
        expected = []
        for other in range(N):
            if other == robot:
                continue
            planned, braking = 100.0 * other + n_proposed[other], -float(other + 1)
            if n_proposed[other]:
                expected.append([planned] * 3 + [planned + 0.5])
            if not n_proposed[other] or (name == "distributed_greedy" and other not in fixed):
                expected.append([braking] * 2)
        peers = agents[robot].peers[n_proposed[robot]]
        assert len(peers) == len(expected)
        for path, xs in zip(peers.paths[:, :, 0].tolist(), expected, strict=True):
            assert path == xs + [xs[-1]] * (len(path) - len(xs))
        assert peers.separation == pytest.approx(2 * OPTIONS.dynamics.radius + 0.25)
        n_proposed[robot] += 1


def test_robots_do_not_wait_for_a_slow_network() -> None:
    _, log, _ = taken("greedy", 0, TeamOptions(size=N, latency=0.4))
    assert {about for _, about in calls(log, "listen")} == {(NOW,)}

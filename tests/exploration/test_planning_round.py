"""A team that plans together: who is asked what, and when, by pilots that write it down."""

from __future__ import annotations

import itertools
from collections.abc import Collection
from typing import Any

import pytest
import torch
from torch import Tensor

from gmmtorch.exploration.mission.options import TeamOptions
from gmmtorch.exploration.planning.coordination import COORDINATIONS, Coordination
from gmmtorch.exploration.planning.peer_trajectories import PeerTrajectories
from gmmtorch.exploration.planning.planner_interface import Plan
from gmmtorch.exploration.planning.planning_round import take_turns

N, NOW, NUMBER = 5, 40.0, 20
OPTIONS = TeamOptions(size=N, latency=0.02, jitter=0.004, margin=0.25)
every_coordination = pytest.mark.parametrize("name", COORDINATIONS)
seeds = pytest.mark.parametrize("seed", range(3))


def states(n: int, x: float) -> Tensor:
    path = torch.zeros(n, 7, dtype=torch.float64)
    path[:, 0] = x
    return path


class Recorder:
    """A pilot whose n-th plan, of robot r, is at x = 100 r + n, its braking ½ further on."""

    def __init__(self, number: int, log: list[tuple[str, int, Any]], values: list[float]) -> None:
        self.number, self._log, self._values = number, log, values
        self.braking = states(2, -float(number + 1))
        self.peers: list[PeerTrajectories] = []

    def _note(self, name: str, *about: Any) -> None:
        self._log.append((name, self.number, about))

    def listen(self, now: float) -> None:
        self._note("listen", now)

    def survey(self, now: float) -> None:
        self._note("survey", now)

    def propose(self, now: float, fixed: Collection[int], peers: PeerTrajectories) -> Plan:
        self._note("propose", now, sorted(fixed))
        self.peers.append(peers)
        x = 100.0 * self.number + len(self.peers)
        return Plan(states(3, x), states(1, x + 0.5), states(1, x)[:, :4], self._values.pop(0), "explore")

    def settle(self) -> None:
        self._note("settle")

    def tell_plan(self, now: float, number: int) -> None:
        self._note("tell_plan", now, number)

    def tell_views(self, now: float) -> None:
        self._note("tell_views", now)


def taken(
    name: str, seed: int, options: TeamOptions = OPTIONS
) -> tuple[list[Recorder], list[tuple[str, int, Any]], dict[int, Plan]]:
    log: list[tuple[str, int, Any]] = []
    drawn = torch.rand(N, 3, generator=torch.Generator().manual_seed(seed)).tolist()
    pilots = [Recorder(number, log, values) for number, values in enumerate(drawn)]
    generator = torch.Generator().manual_seed(seed)
    plans = take_turns(pilots, Coordination(name, 3), options, NOW, NUMBER, generator)
    return pilots, log, plans


def calls(log: list[tuple[str, int, Any]], name: str) -> list[tuple[int, Any]]:
    return [(robot, about) for what, robot, about in log if what == name]


@every_coordination
@seeds
def test_all_look_before_anybody_plans_and_tell_views_when_all_have(name: str, seed: int) -> None:
    _, log, plans = taken(name, seed)
    assert log[:N] == [("survey", robot, (NOW,)) for robot in range(N)]
    assert log[-N:] == [("tell_views", robot, (NOW,)) for robot in range(N)]
    assert calls(log, "settle") == [(robot, ()) for robot in plans]
    last = max(row for row, (what, *_) in enumerate(log) if what == "propose")
    assert min(row for row, (what, *_) in enumerate(log) if what == "settle") > last
    assert len(log) == 4 * N + 2 * len(calls(log, "propose"))


@every_coordination
@seeds
def test_plans_are_told_once_and_before_those_listen_who_plan_after_them(name: str, seed: int) -> None:
    _, log, plans = taken(name, seed)
    assert sorted(plans) == list(range(N))
    assert calls(log, "tell_plan") == [(robot, (NOW, NUMBER)) for robot in plans]
    told: list[int] = []
    for (what, robot, about), after in itertools.pairwise(log):
        if what == "tell_plan":
            told.append(robot)
        elif what == "listen":
            then, who, (now, fixed) = after
            assert (then, who, now) == ("propose", robot, NOW)  # nothing comes between
            assert fixed == sorted(told)  # those whose plans it could hear, and no others
            assert robot not in fixed
            assert about == (pytest.approx(NOW + len(fixed) * OPTIONS.plan_slack),)
    assert OPTIONS.plan_slack > 2 * OPTIONS.latency


@every_coordination
@seeds
def test_everybody_follows_the_last_plan_that_it_proposed(name: str, seed: int) -> None:
    pilots, _, plans = taken(name, seed)
    for robot, plan in plans.items():
        assert plan.path[0, 0] == 100 * robot + len(pilots[robot].peers)


def test_who_plans_after_whom() -> None:
    def fixed(name: str, seed: int = 0) -> list[tuple[int, list[int]]]:
        return [(robot, about[1]) for robot, about in calls(taken(name, seed)[1], "propose")]

    assert fixed("myopic") == [(robot, []) for robot in range(N)]
    assert fixed("greedy") == [(robot, list(range(robot))) for robot in range(N)]
    rounds = Coordination("random_partition", 3).rounds(N, torch.Generator().manual_seed(1))
    before: list[int] = []
    expected = []
    for together in rounds:
        expected += [(robot, sorted(before)) for robot in together]
        before += together
    assert fixed("random_partition", 1) == expected
    # Of five, two are settled, then two, then the last.
    found = fixed("distributed_greedy")
    assert [len(others) for _, others in found] == [0] * 5 + [2] * 3 + [4]


@every_coordination
@seeds
def test_traffic_is_where_the_others_may_be(name: str, seed: int) -> None:
    """On what they settled on; on what they proposed, or as before while that may change; or as before."""
    pilots, log, _ = taken(name, seed)
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
        peers = pilots[robot].peers[n_proposed[robot]]
        assert len(peers) == len(expected)
        for path, xs in zip(peers.paths[:, :, 0].tolist(), expected, strict=True):
            assert path == xs + [xs[-1]] * (len(path) - len(xs))
        assert peers.separation == pytest.approx(2 * OPTIONS.dynamics.radius + 0.25)
        n_proposed[robot] += 1


def test_a_slow_network_is_not_waited_for() -> None:
    _, log, _ = taken("greedy", 0, TeamOptions(size=N, latency=0.4))
    assert {about for _, about in calls(log, "listen")} == {(NOW,)}


def test_a_robot_alone_plans_and_tells() -> None:
    log: list[tuple[str, int, Any]] = []
    pilot = Recorder(0, log, [1.0])
    plans = take_turns([pilot], Coordination("greedy"), OPTIONS, NOW, 3, torch.Generator())
    assert [what for what, *_ in log] == ["survey", "listen", "propose", "settle", "tell_plan", "tell_views"]
    assert list(plans) == [0]
    assert len(pilot.peers[0]) == 0

"""plan_together: the order of calls to recording agents."""

from __future__ import annotations

import itertools
from collections.abc import Collection
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from gmmtorch.team.exploration.mission.options import TeamOptions
from gmmtorch.team.exploration.mission.planning_round import plan_together
from gmmtorch.team.exploration.planning.coordination import COORDINATIONS, Coordination, PeerTrajectories
from gmmtorch.team.exploration.planning.planner_interface import Plan

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
    plans = plan_together(agents, Coordination(name, 3), options, NOW, NUMBER, generator)
    return agents, log, plans


def calls(log: list[tuple[str, int, Any]], name: str) -> list[tuple[int, Any]]:
    return [(robot, about) for what, robot, about in log if what == name]


@every_coordination
@seeds
def test_all_robots_take_snapshots_before_planning_and_send_views_after(name: str, seed: int) -> None:
    _, log, plans = taken(name, seed)
    assert log[:N] == [("begin_planning", robot, (NOW,)) for robot in range(N)]
    assert log[-N:] == [("send_views", robot, (NOW,)) for robot in range(N)]
    assert calls(log, "follow") == [(robot, ()) for robot in plans]
    last = max(row for row, (what, *_) in enumerate(log) if what == "propose")
    assert min(row for row, (what, *_) in enumerate(log) if what == "follow") > last
    assert len(log) == 4 * N + 2 * len(calls(log, "propose"))


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
def test_each_robot_follows_its_last_proposal(name: str, seed: int) -> None:
    agents, _, plans = taken(name, seed)
    for robot, plan in plans.items():
        assert plan.path[0, 0] == 100 * robot + len(agents[robot].peers)


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

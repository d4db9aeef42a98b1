"""Robots that fly by the clock, each in a world of its own."""

from __future__ import annotations

import itertools
import shutil
import time
from typing import Any

import pytest
import torch
from exploration.flying_robots import TEAM, flying, small_room, transports
from exploration.replays import Clock
from hypothesis import given
from hypothesis import strategies as st

from gmmtorch.exploration.mission.flying import FlyingNode, _ahead
from gmmtorch.exploration.mission.node import run_paced
from gmmtorch.exploration.mission.team_setup import make_agent, start_poses
from gmmtorch.exploration.planning.peer_trajectories import PeerTrajectories
from gmmtorch.exploration.world.world import World
from gmmtorch.sharing.journal import Journal
from gmmtorch.sharing.messages.message_registry import PlanMessage, encode_plan
from gmmtorch.sharing.transport.udp import UdpTransport


@pytest.fixture(scope="module")
def world() -> World:
    return small_room()


def plan(n: int, step: float = 0.2, sender: int = 1) -> PlanMessage:
    """To fly along x, a metre a pose."""
    path = torch.zeros(n, 4, dtype=torch.float64)
    path[:, 0] = torch.arange(1, n + 1)
    return PlanMessage(sender, 0, 0.0, step, path, torch.zeros(0, 4))


def test_by_the_clock_they_come_to_hold_the_same_map(world, tmp_path):
    clock = Clock()
    with transports(2) as links:
        nodes = [flying(k, world, TEAM, links[k], incarnation=7 + k) for k in range(2)]
        paced = run_paced(nodes, TEAM.rate, clock=clock, sleep=clock.sleep)
        assert paced.ticks == 4
        end = time.monotonic() + 60
        while nodes[0].agent.digest() != nodes[1].agent.digest() and time.monotonic() < end:
            run_paced(nodes, TEAM.rate, settle=1.0, clock=clock, sleep=clock.sleep)
        assert nodes[0].agent.digest() == nodes[1].agent.digest()
        for node in nodes:
            row = node.row()
            assert row["n_components"] > 0
            assert row["collisions"] == 0
            assert 0 < row["entropy_bits_left"] < row["observable_bits"]
            assert set(node.agent.heard_at) == {1 - node.robot}
            assert row["bytes_sent"] == sum(row["bytes_by_kind"].values())
            assert row["socket_bytes"] == row["wire_bytes"] - 28 * row["datagrams"]
            files = node.files()
            assert set(files) == {"map", "trajectory"}
            for file, write in files.values():
                write(tmp_path / f"{node.robot}_{file}")
            assert "another robot" not in node.status()
        assert sum(node.row()["path_length"] for node in nodes) > 0


# -- what is heard of others' plans ---------------------------------------------------------------


def test_a_teammate_is_where_its_plan_has_it_by_now():
    def xs(age: float, step: float = 0.2, of: float = 0.2) -> list[float]:
        ahead = _ahead(plan(6, of), age, step)
        assert (ahead[:, 1:] == 0).all()
        return ahead[:, 0].tolist()

    assert xs(0.0) == [1, 2, 3, 4, 5, 6]
    assert xs(0.4) == [3, 4, 5, 6]
    assert xs(0.45) == [3, 4, 5, 6]  # 3.25 steps after its begin
    assert xs(0.55) == [4, 5, 6, 6]
    assert xs(1.2) == xs(7.0) == xs(1e9) == [6]
    assert xs(0.0, step=0.4) == [2, 4, 6]
    assert xs(0.1, step=0.2, of=0.4) == [1, 1, 2, 2, 3, 3, 4, 4, 5, 5, 6, 6]


@given(
    n=st.integers(1, 40),
    of=st.floats(0.01, 2.0),
    step=st.floats(0.05, 1.0),
    age=st.floats(0.0, 30.0),
)
def test_it_is_at_most_half_a_step_off(n, of, step, age):
    ahead = _ahead(plan(n, of), age, step)[:, 0]
    times = age + step * torch.arange(1, len(ahead) + 1)
    assert (times[-1] >= n * of - 1e-6) or len(ahead) == 1000
    flown = times <= n * of  # where it is at rest from then on
    first = times < of
    off = (ahead.double() * of - times).abs()
    assert (off[flown & ~first] <= of / 2 + 1e-6).all()
    assert (ahead[first] == 1).all()
    assert (ahead[~flown & (times > (n + 0.5) * of)] == n).all()


def flown_beside(node: FlyingNode, plans: list[PlanMessage], age: float, monkeypatch: Any) -> dict[str, Any]:
    """What a robot plans with, which has heard these plans so many seconds ago."""
    seen: dict[str, Any] = {}
    propose = node.agent.propose

    def noted(now: float, fixed: Any, peers: PeerTrajectories, since: float | None = None) -> Any:
        seen.update(fixed=fixed, peers=peers, since=since)
        return propose(now, fixed, peers, since)

    monkeypatch.setattr(node.agent, "propose", noted)
    for one in plans:
        node.agent.robot.plans[one.sender] = one
        node.agent.heard_at[one.sender] = 50.0 - age
    node.tick(50.0)
    return seen


def test_it_plans_around_what_it_has_heard(world, monkeypatch):
    with transports(1) as (link,):
        node = flying(0, world, TEAM, link)
        told = [plan(10, sender=4), plan(3, sender=2)]
        seen = flown_beside(node, told, 0.4, monkeypatch)
        paths = seen["peers"].paths
        assert paths[..., 0].tolist() == [[3.0] * 8, [3, 4, 5, 6, 7, 8, 9, 10]]
        assert seen["peers"].separation == pytest.approx(0.7)
        assert sorted(seen["fixed"]) == [2, 4]
        assert seen["since"] == 48.0


@pytest.mark.parametrize("strange", [plan(0), plan(1, 1e-3), plan(1000, 1e15), plan(1000, 1e-3)])
@pytest.mark.parametrize("age", [0.0, 1e6])
def test_strange_plans_do_not_end_it(world, monkeypatch, strange, age):
    with transports(1) as (link,):
        node = flying(0, world, TEAM, link)
        seen = flown_beside(node, [strange], age, monkeypatch)
        assert len(seen["peers"]) == (len(strange.path) > 0)
        assert seen["peers"].paths.shape[1] <= 1000


def test_views_are_told_as_often_as_it_plans_and_no_more(world, monkeypatch):
    with transports(1) as (link,):
        node, told = flying(0, world, TEAM, link), []
        monkeypatch.setattr(node.agent, "tell_views", told.append)
        for k in range(1000):  # every 20 ms
            node.listen(0.02 * k)
        assert len(told) == 9
        assert all(1.99 < b - a < 2.03 for a, b in itertools.pairwise([0.0, *told]))
        for now in (30.0, 0.0, 1.0, 0.0, 1.1, 1.2):  # a clock that is set back stands still
            node.listen(now)
        assert told[9:] == [30.0, 1.1]


# -- trouble --------------------------------------------------------------------------------------


def test_another_robot_of_its_number_is_named(world, monkeypatch):
    monkeypatch.setattr("gmmtorch.sharing.transport.sessions.FRESH_SECONDS", 0.1)
    path = plan(4).path
    with UdpTransport.unicast(0) as link, UdpTransport.unicast(0, peers=[link.address]) as other:
        node = flying(0, world, TEAM, link)
        assert node.twin is None
        end = time.monotonic() + 20
        while node.twin is None and time.monotonic() < end:
            other.send(0, encode_plan(0, 0, 0.0, 0.2, path), 0.0, "plans")
            node.listen(0.0)
            time.sleep(0.01)
        assert f"robot 0 (127.0.0.1:{other.address[1]}" in str(node.twin)
        assert "id=" in str(node.twin)
        assert "another robot 0 is there" in node.status()
        assert node.row()["refused"].keys() == {"duplicate_id"}


def test_started_again_it_knows_what_it_knew(world, tmp_path):
    def started(folder: str, incarnation: int) -> FlyingNode:
        link = UdpTransport.unicast(0)
        agent = make_agent(0, start_poses(world, TEAM)[0], world, TEAM, link, incarnation=incarnation)
        return FlyingNode(agent, world, TEAM, link, Journal(tmp_path / folder, agent.robot.mapper.shared))

    first = started("first", 5)
    for now in range(3):
        first.tick(float(now))
    shutil.copytree(tmp_path / "first", tmp_path / "again")  # as it would be left by one that is killed
    knew = first.agent.robot.mapper
    again = started("again", 6)
    knows = again.agent.robot.mapper
    assert knows.digest() == knew.digest()
    assert knows.belief.entropy_bits == pytest.approx(knew.belief.entropy_bits)
    again.tick(0.0)
    assert not knew.held - knows.held
    assert again.row()["incarnation"] != first.row()["incarnation"]
    for node in (first, again, again):
        node.close()

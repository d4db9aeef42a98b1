"""Missions of one robot each, by the wall clock, over UDP."""

from __future__ import annotations

import itertools
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
import torch
from exploration.replays import FakeTime, Together
from exploration.rooms import small_room

from gmmtorch.simulation.sensors.depth_camera import DepthCamera
from gmmtorch.team.exploration.mission.driver import Stopwatch, WallClock, drive, settle
from gmmtorch.team.exploration.mission.mission import Mission
from gmmtorch.team.exploration.mission.options import TeamOptions
from gmmtorch.team.exploration.mission.robot_view import DuplicateIdError, FlyingRobotView
from gmmtorch.team.exploration.mission.team_setup import make_agent, start_poses
from gmmtorch.team.exploration.planning.coordination import PeerTrajectories
from gmmtorch.team.exploration.world.world import World
from gmmtorch.team.sharing.messages.message_registry import PlanMessage, encode_plan
from gmmtorch.team.sharing.replica.replica import Replica
from gmmtorch.team.sharing.store import Store
from gmmtorch.team.sharing.transport.udp import UdpTransport

TEAM = TeamOptions(
    size=2,
    duration=4.0,
    camera=DepthCamera(width=48, height=36, max_range=4.0),
    window=(64, 64, 32),
    sample_every=2.0,
    n_beams=40,
    latency=0.0,
)


@contextmanager
def transports(n: int, **options: Any) -> Iterator[list[UdpTransport]]:
    """Transports that all send to one another."""
    with ExitStack() as stack:
        made = [stack.enter_context(UdpTransport.unicast(k, **options)) for k in range(n)]
        for one in made:
            one.peers = [other.address for other in made if other is not one]
        yield made


def mission_of(
    number: int, world: World, options: TeamOptions, transport: UdpTransport, **about: Any
) -> Mission:
    """The mission of one robot. about: an incarnation."""
    watch, pose = Stopwatch(), start_poses(world, options)[number]
    agent = make_agent(number, pose, world, options, transport, watch=watch, **about)
    return Mission(world, [agent], options, watch)


@pytest.fixture(scope="module")
def world() -> World:
    return small_room()


def plan(n: int, step: float = 0.2, sender: int = 1) -> PlanMessage:
    """A plan of n poses along x, one metre apart."""
    path = torch.zeros(n, 4, dtype=torch.float64)
    path[:, 0] = torch.arange(1, n + 1)
    return PlanMessage(sender, 0, 0.0, step, path, torch.zeros(0, 4))


def test_two_processes_hold_the_map_of_one_process_that_received_everything(world, tmp_path, monkeypatch):
    fake, observer = FakeTime(), Replica(9, dim=3)
    clock = WallClock(clock=fake, sleep=fake.sleep)
    send = UdpTransport.send

    def observed(self: UdpTransport, sender: int, datagrams: Any, now: float, kind: str) -> None:
        send(self, sender, datagrams, now, kind)
        for datagram in datagrams:
            observer.receive(datagram)

    monkeypatch.setattr(UdpTransport, "send", observed)
    with transports(2) as links:
        missions = [mission_of(k, world, TEAM, links[k], incarnation=7 + k) for k in range(2)]
        agents = [mission.agents[0] for mission in missions]
        assert drive(Together(*missions), clock).ticks == 4

        def are_equal() -> bool:
            return agents[0].digest() == agents[1].digest()

        settle(Together(*missions), WallClock(), 60.0, stop=are_equal)
        assert are_equal()
        assert agents[0].robot.mapper.shared.digest() == observer.digest()
        views = [FlyingRobotView(*pair) for pair in zip(missions, links, strict=True)]
        for view, agent in zip(views, agents, strict=True):
            view.check_id()
            row = view.row()
            assert row["n_components"] > 0
            assert row["collisions"] == 0
            assert 0 < row["entropy_bits_left"] < row["observable_bits"]
            assert set(agent.heard_at) == {1 - view.robot}
            assert row["bytes_sent"] == sum(row["bytes_by_kind"].values())
            assert row["socket_bytes"] == row["wire_bytes"] - 28 * row["datagrams"]
            assert view.scalars()["records"] == row["n_records"]
            files = view.files()
            assert set(files) == {"map", "trajectory"}
            for file, write in files.values():
                write(tmp_path / f"{view.robot}_{file}")
            assert "another robot" not in view.status()
        assert sum(view.row()["path_length"] for view in views) > 0


# -- plans that were heard --------------------------------------------------------------------------------


def planned_beside(
    mission: Mission, plans: list[PlanMessage], age: float, monkeypatch: pytest.MonkeyPatch
) -> dict[str, Any]:
    """The inputs of the planner of a robot that heard these plans `age` seconds ago."""
    (agent,), seen = mission.agents, {}
    propose = agent.propose

    def noted(now: float, final: Any, peers: PeerTrajectories, since: float | None = None) -> Any:
        seen.update(final=final, peers=peers, since=since)
        return propose(now, final, peers, since)

    monkeypatch.setattr(agent, "propose", noted)
    for one in plans:
        agent.robot.plans[one.sender] = one
        agent.heard_at[one.sender] = 50.0 - age
    mission.tick(50.0)
    return seen


def test_a_robot_avoids_the_paths_that_it_has_heard(world, monkeypatch):
    with transports(1) as (link,):
        heard = [plan(10, sender=4), plan(3, sender=2)]
        seen = planned_beside(mission_of(0, world, TEAM, link), heard, 0.4, monkeypatch)
    assert seen["peers"].paths[..., 0].tolist() == [[3.0] * 8, [3, 4, 5, 6, 7, 8, 9, 10]]
    assert seen["peers"].separation == pytest.approx(0.7)
    assert sorted(seen["final"]) == [2, 4]
    assert seen["since"] == 48.0


@pytest.mark.parametrize("strange", [plan(0), plan(1, 1e-3), plan(1000, 1e15), plan(1000, 1e-3)])
@pytest.mark.parametrize("age", [0.0, 1e6])
def test_strange_plans_do_not_end_a_mission(world, monkeypatch, strange, age):
    with transports(1) as (link,):
        seen = planned_beside(mission_of(0, world, TEAM, link), [strange], age, monkeypatch)
    assert len(seen["peers"]) == (len(strange.path) > 0)
    assert seen["peers"].paths.shape[1] <= 1000


def test_views_are_sent_once_every_planning_period(world, monkeypatch):
    with transports(1) as (link,):
        mission, sent = mission_of(0, world, TEAM, link), []
        monkeypatch.setattr(mission.agents[0], "send_views", sent.append)
        for k in range(500):
            mission.exchange(0.04 * k)
    assert len(sent) == 9
    assert all(1.99 < b - a < 2.05 for a, b in itertools.pairwise([0.0, *sent]))


# -- duplicate ids, and restarts --------------------------------------------------------------------------


def test_a_duplicate_id_is_reported_with_its_address(world, monkeypatch):
    monkeypatch.setattr("gmmtorch.team.sharing.transport.sessions.FRESH_SECONDS", 0.1)
    path = plan(4).path
    with UdpTransport.unicast(0) as link, UdpTransport.unicast(0, peers=[link.address]) as other:
        mission = mission_of(0, world, TEAM, link)
        view = FlyingRobotView(mission, link)
        view.check_id()

        def is_reported() -> bool:
            other.send(0, encode_plan(0, 0, 0.0, 0.2, path), 0.0, "plans")
            return bool(link.duplicates)

        settle(mission, WallClock(), 20.0, stop=is_reported)
        with pytest.raises(DuplicateIdError, match=rf"robot 0 \(127.0.0.1:{other.address[1]}.*id="):
            view.check_id()
        assert "another robot has id 0" in view.status()
        assert view.row()["refused"].keys() == {"duplicate_id"}


def test_a_restarted_robot_has_its_map(world, tmp_path):
    with transports(2) as links:

        def started(folder: Path, number: int) -> Mission:
            mission = mission_of(0, world, TEAM, links[number], incarnation=5 + number)
            store = Store(folder / "robot.sqlite", 0)
            store.restore(mission.agents[0].robot.mapper.shared)
            mission.agents[0].keep_in(store)
            return mission

        links[1] = links[0]
        first = started(tmp_path / "first", 0)
        for now in range(3):
            first.tick(float(now))
        shutil.copytree(tmp_path / "first", tmp_path / "again")  # what the death of its process leaves
        again = started(tmp_path / "again", 1)
        before, after = (mission.robots[0].mapper for mission in (first, again))
        assert after.shared.digest() == before.shared.digest()
        assert after.belief.entropy_bits == pytest.approx(before.belief.entropy_bits)
        again.tick(0.0)
        assert not before.shared.held - after.shared.held

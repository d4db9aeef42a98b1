"""ReplayMission over sockets, and with robots that are killed and restarted."""

from __future__ import annotations

import json
import random
import shutil
import sqlite3
from collections.abc import Callable

import pytest
from exploration.replays import RULES, Together, content, killed, log, mapped, part, robot, run, stored
from hypothesis import given, settings
from hypothesis import strategies as st
from own_process import answer_of

from gmmtorch.errors import DataError
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.team.exploration.mission.driver import WallClock, settle
from gmmtorch.team.exploration.mission.replay import ReplayMission
from gmmtorch.team.exploration.mission.robot_view import DuplicateIdError, ReplayingRobotView
from gmmtorch.team.sharing.replica.replica import Replica
from gmmtorch.team.sharing.transport.security import TeamKey
from gmmtorch.team.sharing.transport.simulated_network import Network
from gmmtorch.team.sharing.transport.udp import UdpTransport

N_KILLS = 4
"""`python -m exploration.kill_replay` takes more."""


def until(condition: Callable[[], bool], *missions: ReplayMission) -> None:
    """Lets robots exchange messages in real time, for at most a minute without news."""
    settle(Together(*missions), WallClock(), 60.0, stop=condition)
    assert condition()


# -- over sockets ----------------------------------------------------------------------------------


@pytest.mark.parametrize("key", [None, TeamKey(bytes(range(32)))])
def test_robots_share_over_udp(key):
    transports = [UdpTransport.unicast(k, key=key) for k in range(3)]
    for transport in transports:
        transport.peers = [other.address for other in transports if other is not transport]
    parts = [part(k, 3, 12) for k in range(3)]
    team = [robot(k, parts[k], transports[k], announce_every=0.1, rate=100.0) for k in range(3)]
    run(*team, clock=WallClock())
    until(lambda: len({mission.replica.digest() for mission in team}) == 1, *team)
    alone = [mapped("windowed", one).components() for one in parts]
    assert content(team[2].replica.components()) == content(*alone)
    for mission, transport in zip(team, transports, strict=True):
        row = ReplayingRobotView(mission, transport).row()
        assert json.loads(json.dumps(row, allow_nan=False)) == row
        assert row["socket_datagrams"] == 2 * row["datagrams"]
        assert 2 * row["wire_bytes"] == row["socket_bytes"] + 28 * row["socket_datagrams"]
        assert row["refused"] == row["failures"] == {}
        transport.close()


def test_a_robot_without_network_continues_and_catches_up_later():
    transports = [UdpTransport.unicast(k) for k in range(2)]
    team = [robot(k, part(k, 2, 8), transports[k], announce_every=0.05, rate=200.0) for k in range(2)]
    transports[0].peers = [("127.0.0.1", 9)]  # no process listens there
    run(*team, clock=WallClock())
    assert all(mission.is_over for mission in team)
    assert team[0].replica.digest() != team[1].replica.digest()
    transports[0].peers, transports[1].peers = [transports[1].address], [transports[0].address]
    until(lambda: team[0].replica.digest() == team[1].replica.digest(), *team)
    for transport in transports:
        transport.close()


def has_duplicate(view: ReplayingRobotView) -> bool:
    try:
        view.check_id()
    except DuplicateIdError:
        return True
    return False


def test_duplicate_ids_are_detected_over_udp(monkeypatch):
    monkeypatch.setattr("gmmtorch.team.sharing.transport.sessions.FRESH_SECONDS", 0.1)
    transports = [UdpTransport.unicast(5) for _ in range(2)]
    team = [robot(5, part(k, 2, 8), transports[k], announce_every=0.05, rate=200.0) for k in range(2)]
    views = [ReplayingRobotView(*pair) for pair in zip(team, transports, strict=True)]
    assert not any(map(has_duplicate, views))
    transports[0].peers, transports[1].peers = [transports[1].address], [transports[0].address]
    until(lambda: all(map(has_duplicate, views)), *team)
    for view, transport, other in zip(views, transports, reversed(transports), strict=True):
        with pytest.raises(DuplicateIdError, match=f"robot 5.*{other.address[1]}.*folder"):
            view.check_id()
        assert "another robot has id 5" in view.status()
        assert list(view.row()["namesakes"]) == ["5"]
        transport.close()


class _ByPlace(Network):
    """A network that identifies robots by their place, whatever their ids."""

    def __init__(self, network: Network, place: int) -> None:
        super().__init__(6)
        self._network, self._place = network, place

    def send(self, sender, datagrams, now, kind):
        self._network.send(self._place, datagrams, now, kind)

    def deliver(self, robot, now):
        return self._network.deliver(self._place, now)


def test_duplicate_ids_are_detected_from_records_alone():
    network = Network(2)
    places = [_ByPlace(network, k) for k in range(2)]
    team = [ReplayMission(Replica(5), part(k, 2, 8), places[k], GaussianMap, rate=10.0) for k in range(2)]
    run(*team, quiet=5.0)
    views = [ReplayingRobotView(*pair) for pair in zip(team, places, strict=True)]
    assert all(map(has_duplicate, views))
    assert views[0].row()["conflicts"].keys() == {"5"}


# -- killed and restarted --------------------------------------------------------------------------


@settings(max_examples=3)
@given(rule=st.sampled_from(sorted(RULES)), seed=st.integers(0, 10**6))
def test_a_robot_killed_between_any_ticks_ends_with_the_map_of_one_that_lived(tmp_path_factory, rule, seed):
    rng, folder, network = random.Random(seed), tmp_path_factory.mktemp("robot") / "0", Network(2)
    listener, now, lives = robot(1, [], network), 0.0, 0
    while True:
        mission = stored(folder, log(16), network, rule, keep_every=5)
        left = rng.randint(1, 12)
        lives += 1
        while left and not mission.is_over:
            mission.tick(now)
            if rng.random() < 0.7:
                listener.exchange(now)
            now, left = now + 0.1, left - 1
        if mission.is_over:
            break
        folder = killed(folder)
        assert lives < 60  # each life reads at most five scans and a window again
    assert lives > 1
    for _ in range(100):
        now += 0.5
        mission.exchange(now)
        listener.exchange(now)
    assert content(mission.replica.components()) == content(mapped(rule, log(16)).components())
    assert listener.replica.digest() == mission.replica.digest()


def test_published_components_stay_while_a_restarted_robot_catches_up(tmp_path):
    """Its saved map is older than what it published: it publishes nothing before it is as far as it was."""
    network, options = Network(1), {"rule": "incremental", "keep_every": 9}  # windows of three
    first = stored(tmp_path / "0", log(24), network, **options)
    for tick in range(17):
        first.tick(tick / 10)
    mission = stored(killed(tmp_path / "0"), log(24), network, **options)
    assert mission.resumed_at == 9
    assert mission.replica.incarnation != first.replica.incarnation
    expected = {n: content(mapped("incremental", log(24)[:n]).components()) for n in (15, 18)}
    for position in range(10, 20):
        mission.tick(position / 10)
        assert content(mission.replica.components()) == expected[15 if position < 18 else 18]


def test_if_the_last_progress_is_damaged_the_one_before_is_used(tmp_path):
    first = stored(tmp_path / "0", log(24), Network(1), "incremental", keep_every=6)
    for tick in range(17):
        first.tick(tick / 10)
    left = killed(tmp_path / "0")
    with sqlite3.connect(left / "robot.sqlite") as db:
        db.execute("UPDATE progress SET state = x'00' WHERE scans = 12")
    db.close()
    mission = stored(left, log(24), Network(1), "incremental", keep_every=6)
    assert mission.resumed_at == 6
    published = content(mapped("incremental", log(24)[:15]).components())
    for position in range(7, 18):
        mission.tick(position / 10)
        assert content(mission.replica.components()) == published
    run(mission)
    assert content(mission.replica.components()) == content(mapped("incremental", log(24)).components())


def test_a_robot_that_lost_its_disk_starts_again_and_its_records_come_back(tmp_path):
    network = Network(2)
    first, teammate = stored(tmp_path / "a", log(24), network, "incremental"), robot(1, [], network)
    for tick in range(16):
        first.tick(tick / 10)
        teammate.exchange(tick / 10)
    published = content(teammate.replica.components())
    assert published == content(mapped("incremental", log(24)[:15]).components())
    mission = stored(tmp_path / "b", log(24), network, "incremental", announce_every=0.2)
    for step in range(100):
        mission.exchange(3.0 + step / 10)
        teammate.exchange(3.0 + step / 10)
    assert content(mission.replica.components()) == published
    now = 100.0
    while not mission.is_over:
        now += 0.1
        mission.tick(now)
        here = content(mission.replica.components())
        assert mission.position > 15 or not published - here
        assert mission.map.n_pending or not content(mission.map.components()) - here
    run(mission, teammate, quiet=5.0)
    expected = content(mapped("incremental", log(24)).components())
    assert content(mission.replica.components()) == content(teammate.replica.components()) == expected


@pytest.mark.parametrize("n_ticks", [3, 6])
def test_a_stopped_robot_continues(tmp_path, n_ticks):
    mission = stored(tmp_path / "0", log(6), Network(1), "per_scan", keep_every=1)
    for tick in range(n_ticks):
        mission.tick(tick / 10)
    again = stored(killed(tmp_path / "0"), log(6), Network(1), "per_scan", keep_every=1)
    assert again.resumed_at == n_ticks
    assert again.replica.digest() == mission.replica.digest()
    run(again)
    assert content(again.replica.components()) == content(mapped("per_scan", log(6)).components())
    assert (again.replica.digest() == mission.replica.digest()) == (n_ticks == 6)  # nothing is repeated


def test_progress_of_another_log_or_rule_is_rejected(tmp_path):
    run(stored(tmp_path / "0", log(6), Network(1)))
    for name, scans, rule in (("n_scans", log(7), "windowed"), ("learning", log(6), "per_scan")):
        with pytest.raises(DataError, match=rf"\({name} differ\)"):
            stored(killed(tmp_path / "0"), scans, Network(1), rule)
        shutil.rmtree(tmp_path / "0+")


@pytest.mark.slow
def test_the_process_of_a_robot_is_killed():
    """In its own process, as it forks; see `kill_replay`."""
    found = answer_of("exploration.kill_replay", N_KILLS)
    assert found["kills"] == N_KILLS
    assert all(made["lost"] == made["doubled"] == 0 for made in found["robots"])

"""ReplayMission: the team's map holds what each robot learns, over sockets, kills and restarts."""

from __future__ import annotations

import functools
import json
import logging
import random
import resource
import shutil
import sqlite3
from collections.abc import Callable

import pytest
import torch
from exploration.replays import RULES, Together, content, killed, log, mapped, part, robot, run, stored
from hypothesis import given, settings
from hypothesis import strategies as st
from own_process import answer_of

from gmmtorch import GaussianMap, GmmTorchError, IncrementalRule, Scan
from gmmtorch.datasets import DatasetShard, load, shard_indices, start_frame
from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.team.exploration import ReplayingRobotView, ReplayMission, WallClock, settle
from gmmtorch.team.sharing import FrameJoiner, Network, Replica, TeamKey, UdpTransport
from gmmtorch.team.sharing.transport.simulated_network import LinkConditions


def n_missing(mission: ReplayMission) -> int:
    return mission.replica.missing.size


# -- a team ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("rule", sorted(RULES))
def test_all_robots_hold_what_each_would_learn_alone(rule):
    network = Network(3)
    parts = [part(k, 3, 15) for k in range(3)]
    team = [robot(k, parts[k], network, rule) for k in range(3)]
    done = run(*team, quiet=1.0)
    assert (done.ticks, done.late) == (5, 0)
    assert len({mission.replica.digest() for mission in team}) == 1
    alone = [mapped(rule, one).components() for one in parts]
    assert content(team[1].replica.components()) == content(*alone)
    assert all(mission.is_over and n_missing(mission) == 0 for mission in team)


@pytest.mark.parametrize("budget", [None, 2000.0])
def test_losses_of_the_network_are_repaired(budget):
    network = Network(3, LinkConditions(loss=0.3, duplication=0.1, latency=0.05, jitter=0.1), seed=3)
    parts = [part(k, 3, 12) for k in range(3)]
    team = [robot(k, parts[k], network, "incremental", budget=budget) for k in range(3)]
    run(*team, quiet=20.0)
    assert network.reception().lost > 10
    assert len({mission.replica.digest() for mission in team}) == 1
    alone = [mapped("incremental", one).components() for one in parts]
    assert content(team[0].replica.components()) == content(*alone)


@pytest.mark.slow
def test_robots_without_known_starts_share_a_map_in_one_frame():
    scans, network = load("synthetic_building_2d", n_scans=60), Network(2)
    team, frames = [], []
    for number, chosen in enumerate((range(50), range(10, 60))):
        frames.append(start_frame(scans, chosen[0]))
        replica = Replica(number, own_frame=True)
        own = DatasetShard(scans, chosen, torch.linalg.inv(frames[-1]))
        make_map = functools.partial(GaussianMap, window=10, robot=number)
        joiner = FrameJoiner(replica)
        team.append(ReplayMission(replica, own, network, make_map, rate=10.0, joiner=joiner))
    run(*team, quiet=20.0)
    one, two = (mission.replica for mission in team)
    assert one.digest() == two.digest()
    found = ReplayingRobotView(team[1], network).row()["frame"]
    assert found["of_robot"] == 0
    truth = torch.linalg.inv(frames[0]) @ frames[1]
    assert torch.allclose(torch.tensor(found["transform"], dtype=torch.float64), truth, atol=0.05)
    assert len(one.components()) == one.n_components == len(two.components())


def test_a_window_is_published_once_its_components_are_final():
    mission = robot(0, part(0, 1, 6), Network(2))  # windows of four
    counts = []
    for tick in range(7):
        mission.tick(tick / 10)
        counts.append(mission.replica.n_components)
        assert mission.is_over == (tick >= 5)
    assert counts[:3] == [0, 0, 0]
    assert 0 < counts[3] == counts[4] < counts[5] == counts[6]
    assert content(mission.replica.components()) == content(mapped("windowed", part(0, 1, 6)).components())


@pytest.mark.parametrize("n_scans", [0, 1, 5])
def test_a_stream_of_unknown_length_gives_the_map_of_a_list(n_scans):
    network = Network(1)
    mission = robot(0, iter(log(5)[:n_scans]), network)
    assert mission.n_scans is None
    assert "/?" in ReplayingRobotView(mission, network).status()
    assert run(mission).ticks == n_scans + 1  # the last tick finds the end
    assert (mission.n_scans, mission.position) == (n_scans, n_scans)
    expected = mapped("windowed", log(5)[:n_scans])
    assert content(mission.replica.components()) == (content(expected.components()) if n_scans else content())


# -- trouble ---------------------------------------------------------------------------------------


def test_a_full_disk_is_logged_once_and_everything_is_kept_once_there_is_room(tmp_path, caplog):
    network = Network(2)
    mission = stored(tmp_path / "0", log(24), network, "per_scan", keep_every=2)
    listener = robot(1, [], network)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200, limits[1]))  # the kernel refuses to let files grow
    try:
        with caplog.at_level(logging.WARNING):
            for tick in range(10):
                mission.tick(tick / 10)
                listener.exchange(tick / 10 + 0.09)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert listener.replica.digest() == mission.replica.digest()
    assert ReplayingRobotView(mission, network).row()["unkept"] > 3
    assert caplog.text.count("is no longer written") == 1
    run(mission, listener, quiet=1.0)
    assert "is written again" in caplog.text
    again = stored(killed(tmp_path / "0"), log(24), Network(1), "per_scan", keep_every=2)
    assert again.replica.digest() == mission.replica.digest()
    assert again.resumed_at == 24


def test_a_scan_that_cannot_be_read_is_left_out_and_logged_once(caplog):
    class Damaged(DatasetShard):
        def __getitem__(self, index):
            if index in (2, 5):
                raise DataError(f"scan {index} is damaged")
            return super().__getitem__(index)

    mission = robot(0, Damaged(log(8), range(8)), Network(1), "per_scan")
    run(mission)
    assert (mission.n_unread, mission.position) == (2, 8)
    assert caplog.text.count("is damaged") == 1
    whole = [scan for index, scan in enumerate(log(8)) if index not in (2, 5)]
    assert content(mission.replica.components()) == content(mapped("per_scan", whole).components())


def test_a_scan_of_another_dimension_is_an_error():
    mission = robot(0, [*log(4), Scan([[1.0, 2.0, 3.0]], [0.0, 0.0, 0.0])], Network(1), "per_scan")
    with pytest.raises(InvalidArgumentError, match="3-dimensional"):
        run(mission)
    assert content(mission.replica.components()) == content(mapped("per_scan", log(4)).components())


@pytest.mark.parametrize(
    "options", [{"announce_every": 0.0}, {"budget": 0.0}, {"keep_every": 0}, {"rate": 0.0}]
)
def test_bad_options_are_rejected_by_name(options):
    with pytest.raises(InvalidArgumentError, match=next(iter(options))):
        robot(0, [], Network(1), **options)


# -- the view of the robot -------------------------------------------------------------------------


def test_row_and_scalars_agree_with_the_network():
    network = Network(2, LinkConditions(loss=0.2))
    team = [robot(k, part(k, 2, 8), network) for k in range(2)]
    run(*team, quiet=3.0)
    for k, mission in enumerate(team):
        view, sent = ReplayingRobotView(mission, network), network.traffic(k)
        row, scalars = view.row(), view.scalars()
        assert row["bytes_sent"] == scalars["bytes_sent"] == sent.bytes
        assert sum(row["bytes_by_kind"].values()) == sent.bytes
        assert row["wire_bytes"] == scalars["wire_bytes_sent"] == sent.bytes + 28 * sent.datagrams
        assert row["heard"] == network.reception(k).datagrams
        assert row["digest"] == mission.replica.digest().hex()
        assert row["n_components"] == scalars["components"] == len(mission.replica.components())
        assert json.loads(json.dumps(row, allow_nan=False)) == row
        assert all(isinstance(value, float) for value in scalars.values())
        assert "scan 4/4" in view.status()


def test_files_are_the_team_map_and_the_own_map(tmp_path):
    network = Network(2)
    team = [robot(k, part(k, 2, 8), network) for k in range(2)]
    run(*team, quiet=2.0)
    files = ReplayingRobotView(team[0], network).files()
    paths = {name: tmp_path / file for name, (file, _) in files.items()}
    for name, (_, write) in files.items():
        write(paths[name])
    assert content(GaussianMap.load(paths["map"]).components()) == content(team[1].replica.components())
    assert content(GaussianMap.load(paths["own_map"]).components()) == content(team[0].map.components())
    assert ReplayingRobotView(robot(0, [], Network(1)), Network(1)).files() == {}


@pytest.mark.real_data
def test_a_real_log(real_data):
    scans = load("carmen", real_data / "laser2d" / "intel.log.gz")
    network, rule = Network(3, LinkConditions(loss=0.3)), IncrementalRule(window=5)
    parts = [DatasetShard(scans, list(shard_indices(30, k, 3))) for k in range(3)]
    team = [
        ReplayMission(Replica(k), parts[k], network, lambda: GaussianMap(rule), rate=10.0) for k in range(3)
    ]
    run(*team, quiet=15.0)
    assert len({mission.replica.digest() for mission in team}) == 1
    alone = []
    for scans_of_one in parts:
        made = GaussianMap(rule)
        for scan in scans_of_one:
            made.insert(scan)
        alone.append(made.components())
    assert content(team[0].replica.components()) == content(*alone)


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


def has_duplicate(view: ReplayingRobotView) -> bool:
    try:
        view.check_id()
    except GmmTorchError:
        return True
    return False


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

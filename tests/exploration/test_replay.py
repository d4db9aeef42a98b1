"""ReplayMission: the team's map holds what each robot learns from its scans."""

from __future__ import annotations

import functools
import json
import logging
import random
import resource

import pytest
import torch
from exploration.replays import RULES, content, killed, log, mapped, part, robot, run, stored

from gmmtorch.datasets import load
from gmmtorch.datasets.base import DatasetShard, shard_indices, start_frame
from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.mapping.learning.rules import IncrementalRule
from gmmtorch.scan import Scan
from gmmtorch.team.exploration.mission.replay import ReplayMission
from gmmtorch.team.exploration.mission.robot_view import ReplayingRobotView
from gmmtorch.team.sharing.frame_joiner import FrameJoiner
from gmmtorch.team.sharing.replica.replica import Replica
from gmmtorch.team.sharing.transport.link_conditions import LinkConditions
from gmmtorch.team.sharing.transport.simulated_network import Network


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


def test_jumping_clocks_do_not_change_the_map():
    network, rng = Network(2), random.Random(0)
    team = [robot(k, part(k, 2, 8), network) for k in range(2)]
    for _ in range(60):
        now = rng.choice([0.0, 1e9, rng.uniform(0, 100)])
        for mission in team:
            (mission.exchange if mission.is_over else mission.tick)(now)
    for tick in range(200):
        for mission in team:
            mission.exchange(1e9 + tick)
    assert team[0].replica.digest() == team[1].replica.digest()


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

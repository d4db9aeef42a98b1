"""ReplayNode: the team's map is what each robot would make of its scans alone, whatever happens to it."""

from __future__ import annotations

import json
import logging
import os
import random
import resource
import subprocess
import sys
import time
from pathlib import Path

import pytest
from exploration.replays import RULES, Clock, content, log, mapped
from hypothesis import given, settings
from hypothesis import strategies as st

from gmmtorch.datasets import load
from gmmtorch.datasets.dataset_shard import DatasetShard, shard_indices
from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.exploration.mission.node import TwinError, check_number, run_paced
from gmmtorch.exploration.mission.replay import ReplayNode
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.mapping.learning.rules import IncrementalRule
from gmmtorch.scan import Scan
from gmmtorch.sharing.journal import Journal
from gmmtorch.sharing.replica.replica import Replica
from gmmtorch.sharing.transport.link_conditions import LinkConditions
from gmmtorch.sharing.transport.security import TeamKey
from gmmtorch.sharing.transport.simulated_network import Network
from gmmtorch.sharing.transport.udp import UdpTransport

N_KILLS = 4
"""`python -m exploration.kill_replay` has more."""


def part(k: int, n: int, n_scans: int = 24) -> DatasetShard:
    return DatasetShard(log(n_scans), shard_indices(n_scans, k, n))


def robot(number: int, scans, transport, rule: str = "windowed", **options) -> ReplayNode:
    return ReplayNode(Replica(number), scans, transport, lambda: GaussianMap(RULES[rule]), **options)


def kept(folder: Path, scans, transport, rule: str = "windowed", number: int = 0, **options) -> ReplayNode:
    """A robot with a journal and a folder."""
    replica = Replica(number)
    return ReplayNode(
        replica,
        scans,
        transport,
        lambda: GaussianMap(RULES[rule]),
        journal=Journal(folder / "journal", replica),
        folder=folder,
        **options,
    )


def run(*nodes: ReplayNode, settle: float = 0.0, **options):
    clock = Clock()
    return run_paced(nodes, 10.0, settle=settle, clock=clock, sleep=clock.sleep, **options)


def kill(node: ReplayNode) -> None:
    """All that the death of its process does to it."""
    node._logbook._journal.close()  # which writes nothing


# -- a team ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rule", sorted(RULES))
def test_all_hold_what_each_would_have_learned_alone(rule):
    network = Network(3)
    nodes = [robot(k, part(k, 3), network, rule) for k in range(3)]
    done = run(*nodes, settle=1.0)
    assert (done.ticks, done.late) == (8, 0)
    assert len({node.replica.digest() for node in nodes}) == 1
    alone = [mapped(rule, part(k, 3)).components() for k in range(3)]
    assert content(nodes[1].replica.components()) == content(*alone)
    assert all(node.is_over and node.n_missing == 0 for node in nodes)


@pytest.mark.parametrize("budget", [None, 2000.0])
def test_what_a_bad_network_loses_comes_again(budget):
    network = Network(3, LinkConditions(loss=0.3, duplication=0.1, latency=0.05, jitter=0.1), seed=3)
    nodes = [robot(k, part(k, 3), network, "incremental", budget=budget) for k in range(3)]
    run(*nodes, settle=20.0)
    assert network.reception().lost > 10
    assert len({node.replica.digest() for node in nodes}) == 1
    alone = [mapped("incremental", part(k, 3)).components() for k in range(3)]
    assert content(nodes[0].replica.components()) == content(*alone)


def test_a_budget_holds_and_delays_only():
    network, rate = Network(2), 300.0
    node = robot(0, part(0, 1), network, "per_scan", budget=rate)
    clock = Clock()

    def spent(_, now):
        records = network.traffic(0).bytes - network.traffic(0, "announcements").bytes
        assert records <= 1200 + rate * now

    options = {"clock": clock, "sleep": clock.sleep, "status_every": 0.1, "on_status": spent}
    run_paced([node, robot(1, [], network)], 10.0, settle=3.0, **options)
    listener = robot(1, [], network)
    run(node, listener, settle=60.0)
    assert listener.replica.digest() == node.replica.digest()


def test_a_window_is_published_when_its_components_are_final():
    network = Network(2)
    node = robot(0, part(0, 1, 6), network)  # windows of four
    counts = []
    for tick in range(7):
        node.tick(tick / 10)
        counts.append(node.replica.n_components)
        assert node.is_over == (tick >= 5)
    assert counts[:3] == [0, 0, 0]
    assert 0 < counts[3] == counts[4] < counts[5] == counts[6]
    assert content(node.replica.components()) == content(mapped("windowed", part(0, 1, 6)).components())


@pytest.mark.parametrize("n_scans", [0, 1, 5])
def test_a_stream_of_unknown_length_is_mapped_as_a_list_is(n_scans):
    node = robot(0, iter(log(5)[:n_scans]), Network(1))
    assert node.n_scans is None
    assert "/?" in node.status()
    assert run(node).ticks == n_scans + 1  # the last one finds that it is over
    assert (node.n_scans, node.position) == (n_scans, n_scans)
    expected = mapped("windowed", log(5)[:n_scans])
    assert content(node.replica.components()) == (content(expected.components()) if n_scans else content())


def test_one_that_starts_late_catches_up_after_the_others_work_is_over():
    network = Network(2)
    first = robot(0, part(0, 2), network)
    run(first, settle=1.0)
    network.deliver(1, 1e9)  # nobody was there
    late = robot(1, part(1, 2), network)
    run(late, first, settle=10.0)
    assert late.replica.digest() == first.replica.digest()
    assert {int(i) for i in late.replica.components().ids[:, 0]} == {0, 1}


def test_what_others_have_told_and_has_not_come_is_missing():
    network = Network(2)
    talker, listener = robot(0, part(0, 1, 8), network), robot(1, [], network)
    run(talker)
    assert network.deliver(1, 1e3)  # the records, which are lost; then it says that it has them
    network.send(0, talker.replica.announcements(), 1e3, "announcements")
    listener.listen(2e3)
    assert listener.n_missing == talker.replica.held.size > 0
    run(talker, listener, settle=5.0)
    assert listener.n_missing == 0


# -- over sockets ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("key", [None, TeamKey(bytes(range(32)))])
def test_over_udp(key):
    transports = [UdpTransport.unicast(k, key=key) for k in range(3)]
    for transport in transports:
        transport.peers = [other.address for other in transports if other is not transport]
    nodes = [robot(k, part(k, 3, 18), transports[k], announce_every=0.1) for k in range(3)]
    run_paced(nodes, 100.0, settle=0.5)
    end = time.monotonic() + 60
    while len({node.replica.digest() for node in nodes}) > 1 and time.monotonic() < end:
        run_paced(nodes, 100.0, settle=0.1)
    assert len({node.replica.digest() for node in nodes}) == 1
    alone = [mapped("windowed", part(k, 3, 18)).components() for k in range(3)]
    assert content(nodes[2].replica.components()) == content(*alone)
    for node in nodes:
        row = node.row()
        assert json.loads(json.dumps(row, allow_nan=False)) == row
        assert row["socket_datagrams"] == 2 * row["datagrams"]
        assert 2 * row["wire_bytes"] == row["socket_bytes"] + 28 * row["socket_datagrams"]
        assert row["refused"] == row["failures"] == {}
        node.close()
        node.close()


def test_without_a_network_it_goes_on_alone_and_catches_up_later():
    transports = [UdpTransport.unicast(k) for k in range(2)]
    nodes = [robot(k, part(k, 2, 8), transports[k], announce_every=0.05) for k in range(2)]
    transports[0].peers = [("127.0.0.1", 9)]  # where nobody listens
    run_paced(nodes, 200.0)
    assert all(node.is_over for node in nodes)
    assert nodes[0].replica.digest() != nodes[1].replica.digest()
    transports[0].peers, transports[1].peers = [transports[1].address], [transports[0].address]
    end = time.monotonic() + 60
    while nodes[0].replica.digest() != nodes[1].replica.digest() and time.monotonic() < end:
        run_paced(nodes, 200.0, settle=0.1)
    assert nodes[0].replica.digest() == nodes[1].replica.digest()
    for node in nodes:
        node.close()


def test_two_robots_of_one_number_over_udp():
    transports = [UdpTransport.unicast(5) for _ in range(2)]
    nodes = [robot(5, part(k, 2, 8), transports[k], announce_every=0.05) for k in range(2)]
    assert [node.twin for node in nodes] == [None, None]
    transports[0].peers, transports[1].peers = [transports[1].address], [transports[0].address]
    end = time.monotonic() + 60
    while not all(node.twin for node in nodes) and time.monotonic() < end:
        run_paced(nodes, 200.0, settle=0.1)
    for node, other in zip(nodes, reversed(transports), strict=True):
        with pytest.raises(TwinError, match=f"robot 5.*{other.address[1]}.*folder"):
            check_number(node)
        assert "another robot 5" in node.status()
        assert list(node.row()["namesakes"]) == ["5"]
        node.close()


def test_two_robots_of_one_number_where_nobody_looks_at_senders():
    """As seen by what they say: relayed by a third, say."""
    network = Network(2)
    nodes = [ReplayNode(Replica(5), part(k, 2, 8), _Renamed(network, k), GaussianMap) for k in range(2)]
    run(*nodes, settle=5.0)
    assert all(node.twin and node.replica.conflicts[5] for node in nodes)
    assert nodes[0].row()["conflicts"].keys() == {"5"}


class _Renamed(Network):
    """A network in which a robot is known by its place."""

    def __init__(self, network: Network, place: int) -> None:
        super().__init__(6)
        self._network, self._place = network, place

    def send(self, sender, datagrams, now, kind):
        self._network.send(self._place, datagrams, now, kind)

    def deliver(self, robot, now):
        return self._network.deliver(self._place, now)


# -- killed, and started again -----------------------------------------------------------------------------


@settings(max_examples=3)
@given(rule=st.sampled_from(sorted(RULES)), seed=st.integers(0, 10**6))
def test_killed_between_any_two_ticks_its_map_is_that_of_one_that_lived(tmp_path_factory, rule, seed):
    rng, folder, network = random.Random(seed), tmp_path_factory.mktemp("robot"), Network(2)
    listener, now, lives = robot(1, [], network), 0.0, 0
    expected = content(mapped(rule, log(24)).components())
    while True:
        node = kept(folder, log(24), network, rule, keep_every=5)
        left = rng.randint(1, 12)
        lives += 1
        while left and not node.is_over:
            node.tick(now)
            if rng.random() < 0.7:
                listener.listen(now)
            now, left = now + 0.1, left - 1
        if node.is_over:
            break
        kill(node)
        assert lives < 60  # each goes on where it was, to within five scans and a window
    assert lives > 1
    for _ in range(100):
        now += 0.5
        node.listen(now)
        listener.listen(now)
    assert content(node.replica.components()) == expected
    assert listener.replica.digest() == node.replica.digest()
    kill(node)


def test_while_it_catches_up_what_it_said_still_counts(tmp_path):
    """Its map is older than what it said: it says nothing before it is as far as it was."""
    network, options = Network(1), {"rule": "incremental", "keep_every": 9}  # windows of three
    first = kept(tmp_path, log(24), network, **options)
    for tick in range(17):
        first.tick(tick / 10)
    kill(first)
    node = kept(tmp_path, log(24), network, **options)
    assert node.resumed_at == node.row()["resumed_at"] == 9
    assert node.row()["incarnation"] != first.row()["incarnation"]
    for position in range(10, 20):
        node.tick(position / 10)
        learned = 15 if position < 18 else 18
        assert content(node.replica.components()) == content(
            mapped("incremental", log(24)[:learned]).components()
        )
    kill(node)


def test_if_the_newest_map_has_rotted_the_one_before_will_do(tmp_path):
    first = kept(tmp_path, log(24), Network(1), "incremental", keep_every=6)
    for tick in range(17):
        first.tick(tick / 10)
    kill(first)
    (tmp_path / "map-00000012.state").write_bytes(b"rotten")
    node = kept(tmp_path, log(24), Network(1), "incremental", keep_every=6)
    assert node.resumed_at == 6
    said = content(mapped("incremental", log(24)[:15]).components())
    for position in range(7, 18):
        node.tick(position / 10)
        assert content(node.replica.components()) == said
    run(node)
    assert content(node.replica.components()) == content(mapped("incremental", log(24)).components())
    kill(node)


def test_one_that_lost_its_disk_begins_anew_and_nothing_is_lost_or_there_twice_in_the_end(tmp_path):
    network = Network(2)
    first, teammate = kept(tmp_path / "a", log(24), network, "incremental"), robot(1, [], network)
    run(first, teammate, settle=1.0, duration=1.6)
    kill(first)
    said = content(teammate.replica.components())
    assert said == content(mapped("incremental", log(24)[:15]).components())
    node = kept(tmp_path / "b", log(24), network, "incremental", announce_every=0.2)
    run(teammate, node, settle=3.0, duration=0.0)
    assert content(node.replica.components()) == said  # what it said comes back
    now = 100.0
    while not node.is_over:
        now += 0.1
        node.tick(now)
        here = content(node.replica.components())
        assert node.position > 15 or not said - here
        assert node.map.n_pending or not content(node.map.components()) - here
    run(node, teammate, settle=5.0)
    for each in (node, teammate):
        assert content(each.replica.components()) == content(mapped("incremental", log(24)).components())
    kill(node)


@pytest.mark.parametrize("over", [False, True])
def test_stopped_and_started_again_it_goes_on(tmp_path, over):
    node = kept(tmp_path, log(6), Network(1), "per_scan", keep_every=1)
    run(node, duration=None if over else 0.3)
    node.close()
    again = kept(tmp_path, log(6), Network(1), "per_scan", keep_every=1)
    assert again.resumed_at == (6 if over else 3)
    assert again.replica.digest() == node.replica.digest()
    run(again)
    assert content(again.replica.components()) == content(mapped("per_scan", log(6)).components())
    assert (again.replica.digest() == node.replica.digest()) == over  # nothing is said again
    again.close()


def test_a_stream_goes_on_where_it_was(tmp_path):
    node = kept(tmp_path, iter(log(9)), Network(1), "per_scan", keep_every=2)
    run(node, duration=0.5)
    node.close()
    again = kept(tmp_path, iter(log(9)), Network(1), "per_scan", keep_every=2)
    assert again.resumed_at == 4
    run(again)
    assert content(again.replica.components()) == content(mapped("per_scan", log(9)).components())
    again.close()


def test_to_go_on_with_another_log_rule_or_number_is_refused(tmp_path):
    run(node := kept(tmp_path, log(6), Network(1), facts={"dataset": "intel"}))
    node.close()

    def opened(scans=None, rule="windowed", number=0, dataset="intel"):
        replica = Replica(number)
        options = {"folder": tmp_path, "facts": {"dataset": dataset}}
        return ReplayNode(replica, scans or log(6), Network(9), lambda: GaussianMap(RULES[rule]), **options)

    opened()
    for options, named in (
        ({"scans": log(7)}, "n_scans"),
        ({"rule": "per_scan"}, "learning"),
        ({"number": 3}, "robot"),
        ({"dataset": "aces"}, "dataset"),
    ):
        with pytest.raises(DataError, match=named):
            opened(**options)
    with pytest.raises(DataError, match="robot 0"):
        Journal(tmp_path / "journal", Replica(3))


def test_the_real_process_is_killed():
    """In a process of its own, as it forks; see `kill_replay`."""
    done = subprocess.run(
        [sys.executable, "-m", "exploration.kill_replay", str(N_KILLS)],
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parent.parent), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads(done.stdout)
    assert found["kills"] == N_KILLS
    assert all(made["lost"] == made["doubled"] == 0 for made in found["robots"])


# -- trouble -----------------------------------------------------------------------------------------------


def test_a_full_disk_is_said_once_and_all_is_kept_again_when_there_is_room(tmp_path, caplog):
    """The kernel refuses what would make a file longer."""
    network = Network(2)
    node, listener = kept(tmp_path, log(24), network, "per_scan", keep_every=2), robot(1, [], network)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200, limits[1]))
    try:
        with caplog.at_level(logging.WARNING):
            run(node, listener, settle=1.0, duration=1.0)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert listener.replica.digest() == node.replica.digest()
    assert node.row()["unkept"] > 3
    assert caplog.text.count("no longer kept") == 1
    assert caplog.text.count("how far it is") == 1
    run(node, listener, settle=1.0)
    assert "kept on disk again" in caplog.text
    kill(node)
    again = kept(tmp_path, log(24), Network(1), "per_scan", keep_every=2)
    assert again.replica.digest() == node.replica.digest()
    assert again.resumed_at == 24
    again.close()


def test_a_scan_that_cannot_be_read_is_left_out_and_said_once(caplog):
    class Damaged(DatasetShard):
        def __getitem__(self, index):
            if index in (2, 5):
                raise DataError(f"scan {index} is damaged")
            return super().__getitem__(index)

    node = robot(0, Damaged(log(8), range(8)), Network(1), "per_scan")
    run(node)
    assert (node.row()["unread"], node.row()["scans"]) == (2, 8)
    assert caplog.text.count("is damaged") == 1
    whole = [scan for index, scan in enumerate(log(8)) if index not in (2, 5)]
    assert content(node.replica.components()) == content(mapped("per_scan", whole).components())


def test_scans_that_are_no_neighbours_are_an_error():
    node = robot(0, [*log(4), Scan([[1.0, 2.0, 3.0]], [0.0, 0.0, 0.0])], Network(1), "per_scan")
    with pytest.raises(InvalidArgumentError, match="3-dimensional"):
        run(node)
    assert content(node.replica.components()) == content(mapped("per_scan", log(4)).components())


def test_datagrams_that_say_nothing_are_counted():
    network = Network(2)
    node = robot(0, log(4), network)
    network.send(1, [b"", b"nonsense", b"\x11" * 1200], 0.0, "noise")
    network.send(1, robot(1, [], network).replica.announcements(), 0.0, "announcements")
    run(node)
    assert (node.row()["heard"], node.row()["damaged"]) == (4, 3)


def test_clocks_that_jump_change_nothing_that_is_learned():
    network, rng = Network(2), random.Random(0)
    nodes = [robot(k, part(k, 2, 8), network) for k in range(2)]
    for _ in range(60):
        now = rng.choice([0.0, 1e9, rng.uniform(0, 100)])
        for node in nodes:
            node.tick(now) if not node.is_over else node.listen(now)
    for tick in range(200):
        for node in nodes:
            node.listen(1e9 + tick)
    assert nodes[0].replica.digest() == nodes[1].replica.digest()


@pytest.mark.parametrize("options", [{"announce_every": 0.0}, {"budget": 0.0}, {"keep_every": 0}])
def test_bad_options(options):
    with pytest.raises(InvalidArgumentError, match=next(iter(options))):
        robot(0, [], Network(1), **options)


# -- what it leaves ----------------------------------------------------------------------------------------


def test_its_books_are_those_of_the_network():
    network = Network(2, LinkConditions(loss=0.2))
    nodes = [robot(k, part(k, 2, 8), network) for k in range(2)]
    run(*nodes, settle=3.0)
    for k, node in enumerate(nodes):
        row, scalars, sent = node.row(), node.scalars(), network.traffic(k)
        assert row["bytes_sent"] == scalars["bytes_sent"] == sent.bytes
        assert sum(row["bytes_by_kind"].values()) == sent.bytes
        assert row["wire_bytes"] == scalars["wire_bytes_sent"] == sent.bytes + 28 * sent.datagrams
        assert row["heard"] == network.reception(k).datagrams
        assert row["digest"] == node.replica.digest().hex()
        assert row["n_components"] == scalars["components"] == len(node.replica.components())
        assert json.loads(json.dumps(row, allow_nan=False)) == row
        assert all(isinstance(value, float) for value in scalars.values())
        assert "scan 4/4" in node.status()


def test_its_maps_are_files(tmp_path):
    network = Network(2)
    nodes = [robot(k, part(k, 2, 8), network) for k in range(2)]
    run(*nodes, settle=2.0)
    paths = {name: tmp_path / file for name, (file, _) in nodes[0].files().items()}
    for name, (_, write) in nodes[0].files().items():
        write(paths[name])
    assert content(GaussianMap.load(paths["map"]).components()) == content(nodes[1].replica.components())
    assert content(GaussianMap.load(paths["own_map"]).components()) == content(nodes[0].map.components())
    assert robot(0, [], Network(1)).files() == {}


@pytest.mark.real_data
def test_a_real_log(real_data, tmp_path):
    scans = load("carmen", real_data / "laser2d" / "intel.log.gz")
    network = Network(3, LinkConditions(loss=0.3))
    rule, parts = (
        IncrementalRule(window=5),
        [DatasetShard(scans, list(shard_indices(30, k, 3))) for k in range(3)],
    )
    nodes = [ReplayNode(Replica(k), parts[k], network, lambda: GaussianMap(rule)) for k in range(3)]
    run(*nodes, settle=15.0)
    assert len({node.replica.digest() for node in nodes}) == 1
    alone = []
    for scans_of_one in parts:
        made = GaussianMap(rule)
        for scan in scans_of_one:
            made.insert(scan)
        alone.append(made.components())
    assert content(nodes[0].replica.components()) == content(*alone)

"""Store: kept records are restored after sessions, kills and restarts."""

from __future__ import annotations

import random

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mapping.random_components import random_components
from own_process import answer_of
from sharing.replica_histories import replica_of
from sharing.schedules import act, components, run_schedule
from sharing.store_cases import altered, filled, killed, recorded, reopened, rows, state

from gmmtorch.team.sharing import store as store_module
from gmmtorch.team.sharing.messages.message_registry import encode_components
from gmmtorch.team.sharing.replica.replica import Replica
from gmmtorch.team.sharing.store import Store

N_KILLS = 6
"""`scripts/soak.sh` runs more."""


# -- stored and loaded -----------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(2))
def test_a_loaded_replica_equals_the_stored_one(seed):
    """With supersessions, counters and corrections, after loss and restarts."""
    for replica in run_schedule(seed, n_steps=20).replicas:
        again = Replica(replica.robot)
        assert again.load(*replica.stored()) == 0
        assert again.held == replica.held
        assert again.digest() == replica.digest()
        for name, value in vars(replica.components()).items():
            assert torch.equal(value, getattr(again.components(), name)), name


def test_load_refuses_what_is_damaged_or_has_no_room():
    full = replica_of(recorded(1, 8), robot=0)
    batches, datagrams = full.stored()
    damaged = [data[:-1] + bytes([data[-1] ^ 1]) for data in (*batches, *datagrams)]
    empty = Replica(0)
    assert empty.load(damaged[: len(batches)], damaged[len(batches) :]) == len(damaged) > 2
    assert empty.load([], full.announcements()) == 1
    assert not empty.held
    assert Replica(0, most_components=2).load(batches, []) == 1
    own = Replica(0)
    own.add(components(random.Random(0), 5))
    assert Replica(0, most_components=2).load(own.stored()[0], []) == 0  # own components have no limit


@settings(max_examples=2)
@given(seed=st.integers(0, 10**6))
def test_a_restarted_robot_has_all_kept_records(tmp_path_factory, seed):
    rng, folder = random.Random(seed), tmp_path_factory.mktemp("store")
    path, kept = folder / "0" / "robot.sqlite", []
    for life in range(2):
        robot, heard = Replica(0), recorded(1, 4, seed + life)
        with Store(path, 0) as store:
            assert store.restore(robot).n_refused == 0
            assert robot.digest() == replica_of(kept).digest()
            for datagram in heard:
                assert robot.receive(datagram)
                act(rng, robot)
                own = robot.datagrams()
                assert store.keep([datagram, *own])
                kept += [datagram, *own]
                if rng.random() < 0.2:
                    assert store.compact()
            path = killed(path, folder / f"{life + 1}")
    assert reopened(path)[0].digest() == replica_of(kept).digest()


def test_close_keeps_unsent_records(tmp_path):
    first, again = Replica(0), Replica(0)
    with Store(tmp_path / "s", 0) as store:
        store.restore(first)
        ids = first.add(components(random.Random(0), 3))
        first.count({tuple(ids[0].tolist()): 7.0})
    with Store(tmp_path / "s", 0) as store:
        store.restore(again)
        assert again.digest() == first.digest()
        assert again.datagrams() == []  # until a teammate announces that it lacks them
        for datagram in Replica(1).announcements():
            again.receive(datagram)
        assert replica_of(again.datagrams()).digest() == first.digest()
        new = again.add(components(random.Random(1), 1), supersedes=ids)
        assert again.components().ids.tolist() == new.tolist()
        assert new[0, 1] >> 28 == again.incarnation != first.incarnation


def test_only_new_records_are_written(tmp_path):
    datagrams, replica = recorded(1, 5), Replica(0)
    with Store(tmp_path / "s", 0) as store:
        store.restore(replica)
        for datagram in [*datagrams, *datagrams]:
            assert replica.receive(datagram)
            assert store.keep([datagram])
        deaf = Replica(1000)
        for number in range(12):  # the same records in other datagrams
            for datagram in deaf.announcements():
                replica.receive(datagram)
            again = replica.datagrams(max_bytes=1000 + 10 * number)
            assert store.keep([*again, *replica.announcements()])
        path = killed(store.path, tmp_path / "copy")
    assert [data for _, data in rows(path)] == datagrams


def test_a_long_log_is_compacted(tmp_path, monkeypatch):
    monkeypatch.setattr(store_module, "_MOST_LOG_BYTES", 1000)
    datagrams = recorded(1, 40)
    path = filled(tmp_path, datagrams)
    assert sum(len(data) for _, data in rows(path)) < sum(map(len, datagrams)) - 500
    assert len(rows(path, "batch")) == 1
    assert reopened(path)[0].digest() == replica_of(datagrams).digest()


def test_keys_in_memory_are_bounded(tmp_path, monkeypatch):
    monkeypatch.setattr(store_module, "_MOST_NAMES", 20)
    parts = [components(random.Random(seed), 1) for seed in range(30)]
    for number, part in enumerate(parts):
        part.ids[:] = torch.tensor([[3, 2 * number]])
    datagrams = [encode_components(part)[0] for part in parts]
    path = filled(tmp_path, [*datagrams, *datagrams])
    assert len(datagrams) < len(rows(path)) <= 2 * len(datagrams)
    assert reopened(path)[0].digest() == replica_of(datagrams).digest()


# -- sessions and progress -------------------------------------------------------------------------


def test_earlier_sessions_are_remembered_up_to_a_limit(tmp_path, monkeypatch):
    monkeypatch.setattr(store_module, "MOST_SESSIONS", 10)
    sessions = [number.to_bytes(8, "little") for number in range(15)]
    with Store(tmp_path / "s", 0) as store:
        assert store.begin_session(sessions[0]) == frozenset()
    with Store(tmp_path / "s", 0) as store:
        assert store.begin_session(sessions[0]) == frozenset()
        assert store.begin_session(sessions[1]) == {sessions[0]}
        for session in sessions[2:]:
            former = store.begin_session(session)
    assert former == set(sessions[-11:-1])


def test_the_newest_undamaged_progress_is_found(tmp_path):
    with Store(tmp_path / "s", 0) as store:
        assert (store.progress(), store.farthest) == (None, None)
        for n in (0, 7, 30, 102):
            assert store.save_progress(n, state(n))
    assert [n for n, *_ in rows(tmp_path / "s", "progress")] == [30, 102]
    altered(tmp_path / "s", "UPDATE progress SET state = zeroblob(9) WHERE scans = 102")
    with Store(tmp_path / "s", 0) as store:
        n_scans, found = store.progress()
        assert (n_scans, found["n"], found["none"], store.farthest) == (30, 30, None, 102)
        assert torch.equal(found["nested"][0]["x"], state(30)["nested"][0]["x"])
        store.save_progress(40, state(40))
    with Store(tmp_path / "s", 0) as store:
        assert (store.progress()[0], store.farthest) == (40, 102)
        store.save_progress(110, state(110))
    assert [n for n, *_ in rows(tmp_path / "s", "progress")] == [40, 110]


# -- kills and restarts ----------------------------------------------------------------------------


@pytest.mark.slow
def test_acknowledged_records_survive_a_kill_at_any_time():
    """In a separate process, because it forks; see `kill_store`."""
    kills = answer_of("sharing.kill_store", N_KILLS)
    assert kills["kills"] == N_KILLS
    assert kills["acknowledged"] > N_KILLS
    assert kills["lost"] == kills["unequal"] == kills["refused"] == kills["failed"] == 0


def test_a_restart_loads_few_more_bytes_than_the_replica_has(tmp_path, monkeypatch):
    replica, loaded, load = Replica(0), [], Replica.load
    with Store(tmp_path / "s", 0) as store:
        store.restore(replica)
        replica.add(random_components(3, k=3000))
        store.keep(replica.datagrams())
    reopened(tmp_path / "s")

    def counted(again: Replica, batches: list[bytes], datagrams: list[bytes]) -> int:
        loaded.append(sum(map(len, [*batches, *datagrams])))
        return load(again, batches, datagrams)

    monkeypatch.setattr(Replica, "load", counted)
    assert reopened(tmp_path / "s")[0].digest() == replica.digest()
    batches, datagrams = replica.stored()
    assert loaded[0] <= 1.2 * sum(map(len, [*batches, *datagrams]))

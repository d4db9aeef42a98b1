"""Store: kept records are restored after kills and restarts; damage, other owners, and disks that fail."""

from __future__ import annotations

import contextlib
import logging
import os
import random
import resource
import shutil
import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mapping.map_cases import assert_same_components
from mapping.random_components import random_components
from own_process import answer_of
from sharing.replica_histories import replica_of, same_attributes
from sharing.schedules import act, components, run_schedule

from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.team.sharing import store as store_module
from gmmtorch.team.sharing.messages.component_messages import encode_components
from gmmtorch.team.sharing.replica.replica import Replica
from gmmtorch.team.sharing.store import Restored, Store


def recorded(robot: int, n: int, seed: int = 0) -> list[bytes]:
    """The first n datagrams of a robot that adds, supersedes, counts and corrects."""
    rng, replica = random.Random(seed), Replica(robot)
    datagrams: list[bytes] = []
    while len(datagrams) < n:
        act(rng, replica)
        datagrams += replica.datagrams()
    return datagrams[:n]


def killed(path: Path, copy: Path) -> Path:
    """A copy of the files at `path`, as a process leaves them that is killed now."""
    copy.mkdir()
    for file in path.parent.glob(f"{path.name}*"):
        shutil.copy(file, copy)
    return copy / path.name


def filled(folder: Path, datagrams: list[bytes]) -> Path:
    """The store of robot 0, which received these one by one and was killed."""
    replica = Replica(0)
    with Store(folder / "first" / "robot.sqlite", 0) as store:
        store.restore(replica)
        for datagram in datagrams:
            assert replica.receive(datagram)
            assert store.keep([datagram])
        return killed(store.path, folder / "killed")


def reopened(path: Path, **options) -> tuple[Replica, Restored]:
    replica = Replica(0)
    with Store(path, 0, **options) as store:
        restored = store.restore(replica)
        store.close()
    return replica, restored


def rows(path: Path, table: str = "record") -> list[tuple]:
    with contextlib.closing(sqlite3.connect(path)) as db:
        return db.execute(f"SELECT * FROM {table}").fetchall()


def altered(path: Path, *statements: str) -> Path:
    with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as db:
        for statement in statements:
            db.execute(statement)
    return path


def state(n: int) -> dict[str, object]:
    return {"n": n, "none": None, "nested": [{"x": torch.full((2, 3), float(n), dtype=torch.float64)}]}


N_KILLS = 6
"""`scripts/soak.sh` runs more."""


# -- stored and loaded -----------------------------------------------------------------------------


@pytest.mark.parametrize(("seed", "painters"), [(0, 0), (1, 0), (1, 2)])
def test_a_loaded_replica_equals_the_stored_one(seed, painters):
    """With supersessions, counters, corrections and channels, after loss and restarts."""
    for replica in run_schedule(seed, n_steps=20, painters=painters).replicas:
        again = Replica(replica.robot)
        assert again.load(*replica.stored()) == 0
        assert again.held == replica.held
        assert again.digest() == replica.digest()
        assert_same_components(replica.components(), again.components())
        assert same_attributes(replica.components(), again.components())


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


# -- damage ----------------------------------------------------------------------------------------


def test_any_prefix_of_the_log_is_a_prefix_of_the_commits(tmp_path):
    """A write-ahead log cut at any byte, as by a loss of power."""
    datagrams = recorded(1, 5)
    path = filled(tmp_path, datagrams)
    log = Path(f"{path}-wal").read_bytes()
    expected = [replica_of(datagrams[:n]).digest() for n in range(len(datagrams) + 1)]
    last, rng = 0, random.Random(0)
    for number, end in enumerate(sorted([0, len(log), *rng.sample(range(len(log)), 12)])):
        cut = killed(path, tmp_path / str(number))
        os.truncate(f"{cut}-wal", end)
        if end < 40_000:  # the tables are created in the log, too
            cut.unlink()
            shutil.copy(path, cut)
        found, restored = reopened(cut)
        n = expected.index(found.digest())
        assert n >= last
        assert restored.n_refused == 0
        last = n
    assert last == len(datagrams)


def test_a_damaged_row_is_skipped_and_logged(tmp_path, caplog):
    datagrams = recorded(1, 6)
    path = filled(tmp_path, datagrams)
    altered(path, "UPDATE record SET datagram = substr(datagram, 2) WHERE number = 3")
    found, restored = reopened(path)
    assert restored == Restored(5, 1)
    assert "1 of 6 rows" in caplog.text
    for datagram in datagrams:  # a teammate sends it again
        assert found.receive(datagram)
    assert found.digest() == replica_of(datagrams).digest()


def test_flipped_bytes_are_refused_or_restored_in_part(tmp_path, caplog):
    caplog.set_level(logging.ERROR)
    datagrams = recorded(1, 6)
    with Store(filled(tmp_path, datagrams), 0) as store:
        store.restore(Replica(0))
        store.save_progress(3, state(3))
    data, rng, n_refused = bytearray(store.path.read_bytes()), random.Random(0), 0
    held = replica_of(datagrams).held
    for _ in range(25):
        flipped = bytearray(data)
        for _ in range(rng.randint(1, 30)):
            flipped[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        store.path.write_bytes(flipped)
        try:
            replica = Replica(0)
            with Store(store.path, 0) as opened:
                opened.restore(replica)
                opened.progress()
            assert held.covers(replica.held)
        except (DataError, InvalidArgumentError):
            n_refused += 1
    assert 2 < n_refused < 23


@pytest.mark.parametrize(
    ("statement", "match"),
    [
        ("CREATE TRIGGER t AFTER INSERT ON record BEGIN DELETE FROM batch; END", "other tables"),
        ("CREATE VIEW v AS SELECT * FROM fact", "other tables"),
        ("CREATE TABLE more (x)", "other tables"),
        ("DROP TABLE record", "other tables"),
        ("PRAGMA user_version = 2", "version 2"),
        ("PRAGMA application_id = 7", "no store"),
        ("INSERT INTO fact VALUES (x'00', '1')", "facts are damaged"),
        ("UPDATE fact SET value = '{'", "facts are damaged"),
        ("UPDATE fact SET value = '7'", "robot was 7 and is 0"),
    ],
)
def test_a_foreign_file_is_refused_and_unchanged(tmp_path, statement, match):
    path = altered(filled(tmp_path, recorded(1, 2)), statement)
    before = rows(path, "sqlite_master")
    with pytest.raises((DataError, InvalidArgumentError), match=match):
        Store(path, 0)
    assert rows(path, "sqlite_master") == before
    altered(path, "PRAGMA user_version")  # it is not locked


def test_a_file_that_is_no_database_is_refused(tmp_path):
    (tmp_path / "noise").write_bytes(b"x" * 5000)
    os.mkfifo(tmp_path / "pipe")
    with (tmp_path / "huge").open("wb") as file:
        file.truncate(1 << 40)  # a hole: a terabyte that takes no room
    with contextlib.closing(sqlite3.connect(tmp_path / "other")) as db:
        db.execute("CREATE TABLE mine (x)")
    for name in ("noise", "pipe", "huge", "other"):
        with pytest.raises(DataError, match=name):
            Store(tmp_path / name, 0)


# -- owner -----------------------------------------------------------------------------------------


def test_a_store_of_another_robot_world_or_log_is_refused(tmp_path):
    facts = {"source": "log", "size": (1, 2), "path": "x" * 100}
    Store(tmp_path / "s", 0, facts).close()
    Store(tmp_path / "s", 0, facts).close()
    for robot, other, words in (
        (4, facts, ["robot was 0 and is 4"]),
        (0, {**facts, "size": [1, 3]}, ["size was [1, 2] and is [1, 3]"]),
        (
            0,
            {"source": "world", "path": "y" * 100},
            ["source was log", "size was", f"{'x' * 40}… and is {'y' * 40}…"],
        ),
    ):
        with pytest.raises(InvalidArgumentError) as caught:
            Store(tmp_path / "s", robot, other)
        assert all(word in str(caught.value) for word in words)


def test_an_incarnation_that_was_used_is_refused(tmp_path):
    first = Replica(0, incarnation=7)
    with Store(tmp_path / "s", 0) as store:
        store.restore(first)
        first.add(components(random.Random(0), 2))
    for _ in range(2):  # also one of an earlier session
        with Store(tmp_path / "s", 0) as store, pytest.raises(InvalidArgumentError, match="incarnation=7"):
            store.restore(Replica(0, incarnation=7))
        reopened(tmp_path / "s")
    with Store(tmp_path / "s", 0) as store, pytest.raises(InvalidArgumentError, match="records already"):
        store.restore(replica_of(recorded(1, 2), robot=0))


@pytest.mark.slow
def test_one_process_at_a_time_and_the_lock_ends_with_it(tmp_path):
    with Store(tmp_path / "s", 0), pytest.raises(InvalidArgumentError, match=r"path=.*runs already.*fuser"):
        Store(tmp_path / "s", 0)
    code = (
        "import sys, time; from gmmtorch.team.sharing.store import Store\n"
        "store = Store(sys.argv[1], 0); print('open', flush=True); time.sleep(600)"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "s")]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == b"open\n"
        with pytest.raises(InvalidArgumentError, match="runs already"):
            Store(tmp_path / "s", 0)
        child.kill()
        child.wait()
    Store(tmp_path / "s", 0).close()


@pytest.mark.parametrize("options", [{"robot": -1}, {"robot": 0, "max_bytes": 10}])
def test_invalid_store_options_are_named(tmp_path, options):
    with pytest.raises(InvalidArgumentError, match=list(options)[-1]):
        Store(tmp_path / "s", **options)


@pytest.mark.parametrize("datagram", [b"", b"\x11" * 1201, bytearray(b"\x11"), "text", None])
def test_invalid_datagrams_are_refused(tmp_path, datagram):
    with Store(tmp_path / "s", 0) as store, pytest.raises(InvalidArgumentError, match="datagram"):
        store.keep([datagram])


# -- a disk that fails -----------------------------------------------------------------------------


@contextlib.contextmanager
def file_limit(n_bytes: int):
    """The kernel refuses to let files of this process grow beyond that, as on a full disk."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (n_bytes, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def test_a_full_disk_is_logged_once_and_all_is_kept_when_there_is_room(tmp_path, caplog):
    datagrams, replica = recorded(1, 60), Replica(0)
    with Store(tmp_path / "s", 0) as store:
        store.restore(replica)
        with file_limit(100_000):
            results = []
            for datagram in datagrams[:40]:
                assert replica.receive(datagram)
                results.append(store.keep([datagram]))
            n_kept = results.index(False)
            assert not any(results[n_kept:])
            assert store.n_failed == 40 - n_kept > 5
            assert not store.save_progress(3, state(3))
            assert store.begin_session(b"12345678") == frozenset()
        assert caplog.text.count("no longer written") == 1
        found = reopened(killed(store.path, tmp_path / "full"))[0]
        assert found.digest() == replica_of(datagrams[:n_kept]).digest()
        for datagram in datagrams[40:]:
            assert replica.receive(datagram)
            store.keep([datagram])
        assert caplog.text.count("written again") == 1
        again = killed(store.path, tmp_path / "room")
    assert reopened(again)[0].digest() == replica_of(datagrams).digest()


def test_a_store_has_a_largest_size(tmp_path):
    replica = Replica(0)
    with Store(tmp_path / "s", 0, max_bytes=1 << 17) as store:
        store.restore(replica)
        while store.keep(replica.datagrams()):
            replica.add(random_components(3, k=300, seed=len(replica.held)))
            assert replica.n_components < 30_000
    assert sum(file.stat().st_size for file in tmp_path.iterdir()) <= 1 << 17


@pytest.mark.parametrize("code", [sqlite3.SQLITE_READONLY, sqlite3.SQLITE_CANTOPEN])
def test_a_read_only_disk_is_read(tmp_path, monkeypatch, caplog, code):
    """The write-ahead log is read too, and no file changes."""
    datagrams = recorded(1, 5)
    path = filled(tmp_path, datagrams)
    before = {file.name: file.read_bytes() for file in path.parent.iterdir()}
    connect, replica = store_module.connect, Replica(0)

    def fails(place: str) -> sqlite3.Connection:
        if place == str(path):
            error = sqlite3.OperationalError("attempt to write a readonly database")
            error.sqlite_errorcode = code
            raise error
        return connect(place)

    monkeypatch.setattr(store_module, "connect", fails)
    with Store(path, 0) as store:
        assert not store.is_writable
        store.restore(replica)
        assert not store.keep(recorded(2, 1))
        assert not store.save_progress(1, state(1))
        assert (store.progress(), store.begin_session(b"12345678")) == (None, frozenset())
    assert replica.digest() == replica_of(datagrams).digest()
    assert caplog.text.count("cannot be written") == 1
    assert "Choose another folder, or run without a store" in caplog.text
    assert {file.name: file.read_bytes() for file in path.parent.iterdir()} == before


def test_an_unusable_path_gives_an_empty_store(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    for full in (False, True):
        with monkeypatch.context() as patch, Store(tmp_path / "file" / "below" / "s", 0) as store:
            if full:  # no room for a copy either
                patch.setattr(store_module.tempfile, "mkdtemp", _raise_full)
            assert not store.is_writable
            assert store.restore(Replica(0)) == Restored(0, 0)


def _raise_full(*_, **__):
    raise OSError(28, "No space left on device")

"""Journal: what was kept is there again, wherever the robot, or its disk, stops."""

from __future__ import annotations

import contextlib
import errno
import itertools
import json
import logging
import os
import random
import resource
import shutil
import subprocess
import sys
import zlib
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from sharing.schedules import act, components

import gmmtorch as gt
from gmmtorch.errors import DataError, GmmTorchError, InvalidArgumentError, OutputError
from gmmtorch.sharing import journal_restore
from gmmtorch.sharing.journal import Journal
from gmmtorch.sharing.journal_format import (
    framed,
    is_sound,
    log_header,
    pack_snapshot,
    read_log,
    unpack_snapshot,
)
from gmmtorch.sharing.messages.message_registry import encode_components
from gmmtorch.sharing.replica.replica import Replica

N_KILLS = 5
"""`scripts/soak.sh` has more."""
HERE = Path("a.log")
seeds = st.integers(0, 10**6)


def spoken(robot: int, n: int, seed: int = 0) -> list[bytes]:
    """What a robot says first, n datagrams, while it adds, supersedes, counts and corrects."""
    rng, replica = random.Random(seed), Replica(robot)
    datagrams: list[bytes] = []
    while len(datagrams) < n:
        act(rng, replica)
        datagrams += replica.datagrams()
    return datagrams[:n]


def told(datagrams: list[bytes], robot: int = 1000) -> Replica:
    replica = Replica(robot)
    for datagram in datagrams:
        assert replica.receive(datagram)
    return replica


def kept(folder: Path, datagrams: list[bytes], **options) -> Path:
    """The folder of robot 0, which heard these and was killed."""
    replica = Replica(0)
    journal = Journal(folder, replica, **options)
    for datagram in datagrams:
        assert replica.receive(datagram)
        journal.heard(datagram)
    journal.close()
    return folder


def reopened(folder: Path, robot: int = 0) -> tuple[Replica, journal_restore.Restored]:
    replica = Replica(robot)
    journal = Journal(folder, replica)
    journal.close()
    return replica, journal.restored


def newest(folder: Path, suffix: str) -> Path:
    return sorted(folder.glob(f"[0-9]*{suffix}"))[-1]


def flip(path: Path, at: int, bits: int = 0x10) -> None:
    data = bytearray(path.read_bytes())
    data[at] ^= bits
    path.write_bytes(data)


# -- there and back ----------------------------------------------------------------------------------------


@settings(max_examples=2)
@given(seed=seeds)
def test_a_robot_that_is_killed_goes_on_with_all_that_was_kept(tmp_path_factory, seed):
    rng, folder = random.Random(seed), tmp_path_factory.mktemp("journal") / "robot"
    said: list[bytes] = []
    for life in range(3):
        robot, heard = Replica(0), spoken(1, 4, seed + life)
        journal = Journal(folder, robot, most_log_bytes=rng.choice([500, 1 << 20]))
        assert robot.digest() == told(said).digest()
        for datagram in heard:
            assert robot.receive(datagram)
            journal.heard(datagram)
            act(rng, robot)
            own = robot.datagrams()
            journal.said(own)
            said += [datagram, *own]
        journal.close()  # which writes nothing: as if killed
    found, restored = reopened(folder)
    assert found.digest() == told(said).digest()
    for name, value in vars(found.components()).items():
        assert torch.equal(value, getattr(told(said).components(), name)), name
    assert (restored.n_refused, restored.n_torn, restored.damage) == (0, 0, ())


def test_a_clean_end_keeps_what_was_not_said_yet(tmp_path):
    replica = Replica(0)
    with Journal(tmp_path, replica) as journal:
        ids = replica.add(components(random.Random(0), 3))
        replica.count({tuple(ids[0].tolist()): 7.0})
    again = Replica(0)
    with Journal(tmp_path, again) as journal:
        assert journal.restored.n_datagrams == 0
        assert again.digest() == replica.digest()
        assert told(again.datagrams()).digest() == replica.digest()  # it is due still


def test_a_life_that_ends_in_an_error_writes_no_last_snapshot(tmp_path):
    replica = Replica(0)

    def live():
        with Journal(tmp_path, replica):
            replica.add(components(random.Random(0), 3))
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        live()
    assert reopened(tmp_path)[0].digest() == Replica(0).digest()


def test_what_was_said_is_not_due_again_and_can_be_superseded(tmp_path):
    replica = Replica(0)
    journal = Journal(tmp_path, replica)
    ids = replica.add(components(random.Random(0), 3))
    journal.said(replica.datagrams())
    journal.close()
    again = Replica(0)
    with Journal(tmp_path, again):
        assert again.datagrams() == []
        new = again.add(components(random.Random(1), 1), supersedes=ids)
        assert again.components().ids.tolist() == new.tolist()
        assert new[0, 1] >> 28 == again.incarnation != replica.incarnation


def test_only_records_are_kept(tmp_path):
    replica, other = Replica(0), told(spoken(1, 3), robot=1)
    journal = Journal(tmp_path, replica)
    size = newest(tmp_path, ".log").stat().st_size
    for datagram in other.announcements():
        assert replica.receive(datagram)
        journal.heard(datagram)
    journal.said([])
    assert newest(tmp_path, ".log").stat().st_size == size
    journal.close()


def test_what_was_held_already_is_not_written_again(tmp_path):
    datagrams = spoken(1, 5)
    replica = Replica(0)
    journal = Journal(tmp_path, replica)
    for datagram in [*datagrams, *datagrams]:
        assert replica.receive(datagram)
        journal.heard(datagram)
    journal.close()
    size = newest(tmp_path, ".log").stat().st_size
    assert size == len(log_header(0, 5)) + sum(len(framed(datagram)) for datagram in datagrams)
    assert reopened(tmp_path)[0].digest() == told(datagrams).digest()


def test_what_is_said_again_is_not_written_again(tmp_path):
    """Under loss: in other datagrams than at first, others' records too, and with new ones between."""
    rng, replica, deaf = random.Random(0), Replica(0), Replica(1000)
    journal = Journal(tmp_path, replica)

    def size() -> int:
        return newest(tmp_path, ".log").stat().st_size

    first = spoken(1, 5)
    for datagram in first:
        assert replica.receive(datagram)
    journal.heard(first)
    for _ in range(3):
        act(rng, replica)
        journal.said(replica.datagrams())
    journal.said(replica.datagrams())
    before, n_again = size(), 0
    for number in range(12):
        for datagram in deaf.announcements():
            replica.receive(datagram)
        again = replica.datagrams(max_bytes=1000 + 10 * number, budget=(None, 1500)[number % 2])
        journal.said(again)
        journal.said([*replica.announcements(), *again])
        n_again += len(again)
        journal.heard(first)
        assert size() == before
    assert n_again > 10
    replica.add(components(rng, 2))
    (new,) = replica.datagrams()
    journal.heard(first)
    journal.said([*first, new, *again, new])
    assert size() == before + len(framed(new))
    journal.close()
    found, restored = reopened(tmp_path)
    assert found.digest() == replica.digest()
    assert restored.n_refused == 0


def test_what_is_said_after_a_snapshot_that_rots_is_there(tmp_path):
    """The snapshot had it, not said yet; so the log has it, too, and once only."""
    replica = Replica(0)
    journal = Journal(tmp_path, replica)
    for seed in range(4):
        replica.add(components(random.Random(seed), 3))
        journal.snapshot()
        said = replica.datagrams()
        journal.said(said)
        size = newest(tmp_path, ".log").stat().st_size
        assert size == len(log_header(0, 5)) + sum(map(len, map(framed, said)))
        journal.said(said)
        assert newest(tmp_path, ".log").stat().st_size == size
        flip(newest(copy := shutil.copytree(tmp_path, tmp_path.with_name(f"copy{seed}")), ".snapshot"), 99)
        found, restored = reopened(copy)
        assert len(restored.damage) == 1
        assert found.digest() == replica.digest()
    journal.close()


def test_names_of_what_is_kept_take_bounded_memory(tmp_path, monkeypatch):
    """Beyond it they are forgotten, and what comes again is written again."""
    monkeypatch.setattr("gmmtorch.sharing.journal._MOST_NAMED", 20)
    replica = Replica(0)
    journal = Journal(tmp_path, replica)
    parts = [components(random.Random(seed), 1) for seed in range(50)]
    for number, part in enumerate(parts):
        part.ids[:] = torch.tensor([[3, 2 * number]])
    datagrams = [encode_components(part)[0] for part in parts]
    for datagram in datagrams:
        assert replica.receive(datagram)
        journal.heard(datagram)
        assert len(journal._kept) <= 20
    journal.close()
    assert reopened(tmp_path)[0].digest() == told(datagrams).digest()


def test_a_long_log_becomes_a_snapshot_and_old_files_go(tmp_path):
    datagrams = spoken(1, 40)
    kept(tmp_path, datagrams, most_log_bytes=1000)
    names = sorted(path.name for path in tmp_path.iterdir())
    assert len(names) == 5  # the lock, and the last two snapshots with their logs
    assert sum(path.stat().st_size for path in tmp_path.glob("*.log")) < 2 * (1000 + 1200)
    found, restored = reopened(tmp_path)
    assert found.digest() == told(datagrams).digest()
    assert 0 < restored.n_datagrams < len(datagrams)


# -- half-written and damaged logs -------------------------------------------------------------------------


def test_a_log_that_ends_anywhere_gives_all_whole_datagrams_and_no_alarm():
    datagrams = spoken(1, 6)
    log = log_header(0, 5) + b"".join(map(framed, datagrams))
    ends = [len(log_header(0, 5))]
    for datagram in datagrams:
        ends.append(ends[-1] + len(framed(datagram)))
    for end in range(len(log) + 1):
        found = read_log(log[:end], HERE)
        whole = sum(end >= e for e in ends) - 1
        assert found.datagrams == datagrams[: max(whole, 0)]
        assert found.n_damaged == 0
        assert found.n_torn == end - (ends[whole] if whole >= 0 else 0)


def test_a_journal_whose_log_ends_anywhere_is_restored_as_far_as_it_goes(tmp_path):
    """The same through the disk, at every byte of the last two frames and of the header."""
    datagrams = spoken(1, 4)
    folder = kept(tmp_path / "whole", datagrams)
    log = newest(folder, ".log")
    data, tail = log.read_bytes(), sum(len(framed(datagram)) for datagram in datagrams[-2:])
    expected = [told(datagrams[:n]).digest() for n in range(len(datagrams) + 1)]
    for end in [*range(30), *range(len(data) - tail, len(data) + 1, 7), len(data) - 1]:
        shutil.copytree(folder, tmp_path / "cut", dirs_exist_ok=True)
        os.truncate(tmp_path / "cut" / log.name, end)
        found, restored = reopened(tmp_path / "cut")
        assert restored.damage == ()
        assert found.digest() == expected[restored.n_datagrams]
        assert restored.n_datagrams == len(read_log(data[:end], HERE).datagrams)
        shutil.rmtree(tmp_path / "cut")


@pytest.mark.parametrize("bits", [0x01, 0x80, 0xFF])
def test_a_flipped_byte_costs_one_datagram_at_most_and_is_said(bits):
    datagrams = spoken(1, 4)
    log = log_header(0, 5) + b"".join(map(framed, datagrams))
    for at in range(len(log)):
        data = bytearray(log)
        data[at] ^= bits
        found = read_log(bytes(data), HERE)
        left = list(datagrams)
        for datagram in found.datagrams:
            left.remove(datagram)  # raises for what was never written
        assert len(left) == (at >= len(log_header(0, 5)))
        # The length of the last one may say that more was to come: then nobody can tell.
        assert found.n_damaged > 0 or (found.n_torn > 0 and left == datagrams[-1:])


def test_damage_in_the_middle_is_said_and_the_rest_used(tmp_path, caplog):
    datagrams = spoken(1, 6)
    log = newest(kept(tmp_path, datagrams), ".log")
    flip(log, log.stat().st_size // 2)
    with caplog.at_level(logging.WARNING):
        found, restored = reopened(tmp_path)
    assert restored.n_datagrams == len(datagrams) - 1
    assert len(restored.damage) == 1
    assert str(log) in restored.damage[0]
    assert restored.damage[0] in caplog.text
    for datagram in datagrams:  # a teammate has what is lacking
        assert found.receive(datagram)
    assert found.digest() == told(datagrams).digest()


@settings(max_examples=200)
@given(
    data=st.binary(max_size=300)
    | st.lists(
        st.sampled_from([b"\xa7", b"\xa7\x5c", b"\xa7\x5c\x05\x00", b"\0", framed(b"abc"), log_header(0, 5)])
    ).map(b"".join)
)
def test_any_bytes_are_a_log_of_which_every_byte_is_accounted_for(data):
    found = read_log(data, HERE)
    n_header = 0 if found.robot is None else len(log_header(0, 5))
    n_frames = sum(len(framed(datagram)) for datagram in found.datagrams)
    assert n_header + n_frames + found.n_torn + found.n_damaged == len(data)


# -- damaged snapshots -------------------------------------------------------------------------------------


def test_a_damaged_snapshot_costs_nothing_as_the_one_before_is_there(tmp_path):
    datagrams = spoken(1, 30)
    kept(tmp_path / "whole", datagrams, most_log_bytes=1500)
    path = newest(tmp_path / "whole", ".snapshot")
    size = path.stat().st_size
    for at in [0, 15, 16, 30, size // 2, size - 1]:
        folder = shutil.copytree(tmp_path / "whole", tmp_path / f"flipped-{at}")
        flip(folder / path.name, at)
        found, restored = reopened(folder)
        assert found.digest() == told(datagrams).digest()
        assert len(restored.damage) == 1
        assert str(folder / path.name) in restored.damage[0]
        found, restored = reopened(folder)  # and once more, on what was written then
        assert found.digest() == told(datagrams).digest()


def test_every_flip_and_every_cut_of_a_snapshot_is_seen():
    data = pack_snapshot(told(spoken(1, 3)).state(), 0, 5)
    assert is_sound(data)
    rng = random.Random(0)
    for at in range(0, len(data), 13):
        flipped = bytearray(data)
        flipped[at] ^= 1 << rng.randrange(8)
        assert not is_sound(bytes(flipped))
        assert not is_sound(data[:at])


def test_without_any_sound_snapshot_the_logs_are_used(tmp_path):
    datagrams = spoken(1, 5)
    kept(tmp_path, datagrams)
    for path in tmp_path.glob("*.snapshot"):
        path.write_bytes(b"rotten")
    found, restored = reopened(tmp_path)
    assert restored.snapshot is None
    assert restored.damage
    assert found.digest() == told(datagrams).digest()


def test_a_folder_in_which_nothing_can_be_read_is_refused_and_left(tmp_path):
    (tmp_path / "00000007.snapshot").write_bytes(b"x" * 5000)
    (tmp_path / "00000007.log").write_bytes(b"x" * 5000)
    with pytest.raises(DataError, match="00000007"):
        reopened(tmp_path)
    assert (tmp_path / "00000007.snapshot").read_bytes() == b"x" * 5000
    assert len(list(tmp_path.iterdir())) == 3  # with the lock


def test_others_files_are_left_alone(tmp_path):
    for name in ("map.safetensors", "notes.log", "12.log"):
        (tmp_path / name).write_text("mine")
    kept(tmp_path, spoken(1, 3))
    reopened(tmp_path)
    assert all((tmp_path / name).read_text() == "mine" for name in ("map.safetensors", "notes.log", "12.log"))


def test_what_is_no_file_or_too_long_is_damage_and_not_read(tmp_path, monkeypatch):
    datagrams = spoken(1, 5)
    kept(tmp_path, datagrams)
    (tmp_path / "00000500.log").mkdir()
    os.mkfifo(tmp_path / "00000501.snapshot")
    with (tmp_path / "00000502.log").open("wb") as file:
        file.truncate(1 << 40)  # a hole: a terabyte that takes no room
    with (tmp_path / "00000503.snapshot").open("wb") as file:
        file.truncate(1 << 40)
    found, restored = reopened(tmp_path)
    assert len(restored.damage) == 4
    assert found.digest() == told(datagrams).digest()


def test_versions_to_come_are_refused_and_left(tmp_path):
    folder = kept(tmp_path, spoken(1, 3))
    log = newest(folder, ".log")
    data = log.read_bytes()
    fields = data[:7] + b"\x02" + data[8:14]
    log.write_bytes(fields + zlib.crc32(fields).to_bytes(4, "little") + data[18:])
    with pytest.raises(DataError, match="version 2"):
        reopened(folder)
    assert log.exists()


def tables_of(state: dict) -> Iterator[dict]:
    yield state
    for value in state.values():
        if isinstance(value, dict):
            yield from tables_of(value)


@pytest.mark.filterwarnings("ignore:Using a non-tuple sequence")  # torch, of lists where a tensor should be
@settings(max_examples=40)
@given(data=st.data())
def test_snapshots_that_somebody_forged_are_refused_or_restored(tmp_path_factory, data):
    """With a digest that is right, and any part of the state replaced."""
    folder = tmp_path_factory.mktemp("journal")
    state = told(spoken(1, 3), robot=0).state()
    part = data.draw(st.sampled_from(list(tables_of(state))))
    tensors = [torch.zeros(0), torch.full((3, 3), torch.nan), torch.arange(5), torch.ones(2, 2, 2)]
    hostile = (
        st.none() | st.integers() | st.floats() | st.text(max_size=3) | st.lists(st.integers(), max_size=3)
        | st.sampled_from([*tensors, [[0, 1e400], [1, 2, 3]], {"a": {}}])
    )  # fmt: skip
    part[data.draw(st.sampled_from(sorted(part)))] = data.draw(hostile)
    (folder / "00000001.snapshot").write_bytes(pack_snapshot(state, 0, 5))
    with contextlib.suppress(DataError):
        reopened(folder)


def test_a_replica_that_has_no_room_for_what_was_kept_says_so(tmp_path):
    datagrams = spoken(1, 8)
    kept(tmp_path, datagrams)
    small = Replica(0, most_components=2)
    journal = Journal(shutil.copytree(tmp_path, tmp_path / "copy"), small)  # of logs it takes what fits
    journal.close()
    assert journal.restored.n_refused > 0
    assert "full" in journal.restored.damage[0]
    reopened(tmp_path)  # now it is in a snapshot
    with pytest.raises(DataError, match="most_components"):
        Journal(tmp_path, Replica(0, most_components=2))
    assert reopened(tmp_path)[0].digest() == told(datagrams).digest()


# -- whose it is -------------------------------------------------------------------------------------------


def test_another_robots_journal_is_refused(tmp_path):
    kept(tmp_path, spoken(1, 3))
    with pytest.raises(DataError, match="robot 0, the replica of robot 4"):
        reopened(tmp_path, robot=4)
    for path in tmp_path.glob("*.snapshot"):
        path.unlink()
    with pytest.raises(DataError, match="robot 0, the replica of robot 4"):
        reopened(tmp_path, robot=4)


def test_an_incarnation_that_has_been_is_refused(tmp_path):
    first = Replica(0, incarnation=7)
    with Journal(tmp_path, first) as journal:
        first.add(components(random.Random(0), 2))
        journal.said(first.datagrams())
    with pytest.raises(InvalidArgumentError, match="incarnation=7"):
        Journal(tmp_path, Replica(0, incarnation=7))
    reopened(tmp_path)
    reopened(tmp_path)
    with pytest.raises(InvalidArgumentError, match="incarnation=7"):  # however long ago it was
        Journal(tmp_path, Replica(0, incarnation=7))


def test_a_replica_with_records_is_refused(tmp_path):
    with pytest.raises(InvalidArgumentError, match="records already"):
        Journal(tmp_path, told(spoken(1, 2), robot=0))


def test_one_at_a_time(tmp_path):
    first = Journal(tmp_path, Replica(0))
    with pytest.raises(InvalidArgumentError, match="runs already"):
        Journal(tmp_path, Replica(0))
    first.close()
    first.close()
    reopened(tmp_path)
    with pytest.raises(GmmTorchError, match="closed"):
        first.said([])


@pytest.mark.parametrize(
    "options",
    [{"sync": "never"}, {"most_log_bytes": 0}, {"most_log_bytes": 1 << 40}, {"most_log_bytes": 1.5}],
)
def test_bad_options(tmp_path, options):
    with pytest.raises(InvalidArgumentError, match=next(iter(options))):
        Journal(tmp_path, Replica(0), **options)


@pytest.mark.parametrize("datagram", [b"", b"\x11" * 1201, bytearray(b"\x11"), "text", None])
def test_what_is_no_datagram_is_refused(tmp_path, datagram):
    with Journal(tmp_path, Replica(0)) as journal, pytest.raises(InvalidArgumentError, match="datagram"):
        journal.heard([datagram])


def test_a_place_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="file"):
        Journal(tmp_path / "file", Replica(0))
    with pytest.raises(OutputError, match="file"):
        Journal(tmp_path / "file" / "below", Replica(0))


# -- stopped between any two operations --------------------------------------------------------------------

OPERATIONS = ("open", "write", "fsync", "replace", "unlink", "close", "ftruncate", "chmod")


@contextlib.contextmanager
def before_each(monkeypatch, act_on):
    """`act_on(name, n)` is called before the n-th file operation."""
    count = 0

    def watched(name, operation):
        def watching(*args, **options):
            nonlocal count
            count += 1
            act_on(name, count)
            return operation(*args, **options)

        return watching

    with monkeypatch.context() as patch:
        for name in OPERATIONS:
            patch.setattr(os, name, watched(name, getattr(os, name)))
        yield


def test_every_state_of_the_folder_holds_what_was_kept(tmp_path, monkeypatch):
    """A photograph of the folder before each file operation of opening, writing and two snapshots."""
    datagrams = spoken(1, 8)
    folder = kept(tmp_path / "robot", datagrams[:3])
    photographs: list[tuple[Path, int]] = []
    n_kept, busy = 3, False

    def photograph(name, n):
        nonlocal busy
        if not busy:
            busy = True
            photographs.append((shutil.copytree(folder, tmp_path / f"{n:04d}-{name}"), n_kept))
            busy = False

    replica = Replica(0)
    with before_each(monkeypatch, photograph):
        journal = Journal(folder, replica, sync="always")
        for datagram in datagrams[3:]:
            assert replica.receive(datagram)
            journal.heard(datagram)
            n_kept += 1
            if n_kept in (5, 7):
                journal.snapshot()
        journal.close()
    assert len(photographs) > 40
    expected = [told(datagrams[:n]).digest() for n in range(len(datagrams) + 1)]
    for photo, n in photographs:
        found, restored = reopened(photo)
        assert restored.damage == ()
        assert found.digest() in expected[n : n + 2], photo.name  # the next may be there, half acknowledged
        assert not list(photo.glob(".*"))  # what was never finished is gone


def test_whatever_operation_fails_nothing_is_lost_and_the_journal_goes_on(tmp_path, monkeypatch):
    datagrams = spoken(1, 5)
    origin = kept(tmp_path / "robot", datagrams[:2])
    n_failed = 0
    for nth in itertools.count(1):
        code = (errno.ENOSPC, errno.EIO)[nth % 2]
        folder, replica = shutil.copytree(origin, tmp_path / f"{nth}"), Replica(0)
        journal = Journal(folder, replica, sync="always")
        done = 0

        def fail(name, n, nth=nth, code=code):
            nonlocal done
            done = n
            if n == nth and name not in ("close", "unlink", "ftruncate"):
                raise OSError(code, os.strerror(code))

        missing, errors = [], []
        with before_each(monkeypatch, fail):
            for number, datagram in enumerate(datagrams[2:]):
                assert replica.receive(datagram)
                try:
                    journal.heard(datagram)
                except OutputError as error:
                    errors.append(str(error))
                    missing.append(datagram)
                try:
                    if number == 1:
                        journal.snapshot()
                        missing = []  # it has all
                except OutputError as error:
                    errors.append(str(error))
        journal.close()
        found, restored = reopened(folder)
        assert restored.damage == ()
        assert found.digest() == told([d for d in datagrams if d not in missing]).digest()
        for error in errors:
            assert str(folder) in error
            assert os.strerror(code) in error
        n_failed += len(errors)
        if done < nth:
            break
    assert n_failed > 10


@contextlib.contextmanager
def file_limit(n_bytes: int):
    """No file of this process can grow beyond that: what a full disk does, done by the kernel."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (n_bytes, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def test_a_full_disk(tmp_path):
    """A write fails half-way; what was kept is whole, and all is kept again once there is room."""
    datagrams = spoken(1, 30)
    replica = Replica(0)
    journal = Journal(tmp_path / "robot", replica)
    n_kept = 0
    with file_limit(2000):
        for datagram in datagrams:
            assert replica.receive(datagram)
            try:
                journal.heard(datagram)
                n_kept += 1
            except OutputError:
                break
        with pytest.raises(OutputError, match="cannot be written"):
            journal.heard(datagram)
        with pytest.raises(OutputError, match="cannot be written"):
            journal.snapshot()
    assert 0 < n_kept < len(datagrams)
    found, restored = reopened(shutil.copytree(tmp_path / "robot", tmp_path / "copy"))
    assert found.digest() == told(datagrams[:n_kept]).digest()
    assert (restored.n_torn, restored.damage) == (0, ())  # it ends where it ended before
    for datagram in datagrams[n_kept + 1 :]:
        assert replica.receive(datagram)
        journal.heard(datagram)
    journal.snapshot()
    journal.close()
    found, restored = reopened(tmp_path / "robot")
    assert found.digest() == told(datagrams).digest()
    assert restored.damage == ()


def test_no_room_for_a_snapshot_is_said_and_the_logs_go_on(tmp_path, caplog):
    datagrams = spoken(1, 30)
    replica = Replica(0)
    journal = Journal(tmp_path, replica, most_log_bytes=1500)
    with file_limit(3000):
        for datagram in datagrams:
            assert replica.receive(datagram)
            journal.heard(datagram)
    journal.close()
    assert "grows on" in caplog.text
    assert reopened(tmp_path)[0].digest() == told(datagrams).digest()


def test_a_full_disk_on_opening_gives_the_replica_all_the_same(tmp_path):
    datagrams = spoken(1, 10)
    kept(tmp_path, datagrams)
    replica = Replica(0)
    with file_limit(10), pytest.raises(OutputError):
        Journal(tmp_path, replica)
    assert replica.digest() == told(datagrams).digest()
    assert reopened(tmp_path)[0].digest() == replica.digest()


@pytest.mark.parametrize("what", ["lock", "folder"])
def test_a_disk_for_reading_alone_gives_the_replica_all_the_same(tmp_path, monkeypatch, what):
    datagrams = spoken(1, 10)
    kept(tmp_path, datagrams)
    opened, listed = os.open, os.listdir

    def reads(path, flags, *mode, **options):
        if flags & (os.O_WRONLY | os.O_RDWR):
            raise OSError(errno.EROFS, "Read-only file system")
        return opened(path, flags, *mode, **options)

    def lists(path):
        if what == "folder":
            raise PermissionError(errno.EACCES, "Permission denied")
        return listed(path)

    monkeypatch.setattr(os, "open", reads)
    monkeypatch.setattr(os, "listdir", lists)
    replica = Replica(0)
    with pytest.raises(OutputError, match="Read-only" if what == "lock" else "cannot be listed"):
        Journal(tmp_path, replica)
    assert replica.digest() == (told(datagrams) if what == "lock" else Replica(0)).digest()


# -- killed ------------------------------------------------------------------------------------------------


def test_killed_at_random_all_that_was_acknowledged_is_there():
    """In a process of its own, as it forks; see `kill_journal`."""
    done = subprocess.run(
        [sys.executable, "-m", "sharing.kill_journal", str(N_KILLS)],
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parent.parent), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    kills = json.loads(done.stdout)
    assert kills["kills"] == N_KILLS
    assert kills["acknowledged"] > N_KILLS
    assert kills["lost"] == kills["unequal"] == kills["damaged"] == kills["failed"] == 0


def test_the_lock_goes_with_the_process(tmp_path):
    code = (
        "import fcntl, sys, time; file = open(sys.argv[1], 'w'); fcntl.flock(file, fcntl.LOCK_EX)\n"
        "print('locked', flush=True); time.sleep(600)"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "lock")]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == b"locked\n"
        with pytest.raises(InvalidArgumentError, match="runs already"):
            Journal(tmp_path, Replica(0))
        child.kill()
        child.wait()
        reopened(tmp_path)


def test_it_is_public():
    assert gt.sharing.Journal is Journal
    state, robot, incarnation = unpack_snapshot(pack_snapshot(told(spoken(1, 3)).state(), 3, 5), HERE)
    assert (robot, incarnation) == (3, 5)
    assert state["robot"] == 1000

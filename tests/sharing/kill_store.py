"""Kills a robot's process at random, and compares its store with what it acknowledged.

    PYTHONPATH=tests python -m sharing.kill_store 200

A robot adds, supersedes, counts and corrects records, merges those of another robot that does the same, and
keeps all of them in its store, many of them again, as with a network that loses datagrams. It writes into a
pipe what it is about to keep, and when it is kept. Half of its lives end by the clock, which starts when
the store is open. The other half end after a random number of SQLite's virtual machine steps, also while
the store is opened or compacted. The next life starts with the file that is left.

After each death a copy of the file is opened. It must hold everything that was acknowledged, and its digest
must be that of a replica that received it, with or without the batch that was being written.
"""

from __future__ import annotations

import json
import os
import random
import select
import shutil
import signal
import sqlite3
import sys
import tempfile
import time
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from sharing.schedules import act

from gmmtorch.team.sharing import Replica, Store, store

LIVES = 20
"""Of one robot; then another begins without a file."""
_LONGEST_LIFE = 0.5  # seconds, by the clock
_MOST_STEPS = (300, 3000)  # before a life ends in SQLite; to open a store takes some 200
_LONG_LOGS = (3_000, 20_000)  # bytes, so that some lives compact
_PATIENCE = 60.0  # seconds, with a life that does not end by itself
_OBSERVER = 1000
_INTENT, _KEPT = b"I", b"K"


@dataclass
class Kills:
    """in_sqlite: kills by the number of steps; unopened: before the store was open; acknowledged:
    datagrams; lost: acknowledged records that were missing; unequal: digests that are not the model's;
    refused: rows; failed: lives that ended in an error."""

    kills: int = 0
    in_sqlite: int = 0
    unopened: int = 0
    acknowledged: int = 0
    lost: int = 0
    unequal: int = 0
    refused: int = 0
    failed: int = 0

    @property
    def sound(self) -> bool:
        return not (self.lost or self.unequal or self.refused or self.failed)


def kill_often(n: int, seed: int, folder: Path) -> Kills:
    """Kill a robot n times, with its files in `folder`. It forks: for a process with one thread."""
    rng, kills = random.Random(seed), Kills()
    for number in range(n):
        if number % LIVES == 0:
            home, model = folder / f"{seed}-{number}", Replica(_OBSERVER)
        _kill(rng, home, model, kills)
    return kills


def _kill(rng: random.Random, home: Path, model: Replica, kills: Kills) -> None:
    """One life, and the inspection. The model receives what was kept."""
    in_sqlite = rng.random() < 0.5
    steps = rng.randrange(1, rng.choice(_MOST_STEPS)) if in_sqlite else None
    said, status = _life(rng.getrandbits(32), home, steps, rng.uniform(0.0, _LONGEST_LIFE))
    kept, pending = _parsed(said)
    kills.kills += 1
    kills.in_sqlite += in_sqlite
    kills.unopened += not said
    kills.failed += not (os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL)
    kills.acknowledged += len(kept)

    copy = home.with_name("copy")
    shutil.rmtree(copy, ignore_errors=True)
    if home.exists():
        shutil.copytree(home, copy)
    found = Replica(0)
    with Store(copy / "robot.sqlite", 0) as kept_in:
        kills.refused += kept_in.restore(found).n_refused
    for datagram in kept:
        assert model.receive(datagram)
    kills.lost += (model.held - found.held).size
    if model.digest() != found.digest():  # then the batch that was being written was committed
        for datagram in pending:
            assert model.receive(datagram)
    kills.unequal += model.digest() != found.digest()


def _life(seed: int, home: Path, steps: int | None, seconds: float) -> tuple[bytes, int]:
    """What a robot wrote into the pipe until it was killed, and how it ended."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reader)
        try:
            die_after_steps(steps)
            _live(random.Random(seed), home, writer)
        except BaseException as error:
            sys.stderr.write(f"{error!r}\n")
        finally:
            os._exit(1)  # not reached by those that are killed in time
    os.close(writer)
    said, deadline = b"", time.monotonic() + _PATIENCE
    while (left := deadline - time.monotonic()) > 0:
        if select.select([reader], [], [], left)[0]:
            chunk = os.read(reader, 1 << 16)
            if not chunk:
                break
            if not said and steps is None:
                deadline = time.monotonic() + seconds
            said += chunk
    with suppress(ProcessLookupError):
        os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    while chunk := os.read(reader, 1 << 16):
        said += chunk
    os.close(reader)
    return said, status


def die_after_steps(steps: int | None) -> None:
    """Kill this process after so many steps of SQLite's virtual machine; None: never."""
    if steps is None:
        return
    left, connect = steps, store.connect

    def step() -> None:
        nonlocal left
        left -= 1
        if not left:
            os.kill(os.getpid(), signal.SIGKILL)

    def watched(path: str) -> sqlite3.Connection:
        db = connect(path)
        db.set_progress_handler(step, 1)
        return db

    store.connect = watched


def _live(rng: random.Random, home: Path, pipe: int) -> None:
    torch.set_num_threads(1)
    store._MOST_LOG_BYTES = rng.choice(_LONG_LOGS)
    robot, other = Replica(0), Replica(rng.randint(1, 3))
    kept_in = Store(home / "robot.sqlite", 0)
    kept_in.restore(robot)
    _write(pipe, _KEPT, [])
    before: list[bytes] = []
    while True:
        for maker in (robot, other):
            act(rng, maker)
            new = maker.datagrams()
            datagrams = [*new, *rng.sample(before, min(rng.randrange(4), len(before)))]
            rng.shuffle(datagrams)
            before += new
            if maker is other:
                for datagram in datagrams:
                    assert robot.receive(datagram)
            _write(pipe, _INTENT, datagrams)
            assert kept_in.keep(datagrams)
            _write(pipe, _KEPT, [])


def _write(pipe: int, what: bytes, datagrams: list[bytes]) -> None:
    body = b"".join(len(datagram).to_bytes(2, "little") + datagram for datagram in datagrams)
    message = what + len(body).to_bytes(4, "little") + body
    while message:
        message = message[os.write(pipe, message) :]


def _parsed(said: bytes) -> tuple[list[bytes], list[bytes]]:
    """Datagrams that are kept, and those of the batch that was being kept."""
    kept: list[bytes] = []
    pending: list[bytes] = []
    while len(said) >= 5 and len(said) >= 5 + int.from_bytes(said[1:5], "little"):
        end = 5 + int.from_bytes(said[1:5], "little")
        what, body, said = said[:1], said[5:end], said[end:]
        if what == _KEPT:
            kept, pending = kept + pending, []
        while body:
            length = int.from_bytes(body[:2], "little")
            pending.append(body[2 : 2 + length])
            body = body[2 + length :]
    return kept, pending


if __name__ == "__main__":
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as temporary:
        made = kill_often(int(sys.argv[1]), int([*sys.argv, "0"][2]), Path(temporary))
    sys.stdout.write(json.dumps(asdict(made)) + "\n")
    sys.exit(0 if made.sound else 1)

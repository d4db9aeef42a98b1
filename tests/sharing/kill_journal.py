"""Kills a robot's process at random, and looks at what its journal has kept.

    PYTHONPATH=tests python -m sharing.kill_journal 200

A robot adds, supersedes, counts and corrects; hears another that does the same; keeps all of it, much of it
again, as under loss; and says into a pipe what it is about to keep, and when it has been told that it is
kept. Half of its lives end by the clock, which starts when its journal is open; half inside a file operation,
also while it is opened, writes after a random part of their bytes. Then it lives again, on what is there.

After each death a copy of its folder is opened. Everything acknowledged must be there, and the digest be that
of a replica that heard what was kept, of the batch that was being written at most a beginning.
"""

from __future__ import annotations

import json
import os
import random
import select
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from sharing.schedules import act

from gmmtorch.sharing.journal import Journal
from gmmtorch.sharing.replica.replica import Replica

LIVES = 20
"""Of one robot; then another begins with an empty folder."""
_LONGEST_LIFE = 0.5  # seconds, by the clock
_MOST_OPERATIONS = (30, 120)  # before it ends in one; opening takes some 25
_PATIENCE = 60.0  # seconds, with a life that does not end by itself
_OPERATIONS = ("write", "fsync", "replace", "unlink", "open", "close")
_OBSERVER = 1000
_INTENT, _KEPT = b"I", b"K"


@dataclass
class Kills:
    """What has come of so many kills.

    in_operations: of them inside a file operation; unopened: before the journal was open; torn: with a
    half-written end; acknowledged: datagrams; lost: records of these, and of earlier lives', that were
    missing; unequal: digests that are not the model's; damaged: journals that said they are; failed:
    lives that ended in an error.
    """

    kills: int = 0
    in_operations: int = 0
    unopened: int = 0
    torn: int = 0
    acknowledged: int = 0
    lost: int = 0
    unequal: int = 0
    damaged: int = 0
    failed: int = 0

    @property
    def sound(self) -> bool:
        return not (self.lost or self.unequal or self.damaged or self.failed)


def kill_often(n: int, seed: int, folder: Path) -> Kills:
    """Kill a robot n times; `folder` is where its journals may be. Forks: for a process with one thread."""
    rng, kills = random.Random(seed), Kills()
    for number in range(n):
        if number % LIVES == 0:
            home, model = folder / f"{seed}-{number}", Replica(_OBSERVER)
        _kill(rng, home, model, kills)
    return kills


def _kill(rng: random.Random, home: Path, model: Replica, kills: Kills) -> None:
    """One life, and the inspection. The model hears what was kept."""
    in_operation = rng.random() < 0.5
    limit = rng.randrange(1, rng.choice(_MOST_OPERATIONS)) if in_operation else None
    said, status = _life(rng.getrandbits(32), home, limit, rng.uniform(0.0, _LONGEST_LIFE))
    kept, pending = _told(said)
    kills.kills += 1
    kills.in_operations += in_operation
    kills.unopened += not said
    kills.failed += not (os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL)
    kills.acknowledged += len(kept)

    copy = home.with_name("copy")
    shutil.rmtree(copy, ignore_errors=True)
    if home.exists():
        shutil.copytree(home, copy)
    found = Replica(0)
    with Journal(copy, found) as journal:
        kills.torn += journal.restored.n_torn > 0
        kills.damaged += len(journal.restored.damage) + journal.restored.n_refused > 0
    digest = found.digest()
    for datagram in kept:
        assert model.receive(datagram)
    kills.lost += (model.held - found.held).size
    for datagram in pending:
        if model.digest() == digest:
            break
        assert model.receive(datagram)
    kills.unequal += model.digest() != digest


def _life(seed: int, home: Path, limit: int | None, seconds: float) -> tuple[bytes, int]:
    """What a robot said into the pipe until it was killed, and how it ended."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reader)
        try:
            _die_in_operation(random.Random(seed), limit, writer)
            _live(random.Random(seed), home, writer)
        except BaseException as error:
            sys.stderr.write(f"{error!r}\n")
        finally:
            os._exit(1)  # nobody gets here who is killed in time
    os.close(writer)
    said, deadline = b"", time.monotonic() + _PATIENCE
    while (left := deadline - time.monotonic()) > 0:
        if select.select([reader], [], [], left)[0]:
            chunk = os.read(reader, 1 << 16)
            if not chunk:
                break
            if not said and limit is None:
                deadline = time.monotonic() + seconds
            said += chunk
    with suppress(ProcessLookupError):
        os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    while chunk := os.read(reader, 1 << 16):
        said += chunk
    os.close(reader)
    return said, status


def _live(rng: random.Random, home: Path, pipe: int) -> None:
    torch.set_num_threads(1)
    robot, other = Replica(0), Replica(rng.randint(1, 3))
    sync, size = rng.choice(["snapshot", "always"]), rng.choice([4_000, 20_000])
    journal = Journal(home, robot, sync=sync, most_log_bytes=size)
    _tell(pipe, _KEPT, [])
    before: list[bytes] = []
    while True:
        for maker in (robot, other):
            act(rng, maker)
            new = maker.datagrams()
            datagrams = [*new, *rng.sample(before, min(rng.randrange(4), len(before)))]
            rng.shuffle(datagrams)
            before += new
            _tell(pipe, _INTENT, datagrams)
            if maker is robot:
                journal.said(datagrams)
            else:
                for datagram in datagrams:
                    assert robot.receive(datagram)
                journal.heard(datagrams)
            _tell(pipe, _KEPT, [])


def _tell(pipe: int, what: bytes, datagrams: list[bytes]) -> None:
    body = b"".join(len(datagram).to_bytes(2, "little") + datagram for datagram in datagrams)
    message = what + len(body).to_bytes(4, "little") + body
    while message:
        message = message[_write(pipe, message) :]


def _told(said: bytes) -> tuple[list[bytes], list[bytes]]:
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


_write = os.write


def _die_in_operation(rng: random.Random, limit: int | None, pipe: int) -> None:
    """Let the file operation of that number be this process's last, done, not done, or done in part."""
    if limit is None:
        return
    left = limit

    def deadly(name: str, operation: Callable[..., Any]) -> Callable[..., Any]:
        def last(*args: Any, **options: Any) -> Any:
            nonlocal left
            left -= 1
            if left:
                return operation(*args, **options)
            if name == "write":
                operation(args[0], args[1][: rng.randint(0, len(args[1]))])
            elif rng.random() < 0.5:
                operation(*args, **options)
            os.kill(os.getpid(), signal.SIGKILL)
            return None

        return last

    for name in _OPERATIONS:
        setattr(os, name, deadly(name, getattr(os, name)))


if __name__ == "__main__":
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as temporary:
        made = kill_often(int(sys.argv[1]), int([*sys.argv, "0"][2]), Path(temporary))
    sys.stdout.write(json.dumps(asdict(made)) + "\n")
    sys.exit(0 if made.sound else 1)

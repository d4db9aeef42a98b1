"""The tests of sharing at length: teams with bad networks, robots that are killed, and hostile bytes.

    python benchmarks/soak.py                                    # half an hour on two cores
    python benchmarks/soak.py --schedules 100 --kills 50 --packets 100000

Schedules lose, repeat, delay and reorder datagrams, divide teams, and restart robots. When the
network works again, all replicas must be equal and hold every record that any of them held.

Robots with a store are killed (kill -9) at random, also within SQLite. When they start again,
everything that was acknowledged must be there, and nothing else but the batch that was being
written.

Packets are noise, valid datagrams of all 13 kinds that are truncated or altered (with right
checksums or wrong ones), datagrams made up by somebody who knows the formats, and frames of a
stranger. They go to the decoder, a replica, a view library, and the opener of a team with a key.
The exit status is 1 if a replica or opener accepts what the decoder refuses, if anything but
`DataError` is raised, or if memory grows: by more than `_ALLOWED_KB` outside of replicas, which are
replaced now and then, or by more than `_MOST_HELD_KB` in a replica and a library. A valid datagram
with values in range is accepted; only a key keeps it out.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import gc
import logging
import random
import sys
import tempfile
import tracemalloc
import zlib
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from gmmtorch.errors import DataError
from gmmtorch.processes import end_with_parent
from gmmtorch.report.text import format_table
from gmmtorch.team.sharing.messages.datagrams import Kind
from gmmtorch.team.sharing.messages.message_registry import decode
from gmmtorch.team.sharing.messages.mission_messages import ViewsMessage
from gmmtorch.team.sharing.replica.replica import Replica
from gmmtorch.team.sharing.transport.security import Opener, Sealer, TeamKey
from gmmtorch.team.sharing.view_library import ViewLibrary

_LIFE = 20_000  # packets that a replica and a set of views hear
_ALLOWED_KB = 256  # of growth, in each process, from the end of the first life on: caches of Python's own
_MOST_HELD_KB = 8 * 1024  # by a replica of `_COMPONENTS` and a set of views
_COMPONENTS = 2000


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--schedules", type=int, default=1000)
    parser.add_argument("--kills", type=int, default=500)
    parser.add_argument("--packets", type=int, default=1_000_000)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    with concurrent.futures.ProcessPoolExecutor(options.workers, initializer=_alone) as pool:
        seeds = range(options.seed, options.seed + options.schedules)
        team = _schedules(list(pool.map(_schedule, seeds, chunksize=5)))
        killed = _summed(pool.map(_kills, *_shares(options.kills, options.workers, options.seed)))
        parts = list(pool.map(_packets, *_shares(options.packets, options.workers, 0)))
    print(format_table([team], list(team)))
    print(format_table([killed], list(killed)))
    rows = [
        {"to": listener, **{what: sum(part.outcomes[listener][what] for part in parts) for what in _OUTCOMES}}
        for listener in parts[0].outcomes
    ]
    memory = {
        "grown_kb": max(part.grown_kb for part in parts),
        "held_kb": max(part.held_kb for part in parts),
    }
    print(format_table(rows, list(rows[0])))
    print(format_table([memory], list(memory)))
    sound = team["converged"] == team["complete"] == options.schedules
    sound = sound and not any(killed[what] for what in ("lost", "unequal", "refused", "failed"))
    sound = sound and not any(row["raised"] + row["believed"] for row in rows)
    return 0 if sound and memory["grown_kb"] <= _ALLOWED_KB and memory["held_kb"] <= _MOST_HELD_KB else 1


def _shares(n: int, workers: int, seed: int) -> tuple[range, list[int]]:
    """A seed and a part of n for each worker."""
    return range(seed, seed + workers), [(n + worker) // workers for worker in range(workers)]


def _summed(parts: Iterable[dict[str, int]]) -> dict[str, int]:
    total: dict[str, int] = {}
    for part in parts:
        total = {name: total.get(name, 0) + value for name, value in part.items()}
    return total


def _alone() -> None:
    end_with_parent()
    torch.set_num_threads(1)
    logging.disable()  # of what is refused
    sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))


def _schedule(seed: int) -> dict[str, Any]:
    from sharing.schedules import run_schedule

    outcome = run_schedule(seed, n_robots=3 + seed % 3)
    return {
        "converged": outcome.converged,
        "complete": outcome.complete,
        "rounds": outcome.rounds,
        "crashes": outcome.crashes,
    }


def _schedules(outcomes: list[dict[str, Any]]) -> dict[str, Any]:
    return {
        "schedules": len(outcomes),
        "converged": sum(outcome["converged"] for outcome in outcomes),
        "complete": sum(outcome["complete"] for outcome in outcomes),
        "most_rounds": max((outcome["rounds"] for outcome in outcomes), default=0),
        "crashes": sum(outcome["crashes"] for outcome in outcomes),
    }


def _kills(seed: int, n: int) -> dict[str, int]:
    from sharing.kill_store import kill_often

    with tempfile.TemporaryDirectory() as folder:
        return asdict(kill_often(n, seed, Path(folder)))


_OUTCOMES = ("packets", "refused", "in_range", "believed", "raised")


@dataclass
class _Heard:
    """What came of packets, by listener; and the most memory (kB) that a listener held, or left behind."""

    outcomes: dict[str, Counter[str]]
    grown_kb: int = 0
    held_kb: int = 0


def _packets(seed: int, n: int) -> _Heard:
    """Hostile packets to the decoder, a replica, a set of views, and a transport's opener."""
    from sharing.message_examples import examples

    rng, sound = random.Random(seed), examples()
    stranger, opener = Sealer(1, TeamKey.generate()), Opener(TeamKey.generate())
    heard = _Heard({to: Counter() for to in ("decoder", "replica", "views", "opener")})
    tracemalloc.start()
    begun = None
    for begin in range(0, n, _LIFE):
        listeners = Replica(0, incarnation=1, most_components=_COMPONENTS), ViewLibrary(0, incarnation=1)
        for _ in range(begin, min(begin + _LIFE, n)):
            packet = _hostile(rng, sound)
            frame = stranger.seal(packet[:1200]) if rng.random() < 0.3 else _framed(rng, packet)
            for to, outcome in (*_decoded(packet, *listeners), ("opener", _opened(opener, frame))):
                heard.outcomes[to].update(("packets", outcome))
        held = _traced_kb()
        del listeners
        left = _traced_kb()
        heard.held_kb = max(heard.held_kb, held - left)
        begun = left if begun is None else begun
        heard.grown_kb = max(0, left - begun)
    tracemalloc.stop()
    return heard


def _traced_kb() -> int:
    """Memory that Python and NumPy hold. Of tensors it has the objects alone: enough to see them pile up."""
    gc.collect()
    return tracemalloc.get_traced_memory()[0] // 1024


def _hostile(rng: random.Random, sound: list[bytes]) -> bytes:
    """Noise; a sound datagram that is one no more, its checksum right now and then; or one made up."""
    from sharing.structured_bodies import structured

    choice = rng.randrange(5)
    if choice == 0:
        return rng.randbytes(rng.randrange(1300))
    if choice == 1:
        return structured(rng.choice(list(Kind)), rng)
    datagram = bytearray(rng.choice(sound))
    if choice == 2:
        return bytes(datagram[: rng.randrange(len(datagram))])
    for _ in range(rng.randint(1, 4)):
        datagram[rng.randrange(len(datagram))] ^= rng.randrange(1, 256)
    if choice == 3:
        return bytes(datagram)
    begin = 1 if datagram[0] & 15 == Kind.COMPONENTS else 0  # the checksum of kind 1 is its batch's own
    return bytes(datagram[:-4]) + zlib.crc32(datagram[begin:-4]).to_bytes(4, "little")


def _decoded(packet: bytes, replica: Replica, views: ViewLibrary) -> list[tuple[str, str]]:
    """What the decoder, and then a replica and a set of views, made of it."""
    try:
        message = decode(packet)
    except DataError:
        taken = _outcome(lambda: replica.receive(packet))
        return [("decoder", "refused"), ("replica", "believed" if taken == "in_range" else taken)]
    except Exception:
        return [("decoder", "raised")]
    return [
        ("decoder", "in_range"),
        ("replica", _outcome(lambda: replica.receive(packet, message))),
        *(
            [("views", _outcome(lambda: views.receive(message, 0.0)))]
            if isinstance(message, ViewsMessage)
            else []
        ),
    ]


def _outcome(take: Callable[[], bool]) -> str:
    try:
        return "in_range" if take() else "refused"
    except Exception:
        return "raised"


def _framed(rng: random.Random, packet: bytes) -> bytes:
    return bytes([rng.choice([0xF1, 0xE1, rng.randrange(256)])]) + packet


def _opened(opener: Opener, frame: bytes) -> str:
    try:
        return "refused" if opener.open(frame) is None else "believed"
    except Exception:
        return "raised"


if __name__ == "__main__":
    sys.exit(main())

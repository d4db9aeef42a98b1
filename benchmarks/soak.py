"""What the tests of sharing do briefly, for long: teams in trouble, robots killed, and hostile bytes.

    python benchmarks/soak.py                                    # some 20 minutes on two cores
    python benchmarks/soak.py --schedules 100 --kills 50 --packets 100000

Schedules lose, repeat, delay and reorder datagrams, cut robots off, crash and restart them; once the
network works again all replicas must be equal and hold all that anybody held. Robots that keep a journal
are killed (kill -9) at random, also half-way through writing: what was acknowledged must be there when they
start again, and nothing else but the beginning of what was being written. Packets are noise, sound
datagrams cut off or altered (their checksums made right again or not), and frames of a stranger: none may
be believed, nothing raised but `DataError`, and memory must not grow. Altered ones whose checksum is right
may say something in range.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import logging
import random
import sys
import tempfile
import tracemalloc
import zlib
from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from gmmtorch.errors import DataError
from gmmtorch.report.table import format_table
from gmmtorch.sharing.messages import decode
from gmmtorch.sharing.replica import Replica
from gmmtorch.sharing.security import Opener, Sealer, TeamKey

_WARM = 5_000  # packets until caches are filled


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
        {"what": what, **{key: sum(part[what][key] for part in parts) for key in parts[0][what]}}
        for what in parts[0]
    ]
    print(format_table(rows, list(rows[0])))
    sound = team["converged"] == team["complete"] == options.schedules
    sound = sound and not any(killed[what] for what in ("lost", "unequal", "damaged", "failed"))
    return 0 if sound and not any(row["raised"] + row["believed"] for row in rows) else 1


def _shares(n: int, workers: int, seed: int) -> tuple[range, list[int]]:
    """A seed and a part of n for each worker."""
    return range(seed, seed + workers), [(n + worker) // workers for worker in range(workers)]


def _summed(parts: Iterable[dict[str, int]]) -> dict[str, int]:
    total: dict[str, int] = {}
    for part in parts:
        total = {name: total.get(name, 0) + value for name, value in part.items()}
    return total


def _alone() -> None:
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
    from sharing.kill_journal import kill_often

    with tempfile.TemporaryDirectory() as folder:
        return asdict(kill_often(n, seed, Path(folder)))


def _packets(seed: int, n: int) -> dict[str, Counter[str]]:
    """Hostile packets to the decoder, a replica, and a transport's opener."""
    from sharing.message_examples import examples

    rng, sound = random.Random(seed), examples()
    replica = Replica(0, incarnation=1)
    stranger, opener = Sealer(1, TeamKey.generate()), Opener(TeamKey.generate())
    outcomes = ("packets", "refused", "in_range", "believed", "raised")
    found = {what: Counter(dict.fromkeys(outcomes, 0)) for what in ("decode", "open")}
    tracemalloc.start()
    begun = 0
    for number in range(n):
        if number == min(_WARM, n // 2):
            begun = tracemalloc.get_traced_memory()[0]
        packet = _hostile(rng, sound)
        found["decode"].update(packets=1, **{_decoded(packet, replica): 1})
        frame = stranger.seal(packet[:1200]) if rng.random() < 0.3 else _framed(rng, packet)
        found["open"].update(packets=1, **{_opened(opener, frame): 1})
    grown = (tracemalloc.get_traced_memory()[0] - begun) // 1024
    tracemalloc.stop()
    found["decode"]["grown_kb"] = found["open"]["grown_kb"] = max(0, grown)
    return found


def _hostile(rng: random.Random, sound: list[bytes]) -> bytes:
    """Noise, or a sound datagram that is one no more; a checksum that is right now and then."""
    kind = rng.randrange(4)
    if kind == 0:
        return rng.randbytes(rng.randrange(1300))
    datagram = bytearray(rng.choice(sound))
    if kind == 1:
        return bytes(datagram[: rng.randrange(len(datagram))])
    for _ in range(rng.randint(1, 4)):
        datagram[rng.randrange(len(datagram))] ^= rng.randrange(1, 256)
    if kind == 2:
        return bytes(datagram)
    begin = 1 if datagram[0] & 15 == 1 else 0  # the checksum of kind 1 is its batch's own
    return bytes(datagram[:-4]) + zlib.crc32(datagram[begin:-4]).to_bytes(4, "little")


def _decoded(packet: bytes, replica: Replica) -> str:
    """What came of it. An altered datagram whose checksum is right may say something else that is in range:
    what keeps that out is a key."""
    try:
        taken = replica.receive(packet)
        decode(packet)
    except DataError:
        return "believed" if taken else "refused"
    except Exception:
        return "raised"
    return "in_range"


def _framed(rng: random.Random, packet: bytes) -> bytes:
    return bytes([rng.choice([0xF1, 0xE1, rng.randrange(256)])]) + packet


def _opened(opener: Opener, frame: bytes) -> str:
    try:
        return "refused" if opener.open(frame) is None else "believed"
    except Exception:
        return "raised"


if __name__ == "__main__":
    sys.exit(main())

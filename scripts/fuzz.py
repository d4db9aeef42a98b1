#!/usr/bin/env python3
"""Hostile input at length: damaged files, messages and datagrams to every reader, within time and memory.

    python scripts/fuzz.py --minutes 60 --folder /tmp/fuzz
    python scripts/fuzz.py --inputs 100000 --targets mcap,pcd

Inputs are sound ones that were changed where it hurts: sizes, counts, names, numbers; checksums fit again.
A reader may return or raise a `GmmTorchError`. Anything else is a fault: another error, more than 10 s of a
processor, more than 512 MiB above what the process had, a new file beside the input, the end of the process.
The inputs of faults are kept in the folder. The exit status is 1 if there is one.
"""

from __future__ import annotations

import argparse
import collections
import ctypes
import functools
import json
import logging
import os
import random
import resource
import select
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
import zlib
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "scripts"), str(ROOT / "tests")]
os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch  # noqa: E402
from fuzzing.maps import maps, mixtures  # noqa: E402
from fuzzing.network import sharing, sockets  # noqa: E402
from fuzzing.recordings import bags, clouds, folders, logs, nuscenes, packets  # noqa: E402
from fuzzing.target import Target  # noqa: E402

from gmmtorch import datasets  # noqa: E402
from gmmtorch.errors import GmmTorchError  # noqa: E402

SECONDS, MEMORY, SILENCE = 10, 512 << 20, 60
"""Of a processor and bytes for an input, at most; seconds without an outcome."""
BATCH, BATCH_SECONDS = 6_000, 5
"""Inputs and seconds of a process, at most: slow readers get fewer inputs."""


def targets(folder: Path) -> dict[str, Target]:
    """Every reader with small sound inputs, which the package's own writers and the formats' rules make."""
    scans = datasets.load("synthetic_building", n_scans=2)
    few = [scan.select(torch.arange(scan.n_beams) % 400 == 0) for scan in scans]
    poses = [scans.pose(index) for index in range(2)]
    return {
        **bags(folder, few, poses),
        **clouds(folder, few[0].points),
        **logs(),
        **packets(folder),
        **nuscenes(),
        **folders(folder),
        **mixtures(folder, few[0].points),
        **maps(folder, few),
        **sharing(few),
        **sockets(),
    }


# -- runs --------------------------------------------------------------------------------------------


class TooLongError(Exception):
    """A reader took more than its seconds."""


M_ARENA_MAX = -8


@functools.cache
def parse_once() -> None:
    """Definitions of messages that did not change are parsed once, because that takes half of the time."""
    import rosbags.typesys

    parse = rosbags.typesys.get_types_from_msg
    rosbags.typesys.get_types_from_msg = functools.lru_cache(maxsize=200)(parse)


def child(target: Target, seed: int, n: int, place: Path, to: int) -> None:
    """Feeds n inputs, fewer if they take too long; writes a line for each to a pipe."""
    rng, end = random.Random(seed), time.monotonic() + BATCH_SECONDS
    if (mallopt := getattr(ctypes.CDLL(None), "mallopt", None)) is not None:
        mallopt(M_ARENA_MAX, 1)  # so that the memory of idle threads does not count
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))

    def stop(*_: object) -> None:
        raise TooLongError

    signal.signal(signal.SIGPROF, stop)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    before = set(place.iterdir())
    for _ in range(n):
        if time.monotonic() > end:
            break
        name = rng.choice(list(target.seeds))
        data = target.change(target.seeds[name], list(target.seeds.values()), rng)
        if target.mend is not None and rng.random() < 0.7:
            data = target.mend(data)
        path = place / name
        path.write_bytes(data)
        size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (size + MEMORY, resource.RLIM_INFINITY))
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        outcome = "read"
        try:
            target.read(path)
        except GmmTorchError as error:
            outcome = "refused"
            if not str(error).isprintable():
                outcome = "fault: a message with control characters"
        except BaseException as error:
            last = traceback.extract_tb(error.__traceback__)[-1]
            outcome = (
                f"fault: {type(error).__name__} in {Path(last.filename).name}:{last.lineno} {error!s:.80}"
            )
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
        if outcome.startswith("fault"):
            shutil.copy(path, place / f"fault-{zlib.crc32(data):08x}-{name}")
        path.unlink()
        extra = [one.name for one in set(place.iterdir()) - before if not one.name.startswith("fault-")]
        if extra:
            outcome = f"fault: files were written: {extra[:3]}"
        os.write(to, (json.dumps(outcome) + "\n").encode())
    os._exit(0)


def warm_up(name: str, target: Target, place: Path) -> None:
    """Reads the sound inputs, so that what readers import is in memory. Raises an error if one is refused."""
    for seed, data in target.seeds.items() if not target.has_thread else ():
        path = place / seed
        path.write_bytes(data)
        try:
            target.read(path)
        except GmmTorchError as error:
            raise AssertionError(f"{name}: the sound {seed} is refused: {error}") from error
        path.unlink()


def batch(target: Target, seed: int, n: int, place: Path) -> Iterator[str]:
    """The outcomes of n inputs in a process of their own."""
    begin, end = os.pipe()
    pid = os.fork()
    if pid == 0:
        os.close(begin)
        try:
            child(target, seed, n, place, end)
        finally:
            os._exit(3)
    os.close(end)
    rest, status = b"", None
    while True:
        if not select.select([begin], [], [], SILENCE)[0]:
            os.kill(pid, signal.SIGKILL)
            status = "fault: it hangs outside of Python"
            break
        data = os.read(begin, 65536)
        if not data:
            break
        *lines, rest = (rest + data).split(b"\n")
        yield from (json.loads(line) for line in lines)
    os.close(begin)
    _, code = os.waitpid(pid, 0)
    if status is None and code:
        status = f"fault: the process ended with status {code}"
    if status is not None:
        for path in place.iterdir():
            if path.name in target.seeds:
                path.rename(place / f"fault-{seed}-{path.name}")
        yield status


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, help="how long it runs")
    parser.add_argument("--inputs", type=int, help="how many inputs it feeds, if it does not run for minutes")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--targets", default="", help="names, separated by commas; all without")
    parser.add_argument("--folder", type=Path, help="for inputs that made faults; a temporary one without")
    options = parser.parse_args()
    logging.disable()
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    parse_once()
    memory = Path("/dev/shm")  # where writing a file takes no time
    folder = options.folder or Path(tempfile.mkdtemp(prefix="fuzz", dir=memory if memory.is_dir() else None))
    (folder / "seeds").mkdir(parents=True, exist_ok=True)
    chosen = targets(folder / "seeds")
    if options.targets:
        names = options.targets.split(",")
        if unknown := set(names) - chosen.keys():
            parser.error(f"no targets {', '.join(sorted(unknown))}; there are {', '.join(chosen)}")
        chosen = {name: chosen[name] for name in names}
    for name, target in chosen.items():
        (folder / name.replace(" ", "_")).mkdir(exist_ok=True)
        warm_up(name, target, folder / name.replace(" ", "_"))
    counts = {name: collections.Counter[str]() for name in chosen}
    seconds = collections.Counter[str]()
    end = time.monotonic() + 60 * (options.minutes or 1e9)
    seed = options.seed * 1_000_000
    n_inputs = options.inputs or (10**12 if options.minutes else 20_000)
    while sum(map(collections.Counter.total, counts.values())) < n_inputs and time.monotonic() < end:
        for name, target in chosen.items():
            place = folder / name.replace(" ", "_")
            seed += 1
            start = time.monotonic()
            size = min(BATCH, max(20, n_inputs // (20 * len(chosen))))
            outcomes = collections.Counter(batch(target, seed, size, place))
            for outcome in outcomes:
                if outcome.startswith("fault") and outcome not in counts[name]:
                    print(f"{name}: {outcome} (in {place})", flush=True)
            counts[name] += outcomes
            seconds[name] += round(time.monotonic() - start)
        (folder / "counts.json").write_text(json.dumps({"outcomes": counts, "seconds": seconds}, indent=1))
    n_faults = 0
    print(f"\n{'reader':16}{'inputs':>10}{'read':>10}{'refused':>10}{'faults':>8}")
    for name, found in counts.items():
        faults = sum(n for outcome, n in found.items() if outcome.startswith("fault"))
        total = found["read"] + found["refused"] + faults
        print(f"{name:16}{total:>10,}{found['read']:>10,}{found['refused']:>10,}{faults:>8,}")
        n_faults += faults
    return int(n_faults > 0)


if __name__ == "__main__":
    sys.exit(main())

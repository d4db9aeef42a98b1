"""Robots as processes that replay a log over UDP: killed and started again, or many of them for long.

    python benchmarks/udp_team.py --runs 20 --loss 0.3 --kill    # three robots, one killed in each run
    python benchmarks/udp_team.py --robots 16 --scans 9600 --rate 1           # ten minutes

Each robot is a `gmmtorch-robot` with its part of the log and a store. With --kill one
is killed (kill -9) at a random time, and started again a little later. Once all have had their say the
maps must be equal, and hold every component of each robot's own map, once, to the bit; nothing may have
been refused. Memory is what the kernel says of each process, and must not grow by more than a tenth from
a third of a run of five minutes or more to two thirds; at its end robots write and compare maps.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from gmmtorch.experiments.harness import Case, Row, run
from gmmtorch.mapping.codec.quantization import quantized
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.team.cli.from_options import free_addresses
from gmmtorch.team.sharing.replica.materialized_view import fingerprints

_PAUSE = 0.1
_SAMPLE = 10.0  # seconds between looks at the memory
_PATIENCE = 60.0
_KILLED_WITHIN = 12.0  # seconds after its store is open
_LONG, _GROWTH = 300.0, 1.1  # seconds of a run in which memory is to be level; and how much that allows


def measure(options: Any) -> Iterator[Row]:
    n_sound = 0
    for seed in range(options.seed, options.seed + options.runs):
        with tempfile.TemporaryDirectory() as folder:
            row = played(options, seed, Path(folder))
        n_sound += _is_sound(row)
        yield {"seed": seed, **row}
    if n_sound < options.runs:
        raise SystemExit(
            f"Only {n_sound} of {options.runs} runs have equal maps, lose nothing, refuse nothing."
        )


def _is_sound(row: dict[str, Any]) -> bool:
    level = row["seconds"] < _LONG or row["mb_two_thirds"] <= _GROWTH * row["mb_third"]
    wrong = ("lost", "doubled", "refused", "not_merged", "dropped")
    return bool(row["same_map"]) and level and not any(row[what] for what in wrong)


def played(options: argparse.Namespace, seed: int, folder: Path) -> dict[str, Any]:
    """One team, from start to end."""
    rng = random.Random(seed)
    addresses = free_addresses(options.robots)
    processes = [_start(options, seed, robot, addresses, folder) for robot in range(options.robots)]
    victim = rng.randrange(options.robots) if options.kill else None
    begin = time.monotonic()
    kill_after, again_after = rng.uniform(0.0, _KILLED_WITHIN), rng.uniform(0.0, 5.0)
    at_work_since: float | None = None
    memory: list[list[int]] = []
    sampled, dead_since = -_SAMPLE, None
    try:
        while any(process.poll() is None for process in processes) or dead_since is not None:
            now = time.monotonic() - begin
            if victim is not None and at_work_since is None and _is_at_work(folder / f"robot_{victim}"):
                at_work_since = now
            working = 0.0 if at_work_since is None else now - at_work_since
            if victim is not None and dead_since is None and working > kill_after:
                processes[victim].kill()
                processes[victim].wait()
                dead_since = now
            if victim is not None and dead_since is not None and now >= dead_since + again_after:
                processes[victim] = _start(options, seed, victim, addresses, folder)
                victim = dead_since = None
            if options.seconds is not None and now >= options.seconds:
                break
            if now >= sampled + _SAMPLE:
                sampled = now
                memory.append([_resident_kb(process.pid) for process in processes])
            time.sleep(_PAUSE)
        for process in processes:
            process.terminate()
        for process in processes:
            process.wait(_PATIENCE)
    finally:
        for process in processes:
            process.kill()
    homes = [folder / f"robot_{robot}" for robot in range(options.robots)]
    found = [_row(home) for home in homes]
    return _summary(found, memory, time.monotonic() - begin) | _compared(homes)


def _is_at_work(home: Path) -> bool:
    """Whether a robot has opened its store."""
    return any(home.glob("kept/robot_*.sqlite"))


def _start(
    options: argparse.Namespace, seed: int, robot: int, addresses: Sequence[str], folder: Path
) -> subprocess.Popen[bytes]:
    home = folder / f"robot_{robot}"
    home.mkdir(exist_ok=True)
    peers = ",".join(address for address in addresses if address != addresses[robot])
    given = [
        f"id={robot}",
        f"team.size={options.robots}",
        "source=log",
        f"dataset@log.dataset={options.dataset}",
        f"sensor.rate={options.rate}",
        f"settle={options.settle}",
        f"seed={seed}",
        f"network.loss={options.loss}",
        f"link.listen={addresses[robot]}",
        f"link.peers=[{peers}]",
        f"journal.folder={home / 'kept'}",
        f"hydra.run.dir={home}",
        "report.progress=false",
        "report.tensorboard=false",
        *([] if options.path is None else [f"log.dataset.path={options.path}"]),
        *([] if options.scans is None else [f"log.dataset.n_scans={options.scans}"]),
    ]
    with (home / "output.log").open("ab") as output:
        return subprocess.Popen(
            [sys.executable, "-m", "gmmtorch.team.cli.robot", *given],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
        )


def _row(home: Path) -> dict[str, Any]:
    try:
        row: dict[str, Any] = json.loads((home / "results.json").read_text())["rows"][0]
    except (OSError, ValueError) as error:
        sys.exit(f"A robot has left no results ({error}):\n{(home / 'output.log').read_text()[-2000:]}")
    return row


def _summary(
    rows: Sequence[dict[str, Any]], memory: Sequence[Sequence[int]], seconds: float
) -> dict[str, Any]:
    """Memory, in MB of the largest process: after a third of the time, two thirds of it, and at the end."""
    peaks = [max(sample) / 1024 for sample in memory] or [0.0]
    return {
        "robots": len(rows),
        "seconds": round(seconds),
        "same_map": len({row["digest"] for row in rows}) == 1,
        "records": max(row["n_records"] for row in rows),
        "refused": sum(sum(row["refused"].values()) for row in rows),
        "not_merged": sum(sum(row["not_merged"].values()) for row in rows),
        "dropped": sum(row["dropped"] for row in rows),
        "datagrams": sum(row["datagrams"] for row in rows),
        "heard": sum(row["heard"] for row in rows),
        "wire_bytes": sum(row["wire_bytes"] for row in rows),
        "resumed_at": max(row.get("resumed_at", 0) for row in rows),
        "mb_third": round(peaks[len(peaks) // 3]),
        "mb_two_thirds": round(peaks[2 * len(peaks) // 3]),
        "mb_end": round(peaks[-1]),
    }


def _compared(homes: Sequence[Path]) -> dict[str, int]:
    """What the team's maps lack of the robots' own maps, and what they have beside that; of the worst."""
    expected = sum((_content(home / "own_map.safetensors") for home in homes), Counter())
    said = [_content(home / "map.safetensors") for home in homes]
    return {
        "lost": max((expected - one).total() for one in said),
        "doubled": max((one - expected).total() for one in said),
    }


def _content(path: Path) -> Counter[bytes]:
    """What the components of a map say, to the bit, whatever their ids and order, and how often."""
    return Counter(fingerprints(quantized(GaussianMap.load(path).components())))


def _resident_kb(pid: int) -> int:
    try:
        status = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return 0
    return next((int(line.split()[1]) for line in status.splitlines() if line.startswith("VmRSS")), 0)


CASE = Case("udp-numbers", measure, key=2, needs_data=False)

if __name__ == "__main__":
    run(
        __doc__,
        CASE,
        robots={"type": int, "default": 3},
        runs={"type": int, "default": 1},
        seconds={"type": float, "help": "then they are told to stop"},
        rate={"type": float, "default": 10.0, "help": "scans a second"},
        settle={"type": float, "default": 25.0, "help": "seconds without news until a robot ends"},
        loss={"type": float, "default": 0.0},
        kill={"action": "store_true"},
        dataset={"default": "synthetic_building_2d"},
        path={},
        scans={"type": int, "help": "of a synthetic log, in all"},
        seed={"type": int, "default": 0},
    )

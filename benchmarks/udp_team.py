"""Robots as processes that replay a log over UDP: killed and started again, or many of them for long.

    python benchmarks/udp_team.py --runs 20 --loss 0.3 --kill    # three robots, one killed in each run
    python benchmarks/udp_team.py --robots 16 --seconds 600 --scans 9600 --rate 2

Each robot is a `gmmtorch-robot` with its part of the log and a journal. With --kill one
is killed (kill -9) at a random time, and started again a little later. Once all have had their say the
maps must be equal, and hold all that any of them held. Memory is what the kernel says of each process.
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
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gmmtorch.cli.links import free_addresses
from gmmtorch.report.table import format_table

_PAUSE = 0.1
_SAMPLE = 10.0  # seconds between looks at the memory
_PATIENCE = 60.0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--robots", type=int, default=3)
    parser.add_argument("--runs", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=None, help="then they are told to stop")
    parser.add_argument("--rate", type=float, default=10.0, help="scans a second")
    parser.add_argument("--settle", type=float, default=25.0, help="seconds without news until a robot ends")
    parser.add_argument("--loss", type=float, default=0.0)
    parser.add_argument("--kill", action="store_true")
    parser.add_argument("--dataset", default="synthetic_building_2d")
    parser.add_argument("--path", default=None)
    parser.add_argument("--scans", type=int, default=None, help="of a synthetic log, in all")
    parser.add_argument("--part", default="consecutive")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    rows = []
    for seed in range(options.seed, options.seed + options.runs):
        with tempfile.TemporaryDirectory() as folder:
            rows.append(run(options, seed, Path(folder)))
        print(format_table(rows, list(rows[0])), flush=True)
    same = [row for row in rows if row["same_map"] and row["missing"] == row["refused"] == 0]
    print(f"{len(same)} of {len(rows)} runs: all maps equal, nothing lost, nothing refused")
    return 0 if len(same) == len(rows) else 1


def run(options: argparse.Namespace, seed: int, folder: Path) -> dict[str, Any]:
    """One team, from start to end."""
    rng = random.Random(seed)
    addresses = free_addresses(options.robots)
    processes = [_start(options, seed, robot, addresses, folder) for robot in range(options.robots)]
    victim = rng.randrange(options.robots) if options.kill else None
    begin = time.monotonic()
    kill_at, again_at = rng.uniform(8.0, 20.0), rng.uniform(0.0, 5.0)
    memory: list[list[int]] = []
    sampled, dead_since = -_SAMPLE, None
    try:
        while any(process.poll() is None for process in processes) or dead_since is not None:
            now = time.monotonic() - begin
            if victim is not None and dead_since is None and now >= kill_at:
                processes[victim].kill()
                processes[victim].wait()
                dead_since = now
            if victim is not None and dead_since is not None and now >= dead_since + again_at:
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
    found = [_row(folder / f"robot_{robot}") for robot in range(options.robots)]
    return _summary(found, memory, time.monotonic() - begin)


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
        f"log.rate={options.rate}",
        f"log.part={options.part}",
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
            [sys.executable, "-m", "gmmtorch.cli.robot", *given],
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
    """Memory, in MB of the largest process: after a quarter of the time, half of it, and at the end."""
    peaks = [max(sample) / 1024 for sample in memory] or [0.0]
    return {
        "robots": len(rows),
        "seconds": round(seconds),
        "same_map": len({row["digest"] for row in rows}) == 1,
        "records": max(row["n_records"] for row in rows),
        "missing": max(row["n_records"] for row in rows) - min(row["n_records"] for row in rows),
        "refused": sum(sum(row["refused"].values()) for row in rows),
        "dropped": sum(row["dropped"] for row in rows),
        "datagrams": sum(row["datagrams"] for row in rows),
        "heard": sum(row["heard"] for row in rows),
        "wire_bytes": sum(row["wire_bytes"] for row in rows),
        "resumed_at": max(row.get("resumed_at", 0) for row in rows),
        "mb_quarter": round(peaks[len(peaks) // 4]),
        "mb_half": round(peaks[len(peaks) // 2]),
        "mb_end": round(peaks[-1]),
    }


def _resident_kb(pid: int) -> int:
    try:
        status = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return 0
    return next((int(line.split()[1]) for line in status.splitlines() if line.startswith("VmRSS")), 0)


if __name__ == "__main__":
    sys.exit(main())

"""Plays a recording to gmmtorch-ros at its own speed, over DDS and Zenoh. Writes the table of BENCHMARKS.md.

    OMP_NUM_THREADS=1 python benchmarks/ros.py --data $GMMTORCH_DATA
    OMP_NUM_THREADS=1 python benchmarks/ros.py --data $GMMTORCH_DATA --minutes 10   # one map of 16 kB

The player, the mapper and Zenoh's router are processes of their own on loopback. The map is compared with the
one that gmmtorch-map makes of the same recording.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from tables import ROOT, hardware, markdown, publish

_MEGABYTE = 1 << 20
_ROUTER = "from gmmtorch.live.ros.zenoh_middleware import open_router; r = open_router(); input()"


def command(name: str, folder: Path, *options: str) -> list[str]:
    script = str(ROOT / "scripts" / f"{name}.py")
    return [sys.executable, script, f"hydra.run.dir={folder}", "report.progress=false", *options]


class Usage:
    """CPU time and memory of a process, sampled while it runs."""

    def __init__(self, process: subprocess.Popen[Any]) -> None:
        self._path = Path(f"/proc/{process.pid}")
        self.memory: list[int] = []
        self._ticks = self._cpu()
        self._begin = time.monotonic()

    def _cpu(self) -> int:
        fields = (self._path / "stat").read_text().rpartition(")")[2].split()
        return int(fields[11]) + int(fields[12])

    def sample(self) -> None:
        pages = int((self._path / "statm").read_text().split()[1])
        self.memory.append(pages * os.sysconf("SC_PAGE_SIZE"))

    def cpu_share(self) -> float:
        ticks = self._cpu() - self._ticks
        return ticks / os.sysconf("SC_CLK_TCK") / (time.monotonic() - self._begin)


def played(
    middleware: str, bag: Path, folder: Path, more: list[str], seconds: float = 0.0
) -> tuple[dict[str, Any], Usage, float]:
    """The row of results.json of the mapper, its usage, and its share of a core.

    The recording is played again until `seconds` have passed.
    """
    node = [f"node.middleware={middleware}", "node.domain=91", "wait=60"]
    receive = [*node, "node.use_sim_time=true", *more]
    mapper = subprocess.Popen(command("ros", folder / "mapper", *receive))
    play = command("ros", folder / "player", *node, f"play={bag}")
    player, end = subprocess.Popen(play), time.monotonic() + seconds
    usage: Usage | None = None
    while player.poll() is None or time.monotonic() < end:
        if player.poll() is not None:
            player = subprocess.Popen(play)
        time.sleep(0.5)
        started = any((folder / "mapper").glob("ros.log"))
        usage = Usage(mapper) if usage is None and started else usage
        if usage is not None:
            usage.sample()
    assert usage is not None
    share = usage.cpu_share()
    time.sleep(1.0)
    mapper.send_signal(signal.SIGINT)
    mapper.wait()
    row: dict[str, Any] = json.loads((folder / "mapper" / "results.json").read_text())["rows"][0]
    return row, usage, share


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--minutes", type=float, help="play the recording again and again to one map")
    given = parser.parse_args()
    bag = given.data / "bags" / "turtlebot4" / "bag"
    if given.minutes:
        long_run(bag, given.minutes)
    else:
        one_play(bag)


def long_run(bag: Path, minutes: float) -> None:
    """The row of a map with a budget to which the recording is played again and again over DDS."""
    with tempfile.TemporaryDirectory() as name:
        row, usage, share = played("dds", bag, Path(name), ["map.max_bytes=16000"], 60 * minutes)
    n = len(usage.memory)
    header = ["minutes", "scans", "dropped", "median latency", "99 %", "of a core"]
    cells = [
        f"{minutes:g}",
        row["n_scans"],
        row["n_dropped"],
        f"{row['latency_median']:.2f} s",
        f"{row['latency_p99']:.2f} s",
        f"{100 * share:.0f} %",
        ", ".join(f"{usage.memory[min(n - 1, n * k // 5)] / _MEGABYTE:.0f}" for k in range(1, 6)) + " MB",
    ]
    publish("ros-long", markdown([*header, "memory after each fifth"], [cells]) + f"\n\n{hardware()}")


def one_play(bag: Path) -> None:
    """The table of maps with and without a budget, over both middlewares."""
    rows = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        quiet = ["report.figures=false", "report.tensorboard=false"]
        for budget in ("null", "16000"):
            options = [f"map.max_bytes={budget}"]
            known = command("map", folder / budget, "dataset=rosbag", f"dataset.path={bag}", *quiet, *options)
            subprocess.run(known, check=True, stdout=subprocess.DEVNULL)
            expected = (folder / budget / "map.safetensors").read_bytes()
            for middleware in ("dds", "zenoh"):
                router = subprocess.Popen([sys.executable, "-c", _ROUTER], stdin=subprocess.PIPE)
                place = folder / f"{middleware}-{budget}"
                row, usage, share = played(middleware, bag, place, options)
                router.communicate(b"\n")
                same = (place / "mapper" / "map.safetensors").read_bytes() == expected
                half = len(usage.memory) // 2
                rows.append(
                    [
                        f"{middleware}, {'no budget' if budget == 'null' else '16 kB'}",
                        f"{row['n_scans']} of 356",
                        row["n_dropped"],
                        "yes" if same else "no",
                        f"{row['latency_median']:.2f} s",
                        f"{row['latency_p99']:.2f} s",
                        f"{100 * share:.0f} %",
                        f"{usage.memory[half] / _MEGABYTE:.0f}, {usage.memory[-1] / _MEGABYTE:.0f} MB",
                    ]
                )
    header = ["middleware, map", "scans", "dropped", "same map", "median latency", "99 %", "of a core"]
    table = markdown([*header, "memory at half time, at the end"], rows)
    publish("ros", f"{table}\n\n{hardware()}")


if __name__ == "__main__":
    main()

"""Plays a recording to gmmtorch-ros at its own speed, over DDS and Zenoh.

    OMP_NUM_THREADS=1 python benchmarks/ros.py --data $GMMTORCH_DATA
    OMP_NUM_THREADS=1 python benchmarks/ros.py --data $GMMTORCH_DATA --only ros-long   # one map of 16 kB

The player, the mapper and Zenoh's router are processes of their own on loopback. The map is compared with the
one that gmmtorch-map makes of the same recording.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pages import ROOT

from gmmtorch.experiments.harness import Case, Row, run

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
    node = [f"node.middleware={middleware}", "wait=60"]
    apart = {**os.environ, "ROS_DOMAIN_ID": "91"}
    receive = [*node, "node.use_sim_time=true", *more]
    mapper = subprocess.Popen(command("ros", folder / "mapper", *receive), env=apart)
    play = command("ros", folder / "player", *node, f"play={bag}")
    player, end = subprocess.Popen(play, env=apart), time.monotonic() + seconds
    usage: Usage | None = None
    while player.poll() is None or time.monotonic() < end:
        if player.poll() is not None:
            player = subprocess.Popen(play, env=apart)
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


def recorded(options: Any) -> Path:
    folder: Path = options.data / "bags" / "turtlebot4" / "bag"
    return folder


def long_run(options: Any) -> Iterator[Row]:
    """The row of a map with a budget to which the recording is played again and again over DDS."""
    with tempfile.TemporaryDirectory() as name:
        budget, seconds = ["map.max_bytes=16000"], 60 * options.minutes
        row, usage, share = played("dds", recorded(options), Path(name), budget, seconds)
    n = len(usage.memory)
    fifths = [f"{usage.memory[min(n - 1, n * k // 5)] / _MEGABYTE:.0f}" for k in range(1, 6)]
    yield options.minutes, row["n_scans"], *latencies(row, share), ", ".join(fifths) + " MB"


def latencies(row: dict[str, Any], share: float) -> list[float]:
    return [row["n_dropped"], row["latency_median"], row["latency_p99"], 100 * share]


def one_play(options: Any) -> Iterator[Row]:
    """Maps with and without a budget, over both middlewares."""
    bag, quiet = recorded(options), ["report.figures=false", "report.tensorboard=false"]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for budget in ("null", "16000"):
            limit = [f"map.max_bytes={budget}"]
            known = command("map", folder / budget, "dataset=rosbag", f"dataset.path={bag}", *quiet, *limit)
            subprocess.run(known, check=True, stdout=subprocess.DEVNULL)
            expected = (folder / budget / "map.safetensors").read_bytes()
            for middleware in options.methods:
                router = subprocess.Popen([sys.executable, "-c", _ROUTER], stdin=subprocess.PIPE)
                place = folder / f"{middleware}-{budget}"
                row, usage, share = played(middleware, bag, place, limit)
                router.communicate(b"\n")
                same = (place / "mapper" / "map.safetensors").read_bytes() == expected
                half, last = (usage.memory[i] / _MEGABYTE for i in (len(usage.memory) // 2, -1))
                label = f"{middleware}, {'no budget' if budget == 'null' else '16 kB'}"
                done = f"{row['n_scans']} of 356", "yes" if same else "no"
                yield label, *done, *latencies(row, share), f"{half:.0f}, {last:.0f} MB"


LATENCY = {"dropped": ".0f", "median latency": "{:.2f} s", "99 %": "{:.2f} s", "of a core": "{:.0f} %"}
PLAYED = dict.fromkeys(("middleware, map", "scans", "same map"), "")
CASES = (
    Case(
        "ros",
        one_play,
        "The latency is from the stamp of a scan to a published grid (0.1 m) that includes it.",
        {**PLAYED, **LATENCY, "memory at half time, at the end": ""},
        methods=("dds", "zenoh"),
    ),
    Case(
        "ros-long",
        long_run,
        "The same recording repeated, one map with a budget of 16 kB, over DDS.",
        {"minutes": ".0f", "scans": ".0f", **LATENCY, "memory after each fifth": ""},
    ),
)

if __name__ == "__main__":
    minutes = {"type": float, "default": 10.0, "help": "of ros-long"}
    run(__doc__, *CASES, minutes=minutes)

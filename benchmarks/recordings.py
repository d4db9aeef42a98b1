"""Sixteen recordings on two workers, one of which is killed, beside one process.

    python benchmarks/recordings.py --data FOLDER

FOLDER holds street/ and laser2d/freiburg-campus.log.gz. The scans that are not held out are cut into
sixteen recordings. gmmtorch-map runs on all of them as one recording, and as sixteen. Every map answers about
the same points of the held-out scans, by the point form. Needs the
extra [cluster].
"""

from __future__ import annotations

import gzip
import itertools
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from gmmtorch import GaussianMap, datasets
from gmmtorch.experiments.evaluation.queries import hit_and_free, split_indices, test_beams
from gmmtorch.experiments.harness import Case, Row, run, score
from gmmtorch.mapping import TiledMap

N_PARTS, N_POINTS = 16, 20_000
CITY = 1e7  # metres of road
QUIET = ["report.progress=false", "report.figures=false", "report.tensorboard=false"]


@dataclass(frozen=True)
class Source:
    """A data set: name and path, every n-th scan held out, and side (m) of the cells that are asked."""

    name: str
    path: str
    test_every: int
    resolution: float


SOURCES = {
    "street": Source("scan_folder", "street", 5, 0.2),
    "freiburg-campus": Source("carmen", "laser2d/freiburg-campus.log.gz", 10, 0.1),
}


def cut(source: Source, path: Path, indices: list[int], target: Path) -> str:
    """Writes the scans with these indices as one recording; returns its path."""
    if source.name == "carmen":
        with gzip.open(path, "rt", errors="replace") as log:
            lines = [line for line in log if line.startswith("FLASER ")]
        target.with_suffix(".log").write_text("".join(lines[i] for i in indices))
        return str(target.with_suffix(".log"))
    (target / "scans").mkdir(parents=True)
    files, poses = sorted((path / "scans").iterdir()), (path / "poses.txt").read_text().splitlines()
    for i in indices:
        (target / "scans" / files[i].name).symlink_to(files[i])
    (target / "poses.txt").write_text("\n".join(poses[i] for i in indices) + "\n")
    return str(target)


def run_map(folder: Path, source: Source, options: list[str], kill: bool = False) -> tuple[float, list[Any]]:
    """Wall seconds of gmmtorch-map, and the rows of its results. `kill`: one worker with SIGKILL.

    A row without `cpu_seconds` gets those of the whole process.
    """
    given = [f"dataset={source.name}", f"resolution={source.resolution}", f"hydra.run.dir={folder}", *QUIET]
    begin = time.perf_counter()
    command = subprocess.Popen([sys.executable, "-m", "gmmtorch.cli.map", *given, *options])
    ended, status, usage = 0, 0, None
    while not ended:
        time.sleep(0.05)
        ended, status, usage = os.wait4(command.pid, os.WNOHANG)
        if kill and len(list(folder.glob("recordings/*/recording.json"))) >= N_PARTS // 4:
            kill = not kill_a_worker(command.pid)
    seconds = time.perf_counter() - begin
    if status:
        raise SystemExit(f"gmmtorch-map failed in {folder}")
    rows = json.loads((folder / "results.json").read_text())["rows"]
    for row in rows:
        row.setdefault("cpu_seconds", usage.ru_utime + usage.ru_stime)
    return seconds, rows


def kill_a_worker(parent: int) -> bool:
    """Kills a process that descends from `parent` and maps a recording. Whether there was one."""
    for place in Path("/proc").iterdir():
        if not place.name.isdigit():
            continue
        try:
            if not (place / "cmdline").read_bytes().startswith(b"ray::map_recording"):
                continue
            above = int(place.name)
            while above not in (0, 1, parent):
                above = int(Path(f"/proc/{above}/stat").read_text().rsplit(")", 1)[1].split()[1])
        except (OSError, ValueError):
            continue
        if above == parent:
            os.kill(int(place.name), signal.SIGKILL)
            return True
    return False


def memory(rows: list[Any]) -> str:
    """Memory (MB) of each worker after its first and after its last recording."""
    workers: dict[str, list[float]] = {}
    for row in rows:
        workers.setdefault(row["worker"], []).append(row["history"][-1]["memory_bytes"] / 1e6)
    return ", ".join(f"{values[0]:.0f} to {values[-1]:.0f}" for values in workers.values() if len(values) > 1)


@cache
def measured(name: str, data: Path) -> tuple[list[Row], dict[str, Any]]:
    """Rows of the runs, and what the last of them says of its merged map."""
    source = SOURCES[name]
    path = data.resolve() / source.path
    dataset = datasets.load(source.name, path)
    train, test = split_indices(len(dataset), source.test_every)
    beams = test_beams([dataset[i] for i in test], N_POINTS, 0)
    asked = hit_and_free(*beams, "uniform", source.resolution, 0)

    def row(about: str, seconds: float, cpu: float, built: Any, found: Any, used: str, merge: Any) -> Row:
        auc, n_bytes = score(built, asked, source.resolution), found["nbytes"] / 1e3
        return name, about, seconds, cpu, auc, found["n_components"], n_bytes, used, merge

    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        whole = cut(source, path, train, work / "whole")
        edges = [round(i * len(train) / N_PARTS) for i in range(N_PARTS + 1)]
        pieces = [train[a:b] for a, b in itertools.pairwise(edges)]
        parts = [cut(source, path, piece, work / f"part{i:02}") for i, piece in enumerate(pieces)]
        seconds, (found,) = run_map(work / "one", source, [f"dataset.path={whole}"])
        built = GaussianMap.load(work / "one" / "map.safetensors")
        first, last = (found["history"][i]["memory_bytes"] / 1e6 for i in (0, -1))
        used = f"{first:.0f} to {last:.0f}"
        rows = [row("one recording, one process", seconds, found["cpu_seconds"], built, found, used, None)]
        inputs = "inputs=[" + ",".join(f'"{part}"' for part in parts) + "]"
        files: list[dict[str, bytes]] = []
        for number, (about, options, kill) in enumerate(RUNS):
            target = work / f"many{number}"
            seconds, (*each, merged) = run_map(target, source, [inputs, *options], kill)
            tiled = TiledMap(target / "tiles")
            files.append({file.name: file.read_bytes() for file in tiled.folder.iterdir()})
            if kill and not merged["n_lost"]:
                raise SystemExit("no worker was lost; the run was too short")
            cpu = merged["cpu_seconds"] + merged["merge_cpu_seconds"]
            rows.append(row(about, seconds, cpu, tiled, merged, memory(each), merged["memory_bytes"] / 1e6))
    if any(each != files[0] for each in files):
        raise SystemExit("the tiles of the runs differ")
    return rows, merged


RUNS: tuple[tuple[str, list[str], bool], ...] = (
    ("16 recordings, one process", [], False),
    ("16 recordings, two workers", ["workers=2"], False),
    ("16 recordings, two workers, one killed", ["workers=2"], True),
)


def runs(options: Any) -> Iterator[Row]:
    for name in options.names:
        yield from measured(name, options.data)[0]


def costs(options: Any) -> Iterator[Row]:
    """By the last run, a metre, and for a city."""
    for name in options.names:
        merged = measured(name, options.data)[1]
        n_bytes = merged["nbytes"] / merged["metres"]
        seconds = (merged["cpu_seconds"] + merged["merge_cpu_seconds"]) / merged["metres"]
        city = CITY * n_bytes / 1e9, CITY * seconds / 3600
        yield name, merged["metres"], n_bytes, 1e3 * seconds, *city


RUN = {"data": "", "how": "", "wall s": ".0f", "CPU s": ".0f", "AUC": ".4f", "components": ",.0f"}
RUN |= {"kB": ".0f", "memory of a worker, MB": "", "merging, MB": ".0f"}
COSTS = {"data": "", "path": "{:,.0f} m", "bytes a metre": "{:.0f} B", "CPU a metre": "{:.0f} ms"}
COSTS |= {"bytes, 10,000 km": "{:.1f} GB", "core hours, 10,000 km": "{:.0f} h"}
CASES = (
    Case(
        "recordings",
        runs,
        "Merging: the peak memory of the process that merges.",
        RUN,
        tuple(SOURCES),
        key=2,
    ),
    Case(
        "recordings-costs",
        costs,
        "Of the last run; the CPU seconds are extrapolated to 10,000 km of roads.",
        COSTS,
        tuple(SOURCES),
    ),
)

if __name__ == "__main__":
    run(__doc__, *CASES)

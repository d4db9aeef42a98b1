"""Sixteen recordings on two workers, one of which is killed, beside one process.

    python benchmarks/recordings.py --data FOLDER [--write]

FOLDER holds street/ and laser2d/freiburg-campus.log.gz. The scans that are not held out are cut into
sixteen recordings. gmmtorch-map runs on all of them as one recording, and as sixteen. Every map answers about
the same points of the held-out scans, by the point form. --write puts the tables into BENCHMARKS.md. Needs
the extra [cluster].
"""

from __future__ import annotations

import argparse
import gzip
import itertools
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tables import hardware, markdown, publish

from gmmtorch import GaussianMap, datasets
from gmmtorch.experiments.evaluation.metrics import roc
from gmmtorch.experiments.evaluation.queries import (
    FREE,
    OCCUPIED,
    Queries,
    hit_and_free,
    split_indices,
    test_beams,
)
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


def auc(answer: Any, asked: Queries, resolution: float) -> float:
    theta = torch.as_tensor(answer.occupancy(asked.points, resolution))
    return roc(theta[asked.of(OCCUPIED)], theta[asked.of(FREE)]).auc


def memory(rows: list[Any]) -> str:
    """Memory (MB) of each worker after its first and after its last recording."""
    workers: dict[str, list[float]] = {}
    for row in rows:
        workers.setdefault(row["worker"], []).append(row["history"][-1]["memory_bytes"] / 1e6)
    return ", ".join(f"{values[0]:.0f} to {values[-1]:.0f}" for values in workers.values() if len(values) > 1)


def measure(name: str, data: Path, work: Path) -> tuple[list[list[object]], list[object]]:
    """Rows of the table of runs, and the row of the table of a city."""
    source = SOURCES[name]
    path = data / source.path
    dataset = datasets.load(source.name, path)
    train, test = split_indices(len(dataset), source.test_every)
    beams = test_beams([dataset[i] for i in test], N_POINTS, 0)
    asked = hit_and_free(*beams, "uniform", source.resolution, 0)
    whole = cut(source, path, train, work / "whole")
    edges = [round(i * len(train) / N_PARTS) for i in range(N_PARTS + 1)]
    pieces = [train[a:b] for a, b in itertools.pairwise(edges)]
    parts = [cut(source, path, piece, work / f"part{i:02}") for i, piece in enumerate(pieces)]

    seconds, (row,) = run_map(work / "one", source, [f"dataset.path={whole}"])
    built = GaussianMap.load(work / "one" / "map.safetensors")
    first, last = (row["history"][i]["memory_bytes"] / 1e6 for i in (0, -1))
    table: list[list[object]] = [
        [
            name,
            "one recording, one process",
            f"{seconds:.0f}",
            f"{row['cpu_seconds']:.0f}",
            f"{auc(built, asked, source.resolution):.4f}",
            f"{row['n_components']:,}",
            f"{row['nbytes'] / 1e3:.0f}",
            f"{first:.0f} to {last:.0f}",
            "",
        ]
    ]
    inputs = "inputs=[" + ",".join(f'"{part}"' for part in parts) + "]"
    runs = {
        "16 recordings, one process": ([], False),
        "16 recordings, two workers": (["workers=2"], False),
        "16 recordings, two workers, one killed": (["workers=2"], True),
    }
    files: list[dict[str, bytes]] = []
    for number, (about, (options, kill)) in enumerate(runs.items()):
        folder = work / f"many{number}"
        seconds, (*rows, merged) = run_map(folder, source, [inputs, *options], kill)
        tiled = TiledMap(folder / "tiles")
        files.append({file.name: file.read_bytes() for file in tiled.folder.iterdir()})
        if kill and not merged["n_lost"]:
            raise SystemExit("no worker was lost; the run was too short")
        table.append(
            [
                name,
                about,
                f"{seconds:.0f}",
                f"{merged['cpu_seconds'] + merged['merge_cpu_seconds']:.0f}",
                f"{auc(tiled, asked, source.resolution):.4f}",
                f"{merged['n_components']:,}",
                f"{merged['nbytes'] / 1e3:.0f}",
                memory(rows),
                f"{merged['memory_bytes'] / 1e6:.0f}",
            ]
        )
    if any(each != files[0] for each in files):
        raise SystemExit("the tiles of the runs differ")
    metre_bytes = merged["nbytes"] / merged["metres"]
    metre_seconds = (merged["cpu_seconds"] + merged["merge_cpu_seconds"]) / merged["metres"]
    city: list[object] = [
        name,
        f"{merged['metres']:,.0f} m",
        f"{metre_bytes:.0f} B",
        f"{1e3 * metre_seconds:.0f} ms",
        f"{CITY * metre_bytes / 1e9:.1f} GB",
        f"{CITY * metre_seconds / 3600:.0f} h",
    ]
    return table, city


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--write", action="store_true", help="put the tables into BENCHMARKS.md")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rows, cities = [], []
    for name in SOURCES:
        with tempfile.TemporaryDirectory() as work:
            table, city = measure(name, arguments.data.resolve(), Path(work))
        rows += table
        cities.append(city)
        print(markdown([""] * len(table[0]), table), city, flush=True)
    header = [
        "data",
        "how",
        "wall s",
        "CPU s",
        "AUC",
        "components",
        "kB",
        "memory of a worker, MB",
        "merging, MB",
    ]
    text = f"{hardware()}\n\n{markdown(header, rows)}"
    per_metre = [
        "data",
        "path",
        "bytes a metre",
        "CPU a metre",
        "bytes, 10,000 km",
        "core hours, 10,000 km",
    ]
    text += f"\n\n{markdown(per_metre, cities)}"
    if arguments.write:
        publish("recordings", text)
    else:
        print(text)


if __name__ == "__main__":
    main()

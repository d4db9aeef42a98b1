"""Poses estimated from scans alone, against true ones, beside KISS-ICP. Writes a table of BENCHMARKS.md.

    OMP_NUM_THREADS=1 python benchmarks/odometry.py --data FOLDER [--names hall] [--most 150] [--seeds 0 1]

FOLDER holds hall/, courtyard/, street/ and laser2d/. `--most` limits the scans of each. Each run moves all
points by noise of 1 mm, because a step that is nearly ambiguous may change with it. The first run also scores
the map of the scans with the given and with the estimated poses, as gmmtorch-occupancy does. Every run is a
line of the file `--runs`, which may hold runs of other calls; the table has all of them. One thread.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from tables import OUTPUTS, hardware, markdown, publish

import gmmtorch as gt
from gmmtorch.datasets import Dataset
from gmmtorch.experiments.evaluation.held_out import Protocol, evaluate
from gmmtorch.experiments.evaluation.mapping_methods import choose, methods
from gmmtorch.localization.odometry import METHODS, with_odometry
from gmmtorch.localization.trajectory_errors import absolute_trajectory_error, relative_pose_error

NOISE = 1e-3  # metres of standard deviation that move every point of a run
WRONG = 0.2  # metres of a step
HELD_OUT = {"hall": 5, "courtyard": 5, "street": 5}  # every n-th scan; 10 of the others
RESOLUTION = {2: 0.1, 3: 0.2}  # metres of a cell


def opened(data: Path, name: str, most: int | None) -> Dataset:
    log = data / f"laser2d/{name}.log.gz"
    found = gt.datasets.load("carmen", log) if log.is_file() else gt.datasets.load("scan_folder", data / name)
    if most is not None and most < len(found):
        found._count = lambda: most  # type: ignore[method-assign]
    return found


class Jittered(Dataset):
    """Scans whose points are moved by noise, another one for each seed."""

    def __init__(self, source: Dataset, seed: int) -> None:
        super().__init__(source.name, source.ranges)
        self._source, self._seed = source, seed

    def _count(self) -> int:
        return len(self._source)

    def _read(self, index: int) -> gt.Scan:
        scan = self._source[index]
        draw = torch.Generator().manual_seed(len(self) * self._seed + index)
        return replace(scan, points=scan.points + NOISE * torch.randn(scan.points.shape, generator=draw))

    def _known_pose(self, index: int) -> torch.Tensor | None:
        return self._source.pose(index)

    def _known_times(self) -> torch.Tensor | None:
        return self._source.times


def measured(scans: Dataset, method: str, seed: int, name: str) -> dict[str, object]:
    """The figures of one run."""
    begin = time.process_time()
    posed, trajectory = with_odometry(Jittered(scans, seed), method)
    seconds = time.process_time() - begin
    true = torch.stack([posed.own_pose(index) for index in range(len(posed))])
    steps, found = relative_pose_error(trajectory.poses, true).distances, trajectory.found
    is_wrong, is_lost = steps > WRONG, ~(found[1:] & found[:-1])
    figures = {
        "data": name,
        "method": method,
        "seed": seed,
        "n_scans": len(posed),
        "ate": absolute_trajectory_error(trajectory.poses, true).rmse,
        "step": float(steps.median()),
        "n_wrong": int(is_wrong.sum()),
        "n_noticed": int((is_wrong & is_lost).sum()),
        "n_lost": int((~found).sum()),
        "n_closures": trajectory.n_closures,
        "seconds": seconds,
    }
    if method == "mixture" and seed == 0:
        figures["auc"] = [map_score(each, name) for each in (scans, posed)]
    return figures


def map_score(scans: Dataset, name: str) -> float:
    """AUC of the map of the scans that are not held out, without a budget of bytes."""
    resolution = RESOLUTION[scans[0].dim]
    factories = choose(("point",), methods(partial(gt.GaussianMap, cutoff=3.0)))
    protocol = Protocol(HELD_OUT.get(name, 10), (1.0,), "beams", (resolution,), max_beams=50_000)
    return float(evaluate(name, list(scans), factories, protocol).rows[0]["auc"])


def row(runs: list[dict]) -> dict[str, object]:
    """The row of the table of one data set and method, of runs by seed."""
    mixture = runs[0]["method"] == "mixture"
    auc = next((run["auc"] for run in runs if "auc" in run), None)
    return {
        "data": runs[0]["data"],
        "scans": runs[0]["n_scans"],
        "odometry": runs[0]["method"],
        "ATE": ", ".join(f"{run['ate']:.2f}" for run in runs) + " m",
        "median step error": f"{1e3 * statistics.median(run['step'] for run in runs):.0f} mm",
        f"steps off by over {WRONG} m": _each(runs, "n_wrong"),
        "of these, called lost": _each(runs, "n_noticed") if mixture else "",
        "lost scans": _each(runs, "n_lost") if mixture else "",
        "closures": _each(runs, "n_closures") if mixture else "",
        "scans/s": f"{statistics.median(run['n_scans'] / run['seconds'] for run in runs):.1f}",
        "AUC given → estimated poses": "" if auc is None else " → ".join(f"{score:.3f}" for score in auc),
    }


def _each(runs: list[dict], name: str) -> str:
    return ", ".join(str(run[name]) for run in runs)


def table(file: Path) -> str:
    """All runs of a file; a later run replaces an earlier one of the same data, method and seed."""
    lines = [json.loads(line) for line in file.read_text().splitlines()]
    kept = {(run["data"], run["method"], run["seed"]): run for run in lines}
    rows = []
    for name, method in dict.fromkeys((name, method) for name, method, _ in kept):
        runs = [kept[key] for key in sorted(kept) if key[:2] == (name, method)]
        rows.append(row(runs))
    return markdown(list(rows[0]), [list(one.values()) for one in rows])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    names = ["hall", "courtyard", "street", "intel", "freiburg-101", "aces"]
    parser.add_argument("--names", nargs="*", default=names)
    parser.add_argument("--methods", nargs="+", default=METHODS)
    parser.add_argument("--most", type=int)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--runs", type=Path, default=OUTPUTS / "odometry_runs.jsonl")
    options = parser.parse_args()
    torch.set_num_threads(1)
    for name in options.names:
        scans = opened(options.data, name, options.most)
        for method in options.methods:
            for seed in options.seeds:
                line = json.dumps(measured(scans, method, seed, name))
                print(line, flush=True)
                with options.runs.open("a") as file:
                    file.write(line + "\n")
    publish("odometry", f"{table(options.runs)}\n\n{hardware()}")


if __name__ == "__main__":
    main()

"""Poses estimated from scans alone, against true ones, beside KISS-ICP. Writes a table of BENCHMARKS.md.

    OMP_NUM_THREADS=1 python benchmarks/odometry.py --data FOLDER [--names hall intel] [--most 150] [--runs 3]

FOLDER holds hall/, courtyard/, street/ and laser2d/. `--most` limits the scans of each. Each run moves all
points by noise of 1 mm, because a step that is nearly ambiguous may change with it. One thread.
"""

from __future__ import annotations

import argparse
import statistics
import time
from dataclasses import replace
from pathlib import Path

import torch
from tables import hardware, markdown, publish

import gmmtorch as gt
from gmmtorch.datasets import Dataset
from gmmtorch.evaluation.trajectories import absolute_trajectory_error, relative_pose_error
from gmmtorch.localization.recorded_poses import METHODS, with_odometry

NOISE = 1e-3  # metres of standard deviation that move every point of a run
WRONG = 0.2  # metres of a step


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


def row(scans: Dataset, method: str, runs: int) -> dict[str, object]:
    rates, errors, median_steps, wrong, unnoticed, lost, closures = [], [], [], [], [], [], []
    for seed in range(runs):
        begin = time.process_time()
        posed, trajectory = with_odometry(Jittered(scans, seed), method)
        rates.append(len(posed) / (time.process_time() - begin))
        true = torch.stack([posed.own_pose(index) for index in range(len(posed))])
        steps = relative_pose_error(trajectory.poses, true).distances
        errors.append(absolute_trajectory_error(trajectory.poses, true).rmse)
        median_steps.append(1e3 * float(steps.median()))
        found = trajectory.found
        wrong.append(int((steps > WRONG).sum()))
        unnoticed.append(int(((steps > WRONG) & found[1:] & found[:-1]).sum()))
        lost.append(int((~found).sum()))
        closures.append(trajectory.n_closures)
        print(scans.name, method, seed, errors[-1], wrong[-1], unnoticed[-1], lost[-1], flush=True)
    return {
        "data": scans.name,
        "scans": len(scans),
        "odometry": method,
        "ATE": f"{statistics.median(errors):.2f} m",
        "worst ATE": f"{max(errors):.2f} m",
        "median step error": f"{statistics.median(median_steps):.0f} mm",
        f"steps off by over {WRONG} m": _each(wrong),
        "of these, not called lost": _each(unnoticed),
        "lost scans": _each(lost) if method == "mixture" else "",
        "closures": _each(closures) if method == "mixture" else "",
        "scans/s": f"{statistics.median(rates):.1f}",
    }


def _each(counts: list[int]) -> str:
    return ", ".join(map(str, counts))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--names", nargs="+", default=["hall", "intel", "freiburg-101", "aces"])
    parser.add_argument("--most", type=int)
    parser.add_argument("--runs", type=int, default=3)
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows = [
        row(opened(options.data, name, options.most), method, options.runs)
        for name in options.names
        for method in METHODS
    ]
    table = markdown(list(rows[0]), [list(one.values()) for one in rows])
    publish("odometry", f"{table}\n\n{hardware()}")


if __name__ == "__main__":
    main()

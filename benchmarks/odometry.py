"""Poses estimated from scans alone, against true ones, beside KISS-ICP.

    OMP_NUM_THREADS=1 python benchmarks/odometry.py --data FOLDER [--names hall] [--most 150] [--seeds 0 1]

FOLDER holds hall/, courtyard/, street/ and laser2d/. `--most` limits the scans of each. Each run moves all
points by noise of 1 mm, because a step that is nearly ambiguous may change with it. The first run also scores
the map of the scans with the given and with the estimated poses, as gmmtorch-occupancy does.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from harness import Case, Row, cpu_seconds, held_out, recording, run

import gmmtorch as gt
from gmmtorch.datasets import Dataset
from gmmtorch.evaluation.held_out import Protocol, evaluate
from gmmtorch.evaluation.methods import choose, methods
from gmmtorch.evaluation.trajectories import absolute_trajectory_error, relative_pose_error
from gmmtorch.localization.odometry.recorded_poses import METHODS, with_odometry

NOISE = 1e-3  # metres of standard deviation that move every point of a run
WRONG = 0.2  # metres of a step
RESOLUTION = {2: 0.1, 3: 0.2}  # metres of a cell


def first(most: int | None, data: Path, name: str) -> Dataset:
    """The first scans of a recording."""
    found = recording(data, name)
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


def measured(scans: Dataset, method: str, seed: int) -> dict[str, Any]:
    """The figures of one run."""
    jittered = Jittered(scans, seed)
    seconds, (posed, trajectory) = cpu_seconds(lambda: with_odometry(jittered, method))
    true = torch.stack([posed.own_pose(index) for index in range(len(posed))])
    steps, found = relative_pose_error(trajectory.poses, true).distances, trajectory.found
    is_wrong, is_lost = steps > WRONG, ~(found[1:] & found[:-1])
    return {
        "ate": f"{absolute_trajectory_error(trajectory.poses, true).rmse:.2f}",
        "step": float(steps.median()),
        "wrong": str(int(is_wrong.sum())),
        "noticed": str(int((is_wrong & is_lost).sum())),
        "lost": str(int((~found).sum())),
        "closures": str(trajectory.n_closures),
        "rate": len(posed) / seconds,
        "posed": posed,
    }


def map_score(scans: Dataset, name: str) -> float:
    """AUC of the map of the scans that are not held out, without a budget of bytes."""
    resolution = RESOLUTION[scans[0].dim]
    factories = choose(("point",), methods(partial(gt.GaussianMap, cutoff=3.0)))
    protocol = Protocol(held_out(scans), (1.0,), "beams", (resolution,), max_beams=50_000)
    return float(evaluate(name, list(scans), factories, protocol).rows[0]["auc"])


def measure(options: Any) -> Iterator[Row]:
    """A row for each recording and method, of runs by seed."""
    for name in options.names:
        scans = first(options.most, options.data, name)
        for method in options.methods:
            runs = [measured(scans, method, seed) for seed in options.seeds]
            each = {part: ", ".join(r[part] for r in runs) for part in ("ate", "wrong")}
            if method == "mixture":
                each |= {part: ", ".join(r[part] for r in runs) for part in ("noticed", "lost", "closures")}
            row: dict[str, Any] = {
                "data": name,
                "scans": len(scans),
                "odometry": method,
                "ATE": each["ate"] + " m",
                "median step error": 1e3 * statistics.median(r["step"] for r in runs),
                f"steps off by over {WRONG} m": each["wrong"],
                "of these, called lost": each.get("noticed"),
                "lost scans": each.get("lost"),
                "closures": each.get("closures"),
                "scans/s": statistics.median(r["rate"] for r in runs),
            }
            if method == "mixture":
                scores = [f"{map_score(which, name):.3f}" for which in (scans, runs[0]["posed"])]
                row["AUC given → estimated poses"] = " → ".join(scores)
            yield row


FORMATS = {"scans": ".0f", "median step error": "{:.0f} mm", "scans/s": ".1f"}
NAMES = ("intel", "freiburg-101", "hall", "courtyard", "aces", "street")
CASE = Case(
    "odometry",
    measure,
    "A cell with several numbers has one for each run.",
    FORMATS,
    NAMES,
    tuple(METHODS),
    key=3,
)
MOST = {"type": int, "help": "scans of each recording"}

if __name__ == "__main__":
    run(__doc__, CASE, most=MOST, seeds={"type": int, "nargs": "+", "default": [0, 1, 2]})

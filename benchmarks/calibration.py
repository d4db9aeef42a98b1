"""Calibration on held-out real scans: our map with its defaults beside grids and OctoMap, at all resolutions.

    python benchmarks/calibration.py --data FOLDER

FOLDER holds laser2d/*.log.gz, hall/, courtyard/, kinect/ and street/. Half of the test points are ends of
held-out beams, the others lie anywhere on them. Peers have two figures: as they are, and calibrated by what
they say about scans before they learn from them.
Writes its tables into BENCHMARKS.md.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import torch
from tables import hardware, markdown, publish

from gmmtorch import GaussianMap, datasets
from gmmtorch.datasets import Dataset
from gmmtorch.errors import MemoryLimitError
from gmmtorch.experiments.evaluation.held_out import Built, Protocol, evaluate
from gmmtorch.experiments.evaluation.mapping_methods import choose, methods
from gmmtorch.experiments.evaluation.metrics import accuracy, separating_threshold

METHODS = ("point", "occupancy_grid", "occupancy_log_odds", "octomap")
PLANAR = ("intel", "aces", "freiburg-101", "freiburg-campus", "orebro", "seattle")
SOLID = ("hall", "courtyard", "street", "kinect")
SIDES = (0.05, 0.1, 0.2, 0.4)
SMALLEST = {"courtyard": 0.2, "street": 0.4}  # cells (m) of OctoMap, else 0.1: smaller ones take minutes
MAX_BEAMS = 50_000


def opened(folder: Path, name: str) -> tuple[Dataset, int, tuple[float, ...]]:
    """A data set, every how many scans are held out, and resolutions (m)."""
    if name in PLANAR:
        return datasets.load("carmen", folder / "laser2d" / f"{name}.log.gz"), 10, (0.02, *SIDES)
    if name == "kinect":
        return datasets.load("depth_frames", folder / name, pixel_stride=2), 5, SIDES
    return datasets.load("scan_folder", folder / name), 5, SIDES


def best_accuracy(built: Built) -> float:
    """The accuracy with the threshold that separates the test points best."""
    threshold = separating_threshold(*built.asked.split(built.theta))
    return accuracy((built.theta >= threshold).double(), built.asked.labels)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--names", nargs="+", default=[*PLANAR, *SOLID], help="data sets; all if not given")
    options = parser.parse_args()
    torch.set_num_threads(1)
    ours: list[list[object]] = []
    peers: list[list[object]] = []
    for name in options.names:
        data, test_every, sides = opened(options.data, name)
        scans = list(data)
        for side in sides:
            names = METHODS if side >= SMALLEST.get(name, 0.1) else METHODS[:-1]
            protocol = Protocol(test_every, (1.0,), "beams", (side,), max_beams=MAX_BEAMS)
            try:
                outcome = evaluate(name, scans, choose(names, methods(GaussianMap)), protocol)
            except MemoryLimitError:  # cells of a street
                outcome = evaluate(name, scans, choose(METHODS[:1], methods(GaussianMap)), protocol)
            rows: dict[str, Any] = {row["method"]: row for row in outcome.rows}
            row = rows["point"]
            values = [row["ece"], row["brier"], row["log_loss_bits"], row["accuracy"]]
            values.append(best_accuracy(outcome.shown[0]))
            ours.append([name, f"{side:g}", *(f"{value:.3f}" for value in values), f"{row['auc']:.4f}"])
            peers.append([name, f"{side:g}"])
            for score in ("log_loss_bits", "ece"):
                peers[-1] += [pair(rows.get(method), score) for method in METHODS]
            print(*ours[-1], *peers[-1][2:], sep=" | ", flush=True)
    header = ["data", "cell (m)", "ECE", "Brier", "log-loss (bits)", "accuracy at ½", "at best", "AUC"]
    note = "Our map with its defaults: one map of each data set, asked at all resolutions."
    first = f"{note} {hardware()}\n\n{markdown(header, ours)}"
    header = ["data", "cell (m)", *(f"log-loss, {m}" for m in METHODS), *(f"ECE, {m}" for m in METHODS)]
    note = "Beside peers, which are built anew for each resolution: as they are → calibrated."
    publish("calibration", f"{first}\n\n{note}\n\n{markdown(header, peers)}")


def pair(row: dict[str, Any] | None, name: str) -> str:
    """A score of a map, and what it is after calibration if the map has none of its own."""
    if row is None:
        return "—"
    after = row[f"calibrated_{name}"]
    return f"{row[name]:.3f}" + ("" if after is None else f" → {after:.3f}")


if __name__ == "__main__":
    main()

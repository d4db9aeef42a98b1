"""Calibration on held-out real scans: our map with its defaults beside grids and OctoMap, at all resolutions.

    python benchmarks/calibration.py --data FOLDER

FOLDER holds laser2d/*.log.gz, hall/, courtyard/, kinect/ and street/. Half of the test points are ends of
held-out beams, the others lie anywhere on them. Peers have two figures: as they are, and calibrated by what
they say about scans before they learn from them.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

from gmmtorch import GaussianMap
from gmmtorch.errors import MemoryLimitError
from gmmtorch.experiments.evaluation import Built, Protocol, choose, evaluate, methods
from gmmtorch.experiments.evaluation.metrics import scores
from gmmtorch.experiments.harness import Case, Row, held_out, recording, run

METHODS = ("point", "occupancy_grid", "occupancy_log_odds", "octomap")
PLANAR = ("intel", "aces", "freiburg-101", "freiburg-campus", "orebro", "seattle")
NAMES = (*PLANAR, "hall", "courtyard", "street", "kinect")
SIDES = (0.05, 0.1, 0.2, 0.4)
SMALLEST = {"courtyard": 0.2, "street": 0.4}  # cells (m) of OctoMap, else 0.1: smaller ones take minutes
MAX_BEAMS = 50_000


@cache
def scored(data: Path, name: str, chosen: tuple[str, ...]) -> list[tuple[float, Built, dict[str, Any]]]:
    """For each side of cells: what our map answered, and a row of results by method."""
    dataset = recording(data, name, **({"pixel_stride": 2} if name == "kinect" else {}))
    scans, found = list(dataset), []
    for side in (0.02, *SIDES) if name in PLANAR else SIDES:
        names = [n for n in chosen if n != "octomap" or side >= SMALLEST.get(name, 0.1)]
        protocol = Protocol(held_out(dataset), (1.0,), "beams", (side,), max_beams=MAX_BEAMS)
        try:
            outcome = evaluate(name, scans, choose(names, methods(GaussianMap)), protocol)
        except MemoryLimitError:  # cells of a street
            outcome = evaluate(name, scans, choose(METHODS[:1], methods(GaussianMap)), protocol)
        found.append((side, outcome.shown[0], {row["method"]: row for row in outcome.rows}))
    return found


def best_accuracy(built: Built) -> float:
    """The accuracy with the threshold that separates the test points best."""
    return scores((built.theta >= built.roc.separating).double(), built.asked.labels)["accuracy"]


def ours(options: Any) -> Iterator[Row]:
    for name in options.names:
        for side, built, rows in scored(options.data, name, METHODS):
            row = rows["point"]
            shown = (row[field] for field in ("ece", "brier", "log_loss_bits", "accuracy"))
            yield name, side, *shown, best_accuracy(built), row["auc"]


def peers(options: Any) -> Iterator[Row]:
    for name in options.names:
        for side, _, rows in scored(options.data, name, tuple(options.methods)):
            row: dict[str, Any] = {"data": name, "cell (m)": side}
            for title, field in (("log-loss", "log_loss_bits"), ("ECE", "ece")):
                row |= {f"{title}, {method}": pair(rows.get(method), field) for method in options.methods}
            yield row


def pair(row: dict[str, Any] | None, name: str) -> str:
    """A score of a map, and what it is after calibration if the map has none of its own."""
    if row is None:
        return "—"
    after = row[f"calibrated_{name}"]
    return f"{row[name]:.3f}" + ("" if after is None else f" → {after:.3f}")


SCORES = dict.fromkeys(("ECE", "Brier", "log-loss (bits)", "accuracy at ½", "at best"), ".3f")
CASES = (
    Case(
        "calibration",
        ours,
        "Our map with its defaults: one map of each data set, asked at all resolutions.",
        {"data": "", "cell (m)": "3", **SCORES, "AUC": ".4f"},
        NAMES,
        key=2,
    ),
    Case(
        "calibration-peers",
        peers,
        "Peers are built anew for each resolution: as they are → calibrated.",
        {"cell (m)": "3"},
        NAMES,
        METHODS,
        key=2,
    ),
)

if __name__ == "__main__":
    run(__doc__, *CASES)

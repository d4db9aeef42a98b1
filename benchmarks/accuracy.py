"""AUC on held-out real scans: our map beside grids, at every share of the beams kept.

    python benchmarks/accuracy.py --data FOLDER

FOLDER holds laser2d/*.log.gz, hall/, courtyard/ and kinect/. The defaults of
gmmtorch-occupancy, but for the budget of maps in 3D.
Writes its tables into BENCHMARKS.md and README.md.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
from tables import ROOT, hardware, markdown, publish

from gmmtorch import GaussianMap, IncrementalRule, datasets
from gmmtorch.datasets import Dataset
from gmmtorch.experiments.evaluation.held_out import Protocol, evaluate
from gmmtorch.experiments.evaluation.mapping_methods import choose, methods

KEPT = (1.0, 0.3, 0.1, 0.05)


METHODS = ("occupancy_grid", "occupancy_log_odds", "monte_carlo", "point")
MAX_BEAMS = 50_000


class Source(NamedTuple):
    """Data set, every how many scans are held out, resolutions (m), and the budget of our map in bytes."""

    dataset: Dataset
    test_every: int
    resolutions: tuple[float, ...]
    max_bytes: int | None = None


def sources(folder: Path) -> dict[str, Source]:
    planar = {
        name: Source(datasets.load("carmen", folder / "laser2d" / f"{name}.log.gz"), 10, (0.1, 0.02))
        for name in ("intel", "aces", "freiburg-101")
    }
    frames = datasets.load("depth_frames", folder / "kinect", pixel_stride=2)
    solid = {
        "hall": Source(datasets.load("scan_folder", folder / "hall"), 5, (0.2,), 8000),
        "courtyard": Source(datasets.load("scan_folder", folder / "courtyard"), 5, (0.2,), 16_000),
        "kinect": Source(frames, 5, (0.05,), 8000),
    }
    return {**planar, **solid}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--names", nargs="+", help="data sets; all if not given")
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows: list[list[object]] = []
    short: list[list[object]] = []
    for name, (dataset, test_every, resolutions, max_bytes) in sources(options.data).items():
        if options.names and name not in options.names:
            continue
        rule = IncrementalRule(max_bytes=max_bytes)
        # What gmmtorch-occupancy takes unless it is told otherwise.
        factories = choose(METHODS, methods(partial(GaussianMap, rule, cutoff=3.0)))
        protocol = Protocol(test_every, KEPT, "beams", resolutions, max_beams=MAX_BEAMS)
        outcome = evaluate(name, list(dataset), factories, protocol)
        for resolution in resolutions:
            short.append([name, f"{resolution:g} m", *brief(outcome.rows, resolution)])
            for kept in KEPT:
                cells = {
                    row["method"]: row
                    for row in outcome.rows
                    if row["resolution"] == resolution and row["kept"] == kept
                }
                rows.append([name, f"{resolution:g}", f"{kept:.0%}", *(summary(cells[m]) for m in METHODS)])
                print(*rows[-1], sep=" | ", flush=True)
    header = ["data", "cell (m)", "beams kept", *METHODS]
    note = "AUC ± half the width of its 95 % bootstrap interval, components, file size."
    publish("accuracy", f"{note} {hardware()}\n\n{markdown(header, rows)}")
    header = ["data", "cell", "100 %", "30 %", "10 %", "grid", "mixture"]
    publish("readme-accuracy", markdown(header, short), ROOT / "README.md")


def brief(rows: list[dict], resolution: float) -> list[str]:
    """AUC of grid → mixture at three shares, and their bytes with all beams."""

    def find(method: str, kept: float) -> dict:
        wanted = (method, kept, resolution)
        return next(row for row in rows if (row["method"], row["kept"], row["resolution"]) == wanted)

    pairs = [(find("occupancy_grid", kept), find("point", kept)) for kept in (1.0, 0.3, 0.1)]
    cells = [f"{grid['auc']:.3f} → {ours['auc']:.3f}" for grid, ours in pairs]
    return [*cells, *(f"{row['nbytes'] / 1e3:,.0f} kB" for row in pairs[0])]


def summary(row: dict) -> str:
    size = f"{row['nbytes'] / 1e3:,.0f} kB"
    count = f"{row['n_components']:,}, " if row["n_components"] is not None else ""
    return f"{row['auc']:.4f} ± {(row['auc_high'] - row['auc_low']) / 2:.4f} ({count}{size})"


if __name__ == "__main__":
    main()

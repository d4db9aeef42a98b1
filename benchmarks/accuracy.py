"""AUC on held-out real scans: mixtures beside grids, at every share of the beams kept.

    python benchmarks/accuracy.py --data FOLDER

FOLDER holds laser2d/*.log.gz, hall/, courtyard/ and kinect/. The same settings for every data set.
Writes its tables into BENCHMARKS.md and README.md.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from tables import ROOT, hardware, markdown, publish

from gmmtorch import GaussianMap, WindowedRule, datasets
from gmmtorch.datasets import Dataset
from gmmtorch.evaluation.contenders import methods
from gmmtorch.evaluation.occupancy import Protocol, evaluate

KEPT = (1.0, 0.3, 0.1, 0.05)


def sources(folder: Path) -> dict[str, tuple[Dataset, int, tuple[float, ...]]]:
    """Data set, every how many scans are held out, resolutions."""
    planar = {
        name: (datasets.load("carmen", folder / "laser2d" / f"{name}.log.gz"), 10, (0.1, 0.02))
        for name in ("intel", "aces", "freiburg-101")
    }
    solid = {
        "hall": (datasets.load("scan_folder", folder / "hall"), 5, (0.2,)),
        "courtyard": (datasets.load("scan_folder", folder / "courtyard"), 5, (0.2,)),
        "kinect": (datasets.load("depth_frames", folder / "kinect"), 5, (0.05,)),
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
    factories = {
        **methods(GaussianMap),
        "monte_carlo, per scan": lambda resolution: GaussianMap(WindowedRule(window=1, max_origins=1)),
    }
    for name, (dataset, test_every, resolutions) in sources(options.data).items():
        if options.names and name not in options.names:
            continue
        outcome = evaluate(name, list(dataset), factories, Protocol(test_every, KEPT, "beams", resolutions))
        for resolution in resolutions:
            short.append([name, f"{resolution:g} m", *brief(outcome.rows, resolution)])
            for kept in KEPT:
                cells = {
                    row["method"]: row
                    for row in outcome.rows
                    if row["resolution"] == resolution and row["kept"] == kept
                }
                rows.append([name, f"{resolution:g}", f"{kept:.0%}", *(summary(cells[m]) for m in factories)])
                print(*rows[-1], sep=" | ", flush=True)
    header = ["data", "cell (m)", "beams kept", *factories]
    note = "AUC ± half the width of its 95 % bootstrap interval, components, file size."
    publish("accuracy", f"{note} {hardware()}\n\n{markdown(header, rows)}")
    header = ["data", "cell", "100 %", "30 %", "10 %", "grid", "mixture"]
    publish("readme-accuracy", markdown(header, short), ROOT / "README.md")


def brief(rows: list[dict], resolution: float) -> list[str]:
    """AUC of grid → mixture at three shares, and their bytes with all beams."""

    def find(method: str, kept: float) -> dict:
        wanted = (method, kept, resolution)
        return next(row for row in rows if (row["method"], row["kept"], row["resolution"]) == wanted)

    pairs = [(find("occupancy_grid", kept), find("monte_carlo", kept)) for kept in (1.0, 0.3, 0.1)]
    cells = [f"{grid['auc']:.3f} → {ours['auc']:.3f}" for grid, ours in pairs]
    return [*cells, *(f"{row['nbytes'] / 1e3:,.0f} KB" for row in pairs[0])]


def summary(row: dict) -> str:
    size = f"{row['nbytes'] / 1e3:,.0f} KB"
    count = f"{row['n_components']:,}, " if row["n_components"] is not None else ""
    return f"{row['auc']:.4f} ± {(row['auc_high'] - row['auc_low']) / 2:.4f} ({count}{size})"


if __name__ == "__main__":
    main()

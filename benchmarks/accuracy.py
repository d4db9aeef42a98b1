"""AUC on held-out real scans: our map beside grids, at every share of the beams kept.

    python benchmarks/accuracy.py --data FOLDER

FOLDER holds laser2d/*.log.gz, hall/, courtyard/ and kinect/. The defaults of gmmtorch-occupancy, but for the
budget of maps in 3D.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache, partial
from pathlib import Path
from typing import Any

from harness import Case, Row, held_out, recording, run

from gmmtorch import GaussianMap, IncrementalRule
from gmmtorch.evaluation.held_out import Protocol, evaluate
from gmmtorch.evaluation.methods import choose, methods

KEPT = (1.0, 0.3, 0.1, 0.05)
METHODS = ("occupancy_grid", "occupancy_log_odds", "monte_carlo", "point")
MAX_BEAMS = 50_000
CELLS = {"hall": (0.2,), "courtyard": (0.2,), "kinect": (0.05,)}  # metres; of 2D logs PLANAR
PLANAR = (0.1, 0.02)
BUDGETS = {"hall": 8000, "courtyard": 16_000, "kinect": 8000}  # bytes of our map
NAMES = ("intel", "aces", "freiburg-101", "hall", "courtyard", "kinect")


@cache
def scored(data: Path, name: str, chosen: tuple[str, ...]) -> list[dict[str, Any]]:
    """A row of results for each method, share of the beams and cell."""
    dataset = recording(data, name, **({"pixel_stride": 2} if name == "kinect" else {}))
    rule = IncrementalRule(max_bytes=BUDGETS.get(name))
    # What gmmtorch-occupancy takes unless it is told otherwise.
    factories = choose(chosen, methods(partial(GaussianMap, rule, cutoff=3.0)))
    cells = CELLS.get(name, PLANAR)
    protocol = Protocol(held_out(dataset), KEPT, "beams", cells, max_beams=MAX_BEAMS)
    return evaluate(name, list(dataset), factories, protocol).rows


def whole(options: Any) -> Iterator[Row]:
    for name in options.names:
        rows = scored(options.data, name, tuple(options.methods))
        for cell in CELLS.get(name, PLANAR):
            for kept in KEPT:
                found = {r["method"]: r for r in rows if r["resolution"] == cell and r["kept"] == kept}
                label: Row = {"data": name, "cell (m)": cell, "beams kept": f"{kept:.0%}"}
                yield {**label, **{method: summary(found[method]) for method in options.methods}}


def summary(row: dict[str, Any]) -> str:
    size = f"{row['nbytes'] / 1e3:,.0f} kB"
    count = f"{row['n_components']:,}, " if row["n_components"] is not None else ""
    return f"{row['auc']:.4f} ± {(row['auc_high'] - row['auc_low']) / 2:.4f} ({count}{size})"


def brief(options: Any) -> Iterator[Row]:
    """AUC of grid → mixture at three shares, and their bytes with all beams."""
    for name in options.names:
        rows = {(r["method"], r["kept"], r["resolution"]): r for r in scored(options.data, name, METHODS)}
        for cell in CELLS.get(name, PLANAR):
            row: dict[str, Any] = {"data": name, "cell": f"{cell:g} m"}
            for kept in KEPT[:3]:
                grid, ours = (rows[method, kept, cell] for method in ("occupancy_grid", "point"))
                row[f"{100 * kept:g} %"] = f"{grid['auc']:.3f} → {ours['auc']:.3f}"
            for side, method in (("grid", "occupancy_grid"), ("mixture", "point")):
                row[side] = rows[method, 1.0, cell]["nbytes"] / 1e3
            yield row


ABOUT = "AUC ± half the width of its 95 % bootstrap interval, components, file size."
BRIEFLY = "AUC, count grid → mixture, by the share of the beams; file sizes with all beams."
CASES = (
    Case("accuracy", whole, ABOUT, {"cell (m)": "3"}, NAMES, METHODS, key=3),
    Case("readme-accuracy", brief, BRIEFLY, dict.fromkeys(("grid", "mixture"), "{:,.0f} kB"), NAMES, key=2),
)

if __name__ == "__main__":
    run(__doc__, *CASES)

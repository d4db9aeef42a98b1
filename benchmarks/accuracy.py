"""AUC on held-out real scans: our map beside grids, by share of the beams and by learning rule.

    python benchmarks/accuracy.py --data FOLDER [--only accuracy readme-accuracy]

FOLDER holds laser2d/*.log.gz, hall/, courtyard/ and kinect/. The defaults of gmmtorch-occupancy, but for the
budget of maps in 3D. `components-NAME` has AUC, components and bytes of maps as their learning rule varies.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache, partial
from pathlib import Path
from typing import Any

from gmmtorch import GaussianMap, IncrementalRule, WindowedRule
from gmmtorch.datasets import Dataset
from gmmtorch.experiments.evaluation import Protocol, choose, evaluate, methods
from gmmtorch.experiments.harness import Case, Row, held_out, recording, run

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
                label: dict[str, Any] = {"data": name, "cell (m)": cell, "beams kept": f"{kept:.0%}"}
                yield label | {method: summary(found[method]) for method in options.methods}


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


RULES: dict[str, dict[str, float]] = {
    "default": {},
    "noise 5 mm": {"noise": 0.005},
    "noise 20 mm": {"noise": 0.02},
    "length 0.15 m": {"length": 0.15},
    "length 0.6 m": {"length": 0.6},
    "half min_points": {"min_points": 0.5},  # times the default of the dimension
    "twice min_points": {"min_points": 2},
    "no EM after the cuts": {"iterations": 1},
    "20 iterations of EM": {"iterations": 20},
    "2 origins": {"max_origins": 2},
    "20 origins": {"max_origins": 20},
    "window of 5": {"window": 5},
    "window of 50": {"window": 50},
    "one scan, one origin": {"window": 1, "max_origins": 1},
}


def protocol(name: str, dataset: Dataset) -> Protocol:
    if dataset[0].dim == 2:
        return Protocol(kept=(1.0, 0.1), resolution=(0.1, 0.02))
    return Protocol(held_out(dataset), (1.0, 0.1), "beams", (0.05 if name == "kinect" else 0.2,))


def by_rule(name: str, options: Any) -> Iterator[Row]:
    dataset = recording(options.data, name, **({"pixel_stride": 2} if name == "kinect" else {}))
    scans, asked = list(dataset), protocol(name, dataset)
    for rule, changes in RULES.items():
        found = evaluate(name, scans, {"monte_carlo": factory(changes, dataset[0].dim)}, asked)
        yield columns(rule, found.rows)
    grid = evaluate(name, scans, {"occupancy_grid": methods(GaussianMap)["occupancy_grid"]}, asked)
    yield columns("(count grid)", grid.rows)


def factory(changes: dict[str, float], dim: int):
    """Makes maps whose rule has these changes from the default."""
    options = dict(changes)
    window = int(options.pop("window", 20))
    if "min_points" in options:
        options["min_points"] *= 6 if dim == 2 else 20
    for whole in ("iterations", "max_origins"):
        if whole in options:
            options[whole] = int(options[whole])
    rule = WindowedRule(window=window, **options)  # type: ignore[arg-type]
    return lambda resolution: GaussianMap(rule, cutoff=5.0, prior=1.0)


def columns(name: str, rows: list[dict[str, Any]]) -> Row:
    """AUC for each share and resolution, components and bytes for each share."""
    cells: dict[str, Any] = {"rule": name}
    for kept in dict.fromkeys(row["kept"] for row in rows):
        of = [row for row in rows if row["kept"] == kept]
        for row in of:
            cells[f"AUC, {kept:.0%}, {row['resolution']:g} m"] = row["auc"]
        cells[f"components, {kept:.0%}"] = f"{of[0]['n_components'] or '–'}"
        cells[f"kB, {kept:.0%}"] = of[0]["nbytes"] / 1e3
    return cells


COMPONENTS = {
    f"AUC, {share}, {cell} m": ".4f" for share in ("100%", "10%") for cell in (0.1, 0.02, 0.2, 0.05)
}
COMPONENTS |= dict.fromkeys(("kB, 100%", "kB, 10%"), ".0f")
ABOUT = "AUC ± half the width of its 95 % bootstrap interval, components, file size."
BRIEFLY = "AUC, count grid → mixture, by the share of the beams; file sizes with all beams."
CASES = (
    Case("accuracy", whole, ABOUT, {"cell (m)": "3"}, NAMES, METHODS, key=3),
    Case("readme-accuracy", brief, BRIEFLY, dict.fromkeys(("grid", "mixture"), "{:,.0f} kB"), NAMES, key=2),
    *(
        Case(f"components-{name}", partial(by_rule, name), name, COMPONENTS)
        for name in ("intel", "aces", "hall", "kinect")
    ),
)

if __name__ == "__main__":
    run(__doc__, *CASES)

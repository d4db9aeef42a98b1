"""How many components: AUC and bytes of the map as its learning rule varies.

    python benchmarks/components.py --data FOLDER [--only components-hall]

FOLDER holds laser2d/intel.log.gz, laser2d/aces.log.gz, hall/ and kinect/.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

from harness import Case, Row, held_out, recording, run

from gmmtorch import GaussianMap, WindowedRule
from gmmtorch.datasets import Dataset
from gmmtorch.evaluation.held_out import Protocol, evaluate
from gmmtorch.evaluation.methods import methods

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


def measure(name: str, options: Any) -> Iterator[Row]:
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


FORMATS = {f"AUC, {share}, {cell} m": ".4f" for share in ("100%", "10%") for cell in (0.1, 0.02, 0.2, 0.05)}
FORMATS |= dict.fromkeys(("kB, 100%", "kB, 10%"), ".0f")
CASES = [
    Case(f"components-{name}", partial(measure, name), name, FORMATS)
    for name in ("intel", "aces", "hall", "kinect")
]

if __name__ == "__main__":
    run(__doc__, *CASES)

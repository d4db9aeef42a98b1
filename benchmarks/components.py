"""How many components: AUC and bytes of the map as its learning rule varies.

    python benchmarks/components.py --data FOLDER

FOLDER holds laser2d/intel.log.gz, laser2d/aces.log.gz, hall/ and kinect/. Writes its table into
BENCHMARKS.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import torch
from tables import hardware, markdown, publish

from gmmtorch import GaussianMap, WindowedRule, datasets
from gmmtorch.experiments.evaluation.held_out import Protocol, evaluate
from gmmtorch.experiments.evaluation.mapping_methods import methods
from gmmtorch.scan import Scan

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


def data(folder: Path, name: str) -> tuple[Sequence[Scan], Protocol]:
    if name in ("intel", "aces"):
        dataset = datasets.load("carmen", folder / "laser2d" / f"{name}.log.gz")
        return list(dataset), Protocol(kept=(1.0, 0.1), resolution=(0.1, 0.02))
    if name == "hall":
        return list(datasets.load("scan_folder", folder / "hall")), Protocol(5, (1.0, 0.1), "beams", (0.2,))
    dataset = datasets.load("depth_frames", folder / "kinect", pixel_stride=2)
    return list(dataset), Protocol(5, (1.0, 0.1), "beams", (0.05,))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--names", nargs="+", default=["intel", "aces", "hall", "kinect"])
    options = parser.parse_args()
    torch.set_num_threads(1)
    for name in options.names:
        scans, protocol = data(options.data, name)
        rows: list[list[object]] = []
        header: list[str] = []
        for rule, changes in RULES.items():
            outcome = evaluate(name, scans, {"monte_carlo": factory(changes, scans[0].dim)}, protocol)
            header, row = columns(rule, outcome.rows)
            rows.append(row)
        grid = evaluate(name, scans, {"occupancy_grid": methods(GaussianMap)["occupancy_grid"]}, protocol)
        rows.append(columns("(count grid)", grid.rows)[1])
        publish(f"components-{name}", f"{name}. {hardware()}\n\n{markdown(header, rows)}")


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


def columns(name: str, rows: list[dict]) -> tuple[list[str], list[object]]:
    """Header and cells: AUC for each share and resolution, components and bytes for each share."""
    header, cells = ["rule"], [name]
    for kept in dict.fromkeys(row["kept"] for row in rows):
        of = [row for row in rows if row["kept"] == kept]
        for row in of:
            header.append(f"AUC, {kept:.0%}, {row['resolution']:g} m")
            cells.append(f"{row['auc']:.4f}")
        header += [f"components, {kept:.0%}", f"kB, {kept:.0%}"]
        cells += [f"{of[0]['n_components'] or '–'}", f"{of[0]['nbytes'] / 1e3:.0f}"]
    return header, cells


if __name__ == "__main__":
    main()

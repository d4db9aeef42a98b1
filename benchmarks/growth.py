"""What a scan, a query after it, and the map's memory cost as maps grow, beside OctoMap and Bonxai.

    OMP_NUM_THREADS=1 python benchmarks/growth.py --data $GMMTORCH_DATA --bonxai libbonxai.so

Draws docs/images/growth.png. OctoMap needs the extra [baselines]. Bonxai (github.com/facontidavide/Bonxai) is
left out without its library:

    g++ -O3 -march=native -std=c++17 -shared -fPIC -o libbonxai.so -I EIGEN -I BONXAI/bonxai_core/include \\
        -I BONXAI/bonxai_map/include benchmarks/bonxai.cpp BONXAI/bonxai_map/src/probabilistic_map.cpp
"""

from __future__ import annotations

import ctypes
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from growing_world import N_POINTS, points_on_beams
from torch import Tensor

from gmmtorch import GaussianMap, Scan
from gmmtorch.experiments.baselines import OctoMapMap
from gmmtorch.experiments.harness import Case, Row, Table, alone, recording, results_of, run
from gmmtorch.mapping import TiledMap, resident_bytes
from gmmtorch.report import draw_grid, label_axes, legend_below, line_look, log_axis, new_figure, save_figure

ROOT = Path(__file__).parents[1]
CELLS = {"street": 0.2, "freiburg-campus": 0.1}  # metres, of the maps of cells and of the cubes asked about
N_ROWS = 12
MAPS = ("gmmtorch", "gmmtorch in tiles", "OctoMap", "Bonxai")


class Bonxai:
    """Bonxai's probabilistic map with OctoMap's defaults, by the functions of bonxai.cpp."""

    def __init__(self, library: str, resolution: float) -> None:
        self._code, self._side = ctypes.CDLL(library), resolution
        self._code.bonxai_new.restype, self._code.bonxai_new.argtypes = ctypes.c_void_p, [ctypes.c_double]
        self._map = ctypes.c_void_p(self._code.bonxai_new(resolution))

    def _given(self, points: Tensor) -> tuple[ctypes.c_void_p, ctypes.c_int64, np.ndarray]:
        """Address and number of points (M, 3); those of a 2D map are in the middle of a layer."""
        if points.shape[1] == 2:
            points = torch.nn.functional.pad(points, (0, 1), value=0.5 * self._side)
        held = points.double().contiguous().numpy()
        return ctypes.c_void_p(held.ctypes.data), ctypes.c_int64(len(held)), held

    def insert(self, scan: Scan) -> None:
        ends, free, origin = map(self._given, (scan.points, scan.no_return, scan.origin[None]))
        self._code.bonxai_insert(self._map, *ends[:2], *free[:2], origin[0])

    def occupancy(self, points: Tensor) -> Tensor:
        found, asked = torch.empty(len(points), dtype=torch.float64), self._given(points)
        self._code.bonxai_ask(self._map, *asked[:2], ctypes.c_void_p(found.data_ptr()))
        return found


def new_map(name: str, side: float, dim: int, folder: str, library: str | None) -> Any:
    if name == "OctoMap":
        return OctoMapMap(side)
    if name == "Bonxai":
        return Bonxai(str(library), side)
    made = GaussianMap(resolution=side)
    return TiledMap.create(folder, made, dim, memory=10**8) if name == "gmmtorch in tiles" else made


def growth(data: Path, recorded: str, name: str, library: str | None) -> dict[str, Any]:
    """Rows: scans so far; of those since the row before, mean ms of a scan and of a query; MB of the map."""
    scans, side = recording(data, recorded), CELLS[recorded]
    generator, spent, rows = torch.Generator().manual_seed(0), [], []
    with tempfile.TemporaryDirectory() as folder:
        first = new_map(name, side, scans[0].dim, f"{folder}/0", library)  # loads the program
        first.insert(scans[0])
        first.occupancy(scans[0].points[:N_POINTS])
        made = new_map(name, side, scans[0].dim, f"{folder}/1", library)
        before = resident_bytes()
        for number, scan in enumerate(scans, 1):
            points = points_on_beams(scan, generator)
            begin = time.process_time()
            made.insert(scan)
            learned = time.process_time()
            made.occupancy(points)
            spent.append((learned - begin, time.process_time() - learned))
            if number % -(-len(scans) // N_ROWS) == 0 or number == len(scans):
                learning, query = (1e3 * torch.tensor(spent)).mean(0).tolist()
                rows.append((number, learning, query, (resident_bytes() - before) / 1e6))
                spent = []
    return {"rows": rows}


def measured(options: Any) -> Iterator[Row]:
    """A row for every twelfth of the scans of each map."""
    for recorded in options.names:
        for name in options.methods:
            if name == "Bonxai" and options.bonxai is None:
                continue
            result = alone(growth, options.data, recorded, name, options.bonxai)
            if "rows" not in result:
                raise RuntimeError(f"{recorded}, {name}: {result['error']}")
            for row in result["rows"]:
                yield recorded, name, *row
    draw(Table.load(results_of(CASES[0]) / "growth.json").rows, options.figure)


def draw(rows: list[list[Any]], path: Path) -> None:
    """Rows of the table, also those of earlier runs."""
    recorded = list(dict.fromkeys(row[0] for row in rows))
    figure = new_figure(13, 3.6 * len(recorded))
    panels = figure.subplots(len(recorded), 3, squeeze=False)
    titles = ("a scan [ms]", f"a query of {N_POINTS} points [ms]", "memory of the map [MB]")
    for line, one in zip(panels, recorded, strict=True):
        for column, (axes, title) in enumerate(zip(line, titles, strict=True), 3):
            for index, name in enumerate(MAPS):
                found = sorted((row[2], max(row[column], 0.01)) for row in rows if row[:2] == [one, name])
                if found:
                    axes.plot(*zip(*found, strict=True), label=name, **line_look(index))
            log_axis(axes, "y", [max(row[column], 0.01) for row in rows if row[0] == one])
            label_axes(axes, f"{one}: {title}", "scans")
            draw_grid(axes)
    legend_below(figure)
    save_figure(figure, path)


CASES = (
    Case(
        "growth",
        measured,
        "After each scan the map is asked about 500 points on its beams. Cells are 0.2 m wide in street, "
        "0.1 m on the campus. Costs are CPU ms, means of the scans since the row before. Memory is that of "
        "the process above that before the first scan. Other programs ran on the machine.",
        {
            "data": "",
            "map": "",
            "scans": ".0f",
            **dict.fromkeys(("a scan, ms", "a query, ms"), "3"),
            "MB": ".0f",
        },
        tuple(CELLS),
        MAPS,
        key=3,
    ),
)

if __name__ == "__main__":
    figure = {"type": Path, "default": ROOT / "docs/images/growth.png"}
    run(__doc__, *CASES, figure=figure, bonxai={"help": "library of Bonxai", "default": None})

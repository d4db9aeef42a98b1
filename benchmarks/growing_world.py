"""What a scan costs to learn as the world grows, and what a query after it costs in a city of tiles.

    python benchmarks/growing_world.py --only growing-world [--halls 1 4 16]
    OMP_NUM_THREADS=1 python benchmarks/growing_world.py --data $GMMTORCH_DATA

`growing-world` has embedded halls side by side. `growing-tiles` has a city in tiles on disk, made of the
folder `street`. A map in memory is in growth.py.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import islice
from typing import Any

import torch
from torch import Tensor

from gmmtorch import GaussianMap, IncrementalRule, Scan, datasets
from gmmtorch.experiments.harness import Case, Row, cpu_seconds, recording, run
from gmmtorch.mapping import TiledMap
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.map_builder import resident_bytes

N_SCANS, APART = 24, 40.0  # scans of a hall; metres from one hall to the next
N_POINTS = 500  # of a query after a scan
PART = 200_000  # components of a city that are in memory
PER_HALL = 1000  # components, where there is a budget


def milliseconds(scans: list[Scan], n_halls: int, rule: IncrementalRule) -> tuple[float, int]:
    """CPU milliseconds a scan, and components, of a map of so many halls."""
    side = math.isqrt(n_halls)
    built = GaussianMap(rule)
    begin = time.process_time()
    for hall in range(n_halls):
        shift = torch.tensor([APART * (hall % side), APART * (hall // side), 0.0], dtype=torch.float64)
        for scan in scans:
            built.insert(Scan(scan.points + shift, scan.origin + shift, scan.no_return + shift))
    built.finish()
    return 1e3 * (time.process_time() - begin) / (n_halls * len(scans)), built.n_components


def points_on_beams(scan: Scan, generator: torch.Generator) -> Tensor:
    """Points (`N_POINTS`, D) anywhere on beams of a scan, as a planner asks about."""
    chosen = torch.randint(len(scan.points), (N_POINTS,), generator=generator)
    share = torch.rand(N_POINTS, 1, generator=generator, dtype=torch.float64)
    return scan.origin + share * (scan.points[chosen] - scan.origin)


def city(found: Components, n_components: int) -> Iterator[Components]:
    """At least so many components: the given ones side by side, in parts."""
    n = -(-n_components // len(found))
    row, size = math.isqrt(n - 1) + 1, 1.1 * (found.means.amax(0) - found.means.amin(0))
    shifts = torch.zeros(n, found.dim, dtype=torch.float64)
    shifts[:, 0], shifts[:, 1] = torch.arange(n) % row * size[0], torch.arange(n) // row * size[1]
    for some in shifts.split(PART // len(found)):
        moved = [replace(found, means=found.means + s, origins=found.origins + s) for s in some]
        yield Components.concatenate(moved)


def growing_tiles(options: Any) -> Iterator[Row]:
    scans = list(islice(recording(options.data, "street"), 66))
    source = GaussianMap()
    for scan in scans:
        source.insert(scan)
    found, generator = source.components(), torch.Generator().manual_seed(0)
    for size in options.components:
        begin, calibration = resident_bytes(), source.query_options.calibration
        with tempfile.TemporaryDirectory() as folder:
            tiled = TiledMap.create(folder, GaussianMap(calibration=calibration), 3, memory=options.memory)
            written = 0.0
            for part in city(found, size):
                written += cpu_seconds(partial(tiled.add, part))[0]
            tiled = TiledMap(folder, memory=options.memory)
            spent: list[tuple[float, float]] = []
            for scan in scans[:44]:
                points = points_on_beams(scan, generator)
                spent.append(
                    (
                        cpu_seconds(partial(tiled.insert, scan))[0],
                        cpu_seconds(partial(tiled.occupancy, points))[0],
                    )
                )
            learning, query = (1e3 * torch.tensor(spent)).mean(0).tolist()
            held = (resident_bytes() - begin) / 1e6
            yield tiled.n_components, len(tiled.index), tiled.nbytes / 1e6, written, learning, query, held


def growing_world(options: Any) -> Iterator[Row]:
    scans = list(datasets.load("synthetic_building", n_scans=N_SCANS))
    milliseconds(scans, 1, IncrementalRule())  # what is loaded but once
    for n_halls in options.halls:
        free, n_components = milliseconds(scans, n_halls, IncrementalRule())
        held, _ = milliseconds(scans, n_halls, IncrementalRule(n_components=PER_HALL * n_halls))
        yield n_halls, n_components, free, held


COSTS = {"halls": ".0f", "components": ",.0f", "no budget": ".0f", f"{PER_HALL:,} components a hall": ".0f"}
TILED = (
    "components",
    "tiles",
    "MB on disk",
    "written in, s",
    "learning, ms a scan",
    "query, ms",
    "MB in memory",
)
CASES = (
    Case(
        "growing-world",
        growing_world,
        f"Copies of the embedded hall side by side, {N_SCANS} scans of 5,120 beams each, CPU ms a scan.",
        COSTS,
        needs_data=False,
    ),
    Case(
        "growing-tiles",
        growing_tiles,
        "A city of streets side by side, in tiles of 100 m on disk; then 44 scans of 19,000 points, each "
        "followed by a query of 500 points. Tiles hold at most the bytes of --memory between queries.",
        {**dict.fromkeys(TILED, ".0f"), "components": ",.0f", "MB on disk": ".1f"},
    ),
)

if __name__ == "__main__":
    halls = {"type": int, "nargs": "+", "default": [1, 4, 16], "help": "square numbers"}
    components = {"type": int, "nargs": "+", "default": [1000, 100_000, 1_000_000], "help": "of the cities"}
    memory = {"type": int, "default": 10**8, "help": "bytes of the tiles in memory"}
    run(__doc__, *CASES, halls=halls, components=components, memory=memory)

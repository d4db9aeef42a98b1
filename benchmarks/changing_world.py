"""A simulated hall in which boxes move and people walk: what stays in the map that is no longer there, and
what is lost that is. Writes its table and its picture into BENCHMARKS.md.

    OMP_NUM_THREADS=1 python benchmarks/changing_world.py --data FOLDER

FOLDER holds recordings in which nothing moves for long, as for benchmarks/accuracy.py: the second case tells
what forgetting costs them. `--only changing-world` needs no folder.

A lidar (32 × 160 beams, 10 m, noise 1 cm) walks through the hall twice. Between the passes boxes move; during
both, people walk. Cells are 0.1 m wide. A *ghost* is a cell in which a person or a box was seen, that is free
at the end, and through which a later beam passed; it stays if the map calls it occupied (θ > ½). A *surface*
is a cell on which beams of the second pass end at the end; it is lost if the map does not call it occupied.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from accuracy import BUDGETS, CELLS, NAMES, PLANAR
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from pages import ROOT
from torch import Tensor

import gmmtorch as gt
from gmmtorch import GaussianMap, IncrementalRule
from gmmtorch.experiments.baselines import LogOdds, OccupancyGrid, OctoMapMap
from gmmtorch.experiments.evaluation import Protocol, choose, evaluate, methods, metrics
from gmmtorch.experiments.harness import Case, Row, cpu_seconds, held_out, recording, run
from gmmtorch.kernels.rays.ray_traversal import traverse
from gmmtorch.report.style import PALETTE, label_axes, legend_below, new_figure, save_figure
from gmmtorch.simulation import World3D, building_3d, poses_3d, spinning_lidar
from gmmtorch.simulation.furniture import Footprint, circle, prism

CELL = 0.1  # metres
SECONDS = 0.4  # between two scans
HEIGHT = 1.2  # of the lidar, metres

# Places of boxes (x, y, heading, length, width, height) in the first and in the second pass; metres, radians.
BOXES = (
    ((3.0, 3.3, 0.2, 0.8, 0.6, 0.9), (5.7, 6.6, 0.7, 0.8, 0.6, 0.9)),
    ((6.0, 3.4, 0.9, 1.0, 0.5, 1.2), (2.8, 7.5, 0.1, 1.0, 0.5, 1.2)),
    ((2.9, 5.9, 0.4, 0.6, 0.6, 0.6), (5.9, 4.0, 1.2, 0.6, 0.6, 0.6)),
    ((12.0, 5.9, 0.5, 0.7, 0.5, 1.0), (11.6, 3.6, 0.3, 0.7, 0.5, 1.0)),
)
# Ends of the ways of people, who go to and fro; metres.
WAYS = (
    ((1.0, 9.0), (7.9, 7.2)),
    ((1.2, 0.8), (8.2, 3.9)),
    ((6.6, 1.0), (5.9, 9.0)),
    ((10.0, 9.0), (13.0, 0.9)),
)
SPEED, STATURE, GIRTH = 1.2, 1.75, 0.25  # of people: m/s, metres, metres
NEAREST = 0.6  # metres between the lidar and a person, who otherwise is not there


DRAWN = (
    "incremental, off",
    "incremental, contradiction",
    "log-odds grid, no clamp",
    "OctoMap (log-odds with clamping)",
)
SLICE = 0.85  # height of the drawn slice, metres

LOW, SHAPE = torch.tensor([-10, -10, -10]), (310, 130, 60)  # cells of the hall


class Recorded(NamedTuple):
    """scans: of both passes. ghosts (G, 3), surfaces (S, 3): centres of cells, metres."""

    scans: list[gt.Scan]
    ghosts: Tensor
    surfaces: Tensor


def boxes(n_pass: int) -> list[Tensor]:
    """Triangles (T, 3, 3) of the boxes in a pass."""
    places = [both[n_pass] for both in BOXES]
    return [prism(Footprint(*place[:5]).corners(), 0.0, place[5]) for place in places]


def people(seconds: float, sensor: Tensor) -> list[Tensor]:
    """Triangles of the people at a time, seen from a position (3,)."""
    found = []
    for begin, end in WAYS:
        here, there = torch.tensor([begin, end], dtype=torch.float64)
        share = abs(seconds * SPEED / float((there - here).norm()) % 2 - 1)
        place = there + share * (here - there)
        if float((place - sensor[:2]).norm()) > NEAREST + GIRTH:
            found.append(prism(circle(GIRTH, 10) + place, 0.0, STATURE))
    return found


def recorded(n_scans: int, seed: int) -> Recorded:
    """Two passes of `n_scans` scans; the second one goes back."""
    generator = torch.Generator().manual_seed(seed)
    hall, sensor = building_3d(generator), spinning_lidar()
    poses = poses_3d(hall.path, n_scans, HEIGHT)
    poses = torch.cat([poses, poses.flip(0)])
    at_the_end = World3D(torch.cat([hall.triangles, *boxes(1)]), hall.path)
    n_cells = math.prod(SHAPE)
    seen, crossed, surface = torch.full((n_cells,), -1), torch.full((n_cells,), -1), torch.zeros(n_cells)
    scans = []
    for number, pose in enumerate(poses):
        origin, rays, seconds = pose[:3, 3], sensor.directions @ pose[:3, :3].T, number * SECONDS
        moved = [*boxes(number // n_scans), *people(seconds, origin)]
        now = World3D(torch.cat([hall.triangles, *moved]), hall.path).distances(origin, rays)
        last = at_the_end.distances(origin, rays)
        noise = torch.randn(len(rays), generator=generator, dtype=torch.float64) * sensor.range_noise
        hit = now < sensor.max_range
        reading = torch.where(hit, now, sensor.max_range)
        ends = origin + rays * (reading + noise)[:, None]
        scans.append(gt.Scan(ends[hit], origin, ends[~hit], time=seconds))
        for voxel, _ in traverse((origin / CELL).expand(len(rays), 3), ends / CELL, SHAPE, low=LOW):
            crossed[voxel] = number
        moving = hit & ((now - last).abs() > 0.05) & (now < last)
        seen[cells(origin + rays[moving] * now[moving, None])] = number
        if number >= n_scans:
            there = last < sensor.max_range
            surface[cells(origin + rays[there] * last[there, None])] = 1
    near = torch.nn.functional.max_pool3d(surface.view(1, *SHAPE), 3, 1, 1).flatten()
    ghosts = (seen >= 0) & (crossed > seen) & (near == 0)
    return Recorded(scans, centres(ghosts), centres(surface > 0))


def cells(points: Tensor) -> Tensor:
    """Flat indices (N,) of the cells that contain points (N, 3)."""
    x, y, z = ((points / CELL).floor().long() - LOW).unbind(1)
    return (x * SHAPE[1] + y) * SHAPE[2] + z


def centres(chosen: Tensor) -> Tensor:
    """Centres (N, 3) of the chosen cells, metres."""
    return (chosen.view(SHAPE).nonzero() + LOW + 0.5) * CELL


def maps() -> dict[str, Callable[[], Any]]:
    """Maps by name, with their defaults."""
    ours = {
        "off": "off",
        "contradiction": "contradiction",
        "half-life 30 s": 30.0,
    }
    made: dict[str, Callable[[], Any]] = {}
    for kind, rule in (
        ("incremental", IncrementalRule()),
        ("incremental, 16 kB", IncrementalRule(max_bytes=16_000)),
    ):
        for name, forget in ours.items():
            made[f"{kind}, {name}"] = partial(GaussianMap, replace(rule, forget=forget), resolution=CELL)
    made["count grid"] = partial(OccupancyGrid, CELL)
    made["log-odds grid, no clamp"] = partial(OccupancyGrid, CELL, log_odds=LogOdds())
    made["OctoMap (log-odds with clamping)"] = partial(OctoMapMap, CELL)
    return made


def measured(made: Any, world: Recorded) -> list[float]:
    """Ghosts that stay, surfaces lost (shares of cells), AUC, kilobytes and CPU seconds of one map."""

    def build() -> None:
        for scan in world.scans:
            made.insert(scan)
        made.finish()

    seconds, _ = cpu_seconds(build)
    ghosts, surfaces = (torch.as_tensor(made.occupancy(c, CELL)) for c in (world.ghosts, world.surfaces))
    stays, lost = float((ghosts > 0.5).double().mean()), float((surfaces <= 0.5).double().mean())
    return [stays, lost, metrics.roc(surfaces, ghosts).auc, made.nbytes / 1e3, seconds]


COLUMNS = ("ghosts that stay", "surfaces lost", "AUC", "bytes", "CPU s")
FORMATS = ("{:.1%}", "{:.1%}", "{:.4f}", "{:,.0f} kB", "{:.0f}")


def row(name: str, by_seed: list[list[float]]) -> Row:
    """Mean and range over the seeds."""
    cells = [name]
    for title, form, values in zip(COLUMNS, FORMATS, zip(*by_seed, strict=True), strict=True):
        text, low, high = (
            form.format(value) for value in (statistics.mean(values), min(values), max(values))
        )
        has_range = title in COLUMNS[:3] and low != high
        cells.append(f"{text} ({low} to {high})" if has_range else text)
    return cells


def draw(made: dict[str, Any], world: Recorded, file: Path) -> None:
    """Slices of some maps at the height of people's chests, with the ghosts that stay."""
    x, y = (torch.arange(n) for n in SHAPE[:2])
    level = int(SLICE / CELL) - int(LOW[2])
    plane = torch.cartesian_prod(x, y)
    points = (torch.cat([plane, torch.full((len(plane), 1), level)], 1) + LOW + 0.5) * CELL
    low, high = (LOW[:2] * CELL).tolist(), ((LOW[:2] + torch.tensor(SHAPE[:2])) * CELL).tolist()
    figure = new_figure(11.5, 7)
    panels = figure.subplots(2, 2, sharex=True, sharey=True).flat
    for axes, (name, map_) in zip(panels, made.items(), strict=True):
        theta = torch.as_tensor(map_.occupancy(points, CELL)).view(SHAPE[:2])
        axes.imshow(
            theta.T, cmap="Greys", vmin=0, vmax=1, origin="lower", extent=(low[0], high[0], low[1], high[1])
        )
        stays = world.ghosts[torch.as_tensor(map_.occupancy(world.ghosts, CELL)) > 0.5]
        axes.scatter(stays[:, 0], stays[:, 1], s=9, color=PALETTE[1], linewidths=0)
        label_axes(axes, f"{name}: {len(stays):,} of {len(world.ghosts):,} ghosts stay")
        axes.set(xlim=(-0.5, 15.5), ylim=(-0.5, 10.5), aspect="equal")
    left = "left by a person or a box, still occupied"
    shown = [
        Line2D([], [], marker="o", linestyle="", color=PALETTE[1], label=left),
        Patch(facecolor="black", label=f"occupied, {SLICE} m above the floor"),
        Patch(facecolor="0.5", label="unknown"),
        Patch(facecolor="white", edgecolor="0.5", label="free"),
    ]
    legend_below(figure, shown)
    save_figure(figure, file, dpi=90)


def static(options: Any) -> Iterator[Row]:
    """AUC on held-out beams of recordings, without forgetting and with it."""
    for name in options.names:
        dataset = recording(options.data, name, **({"pixel_stride": 2} if name == "kinect" else {}))
        budget, cell = BUDGETS.get(name), CELLS.get(name, PLANAR)[0]
        protocol = Protocol(held_out(dataset), (1.0,), "beams", (cell,), max_beams=20_000)
        found = []
        for forget in ("off", "contradiction"):
            rule = IncrementalRule(max_bytes=budget, forget=forget)
            make = methods(partial(GaussianMap, rule, cutoff=3.0))
            found += evaluate(name, list(dataset), choose(["point"], make), protocol).rows
        off, kept = found
        counts = (f"{each['auc']:.4f}, {each['n_components']:,}" for each in (off, kept))
        limit = f"{budget / 1e3:.0f} kB" if budget else "none"
        yield name, cell, limit, *counts, kept["auc"] - off["auc"]


def changing(options: Any) -> Iterator[Row]:
    values: dict[str, list[list[float]]] = {name: [] for name in maps()}
    for seed in range(options.seeds):
        world = recorded(options.scans, seed)
        print(f"seed {seed}: {len(world.ghosts)} ghosts, {len(world.surfaces)} surfaces", flush=True)
        made = {name: factory() for name, factory in maps().items()}
        for name, map_ in made.items():
            values[name].append(measured(map_, world))
        if seed == 0 and options.figure:
            draw({name: made[name] for name in DRAWN}, world, options.figure)
    yield from (row(name, by_seed) for name, by_seed in values.items())


CASES = (
    Case(
        "changing-world",
        changing,
        "AUC compares surfaces with ghosts. Seconds are CPU time of building.",
        dict.fromkeys(("map", *COLUMNS), ""),
        needs_data=False,
    ),
    Case(
        "changing-world-static",
        static,
        "Recordings in which little moves: all beams, 20,000 held-out beams.",
        {
            "data": "",
            "cell (m)": "3",
            "budget": "",
            "`off`: AUC, components": "",
            "`contradiction`": "",
            "difference": "+.4f",
        },
        NAMES,
    ),
)

if __name__ == "__main__":
    run(
        __doc__,
        *CASES,
        scans={"type": int, "default": 100, "help": "of a pass"},
        seeds={"type": int, "default": 5, "help": "halls, walks and noises"},
        figure={"type": Path, "default": ROOT / "docs/images/changing_world.png"},
    )

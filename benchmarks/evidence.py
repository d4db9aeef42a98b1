"""What evidence costs: on a whole grid by each form, at points, and at points of a world that grows.

    OMP_NUM_THREADS=1 python benchmarks/evidence.py --data $GMMTORCH_DATA

A map of the training frames (four of five) of a depth-camera room. Points are the hits of the other frames
and as many free points. Copies of the map side by side make the world that grows. Seconds are of the
processor.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gmmtorch import GaussianMap
from gmmtorch.experiments.evaluation.queries import hit_and_free, test_beams
from gmmtorch.experiments.harness import Case, Row, cpu_seconds, recording, run
from gmmtorch.kernels import kernels
from gmmtorch.mapping.learning.rules import IncrementalRule, LearningRule, WindowedRule
from gmmtorch.occupancy.cones import Cones
from gmmtorch.occupancy.evidence import Evidence
from gmmtorch.occupancy.forms.flux import flux_evidence
from gmmtorch.occupancy.forms.monte_carlo import sample_rays
from gmmtorch.occupancy.forms.point import PointForm
from gmmtorch.occupancy.grid import VoxelGrid
from gmmtorch.scan import Scan

RESOLUTION = 0.05
REFERENCE = 1e-7  # tolerance of the flux that errors are measured against
CUTOFF = 5.0  # of the evidence on a grid: rays have no cutoff


def cones_of(scans: Sequence[Scan], rule: LearningRule) -> Cones:
    built = GaussianMap(rule)
    for scan in scans:
        built.insert(scan)
    built.finish()
    return built.components().cones()


def small_pieces(n_components: int, n_scans: int) -> WindowedRule:
    """A rule that learns as many components as are asked for: low noise makes small pieces."""
    return WindowedRule(n_components=n_components, max_origins=2, noise=0.005, window=n_scans)


def timed(work: Callable[[], Any], repeats: int = 3) -> tuple[float, Any]:
    """Median of processor seconds after a first call, which compiles; and the result."""
    result = work()
    return statistics.median(cpu_seconds(work)[0] for _ in range(repeats)), result


def cast(cones: Cones, grid: VoxelGrid, n_samples: int) -> Evidence:
    evidence, rays = Evidence.empty(grid), sample_rays(cones, n_samples)
    evidence.add_rays(rays.origins, rays.ends, rays.weights, rays.is_hit)
    return evidence


def on_a_grid(options: Any) -> Iterator[Row]:
    """Flux and Monte Carlo evidence of all cells."""
    train, points = room(options.data, options.points)
    cones = cones_of(train, IncrementalRule(max_bytes=8000))
    low, high = points.amin(0), points.amax(0)
    # Not on multiples of the resolution, where sensors lie on faces: either cell may count their rays.
    grid = VoxelGrid(low.tolist(), RESOLUTION, ((high - low) / RESOLUTION).ceil().int().tolist())
    options.about = f"{grid.n_cells:,} cells of {grid.resolution} m, {len(cones.counts)} cones."
    exact = flux_evidence(cones, grid, CUTOFF, tolerance=REFERENCE)
    n_points = float(cones.counts.sum())
    works: list[tuple[str, Callable[[], Evidence]]] = [
        (f"Sobol, 10{power} rays", lambda n=n: cast(cones, grid, n))
        for power, n in (("⁵", 10**5), ("⁶", 10**6))
    ]
    works += [
        (f"flux, tolerance {name}", lambda t=t: flux_evidence(cones, grid, CUTOFF, tolerance=t))
        for name, t in (("0.1", 0.1), ("10⁻²", 1e-2), ("10⁻³", 1e-3), ("10⁻⁴ (default)", 1e-4))
    ]
    for name, work in works:
        seconds, found = timed(work)
        misses = float((found.misses - exact.misses).square().mean().sqrt()) / n_points
        theta = float((found.probability() - exact.probability()).square().mean().sqrt())
        yield name, seconds, misses, theta


def first_query(cones: Cones, points: Tensor, cutoff: float) -> tuple[PointForm, float]:
    """A form, and the seconds to make it and to answer its first query."""
    begin = time.process_time()
    form = PointForm(cones, RESOLUTION, cutoff)
    form(points)
    return form, time.process_time() - begin


def at_points(options: Any) -> Iterator[Row]:
    """Rates by the number of cones and the cutoff, and how many cones a point visits."""
    train, points = room(options.data, options.points)
    rules = [small_pieces(n, len(train)) for n in (100, 300, 1000)]
    rules.insert(2, IncrementalRule(max_bytes=8000))
    options.about = f"{len(points):,} points."
    for cones in (cones_of(train, rule) for rule in rules):
        for cutoff in (3.0, 5.0):
            form, first = first_query(cones, points, cutoff)
            few = points[:: max(1, len(points) // 20_000)]  # the twin is slow
            with kernels("torch"):
                slow, _ = timed(lambda form=form, few=few: form(few), 1)
            fast, _ = timed(lambda form=form: form(points))
            number = form.index.buckets(points)
            listed = form.index.lists.lengths()[number[number >= 0]].double().mean()
            rates = len(points) / fast / 1e6, len(few) / slow / 1e6
            visited = f"{form.visited(points):.0f} of {listed:.0f}"
            yield len(cones.counts), cutoff, *rates, visited, first


def as_it_grows(options: Any) -> Iterator[Row]:
    """1, 4 and 16 copies of the room side by side, each asked about a sixteenth of the points."""
    train, points = room(options.data, options.points)
    cones = cones_of(train, small_pieces(300, len(train)))
    step = float((points.amax(0) - points.amin(0)).amax()) + 2.0
    for copies in (1, 4, 16):
        shift = torch.zeros(copies, 1, 3, dtype=torch.float64)
        shift[:, 0, 0] = step * torch.arange(copies)
        world = Cones(
            (cones.means + shift).flatten(0, 1),
            cones.covariances.repeat(copies, 1, 1),
            (cones.origins + shift).flatten(0, 1),
            cones.counts.repeat(copies),
            cones.max_range.repeat(copies),
        )
        asked = (points[: len(points) // 16] + shift).flatten(0, 1)
        form, first = first_query(world, asked, 3.0)
        seconds, _ = timed(lambda form=form, asked=asked: form(asked))
        entries = form.index.lists.entries.numel() / len(world.counts)
        yield copies, len(world.counts), len(asked) / seconds / 1e6, entries, first


@cache
def room(data: Path, n_points: int) -> tuple[list[Scan], Tensor]:
    """Four of five scans, and half hits, half free points of the others."""
    scans = list(recording(data, "kinect", pixel_stride=4))
    beams = test_beams(scans[::5], n_points // 2, seed=0)
    train = [scan for number, scan in enumerate(scans) if number % 5]
    return train, hit_and_free(*beams, "uniform", RESOLUTION, seed=0).points


ERRORS = {"": "", "CPU s": ".2f", "rms error of misses, a point": ".1e", "rms error of θ": ".1e"}
RATES = {"cones": ".0f", "cutoff": ".0f", "fused, M points/s": ".2f", "tensor operations": ".2f"}
RATES |= {"cones visited of listed": "", "first query, s": ".2f"}
GROWING = {"rooms": ".0f", "cones": ".0f", "M points/s": ".2f", "index entries a cone": ".0f"}
CASES = (
    Case("grid-evidence", on_a_grid, columns=ERRORS),
    Case("point-queries", at_points, columns=RATES, key=2),
    Case(
        "growing-queries", as_it_grows, "Rooms side by side, cutoff 3.", {**GROWING, "first query, s": ".2f"}
    ),
)

if __name__ == "__main__":
    run(__doc__, *CASES, points={"type": int, "default": 500_000})

"""What evidence costs: on a whole grid by each form, at points, and at points of a world that grows.

    OMP_NUM_THREADS=1 python benchmarks/evidence.py --data $GMMTORCH_DATA

A map of the training frames (four of five) of a depth-camera room. Points are the hits of the other frames
and as many free points. Copies of the map side by side make the world that grows. Seconds are of the
processor, on one thread. Writes the tables `grid-evidence`, `point-queries` and `growing-queries` of
BENCHMARKS.md.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from tables import hardware, markdown, publish
from threadpoolctl import threadpool_limits
from torch import Tensor

from gmmtorch import GaussianMap, datasets
from gmmtorch.experiments.evaluation.queries import hit_and_free, test_beams
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
    result, seconds = work(), []
    for _ in range(repeats):
        begin = time.process_time()
        work()
        seconds.append(time.process_time() - begin)
    return statistics.median(seconds), result


def cast(cones: Cones, grid: VoxelGrid, n_samples: int) -> Evidence:
    evidence, rays = Evidence.empty(grid), sample_rays(cones, n_samples)
    evidence.add_rays(rays.origins, rays.ends, rays.weights, rays.is_hit)
    return evidence


def on_a_grid(cones: Cones, grid: VoxelGrid) -> str:
    """Flux and Monte Carlo evidence of all cells."""
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
    rows = []
    for name, work in works:
        seconds, found = timed(work)
        misses = float((found.misses - exact.misses).square().mean().sqrt()) / n_points
        theta = float((found.probability() - exact.probability()).square().mean().sqrt())
        rows.append([name, f"{seconds:.2f}", f"{misses:.1e}", f"{theta:.1e}"])
    about = f"{grid.n_cells:,} cells of {grid.resolution} m, {len(cones.counts)} cones. {hardware()}"
    header = ["", "CPU s", "rms error of misses, a point", "rms error of θ"]
    return f"{about}\n\n{markdown(header, rows)}"


def first_query(cones: Cones, points: Tensor, cutoff: float) -> tuple[PointForm, float]:
    """A form, and the seconds to make it and to answer its first query."""
    begin = time.process_time()
    form = PointForm(cones, RESOLUTION, cutoff)
    form(points)
    return form, time.process_time() - begin


def at_points(maps: Sequence[Cones], points: Tensor) -> str:
    """Rates by the number of cones and the cutoff, and how many cones a point visits."""
    rows = []
    for cones in maps:
        for cutoff in (3.0, 5.0):
            form, first = first_query(cones, points, cutoff)
            few = points[:: max(1, len(points) // 20_000)]  # the twin is slow
            with kernels("torch"):
                slow, _ = timed(lambda form=form, few=few: form(few), 1)
            fast, _ = timed(lambda form=form: form(points))
            number = form.index.buckets(points)
            listed = form.index.lists.lengths()[number[number >= 0]].double().mean()
            rates = [f"{len(points) / fast / 1e6:.2f}", f"{len(few) / slow / 1e6:.2f}"]
            visited = f"{form.visited(points):.0f} of {listed:.0f}"
            rows.append([len(cones.counts), f"{cutoff:g}", *rates, visited, f"{first:.2f}"])
    header = [
        "cones",
        "cutoff",
        "fused, M points/s",
        "tensor operations",
        "cones visited of listed",
        "first query, s",
    ]
    return f"{len(points):,} points. {hardware()}\n\n{markdown(header, rows)}"


def as_it_grows(cones: Cones, points: Tensor) -> str:
    """1, 4 and 16 copies of the room side by side, each asked about a sixteenth of the points."""
    step = float((points.amax(0) - points.amin(0)).amax()) + 2.0
    rows = []
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
        rows.append(
            [copies, len(world.counts), f"{len(asked) / seconds / 1e6:.2f}", f"{entries:.0f}", f"{first:.2f}"]
        )
    return markdown(["rooms", "cones", "M points/s", "index entries a cone", "first query, s"], rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder with the folder kinect")
    parser.add_argument("--points", type=int, default=500_000)
    options = parser.parse_args()
    torch.set_num_threads(1)
    with threadpool_limits(1):
        scans = list(datasets.load("depth_frames", options.data / "kinect", pixel_stride=4))
        train = [scan for number, scan in enumerate(scans) if number % 5]
        beams = test_beams(scans[::5], options.points // 2, seed=0)
        points = hit_and_free(*beams, "uniform", RESOLUTION, seed=0).points
        small = cones_of(train, IncrementalRule(max_bytes=8000))
        low, high = points.amin(0), points.amax(0)
        # Not on multiples of the resolution, where sensors lie on faces: either cell may count their rays.
        grid = VoxelGrid(low.tolist(), RESOLUTION, ((high - low) / RESOLUTION).ceil().int().tolist())
        publish("grid-evidence", on_a_grid(small, grid))
        maps = {n: cones_of(train, small_pieces(n, len(train))) for n in (100, 300, 1000)}
        publish("point-queries", at_points([maps[100], maps[300], small, maps[1000]], points))
        publish("growing-queries", as_it_grows(maps[300], points))


if __name__ == "__main__":
    main()

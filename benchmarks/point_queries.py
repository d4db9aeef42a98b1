"""How many point queries a second a Gaussian map answers, and whether that depends on the world's size.

    python benchmarks/point_queries.py --kinect FOLDER [--points 500000] [--compiled]

A map of the training frames (four of five) of a depth-camera room, asked at the hits of the held-out
frames and at as many free points; then copies of it side by side. Prints Markdown tables.
"""

from __future__ import annotations

import argparse
import statistics
import time
from pathlib import Path

import torch
from tables import hardware, markdown
from torch import Tensor

from gmmtorch import GaussianMap, datasets
from gmmtorch.evaluation.queries import hit_and_free, test_beams
from gmmtorch.mapping.learning.rules import WindowedRule
from gmmtorch.occupancy.cones import Cones
from gmmtorch.occupancy.forms.point import PointForm
from gmmtorch.scan import Scan

RESOLUTION = 0.05


def map_of(scans: list[Scan], n_components: int) -> GaussianMap:
    # Low noise makes small pieces, so that there are as many components as are asked for.
    rule = WindowedRule(n_components=n_components, max_origins=2, noise=0.005)
    built = GaussianMap(window=len(scans), learning=rule)
    for scan in scans:
        built.insert(scan)
    built.finish()
    return built


def rate(form: PointForm, points: Tensor, repeats: int) -> tuple[float, float]:
    """Median of million points a second, by the wall clock and by the processor time of one thread."""
    form(points)  # compiles, once for each size of block
    wall, processor = [], []
    for _ in range(repeats):
        begin, worked = time.perf_counter(), time.process_time()
        form(points)
        wall.append(time.perf_counter() - begin)
        processor.append(time.process_time() - worked)
    return tuple(len(points) / statistics.median(times) / 1e6 for times in (wall, processor))  # type: ignore[return-value]


def timed_form(cones: Cones, compiled: bool) -> tuple[PointForm, float]:
    begin = time.perf_counter()
    form = PointForm(cones, RESOLUTION, compiled=compiled)
    return form, time.perf_counter() - begin


def by_components(train: list[Scan], points: Tensor, compiled: bool, repeats: int) -> str:
    rows = []
    for n_components in (100, 300, 1000):
        built = map_of(train, n_components)
        cones = built.components().cones()
        for mode in (False, True) if compiled else (False,):
            for threads in (1, 2):
                torch.set_num_threads(threads)
                form, seconds = timed_form(cones, mode)
                wall, processor = rate(form, points, repeats)
                listed = form.index.list_lengths()[form.index.buckets(points)].double().mean()
                rows.append(
                    [
                        f"{built.n_components}, {len(cones.counts)}",
                        "compiled" if mode else "eager",
                        threads,
                        f"{wall:.2f}",
                        f"{processor:.2f}",
                        f"{form.visited(points):.0f} of {listed:.0f}",
                        f"{seconds:.2f}",
                    ]
                )
    header = [
        "components, cones",
        "",
        "threads",
        "M points/s",
        "M points/CPU s",
        "cones visited of listed",
        "index, s",
    ]
    return markdown(header, rows)


def by_size(train: list[Scan], points: Tensor, compiled: bool, repeats: int) -> str:
    """1, 4 and 16 copies of the room side by side, each asked about a sixteenth of the points."""
    cones = map_of(train, 300).components().cones()
    step = float((points.amax(0) - points.amin(0)).amax()) + 2.0
    rows = []
    torch.set_num_threads(1)
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
        form, seconds = timed_form(world, compiled)
        wall, processor = rate(form, asked, repeats)
        entries = form.index.entries.numel()
        rows.append(
            [
                copies,
                len(world.counts),
                f"{wall:.2f}",
                f"{processor:.2f}",
                f"{form.visited(asked):.0f}",
                f"{entries / len(world.counts):.0f}",
                f"{seconds:.2f}",
            ]
        )
    header = [
        "rooms",
        "cones",
        "M points/s",
        "M points/CPU s",
        "cones visited",
        "index entries a cone",
        "index, s",
    ]
    return markdown(header, rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kinect", type=Path, required=True, help="folder of depth frames")
    parser.add_argument("--points", type=int, default=500_000)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--compiled", action="store_true", help="torch.compile as well")
    options = parser.parse_args()
    scans = list(datasets.load("depth_frames", options.kinect, pixel_stride=4))
    train = [scan for number, scan in enumerate(scans) if number % 5]
    beams = test_beams(scans[::5], options.points // 2, seed=0)
    points = hit_and_free(*beams, "uniform", RESOLUTION, seed=0).points
    print(f"{len(points):,} points at {RESOLUTION} m. {hardware()}\n")
    print(by_components(train, points, options.compiled, options.repeats), "\n")
    print(by_size(train, points, options.compiled, options.repeats))


if __name__ == "__main__":
    main()

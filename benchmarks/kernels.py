"""Fused kernels against their twins in tensor operations, in the same run; and the operations of each.

    python benchmarks/kernels.py --data $GMMTORCH_DATA [--threads 1] [--device cuda]
    python benchmarks/kernels.py --data $GMMTORCH_DATA --against FOLDER_OF_ANOTHER_VERSION

Writes the tables `kernels` and `operations` of BENCHMARKS.md, on a GPU the table `kernels-gpu`, or with
--against the table `against`: the work of `public_work.py` by both versions in turn, on one thread. A time is
the least of several runs.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import torch
from public_work import counted, least_seconds
from tables import ROOT, hardware, markdown, publish, three_digits
from threadpoolctl import threadpool_limits
from torch import Tensor

from gmmtorch import GaussianMap, datasets
from gmmtorch.experiments.evaluation.queries import hit_and_free, test_beams
from gmmtorch.kernels import kernels
from gmmtorch.kernels.mixtures.em_steps import expectation
from gmmtorch.kernels.rays.ray_traversal import traverse
from gmmtorch.mapping.learning.rules import IncrementalRule
from gmmtorch.mixture.em.exact import quadratic_features
from gmmtorch.occupancy.cones import Cones
from gmmtorch.occupancy.evidence import Evidence
from gmmtorch.occupancy.forms.flux import flux_evidence
from gmmtorch.occupancy.forms.point import PointForm
from gmmtorch.occupancy.grid import VoxelGrid
from gmmtorch.occupancy.voxels.sparse_evidence import SparseEvidence

Work = tuple[str, Callable[[], object], float, str]
"""Name, function, size of the work, and unit of its rate; a size of 0 means that seconds are shown."""


def rays(n: int, resolution: float, device: str) -> tuple[Tensor, Tensor, VoxelGrid]:
    """n rays of about 5 m in a box of 20 × 20 × 4 m."""
    generator = torch.Generator().manual_seed(0)
    extent = torch.tensor([20.0, 20.0, 4.0], dtype=torch.float64)
    starts = torch.rand(n, 3, generator=generator, dtype=torch.float64) * extent
    ends = starts + torch.randn(n, 3, generator=generator, dtype=torch.float64) * 3
    ends = ends.clamp(torch.full_like(extent, 1e-6), extent - 1e-6)
    grid = VoxelGrid((0.0,) * 3, resolution, tuple(round(float(x) / resolution) for x in extent))
    return starts.to(device), ends.to(device), grid


def ray_work(n: int, device: str) -> Iterator[Work]:
    for resolution in (0.2, 0.05):
        starts, ends, grid = rays(n, resolution, device)
        a, b = grid.to_units(starts), grid.to_units(ends)
        visits = sum(chunk.voxel.numel() for chunk in traverse(a, b, grid.shape))

        def list_visits(a: Tensor = a, b: Tensor = b, grid: VoxelGrid = grid) -> None:
            for _ in traverse(a, b, grid.shape):
                pass

        def dense(starts: Tensor = starts, ends: Tensor = ends, grid: VoxelGrid = grid) -> None:
            Evidence.empty(grid, device).add_rays(starts, ends)

        def sparse(starts: Tensor = starts, ends: Tensor = ends, h: float = resolution) -> None:
            SparseEvidence(h, 3, device).add_rays(starts, ends)

        yield f"rays through {resolution} m, enumerated", list_visits, visits / 1e6, "M visits/s"
        yield f"rays through {resolution} m, counted, dense", dense, visits / 1e6, "M visits/s"
        yield f"rays through {resolution} m, counted, sparse", sparse, visits / 1e6, "M visits/s"


def map_and_points(
    data: Path, name: str, n_bytes: int, resolution: float, n_points: int, device: str
) -> tuple[Cones, Tensor]:
    """Cones of a map of four scans of five, and half hits, half free points of the others."""
    options = {"pixel_stride": 4} if name == "depth_frames" else {}
    scans = list(datasets.load(name, data, **options))
    built = GaussianMap(learning=IncrementalRule(max_bytes=n_bytes))
    for number, scan in enumerate(scans):
        if number % 5:
            built.insert(scan)
    built.finish()
    beams = test_beams(scans[::5], n_points // 2, seed=0)
    points = hit_and_free(*beams, "uniform", resolution, seed=0).points.to(device)
    return Cones(*(part.to(device) for part in built.components().cones())), points


def map_work(data: Path, n_points: int, device: str) -> Iterator[Work]:
    places = (
        ("kinect, 8 kB", "kinect", "depth_frames", 8000, 0.05),
        ("hall, 26 kB", "hall", "scan_folder", 26000, 0.2),
    )
    for label, folder, name, n_bytes, resolution in places:
        cones, points = map_and_points(data / folder, name, n_bytes, resolution, n_points, device)
        form = PointForm(cones, resolution, 3.0)

        def ask_first(cones: Cones = cones, h: float = resolution, points: Tensor = points) -> object:
            return PointForm(cones, h, 3.0)(points)

        def ask(form: PointForm = form, points: Tensor = points) -> object:
            return form(points)

        size = f"{label}, {len(cones.counts)} cones"
        yield f"point queries, {size}, cutoff 3", ask, len(points) / 1e6, "M points/s"
        yield f"the first of these queries, {size}", ask_first, 0, "s"
        if folder == "kinect":
            low, high = (points.quantile(q, 0, interpolation="nearest") for q in (0.01, 0.99))
            grid = VoxelGrid.covering(low, high, 0.05)

            def flux(cones: Cones = cones, grid: VoxelGrid = grid) -> Evidence:
                return flux_evidence(cones, grid, 3.0, tolerance=1e-3)

            yield f"flux, {label}, {grid.n_cells:,} cells, tolerance 10⁻³", flux, 0, "s"


def small_work(device: str) -> Iterator[tuple[str, Callable[[], object]]]:
    rows = quadratic_features(torch.rand(100_000, 3, dtype=torch.float64))
    natural = torch.randn(1000, 10, dtype=torch.float64)
    parts = [part.to(device) for part in (rows, torch.ones(len(rows)).double(), natural)]
    yield "E-step, 10⁵ rows, 1,000 components", lambda: expectation(*parts)
    starts, ends, grid = rays(100_000, 0.2, device)
    yield "10⁵ rays, counted, dense", lambda: Evidence.empty(grid, device).add_rays(starts, ends)
    yield "10⁵ rays, counted, sparse", lambda: SparseEvidence(0.2, 3, device).add_rays(starts, ends)
    generator = torch.Generator().manual_seed(0)
    means = torch.rand(300, 3, generator=generator).double() * 10
    roots = 0.2 * torch.randn(300, 3, 3, generator=generator).double()
    origins = torch.rand(300, 3, generator=generator).double() * 10
    spread = roots @ roots.mT + 1e-4 * torch.eye(3)
    parts = (means, spread, origins, torch.ones(300).double() * 100, torch.zeros(300, dtype=torch.bool))
    cones = Cones(*(part.to(device) for part in parts))
    form, points = (
        PointForm(cones, 0.1, 3.0),
        torch.rand(20_000, 3, generator=generator).double().to(device) * 10,
    )
    yield "20,000 point queries", lambda: form(points)
    room = VoxelGrid((0.0,) * 3, 0.3, (33, 33, 33))
    yield "flux on 36,000 cells", lambda: flux_evidence(cones, room, 3.0)


def operations_table(device: str) -> str:
    rows = []
    for name, function in small_work(device):
        cells = []
        for choice in ("torch", "fused"):
            with kernels(choice):
                cells.append("{:,} ({:,})".format(*counted(function)))
        rows.append([name, *cells])
    return markdown(["work", "tensor operations", "fused"], rows)


def against(other: Path, data: Path, repeats: int) -> str:
    """The table of the work of another version, in a folder, and of this one; processor seconds."""
    found: dict[str, dict[str, list[float]]] = {}
    for _ in range(repeats):  # in turn, because the load of a shared machine changes
        for folder in (other, ROOT):
            command = [sys.executable, str(ROOT / "benchmarks/public_work.py"), "--data", str(data)]
            environment = {**os.environ, "PYTHONPATH": str(folder), "OMP_NUM_THREADS": "1"}
            done = subprocess.run(command, cwd=folder, env=environment, check=True, stdout=subprocess.PIPE)
            for name, result in json.loads(done.stdout.splitlines()[-1]).items():
                best = found.setdefault(name, {}).setdefault(str(folder), result)
                best[0] = min(best[0], result[0])
    rows = []
    for name, by_folder in found.items():
        before, after = by_folder[str(other)], by_folder[str(ROOT)]
        counts = [f"{int(result[1]):,} ({int(result[2]):,})" for result in (before, after)]
        rows.append([name, f"{before[0]:.3g}", f"{after[0]:.3g}", f"{before[0] / after[0]:.1f}", *counts])
    return markdown(["work", "s before", "s now", "times faster", "operations before", "now"], rows)


def compared(work: Work, repeats: int, device: str) -> list[str]:
    name, function, size, unit = work
    seconds = []
    for choice in ("torch", "fused"):
        with kernels(choice):
            seconds.append(least_seconds(function, repeats, device))
    shown = [three_digits(size / s if size else s) for s in seconds]
    return [name, unit, *shown, three_digits(seconds[0] / seconds[1])]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, help="folder of real scans, for the rows about maps")
    parser.add_argument("--against", type=Path, help="folder of another version, such as a git worktree")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--rays", type=int, default=1_000_000)
    parser.add_argument("--points", type=int, default=200_000)
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    if options.against:
        if not options.data:
            parser.error("--against needs --data")
        table = against(options.against.resolve(), options.data.resolve(), options.repeats)
        publish("against", f"{hardware()}\n\n{table}")
        return
    with threadpool_limits(options.threads):
        rows = [
            compared(work, options.repeats, options.device) for work in ray_work(options.rays, options.device)
        ]
        if options.data:
            work_on_maps = map_work(options.data, options.points, options.device)
            rows += [compared(work, options.repeats, options.device) for work in work_on_maps]
        header = ["work", "", "tensor operations", "fused", "times faster"]
        facts = f"{options.rays:,} rays. {hardware(options.device)}"
        publish(
            "kernels" if options.device == "cpu" else "kernels-gpu", f"{facts}\n\n{markdown(header, rows)}"
        )
        if options.device == "cpu":
            publish("operations", operations_table(options.device))


if __name__ == "__main__":
    main()

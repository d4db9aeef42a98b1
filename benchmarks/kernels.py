"""Fused kernels against their twins in tensor operations, in the same run; and the operations of each.

    python benchmarks/kernels.py --data $GMMTORCH_DATA [--threads 1] [--device cuda]
    python benchmarks/kernels.py --data $GMMTORCH_DATA --only against --against FOLDER_OF_ANOTHER_VERSION
    python benchmarks/kernels.py --data $GMMTORCH_DATA --only devices --device cuda --threads 16

`against` has the work of `public_work.py` by both versions in turn, on one thread; `devices` has it on a CPU
and on a GPU. A time is the least of several runs.
"""

from __future__ import annotations

import itertools
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import torch
from public_work import counted, em, large_works, prepare, works
from torch import Tensor

from gmmtorch import GaussianMap
from gmmtorch.experiments.evaluation.queries import hit_and_free, test_beams
from gmmtorch.experiments.harness import Case, Row, least_seconds, recording, run
from gmmtorch.kernels import kernels
from gmmtorch.kernels.mixtures.em_steps import expectation
from gmmtorch.kernels.rays.ray_traversal import traverse
from gmmtorch.mapping.learning.rules import IncrementalRule
from gmmtorch.mixture.em.exact import natural_of_precisions, quadratic_features
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
        visits = sum(voxel.numel() for voxel, _ in traverse(a, b, grid.shape))

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
    scans = list(recording(data, name, **({"pixel_stride": 4} if name == "kinect" else {})))
    built = GaussianMap(learning=IncrementalRule(max_bytes=n_bytes))
    for number, scan in enumerate(scans):
        if number % 5:
            built.insert(scan)
    built.finish()
    beams = test_beams(scans[::5], n_points // 2, seed=0)
    points = hit_and_free(*beams, "uniform", resolution, seed=0).points.to(device)
    return Cones(*(part.to(device) for part in built.components().cones())), points


def map_work(data: Path, n_points: int, device: str) -> Iterator[Work]:
    for name, n_bytes, resolution in (("kinect", 8000, 0.05), ("hall", 26000, 0.2)):
        label = f"{name}, {n_bytes // 1000} kB"
        cones, points = map_and_points(data, name, n_bytes, resolution, n_points, device)
        form = PointForm(cones, resolution, 3.0)

        def ask_first(cones: Cones = cones, h: float = resolution, points: Tensor = points) -> object:
            return PointForm(cones, h, 3.0)(points)

        def ask(form: PointForm = form, points: Tensor = points) -> object:
            return form(points)

        size = f"{label}, {len(cones.counts)} cones"
        yield f"point queries, {size}, cutoff 3", ask, len(points) / 1e6, "M points/s"
        yield f"the first of these queries, {size}", ask_first, 0, "s"
        if name == "kinect":
            low, high = (points.quantile(q, 0, interpolation="nearest") for q in (0.01, 0.99))
            grid = VoxelGrid.covering(low, high, 0.05)

            def flux(cones: Cones = cones, grid: VoxelGrid = grid) -> Evidence:
                return flux_evidence(cones, grid, 3.0, tolerance=1e-3)

            yield f"flux, {label}, {grid.n_cells:,} cells, tolerance 10⁻³", flux, 0, "s"


def small_work(device: str) -> Iterator[tuple[str, Callable[[], object]]]:
    means = torch.rand(1000, 3, dtype=torch.float64)
    precisions = 400.0 * torch.eye(3, dtype=torch.float64).expand(1000, 3, 3)
    natural = natural_of_precisions(precisions, means, torch.zeros_like(means[:, 0]))
    rows = quadratic_features(torch.rand(100_000, 3, dtype=torch.float64))
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


def fused(options: Any) -> Iterator[Row]:
    """Each work with both choices of kernels, of which the least time counts."""
    options.about = f"{options.rays:,} rays."
    listed = itertools.chain(
        ray_work(options.rays, options.device), map_work(options.data, options.points, options.device)
    )
    for name, function, size, unit in listed:
        seconds = []
        for choice in ("torch", "fused"):
            with kernels(choice):
                seconds.append(least_seconds(function, options.repeats, options.device))
        slow, fast = (size / each if size else each for each in seconds)
        yield name, unit, slow, fast, seconds[0] / seconds[1]


def operations(options: Any) -> Iterator[Row]:
    for name, function in small_work(options.device):
        counts = []
        for choice in ("torch", "fused"):
            with kernels(choice):
                function()
                counts.append("{:,} ({:,})".format(*counted(function)))
        yield name, *counts


def against(options: Any) -> Iterator[Row]:
    """The work of another version, in a folder, and of this one; processor seconds."""
    if options.against is None:
        return
    found: dict[str, dict[Path, list[float]]] = {}
    this, other = Path(__file__).resolve().parent.parent, options.against.resolve()
    for _ in range(options.repeats):  # in turn, because the load of a shared machine changes
        for folder in (other, this):
            command = [sys.executable, str(this / "benchmarks/public_work.py"), "--data", str(options.data)]
            command += ["--only", *options.works] if options.works else []
            environment = {**os.environ, "PYTHONPATH": str(folder), "OMP_NUM_THREADS": "1"}
            done = subprocess.run(command, cwd=folder, env=environment, check=True, stdout=subprocess.PIPE)
            for name, result in json.loads(done.stdout.splitlines()[-1]).items():
                best = found.setdefault(name, {}).setdefault(folder, result)
                best[0] = min(best[0], result[0])
    for name, by_folder in found.items():
        (before, *were), (after, *are) = by_folder[other], by_folder[this]
        counts = ("{:,.0f} ({:,.0f})".format(*each) for each in (were, are))
        yield name, before, after, before / after, *counts


class GpuUse(NamedTuple):
    """Of a work: the seconds in which the GPU computes, the MB that it allocates at most, and what bounds it.

    launches: the GPU waits for the host for more than half of the time. Otherwise memory, if NVML counts
    accesses to it in more than half of the time, or arithmetic.
    """

    busy: float
    megabytes: float
    bound: str

    @staticmethod
    def of(work: Callable[[], object], seconds: float, device: str) -> GpuUse:
        work()
        held = torch.cuda.memory_allocated(device)
        torch.cuda.reset_peak_memory_stats(device)
        with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
            work()
            torch.cuda.synchronize(device)
        busy = sum(event.self_device_time_total for event in profile.key_averages()) / 1e6
        megabytes = (torch.cuda.max_memory_allocated(device) - held) / 1e6
        if busy < 0.5 * seconds:
            return GpuUse(busy, megabytes, "launches")
        shares, end = [], time.perf_counter() + 1.5  # NVML counts in periods of up to a second
        while time.perf_counter() < end:
            work()
            torch.cuda.synchronize(device)
            shares.append(torch.cuda.memory_usage(device))
        return GpuUse(busy, megabytes, "memory" if max(shares) > 50 else "arithmetic")


def devices(options: Any) -> Iterator[Row]:
    """The work of `public_work.py` on the CPU and on the GPU."""
    if options.device == "cpu":
        return
    prepare(options.data)
    both = ("cpu", options.device)
    listed = {device: {**works(options.data, device), **large_works(options.data, device)} for device in both}
    for name in listed["cpu"]:
        if options.works and not any(part in name for part in options.works):
            continue
        seconds, counts = [], (0, 0)
        for device in both:
            work = listed[device][name]()
            counts = counted(work)  # and what is compiled or loaded once
            seconds.append(least_seconds(work, options.repeats, device))
        use = GpuUse.of(work, seconds[1], options.device)
        yield name, *seconds, seconds[0] / seconds[1], *use, "{:,} ({:,})".format(*counts)


def memory_works(data: Path, device: str) -> dict[str, Callable[[int], Callable[[], object]]]:
    """For each work the function that prepares it for n things."""

    def asked(n: int) -> Callable[[], object]:
        cones, some = map_and_points(data, "kinect", 8000, 0.05, 10_000, device)
        points = some.repeat(n // len(some), 1)
        return lambda: PointForm(cones, 0.05, 3.0)(points)

    def cells(n: int) -> Callable[[], object]:
        return lambda: Evidence.empty(VoxelGrid((0.0,) * 3, 0.1, (n // 10_000, 100, 100)), device)

    def counted_rays(n: int) -> Callable[[], object]:
        starts, ends, grid = rays(n, 0.2, device)
        return lambda: Evidence.empty(grid, device).add_rays(starts, ends)

    def components(n: int) -> Callable[[], object]:
        generator = torch.Generator().manual_seed(0)
        side = n ** (1 / 3)
        means = side * torch.rand(n, 3, generator=generator, dtype=torch.float64)
        spread = torch.tensor([0.3, 0.3, 0.02], dtype=torch.float64).square().diag().expand(n, 3, 3)
        counts = torch.full((n,), 100.0, dtype=torch.float64)
        origins = means + torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64)
        parts = [part.to(device) for part in (means, spread, origins, counts, means[:500])]

        def indexed() -> object:
            made = GaussianMap.from_components(*parts[:2], support=parts[3], origins=parts[2])
            made.occupancy(parts[4])
            return made

        return indexed

    return {
        "a point of exact EM, K = 100": lambda n: em(n, 100, device, "exact"),
        "a point of EM, K = 1,000": lambda n: em(n, 1000, device),
        "a component of a map in 3D with its index": components,
        "a point of a query": asked,
        "a ray that is counted": counted_rays,
        "a cell of a dense grid": cells,
    }


def peak_bytes(work: Callable[[], object], device: str) -> int:
    """Bytes of tensors that a work has at most at a time, with its result, beside its input."""
    if device != "cpu":
        before = torch.cuda.memory_allocated(device)
        torch.cuda.reset_peak_memory_stats(device)
        kept = work()
        del kept
        return torch.cuda.max_memory_allocated(device) - before
    with torch.profiler.profile(profile_memory=True) as profile:
        kept = work()
        del kept
    events: Any = profile.profiler
    changes = [event.nbytes() for event in events.kineto_results.events() if event.name() == "[memory]"]
    return max(itertools.accumulate(changes))


def memory(options: Any) -> Iterator[Row]:
    """Of a CPU, and of a GPU if that is the device: the growth from a million things to three million."""
    for name in memory_works(options.data, "cpu"):
        row: list[float | None] = []
        for device in ("cpu", "cuda"):
            if device == "cuda" and not options.device.startswith("cuda"):
                row.append(None)
                continue
            work = memory_works(options.data, device)[name]
            few, many = (peak_bytes(work(n), device) for n in (10**6, 3 * 10**6))
            row.append((many - few) / (2 * 10**6))
        yield name, *row


CASES = (
    Case(
        "kernels{gpu}",
        fused,
        columns={"work": "", "": "", "tensor operations": "3", "fused": "3", "times faster": "3"},
    ),
    Case(
        "operations{gpu}",
        operations,
        "Tensor operations and kernel launches. In parentheses: those that wait for the device.",
        {"work": "", "tensor operations": "", "fused": ""},
        needs_data=False,
    ),
    Case(
        "against",
        against,
        "CPU seconds of another version and of this one.",
        {
            "work": "",
            "s before": "3",
            "s now": "3",
            "times faster": ".1f",
            "operations before": "",
            "now": "",
        },
    ),
    Case(
        "devices",
        devices,
        "Busy: seconds in which the GPU computes. In parentheses: operations that wait for the device.",
        {
            "work": "",
            "s on the CPU": "3",
            "s on the GPU": "3",
            "times faster": "3",
            "busy": "3",
            "MB": ".0f",
            "bound by": "",
            "operations (waits)": "",
        },
    ),
    Case(
        "memory",
        memory,
        "Bytes that each more of a million to three million takes at most, beside its input.",
        {"": "", "bytes on the CPU": ".0f", "on the GPU": ".0f"},
    ),
)

if __name__ == "__main__":
    run(
        __doc__,
        *CASES,
        against={"type": Path, "help": "folder of another version, such as a git worktree"},
        rays={"type": int, "default": 1_000_000},
        points={"type": int, "default": 200_000},
        repeats={"type": int, "default": 3},
        works={"nargs": "*", "help": "of against and devices: parts of names"},
    )

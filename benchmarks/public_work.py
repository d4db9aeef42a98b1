"""Seconds of work by public names, which do not change between versions; `kernels.py --against` runs it.

    python benchmarks/public_work.py --data FOLDER [--only NAME ...]

Prints a JSON object: for each work the processor seconds of its second run, on one thread, and its dispatched
operations and synchronisations. To measure another version, set PYTHONPATH to its folder.
"""

from __future__ import annotations

import argparse
import itertools
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

import gmmtorch as gt

Work = Callable[[], object]
MAP = {"cutoff": 3.0}
FAST = {"cell": 0.05, "iterations": 4, "window": 16, "window_components": 200}


class Operations(TorchDispatchMode):
    """Counts dispatched operations, launches of fused kernels, and operations that wait for the device."""

    WAITS = (
        "_local_scalar_dense",
        "nonzero",
        "unique",
        "masked_select",
        "repeat_interleave",
        "equal",
        "bincount",
    )

    def __init__(self) -> None:
        super().__init__()
        self.n, self.n_waits = 0, 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):  # type: ignore[no-untyped-def]
        name = func.overloadpacket.__name__
        self.n += not any(word in name for word in ("view", "reshape", "expand", "detach", "select", "slice"))
        self.n_waits += any(word in name for word in self.WAITS)
        return func(*args, **(kwargs or {}))


def counted(work: Callable[[], object]) -> tuple[int, int]:
    """Operations, with launches of fused kernels, and synchronisations of the work."""
    try:
        from gmmtorch.kernels.compiler import FusedKernel
    except ImportError:  # a version without fused kernels
        with Operations() as operations:
            work()
        return operations.n, operations.n_waits
    launches, call = [0], FusedKernel.__call__

    def launch(self: FusedKernel, *arguments: object, **options: object) -> None:
        launches[0] += 1
        call(self, *arguments, **options)  # type: ignore[arg-type]

    FusedKernel.__call__ = launch  # type: ignore[method-assign,assignment]
    try:
        with Operations() as operations:
            work()
    finally:
        FusedKernel.__call__ = call  # type: ignore[method-assign]
    return operations.n + launches[0], operations.n_waits


def uniform(*shape: int) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def room(n: int) -> Tensor:
    """Points on the faces of a box of 8 × 6 × 3 m, 1 cm noise."""
    generator = torch.Generator().manual_seed(0)
    size = torch.tensor([8.0, 6.0, 3.0])
    points, axis = torch.rand(n, 3, generator=generator) * size, torch.randint(3, (n,), generator=generator)
    points[torch.arange(n), axis] = size[axis] * torch.randint(2, (n,), generator=generator)
    return (points + 0.01 * torch.randn(n, 3, generator=generator)).double()


def rays(resolution: float, device: str, n: int = 300_000) -> Work:
    """n rays of about 5 m, counted in a dense grid of 20 × 20 × 4 m."""
    extent = torch.tensor([20.0, 20.0, 4.0], dtype=torch.float64)
    starts = uniform(n, 3) * extent
    steps = 3 * torch.randn(n, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    ends = (starts + steps).clamp(torch.full_like(extent, 1e-6), extent - 1e-6)
    grid = gt.VoxelGrid((0.0, 0.0, 0.0), resolution, tuple(round(float(x) / resolution) for x in extent))
    starts, ends = starts.to(device), ends.to(device)
    return lambda: gt.Evidence.empty(grid, device).add_rays(starts, ends)


def exact_em(device: str, n: int = 100_000) -> Work:
    """Five iterations of exact EM on n points with 1,000 components."""
    points = room(n)
    start = {
        "means_init": points[:: n // 1000].numpy(),
        "precisions_init": 25.0 * torch.eye(3).repeat(1000, 1, 1).numpy(),
    }
    points = points.to(device)
    return lambda: gt.GaussianMixture(1000, algorithm="exact", max_iter=5, tol=0.0, **start).fit(points)


def em(n: int, k: int, device: str, algorithm: str = "auto") -> Work:
    points = room(n).to(device)
    options = {"algorithm": algorithm, "tol": 2e-3, "reg_covar": 1e-5, "random_state": 0}
    return lambda: gt.GaussianMixture(k, **options).fit(points)


def frames(data: Path) -> tuple[list[tuple[Tensor, Tensor]], Tensor]:
    dataset: Any = gt.datasets.load("depth_frames", data / "kinect", pixel_stride=2)
    return [dataset.image(i) for i in range(len(dataset)) if i % 5], dataset.intrinsics


def prepare(data: Path) -> None:
    """Read the frames."""
    FRAMES[0][:], intrinsics = frames(data)
    FRAMES[1].copy_(intrinsics)


def built(images: list[tuple[Tensor, Tensor]], stride: int, **rule: float) -> gt.GaussianMap:
    made = gt.GaussianMap(gt.IncrementalRule(max_bytes=8000, **rule), **MAP)
    made.insert_depth(images, FRAMES[1], stride)
    made.finish()
    return made


FRAMES: tuple[list[tuple[Tensor, Tensor]], Tensor] = ([], torch.eye(3))


def frames_to_map(device: str, stride: int, **rule: float) -> Work:
    images = [(depth.to(device), pose) for depth, pose in FRAMES[0]]
    return lambda: built(images, stride, **rule)


def queries(data: Path, name: str, device: str, n: int = 20_000, method: str = "point") -> Work:
    if name == "kinect":
        made, resolution = built(FRAMES[0], 4), 0.05
    else:
        made, resolution = gt.GaussianMap(gt.IncrementalRule(max_bytes=26_000), **MAP), 0.2
        for number, scan in enumerate(gt.datasets.load("scan_folder", data / name)):
            if number % 5 == 0:
                made.insert(scan)
        made.finish()
    low, high = made.means.amin(0), made.means.amax(0)
    points = (low + (high - low) * uniform(n, 3)).to(device)
    made = made if device == "cpu" else made.to(device)
    for _ in range(8):  # the spatial index makes its lists where it is asked often
        made.occupancy(points, resolution, method=method)
    return lambda: made.occupancy(points, resolution, method=method)


def flux(device: str, side: float = 0.1) -> Work:
    made = built(FRAMES[0], 4)
    low, high = made.means.quantile(0.02, 0), made.means.quantile(0.98, 0)
    shape = tuple(((high - low) / side).ceil().long().tolist())
    grid = gt.VoxelGrid(tuple(low.tolist()), side, shape)
    made = made if device == "cpu" else made.to(device)
    return lambda: made.evidence(grid, "flux")


def frame(device: str) -> Work:
    """A cloud of 20,000 points becomes a map of its own, as a frame inserted into a map does."""
    scan = gt.Scan(room(20_000), torch.tensor([4.0, 3.0, 1.5], dtype=torch.float64))
    scan = scan if device == "cpu" else scan.to(device)

    def insert() -> None:
        made = gt.GaussianMap(gt.IncrementalRule(noise=0.01, length=0.5, cell=0.05, window=1), **MAP)
        made.insert(scan)
        made.finish()

    return insert


def registration(data: Path, device: str) -> Work:
    scans = list(gt.datasets.load("scan_folder", data / "hall"))
    made = []
    for place in (10, 14):
        part = gt.GaussianMap(gt.IncrementalRule(noise=0.02, length=0.6, cell=0.05, window=1))
        part.insert(scans[place])
        part.finish()
        made.append(part if device == "cpu" else part.to(device))
    start = torch.eye(4, dtype=torch.float64)
    start[:3, 3] = torch.tensor([0.4, -0.3, 0.1], dtype=torch.float64)
    return lambda: gt.register(made[1], made[0], start)


def planning(device: str) -> Work:
    """Three robots plan, one after the other, and send their plans, after ten seconds of a mission."""
    from gmmtorch.team.exploration.mission import mission as missions
    from gmmtorch.team.exploration.mission.options import TeamOptions
    from gmmtorch.team.exploration.mission.trials import assemble
    from gmmtorch.team.exploration.world.world import open_world

    world = open_world("warehouse", size=(20.0, 16.0, 5.0))
    made = assemble(world, TeamOptions(size=3, duration=10.0, device=device))
    while not made.is_over:
        made.tick(made.elapsed)
    seconds = itertools.count(made.elapsed + 2, 2)

    def plan() -> None:
        now, generator = next(seconds), torch.Generator().manual_seed(0)
        with torch.inference_mode():
            number = round(now / 2)
            missions.plan_together(made.agents, made.coordination, made.options, now, number, generator)

    return plan


def works(data: Path, device: str = "cpu") -> dict[str, Callable[[], Work]]:
    return {
        "rays through 0.2 m, counted, dense": lambda: rays(0.2, device),
        "rays through 0.05 m, counted, dense": lambda: rays(0.05, device),
        "exact EM, 100,000 points, K = 1,000, five iterations": lambda: exact_em(device),
        "EM, 20,000 points, K = 1,000": lambda: em(20_000, 1000, device),
        "EM, 1,000,000 points, K = 2,000": lambda: em(1_000_000, 2000, device),
        "112 frames to a map, default rule": lambda: frames_to_map(device, 4),
        "112 frames to a map, fast rule, every pixel": lambda: frames_to_map(device, 1, **FAST),
        "a frame of 20,000 points inserted": lambda: frame(device),
        "20,000 point queries, kinect in 8 kB": lambda: queries(data, "kinect", device),
        "20,000 point queries, hall in 26 kB": lambda: queries(data, "hall", device),
        "20,000 queries by flux, hall in 26 kB": lambda: queries(data, "hall", device, method="flux"),
        "flux, kinect in 8 kB, cells of 0.1 m": lambda: flux(device),
        "registration of two scans of hall": lambda: registration(data, device),
        "a planning step of three robots": lambda: planning(device),
    }


def large_works(data: Path, device: str) -> dict[str, Callable[[], Work]]:
    """Work that fills a GPU."""
    return {
        "10,000,000 rays through 0.05 m, counted, dense": lambda: rays(0.05, device, 10_000_000),
        "exact EM, 1,000,000 points, K = 1,000, five iterations": lambda: exact_em(device, 1_000_000),
        "EM, 10,000,000 points, K = 10,000": lambda: em(10_000_000, 10_000, device),
        "flux, kinect in 8 kB, cells of 0.03 m": lambda: flux(device, 0.03),
        "1,000,000 point queries, kinect in 8 kB": lambda: queries(data, "kinect", device, 1_000_000),
        "1,000,000 point queries, hall in 26 kB": lambda: queries(data, "hall", device, 1_000_000),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--only", nargs="*", help="parts of names")
    options = parser.parse_args()
    torch.set_num_threads(1)
    prepare(options.data)
    found = {}
    for name, prepared in works(options.data).items():
        if options.only and not any(part in name for part in options.only):
            continue
        work = prepared()
        counts = counted(work)  # and what is loaded once
        begin = time.process_time()
        work()
        found[name] = (time.process_time() - begin, *counts)
    print(json.dumps(found))


if __name__ == "__main__":
    main()

"""Depth frames in memory to a compact map, and to a mixture each: processor time, and what the map is worth.

    python benchmarks/map_building.py --data FOLDER [--max-bytes 8000] [--device cpu]

FOLDER holds kinect/ (640 × 480 frames). Every fifth frame is held out; the maps of the others are asked, by
the point form at 0.05 m, about the beams of every second pixel of those. `depth` learns a mixture of about 50
components of each frame, beside EM to convergence on all its pixels; the mixtures together are one map.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor

from gmmtorch import GaussianMap, GaussianMixture, IncrementalRule
from gmmtorch.datasets.depth_images import DepthFrames
from gmmtorch.experiments.evaluation.queries import hit_and_free, split_indices, test_beams
from gmmtorch.experiments.harness import Case, Row, cpu_seconds, recording, run, score
from gmmtorch.mixture.estimators.depth_image import fit_depth_image
from gmmtorch.pinhole import back_project

FAST = {"cell": 0.05, "iterations": 4, "window": 16, "window_components": 200}
RULES: list[tuple[str, int, dict[str, Any]]] = [  # name, of how many rows and columns one is used, options
    ("default", 4, {}),
    ("default", 1, {}),
    (f"`{', '.join(f'{name}={value}' for name, value in FAST.items())}`", 1, FAST),
]


def measure(options: Any) -> Iterator[Row]:
    dataset = recording(options.data, "kinect", pixel_stride=2)
    assert isinstance(dataset, DepthFrames)
    train, test = split_indices(len(dataset), 5)
    frames = [(depth.to(options.device), pose) for depth, pose in map(dataset.image, train)]
    asked = hit_and_free(*test_beams([dataset[i] for i in test], 50_000, 0), "uniform", 0.05, 0)
    options.about = f"{len(frames)} frames of 640 × 480; at most {options.max_bytes:,} bytes."

    def build(stride: int, changes: dict[str, Any]) -> GaussianMap:
        built = GaussianMap(IncrementalRule(max_bytes=options.max_bytes, **changes), cutoff=3.0)
        built.insert_depth(frames, dataset.intrinsics, stride)
        built.finish()
        return built

    for name, stride, changes in RULES:
        # The first pays for what is loaded but once.
        runs = [cpu_seconds(lambda stride=stride, changes=changes: build(stride, changes)) for _ in range(2)]
        built = runs[-1][1]
        rate, auc = len(frames) / min(seconds for seconds, _ in runs), score(built, asked, 0.05)
        yield name, f"1/{stride**2}" if stride > 1 else "all", rate, auc, built.n_components, built.nbytes


N_COMPONENTS = 50
RESOLUTION = 0.05


def learned(
    frames: list[tuple[Tensor, Tensor]], fit: Callable[[Tensor], GaussianMixture]
) -> tuple[GaussianMap, float, float]:
    """The map of all frames, the median milliseconds of a fit, and the mean log-likelihood."""
    seconds, mixtures = [], []
    for depth, _ in frames:
        begin = time.perf_counter()
        mixtures.append(fit(depth))
        if depth.is_cuda:
            torch.cuda.synchronize()
        seconds.append(time.perf_counter() - begin)
    means, covariances, support, origins, likelihood = [], [], [], [], []
    for (depth, pose), mixture in zip(frames, mixtures, strict=True):
        points = points_of(depth)
        likelihood.append(mixture.score(points[::7]))
        moved = mixture.moved(pose)
        means.append(moved.means.cpu())
        covariances.append(moved.covariances.cpu())
        support.append(moved.weights.cpu() * points.shape[0])
        origins.append(pose[:3, 3].expand_as(means[-1]))
    parts = (torch.cat(part) for part in (means, covariances, support, origins))
    built = GaussianMap.from_components(*parts, cutoff=5.0, prior=1.0)
    return built, 1e3 * statistics.median(seconds), statistics.mean(likelihood)


INTRINSICS = torch.eye(3)


def points_of(depth: Tensor) -> Tensor:
    return back_project(depth.cpu().double(), INTRINSICS.double()).to(depth.device)


def one_frame(options: Any) -> Iterator[Row]:
    dataset = recording(options.data, "kinect", stride=options.every)
    assert isinstance(dataset, DepthFrames)
    INTRINSICS.copy_(dataset.intrinsics)
    train = [i for i in range(len(dataset)) if i % 5]
    images = [dataset.image(i) for i in train]
    frames = [(depth.float().to(options.device), pose) for depth, pose in images]
    origins, ends = test_beams([dataset[i] for i in range(0, len(dataset), 5)], 1_000_000, seed=0)
    asked = hit_and_free(origins, ends, "uniform", RESOLUTION, seed=0)

    def full(depth: Tensor) -> GaussianMixture:
        return GaussianMixture(N_COMPONENTS, reg_covar=1e-4, random_state=0).fit(points_of(depth))

    def fast(iterations: int) -> Callable[[Tensor], GaussianMixture]:
        return lambda depth: fit_depth_image(depth, INTRINSICS, N_COMPONENTS, max_iter=iterations)

    for depth, _ in frames[:3]:
        fast(4)(depth)  # first uses set things up
    height, width = frames[0][0].shape
    options.about = (
        f"{len(frames)} frames of {width} × {height}, {N_COMPONENTS} components each; {RESOLUTION} m."
    )
    for name, fit in {
        "cells, 4 iterations": fast(4),
        "cells, 8 iterations": fast(8),
        "EM on all pixels, to convergence": full,
    }.items():
        built, milliseconds, likelihood = learned(frames, fit)
        yield name, milliseconds, likelihood, score(built, asked, RESOLUTION)


BUILT = {"rule": "", "pixels used": "", "frames/s": ".0f", "AUC": ".4f", "components": ".0f", "bytes": ",.0f"}
LEARNED = {"": "", "ms a frame, median": ".1f", "log-likelihood a pixel": ".3f", "AUC of the map": ".4f"}
CASES = (
    Case("map-building", measure, "CPU seconds.", BUILT, key=2),
    Case("depth", one_frame, columns=LEARNED),
)

if __name__ == "__main__":
    every = {"type": int, "default": 1, "help": "use every n-th frame only, for single frames"}
    run(__doc__, *CASES, max_bytes={"type": int, "default": 8000}, every=every)

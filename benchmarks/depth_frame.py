"""A 640 × 480 depth frame to a mixture: how long it takes, and what the map loses by it.

    python benchmarks/depth_frame.py --data FOLDER [--every 1] [--device cpu]

FOLDER holds kinect/. Every fifth frame is held out; the mixtures of the others, about 50 components
each, are one map. Beside it: EM to convergence on all pixels with as many components.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator
from typing import Any

import torch
from harness import Case, Row, recording, run, score
from torch import Tensor

from gmmtorch import GaussianMap, GaussianMixture
from gmmtorch.datasets.depth_frames import DepthFrames
from gmmtorch.evaluation.queries import hit_and_free, test_beams
from gmmtorch.mixture.depth_image import fit_depth_image
from gmmtorch.pinhole import back_project

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


def measure(options: Any) -> Iterator[Row]:
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
        yield {
            "": name,
            "ms a frame, median": milliseconds,
            "log-likelihood a pixel": likelihood,
            "AUC of the map": score(built, asked, RESOLUTION),
        }


FORMATS = {"ms a frame, median": ".1f", "log-likelihood a pixel": ".3f", "AUC of the map": ".4f"}
CASE = Case("depth", measure, formats=FORMATS)

if __name__ == "__main__":
    run(__doc__, CASE, every={"type": int, "default": 1, "help": "use every n-th frame only"})

"""A 640 × 480 depth frame to a mixture: how long it takes, and what the map loses by it.

    python benchmarks/depth_frame.py --data FOLDER [--every 1] [--device cpu]

FOLDER holds kinect/. Every fifth frame is held out; the mixtures of the others, about 50 components
each, are one map. Beside it: EM to convergence on all pixels with as many components. Writes its
table into BENCHMARKS.md.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import torch
from tables import hardware, markdown, publish
from torch import Tensor

from gmmtorch import GaussianMap, GaussianMixture, datasets
from gmmtorch.datasets.depth_images import DepthFrames
from gmmtorch.experiments.evaluation.metrics import roc
from gmmtorch.experiments.evaluation.queries import hit_and_free, test_beams
from gmmtorch.mixture.estimators.depth_image import fit_depth_image
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--every", type=int, default=1, help="use every n-th frame only")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    dataset = datasets.load("depth_frames", options.data / "kinect", stride=options.every)
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
    rows = []
    for name, fit in {
        "cells, 4 iterations": fast(4),
        "cells, 8 iterations": fast(8),
        "EM on all pixels, to convergence": full,
    }.items():
        built, milliseconds, likelihood = learned(frames, fit)
        theta = built.occupancy(asked.points, RESOLUTION)
        auc = roc(theta[asked.labels == 1], theta[asked.labels == 0]).auc
        rows.append([name, f"{milliseconds:.1f}", f"{likelihood:.3f}", f"{auc:.4f}"])
        print(rows[-1], flush=True)
    header = ["", "ms a frame, median", "log-likelihood a pixel", "AUC of the map"]
    height, width = frames[0][0].shape
    sizes = f"{len(frames)} frames of {width} × {height}, {N_COMPONENTS} components each"
    publish("depth", f"{sizes}; {RESOLUTION} m. {hardware(options.device)}\n\n{markdown(header, rows)}")


if __name__ == "__main__":
    main()

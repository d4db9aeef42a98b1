"""Depth frames in memory to a compact map: frames a second of processor time, and what the map is worth.

    python benchmarks/map_building.py --data FOLDER [--max-bytes 8000] [--device cpu]

FOLDER holds kinect/ (640 × 480 frames). Every fifth frame is held out; the maps of the others are asked, by
the point form at 0.05 m, about the beams of every second pixel of those. Writes its table into
BENCHMARKS.md.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import torch
from tables import hardware, markdown, publish

from gmmtorch import GaussianMap, IncrementalRule, datasets
from gmmtorch.datasets.depth_images import DepthFrames
from gmmtorch.experiments.evaluation.metrics import roc
from gmmtorch.experiments.evaluation.queries import FREE, OCCUPIED, hit_and_free, split_indices, test_beams

FAST = {"cell": 0.05, "iterations": 4, "window": 16, "window_components": 200}
RULES: list[tuple[str, int, dict[str, Any]]] = [  # name, of how many rows and columns one is used, options
    ("default", 4, {}),
    ("default", 1, {}),
    (f"`{', '.join(f'{name}={value}' for name, value in FAST.items())}`", 1, FAST),
]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--max-bytes", type=int, default=8000)
    parser.add_argument("--device", default="cpu")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    dataset = datasets.load("depth_frames", arguments.data / "kinect", pixel_stride=2)
    assert isinstance(dataset, DepthFrames)
    train, test = split_indices(len(dataset), 5)
    images = [dataset.image(i) for i in train]
    frames = [(depth.to(arguments.device), pose) for depth, pose in images]
    intrinsics = dataset.intrinsics
    asked = hit_and_free(*test_beams([dataset[i] for i in test], 50_000, 0), "uniform", 0.05, 0)
    rows = []
    for name, stride, options in RULES:
        seconds = []
        for _ in range(2):  # the first pays for what is loaded but once
            built = GaussianMap(IncrementalRule(max_bytes=arguments.max_bytes, **options), cutoff=3.0)
            begin = time.process_time()
            built.insert_depth(frames, intrinsics, stride)
            built.finish()
            seconds.append(time.process_time() - begin)
        theta = torch.as_tensor(built.occupancy(asked.points, 0.05))
        auc = roc(theta[asked.of(OCCUPIED)], theta[asked.of(FREE)]).auc
        rows.append(
            [
                name,
                f"1/{stride**2}" if stride > 1 else "all",
                f"{len(frames) / min(seconds):.0f}",
                f"{auc:.4f}",
                f"{built.n_components}",
                f"{built.nbytes:,}",
            ]
        )
    header = ["rule", "pixels used", "frames/s", "AUC", "components", "bytes"]
    machine = hardware(arguments.device)
    note = f"{len(frames)} frames of 640 × 480; at most {arguments.max_bytes:,} bytes. {machine}"
    publish("map-building", f"{note}\n\n{markdown(header, rows)}")


if __name__ == "__main__":
    main()

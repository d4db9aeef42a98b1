"""Depth frames in memory to a compact map: frames a second of processor time, and what the map is worth.

    python benchmarks/map_building.py --data FOLDER [--max-bytes 8000] [--device cpu]

FOLDER holds kinect/ (640 × 480 frames). Every fifth frame is held out; the maps of the others are asked, by
the point form at 0.05 m, about the beams of every second pixel of those.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from harness import Case, Row, cpu_seconds, recording, run, score

from gmmtorch import GaussianMap, IncrementalRule
from gmmtorch.datasets.depth_frames import DepthFrames
from gmmtorch.evaluation.queries import hit_and_free, split_indices, test_beams

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
        yield {
            "rule": name,
            "pixels used": f"1/{stride**2}" if stride > 1 else "all",
            "frames/s": len(frames) / min(seconds for seconds, _ in runs),
            "AUC": score(built, asked, 0.05),
            "components": built.n_components,
            "bytes": built.nbytes,
        }


FORMATS = {"frames/s": ".0f", "AUC": ".4f", "components": ".0f", "bytes": ",.0f"}
CASE = Case("map-building", measure, "CPU seconds.", FORMATS, key=2)

if __name__ == "__main__":
    run(__doc__, CASE, max_bytes={"type": int, "default": 8000})

"""How well scans of a moving sensor fit each other under each option that says when their points were taken.

    python benchmarks/deskewing.py --data FOLDER

FOLDER holds bags/turtlebot4/bag, a laser on a robot that drives and turns. The distance is that from points
of a scan to the nearest points of the scan `APART` seconds later: the mean over pairs of scans of the median.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from statistics import fmean
from typing import Any

from scipy.spatial import KDTree

from gmmtorch import datasets
from gmmtorch.experiments.harness import Case, Row, run

APART, STRIDE = 2.0, 3  # seconds; every how many scans begin a pair
OPTIONS: dict[str, dict[str, Any]] = {
    "the defaults": {},
    "`dataset.deskew=false`": {"deskew": False},
    "`dataset.clock=received`": {"clock": "received"},
}


def measure(options: Any) -> Iterator[Row]:
    folder = options.data / "bags" / "turtlebot4" / "bag"
    for name, changes in OPTIONS.items():
        yield name, *distance(folder, changes)


def distance(folder: Path, options: dict[str, Any]) -> tuple[float, int]:
    scans = [scan for scan in datasets.load("rosbag", folder, **options) if scan.time is not None]
    found = []
    for first in scans[::STRIDE]:
        later = [scan for scan in scans if scan.time >= first.time + APART]
        if later:
            near, _ = KDTree(later[0].points.numpy()).query(first.points.numpy())
            found.append(float(sorted(near)[len(near) // 2]))
    return 100 * fmean(found), len(found)


CASE = Case(
    "deskewing",
    measure,
    "Mean over pairs of scans of the median distance from points of a scan to the nearest of the scan two "
    "seconds later.",
    {"TurtleBot4's laser": "", "distance": "{:.1f} cm", "pairs": ".0f"},
)

if __name__ == "__main__":
    run(__doc__, CASE)

"""How well scans of a moving sensor fit each other under each option that says when their points were taken.

    python benchmarks/deskewing.py --data FOLDER

FOLDER holds bags/turtlebot4/bag, a laser on a robot that drives and turns. The distance is that from points
of a scan to the nearest points of the scan `APART` seconds later: the mean over pairs of scans of the median.
Writes its table into docs/recordings.md.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from statistics import fmean
from typing import Any

from scipy.spatial import KDTree
from tables import ROOT, markdown, publish

from gmmtorch import datasets

APART, STRIDE = 2.0, 3  # seconds; every how many scans begin a pair
OPTIONS: dict[str, dict[str, Any]] = {
    "the defaults": {},
    "`dataset.deskew=false`": {"deskew": False},
    "`dataset.clock=received`": {"clock": "received"},
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    folder = parser.parse_args().data / "bags" / "turtlebot4" / "bag"
    rows = [[name, *distance(folder, options)] for name, options in OPTIONS.items()]
    publish(
        "deskewing",
        markdown(["TurtleBot4's laser", "distance", "pairs"], rows),
        ROOT / "docs" / "recordings.md",
    )


def distance(folder: Path, options: dict[str, Any]) -> tuple[str, int]:
    scans = [scan for scan in datasets.load("rosbag", folder, **options) if scan.time is not None]
    found = []
    for first in scans[::STRIDE]:
        later = [scan for scan in scans if scan.time >= first.time + APART]
        if later:
            near, _ = KDTree(later[0].points.numpy()).query(first.points.numpy())
            found.append(float(sorted(near)[len(near) // 2]))
    return f"{100 * fmean(found):.1f} cm", len(found)


if __name__ == "__main__":
    main()

"""Poses estimated from scans alone, against true ones, beside KISS-ICP. Writes a table of BENCHMARKS.md.

    OMP_NUM_THREADS=1 python benchmarks/odometry.py --data FOLDER [--names hall intel] [--most 150]

FOLDER holds hall/, courtyard/, street/ and laser2d/. `--most` limits the scans of each. One thread.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import torch
from tables import hardware, markdown, publish

import gmmtorch as gt
from gmmtorch.datasets import Dataset
from gmmtorch.evaluation.trajectories import absolute_trajectory_error, relative_pose_error
from gmmtorch.localization.recorded_poses import METHODS, with_odometry


def opened(data: Path, name: str, most: int | None) -> Dataset:
    log = data / f"laser2d/{name}.log.gz"
    found = gt.datasets.load("carmen", log) if log.is_file() else gt.datasets.load("scan_folder", data / name)
    if most is not None and most < len(found):
        found._count = lambda: most  # type: ignore[method-assign]
    return found


def row(scans: Dataset, method: str) -> dict[str, object]:
    begin = time.process_time()
    posed, trajectory = with_odometry(scans, method)
    seconds = time.process_time() - begin
    true = torch.stack([posed.own_pose(index) for index in range(len(posed))])
    ate = absolute_trajectory_error(trajectory.poses, true)
    rpe = relative_pose_error(trajectory.poses, true).distances
    return {
        "data": scans.name,
        "scans": len(posed),
        "odometry": method,
        "ATE": f"{ate.rmse:.2f} m",
        "median step error": f"{1e3 * float(rpe.median()):.0f} mm",
        "steps off by over 0.2 m": int((rpe > 0.2).sum()),
        "lost": int((~trajectory.found).sum()) if method == "mixture" else "",
        "closures": trajectory.n_closures,
        "scans/s": f"{len(posed) / seconds:.1f}",
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument(
        "--names", nargs="+", default=["hall", "courtyard", "street", "intel", "freiburg-101"]
    )
    parser.add_argument("--most", type=int)
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows = [
        row(opened(options.data, name, options.most), method) for name in options.names for method in METHODS
    ]
    table = markdown(list(rows[0]), [list(one.values()) for one in rows])
    publish("odometry", f"{table}\n\n{hardware()}")


if __name__ == "__main__":
    main()

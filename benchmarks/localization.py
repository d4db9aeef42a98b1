"""Localises real scans in maps of the others, and in maps of other places. Writes the table of BENCHMARKS.md.

    OMP_NUM_THREADS=1 python benchmarks/localization.py --data $GMMTORCH_DATA

The folder holds hall/ and laser2d/ (intel, aces). Every fifth scan of the hall and every tenth of the logs is
held out. One thread.
"""

from __future__ import annotations

import argparse
import math
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import torch
from tables import hardware, markdown, publish
from torch import Tensor

import gmmtorch as gt
from gmmtorch.datasets import Dataset
from gmmtorch.localization import Tracker
from gmmtorch.pose import generators

_IN_ORDER = 300  # first scans of a log


class Place(NamedTuple):
    """A data set, every how many scans one is held out, and a map of the others."""

    scans: Dataset
    every: int
    map: gt.GaussianMap

    def held_out(self) -> Iterator[tuple[Tensor, Tensor]]:
        """Points in the sensor frame, and the true pose, of the held-out scans."""
        return (self.scan(number) for number in range(0, len(self.scans), self.every))

    def scan(self, number: int) -> tuple[Tensor, Tensor]:
        pose = self.scans.pose(number)
        assert pose is not None
        return self.scans[number].transformed(torch.linalg.inv(pose)).points, pose


def mapped(scans: Dataset, every: int, rule: gt.IncrementalRule) -> Place:
    m = gt.GaussianMap(rule)
    for number, scan in enumerate(scans):
        if number % every:
            m.insert(scan)
    with tempfile.TemporaryDirectory() as folder:  # as a robot has it: rounded by the codec
        m.save(Path(folder) / "map.safetensors")
        m = gt.GaussianMap.load(Path(folder) / "map.safetensors")
    return Place(scans, every, m)


def moved(pose: Tensor, distance: float, angle: float, generator: torch.Generator) -> Tensor:
    """The pose, off by metres and radians in a random direction."""
    dim, off = len(pose) - 1, pose.clone()
    shift = torch.randn(dim, generator=generator).double()
    turn = torch.randn(dim * (dim - 1) // 2, generator=generator).double()
    off[:dim, dim] += distance * shift / shift.norm()
    axis = torch.einsum("k,kij->ij", turn / turn.norm(), generators(dim))
    off[:dim, :dim] = torch.linalg.matrix_exp(angle * axis) @ pose[:dim, :dim]
    return off


class Outcome(NamedTuple):
    """Errors (m, degrees), whether the tracker called the scan found, CPU seconds, and the mean square of the
    position's error in deviations of the covariance.
    """

    distance: float
    angle: float
    found: bool
    seconds: float
    square: float


def located(tracker: Tracker, points: Tensor, truth: Tensor) -> Outcome:
    begin = time.process_time()
    location = tracker.locate(points)
    seconds, dim = time.process_time() - begin, len(truth) - 1
    turn = location.pose[:dim, :dim].T @ truth[:dim, :dim] - torch.eye(dim)
    error = location.pose[:dim, dim] - truth[:dim, dim]
    square = float(error @ torch.linalg.solve(location.covariance[:dim, :dim], error)) / dim
    angle = math.degrees(float(torch.linalg.matrix_norm(turn)) / math.sqrt(2))
    return Outcome(float(error.norm()), angle, location.found, seconds, square)


def row(name: str, outcomes: list[Outcome]) -> dict[str, object]:
    right = [o for o in outcomes if o.distance <= 0.1 and o.angle <= 1]
    middle = sorted(outcomes)[len(outcomes) // 2]
    return {
        "scans": name,
        "n": len(outcomes),
        "within 0.1 m, 1°": f"{len(right) / len(outcomes):.1%}",
        "found": f"{sum(o.found for o in outcomes) / len(outcomes):.1%}",
        "found, but over 0.1 m or 1°": sum(o.found and o not in right for o in outcomes),
        "found, but over 0.5 m or 5°": sum(o.found and (o.distance > 0.5 or o.angle > 5) for o in outcomes),
        "median error": f"{1e3 * middle.distance:.0f} mm",
        "square": f"{sum(o.square for o in right) / max(len(right), 1):.2f}",
        "scans/s": f"{len(outcomes) / sum(o.seconds for o in outcomes):.1f}",
    }


def from_a_rough_pose(place: Place) -> list[Outcome]:
    generator = torch.Generator().manual_seed(0)
    tracker, outcomes = Tracker(place.map), []
    for points, truth in place.held_out():
        tracker.restart(moved(truth, 0.5, math.radians(10), generator))
        outcomes.append(located(tracker, points, truth))
    return outcomes


def without_a_pose(place: Place, m: gt.GaussianMap, most: int) -> list[Outcome]:
    tracker, outcomes = Tracker(m), []
    scans = list(place.held_out())
    for points, truth in scans[:: max(1, len(scans) // most)]:
        tracker.restart()
        outcomes.append(located(tracker, points, truth))
    return outcomes


def one_after_the_other(place: Place) -> list[Outcome]:
    tracker = Tracker(place.map, place.scan(0)[1])
    return [located(tracker, *place.scan(number)) for number in range(min(len(place.scans), _IN_ORDER))]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    options = parser.parse_args()
    torch.set_num_threads(1)
    hall = mapped(
        gt.datasets.load("scan_folder", path=options.data / "hall"), 5, gt.IncrementalRule(max_bytes=8000)
    )
    intel, aces = (
        mapped(
            gt.datasets.load("carmen", path=options.data / f"laser2d/{name}.log.gz"), 10, gt.IncrementalRule()
        )
        for name in ("intel", "aces")
    )
    for place in (hall, intel):  # loads the kernels
        points, pose = place.scan(0)
        located(Tracker(place.map, pose), points, pose)
    rows = []
    for name, place in (("hall", hall), ("intel", intel)):
        rows.append(row(f"{name}, from 0.5 m and 10° off", from_a_rough_pose(place)))
        rows.append(row(f"{name}, without a pose", without_a_pose(place, place.map, 20)))
        rows.append(row(f"{name}, scans in order", one_after_the_other(place)))
    rows.append(row("aces in the map of intel, without a pose", without_a_pose(aces, intel.map, 20)))
    rows.append(row("intel in the map of aces, without a pose", without_a_pose(intel, aces.map, 20)))
    table = markdown(list(rows[0]), [list(row.values()) for row in rows])
    publish("localization", f"{table}\n\n{hardware()}")


if __name__ == "__main__":
    main()

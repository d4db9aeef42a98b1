"""The poses of the scans of a data set in a map, one after the other."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.datasets import Dataset
from gmmtorch.errors import DataError
from gmmtorch.localization.location import Location
from gmmtorch.localization.tracker import Tracker

_GAP = 10.0  # times the median step: the clock jumps, or scans are missing


class ScanLocation(NamedTuple):
    """number: of the scan. time: seconds, or the number if the data set has no times. location: in the map.
    seconds: computing time of the tracker.
    """

    number: int
    time: float
    location: Location
    seconds: float


def locate_scans(
    dataset: Dataset, tracker: Tracker, use_motion: bool = False, turns: Tensor | None = None
) -> Iterator[ScanLocation]:
    """Localises every scan in order. A scan that cannot be read is not found, and its doubt is the reason.

    Args:
        dataset: its poses serve only to move its scans to the frame of the sensor.
        tracker: with the first pose, if it is known.
        use_motion: predict each pose with the motion between the poses of the data set, such as an
            odometry's. False: the sensor moves as between the last two scans.
        turns: rotations (N, D, D) of the sensor since the scan before, as `Dataset.turns` returns them, which
            predict the headings instead; NaN where they are unknown.

    Raises `InvalidArgumentError` if scans and map have different dimensions.
    """
    times = scan_times(dataset)
    before: Tensor | None = None
    for index in range(len(dataset)):
        points, failure = torch.zeros(0, tracker.dim), ""
        pose = dataset.pose(index)
        try:
            scan = dataset[index]
            frame = torch.eye(scan.dim + 1, dtype=torch.float64) if pose is None else pose.double()
            frame = torch.cat([frame[:, :-1], torch.cat([scan.origin.double(), torch.ones(1)])[:, None]], 1)
            points = scan.transformed(torch.linalg.inv(frame)).points
        except DataError as error:
            failure = str(error)
        motion = None
        if use_motion and pose is not None and before is not None:
            motion = torch.linalg.solve(before.double(), pose.double())
        if turns is not None and index and bool(turns[index].isfinite().all()):
            motion = turns[index]
        begin = time.process_time()
        location = tracker.locate(points, motion)
        seconds = time.process_time() - begin
        if failure:
            location = replace(location, doubts=(failure,))
        yield ScanLocation(index, float(times[index]), location, seconds)
        before = pose


def scan_times(dataset: Dataset) -> Tensor:
    """Times (N,) of the scans, seconds; their indices if the data set has none."""
    return torch.arange(len(dataset)).double() if dataset.times is None else dataset.times.double()


def clock_faults(times: Tensor) -> list[tuple[int, str]]:
    """Scans before which the clock goes back or jumps, with a sentence for each. times: (N,), seconds."""
    steps = times.diff()
    if len(steps) < 2:
        return []
    usual = float(steps[steps > 0].median()) if bool((steps > 0).any()) else 0.0
    faults = ((steps < 0) | (steps > _GAP * usual)).nonzero()[:, 0] + 1
    return [(scan, _fault(float(steps[scan - 1]), usual)) for scan in faults.tolist()]


def _fault(step: float, usual: float) -> str:
    if step < 0:
        return (
            f"the clock goes back by {-step:.3g} s; readers of the trajectory drop the poses of one side: "
            "correct the times of the recording (a bag: clock=received)"
        )
    return (
        f"{step:.3g} s after the scan before it, usually {usual:.2g} s: scans are missing, or the clock jumps"
    )

"""Poses of a recording that states none, or none that one trusts: odometry over all of its scans."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.datasets import Dataset, Reposed, in_plane, with_poses
from gmmtorch.errors import DataError, InvalidArgumentError, check_choice
from gmmtorch.localization.location import Location
from gmmtorch.localization.odometry.odometry import Odometry, Trajectory
from gmmtorch.optional_packages import needs_extra

METHODS = ("kiss_icp", "mixture")
MOTIONS = ("constant", "dataset", "imu")


class PosedRecording(NamedTuple):
    """The scans with the estimated poses, and the trajectory of all scans."""

    dataset: Reposed
    trajectory: Trajectory


def with_odometry(
    source: Dataset,
    method: str = "mixture",
    on_scan: Callable[[int, int], None] = lambda done, total: None,
    motion: str = "constant",
) -> PosedRecording:
    """A data set whose poses are estimated from its scans. The frame of the first usable scan is the world.

    Args:
        source: its own poses move the points into the frame of the sensor, and are not used otherwise.
        method: mixture, `Odometry`; or kiss_icp, the package of Vizzo et al. (2023), without loop
            closures and without covariances (NaN).
        on_scan: called with the number of scans done and of all.
        motion: prediction of each pose. constant: the motion continues; dataset: as between the poses of the
            data set, such as those of wheel odometry; imu: with the rotation of a bag's IMU, while the
            velocity continues. The last two are for mixture only.

    Raises `InvalidArgumentError` for another method or motion or without a usable IMU, `DataError` if no scan
    can be read.
    """
    check_choice("odometry", method, METHODS)
    check_choice("motion", motion, MOTIONS)
    if motion != "constant" and method != "mixture":
        raise InvalidArgumentError(
            f"motion={motion} does not go with odometry={method}; use odometry=mixture."
        )
    turns = source.turns() if motion == "imu" else None
    odometry = odometry_of(method)
    known = torch.zeros(len(source), dtype=torch.bool)
    times = source.times
    before: int | None = None
    for index in range(len(source)):
        points = _sensor_points(source, index)
        if points is not None:
            predicted = None
            if before is not None and motion != "constant":
                predicted = _motion(source, turns, before, index)
            odometry.add(points, None if times is None else float(times[index]), predicted)
            known[index], before = True, index
        on_scan(index + 1, len(source))
    if not known.any():
        raise DataError(f"{source.name}: no scan of {len(source)} can be read, so none has a pose.")
    trajectory: Trajectory = odometry.trajectory()
    poses = torch.eye(trajectory.poses.shape[1]).double().repeat(len(source), 1, 1)
    poses[known] = trajectory.poses
    return PosedRecording(with_poses(source, poses, known), trajectory)


def _motion(source: Dataset, turns: Tensor | None, before: int, now: int) -> Tensor | None:
    """The motion of the sensor between two scans, by the poses of the data set, or its rotation by `turns`
    (N, D, D) since the scan before; None if it is unknown.
    """
    if turns is not None:
        turn = functools.reduce(torch.matmul, turns[before + 1 : now + 1])
        return turn if bool(turn.isfinite().all()) else None
    first, last = source.pose(before), source.pose(now)
    return None if first is None or last is None else torch.linalg.solve(first.double(), last.double())


def _sensor_points(source: Dataset, index: int) -> Tensor | None:
    """Returns (N, D) of a scan in the frame of the sensor; None if it cannot be read."""
    try:
        scan, pose = source[index], source.pose(index)
    except DataError:
        return None  # the reader counts it in `skipped`
    if pose is None:
        raise DataError(
            f"{source.name} does not state the poses in which its points are, so they cannot be moved into "
            "the frame of the sensor."
        )
    return (scan.points.double() - pose[:-1, -1]) @ pose[:-1, :-1]


def odometry_of(method: str) -> Odometry | KissIcp:
    """Odometry by a method, mixture or kiss_icp, without a scan yet."""
    check_choice("odometry", method, METHODS)
    return Odometry() if method == "mixture" else KissIcp()


class KissIcp:
    """KISS-ICP behind the methods of `Odometry`. Scans in 2D lie at z = 0."""

    def __init__(self) -> None:
        with needs_extra("Odometry by kiss_icp needs", "kiss-icp", "odometry"):
            from kiss_icp.config import KISSConfig
            from kiss_icp.kiss_icp import KissICP
        config = KISSConfig()
        config.data.deskew = False  # the readers have deskewed the points
        config.mapping.voxel_size = config.data.max_range / 100  # its own default
        self._icp = KissICP(config)
        self._locations: list[Location] = []

    def add(self, points: Tensor, stamp: float | None = None, motion: Tensor | None = None) -> Location:
        """The pose of the next scan in the frame of the first one, without a covariance (NaN)."""
        dim = points.shape[1]
        rows = torch.nn.functional.pad(points, (0, 3 - dim))
        if len(rows):
            self._icp.register_frame(rows.numpy(), rows.new_zeros(0).numpy())
        pose = self._icp.last_pose if dim == 3 else in_plane(self._icp.last_pose[None])[0]
        free = dim * (dim + 1) // 2
        unknown = torch.full((free, free), torch.nan, dtype=torch.float64)
        self._locations.append(Location(torch.from_numpy(pose.copy()), unknown, 1.0, ()))
        return self._locations[-1]

    def trajectory(self) -> Trajectory:
        """The poses of all scans so far."""
        poses = torch.stack([location.pose for location in self._locations])
        covariances = torch.stack([location.covariance for location in self._locations])
        found = torch.ones(len(poses), dtype=torch.bool)
        return Trajectory(poses, covariances, found, 0, ("",) * len(poses))

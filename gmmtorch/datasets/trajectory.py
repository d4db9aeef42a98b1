"""Trajectory: poses at times, interpolated, and read from TUM and KITTI files; data sets moved to them."""

from __future__ import annotations

import bisect
import logging
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gmmtorch.datasets.base import NO_POSE, Dataset, check_poses, number_rows
from gmmtorch.errors import DataError, InvalidArgumentError, MissingDataError
from gmmtorch.pose import Pose
from gmmtorch.scan import Scan

NANOSECONDS = 1_000_000_000
_log = logging.getLogger(__name__)


class PosesAt(NamedTuple):
    """poses: of space (M). known: (M,) whether the pose is known at the time."""

    poses: Pose
    known: np.ndarray


@dataclass(frozen=True)
class Trajectory:
    """Poses of one frame in another at increasing times.

    times: (N,) int64, nanoseconds. poses: of space (N).
    has_times: False if the poses are those of scans 0, 1, 2, …, which `times` counts.
    """

    times: np.ndarray
    poses: Pose
    has_times: bool = True

    @staticmethod
    def from_samples(times: np.ndarray, poses: Pose) -> Trajectory:
        """The trajectory of samples in the order of recording.

        If the clock jumps, the longest sequence of increasing times is kept. Of samples with equal times the
        last one counts.
        """
        kept = strictly_increasing(times)
        return Trajectory(times[kept], poses[kept])

    def __len__(self) -> int:
        return len(self.times)

    def at(self, times: np.ndarray, max_gap: float = np.inf) -> PosesAt:
        """Poses at times (M,) in ns: linear in position, spherical linear in rotation (Shoemake 1985).

        A sample's own pose is returned unchanged. A pose is unknown before the first sample, after the last
        one, and between samples that are more than `max_gap` seconds apart.
        """
        if len(self) == 0:
            return PosesAt(Pose.identity(3, len(times)), np.zeros(len(times), bool))
        after = np.searchsorted(self.times, times).clip(0, len(self) - 1)
        exact = self.times[after] == times
        before = np.maximum(after - 1, 0)
        gap = self.times[after] - self.times[before]
        inside = (self.times[0] <= times) & (times <= self.times[-1]) & (gap <= max_gap * NANOSECONDS)
        share = np.where(exact, 1.0, (times - self.times[before]) / np.maximum(gap, 1)).clip(0, 1)
        found, between = self.poses[after], inside & ~exact
        if between.any():
            way = self.poses[before[between]].towards(found[between], share[between])
            found.rotation[between], found.translation[between] = way.parts
        return PosesAt(found, exact | inside)


def increasing(times: np.ndarray) -> np.ndarray:
    """Indices of the longest subsequence of `times` that never decreases (patience sorting)."""
    if len(times) < 2 or (np.diff(times) >= 0).all():
        return np.arange(len(times))
    tails: list[int] = []
    ends: list[int] = []
    before = np.full(len(times), -1)
    for index, time in enumerate(times.tolist()):
        place = bisect.bisect_right(tails, time)
        before[index] = ends[place - 1] if place else -1
        tails[place : place + 1], ends[place : place + 1] = [time], [index]
    chain = [ends[-1]]
    while before[chain[-1]] >= 0:
        chain.append(int(before[chain[-1]]))
    return np.array(chain[::-1])


def strictly_increasing(times: np.ndarray) -> np.ndarray:
    """Indices of `increasing(times)`; of equal times that of the last one."""
    order = increasing(times)
    return order[np.append(np.diff(times[order]) > 0, True)] if len(order) else order


def read_trajectory(path: str | Path, n_scans: int | None = None) -> Trajectory:
    """A trajectory file: TUM rows (time x y z qx qy qz qw), or KITTI rows (12 numbers, no time).

    TUM rows out of order are sorted, with a warning. n_scans: wanted number of poses without times, one for
    each scan; None: any. Raises `MissingDataError` and `DataError`, which names the row.
    """
    path = Path(path).expanduser()
    if not path.is_file():
        raise MissingDataError(f"‹poses›={path} does not exist; give a TUM or KITTI trajectory file.")
    rows = read_rows(path)
    if rows.shape[1] == 8:
        return _tum(path, rows)
    if rows.shape[1] != 12:
        raise DataError(
            f"{path} has {rows.shape[1]} numbers per row; a TUM trajectory has 8 (time x y z qx qy qz qw), a "
            "KITTI trajectory 12."
        )
    if n_scans is not None and len(rows) != n_scans:
        raise DataError(
            f"{path} has {len(rows)} poses without times for {n_scans} scans; write one row for each scan, "
            "or a TUM trajectory, which has times."
        )
    return Trajectory(np.arange(len(rows)), kitti_poses(path, rows), has_times=False)


def read_rows(path: Path) -> np.ndarray:
    """The numbers of a text file, one row a line; # begins a comment. Raises `DataError`."""
    text = path.read_text("utf-8", errors="replace")
    lines = [line for line in (line.split("#")[0] for line in text.splitlines()) if line.strip()]
    if not lines:
        raise DataError(f"{path} contains no row of numbers.")
    return number_rows(lines, None, f"{path}, row")


def kitti_poses(path: Path, rows: np.ndarray) -> Pose:
    """The poses (N) of KITTI rows (N, 12). Raises `DataError` for a row that is not rigid."""
    matrices = Pose.identity(3, len(rows)).matrix
    matrices[:, :3] = torch.from_numpy(rows.reshape(-1, 3, 4))
    return Pose.from_matrix(check_poses(matrices, f"{path}, row"))


def _tum(path: Path, rows: np.ndarray) -> Trajectory:
    if not np.isfinite(rows[:, 0]).all() or (np.abs(rows[:, 0]) > 9e9).any():
        raise DataError(f"{path} has times that are not seconds; a TUM row is: time x y z qx qy qz qw.")
    try:
        poses = Pose.from_quaternion(rows[:, 1:4], rows[:, 4:])
    except ValueError as error:
        raise DataError(f"{path}: a row is not a pose; a TUM row is: time x y z qx qy qz qw.") from error
    times = to_nanoseconds(rows[:, 0])
    order = order_of_rows(path, times)
    return Trajectory.from_samples(times[order], poses[order])


def order_of_rows(path: Path, times: np.ndarray) -> np.ndarray:
    """The order (N,) of the rows of a file by their times (N,). A warning states how many rows it moves."""
    n_moved, n_rows = len(times) - len(increasing(times)), len(times)
    if n_moved:
        _log.warning("%s: %d of %d rows are out of order; they are sorted by time.", path, n_moved, n_rows)
    return np.argsort(times, kind="stable")


def to_nanoseconds(seconds: np.ndarray) -> np.ndarray:
    """Times in seconds as int64 nanoseconds."""
    whole = np.floor(seconds)
    return whole.astype(np.int64) * NANOSECONDS + np.round((seconds - whole) * 1e9).astype(np.int64)


_MAX_GAP = 2.0


def with_trajectory(source: Dataset, path: str | Path, stride: int) -> Dataset:
    """Every `stride`-th scan of a data set (stride 1) with poses, moved to those of a trajectory file.

    The file has KITTI rows, one for each scan, or TUM rows, which are interpolated at the times of the scans
    over at most two seconds. Both state the pose of the sensor, world ← sensor.

    Raises `InvalidArgumentError` if the data set has no poses, or no times for TUM rows, and `DataError`.
    """
    path = Path(path).expanduser()
    if len(source) == 0 or source.pose(0) is None:
        raise InvalidArgumentError(
            f"‹poses›={path} cannot be used: the data set does not state its own poses, from which its "
            "points would be moved."
        )
    trajectory = read_trajectory(path, len(source))
    if not trajectory.has_times:
        found, known = trajectory.poses, np.ones(len(source), bool)
    else:
        if source.times is None:
            raise InvalidArgumentError(
                f"‹poses›={path} has poses at times, but the scans have no times; give a KITTI "
                "trajectory, one row for each scan."
            )
        found, known = trajectory.at(to_nanoseconds(source.times.numpy()), _MAX_GAP)
        if not known.any():
            first, last = float(source.times[0]), float(source.times[-1])
            raise DataError(f"{path} has no pose for the scans, which are from {first:.3f} to {last:.3f} s.")
    poses = found.in_plane() if source[0].dim == 2 else found
    return with_poses(source, poses.matrix, torch.from_numpy(known), stride)


def with_poses(source: Dataset, poses: Tensor, known: Tensor, stride: int = 1) -> Reposed:
    """Every `stride`-th scan of a data set, moved to other poses (N, D+1, D+1), world ← sensor.

    known: which of the N scans have such a pose (N,); the others are left out.
    """
    kind = ReposedDepth if hasattr(source, "image") else Reposed
    return kind(source, poses, known, stride)


POINT_TIMES = "point_times"
"""Channel of scans whose `Dataset.keeps_point_times` is set: seconds after the time of the scan."""
_KNOTS = 512  # motions for the points of a sweep


def deskewed(points: Tensor, seconds: Tensor, motion: Pose, duration: float) -> Tensor:
    """Points of a sweep as the sensor would have measured them all at the time of the scan, its frame.

    A point p of τ seconds after that time becomes T(τ) p, where T(τ) is the share τ / `duration` of a motion:
    linear in position, spherical linear in rotation.

    Args:
        points: (N, D), each in the frame of the sensor at its own time, metres. seconds: (N,).
        motion: of the sensor in `duration` seconds: its frame at the time of the scan ← frame then. A
            negative duration is for the motion back to an earlier scan.
    """
    if not len(points):
        return points
    shares = seconds / duration
    first, last = shares.aminmax()
    knots = torch.linspace(float(first), float(last), _KNOTS, dtype=torch.float64, device=points.device)
    nearest = ((shares - first) * ((_KNOTS - 1) / (last - first).clamp_min(1e-12))).round().long()
    here = Pose.identity(motion.dim, device=points.device)
    return here.towards(motion, knots)[nearest].apply(points.double()[:, None])[:, 0]


def without_point_times(scan: Scan, points: Tensor | None = None) -> Scan:
    """A scan without the channel of times, and with other points (N, D) if they are given."""
    channels = {name: value for name, value in scan.attributes.items() if name != POINT_TIMES}
    return replace(scan, points=scan.points if points is None else points, attributes=channels)


class Reposed(Dataset):
    """Scans of another data set with other poses; made by `with_poses` and `with_trajectory`."""

    _poses: Tensor

    def __init__(self, source: Dataset, poses: Tensor, known: Tensor, stride: int) -> None:
        super().__init__(source.name, source.ranges, stride)
        self._source: Any = source
        self._indices = known.nonzero().squeeze(1).tolist()
        self._skip(NO_POSE, *(~known).nonzero().squeeze(1).tolist())
        self._poses = poses[self._indices]
        self._times = None if source.times is None else source.times[self._indices]

    @property
    def skipped(self) -> dict[str, int]:
        return {**self._source.skipped, **super().skipped}

    def _count(self) -> int:
        return len(self._indices)

    def own_pose(self, index: int) -> Tensor:
        """The pose (D+1, D+1) that the source states for scan `index`, world ← sensor."""
        pose: Tensor = self._source.pose(self._indices[self._position(index)])
        return pose

    def _read(self, index: int) -> Scan:
        before = Pose.from_matrix(self._source.pose(self._indices[index]))
        now = Pose.from_matrix(self._poses[index])
        turn = (now @ before.inverse()).orthonormal().rotation  # rotations in files are rounded
        scan = self._deskewed(self._source[self._indices[index]], index, before)
        return scan.transformed(Pose(turn, now.translation - turn @ before.translation).matrix)

    def _deskewed(self, scan: Scan, index: int, placed: Pose) -> Scan:
        """A scan with times of points, each moved by the motion to the next scan or from the last one."""
        if POINT_TIMES not in scan.attributes:
            return scan
        seconds, points = scan.attributes[POINT_TIMES][:, 0], scan.points
        now, still = Pose.from_matrix(self._poses[index]), torch.zeros(scan.dim)
        for other, part in ((index - 1, seconds < 0), (index + 1, seconds >= 0)):
            other = other if 0 <= other < len(self._indices) else 2 * index - other
            if self._times is None or not 0 <= other < len(self._indices):
                continue
            duration = float(self._times[other] - self._times[index])
            if duration and bool(part.any()):
                motion = now.inverse() @ Pose.from_matrix(self._poses[other])
                local = Scan(points[part], still).transformed(placed.inverse().matrix).points
                moved = placed.apply(deskewed(local, seconds[part], motion, duration))
                points = points.double().index_put((part.nonzero()[:, 0],), moved)
        return without_point_times(scan, points)


class ReposedDepth(Reposed):
    """Depth images of another data set with other poses. `intrinsics` and `image` are as in `DepthFrames`."""

    @property
    def intrinsics(self) -> Tensor:
        matrix: Tensor = self._source.intrinsics
        return matrix

    def image(self, index: int) -> tuple[Tensor, Tensor]:
        """Depth (H, W) in metres, 0 for invalid pixels, and pose (4, 4), world ← camera, of a scan."""
        position = self._position(index)
        depth, _ = self._source.image(self._indices[position])
        return depth, self._poses[position]

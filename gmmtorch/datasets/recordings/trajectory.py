"""Trajectory: poses at times, interpolated, and read from files in the TUM and KITTI forms."""

from __future__ import annotations

import bisect
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from gmmtorch.datasets.base import check_pose
from gmmtorch.datasets.number_rows import number_rows
from gmmtorch.errors import DataError, MissingDataError

NANOSECONDS = 1_000_000_000
MIN_NORM = 1e-6
"""A quaternion with a smaller norm states no rotation."""
_log = logging.getLogger(__name__)


class Poses(NamedTuple):
    """matrices: (M, 4, 4). known: (M,) whether the pose is known at the time."""

    matrices: np.ndarray
    known: np.ndarray


@dataclass(frozen=True)
class Trajectory:
    """Poses of one frame in another at increasing times.

    times: (N,) int64, nanoseconds. matrices: (N, 4, 4) float64, metres.
    has_times: False if the poses are those of scans 0, 1, 2, …, which `times` counts.
    """

    times: np.ndarray
    matrices: np.ndarray
    has_times: bool = True

    @staticmethod
    def from_samples(times: np.ndarray, matrices: np.ndarray) -> Trajectory:
        """The trajectory of samples in the order of recording.

        If the clock jumps, the longest sequence of increasing times is kept. Of samples with equal times the
        last one counts.
        """
        kept = strictly_increasing(times)
        return Trajectory(times[kept], matrices[kept])

    def __len__(self) -> int:
        return len(self.times)

    def at(self, times: np.ndarray, max_gap: float = np.inf) -> Poses:
        """Poses at times (M,) in ns: linear in position, spherical linear in rotation (Shoemake 1985).

        A sample's own pose is returned unchanged. A pose is unknown before the first sample, after the last
        one, and between samples that are more than `max_gap` seconds apart.
        """
        if len(self) == 0:
            return Poses(np.tile(np.eye(4), (len(times), 1, 1)), np.zeros(len(times), bool))
        after = np.searchsorted(self.times, times).clip(0, len(self) - 1)
        exact = self.times[after] == times
        before = np.maximum(after - 1, 0)
        gap = self.times[after] - self.times[before]
        inside = (self.times[0] <= times) & (times <= self.times[-1]) & (gap <= max_gap * NANOSECONDS)
        share = np.where(exact, 1.0, (times - self.times[before]) / np.maximum(gap, 1)).clip(0, 1)
        found = self.matrices[after].copy()
        between = inside & ~exact
        if between.any():
            found[between] = _between(
                self.matrices[before[between]], self.matrices[after[between]], share[between]
            )
        return Poses(found, exact | inside)


def _between(first: np.ndarray, second: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Poses (M, 4, 4) at a share (M,) of the way from the first to the second."""
    from scipy.spatial.transform import Rotation

    start = Rotation.from_matrix(first[:, :3, :3])
    turn = (start.inv() * Rotation.from_matrix(second[:, :3, :3])).as_rotvec()
    found = np.tile(np.eye(4), (len(share), 1, 1))
    found[:, :3, :3] = (start * Rotation.from_rotvec(turn * share[:, None])).as_matrix()
    found[:, :3, 3] = first[:, :3, 3] + (second[:, :3, 3] - first[:, :3, 3]) * share[:, None]
    return found


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


def pose_matrix(position: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
    """Poses (…, 4, 4) from positions (…, 3) and quaternions (…, 4) x, y, z, w, which are normalized.

    Raises `ValueError` if a number is not finite or a quaternion is zero.
    """
    with np.errstate(over="ignore"):
        norm = np.linalg.norm(quaternion, axis=-1, keepdims=True)
    if not (np.isfinite(position).all() and np.isfinite(norm).all() and (norm > MIN_NORM).all()):
        raise ValueError(f"position {position} with quaternion {quaternion} is not a pose")
    x, y, z, w = np.moveaxis(quaternion / norm, -1, 0)
    found = np.zeros((*position.shape[:-1], 4, 4))
    found[..., 0, :3] = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)], -1)
    found[..., 1, :3] = np.stack([2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)], -1)
    found[..., 2, :3] = np.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], -1)
    found[..., :3, 3], found[..., 3, 3] = position, 1
    return found


def read_trajectory(path: str | Path, n_scans: int | None = None) -> Trajectory:
    """A trajectory file: TUM rows (time x y z qx qy qz qw), or KITTI rows (12 numbers, no time).

    TUM rows out of order are sorted, with a warning. n_scans: wanted number of poses without times, one for
    each scan; None: any. Raises `MissingDataError`
    and `DataError`, which names the row.
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
    return Trajectory(np.arange(len(rows)), kitti_matrices(path, rows), has_times=False)


def read_rows(path: Path) -> np.ndarray:
    """The numbers of a text file, one row a line; # begins a comment. Raises `DataError`."""
    text = path.read_text("utf-8", errors="replace")
    lines = [line for line in (line.split("#")[0] for line in text.splitlines()) if line.strip()]
    if not lines:
        raise DataError(f"{path} contains no row of numbers.")
    return number_rows(lines, None, f"{path}, row")


def kitti_matrices(path: Path, rows: np.ndarray) -> np.ndarray:
    """Poses (N, 4, 4) from KITTI rows (N, 12). Raises `DataError` for a row that is not rigid."""
    matrices = np.tile(np.eye(4), (len(rows), 1, 1))
    matrices[:, :3] = rows.reshape(-1, 3, 4)
    for number, matrix in enumerate(matrices, 1):
        check_pose(torch.from_numpy(matrix), f"{path}, row {number}")
    return matrices


def _tum(path: Path, rows: np.ndarray) -> Trajectory:
    if not np.isfinite(rows[:, 0]).all() or (np.abs(rows[:, 0]) > 9e9).any():
        raise DataError(f"{path} has times that are not seconds; a TUM row is: time x y z qx qy qz qw.")
    try:
        matrices = pose_matrix(rows[:, 1:4], rows[:, 4:])
    except ValueError as error:
        raise DataError(f"{path}: a row is not a pose; a TUM row is: time x y z qx qy qz qw.") from error
    times = to_nanoseconds(rows[:, 0])
    order = order_of_rows(path, times)
    return Trajectory.from_samples(times[order], matrices[order])


def order_of_rows(path: Path, times: np.ndarray) -> np.ndarray:
    """The order (N,) of the rows of a file by their times (N,). A warning states how many rows it moves."""
    order = np.argsort(times, kind="stable")
    n_moved = len(times) - len(increasing(times))
    if n_moved:
        _log.warning(
            "%s: %d of %d rows are out of order; they are sorted by time.", path, n_moved, len(times)
        )
    return order


def to_nanoseconds(seconds: np.ndarray) -> np.ndarray:
    """Times in seconds as int64 nanoseconds."""
    whole = np.floor(seconds)
    return whole.astype(np.int64) * NANOSECONDS + np.round((seconds - whole) * 1e9).astype(np.int64)


def in_plane(matrices: np.ndarray) -> np.ndarray:
    """Poses (N, 4, 4) as poses (N, 3, 3) of the plane: x, y and the heading of the x axis."""
    found = np.tile(np.eye(3), (len(matrices), 1, 1))
    heading = np.arctan2(matrices[:, 1, 0], matrices[:, 0, 0])
    cos, sin = np.cos(heading), np.sin(heading)
    found[:, 0, 0], found[:, 0, 1], found[:, 1, 0], found[:, 1, 1] = cos, -sin, sin, cos
    found[:, :2, 2] = matrices[:, :2, 3]
    return found


def in_space(poses: np.ndarray) -> np.ndarray:
    """Poses (N, 3, 3) of the plane as poses (N, 4, 4) at height 0; poses (N, 4, 4) as they are."""
    dim = poses.shape[1] - 1
    found = np.tile(np.eye(4), (len(poses), 1, 1))
    found[:, :dim, :dim], found[:, :dim, 3] = poses[:, :dim, :dim], poses[:, :dim, dim]
    return found

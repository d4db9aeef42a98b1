"""Writes trajectories: poses over time in the text forms of the TUM RGB-D and KITTI odometry benchmarks, and
as a table with covariances.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.files import write_bytes
from gmmtorch.pose import Pose
from gmmtorch.scan import ArrayLike

_POSE = ("time", "x", "y", "z", "qx", "qy", "qz", "qw")
_FREE = {3: ("x", "y", "yaw"), 6: ("x", "y", "z", "roll", "pitch", "yaw")}


def write_tum(path: str | Path, times: ArrayLike, poses: ArrayLike) -> Path:
    """Writes a trajectory atomically, one line per pose: time, x, y, z, and the quaternion qx, qy, qz, qw.

    Args:
        times: (S,), seconds.
        poses: (S, D+1, D+1), world ← sensor, metres. Poses in 2D lie at z = 0.

    Raises `InvalidArgumentError` for other shapes, and for values that are not finite.
    """
    rows = _pose_rows(times, _checked(poses))
    lines = [f"{t:.9f} " + _numbers(row, 9) for t, *row in rows]
    text = "\n".join(["# timestamp x y z qx qy qz qw", *lines]) + "\n"
    return write_bytes(path, text.encode())


def write_kitti(path: str | Path, poses: ArrayLike) -> Path:
    """Writes a trajectory atomically, one line per pose: the 12 numbers of world ← sensor, row by row.

    The form has no times. Numbers have 17 digits, which float64 needs to be read back without change.

    Args:
        poses: (S, D+1, D+1), world ← sensor, metres. Poses in 2D lie at z = 0.

    Raises `InvalidArgumentError` for other shapes, and for values that are not finite.
    """
    lines = [_numbers(rows, 17) + "\n" for rows in _checked(poses).matrix[:, :3].flatten(1).tolist()]
    return write_bytes(path, "".join(lines).encode())


def write_pose_table(
    path: str | Path,
    times: ArrayLike,
    poses: ArrayLike,
    covariances: ArrayLike,
    columns: Mapping[str, Sequence[object]] | None = None,
) -> Path:
    """Writes a CSV table atomically, one row a pose: time, x, y, z, qx, qy, qz, qw, further columns, and the
    upper triangle of the covariance: cov_xx, cov_xy, …, cov_yaw_yaw.

    Args:
        times: (S,), seconds.
        poses: (S, D+1, D+1), world ← sensor, metres. Poses in 2D lie at z = 0.
        covariances: (S, F, F) of a shift (m) and a turn (rad) of the pose: x, y, yaw in 2D; x, y, z, roll,
            pitch, yaw in 3D, in the axes of the world.
        columns: further values (S,) by name.

    Raises `InvalidArgumentError` for other shapes, and for values that are not finite.
    """
    pose_rows = _pose_rows(times, _checked(poses))
    spread = torch.as_tensor(covariances).detach().cpu().double().numpy()
    free = _FREE.get(spread.shape[-1] if spread.ndim == 3 else 0, ())
    if spread.shape != (len(pose_rows), len(free), len(free)) or not np.isfinite(spread).all():
        raise InvalidArgumentError(
            f"covariances has shape {spread.shape} or holds NaN; expected (S, 3, 3) or (S, 6, 6) of "
            f"{len(pose_rows)} poses."
        )
    more = dict(columns or {})
    rows, cols = np.triu_indices(len(free))
    names = [f"cov_{free[i]}_{free[j]}" for i, j in zip(rows, cols, strict=True)]
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow([*_POSE, *more, *names])
    for at, (time, *numbers) in enumerate(pose_rows):
        table.writerow(
            [
                f"{time:.9f}",
                *_numbers(numbers, 9).split(),
                *(values[at] for values in more.values()),
                *_numbers(spread[at][rows, cols], 6).split(),
            ]
        )
    return write_bytes(path, text.getvalue().encode())


def _pose_rows(times: ArrayLike, poses: Pose) -> np.ndarray:
    """time, x, y, z, qx, qy, qz, qw (S, 8) of S poses of space."""
    stamp = torch.as_tensor(times).detach().cpu().double().numpy()
    if stamp.shape != (len(poses),) or not np.isfinite(stamp).all():
        raise InvalidArgumentError(
            f"times has shape {stamp.shape} or holds NaN or infinite values; give one time (s) for each of "
            f"{len(poses)} poses."
        )
    return np.column_stack([stamp, poses.translation, poses.quaternion()])


def _checked(poses: ArrayLike) -> Pose:
    """Poses of space, of S poses in 2D or 3D."""
    given = torch.as_tensor(poses).detach().cpu().double()
    if given.ndim != 3 or given.shape[1:] not in ((3, 3), (4, 4)):
        raise InvalidArgumentError(f"poses has shape {tuple(given.shape)}; expected (S, 3, 3) or (S, 4, 4).")
    if not bool(given.isfinite().all()):
        raise InvalidArgumentError("poses holds NaN or infinite values; drop these poses.")
    return Pose.from_matrix(given).in_space()


def _numbers(row: Sequence[float] | np.ndarray, digits: int) -> str:
    return " ".join(f"{value:.{digits}g}" for value in row)

"""Writes trajectories: poses over time in the text forms of the TUM RGB-D and KITTI odometry benchmarks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.files import write_bytes
from gmmtorch.scan import ArrayLike


def write_tum(path: str | Path, times: ArrayLike, poses: ArrayLike) -> Path:
    """Writes a trajectory atomically, one line per pose: time, x, y, z, and the quaternion qx, qy, qz, qw.

    Args:
        times: (S,), seconds.
        poses: (S, D+1, D+1), world ← sensor, metres. Poses in 2D lie at z = 0.

    Raises `InvalidArgumentError` for other shapes, and for values that are not finite.
    """
    from scipy.spatial.transform import Rotation

    matrices = _in_space(poses)
    stamp = torch.as_tensor(times).detach().cpu().double().numpy()
    if stamp.shape != (len(matrices),) or not np.isfinite(stamp).all():
        raise InvalidArgumentError(
            f"times has shape {stamp.shape} or holds NaN or infinite values; give one time (s) for each of "
            f"{len(matrices)} poses."
        )
    spin = Rotation.from_matrix(matrices[:, :3, :3]).as_quat() if len(matrices) else np.zeros((0, 4))
    rows = np.column_stack([matrices[:, :3, 3], spin])
    lines = [f"{t:.9f} " + _numbers(row, 9) for t, row in zip(stamp, rows, strict=True)]
    text = "\n".join(["# timestamp x y z qx qy qz qw", *lines]) + "\n"
    return write_bytes(path, text.encode())


def write_kitti(path: str | Path, poses: ArrayLike) -> Path:
    """Writes a trajectory atomically, one line per pose: the 12 numbers of world ← sensor, row by row.

    The form has no times. Numbers have 17 digits, which float64 needs to be read back without change.

    Args:
        poses: (S, D+1, D+1), world ← sensor, metres. Poses in 2D lie at z = 0.

    Raises `InvalidArgumentError` for other shapes, and for values that are not finite.
    """
    lines = [_numbers(matrix[:3].ravel(), 17) + "\n" for matrix in _in_space(poses)]
    return write_bytes(path, "".join(lines).encode())


def _in_space(poses: ArrayLike) -> np.ndarray:
    """Poses (S, 4, 4), float64, of poses in 2D or 3D."""
    given = torch.as_tensor(poses).detach().cpu().double().numpy()
    if given.ndim != 3 or given.shape[1:] not in ((3, 3), (4, 4)):
        raise InvalidArgumentError(f"poses has shape {given.shape}; expected (S, 3, 3) or (S, 4, 4).")
    if not np.isfinite(given).all():
        raise InvalidArgumentError("poses holds NaN or infinite values; drop these poses.")
    dim = given.shape[1] - 1
    matrices = np.tile(np.eye(4), (len(given), 1, 1))
    matrices[:, :dim, :dim], matrices[:, :dim, 3] = given[:, :dim, :dim], given[:, :dim, dim]
    return matrices


def _numbers(row: np.ndarray, digits: int) -> str:
    return " ".join(f"{value:.{digits}g}" for value in row)

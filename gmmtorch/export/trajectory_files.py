"""Writes trajectories: poses over time in the text form of the TUM RGB-D benchmark."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.files import write_bytes
from gmmtorch.scan import ArrayLike


def write_tum(path: str | Path, times: ArrayLike, poses: ArrayLike) -> Path:
    """Writes a trajectory atomically, one line a pose: time, x, y, z, and the quaternion qx, qy, qz, qw.

    Args:
        times: (S,), seconds.
        poses: (S, D+1, D+1), world ← sensor, metres. Poses in 2D lie at z = 0.

    Raises `InvalidArgumentError` for other shapes, and for values that are not finite.
    """
    from scipy.spatial.transform import Rotation

    stamp, pose = (torch.as_tensor(value).detach().cpu().double().numpy() for value in (times, poses))
    n = len(stamp)
    if stamp.shape != (n,) or pose.shape not in ((n, 3, 3), (n, 4, 4)):
        raise InvalidArgumentError(
            f"times has shape {stamp.shape} and poses {pose.shape}; expected (S,) and (S, 3, 3) or (S, 4, 4)."
        )
    if not (np.isfinite(stamp).all() and np.isfinite(pose).all()):
        raise InvalidArgumentError("times or poses holds NaN or infinite values; drop these poses.")
    dim = pose.shape[1] - 1
    turn = np.tile(np.eye(3), (n, 1, 1))
    turn[:, :dim, :dim] = pose[:, :dim, :dim]
    place = np.pad(pose[:, :dim, dim], ((0, 0), (0, 3 - dim)))
    spin = Rotation.from_matrix(turn).as_quat() if n else np.zeros((0, 4))
    rows = np.column_stack([place, spin])
    lines = [
        f"{t:.9f} " + " ".join(f"{value:.9g}" for value in row) for t, row in zip(stamp, rows, strict=True)
    ]
    text = "\n".join(["# timestamp x y z qx qy qz qw", *lines]) + "\n"
    return write_bytes(path, text.encode())

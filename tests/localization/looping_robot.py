"""A robot with a laser that drives around a block, comes back, and whose odometry drifts."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gmmtorch.localization import Location, Odometry
from gmmtorch.localization.local_map import Keyframe
from gmmtorch.pose import Pose

N_BEAMS = 180
ANGLES = np.linspace(-np.pi, np.pi, N_BEAMS, endpoint=False)
DRIFT = math.radians(0.25)
"""Error of the heading of each step."""
BACK = 46
"""Scans until the robot is back."""


def _box(x0: float, y0: float, x1: float, y1: float) -> list[list[tuple[float, float]]]:
    corners = [(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)]
    return [list(side) for side in itertools.pairwise(corners)]


_ROOM, _BLOCK = (0, 0, 9, 8), (3, 3, 6, 5)
_PILLARS = [(0, 4.2, 0.6, 4.9), (8.3, 2.2, 9, 3.1), (4.2, 7.4, 5.4, 8), (2, 0, 2.4, 0.5)]
_PILLARS += [(6.2, 0, 6.9, 0.3), (7.9, 6.9, 9, 8)]
WALLS = np.concatenate([_box(*corners) for corners in (_ROOM, _BLOCK, *_PILLARS)])
"""Ends (W, 2, 2) of the walls of a corridor around a block, metres."""


def path(n: int) -> np.ndarray:
    """Poses (n, 3, 3), world ← sensor: along the corridor, half a metre or 30° a step, as often as needed."""
    corners = [(7.5, 1.5), (7.5, 6.5), (1.5, 6.5), (1.5, 1.5)]
    x, y, yaw, corner, poses = 2.5, 1.5, 0.0, 0, []
    while len(poses) < n:
        cos, sin = np.cos(yaw), np.sin(yaw)
        poses.append([[cos, -sin, x], [sin, cos, y], [0.0, 0.0, 1.0]])
        gap = np.hypot(corners[corner % 4][0] - x, corners[corner % 4][1] - y)
        if gap > 1e-6:
            x, y = x + min(0.5, gap) * cos, y + min(0.5, gap) * sin
            continue
        yaw += np.pi / 6
        corner += abs(yaw - (corner + 1) * np.pi / 2) < 1e-6
    return np.array(poses)


def ranges(pose: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Ranges (N,) of the laser at a pose (3, 3), with noise (N,), metres."""
    directions = (np.stack([np.cos(ANGLES), np.sin(ANGLES)], 1) @ pose[:2, :2].T)[:, None]
    along, off = WALLS[:, 1] - WALLS[:, 0], WALLS[:, 0] - pose[:2, 2]
    cross = directions[..., 0] * along[:, 1] - directions[..., 1] * along[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (off[:, 0] * along[:, 1] - off[:, 1] * along[:, 0]) / cross
        share = (off[:, 0] * directions[..., 1] - off[:, 1] * directions[..., 0]) / cross
    return np.where((distance > 0) & (share >= 0) & (share <= 1), distance, np.inf).min(1) + noise


def lap(n: int) -> tuple[list[dict[str, Any]], Tensor]:
    """Messages of n scans, and the true poses (n, 3, 3) in the frame of the first one."""
    rng, poses, messages = np.random.default_rng(0), path(n), []
    about = {"range_min": 0.0, "range_max": 20.0, "angle_min": -np.pi, "angle_increment": 2 * np.pi / N_BEAMS}
    for number, pose in enumerate(poses):
        stamp = {"sec": number // 5, "nanosec": number % 5 * 200_000_000}
        measured = ranges(pose, rng.normal(scale=0.005, size=N_BEAMS)).astype(np.float32)
        header = {"frame_id": "laser", "stamp": stamp}
        messages.append({"header": header, **about, "time_increment": 0.0, "ranges": measured})
    return messages, torch.from_numpy(np.linalg.inv(poses[0]) @ poses)


def off_the_walls(means: Tensor) -> Tensor:
    """Distances (K,) of points (K, 2), in the frame of the first pose, from the nearest wall, metres."""
    first = path(1)[0]
    at = (means.numpy() @ first[:2, :2].T + first[:2, 2])[:, None]
    along, off = WALLS[:, 1] - WALLS[:, 0], at - WALLS[:, 0]
    share = np.clip((off * along).sum(2) / (along**2).sum(1), 0, 1)
    return torch.from_numpy(np.linalg.norm(off - share[..., None] * along, axis=2).min(1))


class DriftingOdometry(Odometry):
    """Odometry whose steps are the true ones, with a turn too much in each. It closes loops as usual.

    true: poses (N, 3, 3) of the scans.
    """

    def __init__(self, true: Tensor) -> None:
        super().__init__()
        self._true = true

    def _located(self, scan: Keyframe, *_: Any) -> Location:
        number = len(self._poses)
        before, now = (Pose.from_matrix(self._true[row]) for row in (number - 1, number))
        step = before.inverse() @ now @ Pose.from_yaw(DRIFT, [0.0, 0.0])
        covariance = torch.diag(torch.tensor([0.02, 0.02, 0.01]).double().square())
        return Location((self._poses[-1] @ step).matrix, covariance, 1.0, ())

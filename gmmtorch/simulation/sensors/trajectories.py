"""Paths through waypoints, and the poses of a sensor that travels along them."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError

_CUTTINGS = 5
_TANGENT_STEP = 0.05


def smooth_path(waypoints: Tensor, spacing: float = 0.05) -> Tensor:
    """A path (P, 2) without kinks along waypoints (W, 2), points `spacing` metres apart.

    Cutting the corners again and again (Chaikin) converges to a quadratic B-spline: it never leaves
    the triangles at the corners, so it does not overshoot into a wall as interpolation would, and it
    runs straight where three waypoints lie on a line, as they should at a door.
    """
    if waypoints.ndim != 2 or waypoints.shape[0] < 2 or waypoints.shape[1] != 2:
        raise InvalidArgumentError(
            f"waypoints has shape {tuple(waypoints.shape)}; expected (W, 2) with W of 2 or more."
        )
    if not spacing > 0:
        raise InvalidArgumentError(f"spacing={spacing} must be above zero metres.")
    path = waypoints.double()
    for _ in range(_CUTTINGS):
        a, b = path[:-1], path[1:]
        cut = torch.stack([0.75 * a + 0.25 * b, 0.25 * a + 0.75 * b], 1).flatten(0, 1)
        path = torch.cat([path[:1], cut[1:-1], path[-1:]])
    length = float(_arc_length(path)[-1])
    return _at(path, torch.linspace(0, length, max(2, math.ceil(length / spacing) + 1), dtype=path.dtype))


def poses_2d(path: Tensor, n: int) -> Tensor:
    """`n` poses (n, 3, 3) world ← sensor, evenly spaced along the path (P, 2), looking ahead."""
    where, heading = _stations(path, n)
    pose = torch.eye(3, dtype=torch.float64).repeat(n, 1, 1)
    pose[:, :2, :2] = _turn(heading)
    pose[:, :2, 2] = where
    return pose


def poses_3d(path: Tensor, n: int, height: float, pitch: float = 0.0, swing: float = 0.0) -> Tensor:
    """`n` poses (n, 4, 4) world ← sensor, evenly spaced along the path (P, 2) `height` metres up.

    The sensor looks ahead, `pitch` radians below the horizon, and turns its head up to `swing` radians
    to the left and right, once in about seven poses.
    """
    where, heading = _stations(path, n)
    heading = heading + swing * torch.sin(torch.arange(n, dtype=torch.float64) * 0.9)
    yaw = torch.eye(3, dtype=torch.float64).repeat(n, 1, 1)
    yaw[:, :2, :2] = _turn(heading)
    nod = torch.tensor(
        [[math.cos(pitch), 0, math.sin(pitch)], [0, 1, 0], [-math.sin(pitch), 0, math.cos(pitch)]],
        dtype=torch.float64,
    )
    pose = torch.eye(4, dtype=torch.float64).repeat(n, 1, 1)
    pose[:, :3, :3] = yaw @ nod
    pose[:, :2, 3] = where
    pose[:, 2, 3] = height
    return pose


def _stations(path: Tensor, n: int) -> tuple[Tensor, Tensor]:
    """Positions (n, 2) and headings (n,) in radians, evenly spaced along the path."""
    if n < 1:
        raise InvalidArgumentError(f"n={n} must be at least 1 pose.")
    length = float(_arc_length(path)[-1])
    s = torch.linspace(0, length, n, dtype=path.dtype)
    ahead = _at(path, (s + _TANGENT_STEP).clamp_max(length))
    behind = _at(path, (s - _TANGENT_STEP).clamp_min(0))
    tangent = ahead - behind
    return _at(path, s), torch.atan2(tangent[:, 1], tangent[:, 0])


def _turn(angle: Tensor) -> Tensor:
    """Rotations (n, 2, 2)."""
    cos, sin = angle.cos(), angle.sin()
    return torch.stack([torch.stack([cos, -sin], -1), torch.stack([sin, cos], -1)], -2)


def _arc_length(path: Tensor) -> Tensor:
    steps = (path[1:] - path[:-1]).norm(dim=1)
    return torch.cat([steps.new_zeros(1), steps.cumsum(0)])


def _at(path: Tensor, s: Tensor) -> Tensor:
    """Points (n, 2) at the arc lengths s (n,) in metres."""
    length = _arc_length(path)
    i = torch.searchsorted(length, s.contiguous(), right=True).clamp(1, path.shape[0] - 1)
    step = (length[i] - length[i - 1]).clamp_min(1e-12)
    share = ((s - length[i - 1]) / step).clamp(0, 1)[:, None]
    return path[i - 1] * (1 - share) + path[i] * share

"""Smooth paths through waypoints, and sensor poses along a path."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike, as_tensor
from gmmtorch.errors import InvalidArgumentError

_CORNER_CUTS = 5
_TANGENT_STEP = 0.05


def smooth_path(waypoints: ArrayLike, spacing: float = 0.05) -> Tensor:
    """A smooth path (P, 2) along waypoints (W, 2), with a point every `spacing` metres.

    Repeated corner cutting (Chaikin) converges to a quadratic B-spline. The path stays inside the
    triangles at the corners, so it cannot overshoot into a wall. It is straight where three waypoints lie
    on a line: place them so at doors.
    """
    waypoints = as_tensor(waypoints, "waypoints", torch.float64)
    if waypoints.ndim != 2 or waypoints.shape[0] < 2 or waypoints.shape[1] != 2:
        raise InvalidArgumentError(
            f"waypoints has shape {tuple(waypoints.shape)}; expected (W, 2) with W of 2 or more."
        )
    if not spacing > 0:
        raise InvalidArgumentError(f"spacing={spacing} must be above zero metres.")
    path = waypoints
    for _ in range(_CORNER_CUTS):
        a, b = path[:-1], path[1:]
        cut = torch.stack([0.75 * a + 0.25 * b, 0.25 * a + 0.75 * b], 1).flatten(0, 1)
        path = torch.cat([path[:1], cut[1:-1], path[-1:]])
    length = float(_arc_length(path)[-1])
    return _point_at(
        path, torch.linspace(0, length, max(2, math.ceil(length / spacing) + 1), dtype=path.dtype)
    )


def poses_2d(path: ArrayLike, n: int) -> Tensor:
    """`n` poses (n, 3, 3), world ← sensor, evenly spaced along the path (P, 2) and facing forward."""
    position, heading = _stations(path, n)
    pose = torch.eye(3, dtype=torch.float64).repeat(n, 1, 1)
    pose[:, :2, :2] = _rotation_2d(heading)
    pose[:, :2, 2] = position
    return pose


def poses_3d(path: ArrayLike, n: int, height: float, pitch: float = 0.0, swing: float = 0.0) -> Tensor:
    """`n` poses (n, 4, 4), world ← sensor, evenly spaced along the path (P, 2) at `height` metres.

    The sensor faces forward, `pitch` radians below the horizon. Its yaw swings up to `swing` radians to
    the left and right of the path, with a period of about seven poses.
    """
    position, heading = _stations(path, n)
    heading = heading + swing * torch.sin(torch.arange(n, dtype=torch.float64) * 0.9)
    yaw = torch.eye(3, dtype=torch.float64).repeat(n, 1, 1)
    yaw[:, :2, :2] = _rotation_2d(heading)
    tilt = torch.tensor(
        [[math.cos(pitch), 0, math.sin(pitch)], [0, 1, 0], [-math.sin(pitch), 0, math.cos(pitch)]],
        dtype=torch.float64,
    )
    pose = torch.eye(4, dtype=torch.float64).repeat(n, 1, 1)
    pose[:, :3, :3] = yaw @ tilt
    pose[:, :2, 3] = position
    pose[:, 2, 3] = height
    return pose


def _stations(given: ArrayLike, n: int) -> tuple[Tensor, Tensor]:
    """Positions (n, 2) and headings (n,) in radians, evenly spaced along the path."""
    if n < 1:
        raise InvalidArgumentError(f"n={n} must be at least 1 pose.")
    path = as_tensor(given, "path", torch.float64)
    length = float(_arc_length(path)[-1])
    s = torch.linspace(0, length, n, dtype=path.dtype)
    ahead = _point_at(path, (s + _TANGENT_STEP).clamp_max(length))
    behind = _point_at(path, (s - _TANGENT_STEP).clamp_min(0))
    tangent = ahead - behind
    return _point_at(path, s), torch.atan2(tangent[:, 1], tangent[:, 0])


def _rotation_2d(angle: Tensor) -> Tensor:
    """Rotation matrices (n, 2, 2) of angles (n,) in radians."""
    cos, sin = angle.cos(), angle.sin()
    return torch.stack([torch.stack([cos, -sin], -1), torch.stack([sin, cos], -1)], -2)


def _arc_length(path: Tensor) -> Tensor:
    steps = (path[1:] - path[:-1]).norm(dim=1)
    return torch.cat([steps.new_zeros(1), steps.cumsum(0)])


def _point_at(path: Tensor, s: Tensor) -> Tensor:
    """Points (n, 2) of the path at the arc lengths s (n,) in metres."""
    length = _arc_length(path)
    i = torch.searchsorted(length, s.contiguous(), right=True).clamp(1, path.shape[0] - 1)
    step = (length[i] - length[i - 1]).clamp_min(1e-12)
    share = ((s - length[i - 1]) / step).clamp(0, 1)[:, None]
    return path[i - 1] * (1 - share) + path[i] * share

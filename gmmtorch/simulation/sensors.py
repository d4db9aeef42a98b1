"""Range sensors (beam directions, noise and dropout), and the smooth paths along which they move.

Sensor frame: x forward, y left, z up, for cameras too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike, as_tensor
from gmmtorch.errors import InvalidArgumentError, check_number, check_whole
from gmmtorch.pose import Pose
from gmmtorch.scan import Scan
from gmmtorch.simulation.camera_options import CLOSEST_READING, check_dropout

_CORNER_CUTS = 5
_TANGENT_STEP = 0.05


class World(Protocol):
    """A world that sensors can observe."""

    def distances(self, origin: Tensor, directions: Tensor) -> Tensor:
        """Range (N,) in metres from the origin (D,) along unit directions (N, D); inf without a hit."""


@dataclass(frozen=True, eq=False)
class RangeSensor:
    """The beams of a sensor and their errors.

    Attributes:
        directions: (B, D) unit vectors in the sensor frame.
        max_range: surfaces at this distance (m) or beyond give no return.
        range_noise: standard deviation (m) of a reading, along the beam.
        dropout: share of the beams without any reading. A dropped beam shows neither a surface nor free
            space.
    """

    directions: Tensor
    max_range: float
    range_noise: float = 0.01
    dropout: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "directions", as_tensor(self.directions, "directions", torch.float64))
        check_number("max_range", self.max_range, above=True)
        check_number("range_noise", self.range_noise)
        check_dropout("beams", self.dropout)


def laser_2d(
    n_beams: int = 180,
    field_of_view: float = math.pi,
    max_range: float = 12.0,
    range_noise: float = 0.01,
    dropout: float = 0.0,
) -> RangeSensor:
    """A planar laser: `n_beams` beams spread evenly over `field_of_view` radians, from right to left."""
    check_whole("n_beams", n_beams, 1)
    check_number("field_of_view", field_of_view, 2 * math.pi, above=True)
    angles = (torch.arange(n_beams, dtype=torch.float64) + 0.5) / n_beams * field_of_view - field_of_view / 2
    return RangeSensor(torch.stack([angles.cos(), angles.sin()], 1), max_range, range_noise, dropout)


def spinning_lidar(
    n_rings: int = 32,
    n_azimuths: int = 160,
    elevations: tuple[float, float] = (-math.radians(28), math.radians(28)),
    max_range: float = 10.0,
    range_noise: float = 0.01,
    dropout: float = 0.0,
) -> RangeSensor:
    """A lidar of `n_rings` × `n_azimuths` beams, ring by ring from the lower to the upper elevation (rad)."""
    check_whole("n_rings", n_rings, 1)
    check_whole("n_azimuths", n_azimuths, 1)
    elevation = torch.linspace(*elevations, n_rings, dtype=torch.float64)[:, None]
    azimuth = torch.arange(n_azimuths, dtype=torch.float64) * (2 * math.pi / n_azimuths)
    level, up = elevation.cos(), elevation.sin().expand(n_rings, n_azimuths)
    directions = torch.stack([level * azimuth.cos(), level * azimuth.sin(), up], -1)
    return RangeSensor(directions.flatten(0, 1), max_range, range_noise, dropout)


def depth_camera(
    width: int = 80,
    height: int = 64,
    field_of_view: float = math.radians(75),
    max_range: float = 10.0,
    range_noise: float = 0.01,
    dropout: float = 0.0,
) -> RangeSensor:
    """A pinhole camera of `width` × `height` square pixels, row by row from the top left.

    `field_of_view` is the horizontal angle (rad) between the left and right edges of the image.
    """
    check_whole("width", width, 1)
    check_whole("height", height, 1)
    check_number("field_of_view", field_of_view, math.radians(179), above=True)
    focal = width / 2 / math.tan(field_of_view / 2)
    return RangeSensor(pixel_rays(width, height, (focal, focal)), max_range, range_noise, dropout)


def pixel_rays(width: int, height: int, focal: tuple[float, float]) -> Tensor:
    """Unit vectors (height · width, 3) through the pixel centres of a pinhole camera.

    Pixels are in row-major order from the top left. `focal` is the focal length in pixel widths and heights.
    """
    left = (width / 2 - 0.5 - torch.arange(width, dtype=torch.float64)) / focal[0]
    up = (height / 2 - 0.5 - torch.arange(height, dtype=torch.float64)) / focal[1]
    z, y = torch.meshgrid(up, left, indexing="ij")
    return torch.nn.functional.normalize(torch.stack([torch.ones_like(y), y, z], -1).flatten(0, 1), dim=1)


def sense(
    sensor: RangeSensor, pose: ArrayLike, world: World, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Beam ends (N, D) in the world frame, and whether each beam (N,) had no return.

    The pose (D+1, D+1) is world ← sensor. A beam without return ends at the sensor's maximum range. Dropped
    beams are absent. The number of random draws does not depend on the world.
    """
    place = Pose.from_matrix(pose)
    origin, directions = place.translation, sensor.directions @ place.rotation.T
    n_beams = directions.shape[0]
    noise = torch.randn(n_beams, generator=generator, dtype=torch.float64) * sensor.range_noise
    kept = torch.rand(n_beams, generator=generator, dtype=torch.float64) >= sensor.dropout
    truth = world.distances(origin, directions)
    reading = (truth + noise).clamp_min(CLOSEST_READING)
    no_return = (truth >= sensor.max_range) | (reading >= sensor.max_range)
    reading = torch.where(no_return, sensor.max_range, reading)
    return (origin + directions * reading[:, None])[kept], no_return[kept]


def simulate_scan(sensor: RangeSensor, pose: ArrayLike, world: World, generator: torch.Generator) -> Scan:
    """The scan at a pose (D+1, D+1), world ← sensor. Beams without return end at the maximum range."""
    ends, no_return = sense(sensor, pose, world, generator)
    return Scan(ends[~no_return], Pose.from_matrix(pose).translation, ends[no_return])


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
    n_points = max(2, math.ceil(length / spacing) + 1)
    return _point_at(path, torch.linspace(0, length, n_points, dtype=path.dtype))


def poses_2d(path: ArrayLike, n: int) -> Tensor:
    """`n` poses (n, 3, 3), world ← sensor, evenly spaced along the path (P, 2) and facing forward."""
    position, heading = _stations(path, n)
    return Pose.from_yaw(heading, position).matrix


def poses_3d(path: ArrayLike, n: int, height: float, pitch: float = 0.0, swing: float = 0.0) -> Tensor:
    """`n` poses (n, 4, 4), world ← sensor, evenly spaced along the path (P, 2) at `height` metres.

    The sensor faces forward, `pitch` radians below the horizon. Its yaw swings up to `swing` radians to
    the left and right of the path, with a period of about seven poses.
    """
    position, heading = _stations(path, n)
    heading = heading + swing * torch.sin(torch.arange(n, dtype=torch.float64) * 0.9)
    upright = Pose.from_yaw(heading, torch.nn.functional.pad(position, (0, 1), value=height))
    return (upright @ Pose.from_turn(torch.tensor([0.0, pitch, 0.0], dtype=torch.float64))).matrix


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

"""Range sensors: beam directions, noise and dropout.

Sensor frame: x forward, y left, z up, for cameras too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike, as_tensor
from gmmtorch.errors import InvalidArgumentError, check_whole
from gmmtorch.scan import Scan

_CLOSEST_READING = 1e-3


class World(Protocol):
    """A world that sensors can observe."""

    def distances(self, origin: Tensor, directions: Tensor) -> Tensor:
        """Range (N,) in metres from the origin (D,) along unit directions (N, D); inf without a hit."""
        ...


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
        if not (math.isfinite(self.max_range) and self.max_range > 0):
            raise InvalidArgumentError(f"max_range={self.max_range} must be a distance above zero metres.")
        if not (math.isfinite(self.range_noise) and self.range_noise >= 0):
            raise InvalidArgumentError(f"range_noise={self.range_noise} must be zero metres or more.")
        if not 0 <= self.dropout < 1:
            raise InvalidArgumentError(f"dropout={self.dropout} must be a share of the beams in [0, 1).")


def laser_2d(
    n_beams: int = 180,
    field_of_view: float = math.pi,
    max_range: float = 12.0,
    range_noise: float = 0.01,
    dropout: float = 0.0,
) -> RangeSensor:
    """A planar laser: `n_beams` beams spread evenly over `field_of_view` radians, from right to left."""
    check_whole("n_beams", n_beams, 1)
    _check_field_of_view(field_of_view, 2 * math.pi)
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
    directions = torch.stack(
        [
            elevation.cos() * azimuth.cos(),
            elevation.cos() * azimuth.sin(),
            elevation.sin().expand(n_rings, n_azimuths),
        ],
        -1,
    )
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
    _check_field_of_view(field_of_view, math.radians(179))
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
    matrix = as_tensor(pose, "pose", torch.float64)
    origin, directions = matrix[:-1, -1], sensor.directions @ matrix[:-1, :-1].T
    n_beams = directions.shape[0]
    noise = torch.randn(n_beams, generator=generator, dtype=torch.float64) * sensor.range_noise
    kept = torch.rand(n_beams, generator=generator, dtype=torch.float64) >= sensor.dropout
    truth = world.distances(origin, directions)
    reading = (truth + noise).clamp_min(_CLOSEST_READING)
    no_return = (truth >= sensor.max_range) | (reading >= sensor.max_range)
    reading = torch.where(no_return, sensor.max_range, reading)
    return (origin + directions * reading[:, None])[kept], no_return[kept]


def simulate_scan(sensor: RangeSensor, pose: ArrayLike, world: World, generator: torch.Generator) -> Scan:
    """The scan at a pose (D+1, D+1), world ← sensor. Beams without return end at the maximum range."""
    ends, no_return = sense(sensor, pose, world, generator)
    return Scan(ends[~no_return], as_tensor(pose, "pose", torch.float64)[:-1, -1], ends[no_return])


def _check_field_of_view(field_of_view: float, limit: float) -> None:
    if not 0 < field_of_view <= limit:
        raise InvalidArgumentError(
            f"field_of_view={field_of_view} must be an angle above 0 and at most {limit:.4g} radians."
        )

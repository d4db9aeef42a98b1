"""Sensor models: the error of a range reading, and the density of points on a surface.

A reading has an error along its beam, from the sensor's own noise, and across it, from the noise of the
beam's direction. A beam also has a width: on a surface at incidence θ (0 is head-on), a footprint with
standard deviation f covers depths of f tan θ, and the reading is somewhere among them:

    σ_along² = σ(r)² + (f tan θ)²        R = σ_across² I + (σ_along² − σ_across²) u uᵀ

with u the unit vector of the beam and r the range. A slanted surface also receives fewer beams: the
expected density is proportional to cos θ.

Scans do not contain all quantities, so two approximations are made: a camera's depth is used as the
range (which is 15 % larger at 30° off the axis), and a lidar's beams are equally dense at every elevation.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gmmtorch.arrays import ArrayLike, as_tensor
from gmmtorch.errors import InvalidArgumentError, check_number, check_whole

_CLOSEST = 1e-3
"""Metres. Nearer readings are treated as at this range, so that noise and density stay finite."""

_CHUNK_POINTS = 1 << 15
_SPACING_NEIGHBORS = 32  # more than the beams of one ring that are nearer than the next ring
_SPACING_BEAMS = 1_000  # of a scan, for which the spacing is measured


class Deviations(NamedTuple):
    """Standard deviations (m) of readings: along the beam, across it, and of its footprint."""

    along: Tensor
    across: Tensor
    footprint: Tensor


@dataclass(frozen=True)
class SensorModel(ABC):
    """The sensor properties that fitting and pruning use.

    max_incidence: radians. A surface at a larger incidence is treated as at this angle. It limits f tan θ
        from above and the density from below: an observed surface is not exactly edge-on.
    """

    max_incidence: float = math.radians(80)

    def __post_init__(self) -> None:
        if not 0 <= self.max_incidence < math.pi / 2:
            raise InvalidArgumentError(
                f"max_incidence={self.max_incidence} must be an angle from 0 to below π/2 radians."
            )
        for name, value in vars(self).items():
            if name not in ("max_incidence", "axial"):
                check_number(name, value, above=name != "proportional_noise")

    @abstractmethod
    def deviations(self, distance: ArrayLike) -> Deviations:
        """The deviations at ranges (m) of any shape, at incidence 0."""

    @abstractmethod
    def _density(self, distance: Tensor) -> Tensor:
        """Points per m² (or per metre) of a surface that faces the sensor."""

    def noise_covariances(
        self, points: ArrayLike, origin: ArrayLike, normals: ArrayLike | None = None
    ) -> Tensor:
        """Covariances (N, D, D), m², positive definite, of the errors of readings (N, D), world frame.

        origin: (D,) or (N, D) sensor origins. normals: (N, D) unit normals of the surfaces, of either sign;
        None: incidence 0.
        """
        points = as_tensor(points, "points", torch.float64)
        origin = as_tensor(origin, "origin", torch.float64, points.device)
        beam, distance = beams(points, origin)
        along, across, footprint = self.deviations(distance)
        if normals is not None:
            normals = as_tensor(normals, "normals", torch.float64, points.device)
            cos = self._cosine(cos_incidence(points, origin, normals))
            along = torch.hypot(along, footprint * (1 - cos**2).sqrt() / cos)
        eye = torch.eye(points.shape[1], dtype=points.dtype, device=points.device)
        outer = beam[:, :, None] * beam[:, None, :]
        return across[:, None, None] ** 2 * (eye - outer) + along[:, None, None] ** 2 * outer

    def point_density(self, distance: ArrayLike, cos_incidence: ArrayLike | float = 1.0) -> Tensor:
        """Expected points of one scan on a surface at range `distance` (m), per m² (per metre in 2D)."""
        distance = _ranges(distance)
        cos = as_tensor(cos_incidence, "cos_incidence", distance.dtype, distance.device)
        return self._cosine(cos) * self._density(distance)

    def _cosine(self, cos: Tensor) -> Tensor:
        return cos.abs().clamp(math.cos(self.max_incidence), 1)


@dataclass(frozen=True)
class DepthCameraModel(SensorModel):
    """A structured-light or stereo camera: σ(z) = a + b z + c z², because it measures disparity.

    The defaults are those of a Kinect: axial noise 1.2 mm + 1.9 mm (z − 0.4)², lateral noise 0.8 pixels
    (Nguyen, Izadi & Lovell, 2012). Khoshelham & Elberink (2012) give 1.4 mm z² for the same camera.

    axial: (a, b, c) in m, 1, 1/m. lateral: pixels. pixel_angle: radians between neighbouring pixels.
    """

    axial: tuple[float, float, float] = (0.001504, -0.00152, 0.0019)
    lateral: float = 0.8
    pixel_angle: float = 1 / 585

    def __post_init__(self) -> None:
        super().__post_init__()
        a, b, c = self.axial
        # Positive at every range: at 0, at infinity, and at the minimum if that is between them.
        if not (a > 0 and c >= 0 and b > -2 * math.sqrt(a * c) and all(map(math.isfinite, self.axial))):
            raise InvalidArgumentError(f"axial={self.axial} must give noise above zero at every range.")

    def deviations(self, distance: ArrayLike) -> Deviations:
        a, b, c = self.axial
        z = _ranges(distance)
        pixel = z * self.pixel_angle
        # The footprint is uniform within the pixel.
        return Deviations(a + b * z + c * z**2, pixel * self.lateral, pixel / math.sqrt(12))

    def _density(self, distance: Tensor) -> Tensor:
        return 1 / (distance * self.pixel_angle) ** 2


@dataclass(frozen=True)
class LidarModel(SensorModel):
    """A spinning or solid-state lidar: constant and proportional range noise, and a beam that widens.

    The defaults are those of a 16-ring spinning lidar's data sheet, except for the noise, which in
    practice is below the stated accuracy of 3 cm. On incidence see Soudarissanane et al. (2011).

    noise: m. proportional_noise: m per m of range. divergence: full angle (rad) of the beam, which is
    four standard deviations. azimuth_step, elevation_step: radians between beams.
    """

    noise: float = 0.015
    proportional_noise: float = 0.0
    divergence: float = 0.003
    azimuth_step: float = math.radians(0.2)
    elevation_step: float = math.radians(2.0)

    def deviations(self, distance: ArrayLike) -> Deviations:
        return _laser(distance, self.noise, self.proportional_noise, self.divergence)

    def _density(self, distance: Tensor) -> Tensor:
        return 1 / (distance**2 * self.azimuth_step * self.elevation_step)


@dataclass(frozen=True)
class LaserModel(SensorModel):
    """A laser that sweeps a plane: `LidarModel` in 2D.

    The defaults are those of common indoor scanners of the 2000s: 1 cm, beams of 0.25°, 1° apart.
    """

    noise: float = 0.01
    proportional_noise: float = 0.0
    divergence: float = math.radians(0.25)
    angular_step: float = math.radians(1.0)

    def deviations(self, distance: ArrayLike) -> Deviations:
        return _laser(distance, self.noise, self.proportional_noise, self.divergence)

    def _density(self, distance: Tensor) -> Tensor:
        return 1 / (distance * self.angular_step)


def beams(points: Tensor, origin: Tensor) -> tuple[Tensor, Tensor]:
    """Unit vectors (N, D) from the origin (D,) or (N, D) to the points, and their distances (N,).

    A point at the origin has no direction; it gets the first axis.
    """
    offset = points - origin
    distance = offset.norm(dim=1)
    beam = offset / distance.clamp_min(1e-300)[:, None]
    first = torch.zeros_like(beam)
    first[:, 0] = 1
    return torch.where(distance[:, None] > 0, beam, first), distance


def cos_incidence(points: Tensor, origin: Tensor, normals: Tensor) -> Tensor:
    """|cos| (N,) of the angles between the beams from the origin and the surfaces' unit normals (N, D)."""
    return (beams(points, origin)[0] * normals.to(points)).sum(1).abs()


def estimate_normals(points: ArrayLike, n_neighbors: int = 16) -> Tensor:
    """Unit normals (N, D), float64, of either sign: directions of least variance of each point's neighbours.

    Points (N, D) with N ≥ 1. If the neighbours do not span a surface (a single lidar ring, or too few
    points), the normal is one of the directions that they do not span; use more neighbours there.
    """
    check_whole("n_neighbors", n_neighbors, 1)
    points = as_tensor(points, "points", torch.float64)
    cloud = (points - points.mean(0)).cpu()
    array = cloud.numpy()
    nearest = cKDTree(array).query(array, k=np.arange(1, min(n_neighbors, len(array)) + 1))[1]
    normals = []
    for part in torch.from_numpy(nearest).split(_CHUNK_POINTS):
        patch = cloud[part]
        patch = patch - patch.mean(1, keepdim=True)
        normals.append(torch.linalg.eigh(patch.transpose(1, 2) @ patch)[1][:, :, 0])
    return torch.cat(normals).to(points.device)


def measured_sensor(points: ArrayLike, origin: ArrayLike) -> LaserModel | LidarModel:
    """A sensor with the spacing of the beams of one scan: points (N, D), D = 2 or 3, and its origin (D,).

    The spacing is the median over the beams: in 2D of the angles between neighbours, in 3D of the solid
    angles per beam, π α²/n with α the angle to the n-th neighbour. Other properties are the defaults, and so
    is the spacing if there are fewer than two directions.
    """
    points = as_tensor(points, "points", torch.float64).cpu()
    direction, _ = beams(points, as_tensor(origin, "origin", torch.float64).cpu())
    if points.shape[1] == 2:
        gap = torch.atan2(direction[:, 1], direction[:, 0]).sort().values.diff()
        gap = gap[gap > 0]
        return LaserModel(angular_step=float(gap.median())) if len(gap) else LaserModel()
    n = min(_SPACING_NEIGHBORS, len(points) - 1)
    if n < 1:
        return LidarModel()
    asked = direction[:: max(1, len(points) // _SPACING_BEAMS)].numpy()
    apart = np.median(cKDTree(direction.numpy()).query(asked, k=[n + 1])[0])
    step = float(apart) * math.sqrt(math.pi / n)
    return LidarModel(azimuth_step=step, elevation_step=step) if step > 0 else LidarModel()


def _laser(distance: ArrayLike, noise: float, proportional: float, divergence: float) -> Deviations:
    ranges = _ranges(distance)
    width = ranges * divergence / 4
    return Deviations(noise + proportional * ranges, width, width)


def _ranges(distance: ArrayLike) -> Tensor:
    """Ranges (m) of any shape, at least `_CLOSEST`."""
    return as_tensor(distance, "distance").clamp_min(_CLOSEST)

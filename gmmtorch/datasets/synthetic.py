"""Data sets of simulated scans, computed when they are accessed: in buildings without a file, or of a mesh.

A scan depends only on the world, the seed and its index, not on the order of reading.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from gmmtorch.datasets.base import Dataset, Ranges, require_path
from gmmtorch.datasets.point_files.mesh_files import read_triangles
from gmmtorch.errors import DataError, InvalidArgumentError, check_choice, check_number, check_whole
from gmmtorch.pose import Pose
from gmmtorch.scan import Scan
from gmmtorch.simulation import (
    MeshWorld,
    RangeSensor,
    World,
    building_2d,
    building_3d,
    depth_camera,
    laser_2d,
    poses_2d,
    poses_3d,
    sense,
    spinning_lidar,
)

_MAX_RANGE_2D, _MAX_RANGE_3D, _MAX_RANGE_MESH = 12.0, 10.0, 30.0  # metres
_SEEDS_APART = 1_000_003
"""Difference between the generator seeds of consecutive data set seeds; larger than any number of scans."""
_MOST_SEEDS = 2**40  # so that the seeds of generators have 63 bits

_LIDAR_HEIGHT = 1.2
_CAMERA_HEIGHT = 1.4
_CAMERA_PITCH = math.radians(8)
_CAMERA_SWING = math.radians(60)


class Simulated(Dataset):
    """Scans along the path of a simulated world.

    Beams without a surface within the sensor's maximum range, or within `max_range` if that is shorter,
    have no return. No beam is invalid.

    Args:
        make: the world, the sensor, and its poses, drawn with a generator.
    """

    def __init__(
        self,
        name: str,
        ranges: Ranges,
        stride: int,
        seed: int,
        n_scans: int,
        make: Callable[[torch.Generator], tuple[World, RangeSensor, Tensor]],
    ) -> None:
        self.seed = check_whole("seed", seed, 0)
        self.n_scans = check_whole("n_scans", n_scans, 1)
        if seed >= _MOST_SEEDS or n_scans >= _SEEDS_APART:
            raise InvalidArgumentError(
                f"seed={seed} and n_scans={n_scans} must be below {_MOST_SEEDS} and {_SEEDS_APART}."
            )
        super().__init__(name, ranges, stride)
        self.world, self.sensor, self.poses = make(self._generator(0))
        self._poses = self.poses

    def _generator(self, number: int) -> torch.Generator:
        """Random number generator of the world (0) or of scan `number` − 1."""
        return torch.Generator().manual_seed(self.seed * _SEEDS_APART + number)

    def _count(self) -> int:
        return self.n_scans

    def _read(self, index: int) -> Scan:
        pose = self.poses[index]
        ends, no_return = sense(self.sensor, pose, self.world, self._generator(1 + index))
        return self.ranges.scan(ends, pose[:-1, -1], no_return)


def synthetic_building_2d(ranges: Ranges, stride: int = 1, seed: int = 0, n_scans: int = 120) -> Simulated:
    """A laser (180 beams over 180°, range 12 m, noise 1 cm) on a path through an office of 30 × 20 m."""

    def make(generator: torch.Generator) -> tuple[World, RangeSensor, Tensor]:
        world = building_2d(generator)
        return world, laser_2d(max_range=_MAX_RANGE_2D), poses_2d(world.path, n_scans)

    return Simulated("synthetic_building_2d", ranges, stride, seed, n_scans, make)


def synthetic_building(
    ranges: Ranges, stride: int = 1, seed: int = 0, n_scans: int = 40, sensor: str = "lidar"
) -> Simulated:
    """A lidar (32 × 160 beams) or depth camera (80 × 64 pixels) in a furnished hall; 10 m, noise 1 cm."""

    def make(generator: torch.Generator) -> tuple[World, RangeSensor, Tensor]:
        device, world = _sensor_3d(sensor, _MAX_RANGE_3D), building_3d(generator)
        mount = (_LIDAR_HEIGHT,) if sensor == "lidar" else (_CAMERA_HEIGHT, _CAMERA_PITCH, _CAMERA_SWING)
        return world, device, poses_3d(world.path, n_scans, *mount)

    return Simulated("synthetic_building", ranges, stride, seed, n_scans, make)


def mesh_scans(
    path: str | Path,
    ranges: Ranges,
    stride: int = 1,
    n_scans: int = 100,
    sensor: str = "lidar",
    seed: int = 0,
) -> Simulated:
    """`n_scans` scans of a lidar (32 × 160 beams) or a depth camera (80 × 64 pixels), range 30 m, noise 1 cm.

    The sensor moves through the largest connected part of the mesh (PLY, OBJ or STL; metres, z up), 1.2 m
    above the floor (see `MeshWorld.tour`); a camera faces forward. Scans are about 2 m apart, and parts of
    the mesh beyond the last one are not observed. Scan i depends only on the mesh, the seed, the number of
    scans and i.
    """
    file = require_path(path, "file", "a triangle mesh (PLY, OBJ, STL)", "Units are metres, z is up.")

    def make(_: torch.Generator) -> tuple[World, RangeSensor, Tensor]:
        device, world = _sensor_3d(sensor, _MAX_RANGE_MESH), MeshWorld(read_triangles(file))
        places = world.tour(n_scans)
        steps = places.diff(dim=0) if len(places) > 1 else torch.zeros_like(places)
        ahead = torch.cat([steps, steps[-1:]])[: len(places)]  # x points towards the next place
        return world, device, Pose.from_yaw(torch.atan2(ahead[:, 1], ahead[:, 0]), places).matrix

    return Simulated(file.stem, ranges, stride, seed, n_scans, make)


class MeshSamples(Dataset):
    """One scan of `n_points` points, uniform on the surface, with isotropic Gaussian noise.

    The mesh is a PLY, OBJ or STL file in metres, and the sensor origin the centre of its bounding box. Points
    at or beyond `max_range` from it have no return. noise: standard deviation (m) along each axis.
    """

    def __init__(
        self,
        path: str | Path,
        ranges: Ranges,
        stride: int = 1,
        n_points: int = 100_000,
        noise: float = 0.0,
        seed: int = 0,
    ) -> None:
        self._path = require_path(
            path,
            "file",
            "a triangle mesh (PLY, OBJ, STL)",
            "The Stanford 3D scanning repository publishes well-known meshes.",
        )
        super().__init__(self._path.stem, ranges, stride)
        self.n_points = check_whole("n_points", n_points, 1)
        self.seed = check_whole("seed", seed, 0)
        self.noise = check_number("noise", noise)

    def _count(self) -> int:
        return 1

    def _read(self, index: int) -> Scan:
        triangles = read_triangles(self._path)
        generator = torch.Generator().manual_seed(self.seed)
        points = sample_surface(triangles, self.n_points, generator)
        points += self.noise * torch.randn(points.shape, generator=generator, dtype=points.dtype)
        corners = triangles.reshape(-1, 3)
        return self.ranges.scan(points, (corners.amin(0) + corners.amax(0)) / 2)


def sample_surface(triangles: Tensor, n_points: int, generator: torch.Generator) -> Tensor:
    """Points (n_points, 3), uniformly distributed over the area of triangles (T, 3, 3).

    For u and v uniform in [0, 1], a + (1 − v) √u (b − a) + v √u (c − a) is uniform on a triangle. Raises
    `DataError` if no triangle has an area.
    """
    a, b, c = triangles.unbind(1)
    area = torch.linalg.cross(b - a, c - a).norm(dim=1)
    if not bool(area.sum() > 0):
        raise DataError("The mesh has no area: every triangle is a line or a point.")
    share = torch.cumsum(area, 0)
    drawn = torch.rand(n_points, generator=generator, dtype=torch.float64) * share[-1]
    chosen = torch.searchsorted(share, drawn, right=True).clamp_max(len(area) - 1)
    u, v = torch.rand(2, n_points, 1, generator=generator, dtype=torch.float64)
    a, b, c = triangles[chosen].unbind(1)
    return a + u.sqrt() * ((1 - v) * (b - a) + v * (c - a))


def _sensor_3d(name: str, max_range: float) -> RangeSensor:
    check_choice("sensor", name, ("lidar", "depth_camera"))
    if name == "lidar":
        return spinning_lidar(max_range=max_range)
    return depth_camera(max_range=max_range)

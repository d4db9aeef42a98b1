"""Data sets of a triangle mesh: points sampled from its surface, and scans of a simulated sensor in it."""

from __future__ import annotations

import functools
import math
from pathlib import Path

import torch
from torch import Tensor

from gmmtorch.datasets.base import Dataset, Ranges, require_path
from gmmtorch.datasets.point_files.mesh_files import read_triangles
from gmmtorch.errors import DataError, InvalidArgumentError, check_whole
from gmmtorch.scan import Scan
from gmmtorch.simulation import sense, spinning_lidar
from gmmtorch.simulation.sensors.range_sensors import depth_camera
from gmmtorch.simulation.worlds.mesh_world import MeshWorld


class MeshSamples(Dataset):
    """One scan of `n_points` points, uniform on the surface, with isotropic Gaussian noise.

    The sensor origin is the centre of the bounding box. Points at or beyond `max_range` from it have no
    return.

    Args:
        path: PLY, OBJ or STL; metres.
        ranges: how readings are interpreted.
        stride: see `Dataset`.
        n_points: number of points.
        noise: standard deviation (m) along each axis.
        seed: of the random numbers.
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
        if not 0 <= noise < math.inf:
            raise InvalidArgumentError(f"noise={noise} must be a standard deviation of at least 0 m.")
        self.noise = noise

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


SENSOR_RANGE = 30.0
_SEEDS_APART = 1_000_003


class MeshScans(Dataset):
    """`n_scans` scans of a lidar (32 × 160 beams) or a depth camera (80 × 64 pixels), range 30 m, noise 1 cm.

    The sensor moves through the largest connected part of the mesh, 1.2 m above the floor (see
    `MeshWorld.tour`); a camera faces forward. Beams without a surface within the sensor's range, or within
    `max_range` if that is shorter, have no return. Scan i depends only on the mesh, the seed, the number of
    scans and i.

    Args:
        path: PLY, OBJ or STL; metres, z up.
        ranges: how readings are interpreted.
        stride: every n-th scan is read.
        n_scans: number of scans, about 2 m apart. Parts of the mesh beyond the last one are not observed.
        sensor: "lidar" or "depth_camera".
        seed: of the sensor's noise.
    """

    def __init__(
        self,
        path: str | Path,
        ranges: Ranges,
        stride: int = 1,
        n_scans: int = 100,
        sensor: str = "lidar",
        seed: int = 0,
    ) -> None:
        self._path = require_path(
            path, "file", "a triangle mesh (PLY, OBJ, STL)", "Units are metres, z is up."
        )
        super().__init__(self._path.stem, ranges, stride)
        self.n_scans = check_whole("n_scans", n_scans, 1)
        self.seed = check_whole("seed", seed, 0)
        if sensor not in ("lidar", "depth_camera"):
            raise InvalidArgumentError(f"sensor={sensor!r} is not known; choose lidar or depth_camera.")
        make = spinning_lidar if sensor == "lidar" else depth_camera
        self.sensor = make(max_range=SENSOR_RANGE)

    def _count(self) -> int:
        return self.n_scans

    @functools.cached_property
    def world(self) -> MeshWorld:
        """The world of the mesh, which is read at the first access."""
        return MeshWorld(read_triangles(self._path))

    @functools.cached_property
    def poses(self) -> Tensor:
        """Sensor poses (n_scans, 4, 4), world ← sensor, x forward along the path."""
        places = self.world.tour(self.n_scans)
        ahead = places.roll(-1, 0) - places if len(places) > 1 else torch.zeros_like(places)
        if len(places) > 1:
            ahead[-1] = ahead[-2]
        heading = torch.atan2(ahead[:, 1], ahead[:, 0])
        poses = torch.eye(4, dtype=torch.float64).repeat(len(places), 1, 1)
        cos, sin = heading.cos(), heading.sin()
        poses[:, 0, 0], poses[:, 0, 1], poses[:, 1, 0], poses[:, 1, 1] = cos, -sin, sin, cos
        poses[:, :3, 3] = places
        return poses

    def _known_pose(self, index: int) -> Tensor:
        return self.poses[index]

    def _read(self, index: int) -> Scan:
        generator = torch.Generator().manual_seed(self.seed * _SEEDS_APART + 1 + index)
        pose = self.poses[index]
        ends, no_return = sense(self.sensor, pose, self.world, generator)
        return self.ranges.scan(ends, pose[:3, 3], no_return)

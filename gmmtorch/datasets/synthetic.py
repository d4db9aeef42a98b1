"""Data sets of simulated buildings, computed when they are accessed; no file is needed.

A scan depends only on the seed and its index, not on the order of reading.
"""

from __future__ import annotations

import math

import torch

from gmmtorch.datasets.base import Dataset, Ranges
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.scan import Scan
from gmmtorch.simulation import (
    RangeSensor,
    World2D,
    World3D,
    building_2d,
    building_3d,
    depth_camera,
    laser_2d,
    poses_2d,
    poses_3d,
    sense,
    spinning_lidar,
)

MAX_RANGE_2D = 12.0
MAX_RANGE_3D = 10.0
_SEEDS_APART = 1_000_003
"""Difference between the generator seeds of consecutive data set seeds; larger than any number of scans."""

_LIDAR_HEIGHT = 1.2
_CAMERA_HEIGHT = 1.4
_CAMERA_PITCH = math.radians(8)
_CAMERA_SWING = math.radians(60)


class _Simulated(Dataset):
    """Scans along the path of a simulated world.

    Beams without a surface within the sensor's maximum range, or within `max_range` if that is shorter,
    have no return. No beam is invalid.
    """

    world: World2D | World3D
    sensor: RangeSensor
    poses: torch.Tensor

    def __init__(self, name: str, ranges: Ranges, stride: int, seed: int, n_scans: int) -> None:
        if not 0 <= seed < 2**40:
            raise InvalidArgumentError(f"seed={seed} must be an integer from 0 to 2^40.")
        if not 1 <= n_scans < _SEEDS_APART:
            raise InvalidArgumentError(f"n_scans={n_scans} must be from 1 to {_SEEDS_APART - 1}.")
        super().__init__(name, ranges, stride)
        self.seed = seed
        self.n_scans = n_scans

    def _generator(self, number: int) -> torch.Generator:
        """Random number generator of the world (0) or of scan `number` − 1."""
        return torch.Generator().manual_seed(self.seed * _SEEDS_APART + number)

    def _count(self) -> int:
        return self.n_scans

    def _known_pose(self, index: int) -> torch.Tensor:
        return self.poses[index]

    def _read(self, index: int) -> Scan:
        pose = self.poses[index]
        ends, no_return = sense(self.sensor, pose, self.world, self._generator(1 + index))
        return self.ranges.scan(ends, pose[:-1, -1], no_return)


class SyntheticBuilding2D(_Simulated):
    """A laser (180 beams over 180°, range 12 m, noise 1 cm) on a path through an office of 30 × 20 m."""

    def __init__(self, ranges: Ranges, stride: int = 1, seed: int = 0, n_scans: int = 120) -> None:
        super().__init__("synthetic_building_2d", ranges, stride, seed, n_scans)
        self.world = building_2d(self._generator(0))
        self.sensor = laser_2d(max_range=MAX_RANGE_2D)
        self.poses = poses_2d(self.world.path, n_scans)


class SyntheticBuilding(_Simulated):
    """A lidar (32 × 160 beams) or depth camera (80 × 64 pixels) in a furnished hall; 10 m, noise 1 cm."""

    def __init__(
        self, ranges: Ranges, stride: int = 1, seed: int = 0, n_scans: int = 40, sensor: str = "lidar"
    ) -> None:
        super().__init__("synthetic_building", ranges, stride, seed, n_scans)
        if sensor not in ("lidar", "depth_camera"):
            raise InvalidArgumentError(f"sensor={sensor!r} is not known; choose lidar or depth_camera.")
        self.world = building_3d(self._generator(0))
        path = self.world.path
        if sensor == "lidar":
            self.sensor = spinning_lidar(max_range=MAX_RANGE_3D)
            self.poses = poses_3d(path, n_scans, _LIDAR_HEIGHT)
        else:
            self.sensor = depth_camera(max_range=MAX_RANGE_3D)
            self.poses = poses_3d(path, n_scans, _CAMERA_HEIGHT, _CAMERA_PITCH, _CAMERA_SWING)

"""ScanConversion: decoded messages of a sensor as scans, for bags and for live topics."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gmmtorch.datasets.base import Ranges
from gmmtorch.datasets.recordings.ros import bag_topics, sensor_messages
from gmmtorch.datasets.recordings.ros.bag_topics import Sensor
from gmmtorch.datasets.recordings.ros.depth_camera import DepthCamera
from gmmtorch.datasets.recordings.ros.pose_sources import PoseSource, RegisteredPoses
from gmmtorch.datasets.recordings.ros.sensor_messages import Reading
from gmmtorch.scan import FARTHEST, Scan

_LEVEL = math.cos(math.radians(10))
_MIN_PLANAR = 16
"""Fewer points at one height do not show that a cloud is the scan of a laser."""
_KNOTS = 1024
"""Poses per sweep for deskewing: of a sweep of 0.1 s, one for every 0.1 ms."""


class ScanConversion:
    """Converts the messages of one sensor.

    Args:
        sensor: its topic and kind.
        ranges: how range readings are interpreted.
        source: poses of the sensor.
        deskew: whether points with times get the pose of their own time, if the source has one.
        camera: of depth images.
    """

    def __init__(
        self,
        sensor: Sensor,
        ranges: Ranges,
        source: PoseSource,
        deskew: bool = True,
        camera: DepthCamera | None = None,
    ) -> None:
        self.source, self._camera = source, camera
        self._sensor, self._ranges = sensor, ranges
        self._deskew = deskew and source.can_deskew

    def points(self, message: dict[str, Any], stamp: int) -> Reading:
        """The points of a decoded message that was measured at a stamp (ns), in the sensor's frame."""
        kind = self._sensor.kind
        if kind == bag_topics.CLOUD:
            return sensor_messages.cloud_points(message, stamp)
        if kind == bag_topics.LIST:
            return sensor_messages.listed_points(message, self._sensor.field, stamp)
        if kind == bag_topics.LASER:
            return sensor_messages.laser_points(message)
        assert self._camera is not None
        return sensor_messages.reading(self._camera.points(message), None, None)

    def is_flat(self, matrices: np.ndarray, first: Reading) -> bool:
        """Whether scans are 2D: the sensor is level at all poses (N, 4, 4), and a laser or a planar lidar."""
        is_planar_cloud = not self._sensor.is_camera and is_planar(first, _MIN_PLANAR)
        is_planar_sensor = self._sensor.kind == bag_topics.LASER or is_planar_cloud
        return is_planar_sensor and self.is_level(matrices)

    @staticmethod
    def is_level(matrices: np.ndarray) -> bool:
        """Whether the sensor stands upright, or on its head, at all poses (N, 4, 4)."""
        return bool((np.abs(matrices[:, 2, 2]) > _LEVEL).all())

    def scan(
        self,
        found: Reading,
        stamp: int,
        frame: str,
        matrix: np.ndarray,
        is_flat: bool,
        delay: float | None,
        skip: Callable[[str], None],
    ) -> Scan:
        """The scan of some points, in the world frame.

        Args:
            found: the points. stamp: of their message, ns. frame: of the sensor.
            matrix: (4, 4) pose of the sensor at the stamp.
            is_flat: whether scans are 2D.
            delay: usual time in ns from stamps to receipt; None: stamps are times of receipt.
            skip: is called with the reason if the scan has no points or is not deskewed.
        """
        dim = 2 if is_flat else 3
        origin = torch.from_numpy(matrix[:dim, 3].copy())
        if len(found.points) == 0:
            skip("message without a valid point")
        elif is_flat and not is_planar(found):
            skip("points of several heights among planar scans")
            return Scan(origin.new_empty(0, dim), origin)
        if isinstance(self.source, RegisteredPoses):
            matrix = self.source.of_points(stamp, frame)
        ends = self._in_world(found, stamp, frame, matrix, delay, skip)
        ends[(ends.abs() > FARTHEST).any(1)] = torch.nan  # no sensor measures them
        return self._ranges.scan(ends[:, :dim].contiguous(), origin, torch.from_numpy(found.no_return))

    def times(self, found: Reading, stamp: int, delay: float | None) -> tuple[int, int]:
        """The first and last times (ns) at which poses are needed."""
        if not self._deskew or found.offsets is None or not len(found.points):
            return stamp, stamp
        offsets = causal_offsets(found.offsets, delay)
        return min(stamp, stamp + int(offsets.min())), max(stamp, stamp + int(offsets.max()))

    def _in_world(
        self,
        found: Reading,
        stamp: int,
        frame: str,
        matrix: np.ndarray,
        delay: float | None,
        skip: Callable[[str], None],
    ) -> Tensor:
        """The points (N, 3) in the world frame, each with the pose of its own time if that is known."""
        points, pose = torch.from_numpy(found.points), torch.from_numpy(matrix)
        if self._deskew and found.offsets is not None and len(points):
            offsets = causal_offsets(found.offsets, delay)
            first, last = int(offsets.min()), int(offsets.max())
            n_knots = min(_KNOTS, len(points)) if last > first else 1
            knots = np.linspace(first, last, n_knots).round().astype(np.int64)
            poses = self.source.at(stamp + knots, frame)
            if poses.known.all():
                nearest = np.round((offsets - first) * ((n_knots - 1) / max(last - first, 1)))
                own = torch.from_numpy(poses.matrices)[torch.from_numpy(nearest.astype(np.int64))]
                return (own[:, :3, :3] @ points[:, :, None])[:, :, 0] + own[:, :3, 3]
            skip("points not deskewed: no poses during the sweep")
        return points @ pose[:3, :3].T + pose[:3, 3]


def causal_offsets(offsets: np.ndarray, delay: float | None) -> np.ndarray:
    """Times of points as ns after the stamp, all before the message was received.

    A message that arrives sooner after its stamp than its sweep lasts has the stamp of the sweep's end,
    as some drivers write it. If both times are equal, the recording does not state when it was received.
    delay: see `ScanConversion.scan`.
    """
    last = int(offsets.max())
    at_end = delay is None or 0 < delay < last / 2
    return offsets - last if at_end and last > 0 else offsets


def is_planar(found: Reading, n_least: int = 1) -> bool:
    """Whether a reading has at least `n_least` points, all at one height of the sensor's frame."""
    return len(found.points) >= n_least and bool(np.ptp(found.points[:, 2]) == 0)

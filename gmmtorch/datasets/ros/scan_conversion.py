"""ScanConversion: decoded messages of a sensor as scans, for bags and for live topics."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
import torch

from gmmtorch.datasets.base import Ranges
from gmmtorch.datasets.packets.lidar_packets import LidarPackets
from gmmtorch.datasets.ros import bag_topics, sensor_messages
from gmmtorch.datasets.ros.bag_poses import PoseSource, RegisteredPoses
from gmmtorch.datasets.ros.bag_topics import Sensor
from gmmtorch.datasets.ros.image_camera import ImageCamera
from gmmtorch.datasets.ros.point_times import N_SAMPLES, PointTimes, Rate
from gmmtorch.datasets.ros.sensor_messages import Reading
from gmmtorch.datasets.trajectory import NANOSECONDS, POINT_TIMES
from gmmtorch.errors import DataError
from gmmtorch.pose import Pose
from gmmtorch.scan import FARTHEST, Scan

_LEVEL = math.cos(math.radians(10))
_MIN_PLANAR = 16  # fewer points at one height do not show that a cloud is the scan of a laser
_N_SHAPES = 3  # readings that show whether a lidar is planar
_KNOTS = 1024  # poses per sweep for deskewing: of a sweep of 0.1 s, one for every 0.1 ms


class ScanConversion:
    """Converts the messages of one sensor.

    Args:
        sensor: its topic and kind.
        ranges: how range readings are interpreted.
        source: poses of the sensor.
        deskew: whether points with times get the pose of their own time, if the source has one.
        camera: of depth images.
        attributes: channels of points that are read.
        packets: decodes raw packets of a lidar; None: one without calibration does.

    Attributes:
        keeps_times: of a source without poses during a sweep: scans have the channel `POINT_TIMES`.
    """

    def __init__(
        self,
        sensor: Sensor,
        ranges: Ranges,
        source: PoseSource,
        deskew: bool = True,
        camera: ImageCamera | None = None,
        attributes: Sequence[str] = (),
        packets: LidarPackets | None = None,
    ) -> None:
        self._attributes = attributes
        self.source, self._camera = source, camera
        self._sensor, self._ranges = sensor, ranges
        self._packets = packets or LidarPackets()
        self.keeps_times = False
        self._times = PointTimes(sensor.kind in bag_topics.LASERS) if deskew else None

    def points(self, message: dict[str, Any]) -> Reading:
        """The points of a decoded message, in the sensor's frame."""
        kind = self._sensor.kind
        if self._camera is not None and self._sensor.is_camera:
            return sensor_messages.reading(self._camera.points(message))
        if kind == bag_topics.CLOUD:
            return sensor_messages.cloud_points(message, self._attributes)
        if kind == bag_topics.LIST:
            return sensor_messages.listed_points(message, self._sensor.field)
        if kind == bag_topics.PACKETS:
            return self._packets.points(message, self._attributes)
        return sensor_messages.laser_points(message)

    @property
    def n_samples(self) -> int:
        """Number of the first readings with points that show how the sensor measures."""
        return 1 if self._sensor.is_camera else _N_SHAPES if self._times is None else N_SAMPLES

    def is_flat(self, poses: Pose, samples: Iterable[Reading]) -> bool:
        """Whether scans are 2D: the sensor is level at all poses, and a laser or a planar lidar.

        A lidar is planar if most of its samples are; those with few points do not count.
        """
        planar = [is_planar(found) for found in samples if len(found.points) >= _MIN_PLANAR]
        is_planar_cloud = not self._sensor.is_camera and 2 * sum(planar) > len(planar)
        is_planar_sensor = self._sensor.kind in bag_topics.LASERS or is_planar_cloud
        return is_planar_sensor and self.is_level(poses)

    def learn_times(self, found: Reading, stamp: int, rate: Rate) -> None:
        """Learns from one of the first readings how the sensor states times of points."""
        if self._times is not None:
            self._times.learn(found.times, stamp, rate)

    @staticmethod
    def is_level(poses: Pose) -> bool:
        """Whether the sensor stands upright, or on its head, at all poses."""
        return bool((poses.rotation[..., 2, 2].abs() > _LEVEL).all())

    def scan(
        self, found: Reading, stamp: int, frame: str, pose: Pose, is_flat: bool, skip: Callable[[str], None]
    ) -> Scan:
        """The scan of some points, in the world frame.

        Args:
            found: the points. stamp: of their message, ns. frame: of the sensor.
            pose: of the sensor at the stamp.
            is_flat: whether scans are 2D.
            skip: is called with the reason if the scan has no points, lacks some, or is not deskewed.
        """
        dim = 2 if is_flat else 3
        origin = pose.translation[:dim].clone()
        if len(found.points) == 0:
            skip("message without a valid point")
        elif is_flat and not is_planar(found):
            skip("points of several heights among planar scans")
            return Scan(origin.new_empty(0, dim), origin)
        for name in set(self._attributes) - found.channels.keys():
            skip(f"read without {name}, which they lack")
        found, offsets = self._timed(found, stamp, skip)
        if isinstance(self.source, RegisteredPoses):
            pose = self.source.of_points(stamp, frame)
        poses = None if offsets is None else self._poses_during(stamp, offsets, frame, skip)
        local = torch.from_numpy(found.points)
        ends = pose.apply(local) if poses is None else poses.apply(local[:, None])[:, 0]
        ends[(ends.abs() > FARTHEST).any(1)] = torch.nan  # no sensor measures them
        ends, no_return = ends[:, :dim].contiguous(), torch.from_numpy(found.no_return)
        channels = found.channels
        if offsets is not None and not self.source.can_deskew:
            channels = {**channels, POINT_TIMES: torch.from_numpy(offsets / NANOSECONDS)}
        return self._ranges.scan(ends, origin, no_return, channels)

    def times(self, found: Reading, stamp: int) -> tuple[int, int]:
        """The first and last times (ns) at which poses are needed."""
        _, offsets = self._timed(found, stamp, lambda reason: None)
        if offsets is None:
            return stamp, stamp
        return min(stamp, stamp + int(offsets.min())), max(stamp, stamp + int(offsets.max()))

    def _timed(
        self, found: Reading, stamp: int, skip: Callable[[str], None]
    ) -> tuple[Reading, np.ndarray | None]:
        """The points whose times fit, and these (N,) in ns after the stamp; all points and None if scans are
        not deskewed or the times cannot be used."""
        is_registered = isinstance(self.source, RegisteredPoses)  # by another program, which deskews
        is_used = self.source.can_deskew or (self.keeps_times and not is_registered)
        if self._times is None or not is_used or not len(found.points):
            return found, None
        try:
            if found.doubt:
                raise DataError(found.doubt)
            if found.times is None:
                return found, None
            offsets, kept = self._times.offsets(found.times, stamp)
        except DataError as error:
            skip(f"points not deskewed: {error!s}")
            return found, None
        if kept is None:
            return found, offsets
        skip("points dropped: their times do not fit into the sweep")
        return found.where(kept), offsets

    def _poses_during(
        self, stamp: int, offsets: np.ndarray, frame: str, skip: Callable[[str], None]
    ) -> Pose | None:
        """The poses (N) of the sensor at times (N,) in ns after a stamp; None if they are not known."""
        if not self.source.can_deskew:
            return None
        first, last = int(offsets.min()), int(offsets.max())
        n_knots = min(_KNOTS, len(offsets)) if last > first else 1
        knots = np.linspace(first, last, n_knots).round().astype(np.int64)
        poses = self.source.at(stamp + knots, frame)
        if not poses.known.all():
            skip("points not deskewed: no poses during the sweep")
            return None
        nearest = np.round((offsets - first) * ((n_knots - 1) / max(last - first, 1)))
        return poses.poses[nearest.astype(np.int64)]


def is_planar(found: Reading) -> bool:
    """Whether all points of a reading are at one height of the sensor's frame."""
    return bool(np.ptp(found.points[:, 2]) == 0)

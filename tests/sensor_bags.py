"""Bags of lasers, depth cameras, wheels and clouds with times of their points, for tests."""

from __future__ import annotations

import math

import numpy as np

from gmmtorch.export import bag, cloud_fields, odometry_fields
from gmmtorch.scan import ArrayLike


def moved(x: float, y: float = 0.0, z: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    """A pose (4, 4) that is turned about z only."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    return np.array([[cos, -sin, 0, x], [sin, cos, 0, y], [0, 0, 1, z], [0, 0, 0, 1.0]])


class BagWriter(bag.BagWriter):
    """Writes messages of sensors; times in seconds, lengths in metres, angles in radians."""

    def odometry(self, topic: str, time: float, frame: str, child: str, matrix: ArrayLike) -> None:
        """The pose of `child` in `frame`."""
        self.message(topic, "nav_msgs/msg/Odometry", time, odometry_fields(frame, child, matrix))

    def cloud(
        self, topic: str, time: float, frame: str, points: ArrayLike, offsets: ArrayLike | None = None
    ) -> None:
        """Points (N, 3), and the times (N,) of the points after `time` in a field t (uint32, ns)."""
        if offsets is None:
            super().cloud(topic, time, frame, points)
            return
        columns = np.asarray(points, dtype=np.float32).reshape(-1, 3)
        table = np.zeros(len(columns), [*((axis, "<f4") for axis in "xyz"), ("t", "<u4")])
        table["x"], table["y"], table["z"] = columns.T
        table["t"] = np.round(np.asarray(offsets) * 1e9)
        self.cloud_table(topic, time, frame, table)

    def cloud_table(self, topic: str, time: float, frame: str, table: np.ndarray) -> None:
        """A structured array (N,) or (H, W) as PointCloud2: its fields, in its byte order."""
        self.message(topic, "sensor_msgs/msg/PointCloud2", time, cloud_fields(frame, table))

    def laser(
        self,
        topic: str,
        time: float,
        frame: str,
        ranges: ArrayLike,
        angle_min: float,
        angle_increment: float,
        range_max: float,
        time_increment: float = 0.0,
    ) -> None:
        """Ranges (N,) as LaserScan, which stores float32."""
        values = np.asarray(ranges, dtype=np.float32)
        fields = {
            "header": {"frame_id": frame},
            "angle_min": angle_min,
            "angle_max": angle_min + angle_increment * (len(values) - 1),
            "angle_increment": angle_increment,
            "time_increment": time_increment,
            "range_min": 0.0,
            "range_max": range_max,
            "ranges": values,
        }
        self.message(topic, "sensor_msgs/msg/LaserScan", time, fields)

    def depth(
        self, topic: str, time: float, frame: str, millimetres: ArrayLike, intrinsics: ArrayLike
    ) -> None:
        """A depth image (H, W) in whole millimetres as 16UC1, and its CameraInfo with a matrix (3, 3)."""
        image = np.asarray(millimetres, dtype="<u2")
        common = {"header": {"frame_id": frame}, "height": image.shape[0], "width": image.shape[1]}
        data = np.frombuffer(image.tobytes(), np.uint8)
        content = {**common, "encoding": "16UC1", "step": 2 * image.shape[1], "data": data}
        self.message(topic, "sensor_msgs/msg/Image", time, content)
        matrix = np.asarray(intrinsics, dtype=np.float64).ravel()
        info = {**common, ("K" if self.path.suffix == ".bag" else "k"): matrix}
        self.message(f"{topic.rpartition('/')[0]}/camera_info", "sensor_msgs/msg/CameraInfo", time, info)

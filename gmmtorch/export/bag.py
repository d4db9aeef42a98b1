"""Writes ROS bags, which gmmtorch and ROS read: ROS 2 (.mcap, .db3) and ROS 1 (.bag)."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from gmmtorch.datasets import in_space, to_nanoseconds
from gmmtorch.errors import InvalidArgumentError, OutputError
from gmmtorch.export.message_fields import built_message, cloud_fields, odometry_fields, transform_fields
from gmmtorch.optional_packages import needs_extra
from gmmtorch.scan import ArrayLike, Scan


def write_bag(
    path: str | Path,
    scans: Sequence[Scan],
    poses: Sequence[ArrayLike],
    times: Sequence[float] | None = None,
    topic: str = "/points",
) -> Path:
    """Write scans as PointCloud2 in the frame `lidar`, and their poses as TF from `map` to `lidar`.

    Args:
        path: .mcap, .db3 or .bag; replaced when all is written.
        scans: in the world frame. Points are stored as float32 in the sensor frame, those in 2D at z = 0;
            beams without return are not stored.
        poses: (D+1, D+1) world ← sensor, one for each scan.
        times: seconds, one for each scan; None: ten scans a second.
        topic: of the clouds.

    Raises `InvalidArgumentError` for other shapes of poses and other numbers of poses or times,
    `OutputError` if the file cannot be written, and `GmmTorchError` without rosbags.
    """
    stamps = [i / 10 for i in range(len(scans))] if times is None else list(times)
    if not len(scans) == len(poses) == len(stamps):
        raise InvalidArgumentError(
            f"{len(scans)} scans, {len(poses)} poses and {len(stamps)} times; give as many of each."
        )
    with BagWriter(path) as bag:
        for scan, pose, time in zip(scans, poses, stamps, strict=True):
            given, dim = np.asarray(pose, dtype=np.float64), scan.dim
            if given.shape != (dim + 1, dim + 1):
                raise InvalidArgumentError(
                    f"a pose has shape {given.shape}; scans in {dim}D need ({dim + 1}, {dim + 1})."
                )
            points = scan.points.detach().cpu().double().numpy()
            local = (points - given[:dim, dim]) @ given[:dim, :dim]
            bag.transforms(time, {("map", "lidar"): in_space(given[None])[0]})
            bag.cloud(topic, time, "lidar", np.pad(local, ((0, 0), (0, 3 - dim))))
    return Path(path)


class BagWriter:
    """Writes messages to a bag; use it in a `with` statement.

    The file at `path` (.mcap, .db3 or .bag) appears, or is replaced, when the statement ends without error.
    Times are in seconds, or in nanoseconds if they are integers; poses are (4, 4), float64, metres.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        if self.path.suffix not in (".mcap", ".db3", ".bag"):
            raise InvalidArgumentError(f"path={path} must end in .mcap, .db3 (ROS 2) or .bag (ROS 1).")
        with needs_extra("ROS bags need", "rosbags", "bags"):
            from rosbags import rosbag1, rosbag2, typesys
        self._is_ros1 = self.path.suffix == ".bag"
        self._typesys: Any = typesys
        self.types: Any = typesys.get_typestore(
            typesys.Stores.ROS1_NOETIC if self._is_ros1 else typesys.Stores.ROS2_JAZZY
        )
        if self._is_ros1:  # rosbags has no TF among the types of ROS 1
            self.define("tf2_msgs/msg/TFMessage", "geometry_msgs/TransformStamped[] transforms\n")
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._folder = Path(tempfile.mkdtemp(prefix=f".{self.path.stem}.", dir=self.path.parent))
        except OSError as error:
            raise OutputError(
                f"{path} cannot be written: {error.strerror}; choose another folder."
            ) from error
        self.writer: Any
        if self._is_ros1:
            self.writer = rosbag1.Writer(self._folder / "a.bag")
        else:
            plugin = rosbag2.StoragePlugin["MCAP" if self.path.suffix == ".mcap" else "SQLITE3"]
            self.writer = rosbag2.Writer(self._folder / "a", version=9, storage_plugin=plugin)
        self._connections: dict[tuple[str, str], Any] = {}

    def __enter__(self) -> BagWriter:
        self.writer.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.writer.close()
            if kind is None:
                written = next(file for file in self._folder.rglob(f"*{self.path.suffix}") if file.is_file())
                written.replace(self.path)
        except OSError as failure:
            raise OutputError(f"{self.path} cannot be written: {failure.strerror}.") from failure
        finally:
            shutil.rmtree(self._folder, ignore_errors=True)

    def define(self, name: str, definition: str) -> None:
        """Makes a message type known, such as pkg/msg/Name, by its text in the form of a .msg file."""
        self.types.register(self._typesys.get_types_from_msg(definition, name))

    def message(
        self, topic: str, name: str, time: float, fields: Mapping[str, Any], received: float | None = None
    ) -> None:
        """Writes a message of type `name`, recorded at `received` (default: `time`), from nested fields.

        A header gets `time` as its stamp. Fields that are not given are zero or empty.
        """
        key = (topic, name)
        if key not in self._connections:
            self._connections[key] = self.writer.add_connection(topic, name, typestore=self.types)
        content = built_message(self.types, name, fields, _nanoseconds(time))
        serialize = self.types.serialize_ros1 if self._is_ros1 else self.types.serialize_cdr
        stamp = _nanoseconds(time if received is None else received)
        self.writer.write(self._connections[key], stamp, serialize(content, name))

    def transforms(
        self, time: float, edges: Mapping[tuple[str, str], ArrayLike], static: bool = False
    ) -> None:
        """Writes transforms (parent, child) → parent ← child to /tf, or to /tf_static."""
        topic = "/tf_static" if static else "/tf"
        self.message(topic, "tf2_msgs/msg/TFMessage", time, transform_fields(edges))

    def odometry(self, topic: str, time: float, frame: str, child: str, matrix: ArrayLike) -> None:
        """Writes an Odometry message: the pose of `child` in `frame`."""
        self.message(topic, "nav_msgs/msg/Odometry", time, odometry_fields(frame, child, matrix))

    def cloud(
        self, topic: str, time: float, frame: str, points: ArrayLike, offsets: ArrayLike | None = None
    ) -> None:
        """Writes points (N, 3) of the sensor frame as PointCloud2 in float32.

        offsets: (N,) times of the points in seconds after `time`, stored in a field t (uint32, ns).
        """
        columns = np.asarray(points, dtype=np.float32).reshape(-1, 3)
        fields = [(axis, "<f4") for axis in "xyz"] + ([] if offsets is None else [("t", "<u4")])
        table = np.zeros(len(columns), np.dtype(fields))
        table["x"], table["y"], table["z"] = columns.T
        if offsets is not None:
            table["t"] = np.round(np.asarray(offsets) * 1e9)
        self.cloud_table(topic, time, frame, table)

    def cloud_table(self, topic: str, time: float, frame: str, table: np.ndarray) -> None:
        """Writes a structured array (N,) or (H, W) as PointCloud2: its fields, in its byte order."""
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
        """Writes ranges (N,) in metres as LaserScan, which stores float32. Angles in radians."""
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
        """Writes a depth image (H, W) in whole millimetres as 16UC1, and its CameraInfo beside it.

        intrinsics: pinhole matrix (3, 3) in pixels.
        """
        image = np.asarray(millimetres, dtype="<u2")
        header, (height, width) = {"header": {"frame_id": frame}}, image.shape
        size = {"height": height, "width": width}
        data = np.frombuffer(image.tobytes(), np.uint8)
        content = {**header, **size, "encoding": "16UC1", "step": 2 * width, "data": data}
        self.message(topic, "sensor_msgs/msg/Image", time, content)
        matrix = np.asarray(intrinsics, dtype=np.float64).ravel()
        info = {**header, **size, ("K" if self._is_ros1 else "k"): matrix}
        self.message(f"{topic.rpartition('/')[0]}/camera_info", "sensor_msgs/msg/CameraInfo", time, info)


def _nanoseconds(time: float) -> int:
    return time if isinstance(time, int) else int(to_nanoseconds(np.array(float(time))))

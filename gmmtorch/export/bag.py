"""ROS bags that gmmtorch and ROS read, and the contents of their messages, which live topics share."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from gmmtorch.datasets import ARRAY, BASE, NAME, NANOSECONDS, to_nanoseconds
from gmmtorch.errors import InvalidArgumentError, OutputError
from gmmtorch.optional_packages import needs_extra
from gmmtorch.pose import Pose
from gmmtorch.scan import ArrayLike, Scan

_POINT_TYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}


def built_message(store: Any, name: str, fields: Mapping[str, Any], stamp: int) -> Any:
    """An object of message type `name` of a type store of rosbags.

    A header without a stamp gets `stamp` (ns). Fields that are not given are zero or empty.
    """
    values: dict[str, Any] = {}
    for field, (kind, content) in store.fielddefs[name][1]:
        given = fields.get(field)
        if kind == NAME:
            if content == "builtin_interfaces/msg/Time" and given is None and name.endswith("/Header"):
                given = time_fields(stamp)
            values[field] = built_message(store, content, given or {}, stamp)
        elif kind == BASE:
            values[field] = given if given is not None else "" if content[0] == "string" else 0
        elif content[0][0] == NAME:
            values[field] = [built_message(store, content[0][1], item, stamp) for item in given or []]
        elif content[0][1][0] == "string":
            values[field] = list(given or [])
        else:
            code = {"bool": "u1", "byte": "u1", "char": "u1", "octet": "u1"}.get(content[0][1][0])
            size = content[1] if kind == ARRAY else 0
            array = np.zeros(size) if given is None else given
            values[field] = np.asarray(array, dtype=np.dtype(code or content[0][1][0]))
    return store.types[name](**values)


def time_fields(stamp: int) -> dict[str, int]:
    """A Time from nanoseconds."""
    return {"sec": stamp // NANOSECONDS, "nanosec": stamp % NANOSECONDS}


def pose_fields(matrix: ArrayLike) -> tuple[dict[str, float], dict[str, float]]:
    """Translation and rotation of a pose (4, 4) as fields of messages."""
    pose = Pose.from_matrix(matrix)
    shift, turn = pose.translation.tolist(), pose.quaternion().tolist()
    return dict(zip("xyz", shift, strict=True)), dict(zip("xyzw", turn, strict=True))


def transform_fields(edges: Mapping[tuple[str, str], ArrayLike]) -> dict[str, Any]:
    """A TFMessage from transforms (parent, child) → parent ← child, (4, 4)."""
    entries = [
        {
            "header": {"frame_id": parent},
            "child_frame_id": child,
            "transform": dict(zip(("translation", "rotation"), pose_fields(matrix), strict=True)),
        }
        for (parent, child), matrix in edges.items()
    ]
    return {"transforms": entries}


def odometry_fields(frame: str, child: str, matrix: ArrayLike) -> dict[str, Any]:
    """An Odometry message: the pose (4, 4) of `child` in `frame`."""
    position, orientation = pose_fields(matrix)
    pose = {"pose": {"position": position, "orientation": orientation}}
    return {"header": {"frame_id": frame}, "child_frame_id": child, "pose": pose}


def cloud_fields(frame: str, table: np.ndarray) -> dict[str, Any]:
    """A PointCloud2 from a structured array (N,) or (H, W): its fields, in its byte order.

    Raises `InvalidArgumentError` for other arrays, and for types of fields that PointCloud2 does not have.
    """
    dtypes = {name: (entry[0], entry[1]) for name, entry in (table.dtype.fields or {}).items()}
    unknown = [f"{name} {dtype}" for name, (dtype, _) in dtypes.items() if dtype.str[1:] not in _POINT_TYPES]
    if unknown or not dtypes or table.ndim not in (1, 2):
        raise InvalidArgumentError(
            f"table of shape {table.shape} with fields {', '.join(unknown or dtypes) or 'none'} cannot be a "
            "PointCloud2; give a structured array (N,) or (H, W) whose fields are float32, float64, or whole "
            "numbers of at most 32 bits."
        )
    is_big = any(dtype.str[0] == ">" for dtype, _ in dtypes.values())
    rows = np.atleast_2d(table.astype(table.dtype.newbyteorder(">" if is_big else "<"), copy=False))
    point_fields = [
        {"name": name, "offset": offset, "datatype": _POINT_TYPES[dtype.str[1:]], "count": 1}
        for name, (dtype, offset) in dtypes.items()
    ]
    step = table.dtype.itemsize
    return {
        "header": {"frame_id": frame},
        "height": rows.shape[0],
        "width": rows.shape[1],
        "fields": point_fields,
        "is_bigendian": is_big,
        "point_step": step,
        "row_step": step * rows.shape[1],
        "is_dense": True,
        "data": np.frombuffer(rows.tobytes(), np.uint8),
    }


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
            bag.transforms(time, {("map", "lidar"): Pose.from_matrix(given).in_space().matrix})
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
        with self._errors():
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._folder = Path(tempfile.mkdtemp(prefix=f".{self.path.stem}.", dir=self.path.parent))
        self.writer: Any
        if self._is_ros1:
            self.writer = rosbag1.Writer(self._folder / "a.bag")
        else:
            plugin = rosbag2.StoragePlugin["MCAP" if self.path.suffix == ".mcap" else "SQLITE3"]
            self.writer = rosbag2.Writer(self._folder / "a", version=9, storage_plugin=plugin)
        self._connections: dict[tuple[str, str], Any] = {}

    def __enter__(self) -> BagWriter:
        try:
            with self._errors():
                self.writer.open()
        except OutputError:
            shutil.rmtree(self._folder, ignore_errors=True)
            raise
        return self

    @contextmanager
    def _errors(self) -> Iterator[None]:
        """Turns errors of the disk into an `OutputError`, such as of one that is full."""
        import sqlite3

        try:
            yield
        except (OSError, sqlite3.Error) as error:
            reason = getattr(error, "strerror", None) or error
            raise OutputError(f"{self.path} cannot be written: {reason}; choose another folder.") from error

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            with self._errors():
                self.writer.close()
                if kind is None:
                    files = self._folder.rglob(f"*{self.path.suffix}")
                    next(file for file in files if file.is_file()).replace(self.path)
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
        content = built_message(self.types, name, fields, _nanoseconds(time))
        serialize = self.types.serialize_ros1 if self._is_ros1 else self.types.serialize_cdr
        stamp = _nanoseconds(time if received is None else received)
        with self._errors():
            if key not in self._connections:
                self._connections[key] = self.writer.add_connection(topic, name, typestore=self.types)
            self.writer.write(self._connections[key], stamp, serialize(content, name))

    def transforms(
        self, time: float, edges: Mapping[tuple[str, str], ArrayLike], static: bool = False
    ) -> None:
        """Writes transforms (parent, child) → parent ← child to /tf, or to /tf_static."""
        topic = "/tf_static" if static else "/tf"
        self.message(topic, "tf2_msgs/msg/TFMessage", time, transform_fields(edges))

    def cloud(self, topic: str, time: float, frame: str, points: ArrayLike) -> None:
        """Writes points (N, 3) of the sensor frame as PointCloud2 in float32."""
        columns = np.ascontiguousarray(np.asarray(points, dtype="<f4").reshape(-1, 3))
        table = columns.view([(axis, "<f4") for axis in "xyz"]).reshape(-1)
        self.message(topic, "sensor_msgs/msg/PointCloud2", time, cloud_fields(frame, table))


def _nanoseconds(time: float) -> int:
    return time if isinstance(time, int) else int(to_nanoseconds(np.array(float(time))))

"""Options of the data sets, and the check of a point file's path. Importing this file does not load torch."""

from __future__ import annotations

from dataclasses import dataclass, fields, make_dataclass
from pathlib import Path
from typing import Any, get_type_hints

from gmmtorch.declarations import default_of, option, repeated
from gmmtorch.errors import InvalidArgumentError, MissingDataError

_REQUIRED = "???"  # a value that must be given, as Hydra writes it
SUFFIXES = (".npy", ".las", ".laz", ".pcd", ".ply")
"""Suffixes of the files of points that are read in chunks."""


@dataclass(kw_only=True)
class DatasetOptions:
    """Every option of a data set. `OPTIONS` tells which data set has which, with which default."""

    name: str = option(_REQUIRED, "name of the data set")
    max_range: float | None = option(
        None, "readings at or beyond this distance (m) are beams without return; null: the sensor's own"
    )
    no_return_range: float = option(
        0.0, "metres of free space along a beam without return; 0: such beams are ignored"
    )
    stride: int = option(1, "use every n-th scan")
    odometry: str = option(
        "none",
        "none: the poses of the data set; auto: mixture if it has none; mixture or kiss_icp: poses are "
        "estimated from the scans",
    )
    motion: str = option(
        "constant",
        "prediction of odometry=mixture. constant: the motion continues; dataset: as between the poses of "
        "the data set, such as those of wheels; imu: by the IMU of a ROS bag",
    )
    path: str = option(_REQUIRED, "file or folder")
    poses: str | None = option(
        None,
        "trajectory file (TUM or KITTI) whose poses replace those of the data set. rosbag: tf, standing, a "
        "topic of poses, or such a file; null: tf",
    )
    attributes: list[str] = option(
        [], "channels that the map learns beside the points, such as [colour,intensity,class]"
    )
    pixel_stride: int = option(1, "every n-th pixel of every n-th row of depth images")
    depth_scale: float | None = option(
        0.001, "metres per unit of depth images; null: 0.001 for whole numbers, 1 for floating ones"
    )
    up: str = option(
        "z",
        "axis of the poses' world frame that points up: x, -x, y, -y, z or -z; it becomes z. -y if the world "
        "frame is that of the first camera, as in 7-Scenes",
    )
    intrinsics: list[float] | None = option(
        None,
        "[fx,fy,cx,cy] in pixels of depth images without distortion; null: the recording's own, for tum "
        "[525,525,319.5,239.5]",
    )
    max_gap: float = option(2.0, "longest time (s) between two poses that are interpolated")
    scene: str | None = option(None, "name of the scene, such as scene-0061; null: the only one")
    topic: Any = option(
        None,
        "topic of the sensor, or topics of several, such as [/front,/rear]; null: the only one of its kind",
    )
    frame: str | None = option(
        None, "the fixed frame of TF, such as odom; null: the root of the sensor's tree"
    )
    sensor_frame: str | None = option(None, "read only messages of this frame; null: all")
    extrinsic: list[float] | None = option(
        None, "[x,y,z,qx,qy,qz,qw] (m) of the sensor on the body with the poses; null: from /tf_static"
    )
    clock: str = option("header", "header: stamps of the messages; received: times of recording")
    deskew: bool = option(True, "each point with a time gets the pose of its own time")
    calibration: str | None = option(
        None,
        "file of the lidar whose packets are read: metadata (.json) of an Ouster, corrections (.csv) of a "
        "Hesai; null: the metadata in the recording or beside it, nominal angles",
    )
    n_points: int = option(100_000, "number of points sampled from the surface of the mesh")
    n_scans: int | None = option(None, "number of simulated scans; null: the whole tour")
    sensor: str = option("lidar", "lidar or depth_camera")
    seed: int = option(0, "seed of the simulation, its points or its noise")


_OF_ALL = ("name", "max_range", "no_return_range", "stride", "odometry", "motion")
_OF_FILES = ("path", "poses")
_OF_CLOUDS = (*_OF_FILES, "attributes")
_OF_TUM = (*_OF_CLOUDS, "pixel_stride", "depth_scale", "intrinsics", "max_gap")
_OF_BAGS = ("topic", "frame", "sensor_frame", "extrinsic", "clock", "deskew", "calibration")


def _options(*names: str, **defaults: Any) -> type:
    """A dataclass with the options of all data sets and these, some with other defaults."""
    known, types = {item.name: item for item in fields(DatasetOptions)}, get_type_hints(DatasetOptions)
    values = {name: defaults.get(name, default_of(known[name])) for name in (*_OF_ALL, *names)}
    made = [(name, types[name], repeated(DatasetOptions, name, value)) for name, value in values.items()]
    return make_dataclass("Options", made)


OPTIONS: dict[str, type] = {
    "carmen": _options(*_OF_FILES, max_range=50.0, no_return_range=8.0),
    "scan_folder": _options(*_OF_CLOUDS),
    "pcd_viewpoint": _options(*_OF_CLOUDS),
    "depth_frames": _options(*_OF_CLOUDS, "pixel_stride", "depth_scale", "up"),
    "e57": _options(*_OF_FILES),
    "octomap_log": _options(*_OF_FILES),
    "rosbag": _options(*_OF_TUM, *_OF_BAGS, depth_scale=None),
    "kitti": _options(*_OF_CLOUDS, "max_gap"),
    "nuscenes": _options(*_OF_CLOUDS, "scene"),
    "tum": _options(*_OF_TUM, depth_scale=0.0002, max_gap=0.5),
    "mesh": _options(*_OF_FILES, "n_points", "seed"),
    "mesh_scans": _options(*_OF_FILES, "n_scans", "sensor", "seed", no_return_range=8.0, n_scans=100),
    "synthetic_building": _options("seed", "n_scans", "sensor", no_return_range=8.0),
    "synthetic_building_2d": _options("seed", "n_scans", no_return_range=8.0),
}
"""A dataclass with the options of each data set."""


def point_path(path: str | Path) -> Path:
    """The path of a point file, with ~ expanded.

    Raises `InvalidArgumentError` for an unknown suffix, and `MissingDataError` if the file does not exist.
    """
    path = Path(path).expanduser()
    known = ", ".join(SUFFIXES)
    if path.suffix.lower() not in SUFFIXES:
        raise InvalidArgumentError(f"points={path} has an unknown suffix {path.suffix!r}; known are {known}.")
    if not path.is_file():
        what = "is not a file" if path.exists() else "does not exist"
        raise MissingDataError(f"points={path} {what}; give a file of points ({known}).")
    return path

"""Options of the data sets, and the check of a point file's path. Importing this file does not load torch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gmmtorch.declarations import option, repeated
from gmmtorch.errors import InvalidArgumentError, MissingDataError

_REQUIRED = "???"
"""A value that must be given, as Hydra writes it."""
SUFFIXES = (".npy", ".las", ".laz", ".pcd", ".ply")
"""Suffixes of the files of points that are read in chunks."""


@dataclass(kw_only=True)
class DatasetOptions:
    """What all data sets have."""

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


@dataclass(kw_only=True)
class FileOptions(DatasetOptions):
    """A data set in files."""

    path: str = option(_REQUIRED, "file or folder")
    poses: str | None = option(
        None,
        "trajectory file (TUM or KITTI) whose poses replace those of the data set. rosbag: tf, standing, a "
        "topic of poses, or such a file; null: tf",
    )


@dataclass(kw_only=True)
class ChannelOptions(FileOptions):
    """A data set whose points can have channels."""

    attributes: list[str] = option(
        [], "channels that the map learns beside the points, such as [colour,intensity,class]"
    )


@dataclass(kw_only=True)
class CarmenOptions(FileOptions):
    """A CARMEN log."""

    max_range: float | None = repeated(DatasetOptions, "max_range", 50.0)
    no_return_range: float = repeated(DatasetOptions, "no_return_range", 8.0)


@dataclass(kw_only=True)
class DepthFramesOptions(ChannelOptions):
    """Depth images."""

    pixel_stride: int = option(1, "every n-th pixel of every n-th row of depth images")
    depth_scale: float | None = option(
        0.001,
        "metres per unit of depth images; null: 0.001 for whole numbers, 1 for floating ones",
    )
    up: str = option(
        "z",
        "axis of the poses' world frame that points up: x, -x, y, -y, z or -z; it becomes z. -y if the world "
        "frame is that of the first camera, as in 7-Scenes",
    )


@dataclass(kw_only=True)
class TumOptions(ChannelOptions):
    """A sequence of the TUM RGB-D benchmark."""

    pixel_stride: int = repeated(DepthFramesOptions, "pixel_stride", 1)
    depth_scale: float | None = repeated(DepthFramesOptions, "depth_scale", 0.0002)
    intrinsics: list[float] | None = option(
        None,
        "[fx,fy,cx,cy] in pixels of depth images without distortion; null: the recording's own, for tum "
        "[525,525,319.5,239.5]",
    )
    max_gap: float = option(0.5, "longest time (s) between two poses that are interpolated")


@dataclass(kw_only=True)
class KittiOptions(ChannelOptions):
    """A sequence of the KITTI benchmark."""

    max_gap: float = repeated(TumOptions, "max_gap", 2.0)


@dataclass(kw_only=True)
class NuScenesOptions(ChannelOptions):
    """A scene of nuScenes."""

    scene: str | None = option(None, "name of the scene, such as scene-0061; null: the only one")


@dataclass(kw_only=True)
class RosbagOptions(TumOptions):
    """A ROS bag, or a network capture of a lidar."""

    max_gap: float = repeated(TumOptions, "max_gap", 2.0)
    depth_scale: float | None = repeated(DepthFramesOptions, "depth_scale", None)
    topic: Any = option(
        None,
        "topic of the sensor, or topics of several, such as [/front,/rear]; null: the only one of its kind",
    )
    frame: str | None = option(
        None, "the fixed frame of TF, such as odom; null: the root of the sensor's tree"
    )
    sensor_frame: str | None = option(None, "read only messages of this frame; null: all")
    extrinsic: list[float] | None = option(
        None,
        "[x,y,z,qx,qy,qz,qw] (m) of the sensor on the body with the poses; null: from /tf_static",
    )
    clock: str = option("header", "header: stamps of the messages; received: times of recording")
    deskew: bool = option(True, "each point with a time gets the pose of its own time")
    calibration: str | None = option(
        None,
        "file of the lidar whose packets are read: metadata (.json) of an Ouster, corrections (.csv) of a "
        "Hesai; null: the metadata in the recording or beside it, nominal angles",
    )


@dataclass(kw_only=True)
class MeshOptions(FileOptions):
    """Points of a mesh."""

    n_points: int = option(100_000, "number of points sampled from the surface of the mesh")
    seed: int = option(0, "seed of the simulation, its points or its noise")


@dataclass(kw_only=True)
class SyntheticOptions(DatasetOptions):
    """A simulated building."""

    no_return_range: float = repeated(DatasetOptions, "no_return_range", 8.0)
    seed: int = repeated(MeshOptions, "seed", 0)
    n_scans: int | None = option(None, "number of simulated scans; null: the whole tour")


@dataclass(kw_only=True)
class SyntheticBuildingOptions(SyntheticOptions):
    """A simulated building in 3D."""

    sensor: str = option("lidar", "lidar or depth_camera")


@dataclass(kw_only=True)
class MeshScansOptions(FileOptions):
    """Simulated scans of a mesh, about 2 m apart."""

    no_return_range: float = repeated(DatasetOptions, "no_return_range", 8.0)
    n_scans: int = repeated(SyntheticOptions, "n_scans", 100)
    sensor: str = repeated(SyntheticBuildingOptions, "sensor", "lidar")
    seed: int = repeated(MeshOptions, "seed", 0)


OPTIONS: dict[str, type[DatasetOptions]] = {
    "carmen": CarmenOptions,
    "scan_folder": ChannelOptions,
    "pcd_viewpoint": ChannelOptions,
    "depth_frames": DepthFramesOptions,
    "e57": FileOptions,
    "octomap_log": FileOptions,
    "rosbag": RosbagOptions,
    "kitti": KittiOptions,
    "nuscenes": NuScenesOptions,
    "tum": TumOptions,
    "mesh": MeshOptions,
    "mesh_scans": MeshScansOptions,
    "synthetic_building": SyntheticBuildingOptions,
    "synthetic_building_2d": SyntheticOptions,
}
"""The options of each data set."""


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

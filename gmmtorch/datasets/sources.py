"""The data sets by name, and the function that opens one."""

from __future__ import annotations

import importlib
import inspect
from pathlib import Path
from typing import Any, NamedTuple

from gmmtorch.datasets.base import Dataset, Ranges
from gmmtorch.datasets.dataset_options import OPTIONS
from gmmtorch.errors import InvalidArgumentError


class _Source(NamedTuple):
    """The module and class of a data set."""

    module: str
    reader: str
    needs_path: bool = True


_SOURCES = {
    "carmen": _Source("scan_logs", "CarmenLog"),
    "scan_folder": _Source("scan_folders", "ScanFolder"),
    "pcd_viewpoint": _Source("scan_folders", "PcdViewpoint"),
    "depth_frames": _Source("depth_images", "DepthFrames"),
    "e57": _Source("point_files.e57_files", "E57Scans"),
    "octomap_log": _Source("scan_logs", "OctomapLog"),
    "rosbag": _Source("ros.rosbag", "open_rosbag"),
    "kitti": _Source("scan_folders", "Kitti"),
    "nuscenes": _Source("scan_folders", "NuScenes"),
    "tum": _Source("depth_images", "TumRgbd"),
    "mesh": _Source("synthetic", "MeshSamples"),
    "mesh_scans": _Source("synthetic", "MeshScans"),
    "synthetic_building": _Source("synthetic", "SyntheticBuilding", needs_path=False),
    "synthetic_building_2d": _Source("synthetic", "SyntheticBuilding2D", needs_path=False),
}


def load(
    name: str,
    path: str | Path | None = None,
    *,
    max_range: float | None = None,
    no_return_range: float | None = None,
    stride: int = 1,
    poses: str | Path | None = None,
    **options: Any,
) -> Dataset:
    """The data set `name`: a sequence of scans, each read when it is accessed.

    Args:
        name: carmen, scan_folder, pcd_viewpoint, depth_frames, e57, octomap_log, rosbag, kitti,
            nuscenes, tum, mesh or mesh_scans, which need a `path`; synthetic_building or
            synthetic_building_2d, which need none.
        path: the file or folder.
        max_range: a reading at this distance (m) or beyond is a beam without return. None: 50 for CARMEN
            logs, the sensor's own maximum for mesh_scans and the synthetic buildings, no limit
            (`math.inf`) for the others.
        no_return_range: length (m) of free space along a beam without return; 0 drops such beams. None: 8
            for CARMEN logs, mesh_scans and the synthetic buildings, 0 for the others.
        stride: every n-th scan is read.
        poses: a trajectory file whose poses replace those of the data set: TUM rows (time x y z qx qy qz qw)
            for scans with times, or KITTI rows (12 numbers), one for each scan. rosbag also takes "tf"
            and topics. rosbag and scan_folder take "standing": every scan is in the frame of the sensor.
        options: specific to the data set: `pixel_stride`, `depth_scale` and `up` for depth_frames;
            `n_points`, `noise` and `seed` for mesh; `seed`, `n_scans` and, in 3D, `sensor` ("lidar" or
            "depth_camera") for mesh_scans and the synthetic buildings.

    Raises `InvalidArgumentError` for an unknown name or option or an invalid value, `MissingDataError` for a
    path that does not exist, and `DataError`, now or when a scan is read, for unreadable data.
    """
    if name not in _SOURCES:
        raise InvalidArgumentError(f"dataset={name!r} is not known; choose one of {', '.join(_SOURCES)}.")
    source = _SOURCES[name]
    reader = getattr(importlib.import_module(f"gmmtorch.datasets.{source.module}"), source.reader)
    given = {"max_range": max_range, "no_return_range": no_return_range}
    ranges = Ranges(**{n: getattr(OPTIONS[name], n) if v is None else v for n, v in given.items()})
    known = set(inspect.signature(reader).parameters) - {"path", "ranges", "stride"}
    if poses is not None and "poses" in known:
        options["poses"] = str(poses)
    elif poses == "standing" and "standing" in known:
        options["standing"], poses = True, None
    for option, value in options.items():
        if option not in known:
            takes = f"takes {', '.join(sorted(known))}" if known else "takes no further options"
            raise InvalidArgumentError(
                f"{option}={value!r} is not an option of dataset={name}, which {takes}."
            )
    if source.needs_path and poses is not None and "poses" not in known:
        from gmmtorch.datasets.trajectory import with_trajectory

        return with_trajectory(reader(path, ranges, 1, **options), poses, stride)
    for option, value in (("path", path), ("poses", poses)):
        if value is not None and not source.needs_path:
            raise InvalidArgumentError(
                f"{option}={value} is given, but dataset={name} is simulated; drop it, or choose one "
                f"of {', '.join(n for n, s in _SOURCES.items() if s.needs_path)}."
            )
    dataset: Dataset = reader(*[path] * source.needs_path, ranges, stride, **options)
    return dataset

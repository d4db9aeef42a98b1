"""The data sets by name, and the function that opens one."""

from __future__ import annotations

import importlib
import inspect
from pathlib import Path
from typing import Any

from gmmtorch.datasets.base import Dataset, Ranges
from gmmtorch.datasets.dataset_options import OPTIONS
from gmmtorch.errors import InvalidArgumentError

_READERS = {
    "carmen": "scan_logs.CarmenLog",
    "scan_folder": "scan_folders.ScanFolder",
    "pcd_viewpoint": "scan_folders.PcdViewpoint",
    "depth_frames": "depth_images.DepthFrames",
    "e57": "point_files.e57_files.E57Scans",
    "octomap_log": "scan_logs.OctomapLog",
    "rosbag": "ros.rosbag.open_rosbag",
    "kitti": "scan_folders.Kitti",
    "nuscenes": "scan_folders.NuScenes",
    "tum": "depth_images.TumRgbd",
    "mesh": "synthetic.MeshSamples",
    "mesh_scans": "synthetic.mesh_scans",
    "synthetic_building": "synthetic.synthetic_building",
    "synthetic_building_2d": "synthetic.synthetic_building_2d",
}
_SIMULATED = ("synthetic_building", "synthetic_building_2d")  # data sets without a path


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
    if name not in _READERS:
        raise InvalidArgumentError(f"dataset={name!r} is not known; choose one of {', '.join(_READERS)}.")
    module, _, function = _READERS[name].rpartition(".")
    reader = getattr(importlib.import_module(f"gmmtorch.datasets.{module}"), function)
    needs_path = name not in _SIMULATED
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
    if needs_path and poses is not None and "poses" not in known:
        from gmmtorch.datasets.trajectory import with_trajectory

        return with_trajectory(reader(path, ranges, 1, **options), poses, stride)
    for option, value in (("path", path), ("poses", poses)):
        if value is not None and not needs_path:
            raise InvalidArgumentError(
                f"{option}={value} is given, but dataset={name} is simulated; drop it, or choose one "
                f"of {', '.join(n for n in _READERS if n not in _SIMULATED)}."
            )
    dataset: Dataset = reader(*[path] * needs_path, ranges, stride, **options)
    return dataset

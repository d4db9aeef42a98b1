"""Sequences of the KITTI odometry benchmark: clouds of a Velodyne, and poses of the left camera.

`velodyne/*.bin`: float32 x, y, z, reflectance. `poses.txt`: a row of 12 numbers for each scan, world ←
camera. `calib.txt`: the row `Tr`, camera ← Velodyne. `times.txt`: seconds, optional.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gmmtorch.datasets.base import Dataset, Ranges, check_poses, natural_key, require_path
from gmmtorch.datasets.recordings.trajectory import Trajectory, read_rows, read_trajectory, to_nanoseconds
from gmmtorch.errors import DataError
from gmmtorch.pose import Pose
from gmmtorch.scan import Scan

_POINT_BYTES = 16
_CALIBRATION = "Tr: 1 0 0 0 0 1 0 0 0 0 1 0"


class Kitti(Dataset):
    """Scans of one sequence in the natural order of their file names.

    The world frame is that of the Velodyne at the origin of the poses: x forward, z up. The clouds of the
    benchmark are deskewed already.

    Args:
        path: the folder of the sequence. Poses are also found where the benchmark has them, in
            `../../poses/NN.txt`.
        ranges, stride: see `Dataset`.
        poses: another trajectory: KITTI rows of the camera as in poses.txt, or TUM rows of the Velodyne,
            which need times.txt.
        max_gap: longest time (s) between two poses of a TUM trajectory that are interpolated.
    """

    _poses: Tensor

    def __init__(
        self,
        path: str | Path,
        ranges: Ranges,
        stride: int = 1,
        poses: str | None = None,
        max_gap: float = 2.0,
    ) -> None:
        path = require_path(
            path,
            "folder",
            "velodyne/*.bin, poses.txt and calib.txt",
            "The KITTI odometry benchmark and SemanticKITTI publish sequences in this layout.",
        )
        super().__init__(path.resolve().name, ranges, stride)
        files = sorted((path / "velodyne").glob("*.bin"), key=natural_key)
        if not files:
            raise DataError(f"{path / 'velodyne'} contains no .bin file; put one file per scan there.")
        times = read_rows(path / "times.txt")[:, 0] if (path / "times.txt").is_file() else None
        if times is not None and len(times) < len(files):
            raise DataError(f"{path / 'times.txt'} has {len(times)} rows for {len(files)} scans.")
        trajectory = read_trajectory(poses or _find_poses(path))
        if poses is not None and trajectory.has_times:
            if times is None:
                raise DataError(
                    f"{path / 'times.txt'} is missing; the trajectory {poses} needs times of scans."
                )
            found, known = trajectory.at(to_nanoseconds(times[: len(files)]), max_gap)
        else:
            found, known = _of_lidar(path, trajectory, len(files)), np.ones(len(files), bool)
        if not known.any() and times is not None:
            raise DataError(
                f"{path}: no scan has a pose. Scans are from {times[0]:.3f} to {times[-1]:.3f} s, poses from "
                f"{trajectory.times[0] / 1e9:.3f} to {trajectory.times[-1] / 1e9:.3f} s."
            )
        self._skip("no pose at the time of the scan", *np.flatnonzero(~known).tolist())
        self._files = [file for file, is_known in zip(files, known, strict=True) if is_known]
        self._poses = found[known].matrix
        self._times = None if times is None else torch.from_numpy(times[: len(files)][known])

    def _count(self) -> int:
        return len(self._files)

    def _read(self, index: int) -> Scan:
        path = self._files[index]
        if path.stat().st_size % _POINT_BYTES:
            raise DataError(
                f"{path} is not a whole number of points of {_POINT_BYTES} bytes; it is truncated."
            )
        points = np.fromfile(path, "<f4").reshape(-1, 4)[:, :3].astype(np.float64)
        valid = np.isfinite(points).all(1) & (points != 0).any(1)
        return self.ranges.posed(torch.from_numpy(points[valid]), self._poses[index])


def _find_poses(path: Path) -> Path:
    beside = path.resolve().parent.parent / "poses" / f"{path.resolve().name}.txt"
    if (path / "poses.txt").is_file() or not beside.is_file():
        return path / "poses.txt"
    return beside


def _of_lidar(path: Path, trajectory: Trajectory, n_scans: int) -> Pose:
    """Poses (N) of the Velodyne, Tr⁻¹ P Tr, from those of the camera."""
    if len(trajectory) < n_scans:
        raise DataError(
            f"{path} has {n_scans} scans, but only {len(trajectory)} poses; write one row for each scan."
        )
    mount = _calibration(path / "calib.txt")
    return mount.inverse() @ trajectory.poses[:n_scans] @ mount


def _calibration(path: Path) -> Pose:
    """camera ← Velodyne, the row Tr of calib.txt."""
    if not path.is_file():
        raise DataError(
            f"{path} is missing; it states the Velodyne's pose on the camera. If poses.txt has poses of the "
            f"Velodyne, write the line '{_CALIBRATION}'."
        )
    for line in path.read_text("utf-8", errors="replace").splitlines():
        name, _, numbers = line.partition(":")
        if name.strip() in ("Tr", "Tr_velo_cam", "Tr_velo_to_cam"):
            try:
                rows = np.array([float(word) for word in numbers.split()]).reshape(3, 4)
            except ValueError as error:
                raise DataError(f"{path}: the row {name} is not 12 numbers ({error}).") from error
            matrix = np.vstack([rows, [0, 0, 0, 1]])
            return Pose.from_matrix(check_poses(torch.from_numpy(matrix), f"{path}, row {name}"))
    raise DataError(
        f"{path} has no row Tr (camera ← Velodyne); a calibration without rotation: '{_CALIBRATION}'."
    )

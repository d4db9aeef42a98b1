"""Folders of point clouds with their sensor poses, also those of the KITTI odometry benchmark.

`ScanFolder` has `scans/*.pcd` (or `*.ply`) in the sensor frame, and `poses.txt` with one KITTI row per scan:
12 numbers, the upper 3×4 part of world ← sensor, row by row; metres. `PcdViewpoint` has PCD files with points
in the world frame and the sensor origin in VIEWPOINT.

`Kitti` has `velodyne/*.bin`, float32 x, y, z, reflectance; optional `labels/*.label` of SemanticKITTI;
`poses.txt` with a row of the left camera for each scan;
`calib.txt` with the row `Tr`, camera ← Velodyne; and, optional, `times.txt` in seconds.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gmmtorch.datasets.base import (
    NO_POSE,
    Dataset,
    Ranges,
    check_poses,
    natural_key,
    number_rows,
    require_path,
)
from gmmtorch.datasets.point_files.channels import CLASS, INTENSITY, check_channels, read_channels
from gmmtorch.datasets.point_files.pcd_files import pcd_header
from gmmtorch.datasets.point_files.point_chunks import read_cloud
from gmmtorch.datasets.trajectory import Trajectory, kitti_poses, read_rows, read_trajectory, to_nanoseconds
from gmmtorch.errors import DataError
from gmmtorch.pose import Pose
from gmmtorch.scan import Scan


class ScanFolder(Dataset):
    """Scans in the natural order of their file names (scan_2 before scan_10).

    Points at or beyond `max_range` have no return. NaN, infinite points and points at the sensor origin are
    invalid and dropped; scans with infinite points, or NaN in a PLY file, are counted. With `standing`,
    poses.txt is not read, and every scan is in the frame of the sensor. `attributes`: names of the channels
    that are read, see `read_channels`.
    """

    _poses: torch.Tensor

    def __init__(
        self,
        path: str | Path,
        ranges: Ranges,
        stride: int = 1,
        standing: bool = False,
        attributes: Iterable[str] = (),
    ) -> None:
        self.attributes = check_channels(attributes)
        path = require_path(
            path,
            "folder",
            "scans/*.pcd or scans/*.ply in the sensor frame, and poses.txt (12 numbers per row)",
            "KITTI odometry, MulRan and most lidar SLAM systems export this layout.",
        )
        super().__init__(path.name, ranges, stride)
        scans = path / "scans"
        self._files = sorted([*scans.glob("*.pcd"), *scans.glob("*.ply")], key=natural_key)
        if not self._files:
            raise DataError(f"{scans} contains no .pcd and no .ply file; put one file per scan there.")
        if standing:
            self._poses = Pose.identity(3, len(self._files)).matrix
            return
        self._poses = _read_poses(path / "poses.txt")
        if len(self._poses) != len(self._files):
            raise DataError(
                f"{path}: poses.txt has {len(self._poses)} rows, but there are {len(self._files)} scans; "
                "write one pose for each scan, in the order of the file names."
            )

    def _count(self) -> int:
        return len(self._files)

    def _read(self, index: int) -> Scan:
        points = read_cloud(self._files[index])
        self._count_invalid(points, index)
        channels = read_channels(self._files[index], self.attributes) if self.attributes else {}
        self._without(set(self.attributes) - channels.keys(), index)
        return self.ranges.posed(points, self._poses[index], channels)

    def _count_invalid(self, points: torch.Tensor, index: int) -> None:
        """Counts a scan with points that are not finite. NaN in a PCD file is a beam without return."""
        usual = torch.isfinite(points)
        if self._files[index].suffix == ".pcd":
            usual |= points.isnan()
        if not bool(usual.all()):
            self._skip("points dropped: their coordinates are not finite", index)


def _read_poses(path: Path) -> torch.Tensor:
    """Poses (S, 4, 4) of a file of KITTI rows."""
    if not path.is_file():
        raise DataError(
            f"{path} is missing; write one row of 12 numbers (world ← sensor) for each scan, or "
            "estimate the poses with ‹odometry›=auto."
        )
    rows = read_rows(path)
    if rows.shape[1] != 12:
        raise DataError(f"{path} has {rows.shape[1]} numbers per row; a KITTI pose has 12.")
    return kitti_poses(path, rows).matrix


class PcdViewpoint(Dataset):
    """Scans in the natural order of their file names (scan_2 before scan_10).

    Points at or beyond `max_range` from the viewpoint have no return. NaN, infinite points and points at the
    sensor origin are invalid and dropped. The orientation in VIEWPOINT is not used. `attributes`: names of
    the channels that are read, see `read_channels`.
    """

    def __init__(
        self, path: str | Path, ranges: Ranges, stride: int = 1, attributes: Iterable[str] = ()
    ) -> None:
        self.attributes = check_channels(attributes)
        path = require_path(
            path,
            "folder",
            "*.pcd in the world frame, the sensor position in VIEWPOINT",
            "The la3dm project publishes its simulated lidar scans this way.",
        )
        super().__init__(path.name, ranges, stride)
        self._files = sorted(path.glob("*.pcd"), key=natural_key)
        if not self._files:
            raise DataError(f"{path} contains no .pcd file.")

    def _count(self) -> int:
        return len(self._files)

    def _known_pose(self, index: int) -> torch.Tensor:
        """The position in VIEWPOINT with the rotation of the world frame."""
        return Pose.from_yaw(0.0, _viewpoint(self._files[index])).matrix

    def _read(self, index: int) -> Scan:
        path = self._files[index]
        channels = read_channels(path, self.attributes) if self.attributes else {}
        self._without(set(self.attributes) - channels.keys(), index)
        return self.ranges.scan(read_cloud(path), _viewpoint(path), None, channels)


def _viewpoint(path: Path) -> torch.Tensor:
    """The sensor position (3,) in the header of a PCD file."""
    words = pcd_header(path).get("VIEWPOINT", [])
    if len(words) not in (3, 7):
        raise DataError(
            f"{path}: VIEWPOINT {' '.join(words)} has {len(words)} numbers; it needs a position and a "
            "quaternion, 7 numbers."
        )
    origin = torch.from_numpy(number_rows([" ".join(words)], len(words), f"{path}: VIEWPOINT")[0, :3])
    if not bool(torch.isfinite(origin).all()):
        raise DataError(f"{path}: VIEWPOINT {' '.join(words)} does not begin with a sensor position.")
    return origin


# -- KITTI -------------------------------------------------------------------------------------------


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
        attributes: channels that are read: "intensity", the reflectance; "class", the label of SemanticKITTI
            (the lower 16 bits; 0, unlabeled, is unknown).
    """

    _poses: Tensor

    def __init__(
        self,
        path: str | Path,
        ranges: Ranges,
        stride: int = 1,
        poses: str | None = None,
        max_gap: float = 2.0,
        attributes: Iterable[str] = (),
    ) -> None:
        self.attributes = check_channels(
            attributes, [INTENSITY, CLASS], "scans of KITTI have intensity and class"
        )
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
        self._skip(NO_POSE, *np.flatnonzero(~known).tolist())
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
        table = np.fromfile(path, "<f4").reshape(-1, 4)
        points = table[:, :3].astype(np.float64)
        valid = np.isfinite(points).all(1) & (points != 0).any(1)
        channels = {}
        if INTENSITY in self.attributes:
            channels[INTENSITY] = torch.from_numpy(
                np.where(np.isfinite(table[:, 3]), table[:, 3], np.nan)[valid]
            )
        if CLASS in self.attributes:
            channels[CLASS] = torch.from_numpy(_kitti_labels(path, len(table))[valid])
        return self.ranges.posed(torch.from_numpy(points[valid]), self._poses[index], channels)


def _kitti_labels(scan: Path, n_points: int) -> np.ndarray:
    """The labels (N,) of a scan of SemanticKITTI, −1 where unlabeled."""
    path = scan.parent.parent / "labels" / f"{scan.stem}.label"
    if not path.is_file():
        raise DataError(f"{path} is missing; SemanticKITTI publishes the labels of each scan there.")
    if path.stat().st_size != 4 * n_points:
        raise DataError(
            f"{path} has {path.stat().st_size:,} bytes, not 4 for each of {n_points:,} points; it is damaged,"
            " or of another scan."
        )
    labels = np.fromfile(path, "<u4").astype(np.int64) & 0xFFFF
    return np.where(labels == 0, -1, labels)


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

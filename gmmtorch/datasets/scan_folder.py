"""Folders of point clouds with their sensor poses.

`ScanFolder` has `scans/*.pcd` (or `*.ply`) in the sensor frame, and `poses.txt` with one KITTI row per scan:
12 numbers, the upper 3×4 part of world ← sensor, row by row; metres. `PcdViewpoint` has PCD files with points
in the world frame and the sensor origin in VIEWPOINT.
"""

from __future__ import annotations

from pathlib import Path

import torch

from gmmtorch.datasets.base import Dataset, Ranges, natural_key, require_path
from gmmtorch.datasets.number_rows import number_rows
from gmmtorch.datasets.point_files.cloud_files import read_cloud
from gmmtorch.datasets.point_files.pcd_files import pcd_header
from gmmtorch.datasets.recordings.trajectory import kitti_matrices, read_rows
from gmmtorch.errors import DataError
from gmmtorch.scan import Scan


class ScanFolder(Dataset):
    """Scans in the natural order of their file names (scan_2 before scan_10).

    Points at or beyond `max_range` have no return. NaN, infinite points and points at the sensor origin are
    invalid and dropped; scans with infinite points, or NaN in a PLY file, are counted. With `standing`,
    poses.txt is not read, and every scan is in the frame of the sensor.
    """

    _poses: torch.Tensor

    def __init__(self, path: str | Path, ranges: Ranges, stride: int = 1, standing: bool = False) -> None:
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
            self._poses = torch.eye(4, dtype=torch.float64).repeat(len(self._files), 1, 1)
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
        return self.ranges.posed(points, self._poses[index])

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
    return torch.from_numpy(kitti_matrices(path, rows))


class PcdViewpoint(Dataset):
    """Scans in the natural order of their file names (scan_2 before scan_10).

    Points at or beyond `max_range` from the viewpoint have no return. NaN, infinite points and points at the
    sensor origin are invalid and dropped. The orientation in VIEWPOINT is not used.
    """

    def __init__(self, path: str | Path, ranges: Ranges, stride: int = 1) -> None:
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
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, 3] = _viewpoint(self._files[index])
        return pose

    def _read(self, index: int) -> Scan:
        path = self._files[index]
        return self.ranges.scan(read_cloud(path), _viewpoint(path))


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

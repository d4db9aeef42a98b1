"""A folder of PCD files with points in the world frame and the sensor origin in VIEWPOINT."""

from __future__ import annotations

from pathlib import Path

import torch

from gmmtorch.datasets.base import Dataset, Ranges, natural_key, require_path
from gmmtorch.datasets.point_files.cloud_files import pcd_header, read_cloud
from gmmtorch.errors import DataError
from gmmtorch.scan import Scan


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
        origin = _viewpoint(path)
        return self.ranges.scan(read_cloud(path), origin)


def _viewpoint(path: Path) -> torch.Tensor:
    """The sensor position (3,) in the header of a PCD file."""
    words = pcd_header(path).get("VIEWPOINT", [])
    try:
        origin = torch.tensor([float(w) for w in words[:3]], dtype=torch.float64)
    except ValueError as error:
        raise DataError(f"{path}: VIEWPOINT {' '.join(words)} does not consist of numbers.") from error
    if origin.shape != (3,) or not bool(torch.isfinite(origin).all()):
        raise DataError(f"{path}: VIEWPOINT {' '.join(words)} does not begin with a sensor position.")
    return origin

"""E57 files (ASTM E2807) of terrestrial laser scanners: one scan for each position of the scanner."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gmmtorch.datasets.base import Dataset, Ranges, check_poses, require_path
from gmmtorch.errors import DataError, GmmTorchError
from gmmtorch.optional_packages import needs_extra
from gmmtorch.pose import Pose
from gmmtorch.scan import Scan

_POINTS_PER_BYTE = 8
"""A file that announces more is damaged: a packed coordinate has at least a bit, and a point has three."""


class E57Scans(Dataset):
    """The scans of an E57 file in its order, each from the position of the scanner that the file states.

    Coordinates are Cartesian or spherical. Points that the file marks as invalid are dropped. A scan without
    a pose is in the world frame, with the scanner at its origin, as the standard says.
    """

    _poses: Tensor

    def __init__(self, path: str | Path, ranges: Ranges, stride: int = 1) -> None:
        path = require_path(path, "file", "an E57 file", "Programs of laser scanners export such files.")
        with needs_extra(f"{path}: E57 files need", "pye57", "e57"):
            import pye57
        super().__init__(path.stem, ranges, stride)
        self._path, self._package = path, pye57
        with self._opened() as file:
            headers = [file.get_header(number) for number in range(file.scan_count)]
            n_points = sum(int(header.point_count) for header in headers)
            if n_points > _POINTS_PER_BYTE * path.stat().st_size:
                raise DataError(
                    f"{path} announces {n_points:,} points, more than it has space for; it is damaged."
                )
            matrices = np.tile(np.eye(4), (len(headers), 1, 1))
            for matrix, header in zip(matrices, headers, strict=True):
                if header.has_pose():
                    matrix[:3, :3], matrix[:3, 3] = header.rotation_matrix, header.translation
        if not headers:
            raise DataError(f"{path} contains no scan.")
        self._poses = check_poses(torch.from_numpy(matrices), f"{path}, pose of scan")

    @contextmanager
    def _opened(self) -> Iterator[Any]:
        """The opened file. Turns every error of libE57, which are of several kinds, into a `DataError`."""
        try:
            with self._package.E57(str(self._path)) as file:
                yield file
        except GmmTorchError:
            raise
        except Exception as error:
            raise DataError(
                f"{self._path} cannot be read as E57 ({' '.join(str(error).split())}); it is truncated or "
                "damaged. Write or fetch it again."
            ) from error

    def _count(self) -> int:
        return len(self._poses)

    def _read(self, index: int) -> Scan:
        with self._opened() as file:
            found = file.read_scan(index, transform=False, ignore_missing_fields=True)
            if "sphericalRange" in found:
                parts = [found[f"spherical{name}"] for name in ("Range", "Azimuth", "Elevation")]
                distance, azimuth, elevation = (part.astype(np.float64) for part in parts)
                level = distance * np.cos(elevation)
                axes = [level * np.cos(azimuth), level * np.sin(azimuth), distance * np.sin(elevation)]
            else:
                axes = [found[f"cartesian{axis}"] for axis in "XYZ"]
        points = torch.from_numpy(np.stack(axes, 1).astype(np.float64))
        pose = self._poses[index]
        return self.ranges.scan(Pose.from_matrix(pose).apply(points), pose[:3, 3])

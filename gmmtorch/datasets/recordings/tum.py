"""Sequences of the TUM RGB-D benchmark: depth images with times, and a trajectory of the camera.

`depth.txt`: rows `time file`. `groundtruth.txt`: rows `time x y z qx qy qz qw`. Depth images are PNG with 16
bits, in 1/5000 m; 0 is invalid.
"""

from __future__ import annotations

from pathlib import Path, PurePosixPath

import numpy as np
import torch
from torch import Tensor

from gmmtorch.datasets.base import Dataset, Ranges, require_path
from gmmtorch.datasets.depth_frames import read_png
from gmmtorch.datasets.recordings.trajectory import (
    NANOSECONDS,
    order_of_rows,
    read_trajectory,
    to_nanoseconds,
)
from gmmtorch.errors import DataError, check_number, check_whole
from gmmtorch.pinhole import back_project, pinhole_matrix
from gmmtorch.scan import Scan

_INTRINSICS = (525.0, 525.0, 319.5, 239.5)
"""The values that the benchmark recommends: its depth images are registered with these."""


class TumRgbd(Dataset):
    """Depth images as scans, in the order of their times, with poses interpolated at their times.

    Images without a pose are left out and counted. `intrinsics` is the pinhole matrix (3, 3) in pixels;
    `image` returns the full depth image of a scan.

    Args:
        path: the folder of the sequence.
        ranges, stride: see `Dataset`.
        poses: another trajectory file with times; None: groundtruth.txt.
        intrinsics: fx, fy, cx, cy in pixels; None: 525, 525, 319.5, 239.5.
        depth_scale: metres per unit of the images.
        max_gap: longest time (s) between two poses that are interpolated.
        pixel_stride: every n-th pixel of every n-th row is used.
    """

    _poses: Tensor

    def __init__(
        self,
        path: str | Path,
        ranges: Ranges,
        stride: int = 1,
        poses: str | None = None,
        intrinsics: list[float] | None = None,
        depth_scale: float = 0.0002,
        max_gap: float = 0.5,
        pixel_stride: int = 1,
    ) -> None:
        path = require_path(
            path,
            "folder",
            "depth.txt, groundtruth.txt and depth/*.png",
            "The TUM RGB-D benchmark publishes sequences in this layout.",
        )
        super().__init__(path.resolve().name, ranges, stride)
        self.pixel_stride = check_whole("pixel_stride", pixel_stride, 1)
        check_number("depth_scale", depth_scale, above=True)
        self._scale = depth_scale
        self.intrinsics = pinhole_matrix(_INTRINSICS if intrinsics is None else intrinsics)
        times, files = _listed(path / "depth.txt")
        trajectory = read_trajectory(poses or path / "groundtruth.txt")
        if not trajectory.has_times:
            raise DataError(
                f"{poses or path / 'groundtruth.txt'} has poses without times; give a TUM trajectory."
            )
        found = trajectory.at(times, max_gap)
        self._skip("no pose at the time of the scan", *np.flatnonzero(~found.known).tolist())
        if not found.known.any():
            raise DataError(
                f"{path}: no depth image has a pose. Images are from {times[0] / NANOSECONDS:.3f} to "
                f"{times[-1] / NANOSECONDS:.3f} s, poses from {trajectory.times[0] / NANOSECONDS:.3f} to "
                f"{trajectory.times[-1] / NANOSECONDS:.3f} s."
            )
        self._files = [files[index] for index in np.flatnonzero(found.known)]
        self._poses = torch.from_numpy(found.matrices[found.known])
        self._times = torch.from_numpy(times[found.known] / NANOSECONDS)

    def _count(self) -> int:
        return len(self._files)

    def _read(self, index: int) -> Scan:
        points = back_project(self._depth(index), self.intrinsics, self.pixel_stride)
        return self.ranges.posed(points, self._poses[index])

    def image(self, index: int) -> tuple[Tensor, Tensor]:
        """Depth (H, W) in metres, 0 for invalid pixels, and pose (4, 4), world ← camera, of a scan."""
        position = self._position(index)
        return self._depth(position), self._poses[position]

    def _depth(self, index: int) -> Tensor:
        path = self._files[index]
        return torch.from_numpy(read_png(path, str(path)) * self._scale)


def _listed(path: Path) -> tuple[np.ndarray, list[Path]]:
    """Times (ns), increasing, and files of a list of images. Files must be inside the folder of the list."""
    if not path.is_file():
        raise DataError(f"{path} is missing; it lists a time and a file for each depth image.")
    times, files = [], []
    for number, line in enumerate(path.read_text("utf-8", errors="replace").splitlines(), 1):
        words = line.split("#")[0].split()
        if not words:
            continue
        try:
            seconds, name = float(words[0]), PurePosixPath(words[1])
            if not abs(seconds) < 9e9 or name.is_absolute() or ".." in name.parts:
                raise ValueError(f"{line!r} is not a time and a file of this folder")
        except (ValueError, IndexError) as error:
            raise DataError(f"{path}, line {number}: expected a time and a file ({error}).") from error
        times.append(seconds)
        files.append(path.parent / name)
    if not files:
        raise DataError(f"{path} lists no image.")
    stamps = to_nanoseconds(np.array(times))
    order = order_of_rows(path, stamps)
    return stamps[order], [files[index] for index in order]

"""A data set with the poses of another trajectory, such as that of a SLAM system."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gmmtorch.datasets.base import Dataset
from gmmtorch.datasets.recordings.trajectory import in_plane, read_trajectory, to_nanoseconds
from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.linalg import nearest_rotations
from gmmtorch.scan import Scan

_MAX_GAP = 2.0


def with_trajectory(source: Dataset, path: str | Path, stride: int) -> Dataset:
    """Every `stride`-th scan of a data set (stride 1) with poses, moved to those of a trajectory file.

    Args:
        source: a data set that states its poses.
        path: KITTI rows, one for each scan; or TUM rows, which are interpolated at the times of the scans
            over at most two seconds. Both state the pose of the sensor, world ← sensor.
        stride: every n-th scan is read.

    Raises `InvalidArgumentError` if the data set has no poses, or no times for TUM rows, and `DataError`.
    """
    path = Path(path).expanduser()
    if len(source) == 0 or source.pose(0) is None:
        raise InvalidArgumentError(
            f"‹poses›={path} cannot be used: the data set does not state its own poses, from which its "
            "points would be moved."
        )
    trajectory = read_trajectory(path, len(source))
    if not trajectory.has_times:
        matrices, known = trajectory.matrices, np.ones(len(source), bool)
    else:
        if source.times is None:
            raise InvalidArgumentError(
                f"‹poses›={path} has poses at times, but the scans have no times; give a KITTI "
                "trajectory, one row for each scan."
            )
        matrices, known = trajectory.at(to_nanoseconds(source.times.numpy()), _MAX_GAP)
        if not known.any():
            first, last = float(source.times[0]), float(source.times[-1])
            raise DataError(f"{path} has no pose for the scans, which are from {first:.3f} to {last:.3f} s.")
    is_flat = source[0].dim == 2
    poses = torch.from_numpy(in_plane(matrices) if is_flat else matrices)
    return with_poses(source, poses, torch.from_numpy(known), stride)


def with_poses(source: Dataset, poses: Tensor, known: Tensor, stride: int = 1) -> Reposed:
    """Every `stride`-th scan of a data set, moved to other poses (N, D+1, D+1), world ← sensor.

    known: which of the N scans have such a pose (N,); the others are left out.
    """
    kind = ReposedDepth if hasattr(source, "image") else Reposed
    return kind(source, poses, known, stride)


class Reposed(Dataset):
    """Scans of another data set with other poses; made by `with_poses` and `with_trajectory`."""

    _poses: Tensor

    def __init__(self, source: Dataset, poses: Tensor, known: Tensor, stride: int) -> None:
        super().__init__(source.name, source.ranges, stride)
        self._source: Any = source
        self._indices = known.nonzero().squeeze(1).tolist()
        self._skip("no pose at the time of the scan", *(~known).nonzero().squeeze(1).tolist())
        self._poses = poses[self._indices]
        self._times = None if source.times is None else source.times[self._indices]

    @property
    def skipped(self) -> dict[str, int]:
        return {**self._source.skipped, **super().skipped}

    def _count(self) -> int:
        return len(self._indices)

    def own_pose(self, index: int) -> Tensor:
        """The pose (D+1, D+1) that the source states for scan `index`, world ← sensor."""
        pose: Tensor = self._source.pose(self._indices[self._position(index)])
        return pose

    def pose(self, index: int) -> Tensor:
        return self._poses[self._position(index)]

    def _read(self, index: int) -> Scan:
        before = self._source.pose(self._indices[index])
        motion = self._poses[index] @ torch.linalg.inv(before)
        motion[:-1, :-1] = nearest_rotations(motion[:-1, :-1])  # rotations in files are rounded
        scan: Scan = self._source[self._indices[index]]
        motion[-1] = torch.eye(len(motion), dtype=motion.dtype)[-1]
        motion[:-1, -1] = self._poses[index][:-1, -1] - motion[:-1, :-1] @ before[:-1, -1]
        return scan.transformed(motion)


class ReposedDepth(Reposed):
    """Depth images of another data set with other poses. `intrinsics` and `image` are as in `DepthFrames`."""

    @property
    def intrinsics(self) -> Tensor:
        matrix: Tensor = self._source.intrinsics
        return matrix

    def image(self, index: int) -> tuple[Tensor, Tensor]:
        """Depth (H, W) in metres, 0 for invalid pixels, and pose (4, 4), world ← camera, of a scan."""
        position = self._position(index)
        depth, _ = self._source.image(self._indices[position])
        return depth, self._poses[position]

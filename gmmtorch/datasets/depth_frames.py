"""Depth images with poses, in the layout of the 7-Scenes data set.

`frame-*.depth.png`: 16 bit, millimetres along the optical axis. `frame-*.pose.txt`: 4×4 matrix
camera-to-world, metres. `camera-intrinsics.txt`: 3×3 pinhole matrix in pixels.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gmmtorch.datasets.base import Dataset, Ranges, check_pose, natural_key, require_path
from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.scan import Scan

_INVALID = (0, 65535)


class DepthFrames(Dataset):
    """Depth images as scans, in the natural order of their names (frame-2 before frame-10).

    Pixels at a distance of `max_range` metres or beyond have no return. Depths 0 and 65535 are invalid
    and dropped. `pixel_stride` keeps every n-th pixel of every n-th row. `intrinsics` is the pinhole
    matrix (3, 3) in pixels. `image` returns the full depth image of a scan.
    """

    def __init__(self, path: str | Path, ranges: Ranges, stride: int = 1, pixel_stride: int = 1) -> None:
        path = require_path(
            path,
            "folder",
            "frame-*.depth.png, frame-*.pose.txt and camera-intrinsics.txt",
            "Microsoft's 7-Scenes data set is published in this layout.",
        )
        if pixel_stride < 1:
            raise InvalidArgumentError(f"pixel_stride={pixel_stride} must be at least 1.")
        super().__init__(path.name, ranges, stride)
        self.pixel_stride = pixel_stride
        self._files = sorted(path.glob("frame-*.depth.png"), key=natural_key)
        if not self._files:
            raise DataError(f"{path} holds no frame-*.depth.png.")
        poses = list(path.glob("frame-*.pose.txt"))
        if len(poses) != len(self._files):
            raise DataError(
                f"{path} holds {len(self._files)} depth images, but {len(poses)} poses; each image needs one."
            )
        self.intrinsics = _matrix(path / "camera-intrinsics.txt", 3)

    def _count(self) -> int:
        return len(self._files)

    def _read(self, index: int) -> Scan:
        pose = self._pose(index)
        points = back_project(_depth(self._files[index]), self.intrinsics, self.pixel_stride)
        return self.ranges.scan(points @ pose[:3, :3].T + pose[:3, 3], pose[:3, 3])

    def image(self, index: int) -> tuple[Tensor, Tensor]:
        """Depth (H, W) in metres, 0 for invalid pixels, and pose (4, 4), world ← camera, of a scan.

        The rotation, which is rounded in the file, is made orthonormal.
        """
        position = self._position(index)
        pose = self._pose(position).clone()
        left, _, right = torch.linalg.svd(pose[:3, :3])
        pose[:3, :3] = left @ right
        return _depth(self._files[position]), pose

    def _pose(self, index: int) -> Tensor:
        path = self._files[index]
        path = path.with_name(path.name.replace(".depth.png", ".pose.txt"))
        return check_pose(_matrix(path, 4), str(path))


def back_project(depth: Tensor, intrinsics: Tensor, pixel_stride: int = 1) -> Tensor:
    """Camera-frame points (N, 3) of the valid pixels of a depth image (H, W), metres, row by row.

    x = (u − c_x) d / f_x, y = (v − c_y) d / f_y, z = d. Pixels with depth 0 or NaN are omitted. Only every
    `pixel_stride`-th pixel of every `pixel_stride`-th row is used.
    """
    depth = depth[::pixel_stride, ::pixel_stride]
    v, u = torch.meshgrid(
        *(torch.arange(n, dtype=depth.dtype) * pixel_stride for n in depth.shape), indexing="ij"
    )
    x = (u - intrinsics[0, 2]) / intrinsics[0, 0]
    y = (v - intrinsics[1, 2]) / intrinsics[1, 1]
    return torch.stack([x * depth, y * depth, depth], -1)[depth > 0]


def _depth(path: Path) -> Tensor:
    """Depth (H, W) in metres, float64; 0 for invalid pixels."""
    from PIL import Image

    try:
        with Image.open(path) as image:
            raw = np.asarray(image)
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise DataError(f"{path} is not a complete PNG image: {error}") from error
    if raw.ndim != 2 or raw.dtype not in (np.uint16, np.int32):
        raise DataError(
            f"{path} is {raw.dtype} of shape {raw.shape}; expected one 16-bit channel, millimetres."
        )
    return torch.from_numpy(np.where(np.isin(raw, _INVALID), 0, raw) / 1000.0)


def _matrix(path: Path, size: int) -> Tensor:
    if not path.is_file():
        raise DataError(f"{path} is missing; expected a {size}×{size} matrix.")
    try:
        matrix = np.loadtxt(path, dtype=np.float64, ndmin=2)
    except ValueError as error:
        raise DataError(f"{path} is not a matrix of numbers: {error}") from error
    if matrix.shape != (size, size) or not np.isfinite(matrix).all():
        raise DataError(
            f"{path} holds an array of shape {matrix.shape}; expected a finite {size}×{size} matrix."
        )
    return torch.from_numpy(matrix)

"""Depth images with poses, in the layout of the 7-Scenes data set.

`frame-*.depth.png`: 16 bit, millimetres along the optical axis, or another unit, see `depth_scale`.
`frame-*.pose.txt`: 4×4 matrix camera-to-world, metres. `camera-intrinsics.txt`: 3×3 pinhole matrix in
pixels.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import IO

import numpy as np
import torch
from torch import Tensor

from gmmtorch.datasets.base import Dataset, Ranges, check_pose, natural_key, require_path
from gmmtorch.errors import DataError, InvalidArgumentError, check_choice, check_number, check_whole
from gmmtorch.linalg import nearest_rotations
from gmmtorch.pinhole import back_project, check_intrinsics, is_centered
from gmmtorch.scan import Scan

_INVALID = (0, 65535)
MAX_PIXELS = 1 << 23
"""An image of 4K has 8.3 million; a damaged header may announce billions."""

_UPRIGHT = {
    "z": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "-z": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
    "y": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
    "-y": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    "x": [[0, 0, -1], [0, 1, 0], [1, 0, 0]],
    "-x": [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],
}
"""The rotation that turns an axis into z."""


class DepthFrames(Dataset):
    """Depth images as scans, in the natural order of their names (frame-2 before frame-10).

    Pixels at a distance of `max_range` metres or beyond have no return. Depths 0 and 65535 are invalid
    and dropped. `pixel_stride` keeps every n-th pixel of every n-th row. `depth_scale` is the number of
    metres per unit of the images. `intrinsics` is the pinhole matrix (3, 3) in pixels. `image` returns the
    full depth image of a scan. An image whose middle is far from the principal point is refused: it has
    another size than the intrinsics. `up` is the axis of the world frame of the pose files that points up;
    the frame is turned so that it becomes z.
    """

    def __init__(
        self,
        path: str | Path,
        ranges: Ranges,
        stride: int = 1,
        pixel_stride: int = 1,
        depth_scale: float = 0.001,
        up: str = "z",
    ) -> None:
        path = require_path(
            path,
            "folder",
            "frame-*.depth.png, frame-*.pose.txt and camera-intrinsics.txt",
            "Microsoft's 7-Scenes data set is published in this layout.",
        )
        super().__init__(path.name, ranges, stride)
        check_number("depth_scale", depth_scale, above=True)
        self.pixel_stride = check_whole("pixel_stride", pixel_stride, 1)
        check_choice("up", up, _UPRIGHT)
        self._upright = torch.tensor(_UPRIGHT[up], dtype=torch.float64)
        self.depth_scale = float(depth_scale)
        self._files = sorted(path.glob("frame-*.depth.png"), key=natural_key)
        if not self._files:
            raise DataError(f"{path} holds no frame-*.depth.png.")
        poses = list(path.glob("frame-*.pose.txt"))
        if len(poses) != len(self._files):
            raise DataError(
                f"{path} holds {len(self._files)} depth images, but {len(poses)} poses; each image needs one."
            )
        file = path / "camera-intrinsics.txt"
        try:
            self.intrinsics = check_intrinsics(_matrix(file, 3))
        except InvalidArgumentError as error:
            raise DataError(f"{file}: {error}") from error

    def _count(self) -> int:
        return len(self._files)

    def _read(self, index: int) -> Scan:
        points = back_project(self._depth(index), self.intrinsics, self.pixel_stride)
        return self.ranges.posed(points, self._known_pose(index))

    def image(self, index: int) -> tuple[Tensor, Tensor]:
        """Depth (H, W) in metres, 0 for invalid pixels, and pose (4, 4), world ← camera, of a scan.

        The rotation, which is rounded in the file, is made orthonormal.
        """
        position = self._position(index)
        pose = self._known_pose(position).clone()
        pose[:3, :3] = nearest_rotations(pose[:3, :3])
        return self._depth(position), pose

    def _depth(self, index: int) -> Tensor:
        """Depth (H, W) in metres, float64; 0 for invalid pixels."""
        path = self._files[index]
        depth = metric(read_png(path, str(path)), self.depth_scale)
        height, width = depth.shape
        if not is_centered(self.intrinsics, (height, width)):
            (_, _, cx), (_, _, cy), _ = self.intrinsics.tolist()
            raise DataError(
                f"{path} has {width}×{height} pixels, but camera-intrinsics.txt is for images of about "
                f"{2 * cx:.0f}×{2 * cy:.0f}: its principal point is not near the middle of the image. Scale "
                "the intrinsics, or give the images in full size."
            )
        return depth

    def _known_pose(self, index: int) -> Tensor:
        path = self._files[index]
        path = path.with_name(path.name.replace(".depth.png", ".pose.txt"))
        pose = check_pose(_matrix(path, 4), str(path))
        return torch.cat([self._upright @ pose[:3], pose[3:]])


def read_png(source: Path | IO[bytes], where: str) -> np.ndarray:
    """The pixels (H, W) of a PNG image with one channel of 16 bits. `where` begins the `DataError`s."""
    from PIL import Image

    try:
        # From memory, because Pillow asks a file for as many bytes as a damaged chunk announces.
        content = io.BytesIO(source.read_bytes()) if isinstance(source, Path) else source
        with Image.open(content, formats=("PNG",)) as image:
            if image.width * image.height > MAX_PIXELS:
                raise DataError(
                    f"{where} announces {image.width} × {image.height} pixels; at most "
                    f"{MAX_PIXELS:,} are read."
                )
            raw = np.asarray(image)
    except DataError:
        raise
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise DataError(f"{where} is not a complete PNG image: {error}") from error
    if raw.ndim != 2 or raw.dtype not in (np.uint16, np.int32):
        raise DataError(f"{where} is {raw.dtype} of shape {raw.shape}; expected one 16-bit channel.")
    return raw


def metric(raw: np.ndarray, scale: float) -> Tensor:
    """Depth (H, W) in metres, float64, of pixels in units of `scale` metres; 0 for invalid pixels."""
    valid = np.where(np.isin(raw, _INVALID), 0, raw).astype(np.float64)
    return torch.from_numpy(valid) / (1 / scale)  # exact for millimetres


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

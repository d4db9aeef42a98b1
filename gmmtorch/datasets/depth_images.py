"""Depth images with poses: folders in the layout of 7-Scenes, and sequences of the TUM RGB-D benchmark.

`frame-*.depth.png`: 16 bit, millimetres along the optical axis, or another unit, see `depth_scale`.
`frame-*.pose.txt`: 4×4 matrix camera-to-world, metres. `camera-intrinsics.txt`: 3×3 pinhole matrix in
pixels. Colours, if wanted: `frame-*.color.jpg` or `.png`, and if the images are not registered to
the depth images, `color-intrinsics.txt`, 3×3, and `color-pose.txt`, 4×4, colour camera ← depth camera.

`depth.txt`: rows `time file`. `groundtruth.txt`: rows `time x y z qx qy qz qw`. Depth images are PNG with 16
bits, in 1/5000 m; 0 is invalid. `rgb.txt`: rows `time file` of images that are registered to the depth.
"""

from __future__ import annotations

import io
from abc import abstractmethod
from collections.abc import Iterable
from pathlib import Path, PurePosixPath
from typing import IO, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gmmtorch.datasets.base import NO_POSE, Dataset, Ranges, check_poses, natural_key, require_path
from gmmtorch.datasets.point_files.channels import check_channels
from gmmtorch.datasets.trajectory import NANOSECONDS, order_of_rows, read_trajectory, to_nanoseconds
from gmmtorch.errors import DataError, InvalidArgumentError, check_choice, check_number, check_whole
from gmmtorch.pinhole import back_project, check_intrinsics, is_centered, pinhole_matrix
from gmmtorch.pose import Pose
from gmmtorch.scan import COLOUR, Scan, linear_colours

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
_COLOUR_INTRINSICS, _COLOUR_POSE = "color-intrinsics.txt", "color-pose.txt"


_MAX_COLOUR_PIXELS = 1 << 25
_BLOCK = 4  # pixels: a side of the blocks of the colour image in which points hide each other
_BEHIND = 0.05  # share of the depth by which a hidden point is behind a nearer one in its block


class ColourCamera(NamedTuple):
    """The camera of colour images. intrinsics (3, 3) in pixels; pose (4, 4), colour camera ← depth camera,
    metres; None: the images are registered to the depth images, pixel by pixel."""

    intrinsics: Tensor
    pose: Tensor | None = None

    def colours(self, points: Tensor, path: Path, depth_shape: tuple[int, int]) -> Tensor:
        """Linear RGB (N, 3) of points (N, 3) in the depth camera's frame; NaN for those that the colour
        camera does not see: outside its image, or behind others.

        path: of the image. depth_shape: rows and columns of the depth image.
        """
        image = torch.from_numpy(read_image(path, str(path), ("JPEG", "PNG"), _MAX_COLOUR_PIXELS, "RGB"))
        shape = height, width = int(image.shape[0]), int(image.shape[1])
        if shape != depth_shape and self.pose is None:
            raise DataError(
                f"{path} has {width}×{height} pixels, but the depth image {depth_shape[1]}×{depth_shape[0]}; "
                "write color-intrinsics.txt and color-pose.txt, or register the image to the depth."
            )
        if not is_centered(self.intrinsics, shape):
            raise DataError(
                f"{path} has {width}×{height} pixels, but its intrinsics are those of images of another size."
            )
        seen = points.double()
        if self.pose is not None:
            seen = seen @ self.pose[:3, :3].T + self.pose[:3, 3]
        pixel = seen @ self.intrinsics.T
        depth = pixel[:, 2]
        u, v = (pixel[:, :2] / depth.clamp_min(1e-9)[:, None]).round().long().unbind(1)
        inside = (depth > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
        u, v = u.clamp(0, width - 1), v.clamp(0, height - 1)
        if self.pose is not None:
            block = (v // _BLOCK) * -(-width // _BLOCK) + u // _BLOCK
            block = torch.where(inside, block, 0)
            nearest = depth.new_full((-(-height // _BLOCK) * -(-width // _BLOCK),), torch.inf)
            nearest.scatter_reduce_(0, block[inside], depth[inside], "amin")
            inside &= depth <= (1 + _BEHIND) * nearest[block]
        found = linear_colours(torch.arange(256) / 255)[image[v, u].long()]
        return torch.where(inside[:, None], found, torch.nan)


class _DepthDataset(Dataset):
    """Depth images in files, whose points have colours if `attributes` is ["colour"].

    pixel_stride: every n-th pixel of every n-th row is used. depth_scale: metres per unit of the images.
    intrinsics: the pinhole matrix (3, 3) in pixels.
    """

    intrinsics: Tensor
    _camera: ColourCamera

    def __init__(
        self,
        name: str,
        ranges: Ranges,
        stride: int,
        pixel_stride: int,
        depth_scale: float,
        attributes: Iterable[str],
    ) -> None:
        super().__init__(name, ranges, stride)
        self.attributes = check_channels(attributes, [COLOUR], "depth images have the channel colour only")
        self.pixel_stride = check_whole("pixel_stride", pixel_stride, 1)
        self.depth_scale = check_number("depth_scale", depth_scale, above=True)

    @abstractmethod
    def _colour_file(self, index: int) -> Path | None:
        """The colour image of a depth image; None without one."""

    def _read(self, index: int) -> Scan:
        depth, pose = self._depth(index), self._known_pose(index)
        assert pose is not None
        points, channels = back_project(depth, self.intrinsics, self.pixel_stride), {}
        path = self._colour_file(index) if self.attributes else None
        if path is not None:
            channels[COLOUR] = self._camera.colours(points, path, (depth.shape[0], depth.shape[1]))
        self._note_missing(channels, index)
        return self.ranges.posed(points, pose, channels)

    def image(self, index: int) -> tuple[Tensor, Tensor]:
        """Depth (H, W) in metres, 0 for invalid pixels, and pose (4, 4), world ← camera, of a scan."""
        position = self._position(index)
        pose = self._known_pose(position)
        assert pose is not None
        # The rotation is rounded in files.
        return self._depth(position), Pose.from_matrix(pose).orthonormal().matrix

    @abstractmethod
    def _depth(self, index: int) -> Tensor:
        """Depth (H, W) in metres, float64; 0 for invalid pixels."""


class DepthFrames(_DepthDataset):
    """Depth images as scans, in the natural order of their names (frame-2 before frame-10).

    Pixels at a distance of `max_range` metres or beyond have no return. Depths 0 and 65535 are invalid
    and dropped. An image whose middle is far from the principal point is refused: it has another size than
    the intrinsics. `up` is the axis of the world frame of the pose files that points up; the frame is turned
    so that it becomes z.
    """

    def __init__(
        self,
        path: str | Path,
        ranges: Ranges,
        stride: int = 1,
        pixel_stride: int = 1,
        depth_scale: float = 0.001,
        up: str = "z",
        attributes: Iterable[str] = (),
    ) -> None:
        path = require_path(
            path,
            "folder",
            "frame-*.depth.png, frame-*.pose.txt and camera-intrinsics.txt",
            "Microsoft's 7-Scenes data set is published in this layout.",
        )
        super().__init__(path.name, ranges, stride, pixel_stride, depth_scale, attributes)
        check_choice("up", up, _UPRIGHT)
        self._upright = torch.tensor(_UPRIGHT[up], dtype=torch.float64)
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
            self._camera = ColourCamera(self.intrinsics)
            if self.attributes and (path / _COLOUR_INTRINSICS).exists():
                file = path / _COLOUR_INTRINSICS
                pose = check_poses(_matrix(path / _COLOUR_POSE, 4), str(path / _COLOUR_POSE))
                self._camera = ColourCamera(check_intrinsics(_matrix(file, 3)), pose)
        except InvalidArgumentError as error:
            raise DataError(f"{file}: {error}") from error

    def _colour_file(self, index: int) -> Path | None:
        stem = self._files[index].name.removesuffix(".depth.png")
        files = [self._files[index].with_name(f"{stem}.color.{ending}") for ending in ("jpg", "png")]
        return next(filter(Path.is_file, files), None)

    def _depth(self, index: int) -> Tensor:
        path = self._files[index]
        depth = metric(read_png(path, str(path)), self.depth_scale)
        height, width = depth.shape
        if not is_centered(self.intrinsics, (height, width)):
            (_, _, cx), (_, _, cy), _ = self.intrinsics.tolist()
            raise DataError(
                f"{path} has {width}×{height} pixels, but camera-intrinsics.txt is for images "
                f"of about {2 * cx:.0f}×{2 * cy:.0f}: its principal point is not near the middle of the "
                "image. Scale the intrinsics, or give the images in full size."
            )
        return depth

    def _known_pose(self, index: int) -> Tensor:
        path = self._files[index].with_name(self._files[index].name.replace(".depth.png", ".pose.txt"))
        pose = check_poses(_matrix(path, 4), str(path))
        return torch.cat([self._upright @ pose[:3], pose[3:]])


def read_png(source: Path | IO[bytes], where: str) -> np.ndarray:
    """The pixels (H, W) of a PNG image with one channel of 16 bits. `where` begins the `DataError`s."""
    raw = read_image(source, where, ("PNG",), MAX_PIXELS)
    if raw.ndim != 2 or raw.dtype not in (np.uint16, np.int32):
        raise DataError(f"{where} is {raw.dtype} of shape {raw.shape}; expected one 16-bit channel.")
    return raw


def read_image(
    path: Path | IO[bytes], where: str, formats: tuple[str, ...], most_pixels: int, mode: str = ""
) -> np.ndarray:
    """The pixels (H, W, …) of an image, in one of Pillow's modes, such as "RGB", or in its own.

    Raises `DataError`, which begins with `where`, if it is damaged, of another format, or too large.
    """
    from PIL import Image

    try:
        # From memory, because Pillow asks a file for as many bytes as a damaged chunk announces.
        source = io.BytesIO(path.read_bytes()) if isinstance(path, Path) else path
        with Image.open(source, formats=formats) as image:
            if image.width * image.height > most_pixels:
                raise DataError(
                    f"{where} announces {image.width} × {image.height} pixels; at most {most_pixels:,} are "
                    "read."
                )
            return np.array(image.convert(mode) if mode else image)
    except DataError:
        raise
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise DataError(f"{where} is not a complete {' or '.join(formats)} image: {error}") from error


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


_INTRINSICS = (525.0, 525.0, 319.5, 239.5)
"""The values that the benchmark recommends: its depth images are registered with these."""


class TumRgbd(_DepthDataset):
    """Depth images as scans, in the order of their times, with poses interpolated at their times.

    Images without a pose are left out and counted. poses: another trajectory file with times; None:
    groundtruth.txt. intrinsics: fx, fy, cx, cy in pixels; None: 525, 525, 319.5, 239.5. Colours are
    those of the image in rgb.txt that is nearest in time, within 20 ms.
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
        attributes: Iterable[str] = (),
    ) -> None:
        path = require_path(
            path,
            "folder",
            "depth.txt, groundtruth.txt and depth/*.png",
            "The TUM RGB-D benchmark publishes sequences in this layout.",
        )
        super().__init__(path.resolve().name, ranges, stride, pixel_stride, depth_scale, attributes)
        self.intrinsics = pinhole_matrix(_INTRINSICS if intrinsics is None else intrinsics)
        self._camera = ColourCamera(self.intrinsics)
        times, files = _listed(path / "depth.txt")
        trajectory = read_trajectory(poses or path / "groundtruth.txt")
        if not trajectory.has_times:
            raise DataError(
                f"{poses or path / 'groundtruth.txt'} has poses without times; give a TUM trajectory."
            )
        found = trajectory.at(times, max_gap)
        self._skip(NO_POSE, *np.flatnonzero(~found.known).tolist())
        if not found.known.any():
            raise DataError(
                f"{path}: no depth image has a pose. Images are from {times[0] / NANOSECONDS:.3f} to "
                f"{times[-1] / NANOSECONDS:.3f} s, poses from {trajectory.times[0] / NANOSECONDS:.3f} to "
                f"{trajectory.times[-1] / NANOSECONDS:.3f} s."
            )
        self._files = [files[index] for index in np.flatnonzero(found.known)]
        self._poses = found.poses[found.known].matrix
        self._times = torch.from_numpy(times[found.known] / NANOSECONDS)
        self._images = _nearest(path / "rgb.txt", times[found.known]) if self.attributes else []

    def _colour_file(self, index: int) -> Path | None:
        return self._images[index]

    def _depth(self, index: int) -> Tensor:
        path = self._files[index]
        return torch.from_numpy(read_png(path, str(path)) * self.depth_scale)


_MOST_APART = 20_000_000  # ns between a depth image and its colour image


def _nearest(path: Path, times: np.ndarray) -> list[Path | None]:
    """The listed image that is nearest to each time (ns); None if none is near."""
    stamps, files = _listed(path)
    after = np.searchsorted(stamps, times).clip(1, max(1, len(stamps) - 1))
    choices = np.stack([after - 1, after.clip(max=len(stamps) - 1)])
    gaps = np.abs(stamps[choices] - times)
    best = np.where(gaps[0] <= gaps[1], choices[0], choices[1])
    return [files[i] if gap <= _MOST_APART else None for i, gap in zip(best, gaps.min(0), strict=True)]


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

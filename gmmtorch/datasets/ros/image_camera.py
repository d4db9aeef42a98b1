"""ImageCamera: depth images as points, by the CameraInfo of their camera.

K and P of a CameraInfo are those of the whole image at full resolution (REP 104): K of raw images, with lens
distortion D, and P of rectified ones.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gmmtorch.datasets.ros import sensor_messages
from gmmtorch.datasets.ros.bag_topics import DEPTH, Sensor
from gmmtorch.errors import DataError, InvalidArgumentError, check_number, check_whole
from gmmtorch.pinhole import back_project, check_intrinsics, is_centered, pinhole_matrix

_RECTIFIED = re.compile(r"(^|[/_])(rect(ified)?(?![a-z])|aligned_depth)", re.IGNORECASE)
"""Names of rectified images, such as image_rect_raw. RealSense projects aligned depth images with P."""
_REMEDY = "State the images' own: ‹intrinsics›=[fx,fy,cx,cy] in pixels, without distortion"
_PLAUSIBLE = (0.05, 200.0)  # medians of depth images in metres
_N_COEFFICIENTS = {"plumb_bob": 5, "rational_polynomial": 8, "equidistant": 4}
_ITERATIONS = 30
_STEP = 1e-6  # of differences; in units of the focal length
_CONVERGED = 1e-9
_log = logging.getLogger(__name__)


class _Model(NamedTuple):
    """The camera of images of one shape (H, W).

    intrinsics: pinhole matrix (3, 3) in pixels. rays: (H, W, 3) directions of the pixels with z = 1, zero if
    there is none; raw: (H, W) index of the pixel of the image at each pixel of a pinhole camera, H·W if there
    is none. Both None without distortion.
    """

    shape: tuple[int, ...]
    intrinsics: Tensor
    rays: Tensor | None = None
    raw: Tensor | None = None


class ImageCamera:
    """Points of the depth images of a topic.

    Args:
        sensor: the topic and its kind.
        info: decoded CameraInfo; not used if `intrinsics` is given.
        pixel_stride: every n-th pixel of every n-th row is used.
        depth_scale: metres per unit of the images; None: 0.001 for whole numbers, 1 for floating ones.
        intrinsics: fx, fy, cx, cy in pixels of images without distortion.

    Raises `InvalidArgumentError` for invalid options.
    """

    def __init__(
        self,
        sensor: Sensor,
        info: dict[str, Any] | None,
        pixel_stride: int = 1,
        depth_scale: float | None = None,
        intrinsics: list[float] | None = None,
    ) -> None:
        self._sensor = sensor
        self._info: dict[str, Any] | None = None
        self._stride = check_whole("pixel_stride", pixel_stride, 1)
        self._scale = depth_scale
        if depth_scale is not None:
            check_number("depth_scale", depth_scale, above=True)
        self._given = None if intrinsics is None else pinhole_matrix(intrinsics)
        self._model: _Model | None = None
        self._has_depth = False
        if info is not None:
            self.take(info)

    def take(self, info: dict[str, Any]) -> None:
        """Uses another CameraInfo from now on."""
        content = {  # ROS 1 has K, D and P
            name.lower(): value.tolist() if isinstance(value, np.ndarray) else value
            for name, value in info.items()
            if name != "header"
        }
        if content != self._info:
            self._info, self._model = content, None

    @property
    def is_known(self) -> bool:
        """Whether the intrinsics, or a CameraInfo, are known."""
        return self._given is not None or self._info is not None

    @property
    def intrinsics(self) -> Tensor:
        """Pinhole matrix (3, 3) in pixels of `image`, once one has been read."""
        assert self._model is not None
        return self._model.intrinsics

    def points(self, message: dict[str, Any]) -> np.ndarray:
        """Points (N, 3) of a decoded image, camera frame, metres. Raises `DataError`."""
        depth, model = self._read(message)
        if model.rays is None:
            return back_project(depth, model.intrinsics, self._stride).numpy()
        rays, kept = (x[:: self._stride, :: self._stride] for x in (model.rays, depth))
        return (rays[kept > 0] * kept[kept > 0][:, None]).numpy()

    def image(self, message: dict[str, Any]) -> Tensor:
        """Depth (H, W) in metres, 0 where it is unknown, of a decoded image. Raises `DataError`.

        An image with lens distortion is resampled to `intrinsics`: each pixel has the depth of the nearest.
        """
        depth, model = self._read(message)
        return depth if model.raw is None else torch.cat([depth.flatten(), depth.new_zeros(1)])[model.raw]

    def _read(self, message: dict[str, Any]) -> tuple[Tensor, _Model]:
        """The depth (H, W) of an image, and its camera."""
        is_raw = self._sensor.kind == DEPTH
        read = sensor_messages.depth_image if is_raw else sensor_messages.compressed_depth_image
        depth = read(message, self._scale)
        if not self._has_depth and bool((depth > 0).any()):
            self._has_depth = True
            median = float(depth[depth > 0].median())
            if not _PLAUSIBLE[0] <= median <= _PLAUSIBLE[1]:
                _log.warning(
                    "%s: the median depth is %.3g m. If that is wrong, state the metres per unit of the "
                    "images: depth_scale=0.001 for millimetres, 1 for metres.",
                    self._sensor.topic.name,
                    median,
                )
        shape = tuple(depth.shape)
        if self._model is None or self._model.shape != shape:
            self._model = self._made(shape)
        return depth, self._model

    def _made(self, shape: tuple[int, ...]) -> _Model:
        if self._given is not None:
            return _Model(shape, check_intrinsics(self._given, shape))
        try:
            assert self._info is not None
            is_rectified = bool(_RECTIFIED.search(self._sensor.topic.name))
            matrix = _scaled(_matrix(self._info, is_rectified), self._info, shape)
            distort = None if is_rectified else _distortion(self._info)
        except InvalidArgumentError as error:
            raise DataError(f"the camera info cannot be used: {error} {_REMEDY}") from error
        if distort is None:
            return _Model(shape, matrix)
        return _Model(shape, matrix, _rays(shape, matrix, distort), _raw_pixels(shape, matrix, distort))


def _matrix(info: dict[str, Any], is_rectified: bool) -> Tensor:
    """The pinhole matrix (3, 3) of the whole images at full resolution."""
    k, p = np.array(info["k"]).reshape(3, 3), np.array(info["p"]).reshape(3, 4)[:, :3]
    is_distorted = bool(np.any(info["d"]))
    if is_rectified and not p.any() and is_distorted:
        raise InvalidArgumentError("P, which describes rectified images, is zero.")
    matrix = torch.tensor(p if is_rectified and p.any() else k, dtype=torch.float64)
    matrix[2, 2] = 1  # some drivers scale all nine numbers
    check_intrinsics(matrix)
    if not is_rectified and not is_distorted and p.any() and np.abs(p - k)[:2].max() > 1:
        _log.warning(
            "K %s is used, not P %s, because the topic's name does not contain rect. If the images are "
            "rectified, state P: intrinsics=[%g,%g,%g,%g].",
            *(k.tolist(), p.tolist(), p[0, 0], p[1, 1], p[0, 2], p[1, 2]),
        )
    return matrix


def _scaled(matrix: Tensor, info: dict[str, Any], shape: tuple[int, ...]) -> Tensor:
    """The pinhole matrix (3, 3) of images of a shape (H, W), by region of interest, binning and size."""
    size = np.array([shape[1], shape[0]])
    full = np.array([info["width"], info["height"]])
    binning = np.array([max(1, info["binning_x"]), max(1, info["binning_y"])])
    region = {name: int(info["roi"][name]) for name in ("x_offset", "y_offset", "width", "height")}
    corner = np.array([region["x_offset"], region["y_offset"]])
    window = np.array([region["width"], region["height"]])
    is_whole = not (corner.any() or window.any())
    if not full.all():
        full = size * binning if is_whole else corner + window
    window = full if is_whole else window
    text = (
        f"camera info is for {full[0]}×{full[1]} pixels, region of interest {window[0]}×{window[1]} at "
        f"{corner.tolist()}, binning {binning.tolist()}; the image has {size[0]}×{size[1]} pixels."
    )
    if not window.all() or (corner + window > full).any():
        raise InvalidArgumentError(text)
    if not is_centered(matrix, (full[1], full[0])):
        raise InvalidArgumentError(
            f"the principal point ({matrix[0, 2]:g}, {matrix[1, 2]:g}) is not near the middle; {text}"
        )
    scale = 1 / binning
    if not _is_binned(size, window, binning):
        factors = np.full(2, max(2, round(full[0] / size[0])))
        is_smaller = size[0] * full[1] == size[1] * full[0] or _is_binned(size, full, factors)
        if not is_whole or (binning > 1).any() or not is_smaller:
            raise InvalidArgumentError(text)
        scale = size / full
        _log.warning("the intrinsics are scaled to the image, because the %s", text)
    scaled = matrix.clone()
    scaled[:2, 2] -= torch.from_numpy(corner)
    scaled[:2] *= torch.from_numpy(scale)[:, None]
    return check_intrinsics(scaled, shape)


def _is_binned(size: np.ndarray, full: np.ndarray, factors: np.ndarray) -> bool:
    """Whether an image of a size (W, H) is one of size `full` with binning, rounded up or down."""
    return bool(((size == full // factors) | (size == -(-full // factors))).all())


Distortion = Callable[[np.ndarray], np.ndarray]
"""Where a lens images directions (2, N) x / z, y / z, in units of the focal length."""


def _distortion(info: dict[str, Any]) -> Distortion | None:
    """The distortion of a CameraInfo; None without one. Raises `InvalidArgumentError` for unknown models."""
    model, d = str(info["distortion_model"]), np.asarray(info["d"], np.float64)
    if not d.any():
        return None
    n_known = _N_COEFFICIENTS.get(model, 0)
    if d[n_known:].any() or not np.isfinite(d).all():
        raise InvalidArgumentError(
            f"distortion_model {model!r} with D={d.tolist()} is not known; known are plumb_bob with 5 "
            "numbers, rational_polynomial with 8, and equidistant with 4."
        )
    c = np.pad(d[:n_known], (0, max(0, 8 - len(d[:n_known]))))

    def equidistant(at: np.ndarray) -> np.ndarray:
        radius = np.linalg.norm(at, axis=0)
        angle = np.arctan(radius)
        powers = 1 + sum(c[i] * angle ** (2 * i + 2) for i in range(4))
        return at * np.divide(angle * powers, radius, out=np.ones_like(radius), where=radius > 0)

    def rational(at: np.ndarray) -> np.ndarray:
        x, y = at
        r2, xy = x * x + y * y, 2 * x * y
        k = (1 + r2 * (c[0] + r2 * (c[1] + r2 * c[4]))) / (1 + r2 * (c[5] + r2 * (c[6] + r2 * c[7])))
        shift = [c[2] * xy + c[3] * (r2 + 2 * x * x), c[2] * (r2 + 2 * y * y) + c[3] * xy]
        return at * k + np.stack(shift)

    return equidistant if model == "equidistant" else rational


def _directions(shape: tuple[int, ...], matrix: Tensor) -> np.ndarray:
    """x / z and y / z (2, H·W) of the pixels of a pinhole camera."""
    height, width = shape
    (fx, _, cx), (_, fy, cy), _ = matrix.tolist()
    v, u = np.divmod(np.arange(height * width), width)
    return np.stack([(u - cx) / fx, (v - cy) / fy])


def _rays(shape: tuple[int, ...], matrix: Tensor, distort: Distortion) -> Tensor:
    """Directions (H, W, 3) that are imaged at the pixels, by Newton's method; zero where there is none."""
    target = _directions(shape, matrix)
    found, shift = target.copy(), np.eye(2)[:, :, None] * _STEP
    with np.errstate(all="ignore"):  # a pixel that no direction reaches
        for _ in range(_ITERATIONS):
            error = distort(found) - target
            (xx, yx), (xy, yy) = ((distort(found + s) - distort(found - s)) / (2 * _STEP) for s in shift)
            det = xx * yy - xy * yx
            is_unfolded = (det > 0) & (xx + yy > 0)
            is_found = (np.abs(error).max(0) < _CONVERGED) & is_unfolded
            if is_found.all():
                break
            found -= np.stack([yy * error[0] - xy * error[1], xx * error[1] - yx * error[0]]) / det
    rays = np.where(is_found, np.stack([*found, np.ones_like(det)]), 0)
    return torch.from_numpy(rays.T.reshape(*shape, 3).copy())


def _raw_pixels(shape: tuple[int, ...], matrix: Tensor, distort: Distortion) -> Tensor:
    """The pixel (H, W) of the distorted image at each pixel of a pinhole camera; H·W if there is none."""
    height, width = shape
    (fx, _, cx), (_, fy, cy), _ = matrix.tolist()
    at = distort(_directions(shape, matrix))
    u, v = np.round(at[0] * fx + cx), np.round(at[1] * fy + cy)
    is_inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    index = np.where(is_inside, v * width + u, height * width).astype(np.int64)
    return torch.from_numpy(index.reshape(height, width))

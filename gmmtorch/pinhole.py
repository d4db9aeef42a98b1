"""The pinhole camera: checks of intrinsics, depth images in metres, and their points.

Camera frame: x right, y down, z forward, metres.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike, as_tensor, is_floating
from gmmtorch.errors import InvalidArgumentError, check_number

_LARGEST_OFFSET = 0.2  # of the principal point from the middle, share of the width or height
_LARGEST_SKEW = 1e-3  # share of the focal length
_LEAST_MARGIN = 64  # pixels; small images are crops


def metric_depth(depth: ArrayLike, depth_scale: float | None = None) -> Tensor:
    """A depth image (H, W) in metres, float32 or float64.

    `depth_scale`: metres per unit of the image (0.001 for millimetres). None: the image is in metres and
    has a floating type.

    Raises `InvalidArgumentError` for another shape, and for integers without `depth_scale`, because they are
    usually millimetres.
    """
    image = as_tensor(depth, "depth")
    if image.ndim != 2 or 0 in image.shape:
        raise InvalidArgumentError(
            f"depth has shape {tuple(image.shape)}; expected one image (H, W) of at least one pixel."
        )
    if depth_scale is not None:
        check_number("depth_scale", depth_scale, above=True)
        return image * float(depth_scale)
    if not is_floating(depth):
        raise InvalidArgumentError(
            f"depth is an image of whole numbers ({getattr(depth, 'dtype', type(depth).__name__)}); give "
            "depth_scale, its metres per unit: 0.001 for millimetres, 0.0002 for the TUM data set."
        )
    return image


def pinhole_matrix(values: Sequence[float]) -> Tensor:
    """The pinhole matrix (3, 3) of fx, fy, cx, cy in pixels. Raises `InvalidArgumentError`."""
    try:
        fx, fy, cx, cy = (float(value) for value in values)
        return check_intrinsics([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    except (TypeError, ValueError) as error:
        raise InvalidArgumentError(f"‹intrinsics›={values} must be fx, fy, cx, cy in pixels.") from error


def is_centered(intrinsics: Tensor, shape: tuple[int, int]) -> bool:
    """Whether the principal point is as near to the middle of an image (H, W) as in one that is not cropped.

    If it is not, the matrix (3, 3) is usually that of images of another size.
    """
    middles = ((float(c) + 0.5 - n / 2, n) for c, n in zip(intrinsics[:2, 2], shape[::-1], strict=True))
    return all(abs(offset) <= max(_LARGEST_OFFSET * n, 2) for offset, n in middles)


def check_intrinsics(intrinsics: ArrayLike, shape: tuple[int, ...] | None = None) -> Tensor:
    """A pinhole matrix (3, 3), [[f_x, 0, c_x], [0, f_y, c_y], [0, 0, 1]] in pixels, as float64.

    `shape`: (H, W) of the image, if known. Its principal point can lie outside, because images are cropped,
    but not farther than one width or height.

    Raises `InvalidArgumentError` for another matrix, such as a transposed one.
    """
    matrix = as_tensor(intrinsics, "intrinsics", torch.float64).detach()
    rows = matrix.tolist() if tuple(matrix.shape) == (3, 3) else []
    if not rows or not all(math.isfinite(value) for row in rows for value in row):
        raise InvalidArgumentError(
            f"intrinsics has shape {tuple(matrix.shape)}; expected a finite 3×3 pinhole matrix in pixels."
        )
    (fx, skew, cx), (turn, fy, cy), last = rows
    if last != [0, 0, 1]:
        hint = " It looks transposed." if (cx, cy) == (0, 0) else ""
        raise _wrong(matrix, f"its last row must be 0 0 1.{hint}")
    if not (fx > 0 and fy > 0):
        raise _wrong(matrix, "its focal lengths must be above zero.")
    if turn != 0 or abs(skew) > _LARGEST_SKEW * fx:
        raise _wrong(matrix, "it has skew; undistort the image first.")
    if shape is not None:
        height, width = shape
        margin_x, margin_y = max(width, _LEAST_MARGIN), max(height, _LEAST_MARGIN)
        if not (-margin_x <= cx <= width + margin_x and -margin_y <= cy <= height + margin_y):
            raise _wrong(
                matrix,
                f"its principal point is far outside the image of {width}×{height} pixels; scale the matrix "
                "to the size of the image.",
            )
    return matrix


def _wrong(matrix: Tensor, reason: str) -> InvalidArgumentError:
    return InvalidArgumentError(
        f"intrinsics={matrix.tolist()} is not the matrix [[f_x, 0, c_x], [0, f_y, c_y], [0, 0, 1]]: {reason}"
    )


def back_project(depth: Tensor, intrinsics: Tensor, pixel_stride: int = 1) -> Tensor:
    """Camera-frame points (N, 3) of the valid pixels of a depth image (H, W), metres, row by row.

    x = (u − c_x) d / f_x, y = (v − c_y) d / f_y, z = d. Pixels with depth 0 or NaN are omitted. Only every
    `pixel_stride`-th pixel of every `pixel_stride`-th row is used.
    """
    depth = depth[::pixel_stride, ::pixel_stride]
    v, u = torch.meshgrid(
        *(torch.arange(n, dtype=depth.dtype, device=depth.device) * pixel_stride for n in depth.shape),
        indexing="ij",
    )
    x = (u - intrinsics[0, 2]) / intrinsics[0, 0]
    y = (v - intrinsics[1, 2]) / intrinsics[1, 1]
    return torch.stack([x * depth, y * depth, depth], -1)[depth > 0]

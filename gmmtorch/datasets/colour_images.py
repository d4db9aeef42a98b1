"""Colours of the points of depth images, from images of a colour camera beside the depth camera."""

from __future__ import annotations

import io
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import DataError
from gmmtorch.pinhole import is_centered
from gmmtorch.scan import linear_colours

_MAX_PIXELS = 1 << 25
_BLOCK = 4  # pixels: a side of the blocks of the colour image in which points hide each other
_BEHIND = 0.05  # share of the depth by which a hidden point is behind a nearer one in its block


def read_image(path: Path) -> Tensor:
    """sRGB (H, W, 3), uint8, of a JPEG or PNG image. Raises `DataError` if it is damaged or too large."""
    from PIL import Image

    try:
        with Image.open(io.BytesIO(path.read_bytes()), formats=("JPEG", "PNG")) as image:
            if image.width * image.height > _MAX_PIXELS:
                raise DataError(
                    f"{path} announces {image.width} × {image.height} pixels, more than {_MAX_PIXELS:,}."
                )
            return torch.from_numpy(np.array(image.convert("RGB")))
    except DataError:
        raise
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise DataError(f"{path} is not a complete JPEG or PNG image: {error}") from error


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
        image = read_image(path)
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

"""Writes 2D maps for ROS map_server and Nav2: a grey image, and a YAML file that describes it.

A pixel of value x encodes the occupancy probability p = (255 − x)/255. A cell is occupied if p is
above `occupied_thresh`, free if p is below `free_thresh`, and unknown otherwise. `origin` is the lower
left corner of the image. The first image row is the top of the map (highest y).
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.files import write_bytes
from gmmtorch.occupancy import Thresholds, VoxelGrid


def highest_in_band(
    grid: VoxelGrid, probability: Tensor, z_min: float = -math.inf, z_max: float = math.inf
) -> tuple[VoxelGrid, Tensor]:
    """Projects a 3D map to a 2D grid and probability (n_x, n_y): the highest θ of each column in the band.

    The band is z_min ≤ z ≤ z_max (m).
    A cell counts if it overlaps the band, so a column is free only if all its cells in the band are free.
    Raises `InvalidArgumentError` for a map that is not 3D, and for a band without cells.
    """
    if grid.dim != 3 or tuple(probability.shape) != grid.shape:
        raise InvalidArgumentError(
            f"probability has shape {tuple(probability.shape)} on a grid of {grid.shape}; a band needs a 3D "
            "map."
        )
    low = grid.origin[2] + grid.resolution * torch.arange(grid.shape[2], dtype=torch.float64)
    meets = (low <= z_max) & (low + grid.resolution > z_min)
    if not bool(meets.any()):
        raise InvalidArgumentError(
            f"z_min={z_min}, z_max={z_max} contains no cell of the map, which reaches from "
            f"{grid.origin[2]:.6g} to {float(low[-1]) + grid.resolution:.6g} m."
        )
    flat = VoxelGrid(grid.origin[:2], grid.resolution, grid.shape[:2])
    return flat, probability[..., meets.to(probability.device)].amax(2)


def write_map_server(
    path: str | Path, grid: VoxelGrid, probability: Tensor, thresholds: Thresholds | None = None
) -> tuple[Path, Path]:
    """Writes a 2D map as PATH.yaml and PATH.pgm, each atomically, and returns both paths.

    Probabilities (n_x, n_y) are rounded to multiples of 1/255 such that no cell changes its class.
    """
    rule = thresholds or Thresholds()
    if grid.dim != 2 or tuple(probability.shape) != grid.shape:
        raise InvalidArgumentError(
            f"probability has shape {tuple(probability.shape)} on a grid of {grid.shape}; an image needs a "
            "2D map: see highest_in_band."
        )
    theta = probability.detach().cpu().double()
    if not bool(((theta >= 0) & (theta <= 1)).all()):
        raise InvalidArgumentError("probability holds values outside [0, 1], or NaN; give occupancies.")
    path = Path(path)
    stem = path.with_suffix("") if path.suffix in (".yaml", ".pgm") else path
    image, description = stem.with_name(stem.name + ".pgm"), stem.with_name(stem.name + ".yaml")
    width, height = grid.shape
    # Image rows run along −y and columns along x.
    rows = np.ascontiguousarray(_pixels(theta, rule).T.flip(0).numpy())
    write_bytes(image, f"P5\n{width} {height}\n255\n".encode("ascii") + rows.tobytes())
    lines = [
        f'image: "{_escaped(image.name)}"',
        "mode: trinary",
        f"resolution: {_number(grid.resolution)}",
        f"origin: [{_number(grid.origin[0])}, {_number(grid.origin[1])}, 0.0]",
        "negate: 0",
        f"occupied_thresh: {_number(rule.occupied)}",
        f"free_thresh: {_number(rule.free)}\n",
    ]
    write_bytes(description, "\n".join(lines).encode())
    return description, image


def _pixels(theta: Tensor, rule: Thresholds) -> Tensor:
    """Grey values (uint8): the nearest, or the second nearest if the nearest would change the class."""
    shade = 255 * (1 - theta)
    nearest = shade.round()
    other = torch.where(nearest > shade, nearest - 1, nearest + 1).clamp(0, 255)
    wanted = rule.classify(theta)
    is_wrong = rule.classify((255 - nearest) / 255) != wanted
    is_right = rule.classify((255 - other) / 255) == wanted
    return torch.where(is_wrong & is_right, other, nearest).to(torch.uint8)


def _number(value: float) -> str:
    """A number in a form that every YAML reader accepts; YAML 1.1 reads 1e-05 as text."""
    mantissa, e, exponent = repr(float(value)).partition("e")
    return f"{mantissa}{'' if '.' in mantissa or not e else '.0'}{e}{exponent}"


def _escaped(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"')

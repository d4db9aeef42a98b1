"""Maps as ROS's map_server and Nav2 keep them: a grey image, and a YAML file that says what it means.

A pixel x of the image stands for p = (255 − x)/255, or x/255 if `negate` is set; p above
`occupied_thresh` is occupied, below `free_thresh` free, else unknown. `origin` is the lower-left
corner of the image, whose first row is the top of the map.
"""

from __future__ import annotations

import math
import reprlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import DataError, InvalidArgumentError, MemoryLimitError, MissingDataError
from gmmtorch.files import write_bytes
from gmmtorch.occupancy.evidence import Thresholds
from gmmtorch.occupancy.grid import BYTES_PER_CELL, MEMORY_LIMIT, VoxelGrid

_MAX_YAML_BYTES = 1 << 14
_IMAGE_FORMATS = ("PPM", "PNG", "BMP")
_MODES = ("trinary", "scale")


class MapImage(NamedTuple):
    """A 2D grid, the probability of each of its cells (n_x, n_y), and which are called what."""

    grid: VoxelGrid
    probability: Tensor
    thresholds: Thresholds

    def classify(self) -> Tensor:
        """`CellClass` values (n_x, n_y), as map_server in its trinary mode publishes them."""
        return self.thresholds.classify(self.probability)


def highest_in_band(
    grid: VoxelGrid, probability: Tensor, z_min: float = -math.inf, z_max: float = math.inf
) -> tuple[VoxelGrid, Tensor]:
    """A 3D map as a 2D one: of each column, the highest θ of its cells that meet z_min ≤ z ≤ z_max (m).

    So a column is free only if all of it in the band is. Raises `InvalidArgumentError` for a band
    that meets no cell.
    """
    if grid.dim != 3 or tuple(probability.shape) != grid.shape:
        raise InvalidArgumentError(
            f"probability has shape {tuple(probability.shape)} on a grid of {grid.shape}; a band is cut out "
            "of a 3D map."
        )
    low = grid.origin[2] + grid.resolution * torch.arange(grid.shape[2], dtype=torch.float64)
    meets = (low <= z_max) & (low + grid.resolution > z_min)
    if not bool(meets.any()):
        raise InvalidArgumentError(
            f"z_min={z_min}, z_max={z_max} meets no cell of the map, which reaches from "
            f"{grid.origin[2]:.6g} to {float(low[-1]) + grid.resolution:.6g} m."
        )
    flat = VoxelGrid(grid.origin[:2], grid.resolution, grid.shape[:2])
    return flat, probability[..., meets.to(probability.device)].amax(2)


def write_map_server(
    path: str | Path, grid: VoxelGrid, probability: Tensor, thresholds: Thresholds | None = None
) -> tuple[Path, Path]:
    """Write a 2D map as PATH.yaml and, beside it, PATH.pgm, each atomically; returns both paths.

    Probabilities (n_x, n_y) are kept to 1/255, rounded so that none changes its class.
    """
    rule = thresholds or Thresholds()
    if grid.dim != 2 or tuple(probability.shape) != grid.shape:
        raise InvalidArgumentError(
            f"probability has shape {tuple(probability.shape)} on a grid of {grid.shape}; an image is of a "
            "2D map: see highest_in_band."
        )
    theta = probability.detach().cpu().double()
    if not bool(((theta >= 0) & (theta <= 1)).all()):
        raise InvalidArgumentError("probability holds values outside [0, 1], or NaN; give occupancies.")
    path = Path(path)
    stem = path.with_suffix("") if path.suffix in (".yaml", ".pgm") else path
    image, about = stem.with_name(stem.name + ".pgm"), stem.with_name(stem.name + ".yaml")
    width, height = grid.shape
    # Image rows run downwards, columns to the right: the transpose of x, y, upside down.
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
    write_bytes(about, "\n".join(lines).encode())
    return about, image


def _pixels(theta: Tensor, rule: Thresholds) -> Tensor:
    """Grey values (uint8): the nearest, or where that has another class, its neighbour across θ."""
    shade = 255 * (1 - theta)
    nearest = shade.round()
    other = torch.where(nearest > shade, nearest - 1, nearest + 1).clamp(0, 255)
    wanted = rule.classify(theta)
    strays = rule.classify((255 - nearest) / 255) != wanted
    mends = rule.classify((255 - other) / 255) == wanted
    return torch.where(strays & mends, other, nearest).to(torch.uint8)


def _number(value: float) -> str:
    """A number that every YAML reader takes for one, which 1e-05 is not."""
    mantissa, e, exponent = repr(float(value)).partition("e")
    return f"{mantissa}{'' if '.' in mantissa or not e else '.0'}{e}{exponent}"


def _escaped(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"')


def read_map_server(path: str | Path, memory_limit: int = MEMORY_LIMIT) -> MapImage:
    """Read a map_server YAML file and its image (PGM, PNG or BMP; colours are averaged).

    Transparent pixels are unknown, ½. Raises `MissingDataError` if one of the two is not there,
    `MemoryLimitError` for an image of more cells than the limit allows, and `DataError` if either is
    damaged, the map is turned (yaw), or its mode is one whose pixels are no probabilities.
    """
    path = Path(path)
    facts = _facts(path)
    shade, opaque = _shades(_image_path(path, facts), memory_limit)
    negated = _flag(path, facts)
    theta = shade / 255 if negated else (255 - shade) / 255
    theta = np.where(opaque, theta, 0.5)
    probability = torch.from_numpy(theta[::-1].T.copy())
    mode = facts.get("mode", "trinary")
    if mode not in _MODES:
        raise DataError(f"{path}: mode={_short(mode)} is not one of {', '.join(_MODES)}, whose pixels say p.")
    corner = facts.get("origin")
    if not isinstance(corner, list) or len(corner) not in (2, 3):
        raise DataError(f"{path}: origin={_short(corner)} is not [x, y, yaw].")
    x, y, yaw = (_float(path, "origin", value) for value in [*corner, 0.0][:3])
    if yaw != 0:
        raise DataError(f"{path}: origin has yaw={yaw}; a turned map cannot be read. Turn the image, set 0.")
    try:
        grid = VoxelGrid((x, y), _float(path, "resolution", facts.get("resolution")), probability.shape)
        free, occupied = (_float(path, name, facts.get(name)) for name in ("free_thresh", "occupied_thresh"))
        return MapImage(grid, probability, Thresholds(free, occupied))
    except InvalidArgumentError as error:
        raise DataError(f"{path}: {error}") from error


def _facts(path: Path) -> dict[str, Any]:
    """What the YAML file says."""
    import yaml

    if not path.is_file():
        raise MissingDataError(f"{path} does not exist; expected a map_server YAML file.")
    if path.stat().st_size > _MAX_YAML_BYTES:
        raise DataError(f"{path} has more than {_MAX_YAML_BYTES:,} bytes; it is no map_server YAML file.")
    try:
        facts = yaml.safe_load(path.read_bytes())
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise DataError(f"{path} is not YAML: {reason}") from error
    if not isinstance(facts, dict):
        raise DataError(f"{path} holds no table of image, resolution, origin, …; it is no map_server file.")
    return facts


def _image_path(path: Path, facts: dict[str, Any]) -> Path:
    name = facts.get("image")
    if not isinstance(name, str) or not name or "\0" in name:
        raise DataError(f"{path} names no image.")
    image = path.parent / name  # an absolute name stays what it is
    if not image.is_file():
        raise MissingDataError(f"{image} does not exist; {path} says that the map's image is there.")
    return image


def _shades(path: Path, memory_limit: int) -> tuple[np.ndarray, np.ndarray]:
    """Grey values (rows, columns), float64, and which pixels are opaque."""
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path, formats=_IMAGE_FORMATS) as image:
            n_bytes = math.prod(image.size) * BYTES_PER_CELL
            if n_bytes > memory_limit:
                raise MemoryLimitError(
                    f"{path} has {' × '.join(map(str, image.size))} pixels, whose evidence takes {n_bytes:,} "
                    f"bytes, above the limit of {memory_limit:,}."
                )
            if image.mode not in ("1", "L", "LA", "P", "RGB", "RGBA"):
                raise DataError(f"{path} has {image.mode} pixels; a map has 8 bits a channel.")
            if image.mode in ("1", "L"):
                shade = np.asarray(image.convert("L"), dtype=np.float64)
                return shade, np.ones_like(shade, dtype=bool)
            channels = np.asarray(image.convert("RGBA"), dtype=np.float64)
    except (UnidentifiedImageError, OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        if isinstance(error, DataError):
            raise
        raise DataError(f"{path} is damaged, or no image of {', '.join(_IMAGE_FORMATS)}: {error}") from error
    return channels[..., :3].mean(2), channels[..., 3] == 255


def _flag(path: Path, facts: dict[str, Any]) -> bool:
    value = facts.get("negate", 0)
    if value not in (0, 1):
        raise DataError(f"{path}: negate={_short(value)} must be 0 or 1.")
    return bool(value)


def _float(path: Path, name: str, value: Any) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise DataError(f"{path}: {name}={_short(value)} is not a number.") from error
    if not math.isfinite(number):
        raise DataError(f"{path}: {name}={number} is not finite.")
    return number


def _short(value: Any) -> str:
    """A value for a message: a few lines of YAML can stand for more than fits the memory."""
    brief = reprlib.Repr()
    brief.maxlevel = 1
    try:
        return brief.repr(value)
    except ValueError:  # a whole number of thousands of digits
        return f"a {type(value).__name__}"

"""Pictures of a map, asked point by point: whatever answers occupancy queries can be drawn."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.occupancy.grid import check_resolution
from gmmtorch.scan import ArrayLike

MAX_PIXELS = 2000
"""Cells asked along either side of a picture; what is drawn has no more pixels than the figure."""

MAX_QUERIES = 4_000_000
"""Cells asked for one view of heights."""

_QUERIES_AT_ONCE = 1 << 18
_UNKNOWN_BAND = 0.02  # of θ around ½
_SLACK = 1e-3  # of a cell: corners in float32 are the planes of cells that they were meant to be


@dataclass(frozen=True)
class MapPanel:
    """One map, and the region of it to show.

    Attributes:
        title: what stands above the picture, such as the method's name.
        occupancy: probability (M,) of the points (M, D), float64 world metres; exactly ½ is unknown.
        resolution: side (m) of a cell: one pixel, where the region is not too large for that.
        low, high: (D,) corners of the region, world metres; D = 2 or 3.

    Raises `InvalidArgumentError` for corners that span no region.
    """

    title: str
    occupancy: Callable[[Tensor], Any]
    resolution: float
    low: tuple[float, ...]
    high: tuple[float, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "resolution", check_resolution(self.resolution))
        for name in ("low", "high"):
            corner = _corner(getattr(self, name))
            object.__setattr__(self, name, corner)
        sound = len(self.low) == len(self.high) and len(self.low) in (2, 3)
        if not sound or not all(
            -math.inf < a < b < math.inf for a, b in zip(self.low, self.high, strict=True)
        ):
            raise InvalidArgumentError(
                f"low={self.low}, high={self.high} span no region; give two corners of 2 or 3 finite "
                "coordinates (m), low below high."
            )

    @property
    def dim(self) -> int:
        return len(self.low)


def busiest_regions(
    points: ArrayLike, n: int, side: float | None = None
) -> list[tuple[tuple[float, ...], tuple[float, ...]]]:
    """Corners of `n` squares of the plane that hold the most surface, none beside another; fewer at times.

    Surface is counted in hundredths of the side: points on one another count once.

    Args:
        points: (N, 2), world metres.
        n: how many.
        side: of the squares (m); a tenth of the longer side of the cloud if not given.
    """
    cloud = torch.as_tensor(points).detach().cpu().double()
    cloud = cloud[torch.isfinite(cloud).all(1)]
    if n < 1 or len(cloud) == 0:
        return []
    if side is None:
        side = max(float((cloud.amax(0) - cloud.amin(0)).max()) / 10, 1e-3)
    fine = torch.unique((cloud / (side / 100)).floor(), dim=0)
    tiles, count = torch.unique((fine / 100).floor(), dim=0, return_counts=True)
    chosen: list[Tensor] = []
    for tile in tiles[count.argsort(descending=True, stable=True)]:
        if len(chosen) < n and all(float((tile - other).abs().max()) > 1 for other in chosen):
            chosen.append(tile)
    return [(_corner((t * side).numpy()), _corner(((t + 1) * side).numpy())) for t in chosen]


def robust_bounds(
    points: ArrayLike, trajectory: ArrayLike | None = None, share: float = 0.99, margin: float = 1.0
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Corners (D,), (D,) of the box that holds `share` of the points (N, D) along each axis, and the
    whole trajectory (S, D), with `margin` metres around; the unit box where there is nothing.

    A few stray returns far away thus do not shrink the map to a corner of the picture.
    """
    cloud = torch.as_tensor(points).detach().cpu().double()
    cloud = cloud[torch.isfinite(cloud).all(1)]
    if not 0 < share <= 1:
        raise InvalidArgumentError(f"share={share} must lie in (0, 1].")
    dim = cloud.shape[1]
    lows, highs = [], []
    if len(cloud):
        ends = np.quantile(cloud.numpy(), [(1 - share) / 2, (1 + share) / 2], axis=0)
        lows.append(ends[0])
        highs.append(ends[1])
    if trajectory is not None and len(trajectory):
        path = torch.as_tensor(trajectory).detach().cpu().double().numpy()
        lows.append(path.min(0))
        highs.append(path.max(0))
    if not lows:
        return (-1.0,) * dim, (1.0,) * dim
    pad = max(margin, 1e-3)
    return _corner(np.min(lows, 0) - pad), _corner(np.max(highs, 0) + pad)


class Raster(NamedTuple):
    """Pixels in the plane: centres x (W,) and y (H,), side of a pixel, and (left, right, bottom, top)."""

    x: Tensor
    y: Tensor
    spacing: float
    extent: tuple[float, float, float, float]


def plan(panel: MapPanel, max_pixels: int = MAX_PIXELS) -> Raster:
    """Pixels that lie on the lattice of cells; where there would be too many, every n-th cell is asked."""
    cell = panel.resolution
    first = [math.floor(panel.low[axis] / cell + _SLACK) for axis in range(2)]
    last = [math.ceil(panel.high[axis] / cell - _SLACK) for axis in range(2)]
    factor = max(1, math.ceil(max(b - a for a, b in zip(first, last, strict=True)) / max(max_pixels, 1)))
    centres, extent = [], []
    for a, b in zip(first, last, strict=True):
        n = max(1, math.ceil((b - a) / factor))
        # The middle cell of the pixel, never a boundary between cells.
        centres.append((a + torch.arange(n, dtype=torch.float64) * factor + factor // 2 + 0.5) * cell)
        extent += [a * cell, (a + n * factor) * cell]
    left, right, bottom, top = extent
    return Raster(centres[0], centres[1], cell * factor, (left, right, bottom, top))


def slice_image(
    panel: MapPanel, height: float = 0.0, max_pixels: int = MAX_PIXELS, shown_pixels: int | None = None
) -> tuple[np.ndarray, Raster]:
    """Occupancy (H, W) of the plane, in 3D of the cells at `height` (m); NaN where it is unknown: ½, to 0.02.

    With `shown_pixels` the image is shrunk to about that many pixels along its longer side. Each
    takes its highest occupancy where that is above ½, so that thin walls stay visible; else the
    mean of what is known, or unknown where most is.
    """
    raster = plan(panel, max_pixels)
    theta = _ask(panel, _plane(raster, panel.dim, height)).reshape(len(raster.y), len(raster.x))
    image = np.where(_is_unknown(theta), np.nan, theta)
    factor = 1 if shown_pixels is None else round(max(image.shape) / max(shown_pixels, 1))
    return _shrunk(image, raster, factor) if factor > 1 else (image, raster)


def _is_unknown(theta: np.ndarray) -> np.ndarray:
    """Where nothing to speak of is known: the last traces of a component's tails are no evidence to show."""
    return np.abs(theta - 0.5) < _UNKNOWN_BAND


def _shrunk(image: np.ndarray, raster: Raster, factor: int) -> tuple[np.ndarray, Raster]:
    """One pixel for each factor × factor pixels, as `slice_image` says."""
    rows, columns = (-(-n // factor) for n in image.shape)
    padded = np.full((rows * factor, columns * factor), np.nan)
    padded[: image.shape[0], : image.shape[1]] = image
    tiles = padded.reshape(rows, factor, columns, factor)
    n_known = np.isfinite(tiles).sum((1, 3))
    highest = np.where(np.isnan(tiles), 0.0, tiles).max((1, 3))
    mean = np.nansum(tiles, axis=(1, 3)) / np.maximum(n_known, 1)
    pooled = np.where(highest > 0.5, highest, np.where(2 * n_known < factor**2, np.nan, mean))
    side = raster.spacing * factor
    left, _, bottom, _ = raster.extent
    middle = (factor - 1) / 2 * raster.spacing
    x, y = raster.x[::factor] + middle, raster.y[::factor] + middle
    extent = (left, left + columns * side, bottom, bottom + rows * side)
    return pooled, Raster(x, y, side, extent)


def height_image(
    panel: MapPanel, occupied_above: float, max_pixels: int = MAX_PIXELS, max_queries: int = MAX_QUERIES
) -> tuple[np.ndarray, Raster]:
    """Height (m) of the highest known cell of each column with θ > `occupied_above`, (H, W); its raster.

    NaN in columns without one. Levels are asked from the top down, and only in the columns that
    are still open. Where that could take more than `max_queries` queries, pixels grow.
    """
    cell = panel.resolution
    levels = torch.arange(math.floor(panel.low[2] / cell + _SLACK), math.ceil(panel.high[2] / cell - _SLACK))
    levels = levels.double().add(0.5).mul(cell).flip(0)
    side = max(panel.high[a] - panel.low[a] for a in range(2)) / cell
    area = math.prod(panel.high[a] - panel.low[a] for a in range(2)) / cell**2
    affordable = side * math.sqrt(max_queries / max(area * len(levels), 1))
    raster = plan(panel, max(1, min(max_pixels, int(affordable))))
    columns = _plane(raster, 3, 0.0)
    heights = np.full(len(columns), np.nan)
    for level in levels.tolist():
        still_open = np.isnan(heights).nonzero()[0]
        if len(still_open) == 0:
            break
        points = columns[torch.from_numpy(still_open)]
        points[:, 2] = level
        theta = _ask(panel, points)
        heights[still_open[(theta > occupied_above) & ~_is_unknown(theta)]] = level
    return heights.reshape(len(raster.y), len(raster.x)), raster


def roof_above(panel: MapPanel, path: np.ndarray, occupied_above: float, headroom: float = 0.5) -> bool:
    """Whether most of the path (S, 3) has something occupied more than `headroom` metres above it."""
    levels = torch.arange(float(path[:, 2].min()) + headroom, panel.high[2], panel.resolution).double()
    if len(levels) == 0:
        return False
    stops = torch.from_numpy(path)[torch.linspace(0, len(path) - 1, min(len(path), 200)).long()]
    points = stops[:, None].repeat(1, len(levels), 1)
    points[:, :, 2] = levels
    theta = _ask(panel, points.reshape(-1, 3)).reshape(len(stops), -1)
    occupied = (theta > occupied_above) & ~_is_unknown(theta)
    occupied &= points[:, :, 2].numpy() > stops[:, 2:].numpy() + headroom
    return bool(occupied.any(1).mean() > 0.5)


def _plane(raster: Raster, dim: int, height: float) -> Tensor:
    """Pixel centres (H·W, D), rows from the bottom up."""
    y, x = torch.meshgrid(raster.y, raster.x, indexing="ij")
    columns = [x, y] if dim == 2 else [x, y, torch.full_like(x, height)]
    return torch.stack(columns, -1).reshape(-1, dim)


def _ask(panel: MapPanel, points: Tensor) -> np.ndarray:
    answers = [torch.as_tensor(panel.occupancy(part)) for part in points.split(_QUERIES_AT_ONCE)]
    theta = torch.cat(answers).detach().cpu().double().numpy()
    if theta.shape != (len(points),):
        raise InvalidArgumentError(
            f"occupancy of the panel {panel.title!r} answered {len(points)} points with shape {theta.shape}; "
            "it must give one probability for each point."
        )
    return theta


def _corner(value: ArrayLike) -> tuple[float, ...]:
    return tuple(torch.as_tensor(value, dtype=torch.float64).flatten().tolist())

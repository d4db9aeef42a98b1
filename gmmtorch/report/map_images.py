"""Images of maps that answer occupancy queries: slices, views from above and heights; regions to show."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.axes import Axes
from torch import Tensor

from gmmtorch.occupancy import check_resolution
from gmmtorch.report.style import as_array
from gmmtorch.scan import ArrayLike

Corners = tuple[tuple[float, ...], tuple[float, ...]]
"""The lowest and the highest corner (D,) of a box, world metres."""


def busiest_regions(points: ArrayLike, n: int, side: float | None = None) -> list[Corners]:
    """Returns the corners of the `n` squares of the plane that contain the most surface, no two adjacent.

    Surface is counted in cells of a hundredth of the side, so points (N, 2) on top of each other count once.
    Returns fewer squares if there are not enough. side: in metres; a tenth of the longer side of the cloud.
    """
    cloud = _finite(points)
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
    return [(corner_of(tile * side), corner_of((tile + 1) * side)) for tile in chosen]


def robust_bounds(
    points: ArrayLike, trajectory: ArrayLike | None = None, share: float = 0.99, margin: float = 1.0
) -> Corners:
    """Returns the corners (D,) of a box around `share` of the points (N, D) along each axis and the whole
    trajectory (S, D), plus `margin` metres; a unit box if both are empty.

    A few stray points far away do not enlarge the box.
    """
    cloud = _finite(points)
    corners = []
    if len(cloud):
        corners.append(np.quantile(cloud.numpy(), [(1 - share) / 2, (1 + share) / 2], axis=0))
    if trajectory is not None and len(trajectory):
        path = as_array(trajectory)
        corners.append(np.stack([path.min(0), path.max(0)]))
    if not corners:
        return (-1.0,) * cloud.shape[1], (1.0,) * cloud.shape[1]
    pad = max(margin, 1e-3)
    return corner_of(np.min(corners, (0, 1)) - pad), corner_of(np.max(corners, (0, 1)) + pad)


def inside(points: Tensor, box: tuple[Sequence[float], Sequence[float]]) -> Tensor:
    """Returns the mask (N,) of the points (N, D) in a box between two corners (D,)."""
    low, high = (points.new_tensor(corner) for corner in box)
    return ((points >= low) & (points <= high)).all(1)


def corner_of(value: ArrayLike) -> tuple[float, ...]:
    """Converts coordinates (D,) to a tuple of floats."""
    return tuple(torch.as_tensor(value, dtype=torch.float64).flatten().tolist())


def _finite(points: ArrayLike) -> Tensor:
    cloud = torch.as_tensor(points).detach().cpu().double()
    return cloud[torch.isfinite(cloud).all(1)]


MAX_PIXELS = 2000
"""Largest number of cells queried along a side of a picture."""

MAX_QUERIES = 4_000_000
"""Largest number of cells queried for one image of heights."""

OCCUPIED_ABOVE = 0.4
"""Occupied cells of views from above: grazing beams count more misses than hits in a surface cell, so ½ would
hide thin surfaces."""

HEADROOM = 0.5
"""Metres above a path at which a roof begins."""

_BATCH = 1 << 18  # queries at a time
_UNKNOWN_BAND = 0.02  # around θ = ½: the tails of a component are no evidence
_TOLERANCE = 1e-3  # of a cell: float32 corners on a boundary between cells count as exact


@dataclass(frozen=True)
class MapPanel:
    """One map and the region of it to show.

    Attributes:
        title: text above the picture, such as the method's name.
        occupancy: probability (M,) at the points (M, D), float64 world metres; ½ is unknown.
        resolution: side (m) of a cell; one pixel, unless the region is too large for that.
        low, high: corners (D,) of the region, world metres; D is 2 or 3.
    """

    title: str
    occupancy: Callable[[Tensor], Any]
    resolution: float
    low: tuple[float, ...]
    high: tuple[float, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "resolution", check_resolution(self.resolution))
        for name in ("low", "high"):
            object.__setattr__(self, name, corner_of(getattr(self, name)))

    @property
    def dim(self) -> int:
        return len(self.low)


class MapImage(NamedTuple):
    """An image of a map in the x-y plane.

    image: (nx, ny), one value per cell; cell (i, j) begins at low + (i, j)·resolution. low: corner (x, y),
    world metres. resolution: side of a cell, metres. band: lowest and highest z (m) that the image shows.
    """

    image: Tensor
    low: tuple[float, float]
    resolution: float
    band: tuple[float, float] = (-math.inf, math.inf)

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Left, right, bottom and top, metres."""
        nx, ny = self.image.shape
        (x, y), side = self.low, self.resolution
        return x, x + nx * side, y, y + ny * side

    def draw(self, axes: Axes, colours: np.ndarray, interpolation: str = "nearest") -> None:
        """Draws colours (nx, ny, 3 or 4) of the cells, with equal scales and the limits of the image."""
        axes.imshow(
            np.moveaxis(colours, 0, 1),
            origin="lower",
            extent=self.extent,
            aspect="equal",
            interpolation=interpolation,
        )
        axes.autoscale(False)


def slice_image(
    panel: MapPanel, height: float = 0.0, max_pixels: int = MAX_PIXELS, shown_pixels: int | None = None
) -> MapImage:
    """Returns the occupancy in the plane, in 3D of the cells at `height` (m); NaN where it is unknown.

    With `shown_pixels`, the longer side is reduced to about that many pixels. A pixel shows its highest
    occupancy if that is above ½, so thin walls stay visible; else the mean of its known cells, or unknown
    if most of its cells are.
    """
    image = _pixels(panel, max_pixels)
    theta = _query(panel, _centres(image, panel, height)).reshape(image.image.shape)
    theta[is_unknown(theta)] = torch.nan
    image = image._replace(image=theta)
    factor = 1 if shown_pixels is None else round(max(theta.shape) / max(shown_pixels, 1))
    return _reduced(image, factor) if factor > 1 else image


def height_image(panel: MapPanel, max_pixels: int = MAX_PIXELS, max_queries: int = MAX_QUERIES) -> MapImage:
    """Returns the height (m) of the highest occupied cell in each column, NaN if none.

    Queries layers from the top down, each only in the columns without a cell yet. Pixels grow if that could
    take more than `max_queries` queries.
    """
    cell = panel.resolution
    levels = torch.arange(
        math.floor(panel.low[2] / cell + _TOLERANCE), math.ceil(panel.high[2] / cell - _TOLERANCE)
    )
    levels = levels.double().add(0.5).mul(cell).flip(0)
    sides = [(panel.high[a] - panel.low[a]) / cell for a in range(2)]
    affordable = max(sides) * math.sqrt(max_queries / max(math.prod(sides) * len(levels), 1))
    image = _pixels(panel, max(1, min(max_pixels, int(affordable))))
    columns = _centres(image, panel, 0.0)
    heights = torch.full((len(columns),), torch.nan, dtype=torch.float64)
    for level in levels.tolist():
        still_open = heights.isnan().nonzero()[:, 0]
        if len(still_open) == 0:
            break
        points = columns[still_open]
        points[:, 2] = level
        heights[still_open[_is_occupied(_query(panel, points))]] = level
    return image._replace(image=heights.reshape(image.image.shape))


def highest_occupancy(probability: ArrayLike, low: ArrayLike, resolution: float) -> MapImage:
    """Returns the highest occupancy of the known cells in each column; ½ where none is known.

    probability (nx, ny, nz), nz ≥ 1: within 0.02 of ½ is unknown; truth values are accepted. low (3,): corner
    of the lowest cell, world metres.
    """
    theta = torch.as_tensor(probability).detach().cpu().double()
    x, y, bottom = as_array(low).tolist()
    highest = torch.where(is_unknown(theta), -1.0, theta).amax(2)
    image = torch.where(highest < 0, 0.5, highest)
    return MapImage(image, (x, y), resolution, (bottom, bottom + theta.shape[2] * resolution))


def roof_above(panel: MapPanel, path: np.ndarray) -> bool:
    """Returns whether most of the path (S, 3) has an occupied cell more than `HEADROOM` above it."""
    levels = torch.arange(float(path[:, 2].min()) + HEADROOM, panel.high[2], panel.resolution).double()
    if len(levels) == 0:
        return False
    stops = torch.from_numpy(path)[torch.linspace(0, len(path) - 1, min(len(path), 200)).long()]
    points = stops[:, None].repeat(1, len(levels), 1)
    points[:, :, 2] = levels
    occupied = _is_occupied(_query(panel, points.reshape(-1, 3))).reshape(len(stops), -1)
    occupied &= points[:, :, 2] > stops[:, 2:] + HEADROOM
    return bool(occupied.any(1).double().mean() > 0.5)


def _pixels(panel: MapPanel, max_pixels: int) -> MapImage:
    """Returns an empty image aligned with the cells; a pixel spans several cells in large regions."""
    cell = panel.resolution
    first = [math.floor(panel.low[axis] / cell + _TOLERANCE) for axis in range(2)]
    last = [math.ceil(panel.high[axis] / cell - _TOLERANCE) for axis in range(2)]
    factor = max(1, math.ceil(max(b - a for a, b in zip(first, last, strict=True)) / max(max_pixels, 1)))
    shape = [max(1, math.ceil((b - a) / factor)) for a, b in zip(first, last, strict=True)]
    return MapImage(torch.empty(*shape), (first[0] * cell, first[1] * cell), cell * factor)


def _centres(image: MapImage, panel: MapPanel, height: float) -> Tensor:
    """Returns the query points (nx·ny, D): the centre of the middle cell of each pixel."""
    cell = panel.resolution
    factor = round(image.resolution / cell)
    x, y = (
        (round(corner / cell) + torch.arange(n, dtype=torch.float64) * factor + factor // 2 + 0.5) * cell
        for corner, n in zip(image.low, image.image.shape, strict=True)
    )
    points = torch.cartesian_prod(x, y)
    if panel.dim == 2:
        return points
    return torch.cat([points, torch.full((len(points), 1), height, dtype=torch.float64)], 1)


def _reduced(image: MapImage, factor: int) -> MapImage:
    """Pools factor × factor pixels into one, as `slice_image` describes."""
    shape = [-(-n // factor) for n in image.image.shape]
    padded = torch.full((shape[0] * factor, shape[1] * factor), torch.nan, dtype=torch.float64)
    padded[: image.image.shape[0], : image.image.shape[1]] = image.image
    tiles = padded.reshape(shape[0], factor, shape[1], factor).transpose(1, 2).flatten(2)
    n_known = tiles.isfinite().sum(2)
    highest = tiles.nan_to_num(0.0).amax(2)
    mean = torch.where(2 * n_known < factor**2, torch.nan, tiles.nansum(2) / n_known)
    return MapImage(
        torch.where(highest > 0.5, highest, mean), image.low, image.resolution * factor, image.band
    )


def is_unknown(theta: Tensor) -> Tensor:
    """Returns the mask of probabilities that are as good as ½."""
    return (theta - 0.5).abs() < _UNKNOWN_BAND


def _is_occupied(theta: Tensor) -> Tensor:
    return (theta > OCCUPIED_ABOVE) & ~is_unknown(theta)


def _query(panel: MapPanel, points: Tensor) -> Tensor:
    answers = [torch.as_tensor(panel.occupancy(part)) for part in points.split(_BATCH)]
    return torch.cat(answers).detach().cpu().double()

"""Files for navigation: 2D maps of ROS map_server, the heights between which they reach, distance fields.

A pixel of value x of a map_server image encodes the occupancy probability p = (255 − x)/255. A cell is
occupied if p is above `occupied_thresh`, free if p is below `free_thresh`, and unknown otherwise. `origin` is
the lower left corner of the image. The first image row is the top of the map (highest y).

Floor and ceiling are the heights with most horizontal surface, below and above the sensors. Heights are in
metres in the world frame, z up.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.files import write_bytes, write_npz
from gmmtorch.mapping import Components
from gmmtorch.occupancy import CellClass, OccupancyGrid, Thresholds, VoxelGrid


def highest_in_band(grid: VoxelGrid, probability: Tensor) -> tuple[VoxelGrid, Tensor]:
    """Projects a 3D map of a band of heights to a 2D grid and probability (n_x, n_y): the highest θ of each
    column, so a column is free only if all its cells are.

    Raises `InvalidArgumentError` for a map that is not 3D.
    """
    if grid.dim != 3 or tuple(probability.shape) != grid.shape:
        raise InvalidArgumentError(
            f"probability has shape {tuple(probability.shape)} on a grid of {grid.shape}; a band needs a 3D "
            "map."
        )
    return VoxelGrid(grid.origin[:2], grid.resolution, grid.shape[:2]), probability.amax(2)


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


_UPRIGHT = 0.9
"""Least |n_z| of the normal of a horizontal surface: 26 degrees."""
_FLAT = 0.5
"""A component is flat if its smallest standard deviation is at most this share of the middle one."""
_WEAK = 0.15
"""A ceiling has at least this share of the floor's area; outdoors there is none."""
_LEAST_GAP = 1.0
"""Metres between floor and ceiling, at least, in a grid, which does not store the sensor's height."""
_MARGIN = 2
"""Cells next to the floor and to the ceiling that the band leaves out."""
_NO_SURFACE = "z_min and z_max are not set, and the map shows no floor; give z_min and z_max."


class Levels(NamedTuple):
    """Heights (m) of the floor, of the ceiling (None: there is none) and of the map's top."""

    floor: float
    ceiling: float | None
    top: float

    def band(self, resolution: float) -> tuple[float, float]:
        """Lowest and highest height (m) of the cells between floor and ceiling.

        Raises `InvalidArgumentError` if there is no cell between them.
        """
        margin = _MARGIN * resolution
        low = self.floor + margin
        high = self.top if self.ceiling is None else self.ceiling - margin
        if not low < high:
            raise InvalidArgumentError(
                f"z_min and z_max are not set, and between {self.about()} are no cells of "
                f"resolution={resolution}; give z_min and z_max."
            )
        return low, high

    def about(self) -> str:
        ceiling = "no ceiling" if self.ceiling is None else f"the ceiling at {self.ceiling:.2f} m"
        return f"the floor at {self.floor:.2f} m and {ceiling}"


def of_components(components: Components, resolution: float) -> Levels:
    """The levels of a mixture map in 3D, by the area of its flat, horizontal components."""
    surface = ~components.max_range
    means = components.means[surface].double().cpu()
    variances, axes = torch.linalg.eigh(components.covariances[surface].double().cpu())
    deviations = variances.clamp_min(0).sqrt()  # ascending
    horizontal = (axes[:, 2, 0].abs() >= _UPRIGHT) & (deviations[:, 0] <= _FLAT * deviations[:, 1])
    area = deviations[:, 1] * deviations[:, 2] * horizontal
    heights, sensor = means[:, 2], float(components.origins[:, 2].double().median())
    floor = _peak(heights, area * (heights < sensor), resolution)
    if floor is None:
        raise InvalidArgumentError(_NO_SURFACE)
    return _levels(floor, _peak(heights, area * (heights > sensor), resolution), float(heights.max()))


def of_grid(grid: OccupancyGrid, occupied: float) -> Levels:
    """The levels of an occupancy grid in 3D, by its cells above the probability `occupied`.

    The floor is where most columns of cells begin, the ceiling where most of those end that are higher than a
    metre.
    """
    cells = grid.evidence().cells()[0].cpu()
    theta = torch.as_tensor(grid.occupancy((cells.double() + 0.5) * grid.resolution)).cpu()
    cells = cells[theta > occupied].long()
    if not len(cells):
        raise InvalidArgumentError(_NO_SURFACE)
    _, column = cells[:, :2].unique(dim=0, return_inverse=True)
    heights = (cells[:, 2].double() + 0.5) * grid.resolution
    ends = heights.new_zeros(int(column.max()) + 1)
    lowest = ends.scatter_reduce(0, column, heights, "amin", include_self=False)
    highest = ends.scatter_reduce(0, column, heights, "amax", include_self=False)
    floor = _peak(lowest, torch.ones_like(lowest), grid.resolution)
    assert floor is not None  # there are cells
    high = (highest > floor[0] + _LEAST_GAP).double()
    return _levels(floor, _peak(highest, high, grid.resolution), float(heights.max()))


def _levels(floor: tuple[float, float], ceiling: tuple[float, float] | None, top: float) -> Levels:
    """The levels of two peaks, see `_peak`; a ceiling with too little area is none."""
    is_strong = ceiling is not None and ceiling[1] >= _WEAK * floor[1]
    return Levels(floor[0], ceiling[0] if ceiling is not None and is_strong else None, top)


def _peak(heights: Tensor, area: Tensor, resolution: float) -> tuple[float, float] | None:
    """The height (m) and the area of the three neighbouring layers of cells with most area (N,) at heights
    (N,); None without area."""
    if not bool((area > 0).any()):
        return None
    layers = ((heights - heights.min()) / resolution).long()
    histogram = heights.new_zeros(int(layers.max()) + 3).index_add(0, layers + 1, area)
    smooth = histogram[:-2] + histogram[1:-1] + histogram[2:]
    strongest = int(smooth.argmax())
    weight = area * ((layers - strongest).abs() <= 1)
    return float((heights * weight).sum() / weight.sum()), float(smooth[strongest])


class DistanceField(NamedTuple):
    """Distances (n_x, n_y[, n_z]), float32, metres, from each cell's centre to the centre of the nearest
    occupied cell, 0 in these; infinite if no cell is occupied. classes, int8: −1 unknown, 0 free, 1 occupied
    (`CellClass`).
    """

    distance: np.ndarray
    classes: np.ndarray


def distance_field(
    grid: VoxelGrid, probability: Tensor, thresholds: Thresholds | None = None
) -> DistanceField:
    """The exact Euclidean distance transform of the occupied cells (Maurer et al. 2003).

    Unknown cells are no obstacles, but their class is kept, so that a planner can avoid them.

    Args:
        grid: 2D or 3D. probability: θ, of the grid's shape.
        thresholds: which cells are occupied and which free.

    Raises `InvalidArgumentError` if the shapes disagree.
    """
    from scipy.ndimage import distance_transform_edt

    if tuple(probability.shape) != grid.shape:
        raise InvalidArgumentError(
            f"probability has shape {tuple(probability.shape)}; the grid's is {grid.shape}."
        )
    classes = (thresholds or Thresholds()).classify(probability.detach().cpu()).numpy()
    occupied = classes == CellClass.OCCUPIED
    if not occupied.any():
        distance = np.full(grid.shape, np.inf, np.float32)
    else:
        distance = distance_transform_edt(~occupied, sampling=grid.resolution).astype(np.float32)
    return DistanceField(distance, classes.astype(np.int8))


def write_distance_field(path: str | Path, grid: VoxelGrid, field: DistanceField) -> Path:
    """Writes a field as NPZ, atomically: `distance`, `classes`, `origin` (D,) of the lowest corner (m), and
    `resolution` (m). The centre of cell i is origin + (i + ½) resolution."""
    path = Path(path)
    if path.suffix != ".npz":
        raise InvalidArgumentError(f"path={path} must end in .npz.")
    return write_npz(
        path,
        distance=field.distance,
        classes=field.classes,
        origin=np.asarray(grid.origin, dtype=np.float64),
        resolution=np.asarray(grid.resolution),
    )

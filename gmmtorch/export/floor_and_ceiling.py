"""The heights of floor and ceiling in a 3D map, for a 2D map of the space between them.

Floor and ceiling are the heights with most horizontal surface, below and above the sensors. Heights are in
metres in the world frame, z up.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.mapping import Components

if TYPE_CHECKING:
    from gmmtorch.occupancy import OccupancyGrid

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
    high = (highest > floor.height + _LEAST_GAP).double()
    return _levels(floor, _peak(highest, high, grid.resolution), float(heights.max()))


class _Peak(NamedTuple):
    """The height (m) of the layers with most area, and their area."""

    height: float
    area: float


def _levels(floor: _Peak, ceiling: _Peak | None, top: float) -> Levels:
    is_strong = ceiling is not None and ceiling.area >= _WEAK * floor.area
    return Levels(floor.height, ceiling.height if ceiling is not None and is_strong else None, top)


def _peak(heights: Tensor, area: Tensor, resolution: float) -> _Peak | None:
    """The three neighbouring layers of cells with most area (N,) at heights (N,); None without area."""
    if not bool((area > 0).any()):
        return None
    layers = ((heights - heights.min()) / resolution).long()
    histogram = heights.new_zeros(int(layers.max()) + 3).index_add(0, layers + 1, area)
    smooth = histogram[:-2] + histogram[1:-1] + histogram[2:]
    strongest = int(smooth.argmax())
    weight = area * ((layers - strongest).abs() <= 1)
    return _Peak(float((heights * weight).sum() / weight.sum()), float(smooth[strongest]))

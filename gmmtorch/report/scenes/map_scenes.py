"""Maps in space: the measured points, the components of a map, and the cells that each map calls occupied."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from torch import Tensor

from gmmtorch.mapping import Components
from gmmtorch.occupancy import Thresholds
from gmmtorch.report import style
from gmmtorch.report.maps.map_images import is_unknown
from gmmtorch.report.maps.map_regions import Corners, inside, robust_bounds
from gmmtorch.report.scenes.ellipsoids import (
    cut_away,
    first_viewpoints,
    height_colours,
    principal_axes,
)
from gmmtorch.report.scenes.scene import (
    SOUTH_WEST,
    Ellipsoids,
    balls,
    canvas_around,
    draw_scene,
    height_bar,
    path_balls,
)
from gmmtorch.report.scenes.scene_renderer import N_SIGMA, Canvas
from gmmtorch.report.table import byte_text, count_text

_SIDE = 6.6  # inches, width of a panel
_TALLEST = 1.1  # of a panel, relative to its width
_SHARE = 0.97  # of the points, along each axis, that are shown
_OUTSIDE = 1.0  # metres by which an ellipsoid may exceed the box
_MAX_POINTS = 300_000
_MAX_CELLS = 2_000_000
_REACH = 2  # cells around a measured point that are asked
_POINT_PIXELS = 1.3  # radius of a point
_PATH_PIXELS = 2.5  # radius of the sensor's path
_PATH = style.PALETTE[1]
_POINT_BYTES = 12  # three float32
_N_NEAR = 16  # components near a place, of which one explains it
_BLUR = 0.1  # metres, added to the components to find the one that explains a place
_FILL = 0.62  # radius of a cell's ball, in cells: balls of neighbouring cells touch


class OccupancyPanel(NamedTuple):
    """One map: the title of its panel, its occupancy (M,) at points (M, 3), world metres, and the θ from
    which a cell is drawn."""

    title: str
    occupancy: Callable[[Tensor], Tensor]
    occupied_from: float = Thresholds().occupied


def map_scene_figure(
    points: Tensor,
    trajectory: Tensor,
    maps: Sequence[OccupancyPanel],
    resolution: float,
    components: Components | None = None,
    *,
    title: str = "",
) -> Figure:
    """Draws 3D maps side by side in space, coloured by height (thesis Fig 3.6b and Fig 3.7).

    The first panel shows the points, the second the components as 2σ ellipsoids, and each further one the
    known cells of a map with θ ≥ `occupied_from`. Only cells within two cells of a point are
    asked. Surfaces that hide the inside are left out of all panels: see `cut_away`.

    Args:
        points: (N, 3) measured points, world metres.
        trajectory: (S, 3) sensor origins, world metres.
        maps: the maps.
        resolution: side (m) of the cells; a multiple if more than two million cells would be asked.
        components: surfaces of the map; None: the panel of the components is left out.
        title: of the figure.
    """
    hidden = _Hidden(components)
    cloud = points[style.even_sample(len(points), _MAX_POINTS)].double().cpu()
    cloud = cloud[~hidden(cloud)]
    box = low, high = robust_bounds(cloud, trajectory, _SHARE, margin=0.3)
    scale = style.height_scale(cloud[:, 2])
    canvas = canvas_around(low, high, SOUTH_WEST, int(_SIDE * style.SAVED_DPI))
    size = f"{count_text(len(points), 'point')}, {byte_text(_POINT_BYTES * len(points))}"
    shown = [(f"measured: {size}", _spots(cloud, _POINT_PIXELS / canvas.scale, scale, hidden, box))]
    if components is not None:
        surfaces = _surfaces(components, scale, hidden, box)
        shown.append((f"surfaces of the map: {count_text(len(components), 'component')}", surfaces))
    centres, side = cells_near(points[inside(points, box)], resolution)
    for one in maps:
        theta = one.occupancy(centres).cpu()
        occupied = centres[(theta >= one.occupied_from) & ~is_unknown(theta)]
        shown.append((one.title, _spots(occupied, _FILL * side, scale, hidden, box)))
    path = [path_balls(trajectory.double(), _PATH_PIXELS / canvas.scale, _PATH)] if len(trajectory) else []
    figure, panels = _sheet(len(shown), canvas)
    for axes, (name, part) in zip(panels, shown, strict=False):
        draw_scene(axes, [part, *path], low, high, SOUTH_WEST, canvas)
        axes.set_title(name, fontsize=style.TITLE_SIZE)
    height_bar(figure, panels, scale)
    style.figure_title(figure, title)
    return figure


def _sheet(n_panels: int, canvas: Canvas) -> tuple[Figure, list[Axes]]:
    """Returns a figure and its axes row by row; those beyond `n_panels` are hidden."""
    n_columns = 1 if n_panels == 1 else 2 if n_panels in (2, 4) else 3
    n_rows = math.ceil(n_panels / n_columns)
    tall = min((canvas.top - canvas.bottom) / (canvas.right - canvas.left), _TALLEST)
    figure = style.new_figure(_SIDE * n_columns + 0.9, (_SIDE * tall + 0.5) * n_rows + 0.5)
    panels: list[Axes] = figure.subplots(n_rows, n_columns, squeeze=False).ravel().tolist()
    for axes in panels[n_panels:]:
        axes.set_visible(False)
    return figure, panels


def cells_near(points: Tensor, resolution: float) -> tuple[Tensor, float]:
    """Returns the centres (M, 3) of the cells at most two cells from a point along each axis, and their
    side (m): `resolution`, doubled until there are no more than two million cells."""
    while True:
        cells = torch.unique((points.double() / resolution).floor(), dim=0)
        for axis in range(3):
            step = torch.zeros(2 * _REACH + 1, 3, dtype=torch.float64)
            step[:, axis] = torch.arange(-_REACH, _REACH + 1)
            cells = torch.unique((cells[:, None] + step).flatten(0, 1), dim=0)
            if len(cells) > _MAX_CELLS:
                break
        else:
            return (cells + 0.5) * resolution, resolution
        resolution *= 2


class _Hidden:
    """What is left out because it hides the inside: what lies above `top` (m), and what belongs to components
    that `cut_away` leaves out; `kept` (K,) marks the others."""

    def __init__(self, components: Components | None) -> None:
        self.kept, self.top = torch.ones(0, dtype=torch.bool), math.inf
        if components is None or len(components) == 0:
            return
        self._means, self._covariances = (
            components.means.double().cpu(),
            components.covariances.double().cpu(),
        )
        seen_from = first_viewpoints(components).double().cpu()
        self.kept, self.top = cut_away(self._means, self._covariances, seen_from, SOUTH_WEST)

    def __call__(self, places: Tensor) -> Tensor:
        """Whether each place (M, 3) is left out."""
        from scipy.spatial import cKDTree

        if not len(self.kept) or not len(places):
            return torch.zeros(len(places), dtype=torch.bool)
        n = min(_N_NEAR, len(self.kept))
        _, near = cKDTree(self._means.numpy()).query(places.numpy(), k=range(1, n + 1))
        chosen = torch.from_numpy(near)
        spread = self._covariances + _BLUR**2 * torch.eye(3, dtype=torch.float64)
        inverse = torch.linalg.inv(spread)[chosen]
        offset = places[:, None] - self._means[chosen]
        distance = (offset[..., None, :] @ inverse @ offset[..., None]).flatten(1)
        owner = chosen.gather(1, distance.argmin(1, keepdim=True)).squeeze(1)
        return ~self.kept[owner] | (places[:, 2] > self.top)


def _surfaces(components: Components, scale: Normalize, hidden: _Hidden, box: Corners) -> Ellipsoids:
    """The components in the box that are not hidden, coloured by height."""
    kept = hidden.kept & _lie_inside(components, box)
    means, covariances = components.means[kept], components.covariances[kept]
    return Ellipsoids(means.double(), covariances.double(), height_colours(means[:, 2], scale), hidden.top)


def _spots(places: Tensor, radius: float, scale: Normalize, hidden: _Hidden, box: Corners) -> Ellipsoids:
    """Balls at the places (M, 3) in the box that are not hidden, coloured by height."""
    places = places.double().cpu()
    places = places[inside(places, box)]
    places = places[~hidden(places)]
    return balls(places, radius, height_colours(places[:, 2], scale))


def _lie_inside(components: Components, box: Corners) -> Tensor:
    """Mask (K,) of the components whose means are in the box, and whose ends are nearly."""
    means, (deviations, directions) = components.means, principal_axes(components.covariances)
    end = N_SIGMA * directions[:, :, 2] * deviations[:, 2:]
    wide = tuple(x - _OUTSIDE for x in box[0]), tuple(x + _OUTSIDE for x in box[1])
    return inside(means, box) & inside(means + end, wide) & inside(means - end, wide)

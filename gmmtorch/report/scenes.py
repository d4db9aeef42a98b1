"""Scenes in space above a floor grid: components, points, the occupied cells of maps, and paths of robots."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import Stroke
from matplotlib.ticker import MaxNLocator
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, check_whole
from gmmtorch.mapping import Components
from gmmtorch.occupancy import Thresholds
from gmmtorch.report import style
from gmmtorch.report.ellipsoids import (
    checked_components,
    checked_rows,
    cut_away,
    first_viewpoints,
    height_colour_map,
    height_colours,
    principal_axes,
)
from gmmtorch.report.map_images import Corners, inside, is_unknown, robust_bounds
from gmmtorch.report.scene_renderer import N_SIGMA, Camera, Canvas, render
from gmmtorch.report.text import byte_text, count_text
from gmmtorch.scan import ArrayLike

SOUTH_WEST = Camera(-120.0, 45.0)

_WIDTH = 11.0  # inches, of the picture of a scene
_SHARE = 0.996  # of the components, along each axis, that a scene shows
_PATH_PIXELS = 2.2  # radius of a path
_MARGIN = 0.02  # of the width of the picture
_GRID, _FRAME, _TEXT = "#d5d5d5", "#777777", "#333333"
_TICK_GAP, _NAME_GAP = 12.0, 42.0  # points from the edge of the floor to the numbers and the axis name


class Ellipsoids(NamedTuple):
    """Ellipsoids of a scene: means (K, 3), metres; covariances (K, 3, 3), m²; colours (K, 3) in [0, 1]; top:
    height (m) above which they are cut off."""

    means: Tensor
    covariances: Tensor
    colours: Tensor
    top: float = math.inf


def balls(centres: Tensor, radius: float, colours: Tensor) -> Ellipsoids:
    """Returns balls at centres (K, 3), world metres, with colours (K, 3) or (3,); the radius is in metres."""
    covariance = (radius / N_SIGMA) ** 2 * torch.eye(3, dtype=torch.float64)
    k = len(centres)
    return Ellipsoids(centres, covariance.expand(k, 3, 3), colours.expand(k, 3))


def path_balls(path: Tensor, radius: float, hue: str) -> Ellipsoids:
    """Returns a path (M, 3), metres, as a string of small balls of a radius (m), so that surfaces can hide
    it."""
    steps = (path[1:] - path[:-1]).norm(dim=1).cumsum(0)
    along = np.concatenate([[0.0], steps.numpy()])
    s = np.arange(0.0, along[-1] + radius, radius)
    centres = np.stack([np.interp(s, along, path[:, axis].numpy()) for axis in range(3)], 1)
    return balls(torch.from_numpy(centres), radius, torch.tensor(to_rgb(hue), dtype=torch.float64))


def canvas_around(low: Sequence[float], high: Sequence[float], camera: Camera, pixels: int) -> Canvas:
    """Returns the picture plane, `pixels` wide, that shows the box between two corners (3,), world metres."""
    corners = torch.cartesian_prod(*(torch.tensor(pair).double() for pair in zip(low, high, strict=True)))
    flat = camera.project(corners)[:, :2]
    left, bottom = flat.amin(0).tolist()
    right, top = flat.amax(0).tolist()
    margin = _MARGIN * (right - left)
    width = right - left + 2 * margin
    return Canvas(left - margin, right + margin, bottom - margin, top + margin, pixels / width)


def draw_scene(
    axes: Axes,
    parts: Sequence[Ellipsoids],
    low: Sequence[float],
    high: Sequence[float],
    camera: Camera,
    canvas: Canvas,
    n_ticks: int = 6,
) -> None:
    """Renders the 2σ surfaces of all parts, above a floor grid with lengths along its two near edges.

    Axes coordinates are metres along right and up of the camera. low, high: (3,) corners of the box whose
    floor is drawn, world metres. n_ticks: largest number of intervals along an edge.
    """
    tops = [torch.full((len(part.means),), part.top, dtype=torch.float64) for part in parts]
    means, covariances, colours, _ = zip(*parts, strict=True)
    picture = render(
        torch.cat(means), torch.cat(covariances), torch.cat(colours), camera, canvas, tops=torch.cat(tops)
    )
    _draw_floor(axes, np.asarray(low), np.asarray(high), camera, n_ticks)
    opacity = torch.isfinite(picture.depth)[..., None]
    image = torch.cat([picture.rgb, opacity], 2).mul(255).round().to(torch.uint8)
    rows, columns = picture.depth.shape
    right, top = canvas.left + columns / canvas.scale, canvas.bottom + rows / canvas.scale
    axes.imshow(image.numpy(), extent=(canvas.left, right, canvas.bottom, top), aspect="equal", zorder=2)
    axes.set(xlim=(canvas.left, right), ylim=(canvas.bottom, top), autoscale_on=False)
    axes.set_axis_off()


def height_bar(figure: Figure, axes: Axes | Sequence[Axes], scale: Normalize) -> None:
    """Draws the colour bar of heights on shaded surfaces."""
    style.colour_bar(figure, ScalarMappable(scale, height_colour_map()), axes, "height z [m]", shrink=0.7)


def mixture_scene_figure(
    means: ArrayLike,
    covariances: ArrayLike,
    *,
    seen_from: ArrayLike | None = None,
    trajectories: Sequence[ArrayLike] = (),
    traveller: str = "robot",
    camera: Camera = SOUTH_WEST,
    title: str | None = None,
    max_pixels: int = int(_WIDTH * style.SAVED_DPI),
) -> Figure:
    """Draws the 2σ ellipsoids of a 3D mixture in space, coloured by height, and the paths of robots.

    Leaves out what hides the inside: components of a level ceiling, flat components that were observed from
    the side that faces away from the viewer, and components attached to these.

    Args:
        means: (K, 3), metres.
        covariances: (K, 3, 3), m².
        seen_from: (K, 3), a sensor origin that observed each component; if None, the top is left out.
        trajectories: poses (T, ≥ 3) of each robot, world metres.
        traveller: what each path is of, for the legend.
        camera: the viewer; by default in the south-west, 45° up.
        title: title of the figure; by default the number of components.
        max_pixels: width of the picture.

    Raises `InvalidArgumentError` if shapes disagree, or components are not finite.
    """
    mean, covariance = (value.cpu() for value in checked_components(means, covariances))
    if mean.shape[1] != 3:
        raise InvalidArgumentError(f"means has shape {tuple(mean.shape)}; a scene needs (K, 3).")
    places = checked_rows("seen_from", seen_from, mean)
    kept, top = cut_away(mean, covariance, places, camera)
    paths = [torch.from_numpy(smooth_path(path)) for path in trajectories if len(path)]
    flown = torch.cat([path[:, :3] for path in paths]) if paths else mean[:0]
    low, high = robust_bounds(mean, flown, _SHARE, margin=0.3)
    if bool(kept.any()):
        bottom, top_drawn = robust_bounds(mean[kept, 2:], flown[:, 2:], _SHARE, margin=0.1)
        low, high = low[:2] + bottom, high[:2] + top_drawn
    canvas = canvas_around(low, high, camera, check_whole("max_pixels", max_pixels, 1))
    height = _WIDTH * (canvas.top - canvas.bottom) / (canvas.right - canvas.left)
    figure = style.new_figure(_WIDTH + 0.9, height + 1.1)
    axes = figure.subplots()
    scale = style.height_scale(mean[kept, 2])
    components = Ellipsoids(mean[kept], covariance[kept], height_colours(mean[kept, 2], scale), top)
    radius = _PATH_PIXELS / canvas.scale
    strings = [path_balls(path, radius, style.colour(robot)) for robot, path in enumerate(paths)]
    draw_scene(axes, [components, *strings], low, high, camera, canvas)
    for robot, path in enumerate(paths):
        _mark_path(axes, camera.project(path).numpy()[:, :2], style.colour(robot))
    height_bar(figure, axes, scale)
    style.legend_below(figure, path_handles(trajectories, (-np.inf, np.inf), True, traveller), max_columns=9)
    if title is None:
        title = f"Gaussian mixture: {count_text(len(kept), 'component')}"
        if not bool(kept.all()):
            shown = f"{int(kept.sum()):,} of {count_text(len(kept), 'component')}"
            title = f"Gaussian mixture: {shown} (ceilings and near walls left out)"
    style.figure_title(figure, title)
    return figure


def _mark_path(axes: Axes, flat: np.ndarray, hue: str) -> None:
    """Draws a path (M, 2) on the picture plane thinly, where surfaces hide it too, and marks its ends."""
    axes.plot(*flat.T, color=hue, linewidth=0.8, alpha=0.35, zorder=3)
    look: dict[str, Any] = {"color": hue, "path_effects": style.halo(2.5)}
    for (x, y), shape in ((flat[0], "o"), (flat[-1], "^")):
        axes.plot(x, y, shape, markersize=9, markeredgecolor="#111111", zorder=4, **look)


def _draw_floor(axes: Axes, low: np.ndarray, high: np.ndarray, camera: Camera, n_ticks: int) -> None:
    """Draws the grid at the lowest height, with numbers and axis names along the edges near the viewer."""

    def project(*places: Sequence[float]) -> np.ndarray:
        floor = [[*place, low[2]] for place in places]
        return camera.project(torch.tensor(floor, dtype=torch.float64)).numpy()[:, :2]

    towards = camera.axes[2].numpy()[:2]
    near, far = np.where(towards > 0, high[:2], low[:2]), np.where(towards > 0, low[:2], high[:2])
    locator = MaxNLocator(nbins=n_ticks, steps=[1, 2, 5, 10])
    text: dict[str, Any] = {"textcoords": "offset points", "ha": "center", "va": "center", "color": _TEXT}
    for axis, name in enumerate("xy"):

        def across(value: float, other: float, axis: int = axis) -> tuple[float, float]:
            return (value, other) if axis == 0 else (other, value)

        outward = project(across(0, near[1 - axis]), across(0, far[1 - axis]))
        direction = outward[0] - outward[1]
        direction = direction / max(float(np.linalg.norm(direction)), 1e-9)
        for value in locator.tick_values(low[axis], high[axis]):
            if low[axis] <= value <= high[axis]:
                line = project(across(value, far[1 - axis]), across(value, near[1 - axis]))
                axes.plot(*line.T, color=_GRID, linewidth=0.7, zorder=1)
                axes.annotate(f"{value:g}", line[1], _TICK_GAP * direction, fontsize=style.TICK_SIZE, **text)
        (middle,) = project(across((low[axis] + high[axis]) / 2, near[1 - axis]))
        axes.annotate(f"{name} [m]", middle, _NAME_GAP * direction, fontsize=style.LABEL_SIZE, **text)
    (x0, y0), (x1, y1) = low[:2], high[:2]
    outline = project((x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0))
    axes.plot(*outline.T, color=_FRAME, linewidth=0.9, zorder=1)


_SIDE = 6.6  # inches, width of a panel
_TALLEST = 1.1  # of a panel, relative to its width
_CLOUD_SHARE = 0.97  # of the points, along each axis, that are shown
_OUTSIDE = 1.0  # metres by which an ellipsoid may exceed the box
_MAX_POINTS = 300_000
_MAX_CELLS = 2_000_000
_REACH = 2  # cells around a measured point that are asked
_POINT_PIXELS = 1.3  # radius of a point
_SENSOR_PIXELS = 2.5  # radius of the sensor's path
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
        resolution: side (m) of the cells; a multiple if more than two million cells would be asked.
        components: surfaces of the map; None: the panel of the components is left out.
    """
    hidden = _Hidden(components)
    cloud = points[style.even_sample(len(points), _MAX_POINTS)].double().cpu()
    cloud = cloud[~hidden(cloud)]
    box = low, high = robust_bounds(cloud, trajectory, _CLOUD_SHARE, margin=0.3)
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
    path = [path_balls(trajectory.double(), _SENSOR_PIXELS / canvas.scale, _PATH)] if len(trajectory) else []
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
    """The components with means in the box, and ends nearly, that are not hidden, coloured by height."""
    means, (deviations, directions) = components.means, principal_axes(components.covariances)
    end = N_SIGMA * directions[:, :, 2] * deviations[:, 2:]
    wide = tuple(x - _OUTSIDE for x in box[0]), tuple(x + _OUTSIDE for x in box[1])
    kept = hidden.kept & inside(means, box) & inside(means + end, wide) & inside(means - end, wide)
    means, covariances = means[kept], components.covariances[kept]
    return Ellipsoids(means.double(), covariances.double(), height_colours(means[:, 2], scale), hidden.top)


def _spots(places: Tensor, radius: float, scale: Normalize, hidden: _Hidden, box: Corners) -> Ellipsoids:
    """Balls at the places (M, 3) in the box that are not hidden, coloured by height."""
    places = places.double().cpu()
    places = places[inside(places, box)]
    places = places[~hidden(places)]
    return balls(places, radius, height_colours(places[:, 2], scale))


_N_BETWEEN = 12  # points per leg between two poses
_MAX_NAMED = len(style.PALETTE)  # robots with a colour of their own


def smooth_path(poses: ArrayLike) -> np.ndarray:
    """Returns points (M, 2 or 3) on a smooth path through poses (T, ≥ 2): x, y, z, yaw; metres, radians.

    Robots move along their heading and turn at a constant rate. Between two poses, x and y follow an arc: a
    cubic Hermite curve with tangents of length chord / cos²(Δyaw / 4). z is interpolated without overshoot.
    Legs against the heading, and legs of poses without yaw, are straight.
    """
    from scipy.interpolate import PchipInterpolator

    pose = style.as_array(poses)
    places = pose[:, :3]
    if len(pose) < 2:
        return places
    share = np.arange(_N_BETWEEN) / _N_BETWEEN
    legs = np.diff(pose[:, :2], axis=0)
    begin, end = _tangents(legs, pose[:, 3]) if pose.shape[1] > 3 else (legs, legs)
    s = share[None, :, None]
    flat = (
        pose[:-1, None, :2] * (1 + 2 * s) * (1 - s) ** 2
        + begin[:, None] * s * (1 - s) ** 2
        + pose[1:, None, :2] * (3 - 2 * s) * s**2
        - end[:, None] * s**2 * (1 - s)
    )
    flat = np.concatenate([flat.reshape(-1, 2), pose[-1:, :2]])
    if places.shape[1] < 3:
        return flat
    times = np.append((np.arange(len(pose) - 1)[:, None] + share).ravel(), len(pose) - 1.0)
    height = PchipInterpolator(np.arange(len(pose)), pose[:, 2])(times)
    return np.concatenate([flat, height[:, None]], 1)


def _tangents(legs: np.ndarray, yaw: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the tangents at the begin and end of each leg (T − 1, 2): those of an arc, or the leg
    itself."""
    heading = np.stack([np.cos(yaw), np.sin(yaw)], 1)
    ahead = np.minimum((legs * heading[:-1]).sum(1), (legs * heading[1:]).sum(1)) > 0
    length = np.linalg.norm(legs, axis=1) / np.cos(np.diff(yaw) / 4) ** 2
    is_arc = ahead & (np.abs(np.diff(yaw)) < math.pi)
    begin, end = (np.where(is_arc[:, None], length[:, None] * u, legs) for u in (heading[:-1], heading[1:]))
    return begin, end


def draw_paths(
    axes: Axes,
    trajectories: Sequence[ArrayLike],
    band: tuple[float, float],
    *,
    ends: bool,
    width: float = 2.2,
) -> None:
    """Draws the path of each robot from above; parts outside the band of heights (m) have a white core.

    A triangle shows the last pose and its heading (a square, if poses have no heading), and with `ends` a
    disc the first pose. trajectories: poses (T, ≥ 2) of each robot, world metres. width: in points.
    """
    for robot, trajectory in enumerate(trajectories):
        poses = style.as_array(trajectory)
        if len(poses) == 0:
            continue
        for outside, part in _parts(smooth_path(poses), band):
            look = _path_look(style.colour(robot), style.line_style(robot), outside, width)
            axes.plot(*part.T, zorder=3, **look)
        mark: dict[str, Any] = {"color": style.colour(robot), "markeredgecolor": "#111111", "zorder": 5}
        if ends:
            axes.plot(*poses[0, :2], "o", markersize=9, **mark)
        last = "s" if poses.shape[1] < 4 else (3, 0, math.degrees(poses[-1, 3]) - 90)
        axes.plot(*poses[-1, :2], marker=last, markersize=12, linestyle="", **mark)


def path_handles(
    trajectories: Sequence[ArrayLike], band: tuple[float, float], ends: bool, traveller: str = "robot"
) -> list[Line2D]:
    """Returns legend entries for `draw_paths`: robots or other travellers, first and last poses, and heights
    outside the band."""
    handles = [
        Line2D(
            [],
            [],
            color=style.colour(i),
            linewidth=2.4,
            label=f"{traveller} {i}" if len(trajectories) > 1 else "path",
        )
        for i in range(min(len(trajectories), _MAX_NAMED))
    ]
    marks = (("o", "start"), ("^", "end")) if ends else (("^", "robot"),)
    if handles:
        look: dict[str, Any] = {"color": style.EDGE, "linestyle": "", "markersize": 8}
        handles += [Line2D([], [], marker=shape, label=name, **look) for shape, name in marks]
    heights = [style.as_array(poses)[:, 2] for poses in trajectories if np.shape(poses)[1] > 2]
    if any(((z < band[0]) | (z > band[1])).any() for z in heights):
        look = _path_look(style.EDGE, "-", outside=True)
        handles.append(Line2D([], [], label="path above or below these heights", **look))
    return handles


def _parts(path: np.ndarray, band: tuple[float, float]) -> list[tuple[bool, np.ndarray]]:
    """Splits a path into parts (N, 2) outside and inside the band, each up to the begin of the next."""
    if path.shape[1] < 3:
        return [(False, path)]
    outside = (path[:, 2] > band[1]) | (path[:, 2] < band[0])
    cuts = [0, *(np.flatnonzero(np.diff(outside)) + 1).tolist(), len(path)]
    return [(bool(outside[a]), path[a : b + 1, :2]) for a, b in pairwise(cuts) if a < b]


def _path_look(hue: str, line_style: str, outside: bool, width: float = 2.2) -> dict[str, Any]:
    effects = style.halo(width + 1.6)
    if outside:
        effects.append(Stroke(linewidth=0.36 * width, foreground="white"))
    return {
        "color": hue,
        "linewidth": width,
        "linestyle": line_style,
        "path_effects": effects,
        "solid_capstyle": "butt",
    }

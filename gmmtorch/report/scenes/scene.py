"""Scenes: ellipsoids, balls and paths in space above a floor grid in metres."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, to_rgb
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, check_whole
from gmmtorch.report import style
from gmmtorch.report.maps.map_regions import robust_bounds
from gmmtorch.report.scenes.ellipsoids import (
    checked_components,
    checked_rows,
    cut_away,
    height_colour_map,
    height_colours,
)
from gmmtorch.report.scenes.paths import path_handles, smooth_path
from gmmtorch.report.scenes.scene_renderer import N_SIGMA, Camera, Canvas, render
from gmmtorch.report.table import count_text
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
    """Returns a path (M, 3), metres, as a string of small balls, so that surfaces can hide it.

    `radius` is in metres; `hue` is a colour of matplotlib.
    """
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

    Axes coordinates are metres along right and up of the camera.

    Args:
        axes: the panel; its own axis lines are hidden.
        parts: what to draw.
        low, high: (3,) corners of the box whose floor is drawn, world metres.
        camera: the viewer.
        canvas: the picture plane, such as `canvas_around` the box.
        n_ticks: largest number of intervals along an edge.
    """
    tops = [torch.full((len(part.means),), part.top, dtype=torch.float64) for part in parts]
    means, covariances, colours, _ = zip(*parts, strict=True)
    picture = render(
        torch.cat(means),
        torch.cat(covariances),
        torch.cat(colours),
        camera,
        canvas,
        tops=torch.cat(tops),
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

    Raises:
        InvalidArgumentError: shapes disagree, or components are not finite.
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
    style.figure_title(figure, _scene_title(kept) if title is None else title)
    return figure


def _mark_path(axes: Axes, flat: np.ndarray, hue: str) -> None:
    """Draws a path (M, 2) on the picture plane thinly, where surfaces hide it too, and marks its ends."""
    axes.plot(*flat.T, color=hue, linewidth=0.8, alpha=0.35, zorder=3)
    look: dict[str, Any] = {"color": hue, "path_effects": style.halo(2.5)}
    for (x, y), shape in ((flat[0], "o"), (flat[-1], "^")):
        axes.plot(x, y, shape, markersize=9, markeredgecolor="#111111", zorder=4, **look)


def _scene_title(kept: Tensor) -> str:
    count = count_text(len(kept), "component")
    if bool(kept.all()):
        return f"Gaussian mixture: {count}"
    return f"Gaussian mixture: {int(kept.sum()):,} of {count} (ceilings and near walls left out)"


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

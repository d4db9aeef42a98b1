"""The mixture that a team learned, in space: shaded ellipsoids, without what hides them, and the paths."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize, to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import Normal, Stroke
from matplotlib.ticker import MaxNLocator
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, check_whole
from gmmtorch.report.exploration.cutaway import cut_away
from gmmtorch.report.exploration.path_figures import smooth_path
from gmmtorch.report.exploration.scene_renderer import Camera, Canvas, render
from gmmtorch.report.maps.mesh_figures import checked_components
from gmmtorch.report.style import (
    HEIGHTS,
    LABEL_SIZE,
    SAVED_DPI,
    TICK_SIZE,
    colour,
    figure_title,
    new_figure,
)
from gmmtorch.scan import ArrayLike

_WIDTH = 11.0  # inches
_MAX_NAMED = 7
_PAINT = 0.55  # share of a robot's colour in what it learned; the rest is white
_LIGHTER = 0.25
_FRAME = "#777777"
_CENTRED: dict[str, Any] = {"ha": "center", "va": "center", "color": "#333333"}


def mixture_scene_figure(
    means: ArrayLike,
    covariances: ArrayLike,
    *,
    seen_from: ArrayLike | None = None,
    owners: ArrayLike | None = None,
    trajectories: Sequence[ArrayLike] = (),
    ceiling: float | None = None,
    camera: Camera | None = None,
    title: str | None = None,
    max_pixels: int = int(_WIDTH * SAVED_DPI),
) -> Figure:
    """Ellipsoids (2σ) of a mixture in parallel perspective, coloured by height or by who learned them.

    What hides the inside is left out, so that one looks through roof and near walls into the rooms: what is
    above the ceiling, flat components that were seen from the side turned away from the viewer, and what is
    at these.

    Args:
        means, covariances: (K, 3), (K, 3, 3); metres, m².
        seen_from: (K, 3), a place from which each was seen.
        owners: (K,), the robot that learned each: colours by robot. By height if not given.
        trajectories: of each robot, poses (T, ≥ 3), world metres.
        ceiling: height (m) above which nothing is drawn; if not given, some way beneath the top where most of
            what is overhead is up there, or nobody says whence it was seen.
        camera: whence it is seen; from the south-west, 45° up, if not given.
        title: of the figure; the number of components if not given.
        max_pixels: across the picture.

    Raises:
        InvalidArgumentError: shapes that disagree, or components that are not finite.
    """
    mean, covariance = (value.cpu() for value in checked_components(means, covariances))
    if mean.shape[1] != 3:
        raise InvalidArgumentError(f"means has shape {tuple(mean.shape)}; a scene needs (K, 3).")
    places = _as_rows("seen_from", seen_from, mean.shape)
    robots = _as_rows("owners", owners, mean.shape[:1])
    camera = camera or Camera(-120.0, 45.0)
    kept, top = cut_away(mean, covariance, places, ceiling, camera)
    paths = [smooth_path(path) for path in trajectories]
    low, high = _box(mean, covariance, kept, paths)
    mean, covariance = mean[kept], covariance[kept]
    scale = Normalize(*_heights(mean), clip=True)
    colours = _painted(robots[kept]) if robots is not None else _by_height(mean, scale)
    canvas = _canvas(low, high, camera, check_whole("max_pixels", max_pixels, 1))
    size = _WIDTH * (canvas.top - canvas.bottom) / (canvas.right - canvas.left)
    figure = new_figure(_WIDTH + (0.9 if robots is None else 0.0), size + 1.1)
    axes = figure.subplots()
    beads, bead_sizes, bead_colours = _beads(paths, 2.2 / canvas.scale)
    picture = render(
        torch.cat([mean, beads]),
        torch.cat([covariance, bead_sizes]),
        torch.cat([colours, bead_colours]),
        camera,
        canvas,
        tops=torch.cat([mean.new_full((len(mean),), top), beads.new_full((len(beads),), math.inf)]),
    )
    _draw_frame(axes, low, high, camera)
    _show(axes, picture.rgb, picture.depth, canvas)
    _draw_robots(axes, paths, camera)
    if robots is None:
        bar = figure.colorbar(
            ScalarMappable(scale, _height_colours()), ax=axes, shrink=0.6, pad=0.01, aspect=25
        )
        bar.set_label("height z [m]", fontsize=LABEL_SIZE)
        bar.ax.tick_params(labelsize=TICK_SIZE)
    _legend(figure, robots, len(paths))
    figure_title(figure, _title(kept) if title is None else title)
    return figure


def _title(kept: Tensor) -> str:
    count = f"{len(kept):,} component" + "s" * (len(kept) != 1)
    if bool(kept.all()):
        return f"The mixture: {count}"
    return f"The mixture: {int(kept.sum()):,} of {count}, those that hide the inside left out"


def _as_rows(name: str, value: ArrayLike | None, shape: Sequence[int]) -> Tensor | None:
    if value is None:
        return None
    rows = torch.as_tensor(value).detach().cpu()
    if rows.shape != tuple(shape):
        raise InvalidArgumentError(
            f"{name} has shape {tuple(rows.shape)}; expected {tuple(shape)}, a row a component."
        )
    return rows


def _heights(mean: Tensor) -> tuple[float, float]:
    if len(mean) == 0:
        return 0.0, 1.0
    low, high = (float(value) for value in np.quantile(mean[:, 2].numpy(), [0.01, 0.99]))
    return low, max(high, low + 1e-3)


def _by_height(mean: Tensor, scale: Normalize) -> Tensor:
    return torch.from_numpy(_height_colours()(np.asarray(scale(mean[:, 2].numpy())))[:, :3].copy())


def _height_colours() -> ListedColormap:
    """The usual colours of heights, lighter: shading takes some of the light away."""
    usual = matplotlib.colormaps[HEIGHTS](np.linspace(0, 1, 256))[:, :3]
    return ListedColormap(_LIGHTER + (1 - _LIGHTER) * usual)


def _painted(robots: Tensor) -> Tensor:
    """Light colours (K, 3) of the robots that learned each component."""
    names, index = torch.unique(robots.long(), return_inverse=True)
    strong = torch.tensor([to_rgb(colour(robot)) for robot in names.tolist()], dtype=torch.float64)
    return (_PAINT * strong.reshape(-1, 3) + 1 - _PAINT)[index]


def _box(
    mean: Tensor, covariance: Tensor, kept: Tensor, paths: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Corners (3,), (3,) around all, strays aside, but no higher than what is kept."""
    corners = [path for path in paths if len(path)]
    if len(mean):
        ends = np.quantile(mean.numpy(), [0.002, 0.998], axis=0)
        reach = 2 * covariance.diagonal(dim1=1, dim2=2).sqrt().median(0).values.numpy()
        reach[2] = 0.0
        if bool(kept.any()):
            ends[1, 2] = np.quantile(mean[kept, 2].numpy(), 0.998)
        corners.append(np.stack([ends[0] - reach, ends[1] + reach]))
    if not corners:
        return -np.ones(3), np.ones(3)
    every = np.concatenate(corners)
    return every.min(0) - 0.1, every.max(0) + 0.1


def _canvas(low: np.ndarray, high: np.ndarray, camera: Camera, pixels: int) -> Canvas:
    """Pixels around the projected box."""
    corners = torch.cartesian_prod(*(torch.tensor(pair) for pair in zip(low, high, strict=True)))
    flat = camera.project(corners)[:, :2]
    left, bottom = flat.amin(0).tolist()
    right, top = flat.amax(0).tolist()
    margin = 0.02 * (right - left)
    width = right - left + 2 * margin
    return Canvas(left - margin, right + margin, bottom - margin, top + margin, pixels / width)


def _beads(paths: Sequence[np.ndarray], radius: float) -> tuple[Tensor, Tensor, Tensor]:
    """Paths as strings of small balls (B, 3), (B, 3, 3) of the robots' colours (B, 3), that can be hidden."""
    places, colours = [], []
    for robot, path in enumerate(paths):
        if len(path) == 0:
            continue
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
        s = np.arange(0.0, along[-1] + radius, radius)
        places.append(np.stack([np.interp(s, along, path[:, axis]) for axis in range(3)], 1))
        colours.append(np.tile(to_rgb(colour(robot)), (len(s), 1)))
    balls = torch.from_numpy(np.concatenate(places)) if places else torch.empty(0, 3, dtype=torch.float64)
    shades = torch.from_numpy(np.concatenate(colours)) if places else balls
    size = (radius / 2) ** 2 * torch.eye(3, dtype=torch.float64)
    return balls, size.expand(len(balls), 3, 3), shades


def _show(axes: Axes, rgb: Tensor, depth: Tensor, canvas: Canvas) -> None:
    rows, columns = depth.shape
    image = torch.cat([rgb, torch.isfinite(depth)[..., None]], 2).mul(255).round().to(torch.uint8)
    extent = (
        canvas.left,
        canvas.left + columns / canvas.scale,
        canvas.bottom,
        canvas.bottom + rows / canvas.scale,
    )
    axes.imshow(image.numpy(), extent=extent, aspect="equal", zorder=2)
    axes.set_axis_off()


def _draw_frame(axes: Axes, low: np.ndarray, high: np.ndarray, camera: Camera) -> None:
    """A grid on the floor, with lengths along its two near edges and the height at a corner."""
    towards = camera.axes[2].numpy()
    near = np.where(towards[:2] > 0, high[:2], low[:2])
    far = np.where(towards[:2] > 0, low[:2], high[:2])
    span = high - low
    steps = MaxNLocator(nbins=6, steps=[1, 2, 5, 10])
    for axis in (0, 1):
        other = 1 - axis
        for value in steps.tick_values(low[axis], high[axis]):
            if not low[axis] <= value <= high[axis]:
                continue
            ends = np.tile([0.0, 0.0, low[2]], (3, 1))
            ends[:, axis] = value
            outward = math.copysign(0.012 * span[:2].max(), near[other] - far[other])
            ends[:, other] = far[other], near[other] + outward, near[other] + 3 * outward
            flat = camera.project(torch.from_numpy(ends)).numpy()
            axes.plot(*flat[:2, :2].T, color="#d5d5d5", linewidth=0.7, zorder=1)
            axes.text(flat[2, 0], flat[2, 1], f"{value:g}", fontsize=TICK_SIZE, **_CENTRED)
        middle = np.array([0.0, 0.0, low[2]])
        middle[axis] = (low[axis] + high[axis]) / 2
        middle[other] = near[other] + 8 * outward
        place = camera.project(torch.from_numpy(middle)).numpy()
        axes.text(place[0], place[1], f"{'xy'[axis]} [m]", fontsize=LABEL_SIZE, **_CENTRED)
    floor = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]], low[:2]])
    outline = np.concatenate([floor, np.full((5, 1), low[2])], 1)
    axes.plot(
        *camera.project(torch.from_numpy(outline)).numpy()[:, :2].T, color=_FRAME, linewidth=0.9, zorder=1
    )


def _draw_robots(axes: Axes, paths: Sequence[np.ndarray], camera: Camera) -> None:
    """Where the paths begin and end, and, faintly, the parts of them that are hidden."""
    halo = [Stroke(linewidth=2.5, foreground="white"), Normal()]
    for robot, path in enumerate(paths):
        if len(path) == 0:
            continue
        flat = camera.project(torch.from_numpy(path)).numpy()
        axes.plot(*flat[:, :2].T, color=colour(robot), linewidth=0.8, alpha=0.35, zorder=3)
        for place, shape in ((flat[0], "o"), (flat[-1], "^")):
            axes.plot(
                *place[:2],
                shape,
                color=colour(robot),
                markersize=9,
                markeredgecolor="#111111",
                zorder=4,
                path_effects=halo,
            )


def _legend(figure: Figure, robots: Tensor | None, n_paths: int) -> None:
    handles = []
    learned = sorted({int(robot) for robot in robots.tolist()}) if robots is not None else []
    for robot in sorted({*learned, *range(n_paths)})[:_MAX_NAMED]:
        look: dict[str, Any] = (
            {"linewidth": 2.4} if robot < n_paths else {"linestyle": "", "marker": "o", "markersize": 8}
        )
        handles.append(Line2D([], [], color=colour(robot), label=f"robot {robot}", **look))
    if n_paths:
        look = {"color": "#666666", "linestyle": "", "markersize": 8}
        handles += [Line2D([], [], marker=m, label=t, **look) for m, t in (("o", "start"), ("^", "end"))]
    if handles:
        figure.legend(
            handles=handles,
            loc="outside lower center",
            ncols=min(len(handles), 9),
            frameon=False,
            fontsize=LABEL_SIZE,
        )

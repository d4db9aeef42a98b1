"""Figures of mixtures: 2σ ellipses over their points in 2D, shaded ellipsoids in 3D."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import Normalize, to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from torch import Tensor

from gmmtorch.report import style
from gmmtorch.report.ellipsoids import (
    checked_components,
    checked_rows,
    cut_away,
    ellipse_outlines,
    height_colours,
)
from gmmtorch.report.map_images import inside, robust_bounds
from gmmtorch.report.scenes import SOUTH_WEST, Ellipsoids, balls, canvas_around, draw_scene, height_bar
from gmmtorch.report.text import count_text
from gmmtorch.scan import ArrayLike

MAX_POINTS = 20_000
MAX_ELLIPSES = 5_000
MAX_ELLIPSOIDS = 3_000

_PANEL_WIDTH = 6.6  # inches, of each view of a 3D mixture
_MARGIN = 0.04  # of the longest side of what is shown
_POINT, _ELLIPSE = "#8a8a8a", style.PALETTE[0]
_POINT_PIXELS = 1.2  # radius of a point in the view in space

Corner = Sequence[float]


def mixture_figure(
    points: ArrayLike,
    means: ArrayLike,
    covariances: ArrayLike,
    weights: ArrayLike,
    *,
    seen_from: ArrayLike | None = None,
    title: str = "Gaussian mixture",
    max_components: int | None = None,
) -> Figure:
    """Draws the 2σ ellipses (2D) or ellipsoids (3D) of a mixture with the points that it was fitted to.

    In 3D, draws a view in space and a view from above, both coloured by height. If there are more components
    than `max_components`, draws those with the largest weights; the title states how many.

    Args:
        points: (N, D), metres; at most 20,000 are drawn.
        means: (K, D), metres.
        covariances: (K, D, D), m².
        weights: (K,), on any positive scale.
        seen_from: (K, 3), a sensor origin that observed each component: the view in space then leaves out
            ceilings and near walls, so that rooms are open. If None, it shows all components.
        title: title of the figure; the numbers of components and points are added.
        max_components: largest number to draw; if None, 5,000 in 2D and 3,000 in 3D.

    Raises `InvalidArgumentError` if shapes disagree.
    """
    mean, covariance = (value.cpu() for value in checked_components(means, covariances))
    dim = mean.shape[1]
    cloud, weight = style.as_array(points).reshape(-1, dim), style.as_array(weights)
    places = checked_rows("seen_from", seen_from, mean)
    limit = max_components or (MAX_ELLIPSES if dim == 2 else MAX_ELLIPSOIDS)
    shown = torch.from_numpy(np.sort(np.argsort(-weight, kind="stable")[:limit]))
    mean, covariance = mean[shown], covariance[shown]
    low, high = robust_bounds(cloud if len(cloud) else mean, margin=0.0)
    margin = max(_MARGIN * max(b - a for a, b in zip(low, high, strict=True)), 0.05)
    box = [a - margin for a in low], [b + margin for b in high]
    cloud_shown = cloud[style.even_sample(len(cloud), MAX_POINTS)]
    if dim == 2:
        figure = _flat_figure(cloud_shown, mean, covariance, box)
    else:
        figure = _solid_figure(cloud_shown, mean, covariance, None if places is None else places[shown], box)
    count = count_text(len(weight), "component")
    if len(shown) < len(weight):
        count = f"{len(shown):,} largest of {count}"
    points_drawn = f", {count_text(len(cloud), 'point')}" if len(cloud) else ""
    style.figure_title(figure, f"{title}: {count}{points_drawn}")
    return figure


def _flat_figure(points: np.ndarray, mean: Tensor, covariance: Tensor, box: tuple[Corner, Corner]) -> Figure:
    (x0, y0), (x1, y1) = box
    shape = float(np.clip((y1 - y0) / (x1 - x0), 0.25, 4.0))
    width = 8.2 / max(1.0, shape**0.5)
    figure = style.new_figure(max(width + 0.8, 6.4), width * shape + 1.5)
    axes = figure.subplots()
    colours = np.tile(to_rgb(_ELLIPSE), (len(mean), 1))
    _draw_from_above(axes, points, ellipse_outlines(mean, covariance), colours, box)
    style.label_axes(axes, "", "x [m]", "y [m]")
    _mixture_legend(figure, "2σ ellipses", len(points) > 0)
    return figure


def _solid_figure(
    points: np.ndarray, mean: Tensor, covariance: Tensor, seen_from: Tensor | None, box: tuple[Corner, Corner]
) -> Figure:
    low, high = box
    canvas = canvas_around(low, high, SOUTH_WEST, int(_PANEL_WIDTH * style.SAVED_DPI))
    tall = (canvas.top - canvas.bottom) / (canvas.right - canvas.left)
    tall = max(tall, (high[1] - low[1]) / (high[0] - low[0]))
    figure = style.new_figure(2 * _PANEL_WIDTH + 1.0, float(np.clip(_PANEL_WIDTH * tall, 4.0, 7.0)) + 1.4)
    space, plan = figure.subplots(1, 2)
    scale = Normalize(low[2], high[2], clip=True)
    shown, cloud, top = inside(mean, box), torch.from_numpy(points), np.inf
    if seen_from is None:
        style.label_axes(space, "in space")
        cloud = cloud[inside(cloud, box)]
    else:  # also without points, which would stand where the components were that hide the inside
        style.label_axes(space, "in space, ceilings and near walls left out")
        kept, top = cut_away(mean, covariance, seen_from, SOUTH_WEST)
        shown, cloud = shown & kept, cloud[:0]
    components = Ellipsoids(mean[shown], covariance[shown], height_colours(mean[shown, 2], scale), top)
    grey = torch.tensor(to_rgb(_POINT), dtype=torch.float64)
    dots = balls(cloud, _POINT_PIXELS / canvas.scale, grey)
    draw_scene(space, [components, dots], low, high, SOUTH_WEST, canvas)
    order = torch.argsort(mean[:, 2], stable=True)  # higher components cover lower ones
    mean, covariance = mean[order], covariance[order]
    outlines = ellipse_outlines(mean[:, :2], covariance[:, :2, :2])
    _draw_from_above(plan, points, outlines, height_colours(mean[:, 2], scale).numpy(), box)
    style.label_axes(plan, "from above", "x [m]", "y [m]")
    height_bar(figure, plan, scale)
    _mixture_legend(figure, "2σ ellipsoids", len(points) > 0)
    return figure


def _draw_from_above(
    axes: Axes, points: np.ndarray, outlines: np.ndarray, colours: np.ndarray, box: tuple[Corner, Corner]
) -> None:
    """Draws points, and ellipses (K, C, 2) with colours (K, 3), in the x-y plane."""
    size = float(np.clip(12000 / max(len(points), 1), 1.0, 14))
    axes.scatter(points[:, 0], points[:, 1], s=size, color=_POINT, linewidths=0, rasterized=True)
    opacity = _opacity(outlines)[:, None]
    patches = PolyCollection(
        list(outlines),
        facecolors=np.hstack([colours, opacity]),
        edgecolors=np.hstack([colours, np.minimum(2 * opacity, 1)]),
        linewidths=1.2 if len(outlines) < 500 else 0.6,
    )
    axes.add_collection(patches, autolim=False)
    low, high = box
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")


def _opacity(outlines: np.ndarray) -> np.ndarray:
    """Returns the opacity (K,) of ellipses: large ones are faint, so that small ones stay visible."""
    x, y = outlines[..., 0], outlines[..., 1]
    area = np.abs((x * np.roll(y, -1, 1) - y * np.roll(x, -1, 1)).sum(1)) / 2
    typical = np.median(area) if len(area) else 1.0
    return np.clip(0.5 * np.sqrt(typical / np.maximum(area, 1e-300)), 0.04, 0.5)


def _mixture_legend(figure: Figure, shapes: str, with_points: bool) -> None:
    """Draws the legend with marks large enough to see."""
    look: dict[str, Any] = {"linestyle": "", "marker": "o"}
    handles = [Line2D([], [], color=_POINT, markersize=5, label="points", **look)] if with_points else []
    handles.append(Line2D([], [], color=_ELLIPSE, fillstyle="none", markersize=10, label=shapes, **look))
    style.legend_below(figure, handles)

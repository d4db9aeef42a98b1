"""A mixture over the points it was fitted to: ellipses in 2D, shaded ellipsoids in 3D."""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PolyCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.report.maps.mesh_figures import checked_components, ellipsoid_mesh
from gmmtorch.report.style import (
    HEIGHTS,
    LABEL_SIZE,
    PALETTE,
    TICK_SIZE,
    TITLE_SIZE,
    as_array,
    dress,
    evenly,
    figure_title,
    new_figure,
)
from gmmtorch.scan import ArrayLike

MAX_POINTS = 20_000
MAX_ELLIPSES = 5_000
MAX_ELLIPSOIDS = 3_000

_N_SIGMA = 2.0
_ELEVATION, _AZIMUTH = 35.0, -60.0  # of the viewer, degrees
_POINTS, _EDGE, _ORIGIN = "#8a8a8a", PALETTE[0], PALETTE[1]
_LIGHT = np.array([0.35, -0.5, 0.8]) / np.linalg.norm([0.35, -0.5, 0.8])


def mixture_figure(
    points: ArrayLike,
    means: ArrayLike,
    covariances: ArrayLike,
    weights: ArrayLike,
    origins: ArrayLike | None = None,
    *,
    title: str = "Gaussian mixture",
    max_components: int | None = None,
) -> Figure:
    """The 2σ ellipses (2D) or ellipsoids (3D) of a mixture over its points.

    In 3D a perspective view, coloured by height, and the ellipses as seen from the top. Of many
    components those of the largest weights are drawn, and the title says how many.

    Args:
        points: (N, D), metres; of many an even share is drawn.
        means, covariances, weights: (K, D), (K, D, D), (K,); metres, m², any positive scale.
        origins: (S, D) sensor positions, if they are to be shown.
        title: of the figure; the numbers of components and points are added.
        max_components: the most to draw; 5000 in 2D, 3000 in 3D if not given.

    Raises:
        InvalidArgumentError: shapes that disagree.
    """
    mean, covariance = (value.cpu() for value in checked_components(means, covariances))
    dim = mean.shape[1]
    cloud, weight = as_array(points).reshape(-1, dim), as_array(weights)
    if weight.shape != (len(mean),):
        raise InvalidArgumentError(
            f"weights has shape {weight.shape}; expected ({len(mean)},), one a component."
        )
    positions = np.empty((0, dim)) if origins is None else as_array(origins).reshape(-1, dim)
    limit = max_components or (MAX_ELLIPSES if dim == 2 else MAX_ELLIPSOIDS)
    shown = np.sort(np.argsort(-weight, kind="stable")[:limit])
    mean, covariance = mean[shown], covariance[shown]
    seen = cloud[evenly(len(cloud), MAX_POINTS)]
    box = _box(cloud, mean.numpy(), weight[shown], positions)
    figure = (
        _flat(seen, mean, covariance, positions, box)
        if dim == 2
        else _solid(seen, mean, covariance, positions, box)
    )
    count = f"{len(weight):,} component" + "s" * (len(weight) != 1)
    if len(shown) < len(weight):
        count = f"the {len(shown):,} heaviest of {count}"
    figure_title(figure, f"{title}: {count}, {len(cloud):,} point" + "s" * (len(cloud) != 1))
    return figure


def _box(
    points: np.ndarray, means: np.ndarray, weights: np.ndarray, origins: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Corners of what is shown: the inner 99 % of points and mixture along each axis, all sensor
    positions, and a margin."""
    corners = [np.quantile(points, [0.005, 0.995], axis=0)] if len(points) else []
    if len(means):
        corners.append(np.stack([_quantiles(column, weights) for column in means.T], 1))
    if len(origins):
        corners.append(np.stack([origins.min(0), origins.max(0)]))
    if not corners:
        return -np.ones(points.shape[1]), np.ones(points.shape[1])
    low, high = np.min(corners, axis=(0, 1)), np.max(corners, axis=(0, 1))
    margin = max(0.04 * float((high - low).max()), 0.05)
    return low - margin, high + margin


def _quantiles(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The values below and above which lies half a percent of the weight."""
    order = np.argsort(values, kind="stable")
    share = np.cumsum(np.maximum(weights[order], 0) + 1e-300)
    found = np.searchsorted(share, np.array([0.005, 0.995]) * share[-1])
    return values[order][np.minimum(found, len(values) - 1)]


def _ellipses(mean: torch.Tensor, covariance: torch.Tensor, n_corners: int = 40) -> np.ndarray:
    """2σ ellipses (K, C, 2) of 2D components."""
    angle = torch.arange(n_corners, dtype=torch.float64) * (2 * torch.pi / n_corners)
    circle = torch.stack([angle.cos(), angle.sin()], 1)
    if len(mean) == 0:
        return np.empty((0, n_corners, 2))
    variances, directions = torch.linalg.eigh((covariance + covariance.mT) / 2)
    axes = directions * variances.clamp_min(0).sqrt()[:, None, :]
    return (mean[:, None] + _N_SIGMA * circle @ axes.mT).numpy()


def _opacity(ellipses: np.ndarray) -> np.ndarray:
    """Of each ellipse (K,): large ones are faint, that they do not bury the small ones."""
    x, y = ellipses[..., 0], ellipses[..., 1]
    area = np.abs((x * np.roll(y, -1, 1) - y * np.roll(x, -1, 1)).sum(1)) / 2
    typical = np.median(area) if len(area) else 1.0
    return np.clip(0.5 * np.sqrt(typical / np.maximum(area, 1e-300)), 0.04, 0.5)


def _draw_plane(
    axes: Axes,
    points: np.ndarray,
    ellipses: np.ndarray,
    colours: np.ndarray,
    origins: np.ndarray,
    box: tuple[np.ndarray, np.ndarray],
) -> None:
    """Points, ellipses (K, C, 2) in their colours (K, 3), and sensor positions in the x-y plane."""
    size = float(np.clip(12000 / max(len(points), 1), 1.0, 14))
    axes.scatter(points[:, 0], points[:, 1], s=size, color=_POINTS, linewidths=0, rasterized=True)
    opacity = _opacity(ellipses)[:, None]
    patches = PolyCollection(
        list(ellipses),
        facecolors=np.hstack([colours, opacity]),
        edgecolors=np.hstack([colours, np.minimum(2 * opacity, 1)]),
        linewidths=1.2 if len(ellipses) < 500 else 0.6,
    )
    axes.add_collection(patches, autolim=False)
    if len(origins):
        size = 8 if len(origins) < 20 else 5
        look = {"color": _ORIGIN, "markeredgecolor": "white", "markersize": size, "markeredgewidth": 0.5}
        axes.plot(origins[:, 0], origins[:, 1], "^", **look)  # type: ignore[arg-type]
    axes.set(xlim=(box[0][0], box[1][0]), ylim=(box[0][1], box[1][1]), aspect="equal")


def _legend(figure: Figure, shapes: str, with_origins: bool) -> None:
    """Beneath the picture, with marks that can be seen however small the points are."""
    handles = [
        Line2D([], [], color=_POINTS, marker="o", linestyle="", markersize=5, label="points"),
        Line2D([], [], color=_EDGE, marker="o", linestyle="", fillstyle="none", markersize=10, label=shapes),
    ]
    if with_origins:
        handles.append(
            Line2D([], [], color=_ORIGIN, marker="^", linestyle="", markersize=8, label="sensor positions")
        )
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False, fontsize=LABEL_SIZE)


def _flat(
    points: np.ndarray,
    mean: torch.Tensor,
    covariance: torch.Tensor,
    origins: np.ndarray,
    box: tuple[np.ndarray, np.ndarray],
) -> Figure:
    side = box[1] - box[0]
    shape = float(np.clip(side[1] / side[0], 0.25, 4.0))
    width = 8.2 / max(1.0, shape**0.5)
    figure = new_figure(max(width + 0.8, 6.4), width * shape + 1.5)
    axes = figure.subplots()
    ellipses = _ellipses(mean, covariance)
    colours = np.tile(matplotlib.colors.to_rgb(_EDGE), (len(ellipses), 1))
    _draw_plane(axes, points, ellipses, colours, origins, box)
    dress(axes, "", "x [m]", "y [m]")
    _legend(figure, "2σ ellipses", len(origins) > 0)
    return figure


def _solid(
    points: np.ndarray,
    mean: torch.Tensor,
    covariance: torch.Tensor,
    origins: np.ndarray,
    box: tuple[np.ndarray, np.ndarray],
) -> Figure:
    side = box[1] - box[0]
    width = 5.6 / float(np.clip(side[1] / side[0], 0.55, 1.8))  # of the view from above
    figure = new_figure(7.4 + width + 1.6, 7.2)
    spec = figure.add_gridspec(1, 2, width_ratios=[7.4, width + 1.6])
    view, plan = figure.add_subplot(spec[0], projection="3d"), figure.add_subplot(spec[1])
    heights = matplotlib.colormaps[HEIGHTS]
    scale = Normalize(box[0][2], box[1][2], clip=True)
    _draw_perspective(view, points, mean, covariance, ScalarMappable(scale, heights), origins, box)
    order = torch.argsort(mean[:, 2], stable=True)  # from the top, higher ones cover lower ones
    mean, covariance = mean[order], covariance[order]
    colours = heights(scale(mean[:, 2].numpy()))[:, :3]
    _draw_plane(plan, points, _ellipses(mean[:, :2], covariance[:, :2, :2]), colours, origins, box)
    dress(plan, "from above", "x [m]", "y [m]")
    bar = figure.colorbar(ScalarMappable(scale, heights), ax=plan, pad=0.02, shrink=0.9)
    bar.set_label("height z [m]", fontsize=LABEL_SIZE)
    bar.ax.tick_params(labelsize=TICK_SIZE)
    _legend(figure, "2σ ellipsoids", len(origins) > 0)
    return figure


def _draw_perspective(
    axes: Any,  # mpl_toolkits has no types
    points: np.ndarray,
    mean: torch.Tensor,
    covariance: torch.Tensor,
    heights: ScalarMappable,
    origins: np.ndarray,
    box: tuple[np.ndarray, np.ndarray],
) -> None:
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    inside = points[((points >= box[0]) & (points <= box[1])).all(1)]
    axes.scatter(*inside.T, s=1.5, color=_POINTS, alpha=0.6, linewidths=0, depthshade=False, rasterized=True)
    within = torch.from_numpy(((mean.numpy() >= box[0]) & (mean.numpy() <= box[1])).all(1))
    n_shown = int(within.sum())
    mesh = ellipsoid_mesh(mean[within], covariance[within], _N_SIGMA, 2 if n_shown <= 200 else 1)
    triangles = mesh.vertices[mesh.faces].numpy()
    if n_shown:
        triangles, light = _towards_viewer(triangles)
        shades = np.asarray(heights.to_rgba(triangles[:, :, 2].mean(1)))
        shades[:, :3] *= (0.75 + 0.25 * light)[:, None]
        shades[:, 3] = 0.7
        axes.add_collection3d(Poly3DCollection(triangles, facecolors=shades, linewidths=0), autolim=False)
    if len(origins):
        axes.plot(*origins.T, "^", color=_ORIGIN, markeredgecolor="white", markersize=6, zorder=10)
    axes.set(xlim=(box[0][0], box[1][0]), ylim=(box[0][1], box[1][1]), zlim=(box[0][2], box[1][2]))
    axes.set_box_aspect(box[1] - box[0], zoom=1.1)
    axes.view_init(elev=_ELEVATION, azim=_AZIMUTH)
    axes.set_title("perspective", fontsize=TITLE_SIZE)
    axes.set_xlabel("x [m]", fontsize=LABEL_SIZE)
    axes.set_ylabel("y [m]", fontsize=LABEL_SIZE)
    # Above its axis: beside it, the name would reach into the other panel.
    axes.text(*box[1], "z [m]\n", fontsize=LABEL_SIZE, ha="center", va="bottom", linespacing=0.5)
    for name in "xyz":
        getattr(axes, f"{name}axis").set_pane_color((0.97, 0.97, 0.97, 1.0))
    axes.tick_params(labelsize=TICK_SIZE - 1)


def _towards_viewer(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The triangles (F, 3, 3) that face the viewer, or nearly do, and how directly the light falls on
    each, −1 … 1. Those behind would shine through, and are half the work."""
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    elevation, azimuth = np.radians(_ELEVATION), np.radians(_AZIMUTH)
    level = np.cos(elevation)
    towards = np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
    front = normals @ towards > -0.1  # the perspective sees a little around the edge
    return triangles[front], normals[front] @ _LIGHT

"""Figures that compare maps side by side, and a moving picture of a map that grows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
import torch
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PolyCollection
from matplotlib.colors import Colormap, LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from PIL import Image
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.files import write_atomically
from gmmtorch.mapping import GaussianMap
from gmmtorch.report import map_images, style
from gmmtorch.report.ellipsoids import ellipse_outlines
from gmmtorch.scan import ArrayLike

_MAX_COLUMNS = 4
_GREYS = [(0.0, "#ffffff"), (0.3, "#dedede"), (0.5, "#9c9c9c"), (0.67, "#404040"), (1.0, "#000000")]
_NONE = "#f1f1f1"  # a column without an occupied cell
_PATH, _START, _END = style.PALETTE[1], style.PALETTE[2], style.PALETTE[0]
_TRUE, _LOST = style.PALETTE[5], style.PALETTE[3]


def map_figure(
    panels: Sequence[map_images.MapPanel],
    trajectories: Sequence[ArrayLike] = (),
    *,
    truth: ArrayLike | None = None,
    lost: ArrayLike | None = None,
    title: str | None = None,
    max_pixels: int = map_images.MAX_PIXELS,
    max_queries: int = map_images.MAX_QUERIES,
) -> Figure:
    """Draws one panel per map: occupied dark, free light, unknown (θ within 0.02 of ½) blue-grey.

    In 3D, draws a horizontal slice of each map, and below it the height of the highest occupied cells. The
    slice is at the median height of the trajectories, or without one in the middle of the region. If most of
    the trajectories lies under a roof, the view from above leaves out what is half a metre above them.

    Args:
        panels: one or more maps, all 2D or all 3D.
        trajectories: sensor positions (S, D) of each drive in order, world metres.
        truth: true positions (S, D), drawn beside the trajectories.
        lost: positions (S, D) near which a scan was not localised.
        max_pixels: pixels along each side of a picture; larger regions are sampled more coarsely.
        max_queries: largest number of queries for one view from above.
    """
    dim = panels[0].dim
    paths = [style.as_array(path) for path in trajectories if len(path)]
    flown = np.concatenate(paths) if paths else None
    n_bands = math.ceil(len(panels) / _MAX_COLUMNS)
    n_columns = math.ceil(len(panels) / n_bands)
    n_views = dim - 1  # rows of pictures in a band of panels
    figure, grid, shown_pixels = _sheet(panels, n_columns, n_bands * n_views)
    bands = [grid[i * n_views : (i + 1) * n_views] for i in range(n_bands)]
    slices = np.concatenate([band[0] for band in bands])
    if flown is not None and dim == 3:
        height = float(np.median(flown[:, 2]))
    else:
        height = 0.0 if dim == 2 else (panels[0].low[2] + panels[0].high[2]) / 2
    for axes, panel in zip(slices, panels, strict=False):
        _draw_slice(axes, panel, paths, height, max_pixels, shown_pixels)
    greys = ScalarMappable(Normalize(0, 1), occupancy_colours())
    for band in bands:
        style.colour_bar(figure, greys, band[0].tolist(), "occupancy probability θ")
    if dim == 3:
        views = [band[1] for band in bands]
        # One ceiling for all: panels that are cut at different heights cannot be compared.
        has_roof = flown is not None and any(map_images.roof_above(panel, flown) for panel in panels)
        top = height + map_images.HEADROOM if has_roof else math.inf
        _draw_heights(figure, views, panels, paths, top, shown_pixels, max_queries)
    for axes in bands[-1][:, len(panels) - (n_bands - 1) * n_columns :].flat:
        axes.set_visible(False)
    for axes in np.concatenate([band[-1] for band in bands]):
        axes.set_xlabel("x [m]", fontsize=style.LABEL_SIZE)
    for axes in grid[:, 0]:
        axes.set_ylabel("y [m]", fontsize=style.LABEL_SIZE)
    for axes in grid.flat:
        _draw_beside(axes, truth, lost)
    style.legend_below(figure, [*_legend(bool(paths), dim), *_legend_beside(truth, lost)])
    style.figure_title(figure, title)
    return figure


def _draw_slice(
    axes: Axes,
    panel: map_images.MapPanel,
    paths: list[np.ndarray],
    height: float,
    max_pixels: int,
    shown_pixels: int,
) -> None:
    """Draws θ of the cells in 2D, or of those at z = `height` (m) in 3D, and the sensor paths."""
    cells = f"cells of {style.metres(panel.resolution)}"
    image = map_images.slice_image(panel, height, max_pixels, shown_pixels)
    # Colours are resampled, not probabilities: the mean of free and occupied would look unknown.
    image.draw(axes, occupancy_colours()(np.ma.masked_invalid(image.image.numpy())), "antialiased")
    _draw_paths(axes, panel, paths)
    caption = f"slice at z = {style.metres(height)}, {cells}" if panel.dim == 3 else cells
    style.label_axes(axes, f"{panel.title}\n{caption}")


def _draw_heights(
    figure: Figure,
    bands: list[np.ndarray],
    panels: Sequence[map_images.MapPanel],
    paths: list[np.ndarray],
    top: float,
    shown_pixels: int,
    max_queries: int,
) -> None:
    """Draws the views from above, of the cells below z = `top` (m), with a colour bar for each band."""
    cut = [_below(panel, top) for panel in panels]
    images = [map_images.height_image(panel, shown_pixels, max_queries) for panel in cut]
    known = torch.cat([image.image[image.image.isfinite()] for image in images])
    colours = matplotlib.colormaps[style.HEIGHTS].with_extremes(bad=_NONE)
    heights = ScalarMappable(style.height_scale(known), colours)
    for axes, whole, panel, image in zip(np.concatenate(bands), panels, cut, images, strict=False):
        image.draw(axes, heights.to_rgba(np.ma.masked_invalid(image.image.numpy())))
        _draw_paths(axes, panel, paths)
        below = f" below z = {style.metres(panel.high[2])}" if panel.high[2] < whole.high[2] else ""
        style.label_axes(axes, f"highest cell with θ > {map_images.OCCUPIED_ABOVE:g}{below}")
    for band in bands:
        style.colour_bar(figure, heights, band.tolist(), "height z [m]", extend="both")


def _sheet(
    panels: Sequence[map_images.MapPanel], n_columns: int, n_rows: int
) -> tuple[Figure, np.ndarray, int]:
    """Returns a figure with panels of the shape of the region, its axes (rows, columns), and the number of
    pixels along the longer side of a panel."""
    sides = np.array([[p.high[a] - p.low[a] for a in range(2)] for p in panels])
    shape = float(np.clip((sides[:, 1] / sides[:, 0]).max(), 0.3, 2.5))
    width = {1: 6.4, 2: 5.2}.get(n_columns, 4.4) / max(1.0, shape**0.5)
    figure = style.new_figure((width + 0.35) * n_columns + 1.7, (width * shape + 0.6) * n_rows + 1.4)
    axes = np.asarray(figure.subplots(n_rows, n_columns, squeeze=False))
    return figure, axes, int(width * max(shape, 1.0) * style.SAVED_DPI)


def occupancy_colours() -> Colormap:
    """Returns the colours of θ: white for free, black for occupied, blue-grey for NaN."""
    greys = LinearSegmentedColormap.from_list("occupancy", _GREYS)
    return greys.with_extremes(bad=style.UNKNOWN)


def _draw_paths(axes: Axes, panel: map_images.MapPanel, paths: Sequence[np.ndarray]) -> None:
    """Draws the sensor paths, and limits the axes to the region of the panel."""
    axes.set(xlim=(panel.low[0], panel.high[0]), ylim=(panel.low[1], panel.high[1]))
    size = 8 if len(paths) == 1 else 5
    for path in paths:
        axes.plot(path[:, 0], path[:, 1], color=_PATH, linewidth=1.2, path_effects=style.halo(2.6), zorder=3)
        for (x, y), shape, hue in ((path[0, :2], "o", _START), (path[-1, :2], "s", _END)):
            axes.plot(x, y, shape, color=hue, markersize=size, markeredgecolor="white", zorder=4)


def _draw_beside(axes: Axes, truth: ArrayLike | None, lost: ArrayLike | None) -> None:
    if truth is not None:
        path = style.as_array(truth)
        axes.plot(path[:, 0], path[:, 1], color=_TRUE, linewidth=3.0, zorder=2.5)
    if lost is not None:
        marks = style.as_array(lost)
        axes.plot(marks[:, 0], marks[:, 1], "x", color=_LOST, markersize=7, markeredgewidth=2, zorder=5)


def _legend_beside(truth: ArrayLike | None, lost: ArrayLike | None) -> list[Artist]:
    true = Line2D([], [], color=_TRUE, linewidth=3, label="true path")
    mark = Line2D([], [], color=_LOST, marker="x", linestyle="", markeredgewidth=2, label="scan not found")
    return [line for line, given in ((true, truth), (mark, lost)) if given is not None]


def _below(panel: map_images.MapPanel, ceiling: float) -> map_images.MapPanel:
    """Cuts the panel at the layer boundary nearest to the ceiling, but keeps at least one layer."""
    if ceiling >= panel.high[2]:
        return panel
    top = max(round(ceiling / panel.resolution) * panel.resolution, panel.low[2] + panel.resolution)
    return replace(panel, high=(*panel.high[:2], top))


def _legend(has_paths: bool, dim: int) -> list[Artist]:
    handles: list[Artist] = [Patch(facecolor=style.UNKNOWN, edgecolor=style.EDGE, label="unknown (θ ≈ ½)")]
    if dim == 3:
        handles.append(Patch(facecolor=_NONE, edgecolor=style.EDGE, label="no such cell"))
    if has_paths:
        handles += [
            Line2D([], [], color=_PATH, linewidth=2, label="sensor path"),
            Line2D([], [], color=_START, marker="o", linestyle="", markersize=8, label="start"),
            Line2D([], [], color=_END, marker="s", linestyle="", markersize=8, label="end"),
        ]
    return handles


_WIDTH, _DPI = 6.4, 100  # inches, and pixels per inch
_COMPONENT = style.PALETTE[0]
_BEAM_STRIDE = 3  # of the beams of the newest scan that are drawn
_QUALITY = 72  # of WebP
_LAST_FRAME = 4000  # milliseconds


class GrowthFrame(NamedTuple):
    """A map in 2D after some scans.

    n_scans: in the map. shown: a copy of the map. path: (S, 2) sensor positions, world metres.
    hits: (N, 2) returns of the newest scan.
    """

    n_scans: int
    shown: GaussianMap
    path: Tensor
    hits: Tensor


def save_growth(
    path: str | Path, frames: Sequence[GrowthFrame], *, resolution: float, period: float = 0.15
) -> Path:
    """Writes frames as an animated WebP or GIF that repeats, and returns its path.

    Args:
        path: file name that ends in .webp or .gif.
        frames: the map as it grows; the last one is the finished map.
        resolution: side (m) of the cells of occupancy.
        period: seconds of a frame; the last one is shown for four seconds.

    Raises `InvalidArgumentError` for another suffix, no frame, or a map in 3D.
    """
    path = Path(path)
    if path.suffix.lower() not in (".webp", ".gif"):
        raise InvalidArgumentError(f"path={path} must end in .webp or .gif.")
    if not frames or frames[-1].shown.dim != 2:
        raise InvalidArgumentError("frames must contain at least one map, and only maps in 2D.")
    last = frames[-1]
    solid = last.shown.components()
    means = solid.means[~solid.max_range].cpu()
    box = map_images.robust_bounds(means, last.path, share=0.995, margin=0.8)
    pictures = [_picture(frame, last.n_scans, box, resolution) for frame in frames]
    durations = [round(1000 * period)] * (len(pictures) - 1) + [_LAST_FRAME]

    def write(temporary: Path) -> None:
        first, *others = pictures
        options: dict[str, Any] = (
            {"quality": _QUALITY, "method": 4} if path.suffix.lower() == ".webp" else {"disposal": 1}
        )
        first.save(temporary, save_all=True, append_images=others, duration=durations, loop=0, **options)

    return write_atomically(path, write)


def _picture(frame: GrowthFrame, n_total: int, box: map_images.Corners, resolution: float) -> Image.Image:
    """One frame as a picture; all frames have the same layout."""
    (left, bottom), (right, top) = box
    side = _WIDTH - 0.2
    height = side * (top - bottom) / (right - left)
    page = Figure(figsize=(_WIDTH, height + 0.95), facecolor="white", dpi=_DPI)
    canvas = FigureCanvasAgg(page)
    axes = page.add_axes((0.1 / _WIDTH, 0.4 / (height + 0.95), side / _WIDTH, height / (height + 0.95)))
    _draw_map(axes, frame, box, resolution)
    axes.set(xlim=(left, right), ylim=(bottom, top), xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set_color(style.EDGE)
    _write_numbers(page, frame, n_total, height + 0.95)
    _draw_legend(page)
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())


def _draw_map(axes: Axes, frame: GrowthFrame, box: map_images.Corners, resolution: float) -> None:
    """Draws occupancy, 2σ ellipses, the path, and the sensor with the beams of its newest scan."""
    shown = frame.shown

    def answer(points: Tensor) -> Tensor:
        return shown.occupancy(points, resolution)  # type: ignore[return-value]

    image = map_images.slice_image(
        map_images.MapPanel("", answer, resolution, *box), shown_pixels=round(_WIDTH * _DPI)
    )
    theta = np.ma.masked_invalid(image.image.numpy())
    image.draw(axes, occupancy_colours()(theta), "antialiased")
    components = shown.components()
    solid = ~components.max_range
    outlines = ellipse_outlines(components.means[solid].cpu(), components.covariances[solid].cpu())
    axes.add_collection(
        PolyCollection(
            list(outlines), facecolors=_COMPONENT, edgecolors=_COMPONENT, alpha=0.65, linewidths=0.7
        )
    )
    axes.plot(*frame.path.T, color=_PATH, linewidth=1.0, alpha=0.85, solid_joinstyle="round", zorder=3)
    sensor = frame.path[-1]
    beams = torch.stack([sensor.expand_as(frame.hits), frame.hits, torch.full_like(frame.hits, torch.nan)], 1)
    fan = beams[::_BEAM_STRIDE].reshape(-1, 2)
    axes.plot(*fan.T, color=_PATH, linewidth=0.5, alpha=0.35, zorder=3)
    axes.plot(*sensor, "o", color=_PATH, markersize=9, markeredgecolor="white", zorder=4)


def _write_numbers(page: Figure, frame: GrowthFrame, n_total: int, height: float) -> None:
    """Writes scans, components and bytes in columns that stay where they are."""
    shown = frame.shown
    numbers = (
        (0.26, f"{frame.n_scans:,}", f" of {n_total:,} scans"),
        (0.60, f"{shown.n_components:,}", " components"),
        (0.88, f"{shown.nbytes / 1e3:,.0f}", " kB"),
    )
    y = 1 - 0.28 / height
    for x, value, unit in numbers:
        page.text(x - 0.02, y, value, ha="right", va="center", fontsize=14, fontweight="bold")
        page.text(x - 0.02, y, unit, ha="left", va="center", fontsize=12, color="#444444")


def _draw_legend(page: Figure) -> None:
    free, occupied = occupancy_colours()([0.0, 1.0])
    page.legend(
        handles=[
            Patch(facecolor=_COMPONENT, alpha=0.65, label="component (2σ)"),
            Patch(facecolor=free, edgecolor=style.EDGE, label="free"),
            Patch(facecolor=occupied, edgecolor=style.EDGE, label="occupied"),
            Patch(facecolor=style.UNKNOWN, edgecolor=style.EDGE, label="unknown"),
            Line2D([], [], color=_PATH, marker="o", markeredgecolor="white", label="robot"),
        ],
        loc="lower center",
        ncols=5,
        frameon=False,
        fontsize=10,
        handlelength=1.3,
        columnspacing=1.4,
        borderaxespad=0.2,
    )

"""Maps side by side: where each method says occupied, free and unknown."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import Normal, Stroke

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.report.maps.raster import (
    MAX_PIXELS,
    MAX_QUERIES,
    MapPanel,
    Raster,
    height_image,
    roof_above,
    slice_image,
)
from gmmtorch.report.style import (
    HEIGHTS,
    LABEL_SIZE,
    PALETTE,
    SAVED_DPI,
    TICK_SIZE,
    TITLE_SIZE,
    UNKNOWN,
    as_array,
    dress,
    figure_title,
    metres,
    new_figure,
)
from gmmtorch.scan import ArrayLike

_MAX_COLUMNS = 4
_GREYS = [(0.0, "#ffffff"), (0.3, "#dedede"), (0.5, "#9c9c9c"), (0.67, "#404040"), (1.0, "#000000")]
_NONE = "#f1f1f1"  # a column without an occupied cell
_HEADROOM = 0.5  # metres above the sensor from where a roof is cut off
_PATH, _START, _END = PALETTE[1], PALETTE[2], PALETTE[0]


def map_figure(
    panels: Sequence[MapPanel],
    trajectory: ArrayLike | None = None,
    *,
    title: str | None = None,
    slice_height: float | None = None,
    ceiling: float | None = None,
    occupied_above: float = 0.5,
    max_pixels: int = MAX_PIXELS,
    max_queries: int = MAX_QUERIES,
) -> Figure:
    """One panel a method: occupied dark, free light, unknown (θ within 0.02 of ½) blue-grey.

    In 3D each method has a horizontal slice above, and below it the height of the highest occupied
    cell as seen from the top.

    Args:
        panels: the maps, at least one, all 2D or all 3D.
        trajectory: (S, D) sensor positions in order, world metres; none is drawn if not given.
        title: of the whole figure.
        slice_height: of the slice (m); the median height of the trajectory if not given, without
            trajectory the middle of the region.
        ceiling: cells above it (m) are left out of the view from the top. If not given, they are left
            out from half a metre above the trajectory where most of that lies under a roof.
        occupied_above: probability above which a cell counts as occupied in that view.
        max_pixels: along either side of a picture; larger regions are asked more coarsely.
        max_queries: the most queries for one view from the top.

    Raises:
        InvalidArgumentError: no panel, or panels and trajectory of different dimension.
    """
    if not panels:
        raise InvalidArgumentError("panels is empty; give at least one map to show.")
    dim = panels[0].dim
    path = None if trajectory is None else as_array(trajectory)
    if any(panel.dim != dim for panel in panels) or (path is not None and path.shape[1:] != (dim,)):
        raise InvalidArgumentError(
            f"panels are of dimensions {[panel.dim for panel in panels]} and trajectory has shape "
            f"{None if path is None else path.shape}; all must be 2D, or all 3D."
        )
    n_bands = math.ceil(len(panels) / _MAX_COLUMNS)
    n_columns = math.ceil(len(panels) / n_bands)
    n_views = dim - 1
    figure, grid, shown_pixels = _sheet(panels, n_columns, n_bands * n_views)
    bands = [grid[i * n_views : (i + 1) * n_views] for i in range(n_bands)]
    slices = np.concatenate([band[0] for band in bands])
    height = _slice_height(panels[0], path, slice_height)
    for axes, panel in zip(slices, panels, strict=False):
        cells = f"cells of {metres(panel.resolution)}"
        _draw_slice(axes, panel, height, max_pixels, shown_pixels)
        _draw_path(axes, path)
        _head(axes, panel.title, f"slice at z = {metres(height)}, {cells}" if dim == 3 else cells)
    for band in bands:
        _bar(figure, band[0], ScalarMappable(Normalize(0, 1), _greys()), "occupancy probability θ")
    if dim == 3:
        views = np.concatenate([band[1] for band in bands])
        # One height for all: panels that are cut differently cannot be compared.
        top = min(_ceiling(panel, path, ceiling, occupied_above) for panel in panels)
        cut = [_below(panel, top) for panel in panels]
        images = [height_image(panel, occupied_above, shown_pixels, max_queries) for panel in cut]
        heights = _draw_heights(views, panels, cut, images, occupied_above)
        for band in bands:
            _bar(figure, band[1], heights, "height z [m]", extend="both")
        for axes, _ in zip(views, panels, strict=False):
            _draw_path(axes, path)
    _label(grid, len(panels), n_views)
    _legend(figure, path, dim)
    figure_title(figure, title)
    return figure


def _sheet(panels: Sequence[MapPanel], n_columns: int, n_rows: int) -> tuple[Figure, np.ndarray, int]:
    """A figure whose cells have the shape of the region shown, axes (rows, columns), and the pixels
    along the longer side of one of them."""
    sides = np.array([[p.high[a] - p.low[a] for a in range(2)] for p in panels])
    shape = float(np.clip((sides[:, 1] / sides[:, 0]).max(), 0.3, 2.5))
    width = {1: 6.4, 2: 5.2}.get(n_columns, 4.4) / max(1.0, shape**0.5)
    figure = new_figure((width + 0.35) * n_columns + 1.7, (width * shape + 0.6) * n_rows + 1.4)
    axes = np.asarray(figure.subplots(n_rows, n_columns, squeeze=False))
    return figure, axes, int(width * max(shape, 1.0) * SAVED_DPI)


def _slice_height(panel: MapPanel, path: np.ndarray | None, given: float | None) -> float:
    if panel.dim == 2:
        return 0.0
    if given is not None:
        return float(given)
    if path is not None and len(path):
        return float(np.median(path[:, 2]))
    return (panel.low[2] + panel.high[2]) / 2


def _greys() -> Colormap:
    """White for free, black for occupied, steepest where the two are told apart; blue-grey for NaN."""
    greys = LinearSegmentedColormap.from_list("occupancy", _GREYS)
    return greys.with_extremes(bad=UNKNOWN)


def _draw_slice(axes: Axes, panel: MapPanel, height: float, max_pixels: int, shown_pixels: int) -> None:
    image, raster = slice_image(panel, height, max_pixels, shown_pixels)
    # Colours before resampling: free, occupied and unknown must not be averaged as probabilities.
    colours = _greys()(np.ma.masked_invalid(image))
    axes.imshow(colours, origin="lower", extent=raster.extent, aspect="equal")
    _frame(axes, panel)


def _frame(axes: Axes, panel: MapPanel) -> None:
    axes.set_xlim(panel.low[0], panel.high[0])
    axes.set_ylim(panel.low[1], panel.high[1])


def _ceiling(panel: MapPanel, path: np.ndarray | None, given: float | None, occupied_above: float) -> float:
    if given is not None:
        return float(given)
    if path is None or len(path) == 0 or not roof_above(panel, path, occupied_above, _HEADROOM):
        return math.inf
    return float(np.median(path[:, 2])) + _HEADROOM


def _below(panel: MapPanel, ceiling: float) -> MapPanel:
    """The panel cut off at the layer of cells nearest to the ceiling, one layer at least."""
    if ceiling >= panel.high[2]:
        return panel
    top = max(round(ceiling / panel.resolution) * panel.resolution, panel.low[2] + panel.resolution)
    return replace(panel, high=(*panel.high[:2], top))


def _draw_heights(
    views: np.ndarray,
    panels: Sequence[MapPanel],
    cut: Sequence[MapPanel],
    images: Sequence[tuple[np.ndarray, Raster]],
    occupied_above: float,
) -> ScalarMappable:
    """The views from the top, and their common scale."""
    values = np.concatenate([image[np.isfinite(image)] for image, _ in images])
    low, high = np.quantile(values, [0.01, 0.99]) if len(values) else (cut[0].low[2], cut[0].high[2])
    scale = Normalize(float(low), float(max(high, low + 1e-3)))
    colours = matplotlib.colormaps[HEIGHTS]
    for axes, whole, panel, (image, raster) in zip(views, panels, cut, images, strict=False):
        axes.imshow(
            np.ma.masked_invalid(image),
            origin="lower",
            extent=raster.extent,
            cmap=colours,
            norm=scale,
            aspect="equal",
            interpolation="nearest",
        )
        axes.set_facecolor(_NONE)
        _frame(axes, panel)
        below = f" below z = {metres(panel.high[2])}" if panel.high[2] < whole.high[2] else ""
        dress(axes, f"highest cell with θ > {occupied_above:g}{below}")
    return ScalarMappable(scale, colours)


def _draw_path(axes: Axes, path: np.ndarray | None) -> None:
    if path is None or len(path) == 0:
        return
    halo = [Stroke(linewidth=2.6, foreground="white"), Normal()]
    axes.plot(path[:, 0], path[:, 1], color=_PATH, linewidth=1.2, path_effects=halo, zorder=3)
    for (x, y), shape, colour in ((path[0, :2], "o", _START), (path[-1, :2], "s", _END)):
        axes.plot(x, y, shape, color=colour, markersize=8, markeredgecolor="white", zorder=4)
    axes.autoscale(False)


def _head(axes: Axes, name: str, caption: str) -> None:
    """The method's name in bold, and beneath it what is shown of it."""
    dress(axes)
    axes.set_title(name, fontsize=TITLE_SIZE + 1, fontweight="bold", pad=24)
    note = axes.annotate(
        caption,
        (0.5, 1),
        xytext=(0, 6),
        xycoords="axes fraction",
        textcoords="offset points",
        ha="center",
        fontsize=TITLE_SIZE,
    )
    note.set_in_layout(False)  # the padding of the title is its room


def _bar(
    figure: Figure, row: np.ndarray, colours: ScalarMappable, label: str, extend: str = "neither"
) -> None:
    """The colour bar of a row of panels."""
    bar = figure.colorbar(colours, ax=row.tolist(), pad=0.015, aspect=25, extend=extend)
    bar.set_label(label, fontsize=LABEL_SIZE)
    bar.ax.tick_params(labelsize=TICK_SIZE)


def _label(grid: np.ndarray, n_panels: int, n_views: int) -> None:
    """Axis labels on the outer panels; panels without a map are hidden."""
    n_rows, n_columns = grid.shape
    for row in range(n_rows):
        for column in range(n_columns):
            axes = grid[row, column]
            if row // n_views * n_columns + column >= n_panels:
                axes.set_visible(False)
                continue
            last = row == n_rows - 1 or (row // n_views + 1) * n_columns + column >= n_panels
            if last and (row + 1) % n_views == 0:
                axes.set_xlabel("x [m]", fontsize=LABEL_SIZE)
            if column == 0:
                axes.set_ylabel("y [m]", fontsize=LABEL_SIZE)


def _legend(figure: Figure, path: np.ndarray | None, dim: int) -> None:
    handles: list[Patch | Line2D] = [Patch(facecolor=UNKNOWN, edgecolor="#666666", label="unknown (θ ≈ ½)")]
    if dim == 3:
        handles.append(Patch(facecolor=_NONE, edgecolor="#666666", label="no such cell"))
    if path is not None and len(path):
        handles += [
            Line2D([], [], color=_PATH, linewidth=2, label="sensor path"),
            Line2D([], [], color=_START, marker="o", linestyle="", markersize=8, label="start"),
            Line2D([], [], color=_END, marker="s", linestyle="", markersize=8, label="end"),
        ]
    figure.legend(handles=handles, loc="outside lower center", ncols=5, frameon=False, fontsize=LABEL_SIZE)

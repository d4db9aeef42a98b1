"""What a variance threshold makes of a map (thesis Fig 3.8): cells that are called occupied, in 3D."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from torch import Tensor

from gmmtorch.occupancy.evidence import CellClass, classify
from gmmtorch.report.maps.raster import busiest_regions
from gmmtorch.report.style import (
    HEIGHTS,
    LABEL_SIZE,
    TICK_SIZE,
    TITLE_SIZE,
    Rows,
    colour,
    draw_grid,
    dress,
    figure_title,
    label_of,
    marker,
    metres,
    new_figure,
)

_MAX_CELLS = 400_000
_ROW_NAME: dict[str, Any] = {"fontsize": TITLE_SIZE, "fontweight": "bold", "ha": "center", "va": "center"}
_VIEW = {"elev": 24, "azim": -60}
_SIDE = 2.9  # inches of a panel
_FILLED = 0.6  # of a panel's side, what the longest edge of the box takes
_ZOOM = 0.95  # leaves room for the names of the axes


def figures(rows: Rows) -> dict[str, Figure]:
    """`variance_threshold`: what each threshold decides, one line a number of components."""
    panels = (
        ("occupied_recall", "occupied points called occupied"),
        ("thin_recall", "the same, on thin structures"),
        ("free_recall", "free points called free"),
        ("share_decided", "points not left unknown"),
    )
    figure = new_figure(13.5, 4.2)
    grid = figure.subplots(1, len(panels), sharey=True)
    sizes = list(dict.fromkeys(int(row["n_components"]) for row in rows))
    for axes, (name, title) in zip(grid, panels, strict=True):
        for index, size in enumerate(sizes):
            here = [r for r in rows if r["n_components"] == size and r[name] is not None]
            axes.plot(
                [row["variance_threshold"] for row in here],
                [row[name] for row in here],
                color=colour(index),
                marker=marker(index),
                linewidth=2,
                label=f"{size} components",
            )
        dress(axes, title, "variance threshold v", "")
        axes.set_ylim(0, 1.02)
        draw_grid(axes)
    grid[0].set_ylabel("share of the points", fontsize=LABEL_SIZE)
    grid[-1].legend(frameon=False, fontsize=LABEL_SIZE, loc="lower right")
    figure_title(figure, f"What the dead band decides: {rows[0]['dataset']}, {label_of(rows[0]['method'])}")
    return {"variance_threshold": figure}


def closest_look(
    thin: Tensor, hits: Tensor, side: float = 4.0
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Corners of a box of `side` × `side` metres, as high as what is in it, around most thin points."""
    (low, high), *_ = busiest_regions(thin[:, :2], 1, side)
    there = (
        (hits[:, 0] >= low[0]) & (hits[:, 0] <= high[0]) & (hits[:, 1] >= low[1]) & (hits[:, 1] <= high[1])
    )
    heights = np.quantile(hits[there, 2].numpy(), [0.005, 0.995])
    return (*low, float(heights[0]) - 0.2), (*high, float(heights[1]) + 0.2)


def cells_figure(
    maps: Mapping[int, Callable[[Tensor], Tensor]],
    thresholds: Sequence[float],
    hits: Tensor,
    low: Sequence[float],
    high: Sequence[float],
    resolution: float,
) -> Figure:
    """Cells called occupied in the box [low, high] (m): a row for each map, a column for each threshold.

    The first column shows the held-out points themselves. Colours are heights, the same in all panels.

    Args:
        maps: by number of components: occupancy (M,) of points (M, 3).
        hits: (H, 3) measured points, world metres.
    """
    corner = torch.tensor(low, dtype=torch.float64), torch.tensor(high, dtype=torch.float64)
    inside = hits[((hits >= corner[0]) & (hits <= corner[1])).all(1)]
    size = resolution * max(1.0, (math.prod((corner[1] - corner[0]) / resolution) / _MAX_CELLS) ** (1 / 3))
    axes_points = [
        torch.arange(a, b, size, dtype=torch.float64) + size / 2 for a, b in zip(low, high, strict=True)
    ]
    centers = torch.cartesian_prod(*axes_points)
    heights = ScalarMappable(Normalize(low[2], high[2]), HEIGHTS)
    figure = new_figure(_SIDE * (1 + len(thresholds)) + 1.0, _SIDE * len(maps) + 0.6)
    panels = figure.subplots(len(maps), 1 + len(thresholds), squeeze=False, subplot_kw={"projection": "3d"})
    for row, (n_components, occupancy) in zip(panels, maps.items(), strict=True):
        theta = occupancy(centers)
        _scatter(row[0], inside.numpy(), heights, low, high, 1.5)
        row[0].set_title("held-out points", fontsize=TITLE_SIZE)
        name = f"{n_components:,} components"
        row[0].text2D(-0.12, 0.5, name, rotation=90, transform=row[0].transAxes, **_ROW_NAME)
        for axes, threshold in zip(row[1:], thresholds, strict=True):
            called = classify(theta, threshold) == CellClass.OCCUPIED
            _scatter(axes, centers[called].numpy(), heights, low, high, _mark_side(size, low, high))
            axes.set_title(f"v = {threshold:g}\n{int(called.sum()):,} cells", fontsize=TITLE_SIZE)
    bar = figure.colorbar(heights, ax=panels.ravel().tolist(), shrink=0.6, pad=0.02, aspect=25)
    bar.set_label("height z [m]", fontsize=LABEL_SIZE)
    bar.ax.tick_params(labelsize=TICK_SIZE)
    figure_title(figure, f"Cells of {metres(size)} called occupied, by the variance threshold v")
    return figure


def _mark_side(size: float, low: Sequence[float], high: Sequence[float]) -> float:
    """Points that a cell of `size` metres takes in a panel."""
    return _FILLED * 72 * _SIDE * size / max(b - a for a, b in zip(low, high, strict=True))


def _scatter(
    axes: Any,  # mpl_toolkits has no types
    points: np.ndarray,
    heights: ScalarMappable,
    low: Sequence[float],
    high: Sequence[float],
    side: float,
) -> None:
    axes.scatter(*points.T, c=heights.to_rgba(points[:, 2]), s=side**2, marker="s", linewidths=0)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect([b - a for a, b in zip(low, high, strict=True)], zoom=_ZOOM)
    axes.view_init(**_VIEW)
    for name in "xyz":
        axis = getattr(axes, f"{name}axis")
        # Where two axes meet, one of their labels is enough.
        axis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10], prune="lower" if name == "y" else None))
        axis.set_pane_color((0.97, 0.97, 0.97, 1.0))
        axis.labelpad = -6
        getattr(axes, f"set_{name}label")(f"{name} [m]", fontsize=TICK_SIZE)
    axes.tick_params(labelsize=TICK_SIZE, pad=-2)

"""What a variance threshold makes of a map (thesis Fig 3.8): cells that are called occupied, in 3D."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from gmmtorch.occupancy.evidence import CellClass, classify
from gmmtorch.report.raster import busiest_regions
from gmmtorch.report.style import (
    HEIGHTS,
    LABEL_SIZE,
    TITLE_SIZE,
    colour,
    dress,
    figure_title,
    label_of,
    marker,
    metres,
    new_figure,
)

_MAX_CELLS = 400_000
_VIEW = {"elev": 24, "azim": -60}


def figures(rows: Sequence[Mapping[str, Any]]) -> dict[str, Figure]:
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
        axes.grid(color="#e4e4e4", linewidth=0.8)
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

    The first column shows the held-out points themselves.

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
    figure = new_figure(3.6 * (1 + len(thresholds)), 3.5 * len(maps) + 0.4)
    grid = figure.subplots(len(maps), 1 + len(thresholds), squeeze=False, subplot_kw={"projection": "3d"})
    for row, (n_components, occupancy) in zip(grid, maps.items(), strict=True):
        theta = occupancy(centers)
        _scatter(row[0], inside.numpy(), low, high, 0.6)
        row[0].set_title(f"held-out points\n(map: {n_components} components)", fontsize=TITLE_SIZE - 1)
        for axes, threshold in zip(row[1:], thresholds, strict=True):
            called = classify(theta, threshold) == CellClass.OCCUPIED
            _scatter(axes, centers[called].numpy(), low, high, 5.0)
            axes.set_title(f"v = {threshold:g}: {int(called.sum()):,} cells", fontsize=TITLE_SIZE - 1)
    figure_title(figure, f"Cells of {metres(size)} called occupied, by variance threshold")
    return figure


def _scatter(
    axes: Axes, points: np.ndarray, low: Sequence[float], high: Sequence[float], size: float
) -> None:
    drawn: Any = axes
    drawn.scatter(
        *points.T, c=points[:, 2], cmap=HEIGHTS, vmin=low[2], vmax=high[2], s=size, marker="s", linewidths=0
    )
    drawn.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    drawn.set_box_aspect([b - a for a, b in zip(low, high, strict=True)])
    drawn.view_init(**_VIEW)
    drawn.tick_params(labelsize=6, pad=-2)

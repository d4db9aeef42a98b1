"""Figures of the variance threshold (thesis Fig 3.8): shares of decided points, and occupied cells in
space."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from torch import Tensor

from gmmtorch.occupancy.evidence import CellClass, classify
from gmmtorch.report import style
from gmmtorch.report.maps.map_regions import Corners, busiest_regions
from gmmtorch.report.scenes.ellipsoids import height_colour_map, height_colours
from gmmtorch.report.scenes.scene import balls, canvas_around, draw_scene
from gmmtorch.report.scenes.scene_renderer import Camera

_PANELS = {
    "occupied_recall": "occupied points found",
    "thin_recall": "occupied points found,\nthin structures",
    "free_recall": "free points found",
    "share_decided": "points not left unknown",
}
_MAX_CELLS = 400_000
_SIDE = 3.4  # inches of a panel in space
_POINT_PIXELS = 2.5  # radius of a measured point
_CAMERA = Camera(-60.0, 24.0)


def figures(rows: style.Rows) -> dict[str, Figure]:
    """Draws `variance_threshold`: the decisions at each threshold, one line per number of components."""
    figure = style.new_figure(13.5, 4.6)
    grid = figure.subplots(1, len(_PANELS), sharey=True)
    sizes = list(dict.fromkeys(int(row["n_components"]) for row in rows))
    for axes, (field, title) in zip(grid, _PANELS.items(), strict=True):
        for index, size in enumerate(sizes):
            own = [r for r in rows if r["n_components"] == size and r[field] is not None]
            thresholds = [row["variance_threshold"] for row in own]
            label = f"{size:,} components"
            axes.plot(thresholds, [row[field] for row in own], label=label, **style.line_look(index))
        style.label_axes(axes, title, "variance threshold v", "")
        axes.set_ylim(0, 1.02)
        style.draw_grid(axes)
    grid[0].set_ylabel("share of the points", fontsize=style.LABEL_SIZE)
    style.legend_below(figure)
    subject = f"{rows[0]['dataset']}, {style.label_of(rows[0]['method'])}"
    style.figure_title(figure, f"Decisions against the variance threshold: {subject}")
    return {"variance_threshold": figure}


def closest_look(thin: Tensor, hits: Tensor, side: float = 4.0) -> Corners:
    """Returns the corners of a box around the most thin points: `side` × `side` metres, as high as its
    hits."""
    (low, high), *_ = busiest_regions(thin[:, :2], 1, side)
    inside = ((hits[:, :2] >= torch.tensor(low)) & (hits[:, :2] <= torch.tensor(high))).all(1)
    heights = np.quantile(hits[inside, 2].numpy(), [0.005, 0.995])
    return (*low, float(heights[0]) - 0.2), (*high, float(heights[1]) + 0.2)


def cells_figure(
    maps: Mapping[int, Callable[[Tensor], Tensor]],
    thresholds: Sequence[float],
    hits: Tensor,
    low: Sequence[float],
    high: Sequence[float],
    resolution: float,
) -> Figure:
    """Draws the cells classified occupied in the box [low, high] (m): one row per map, one column per
    threshold.

    The first column shows the held-out points. All panels have the same colours of height.

    Args:
        maps: by number of components: occupancy (M,) of points (M, 3).
        thresholds: variance thresholds.
        hits: (H, 3) measured points, world metres.
        low, high: (3,) corners of the box, world metres.
        resolution: side (m) of the cells; larger if the box has more than 400,000 of them.
    """
    corners = torch.tensor([low, high], dtype=torch.float64)
    inside = hits[((hits >= corners[0]) & (hits <= corners[1])).all(1)]
    size = resolution * max(1.0, (math.prod((corners[1] - corners[0]) / resolution) / _MAX_CELLS) ** (1 / 3))
    steps = [torch.arange(a, b, size, dtype=torch.float64) + size / 2 for a, b in zip(low, high, strict=True)]
    centres = torch.cartesian_prod(*steps)
    scale = Normalize(low[2], high[2], clip=True)
    figure = style.new_figure(_SIDE * (1 + len(thresholds)) + 1.0, _SIDE * len(maps) + 0.6)
    grid = figure.subplots(len(maps), 1 + len(thresholds), squeeze=False)
    canvas = canvas_around(low, high, _CAMERA, int(_SIDE * style.SAVED_DPI))
    for row, (n_components, occupancy) in zip(grid, maps.items(), strict=True):
        theta = occupancy(centres)
        shown = [(inside, _POINT_PIXELS / canvas.scale, f"{n_components:,} components:\nheld-out points")]
        for threshold in thresholds:
            occupied = centres[classify(theta, threshold) == CellClass.OCCUPIED]
            shown.append((occupied, size / 2, f"v = {threshold:g}:\n{len(occupied):,} cells"))
        for axes, (places, radius, title) in zip(row, shown, strict=True):
            part = balls(places, radius, height_colours(places[:, 2], scale))
            draw_scene(axes, [part], low, high, _CAMERA, canvas, n_ticks=3)
            axes.set_title(title, fontsize=style.TITLE_SIZE)
    colours = ScalarMappable(scale, height_colour_map())
    style.colour_bar(figure, colours, grid.ravel().tolist(), "height z [m]", shrink=0.6)
    style.figure_title(figure, f"Cells of {style.metres(size)} classified occupied, by variance threshold v")
    return figure

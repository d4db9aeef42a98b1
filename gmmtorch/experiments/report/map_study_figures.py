"""Figures of studies of maps: AUC against bytes (Table 3.1), poses, thresholds (Fig 3.8), variants."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator
from torch import Tensor

from gmmtorch import report
from gmmtorch.report import LABEL_SIZE, SAVED_DPI, TICK_SIZE, TITLE_SIZE, Corners, Label, Rows


def auc_memory_figures(rows: Rows) -> dict[str, Figure]:
    """Draws `auc_memory`: one panel per resolution, one line per method, one point per size of its map.

    Args:
        rows: dataset, method, size, resolution (m), auc, auc_low, auc_high, nbytes.
    """
    resolutions = list(dict.fromkeys(float(row["resolution"]) for row in rows))
    methods = list(dict.fromkeys(str(row["method"]) for row in rows))
    figure = report.new_figure(1.2 + 6.2 * len(resolutions), 5.2)
    grid = figure.subplots(1, len(resolutions), squeeze=False, sharey=True)
    labels: list[Label] = []
    for axes, resolution in zip(grid[0], resolutions, strict=True):
        for index, method in enumerate(methods):
            own = [r for r in rows if r["method"] == method and float(r["resolution"]) == resolution]
            own.sort(key=lambda row: row["nbytes"])
            sizes = [row["nbytes"] for row in own]
            areas = [row["auc"] for row in own]
            axes.plot(sizes, areas, label=report.label_of(method), **report.line_look(index))
            report.draw_intervals(axes, sizes, own, report.colour(index))
            look = {"fontsize": TICK_SIZE - 1, "color": report.colour(index)}
            labels += [
                Label(axes, f"{row['size']:,}", row["nbytes"], row["auc"], look)
                for row in own
                if row["size"] is not None
            ]
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator())
        report.tick_text(axes.xaxis, lambda value: report.byte_text(value, digits=1))
        report.label_axes(axes, f"cells of {report.metres(resolution)}", "map size", "")
        report.draw_grid(axes)
    grid[0][0].set_ylabel("area under the ROC curve", fontsize=LABEL_SIZE)
    report.legend_below(figure, max_columns=4)
    report.figure_title(figure, f"AUC against map size: {rows[0]['dataset']}")
    report.place_labels(figure, labels)
    return {"auc_memory": figure}


_BARS = (("auc", "noisy poses"), ("auc_corrected", "noisy poses, corrected"), ("auc_clean", "true poses"))


def pose_correction_figures(rows: Rows) -> dict[str, Figure]:
    """Draws `pose_correction`, three bars per row: AUC with noisy poses, after correction, and with true
    poses.

    Args:
        rows: dataset, method, kept, resolution (m), pose_noise_m, pose_noise_rad, auc, auc_corrected,
            auc_clean.
    """
    figure = report.new_figure(2.4 + 2.4 * len(rows), 4.6)
    axes = figure.subplots()
    for number, (field, label) in enumerate(_BARS):
        places = [i + 0.27 * (number - 1) for i in range(len(rows))]
        bars = axes.bar(places, [row[field] for row in rows], 0.25, label=label, color=report.colour(number))
        axes.bar_label(bars, fmt="%.4f", padding=3, fontsize=TICK_SIZE - 1)
    names = [f"{report.label_of(row['method'])}, {report.metres(row['resolution'])}" for row in rows]
    kept = [f"{row['kept']:.0%} of the data" for row in rows]
    axes.set_xticks(range(len(rows)), [f"{a}\n{b}" for a, b in zip(names, kept, strict=True)])
    report.label_axes(axes, "", "", "area under the ROC curve")
    lowest = min(row[field] for row in rows for field, _ in _BARS)
    axes.set_ylim(max(0.0, lowest - 0.5 * (1 - lowest)), 1.0)
    report.legend_below(figure)
    noise = f"{report.metres(rows[0]['pose_noise_m'])}, {rows[0]['pose_noise_rad']:g} rad"
    report.figure_title(figure, f"Maps with pose noise of {noise}: {rows[0]['dataset']}")
    return {"pose_correction": figure}


_PANELS = {
    "thin_recall": "hits on thin structures:\ncalled occupied",
    "thin_kept": "hits on thin structures:\nnot called free",
    "occupied_recall": "all hits:\ncalled occupied",
    "free_recall": "free points:\ncalled free",
}
_MAX_CELLS = 400_000
_SIDE = 3.4  # inches, width of a panel in space
_TEXT_HEIGHT = 0.4  # inches of the title above a panel
_POINT_PIXELS = 2.5  # radius of a measured point
_CAMERA = report.Camera(-60.0, 24.0)


def variance_threshold_figures(rows: Rows) -> dict[str, Figure]:
    """Draws `variance_threshold`: the decisions with each prior, a group of bars for each form and size.

    Shown are the rows with the first resolution and threshold.
    """
    fixed = {name: rows[0][name] for name in ("resolution", "variance_threshold")}
    shown = [row for row in rows if all(row[name] == value for name, value in fixed.items())]
    groups = list(dict.fromkeys((row["method"], row["n_components"]) for row in shown))
    priors = list(dict.fromkeys(row["prior"] for row in shown))
    figure = report.new_figure(15.5, 4.8)
    width = 0.8 / len(priors)
    for axes, (field, title) in zip(
        figure.subplots(1, len(_PANELS), sharey=True), _PANELS.items(), strict=True
    ):
        for index, prior in enumerate(priors):
            own = {(r["method"], r["n_components"]): r[field] for r in shown if r["prior"] == prior}
            bars = [(place, own[group]) for place, group in enumerate(groups) if own.get(group) is not None]
            places = [place + width * (index - 0.5 * (len(priors) - 1)) for place, _ in bars]
            axes.bar(
                places, [value for _, value in bars], width, label=_label(prior), color=report.colour(index)
            )
        names = [
            "counted rays" if n is None else f"{report.label_of(m)},\n{n:,} components" for m, n in groups
        ]
        axes.set_xticks(range(len(groups)), names, rotation=60, fontsize=TICK_SIZE - 1)
        report.label_axes(axes, title, "", "")
        axes.set_ylim(0, 1.02)
        report.draw_grid(axes)
    figure.axes[0].set_ylabel("share of the points", fontsize=LABEL_SIZE)
    report.legend_below(figure)
    subject = f"{rows[0]['dataset']}, cells of {report.metres(fixed['resolution'])}"
    report.figure_title(
        figure, f"Decisions with the variance threshold {fixed['variance_threshold']:g}: {subject}"
    )
    return {"variance_threshold": figure}


def _label(prior: float | None) -> str:
    return "calibrated" if prior is None else f"counts, prior {prior:g}"


def closest_look(thin: Tensor, hits: Tensor) -> Corners:
    """Returns the corners of a box around the most thin points: 4 m × 4 m, as high as its hits."""
    (low, high), *_ = report.busiest_regions(thin[:, :2], 1, 4.0)
    heights = np.quantile(hits[report.inside(hits[:, :2], (low, high)), 2].numpy(), [0.005, 0.995])
    return (*low, float(heights[0]) - 0.2), (*high, float(heights[1]) + 0.2)


def cells_figure(
    maps: Mapping[int, Callable[[Tensor], Mapping[str, Tensor]]],
    hits: Tensor,
    low: Sequence[float],
    high: Sequence[float],
    resolution: float,
) -> Figure:
    """Draws cells in the box [low, high] (m): one column per map, one row per title.

    The first row shows the held-out points. All panels have the same colours of height.

    Args:
        maps: by number of components: centres (M, 3) of cells → masks (M,) of the cells to draw, by title.
        hits: (H, 3) measured points, world metres.
        low, high: (3,) corners of the box, world metres.
        resolution: side (m) of the cells; larger if the box has more than 400,000 of them.
    """
    corners = torch.tensor([low, high], dtype=torch.float64)
    size = resolution * max(1.0, (math.prod((corners[1] - corners[0]) / resolution) / _MAX_CELLS) ** (1 / 3))
    steps = [
        torch.arange(math.floor(a / size), math.ceil(b / size), dtype=torch.float64) * size + size / 2
        for a, b in zip(low, high, strict=True)
    ]
    centres = torch.cartesian_prod(*steps)
    scale = Normalize(low[2], high[2], clip=True)
    drawn = {n: masks(centres) for n, masks in maps.items()}
    canvas = report.canvas_around(low, high, _CAMERA, int(_SIDE * SAVED_DPI))
    side = _SIDE * (canvas.top - canvas.bottom) / (canvas.right - canvas.left) + _TEXT_HEIGHT
    n_rows = 1 + max(len(masks) for masks in drawn.values())
    figure = report.new_figure(_SIDE * len(maps) + 1.0, side * n_rows + 0.6)
    grid = figure.subplots(n_rows, len(maps), squeeze=False)
    for column, (n_components, masks) in zip(grid.T, drawn.items(), strict=True):
        shown = [
            (
                hits[report.inside(hits, (low, high))],
                _POINT_PIXELS / canvas.scale,
                f"{n_components:,} components:\nheld-out points",
            )
        ]
        shown += [(centres[mask], size / 2, title) for title, mask in masks.items()]
        for axes, (places, radius, title) in zip(column, shown, strict=True):
            part = report.balls(places, radius, report.height_colours(places[:, 2], scale))
            report.draw_scene(axes, [part], low, high, _CAMERA, canvas, n_ticks=3)
            axes.set_title(title, fontsize=TITLE_SIZE)
    report.height_bar(figure, grid.ravel().tolist(), scale)
    report.figure_title(figure, f"Cells of {report.metres(size)} with the dead band of a variance threshold")
    return figure


def map_variants_figures(rows: Rows) -> dict[str, Figure]:
    """Draws `map_variants`: the AUC of each variant minus that of the first, with components and bytes.

    Args:
        rows: dataset, variant, resolution (m), n_components, nbytes, auc, auc_gain, auc_gain_low,
            auc_gain_high.
    """
    resolutions = list(dict.fromkeys(float(row["resolution"]) for row in rows))
    variants = list(dict.fromkeys(str(row["variant"]) for row in rows))
    figure = report.new_figure(3.0 + 6.4 * len(resolutions), 1.9 + 0.42 * len(variants))
    grid = figure.subplots(1, len(resolutions), squeeze=False, sharey=True)
    for axes, resolution in zip(grid[0], resolutions, strict=True):
        own = [row for row in rows if float(row["resolution"]) == resolution]
        places = [variants.index(str(row["variant"])) for row in own]
        gains = [row["auc_gain"] for row in own]
        below = [row["auc_gain"] - row["auc_gain_low"] for row in own]
        above = [row["auc_gain_high"] - row["auc_gain"] for row in own]
        axes.axvline(0, color=report.colour(0), linewidth=1, alpha=0.5)
        axes.errorbar(gains, places, xerr=[below, above], fmt="o", color=report.colour(0), capsize=3)
        for row, place in zip(own, places, strict=True):
            text = f"{row['n_components']:,} components, {report.byte_text(row['nbytes'])}"
            at = {"xycoords": ("axes fraction", "data"), "va": "center", "fontsize": TICK_SIZE}
            axes.annotate(text, (1.02, place), annotation_clip=False, **at)
        title = f"cells of {report.metres(resolution)}, {own[0]['variant']}: AUC {own[0]['auc']:.4f}"
        report.label_axes(axes, report.label_of(title), "difference of AUC, 95 % interval", "")
        axes.margins(y=0.08)
        report.draw_grid(axes)
    grid[0][0].set_yticks(range(len(variants)), [report.label_of(name) for name in variants])
    grid[0][0].invert_yaxis()
    report.figure_title(figure, f"Variants of a map: {rows[0]['dataset']}")
    return {"map_variants": figure}

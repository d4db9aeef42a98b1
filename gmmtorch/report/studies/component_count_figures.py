"""What rules that find the number of components choose, on the curve of all numbers."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gmmtorch.report.curve_panels import Panel, subject
from gmmtorch.report.labels import Label, around, place_labels
from gmmtorch.report.style import (
    LABEL_SIZE,
    TICK_SIZE,
    Rows,
    colour,
    draw_grid,
    dress,
    figure_title,
    log_axis,
    marker,
    new_figure,
)

_FITS = (
    Panel("held_out_psnr2_db", "PSNR2 of points held out", "dB"),
    Panel("held_out_log_likelihood", "log-likelihood of points held out", "nats a point"),
    Panel("seconds", "to find the number, and fit", "seconds", log=True),
)
_AUC = Panel("auc", "maps of all scans: AUC of beams held out", "area under the ROC curve")
_NAMES = {
    "fixed": "fixed number",
    "flat_pieces": "flat pieces (× noise)",
    "bic": "least BIC of the curve",
    "mean_shift": "mean shift (× spread)",
    "hierarchical": "tree, flat leaves (× noise)",
}
_MAP = "map_"
_SHOWN_NATS = 2.0
"""Likelihoods so far below the best are off the panel: those of overfitted mixtures fall without end."""


def figures(rows: Rows) -> dict[str, Figure]:
    """`component_count`: PSNR2 and likelihood of points held out, seconds, and the maps' AUC, against bytes.

    A fixed number of components is a line; what a rule chooses are marks, each with what it was told.

    Args:
        rows: of `gmmtorch.evaluation.studies.component_count`.
    """
    figure = new_figure(12.0, 9.4)
    grid = figure.subplots(2, 2)
    fits = [row for row in rows if not str(row["rule"]).startswith(_MAP)]
    maps = [row for row in rows if str(row["rule"]).startswith(_MAP)]
    labels: list[Label] = []
    for axes, panel in zip(grid.flat, _FITS, strict=False):
        labels += _draw(axes, fits, panel)
    _show_best(grid.flat[1], fits, "held_out_log_likelihood", _SHOWN_NATS)
    if maps:
        named = [{**row, "rule": str(row["rule"]).removeprefix(_MAP)} for row in maps]
        labels += _draw(grid.flat[3], named, _AUC)
    grid.flat[3].set_visible(bool(maps))
    lines, names = grid.flat[0].get_legend_handles_labels()
    if lines:
        figure.legend(lines, names, loc="outside lower center", ncols=5, frameon=False, fontsize=LABEL_SIZE)
    figure_title(figure, f"How many components: {subject(fits)}")
    place_labels(figure, labels)
    return {"component_count": figure}


def _draw(axes: Axes, rows: Rows, panel: Panel) -> list[Label]:
    """A panel, and the labels that it is to have."""
    labels: list[Label] = []
    measured = [row for row in rows if row[panel.field] is not None]
    for index, name in enumerate(_NAMES):
        own = sorted((row for row in measured if row["rule"] == name), key=lambda row: row["component_bytes"])
        if own:
            labels += _draw_rule(axes, own, panel.field, name, index)
    dress(axes, panel.title, "bytes of the components, four a number", panel.unit)
    log_axis(axes, "x", [row["component_bytes"] for row in measured])
    if panel.log:
        log_axis(axes, "y", [row[panel.field] for row in measured])
    draw_grid(axes)
    return labels


def _draw_rule(axes: Axes, rows: Rows, field: str, name: str, index: int) -> list[Label]:
    """A line with a dot for each number; for a rule marks, and a label of each: what the rule was told."""
    is_curve = name == "fixed"
    tint = "#333333" if is_curve else colour(index - 1)
    axes.plot(
        [row["component_bytes"] for row in rows],
        [row[field] for row in rows],
        color=tint,
        linestyle="-" if is_curve else ":",
        linewidth=1.6 if is_curve else 1.0,
        marker="." if is_curve else marker(index),
        markersize=6 if is_curve else 8,
        label=_NAMES[name],
        zorder=2 if is_curve else 3,
    )
    if is_curve or name == "bic":
        return []
    look = {"fontsize": TICK_SIZE, "color": tint, "zorder": 5}
    spots = [around(row["component_bytes"], row[field]) for row in rows]
    return [Label(axes, f"{row['setting']:g}", spot, look) for row, spot in zip(rows, spots, strict=True)]


def _show_best(axes: Axes, rows: Rows, field: str, depth: float) -> None:
    """Limit the axis to what is at most so far below the best."""
    values = [float(row[field]) for row in rows if row[field] is not None]
    if values:
        high = max(values)
        low = max(min(values), high - depth)
        margin = 0.05 * (high - low) or 1.0
        axes.set_ylim(low - margin, high + margin)

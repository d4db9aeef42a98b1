"""Panels of quantities against the size of a mixture: one line per variant, mean and range over seeds."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from gmmtorch.report import style

_AXES = {"n_components": "components", "nbytes": "map size [bytes]"}
_LABELS = {"kmeans": "k-means", "kmeans_restarts": "k-means, best of ten"}


class Panel(NamedTuple):
    """A field of the rows, its title and unit; whether the axis is logarithmic, and whether to draw the
    difference to the first line."""

    field: str
    title: str
    unit: str = ""
    log: bool = False
    relative: bool = False


def panels_figure(
    rows: style.Rows, panels: Sequence[Panel], line: str, title: str, x: str = "n_components"
) -> Figure:
    """Draws one panel per quantity, two in a row, against `x` on a logarithmic axis.

    Each value of the field `line` has a line: the mean of the rows with the same `x` (one row per seed), in a
    band from the smallest to the largest. None values are left out.

    Args:
        rows: rows of `results.json` with the fields `line`, `x` and those of the panels.
        panels: the quantities.
        line: field that tells the lines apart.
        title: title of the figure.
        x: integer field on the x axis: `n_components` or `nbytes`.
    """
    n_rows = math.ceil(len(panels) / 2)
    figure = style.new_figure(11.0, 4.1 * n_rows + 0.9)
    grid = figure.subplots(n_rows, 2, squeeze=False)
    names = list(dict.fromkeys(str(row[line]) for row in rows))
    ticks = sorted({int(row[x]) for row in rows})
    for axes, panel in zip(grid.flat, panels, strict=False):
        values = {name: _values([row for row in rows if row[line] == name], x, panel.field) for name in names}
        base = dict.fromkeys(ticks, 0.0)
        if panel.relative:
            base = {k: float(np.mean(v)) for k, v in values[names[0]].items()}
        for index, name in enumerate(names):
            _draw_line(axes, {k: v - base[k] for k, v in values[name].items() if k in base}, name, index)
        style.label_axes(axes, panel.title, _AXES[x], panel.unit)
        _scale(axes, x, ticks)
        if panel.log:
            style.log_axis(axes, "y", [row[panel.field] for row in rows if row[panel.field] is not None])
        style.draw_grid(axes)
    for axes in list(grid.flat)[len(panels) :]:
        axes.set_visible(False)
    style.legend_below(figure, max_columns=5)
    style.figure_title(figure, title)
    return figure


def subject(rows: style.Rows) -> str:
    """Returns the end of a title: data set, number of points, and number of seeds if more than one."""
    n_seeds = len({row.get("seed") for row in rows})
    over = f"\nmean and range of {n_seeds} seeds" if n_seeds > 1 else ""
    return f"{style.label_of(str(rows[0]['dataset']))}, {rows[0]['n_points']:,} points{over}"


def line_label(name: str) -> str:
    """Returns the name of a line as shown in legends."""
    return _LABELS.get(name, style.label_of(name))


def _scale(axes: Axes, x: str, values: Sequence[int]) -> None:
    """Makes the x axis logarithmic; numbers of components have a tick each."""
    if x != "n_components":
        style.log_axis(axes, "x", values)
        return
    axes.set_xscale("log", base=2)
    axes.set_xticks(values, [str(value) for value in values], fontsize=style.TICK_SIZE)
    axes.xaxis.set_minor_locator(NullLocator())


def _values(rows: style.Rows, x: str, field: str) -> dict[int, np.ndarray]:
    """Returns the numbers of all rows with the same `x`, by `x` in ascending order."""
    found: dict[int, list[float]] = {}
    for row in rows:
        if row[field] is not None:
            found.setdefault(int(row[x]), []).append(float(row[field]))
    return {k: np.array(found[k]) for k in sorted(found)}


def _draw_line(axes: Axes, values: Mapping[int, np.ndarray], name: str, index: int) -> None:
    low, mean, high = ([function(v) for v in values.values()] for function in (np.min, np.mean, np.max))
    axes.fill_between(list(values), low, high, color=style.colour(index), alpha=0.15, linewidth=0)
    axes.plot(list(values), mean, label=line_label(name), **style.line_look(index))

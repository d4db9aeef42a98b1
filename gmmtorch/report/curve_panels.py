"""Panels of curves against one quantity: a line for each way of doing it, means and range over seeds."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from gmmtorch.report.style import (
    LABEL_SIZE,
    TICK_SIZE,
    Rows,
    colour,
    draw_grid,
    dress,
    figure_title,
    label_of,
    line_style,
    log_axis,
    marker,
    new_figure,
)

_AXES = {"n_components": "components", "nbytes": "bytes", "component_bytes": "bytes"}
_LABELS = {"kmeans": "k-means", "kmeans_restarts": "k-means, best of ten"}


class Panel(NamedTuple):
    """What is drawn, its name and unit; whether on a logarithmic axis, or less what the first line gives."""

    field: str
    title: str
    unit: str = ""
    log: bool = False
    relative: bool = False


def panels_figure(
    rows: Rows, panels: Sequence[Panel], line: str, title: str, x: str = "n_components"
) -> Figure:
    """A panel for each quantity, two in a row, against the whole number `x` (the number of components,
    or bytes) on a logarithmic axis.

    Each value of the field `line` has a line: the mean of the rows that share `x` (those of several
    seeds), in a band from the least to the most. What is None is left out.
    """
    n_rows = math.ceil(len(panels) / 2)
    figure = new_figure(11.0, 4.1 * n_rows + 0.9)
    grid = figure.subplots(n_rows, 2, squeeze=False)
    names = list(dict.fromkeys(str(row[line]) for row in rows))
    ticks = sorted({int(row[x]) for row in rows})
    for axes, panel in zip(grid.flat, panels, strict=False):
        values = {name: _values([row for row in rows if row[line] == name], x, panel.field) for name in names}
        base = dict.fromkeys(ticks, 0.0)
        if panel.relative:
            base = {k: float(np.mean(v)) for k, v in values[names[0]].items()}
        for index, name in enumerate(names):
            drawn = {k: v - base[k] for k, v in values[name].items() if k in base}
            _draw_line(axes, drawn, name, index)
        dress(axes, panel.title, _AXES[x], panel.unit)
        _scale(axes, x, ticks)
        if panel.log:
            log_axis(axes, "y", [row[panel.field] for row in rows if row[panel.field] is not None])
        draw_grid(axes)
    for axes in list(grid.flat)[len(panels) :]:
        axes.set_visible(False)
    lines, labels = grid.flat[0].get_legend_handles_labels()
    if lines:
        columns = min(len(labels), 5)
        figure.legend(
            lines, labels, loc="outside lower center", ncols=columns, frameon=False, fontsize=LABEL_SIZE
        )
    figure_title(figure, title)
    return figure


def _scale(axes: Axes, x: str, values: Sequence[int]) -> None:
    """A logarithmic axis; one of components is labelled where they are, powers of two as a rule."""
    if x != "n_components":
        log_axis(axes, "x", values)
        return
    axes.set_xscale("log", base=2)
    axes.set_xticks(values, [str(value) for value in values], fontsize=TICK_SIZE)
    axes.xaxis.set_minor_locator(NullLocator())


def subject(rows: Rows) -> str:
    """Data set and number of points, and how many seeds: the end of a title."""
    n_seeds = len({row.get("seed") for row in rows})
    over = f"\nmean and range of {n_seeds} seeds" if n_seeds > 1 else ""
    return f"{label_of(str(rows[0]['dataset']))}, {rows[0]['n_points']:,} points{over}"


def line_label(name: str) -> str:
    """A line's name as a reader would write it."""
    return _LABELS.get(name, label_of(name))


def _values(rows: Rows, x: str, field: str) -> dict[int, np.ndarray]:
    """By `x`, what the rows say that share it; numbers alone."""
    found: dict[int, list[float]] = {}
    for row in rows:
        if row[field] is not None:
            found.setdefault(int(row[x]), []).append(float(row[field]))
    return {k: np.array(found[k]) for k in sorted(found)}


def _draw_line(axes: Axes, values: Mapping[int, np.ndarray], name: str, index: int) -> None:
    low, mean, high = ([function(v) for v in values.values()] for function in (np.min, np.mean, np.max))
    axes.fill_between(list(values), low, high, color=colour(index), alpha=0.15, linewidth=0)
    axes.plot(
        list(values),
        mean,
        color=colour(index),
        linestyle=line_style(index),
        marker=marker(index),
        linewidth=2,
        markersize=6,
        label=line_label(name),
    )

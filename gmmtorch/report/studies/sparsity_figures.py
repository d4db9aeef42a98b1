"""How well maps classify when only a share of the training data is kept."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter, NullLocator

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
    marker,
    metres,
    new_figure,
)

_MAX_COLUMNS = 3


def auc_against_kept_figure(rows: Iterable[Mapping[str, Any]], title: str | None = None) -> Figure:
    """AUC against the share of the training data kept: one panel a resolution, one line a method.

    Sparser to the right, on a logarithmic axis. Rows of several data sets, or of both ways of
    removal, get panels of their own.

    Args:
        rows: occupancy rows of `results.json`: dataset, method, resolution (m), removal, kept, auc; if
            they have auc_low and auc_high, the interval is drawn. Rows without a finite auc are left out.
        title: of the figure.
    """
    sound = [
        row for row in rows if _is_number(row.get("auc")) and _is_number(row.get("kept")) and row["kept"] > 0
    ]
    groups: dict[tuple[str, str, float], list[Mapping[str, Any]]] = {}
    for row in sound:
        key = (str(row.get("dataset", "")), str(row.get("removal", "")), float(row.get("resolution") or 0))
        groups.setdefault(key, []).append(row)
    order = sorted(groups, key=lambda key: (key[0], key[1], -key[2]))
    methods = list(dict.fromkeys(str(row.get("method", "")) for row in sound))
    n_columns = max(1, min(len(order), _MAX_COLUMNS))
    n_rows = max(1, math.ceil(len(order) / n_columns))
    figure = new_figure(1.0 + (6.4 if n_columns == 1 else 4.6) * n_columns, 0.9 + 3.9 * n_rows)
    grid = figure.subplots(n_rows, n_columns, squeeze=False, sharey=True)
    for position, axes in enumerate(grid.flat):
        if position < len(order):
            _draw_panel(axes, groups[order[position]], methods, _heading(order[position], order))
        else:
            axes.set_visible(position == 0)
        if position % n_columns == 0:
            axes.set_ylabel("area under the ROC curve", fontsize=LABEL_SIZE)
    lines, names = _legend_entries(grid.flat)
    if lines:
        figure.legend(
            lines,
            names,
            loc="outside lower center",
            ncols=min(len(names), 4),
            frameon=False,
            fontsize=LABEL_SIZE,
        )
    figure_title(figure, title)
    return figure


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)


def _heading(key: tuple[str, str, float], keys: Sequence[tuple[str, str, float]]) -> str:
    """The resolution, and of data set and removal what not all panels share."""
    dataset, removal, resolution = key
    parts = [dataset] if len({k[0] for k in keys}) > 1 else []
    parts += [f"{removal} removed"] if removal and len({k[1] for k in keys}) > 1 else []
    parts += [f"cells of {metres(resolution)}"] if resolution else []
    return ", ".join(parts)


def _draw_panel(axes: Axes, rows: Rows, methods: Sequence[str], heading: str) -> None:
    shares = sorted({float(row["kept"]) for row in rows})
    for index, method in enumerate(methods):
        mine = sorted(
            (row for row in rows if str(row.get("method", "")) == method), key=lambda row: row["kept"]
        )
        if not mine:
            continue
        percent = [100 * float(row["kept"]) for row in mine]
        areas = [float(row["auc"]) for row in mine]
        axes.plot(
            percent,
            areas,
            color=colour(index),
            linestyle=line_style(index),
            marker=marker(index),
            linewidth=2,
            markersize=6,
            label=label_of(method),
        )
        _draw_intervals(axes, mine, colour(index))
    removal = str(rows[0].get("removal") or "training data")
    dress(axes, heading, f"share of {removal} kept [%]")
    axes.tick_params(labelleft=True)
    axes.set_xscale("log")
    ticks = _sparse_ticks([100 * share for share in shares])
    axes.set_xticks(ticks, [f"{tick:.3g}" for tick in ticks], fontsize=TICK_SIZE)
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlim(130 * shares[-1], 100 * shares[0] / 1.3)
    draw_grid(axes)


def _draw_intervals(axes: Axes, rows: Rows, line_colour: str) -> None:
    known = [row for row in rows if _is_number(row.get("auc_low")) and _is_number(row.get("auc_high"))]
    if not known:
        return
    below = [max(0.0, row["auc"] - row["auc_low"]) for row in known]
    above = [max(0.0, row["auc_high"] - row["auc"]) for row in known]
    percent, areas = [100 * row["kept"] for row in known], [row["auc"] for row in known]
    axes.errorbar(percent, areas, [below, above], fmt="none", ecolor=line_colour, capsize=3, linewidth=1.2)


def _sparse_ticks(values: Sequence[float]) -> list[float]:
    """From the largest share down, those that leave room for their labels."""
    kept: list[float] = []
    for value in sorted(values, reverse=True):
        if not kept or kept[-1] / value > 1.35:
            kept.append(value)
    return kept


def _legend_entries(panels: Iterable[Axes]) -> tuple[list[Any], list[str]]:
    found: dict[str, Any] = {}
    for axes in panels:
        for line, name in zip(*axes.get_legend_handles_labels(), strict=True):
            found.setdefault(name, line)
    return list(found.values()), list(found)

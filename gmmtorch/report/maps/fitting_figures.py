"""Figures of fitting mixtures: convergence, and quality against time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from gmmtorch.report import style


def convergence_figure(lower_bounds_by_name: Mapping[str, Sequence[float]]) -> Figure:
    """Draws the mean log-likelihood per point (nats) after each iteration, one line per fit."""
    figure = style.new_figure(7.0, 4.8)
    axes = figure.subplots()
    for index, (name, bounds) in enumerate(lower_bounds_by_name.items()):
        values = np.asarray(bounds, dtype=np.float64)
        if values.size:
            steps = np.arange(1, len(values) + 1)
            label = f"{style.label_of(name)}: {values[-1]:.4g} nats"
            axes.plot(steps, values, label=label, **style.line_look(index, with_marker=False))
            axes.plot(steps[-1], values[-1], "o", color=style.colour(index), markersize=6)
    style.label_axes(axes, "", "iteration", "mean log-likelihood per point [nats]")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    style.draw_grid(axes)
    style.legend_below(figure, max_columns=2)
    style.figure_title(figure, "Convergence of the fit")
    return figure


def comparison_figure(rows: style.Rows) -> Figure:
    """Draws log-likelihood and PSNR2 against seconds on a logarithmic axis: one mark per method.

    Uses held-out points if there are any, else the training points. The legend gives the number of components
    in use. Marks of scikit-learn are hollow.

    Args:
        rows: fit rows of `results.json`; values that are None have no mark.
    """
    figure = style.new_figure(11.0, 5.6)
    left, right = figure.subplots(1, 2)
    held_out = any(row.get("held_out_log_likelihood") is not None for row in rows)
    prefix, where = ("held_out_", " of held-out points") if held_out else ("", "")
    _draw(left, rows, f"{prefix}log_likelihood", f"log-likelihood{where}", "nats per point")
    _draw(right, rows, f"{prefix}psnr2_db", f"PSNR2{where}", "dB")
    style.legend_below(figure, max_columns=3)
    if rows:
        points = f"{style.label_of(str(rows[0]['dataset']))}, {rows[0]['n_points']:,} points"
        style.figure_title(figure, f"Methods of fitting a mixture: {points}")
    return figure


def _draw(axes: Axes, rows: style.Rows, field: str, heading: str, unit: str) -> None:
    for index, row in enumerate(rows):
        used, method = row.get("n_components_used", row["n_components"]), style.label_of(str(row["method"]))
        axes.plot(
            [row["seconds"]],
            [np.nan if row.get(field) is None else row[field]],
            marker=style.marker(index),
            color=style.colour(index),
            linestyle="",
            markersize=11,
            markeredgewidth=2,
            fillstyle="none" if method.startswith("scikit learn") else "full",
            label=f"{method}: {used:,} components",
        )
    style.label_axes(axes, heading, "time [s]", unit)
    style.log_axis(axes, "x", [row["seconds"] for row in rows])
    axes.margins(0.12)
    style.draw_grid(axes)

"""Curves: receiver operating characteristics, and how a fit converged."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from gmmtorch.report.style import (
    LABEL_SIZE,
    colour,
    draw_grid,
    dress,
    figure_title,
    label_of,
    line_style,
    new_figure,
)


def roc_figure(
    curves: Mapping[str, tuple[np.ndarray, np.ndarray, float]],
    title: str = "Receiver operating characteristic",
) -> Figure:
    """True against false positive rate, one line a method, the area under it in the legend.

    Args:
        curves: by method: false positive rates, true positive rates (T,) each, and the area.
        title: of the figure.
    """
    figure = new_figure(5.8, 5.6)
    axes = figure.subplots()
    axes.plot([0, 1], [0, 1], color="#999999", linewidth=1, linestyle=(0, (1, 2)), label="chance, AUC 0.5")
    for index, (name, (false_rate, true_rate, area)) in enumerate(curves.items()):
        text = f"{label_of(name)}, AUC {area:.4f}"
        axes.plot(
            np.asarray(false_rate),
            np.asarray(true_rate),
            color=colour(index),
            linestyle=line_style(index),
            linewidth=2,
            label=text,
        )
    dress(axes, "", "false positive rate (free called occupied)", "true positive rate (occupied found)")
    axes.set(xlim=(-0.01, 1.01), ylim=(-0.01, 1.01), aspect="equal")
    draw_grid(axes)
    axes.legend(loc="lower right", fontsize=LABEL_SIZE - 1, frameon=True, framealpha=0.95, edgecolor="none")
    figure_title(figure, title)
    return figure


def convergence_figure(
    lower_bounds_by_name: Mapping[str, Sequence[float]], title: str = "Convergence of the fit"
) -> Figure:
    """Mean log-likelihood per point (nats) after each iteration, one line a fit."""
    figure = new_figure(7.0, 4.8)
    axes = figure.subplots()
    for index, (name, bounds) in enumerate(lower_bounds_by_name.items()):
        values = np.asarray(bounds, dtype=np.float64)
        if values.size == 0:
            continue
        steps = np.arange(1, len(values) + 1)
        label = f"{label_of(name)}: {values[-1]:.4g} nats"
        axes.plot(steps, values, color=colour(index), linestyle=line_style(index), linewidth=2, label=label)
        axes.plot(steps[-1], values[-1], "o", color=colour(index), markersize=6)
    dress(axes, "", "iteration", "mean log-likelihood per point [nats]")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    draw_grid(axes)
    if axes.lines:
        figure.legend(loc="outside lower center", ncols=2, fontsize=LABEL_SIZE, frameon=False)
    figure_title(figure, title)
    return figure

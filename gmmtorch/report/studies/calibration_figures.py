"""Reliability diagrams: how often what is called occupied, is."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.evaluation.calibration import Reliability
from gmmtorch.report.style import (
    LABEL_SIZE,
    TICK_SIZE,
    colour,
    draw_grid,
    dress,
    figure_title,
    label_of,
    line_style,
    marker,
    new_figure,
)

_SMALLEST, _LARGEST = 3.0, 11.0  # markers (points), by the share of the points in a bin


def reliability_figure(
    curves: Mapping[str, Reliability], title: str = "Reliability of the probabilities"
) -> Figure:
    """Share that is occupied against the probability given, one line a method; below, where the points are.

    On the diagonal a map means what it says; above it is too timid to call things occupied, below
    too bold. A marker's area is the share of the points in its bin, and the legend has the expected
    calibration error (ECE). Raises `InvalidArgumentError` without a curve.
    """
    if not curves:
        raise InvalidArgumentError("curves is empty; give one reliability curve at least.")
    figure = new_figure(7.4, 7.8)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3.4, 1))
    upper.fill_between([0, 1], [0, 1], [1, 1], color="#f3f6f9", linewidth=0)
    upper.plot([0, 1], [0, 1], color="#999999", linewidth=1, linestyle=(0, (1, 2)))
    upper.text(
        0.93,
        0.915,
        "as often as said",
        color="#777777",
        fontsize=TICK_SIZE,
        ha="right",
        va="top",
        rotation=45,
        rotation_mode="anchor",
        transform_rotates_text=True,
    )
    for corner, text in (
        ((0.03, 0.97), "occupied more often than said"),
        ((0.97, 0.03), "occupied less often"),
    ):
        high = corner[1] > 0.5
        upper.text(
            *corner,
            text,
            color="#777777",
            fontsize=TICK_SIZE,
            ha="left" if high else "right",
            va="top" if high else "bottom",
        )
    for index, (name, curve) in enumerate(curves.items()):
        _draw_curve(upper, curve, f"{label_of(name)}, ECE {curve.expected_error:.3f}", index)
        _draw_shares(lower, curve, index)
    dress(upper, "", "", "share that is occupied")
    upper.set(xlim=(-0.02, 1.02), ylim=(-0.02, 1.02))
    draw_grid(upper)
    dress(lower, "", "probability θ given to the point", "share of points")
    lower.set_ylim(bottom=0)
    lower.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.0%}"))
    draw_grid(lower, "y")
    figure.legend(
        *upper.get_legend_handles_labels(),
        loc="outside lower center",
        ncols=1 if len(curves) == 1 else 2,
        fontsize=LABEL_SIZE,
        frameon=False,
    )
    figure_title(figure, title)
    return figure


def _draw_curve(axes: Axes, curve: Reliability, label: str, index: int) -> None:
    style: dict[str, Any] = {"color": colour(index), "linestyle": line_style(index), "linewidth": 1.8}
    axes.plot(curve.predicted, curve.observed, **style)
    size = _SMALLEST + (_LARGEST - _SMALLEST) * np.sqrt(curve.n_points / curve.n_points.max())
    axes.scatter(
        curve.predicted,
        curve.observed,
        s=size**2,
        color=colour(index),
        marker=marker(index),
        edgecolors="white",
        linewidths=0.7,
        zorder=3,
    )
    axes.plot([], [], **style, marker=marker(index), markersize=7, label=label)  # of one size in the legend


def _draw_shares(axes: Axes, curve: Reliability, index: int) -> None:
    """The histogram of the probabilities: as lines, so that no method hides another."""
    share = curve.n_points / curve.n_points.sum()
    axes.plot(
        curve.predicted,
        share,
        color=colour(index),
        linestyle=line_style(index),
        marker=marker(index),
        markersize=4.5,
        linewidth=1.4,
        drawstyle="steps-mid",
    )

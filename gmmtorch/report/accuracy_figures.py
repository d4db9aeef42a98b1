"""Figures of accuracy: ROC, reliability and AUC of maps; trajectories; convergence and likelihood of fitted
mixtures.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.occupancy import Reliability
from gmmtorch.report import style

_MAX_COLUMNS = 3
_SMALLEST, _LARGEST = 3.0, 11.0  # marker sizes (points), by the share of the points in a bin
_NOTE = "#777777"


def roc_figure(
    curves: Mapping[str, tuple[np.ndarray, np.ndarray, float]],
    title: str = "Receiver operating characteristic",
) -> Figure:
    """Draws the true against the false positive rate, one line per method, with the AUC in the legend.

    Args:
        curves: by method: false positive rates (T,), true positive rates (T,) and the area under the curve.
    """
    figure = style.new_figure(5.8, 5.6)
    axes = figure.subplots()
    _draw_diagonal(axes, "chance, AUC 0.5")
    for index, (name, (false_rate, true_rate, area)) in enumerate(curves.items()):
        text = f"{style.label_of(name)}, AUC {area:.4f}"
        axes.plot(false_rate, true_rate, label=text, **style.line_look(index, with_marker=False))
    style.label_axes(axes, "", "false positive rate (free points classified occupied)", "true positive rate")
    axes.set(xlim=(-0.01, 1.01), ylim=(-0.01, 1.01), aspect="equal")
    style.draw_grid(axes)
    axes.legend(loc="lower right", fontsize=style.LABEL_SIZE - 1, framealpha=0.95, edgecolor="none")
    style.figure_title(figure, title)
    return figure


def reliability_figure(
    curves: Mapping[str, Reliability], title: str = "Reliability of the probabilities"
) -> Figure:
    """Draws the observed share of occupied points against the predicted probability, one line per method, and
    below it the share of points at each probability.

    On the diagonal the probabilities are calibrated. The area of a marker is the share of points in its bin;
    the legend gives the expected calibration error (ECE). Raises `InvalidArgumentError` without a curve.
    """
    if not curves:
        raise InvalidArgumentError("curves is empty; give one reliability curve at least.")
    figure = style.new_figure(7.4, 7.8)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3.4, 1))
    upper.fill_between([0, 1], [0, 1], [1, 1], color="#f3f6f9", linewidth=0)
    _draw_diagonal(upper, "calibrated")
    note: dict[str, Any] = {"color": _NOTE, "fontsize": style.TICK_SIZE}
    upper.text(0.03, 0.97, "occupied more often than predicted", va="top", **note)
    upper.text(0.97, 0.03, "occupied less often than predicted", ha="right", **note)
    for index, (name, curve) in enumerate(curves.items()):
        _draw_reliability(upper, curve, f"{style.label_of(name)}, ECE {curve.expected_error:.3f}", index)
        share = curve.n_points / curve.n_points.sum()
        look = style.line_look(index) | {"markersize": 4.5, "linewidth": 1.4}
        lower.plot(curve.predicted, share, drawstyle="steps-mid", **look)
    style.label_axes(upper, "", "", "observed share of occupied points")
    upper.set(xlim=(-0.02, 1.02), ylim=(-0.02, 1.02))
    style.draw_grid(upper)
    style.label_axes(lower, "", "predicted occupancy probability θ", "share of points")
    lower.set_ylim(bottom=0)
    style.tick_text(lower.yaxis, lambda value: f"{value:.0%}")
    style.draw_grid(lower, "y")
    style.legend_below(figure, max_columns=3)
    style.figure_title(figure, title)
    return figure


def auc_against_kept_figure(rows: Iterable[Mapping[str, Any]]) -> Figure:
    """Draws the AUC against the share of the training data kept: one panel per resolution, one line per
    method.

    The logarithmic axis has the sparser data on the right. Several data sets, or both ways of removal, have
    panels of their own.

    Args:
        rows: occupancy rows of `results.json`: dataset, method, resolution (m), removal, kept, auc, and for
            error bars auc_low and auc_high. Rows without a finite auc are left out.
    """
    valid = [
        row for row in rows if _is_number(row.get("auc")) and _is_number(row.get("kept")) and row["kept"] > 0
    ]
    groups: dict[tuple[str, str, float], list[Mapping[str, Any]]] = {}
    for row in valid:
        key = (str(row.get("dataset", "")), str(row.get("removal", "")), float(row.get("resolution") or 0))
        groups.setdefault(key, []).append(row)
    keys = sorted(groups, key=lambda key: (key[0], key[1], -key[2]))
    methods = list(dict.fromkeys(str(row.get("method", "")) for row in valid))
    n_columns = max(1, min(len(keys), _MAX_COLUMNS))
    n_rows = max(1, math.ceil(len(keys) / n_columns))
    figure = style.new_figure(1.0 + (6.4 if n_columns == 1 else 4.6) * n_columns, 0.9 + 3.9 * n_rows)
    grid = figure.subplots(n_rows, n_columns, squeeze=False, sharey=True)
    for position, axes in enumerate(grid.flat):
        if position < len(keys):
            _draw_auc(axes, groups[keys[position]], methods, _heading(keys[position], keys))
        else:
            axes.set_visible(position == 0)
        if position % n_columns == 0:
            axes.set_ylabel("area under the ROC curve", fontsize=style.LABEL_SIZE)
    style.legend_below(figure, max_columns=4)
    return figure


def _draw_diagonal(axes: Axes, label: str) -> None:
    axes.plot([0, 1], [0, 1], color="#999999", linewidth=1, linestyle=(0, (1, 2)), label=label)


def _draw_reliability(axes: Axes, curve: Reliability, label: str, index: int) -> None:
    look = style.line_look(index, with_marker=False)
    axes.plot(curve.predicted, curve.observed, **look)
    size = _SMALLEST + (_LARGEST - _SMALLEST) * np.sqrt(curve.n_points / curve.n_points.max())
    axes.scatter(
        curve.predicted,
        curve.observed,
        s=size**2,
        color=style.colour(index),
        marker=style.marker(index),
        edgecolors="white",
        linewidths=0.7,
        zorder=3,
    )
    axes.plot([], [], label=label, **style.line_look(index))  # a legend entry with one size of marker


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)


def _heading(key: tuple[str, str, float], keys: Sequence[tuple[str, str, float]]) -> str:
    """Returns the title of a panel: the resolution, and data set and removal if the panels differ in them."""
    dataset, removal, resolution = key
    parts = [dataset] if len({k[0] for k in keys}) > 1 else []
    parts += [f"{removal} removed"] if removal and len({k[1] for k in keys}) > 1 else []
    parts += [f"cells of {style.metres(resolution)}"] if resolution else []
    return ", ".join(parts)


def _draw_auc(axes: Axes, rows: style.Rows, methods: Sequence[str], heading: str) -> None:
    for index, method in enumerate(methods):
        own = sorted((row for row in rows if str(row.get("method", "")) == method), key=lambda r: r["kept"])
        if own:
            percent = [100 * float(row["kept"]) for row in own]
            areas = [float(row["auc"]) for row in own]
            axes.plot(percent, areas, label=style.label_of(method), **style.line_look(index))
            style.draw_intervals(axes, percent, own, style.colour(index))
    removal = str(rows[0].get("removal") or "training data")
    style.label_axes(axes, heading, f"share of {removal} kept [%]")
    axes.tick_params(labelleft=True)
    shares = [100 * float(row["kept"]) for row in rows]
    style.log_axis(axes, "x", shares)
    axes.set_xlim(1.3 * max(shares), min(shares) / 1.3)
    style.draw_grid(axes)


def trajectory_figure(
    estimate: np.ndarray, truth: np.ndarray, found: np.ndarray, title: str = "Estimated poses"
) -> Figure:
    """Draws two paths from above, and below them the distance between them at each scan.

    Args:
        estimate, truth: positions (N, D) in one frame, metres. found: (N,) bool; lost scans are marked.
    """
    figure = style.new_figure(7.4, 8.6)
    upper, lower = figure.subplots(2, 1, height_ratios=(3, 1))
    upper.plot(truth[:, 0], truth[:, 1], color=_NOTE, linewidth=2.4, label="poses of the data set")
    upper.plot(estimate[:, 0], estimate[:, 1], color=style.colour(0), linewidth=1.2, label="estimated")
    scans, gaps = np.arange(len(truth)), np.linalg.norm(estimate - truth, axis=1)
    lower.plot(scans, gaps, color=style.colour(0), linewidth=1.2)
    if not found.all():
        look: dict[str, Any] = {"color": style.colour(1), "markersize": 4, "linestyle": "none"}
        upper.plot(*estimate[~found, :2].T, marker="x", label="lost", **look)
        lower.plot(scans[~found], gaps[~found], marker="x", **look)
    upper.set_aspect("equal", adjustable="datalim")
    style.label_axes(upper, "", "x [m]", "y [m]")
    style.label_axes(lower, "", "scan", "distance [m]")
    lower.set_ylim(bottom=0)
    for axes in (upper, lower):
        style.draw_grid(axes)
    upper.legend(loc="best", fontsize=style.LABEL_SIZE - 1, framealpha=0.95, edgecolor="none")
    style.figure_title(figure, title)
    return figure


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

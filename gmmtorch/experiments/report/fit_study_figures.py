"""Figures of the studies of fits: initialization (thesis Fig 2.1), sensor noise, number of components."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from gmmtorch import report
from gmmtorch.report import TICK_SIZE, Label, Rows

_AXES = {"n_components": "components", "nbytes": "map size [bytes]"}
_LABELS = {
    "kmeans": "k-means",
    "kmeans_restarts": "k-means, best of ten",
    "random_points_box": "random points, covariance of the box",
    "bounding_box_box": "bounding box, covariance of the box",
}


class Panel(NamedTuple):
    """A field of the rows, its title and unit; whether the axis is logarithmic, and whether to draw the
    difference to the first line."""

    field: str
    title: str
    unit: str = ""
    log: bool = False
    relative: bool = False


def panels_figure(
    rows: Rows, panels: Sequence[Panel], line: str, title: str, x: str = "n_components"
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
    figure = report.new_figure(11.0, 4.1 * n_rows + 0.9)
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
        report.label_axes(axes, panel.title, _AXES[x], panel.unit)
        _scale(axes, x, ticks)
        if panel.log:
            report.log_axis(axes, "y", [row[panel.field] for row in rows if row[panel.field] is not None])
        report.draw_grid(axes)
    for axes in list(grid.flat)[len(panels) :]:
        axes.set_visible(False)
    report.legend_below(figure, max_columns=5)
    report.figure_title(figure, title)
    return figure


def subject(rows: Rows) -> str:
    """Returns the end of a title: data set, number of points, and number of seeds if more than one."""
    n_seeds = len({row.get("seed") for row in rows})
    over = f"\nmean and range of {n_seeds} seeds" if n_seeds > 1 else ""
    return f"{report.label_of(str(rows[0]['dataset']))}, {rows[0]['n_points']:,} points{over}"


def line_label(name: str) -> str:
    """Returns the name of a line as shown in legends."""
    return _LABELS.get(name, report.label_of(name))


def _scale(axes: Axes, x: str, values: Sequence[int]) -> None:
    """Makes the x axis logarithmic; numbers of components have a tick each."""
    if x != "n_components":
        report.log_axis(axes, "x", values)
        return
    axes.set_xscale("log", base=2)
    axes.set_xticks(values, [str(value) for value in values], fontsize=TICK_SIZE)
    axes.xaxis.set_minor_locator(NullLocator())


def _values(rows: Rows, x: str, field: str) -> dict[int, np.ndarray]:
    """Returns the numbers of all rows with the same `x`, by `x` in ascending order."""
    found: dict[int, list[float]] = {}
    for row in rows:
        if row[field] is not None:
            found.setdefault(int(row[x]), []).append(float(row[field]))
    return {k: np.array(found[k]) for k in sorted(found)}


def _draw_line(axes: Axes, values: Mapping[int, np.ndarray], name: str, index: int) -> None:
    low, mean, high = ([function(v) for v in values.values()] for function in (np.min, np.mean, np.max))
    axes.fill_between(list(values), low, high, color=report.colour(index), alpha=0.15, linewidth=0)
    axes.plot(list(values), mean, label=line_label(name), **report.line_look(index))


_COST = (
    Panel("init_seconds", "initialization time", "seconds", log=True),
    Panel("n_iterations", "iterations of EM", log=True),
    Panel("seconds", "time of initialization and EM", "seconds", log=True),
    Panel("psnr2_db", "PSNR2", "dB"),
)
_QUALITY = (
    Panel("psnr_forward_db", "PSNR of points to the nearest sample", "dB", relative=True),
    Panel("psnr_backward_db", "PSNR of samples to the nearest point", "dB", relative=True),
    Panel("held_out_psnr2_db", "PSNR2 of held-out points", "dB", relative=True),
    Panel("held_out_log_likelihood", "log-likelihood of held-out points", "nats per point", relative=True),
)


def initialization_figures(rows: Rows) -> dict[str, Figure]:
    """Draws `initialization`: initialization time, iterations, total time and PSNR2, as in Fig 2.1; and
    `initialization_quality`: the gain over the first initialization in both terms of PSNR2, and in PSNR2 and
    log-likelihood of held-out points.

    Args:
        rows: of the initialization study: `start`, `n_components`, and the quantities drawn.
    """
    first, about = line_label(str(rows[0]["start"])), subject(rows)
    costs = panels_figure(rows, _COST, "start", f"EM after different initializations: {about}")
    gains = panels_figure(rows, _QUALITY, "start", f"Gain over {first}: {about}")
    return {"initialization": costs, "initialization_quality": gains}


_SENSOR_PANELS = (
    Panel("held_out_log_likelihood", "log-likelihood of held-out measurements", "nats per point"),
    Panel("thickness", "thickness of the components", "metres", log=True),
    Panel("auc", "AUC, free points anywhere on the beam", "area under the ROC curve"),
    Panel("auc_near_surface", "AUC, free points near the surface", "area under the ROC curve"),
)


def sensor_model_figures(rows: Rows) -> dict[str, Figure]:
    """Draws `sensor_model`: log-likelihood, thickness and AUC of each variant against the bytes of its map.

    Args:
        rows: of `gmmtorch.experiments.studies.sensor_noise`.
    """
    title = f"With and without a model of the sensor noise: {subject(rows)}"
    return {"sensor_model": panels_figure(rows, _SENSOR_PANELS, "variant", title, x="nbytes")}


_FITS = (
    Panel("held_out_psnr2_db", "PSNR2 of held-out points", "dB"),
    Panel("held_out_log_likelihood", "log-likelihood of held-out points", "nats per point"),
    Panel("seconds", "time to choose the number and to fit", "seconds", log=True),
)
_AUC = Panel("auc", "maps of all scans: AUC of held-out beams", "area under the ROC curve")
_RULE_NAMES = {
    "fixed": "fixed number",
    "flat_pieces": "flat pieces (multiple of the noise)",
    "bic": "lowest BIC",
    "mean_shift": "mean shift (bandwidth)",
    "hierarchical": "tree with flat leaves (multiple of the noise)",
}
_MAP_PREFIX = "map_"
_SHOWN_NATS = 2.0
"""Range of log-likelihoods below the best that is shown: those of overfitted mixtures have no limit."""


def component_count_figures(rows: Rows) -> dict[str, Figure]:
    """Draws `component_count`: PSNR2 and log-likelihood of held-out points, time, and the AUC of maps,
    against bytes.

    Fixed numbers of components form a line; the choices of each rule are marks, labelled with its setting.

    Args:
        rows: of `gmmtorch.experiments.studies.fit_studies`.
    """
    figure = report.new_figure(12.0, 9.4)
    grid = figure.subplots(2, 2)
    fits = [row for row in rows if not str(row["rule"]).startswith(_MAP_PREFIX)]
    maps = [
        {**row, "rule": str(row["rule"]).removeprefix(_MAP_PREFIX)}
        for row in rows
        if str(row["rule"]).startswith(_MAP_PREFIX)
    ]
    labels: list[Label] = []
    for axes, panel in zip(grid.flat, _FITS, strict=False):
        labels += _draw_rules(axes, fits, panel)
    likelihoods = [row["held_out_log_likelihood"] for row in fits]
    best = max((value for value in likelihoods if value is not None), default=0.0)
    grid.flat[1].set_ylim(bottom=max(grid.flat[1].get_ylim()[0], best - _SHOWN_NATS))
    if maps:
        labels += _draw_rules(grid.flat[3], maps, _AUC)
    grid.flat[3].set_visible(bool(maps))
    report.legend_below(figure, max_columns=5)
    report.figure_title(figure, f"Number of components: {subject(fits)}")
    report.place_labels(figure, labels)
    return {"component_count": figure}


def _draw_rules(axes: Axes, rows: Rows, panel: Panel) -> list[Label]:
    """Draws a panel, and returns the labels of its marks."""
    labels: list[Label] = []
    measured = [row for row in rows if row[panel.field] is not None]
    for index, name in enumerate(_RULE_NAMES):
        own = sorted((row for row in measured if row["rule"] == name), key=lambda row: row["component_bytes"])
        if own:
            labels += _draw_rule(axes, own, panel.field, name, index)
    report.label_axes(axes, panel.title, "size of the components [bytes, float32]", panel.unit)
    report.log_axis(axes, "x", [row["component_bytes"] for row in measured])
    if panel.log:
        report.log_axis(axes, "y", [row[panel.field] for row in measured])
    report.draw_grid(axes)
    return labels


def _draw_rule(axes: Axes, rows: Rows, field: str, name: str, index: int) -> list[Label]:
    """Draws the line of fixed numbers, or the marks of a rule with a label for the setting of each."""
    sizes, values = [row["component_bytes"] for row in rows], [row[field] for row in rows]
    if name == "fixed":
        axes.plot(sizes, values, ".-", color="#333333", linewidth=1.6, label=_RULE_NAMES[name], zorder=2)
        return []
    look = report.line_look(index - 1) | {"linestyle": ":", "linewidth": 1.0, "markersize": 8}
    axes.plot(sizes, values, label=_RULE_NAMES[name], zorder=3, **look)
    if name == "bic":
        return []
    text = {"fontsize": TICK_SIZE, "color": look["color"], "zorder": 5}
    return [
        Label(axes, f"{row['setting']:g}", x, y, text) for row, x, y in zip(rows, sizes, values, strict=True)
    ]

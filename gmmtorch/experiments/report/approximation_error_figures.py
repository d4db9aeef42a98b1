"""Figures of the error of each form of evidence (thesis Fig 3.3), and of the time that accuracy costs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from gmmtorch import report
from gmmtorch.report import EDGE, LABEL_SIZE, TICK_SIZE, TITLE_SIZE, UNKNOWN, Rows

_LABELS = {
    "point": "point form",
    "cone_exact": "projection, exact polygon",
    "monte_carlo": "Monte Carlo",
    "monte_carlo_plain": "Monte Carlo, plain",
    "monte_carlo_stratified": "Monte Carlo, stratified",
    "monte_carlo_sobol": "Monte Carlo, Sobol",
    "monte_carlo_large": "Monte Carlo, Sobol, many rays",
    "flux": "face flux",
    "flux_float32": "face flux, float32",
}
_CURVES = ("flux", "cone", "cone_exact", "monte_carlo_plain", "monte_carlo_stratified", "monte_carlo_sobol")
_SCALE = LogNorm(1e-6, 1.0)
_QUANTILES = {"median": "median", "p99": "99th percentile", "max": "largest"}
_LEAST = 1e-9  # smallest error that the sweep shows


def approximation_figures(rows: Rows) -> dict[str, Figure]:
    """Draws the figures whose study has rows.

    `approximation_error` and `approximation_error_probability`: maps of the error of E = hits + misses and
    of θ; `approximation_error_sweep`: quantiles of the error in random scenes; `approximation_error_curve`:
    error against time.
    """
    maps, sweep, curve = ([row for row in rows if row["study"] == name] for name in ("map", "sweep", "curve"))
    found = {}
    if maps:
        found["approximation_error"] = _map_figure(maps, "error", "Error of E = hits + misses per ray")
        title = "Error of the occupancy probability θ"
        found["approximation_error_probability"] = _map_figure(maps, "probability_error", title)
    if sweep:
        found["approximation_error_sweep"] = _sweep_figure(sweep)
    if curve:
        found["approximation_error_curve"] = _curve_figure(curve)
    return found


def label(method: str, dim: int) -> str:
    """Returns the name of a method as shown in figures; the thesis's form differs between 2D and 3D."""
    if method == "cone":
        return "thesis cone (3.3)" if dim == 2 else "thesis projection (3.4\N{EN DASH}3.7)"
    return _LABELS.get(method, method)


def _by_dim(rows: Rows) -> dict[int, list[Mapping[str, Any]]]:
    dims = sorted({int(row["dim"]) for row in rows})
    return {dim: [row for row in rows if row["dim"] == dim] for dim in dims}


def _map_figure(rows: Rows, field: str, title: str) -> Figure:
    groups = _by_dim(rows)
    n_columns = max(map(len, groups.values()))
    figure = report.new_figure(3.1 * n_columns + 1.4, 3.3 * len(groups) + 1.3)
    grid = figure.subplots(len(groups), n_columns, squeeze=False, sharex=True, sharey=True)
    for line, (dim, own) in zip(grid, groups.items(), strict=True):
        for axes, row in zip(line, own, strict=False):
            _draw_map(axes, row, field)
        for axes in line[len(own) :]:
            axes.set_visible(False)
        line[0].set_ylabel(f"{dim}D: depth beyond the mean r′ − p [σ]", fontsize=LABEL_SIZE)
    for column in grid.T:
        lowest = [axes for axes in column if axes.get_visible()][-1]
        lowest.set_xlabel("distance of the mean p [σ]", fontsize=LABEL_SIZE)
        lowest.tick_params(labelbottom=True)
    colours = ScalarMappable(_SCALE, "cividis")
    text = "largest absolute error, cells up to 2σ off axis"
    report.colour_bar(figure, colours, grid.ravel().tolist(), text, aspect=30, extend="both")
    unknown = Patch(facecolor=UNKNOWN, edgecolor=EDGE, label="cell begins behind the sensor")
    report.legend_below(figure, [unknown])
    report.figure_title(figure, title)
    return figure


def _draw_map(axes: Axes, row: Mapping[str, Any], field: str) -> None:
    values = np.array([[np.nan if v is None else max(v, 1e-12) for v in line] for line in row[field]])
    axes.set_facecolor(UNKNOWN)
    axes.pcolormesh(
        row["distances"],
        row["depths"],
        np.ma.masked_invalid(values),
        norm=_SCALE,
        cmap="cividis",
        shading="nearest",
        rasterized=True,
    )
    report.label_axes(axes, label(row["method"], row["dim"]))
    report.log_axis(axes, "x", row["distances"])
    if np.isfinite(values).any():
        axes.text(
            0.97,
            0.04,
            f"max {np.nanmax(values):.1g}",
            transform=axes.transAxes,
            ha="right",
            fontsize=TICK_SIZE,
            bbox={"facecolor": "white", "alpha": 0.85, "edgecolor": "none", "pad": 2.5},
        )


def _sweep_figure(rows: Rows) -> Figure:
    groups = _by_dim(rows)
    quantities = {"hits": "hits per ray", "misses": "misses per ray", "probability": "probability θ"}
    figure = report.new_figure(13.5, 4.2 * len(groups) + 0.9)
    grid = figure.subplots(len(groups), len(quantities), squeeze=False, sharex=True)
    for line, (dim, own) in zip(grid, groups.items(), strict=True):
        places = np.arange(len(own))[::-1]
        for axes, (field, quantity) in zip(line, quantities.items(), strict=True):
            _draw_quantiles(axes, own, field, places)
            report.label_axes(axes, f"{dim}D: {quantity}", "absolute error" if line is grid[-1] else "")
            report.log_axis(axes, "x", [_LEAST, 1.0])
            axes.set_xlim(_LEAST / 3, 3)
            axes.set_xticks([_LEAST, 1e-6, 1e-3, 1], ["≤ 1e-9", "1e-6", "1e-3", "1"])
            axes.set_yticks(places, [label(r["method"], dim) for r in own] if axes is line[0] else [])
            axes.set_ylim(-0.6, len(own) - 0.4)
            report.draw_grid(axes, "x")
    report.legend_below(figure)
    title = "Error for random components and cells of any size, distance and incidence"
    report.figure_title(figure, f"{title}: {rows[0]['n_cases']:,} cases each")
    return figure


def _draw_quantiles(axes: Axes, rows: Rows, field: str, places: np.ndarray) -> None:
    values = {q: np.array([max(row[f"{field}_{q}"], _LEAST) for row in rows]) for q in _QUANTILES}
    axes.hlines(places, values["median"], values["max"], color="#bbbbbb", linewidth=3, zorder=1)
    for index, (quantile, text) in enumerate(_QUANTILES.items()):
        look = report.line_look(index) | {"linestyle": "", "markersize": 8}
        axes.plot(values[quantile], places, label=text, zorder=2, **look)


def _curve_figure(rows: Rows) -> Figure:
    groups = _by_dim(rows)
    figure = report.new_figure(5.8 * len(groups) + 0.6, 9.4)
    grid = figure.subplots(2, len(groups), squeeze=False, sharex="col", sharey="row")
    panels = {
        "error": "relative error of hits and misses",
        "probability_error": "root mean square error of θ",
    }
    for number, (dim, own) in enumerate(groups.items()):
        size = f"{dim}D: {own[0]['n_components']:,} components, {own[0]['n_cells']:,} cells"
        for axes, (field, text) in zip(grid[:, number], panels.items(), strict=True):
            _draw_curves(axes, own, field)
            report.label_axes(axes, "", "", text if number == 0 else "")
            report.log_axis(axes, "y", [row[field] for row in rows])
            report.log_axis(axes, "x", [row["seconds"] for row in own])
            axes.tick_params(labelbottom=True, labelleft=True)
            report.draw_grid(axes)
        grid[0, number].set_title(size, fontsize=TITLE_SIZE)
        grid[1, number].set_xlabel("time [s]", fontsize=LABEL_SIZE)
    report.legend_below(figure, max_columns=3)
    report.figure_title(figure, "Error against computing time on a whole grid")
    return figure


def _draw_curves(axes: Axes, rows: Rows, field: str) -> None:
    for method in dict.fromkeys(row["method"] for row in rows):
        own = [row for row in rows if row["method"] == method]
        index = _CURVES.index(method) if method in _CURVES else len(_CURVES)
        look = report.line_look(index) | {"markersize": 8, "linestyle": "-" if len(own) > 1 else ""}
        name = label(method, rows[0]["dim"]) + _settings(own)
        axes.plot([row["seconds"] for row in own], [row[field] for row in own], label=name, **look)


def _settings(rows: Rows) -> str:
    """Returns the settings along a line, from its first point to its last."""
    first, last = rows[0]["setting"], rows[-1]["setting"]
    if first is None:
        return ""
    if max(first, last) < 1:
        return f"\ntolerance {first:g} to {last:g}"
    return f"\n{first:,.0f} to {last:,.0f} rays"

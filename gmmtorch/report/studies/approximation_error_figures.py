"""How far off each form of evidence is (thesis Fig 3.3), and what its accuracy costs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from gmmtorch.report.style import (
    LABEL_SIZE,
    TICK_SIZE,
    UNKNOWN,
    Rows,
    colour,
    draw_grid,
    dress,
    figure_title,
    log_axis,
    marker,
    new_figure,
)

_LABELS = {
    "point": "point form",
    "monte_carlo": "Monte Carlo",
    "monte_carlo_plain": "Monte Carlo, plain",
    "monte_carlo_stratified": "Monte Carlo, stratified",
    "monte_carlo_sobol": "Monte Carlo, Sobol",
    "monte_carlo_large": "Monte Carlo, Sobol, many",
    "flux": "face flux",
    "flux_float32": "face flux, float32",
}
_COLOURS = {
    name: colour(i)
    for i, name in enumerate(
        ("flux", "cone", "cone_exact", "monte_carlo_plain", "monte_carlo_stratified", "monte_carlo_sobol")
    )
}
_SCALE = LogNorm(1e-6, 1.0)
_QUANTILES = (("median", 0.45), ("p99", 0.75), ("max", 1.0))


def figures(rows: Rows) -> dict[str, Figure]:
    """`approximation_error` and `approximation_error_probability`: maps of the error of E and of θ;
    `approximation_error_sweep`: quantiles on scenes at random; `approximation_error_curve`: error against
    time. Each where there are rows of its study."""
    drawn = {
        "approximation_error": ("map", _map_figure, "error", "Error of the share of rays E (hits + misses)"),
        "approximation_error_probability": (
            "map",
            _map_figure,
            "probability_error",
            "Error of the occupancy probability θ",
        ),
        "approximation_error_sweep": (
            "sweep",
            _sweep_figure,
            "",
            "Error on components and cells at random, of any size, distance and incidence",
        ),
        "approximation_error_curve": ("curve", _curve_figure, "", "What accuracy costs on a whole grid"),
    }
    found = {}
    for name, (study, draw, field, title) in drawn.items():
        chosen = [row for row in rows if row["study"] == study]
        if chosen:
            found[name] = draw(chosen, field, title)
    return found


def label(method: str, dim: int) -> str:
    """A method as a reader would name it: the thesis's form is another one in 2D and in 3D."""
    if method == "cone":
        return "thesis cone (3.3)" if dim == 2 else "thesis projection (3.4\N{EN DASH}3.7)"
    if method == "cone_exact":
        return "projection, exact polygon"
    return _LABELS.get(method, method)


def _dims(rows: Rows) -> list[int]:
    return sorted({int(row["dim"]) for row in rows})


def _map_figure(rows: Rows, field: str, title: str) -> Figure:
    dims = _dims(rows)
    most = max(sum(row["dim"] == dim for row in rows) for dim in dims)
    figure = new_figure(3.1 * most + 1.4, 3.3 * len(dims) + 1.3)
    grid = figure.subplots(len(dims), most, squeeze=False, sharex=True, sharey=True)
    for line, dim in zip(grid, dims, strict=True):
        here = [row for row in rows if row["dim"] == dim]
        for axes, row in zip(line, here, strict=False):
            _draw_map(axes, row, field)
        for axes in line[len(here) :]:
            axes.set_visible(False)
        line[0].set_ylabel(f"{dim}D:  depth r′ − p  [deviations]", fontsize=LABEL_SIZE)
    for column in range(most):
        lowest = max(i for i in range(len(dims)) if grid[i, column].get_visible())
        grid[lowest, column].set_xlabel("distance p  [deviations]", fontsize=LABEL_SIZE)
        grid[lowest, column].tick_params(labelbottom=True)
    bar = figure.colorbar(
        ScalarMappable(_SCALE, "cividis"), ax=grid.ravel().tolist(), pad=0.015, aspect=30, extend="both"
    )
    bar.set_label("largest absolute error, cells up to 2 deviations off axis", fontsize=LABEL_SIZE)
    bar.ax.tick_params(labelsize=TICK_SIZE)
    handles = [Patch(facecolor=UNKNOWN, edgecolor="#666666", label="cell begins behind the sensor")]
    figure.legend(handles=handles, loc="outside lower center", frameon=False, fontsize=LABEL_SIZE)
    figure_title(figure, title)
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
    dress(axes, label(row["method"], row["dim"]))
    log_axis(axes, "x", row["distances"])
    worst = f"max {np.nanmax(values):.1g}" if np.isfinite(values).any() else ""
    axes.text(
        0.97,
        0.04,
        worst,
        transform=axes.transAxes,
        ha="right",
        fontsize=TICK_SIZE,
        bbox={"facecolor": "white", "alpha": 0.85, "edgecolor": "none", "pad": 2.5},
    )


def _sweep_figure(rows: Rows, field: str, title: str) -> Figure:
    dims = _dims(rows)
    names = ("hits", "misses", "probability")
    titles = {"hits": "hits per ray", "misses": "misses per ray", "probability": "probability θ"}
    figure = new_figure(13.5, 4.2 * len(dims) + 0.9)
    grid = figure.subplots(len(dims), len(names), squeeze=False, sharex=True)
    for line, dim in zip(grid, dims, strict=True):
        here = [row for row in rows if row["dim"] == dim]
        places = np.arange(len(here))[::-1]
        for axes, name in zip(line, names, strict=True):
            _draw_quantiles(axes, here, name, places)
            dress(axes, f"{dim}D: {titles[name]}")
            log_axis(axes, "x", [1e-9, 1.0])
            axes.set_xlim(3e-10, 3)
            axes.set_xticks([1e-9, 1e-6, 1e-3, 1], ["≤ 1e-9", "1e-6", "1e-3", "1"])
            axes.set_yticks(places, [label(r["method"], dim) for r in here] if axes is line[0] else [])
            axes.set_ylim(-0.6, len(here) - 0.4)
            draw_grid(axes, "x")
    for axes in grid[-1]:
        axes.set_xlabel("absolute error", fontsize=LABEL_SIZE)
    handles, texts = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, texts, loc="outside lower center", ncols=3, frameon=False, fontsize=LABEL_SIZE)
    figure_title(figure, f"{title}: {rows[0]['n_cases']:,} cases each")
    return figure


def _draw_quantiles(axes: Axes, rows: Rows, name: str, places: np.ndarray) -> None:
    values = {q: np.array([max(row[f"{name}_{q}"], 1e-9) for row in rows]) for q, _ in _QUANTILES}
    axes.hlines(places, values["median"], values["max"], color="#bbbbbb", linewidth=3, zorder=1)
    for index, (quantile, _) in enumerate(_QUANTILES):
        text = {"median": "median", "p99": "99th percentile", "max": "largest"}[quantile]
        axes.plot(
            values[quantile],
            places,
            linestyle="",
            marker=marker(index),
            color=colour(index),
            markersize=8,
            label=text,
            zorder=2,
        )


def _curve_figure(rows: Rows, field: str, title: str) -> Figure:
    dims = _dims(rows)
    figure = new_figure(5.8 * len(dims) + 0.6, 9.4)
    grid = figure.subplots(2, len(dims), squeeze=False, sharex="col", sharey="row")
    panels = (
        ("error", "error of hits and misses, of all evidence"),
        ("probability_error", "root mean square error of θ"),
    )
    for column, dim in enumerate(dims):
        here = [row for row in rows if row["dim"] == dim]
        for axes, (name, text) in zip(grid[:, column], panels, strict=True):
            _draw_curves(axes, here, name)
            first = here[0]
            size = f"{dim}D: {first['n_components']:,} components, {first['n_cells']:,} cells"
            dress(axes, size if axes is grid[0, column] else "", "", text if column == 0 else "")
            log_axis(axes, "y", [row[name] for row in rows])
            log_axis(axes, "x", [row["seconds"] for row in here])
            axes.tick_params(labelbottom=True, labelleft=True)
            draw_grid(axes)
        grid[1, column].set_xlabel("time  [s]", fontsize=LABEL_SIZE)
    handles = {
        text: h for axes in grid.flat for h, text in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    figure.legend(
        handles.values(),
        handles.keys(),
        loc="outside lower center",
        ncols=3,
        frameon=False,
        fontsize=LABEL_SIZE,
    )
    figure_title(figure, title)
    return figure


def _draw_curves(axes: Axes, rows: Rows, name: str) -> None:
    methods = list(dict.fromkeys(row["method"] for row in rows))
    for method in methods:
        here = [row for row in rows if row["method"] == method]
        index = list(_COLOURS).index(method) if method in _COLOURS else len(_COLOURS)
        axes.plot(
            [row["seconds"] for row in here],
            [row[name] for row in here],
            color=_COLOURS.get(method, colour(index)),
            marker=marker(index),
            markersize=8,
            linewidth=2,
            linestyle="-" if len(here) > 1 else "",
            label=label(method, rows[0]["dim"]) + _settings(here),
        )


def _settings(rows: Rows) -> str:
    """The settings along a line, from its first point to its last."""
    first, last = rows[0]["setting"], rows[-1]["setting"]
    if first is None:
        return ""
    if max(first, last) < 1:
        return f"\ntolerance {first:g} to {last:g}"
    return f"\n{first:,.0f} to {last:,.0f} rays"

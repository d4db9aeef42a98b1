"""Ways to learn a mixture, side by side: how good, against how long they took."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gmmtorch.report.style import (
    LABEL_SIZE,
    Rows,
    colour,
    draw_grid,
    dress,
    figure_title,
    label_of,
    log_axis,
    marker,
    new_figure,
)


def comparison_figure(rows: Rows, title: str | None = None) -> Figure:
    """Log-likelihood, and PSNR2, against seconds on a logarithmic axis: a mark for each method.

    On the points held out where there are any, else on those that were learned from. The legend
    says how many components are in use. scikit-learn's marks are hollow.

    Args:
        rows: fit rows of `results.json`; where a value is None no mark is drawn.
        title: of the figure; data set and number of points if not given.
    """
    figure = new_figure(11.0, 5.6)
    left, right = figure.subplots(1, 2)
    held_out = any(row.get("held_out_log_likelihood") is not None for row in rows)
    prefix, where = ("held_out_", " of points held out") if held_out else ("", "")
    _draw(left, rows, f"{prefix}log_likelihood", f"log-likelihood{where}", "nats a point")
    _draw(right, rows, f"{prefix}psnr2_db", f"PSNR2{where}", "dB")
    lines, names = left.get_legend_handles_labels()
    if lines:
        figure.legend(lines, names, loc="outside lower center", ncols=3, frameon=False, fontsize=LABEL_SIZE)
    if title is None and rows:
        title = (
            f"Ways to learn a mixture: {label_of(str(rows[0]['dataset']))}, {rows[0]['n_points']:,} points"
        )
    figure_title(figure, title)
    return figure


def _draw(axes: Axes, rows: Rows, field: str, heading: str, unit: str) -> None:
    for index, row in enumerate(rows):
        value = row.get(field)
        used, method = row.get("n_components_used", row["n_components"]), label_of(str(row["method"]))
        axes.plot(
            [row["seconds"]],
            [float("nan") if value is None else value],
            marker=marker(index),
            color=colour(index),
            linestyle="",
            markersize=11,
            markeredgewidth=2,
            fillstyle="none" if method.startswith("scikit learn") else "full",
            label=f"{method}: {used:,} components",
        )
    dress(axes, heading, "seconds", unit)
    log_axis(axes, "x", [row["seconds"] for row in rows])
    axes.margins(0.12)
    draw_grid(axes)

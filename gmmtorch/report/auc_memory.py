"""AUC against the bytes of the map (thesis Table 3.1)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator

from gmmtorch.report.style import (
    LABEL_SIZE,
    TICK_SIZE,
    colour,
    dress,
    figure_title,
    label_of,
    line_style,
    marker,
    metres,
    new_figure,
)


def figures(rows: Sequence[Mapping[str, Any]]) -> dict[str, Figure]:
    """`auc_memory`: one panel a resolution, one line a method, a point for each size it was given.

    Args:
        rows: dataset, method, size, resolution (m), auc, auc_low, auc_high, nbytes.
    """
    resolutions = list(dict.fromkeys(float(row["resolution"]) for row in rows))
    methods = list(dict.fromkeys(str(row["method"]) for row in rows))
    figure = new_figure(1.2 + 6.2 * len(resolutions), 5.2)
    grid = figure.subplots(1, len(resolutions), squeeze=False, sharey=True)
    for axes, resolution in zip(grid[0], resolutions, strict=True):
        for index, method in enumerate(methods):
            here = [r for r in rows if r["method"] == method and float(r["resolution"]) == resolution]
            here.sort(key=lambda row: row["nbytes"])
            axes.errorbar(
                [row["nbytes"] for row in here],
                [row["auc"] for row in here],
                yerr=[
                    [max(0.0, row["auc"] - row["auc_low"]) for row in here],
                    [max(0.0, row["auc_high"] - row["auc"]) for row in here],
                ],
                color=colour(index),
                linestyle=line_style(index),
                marker=marker(index),
                markersize=7,
                linewidth=2,
                capsize=2,
                elinewidth=1,
                label=label_of(method),
            )
            for row in here:
                if row["size"] is not None:
                    axes.annotate(
                        f"{row['size']:,}",
                        (row["nbytes"], row["auc"]),
                        xytext=(4, -11),
                        textcoords="offset points",
                        fontsize=TICK_SIZE - 2,
                        color=colour(index),
                    )
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator())
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: _bytes(value)))
        dress(axes, f"cells of {metres(resolution)}", "bytes of the map", "")
        axes.grid(color="#e4e4e4", linewidth=0.8)
    grid[0][0].set_ylabel("area under the ROC curve", fontsize=LABEL_SIZE)
    lines, names = grid[0][0].get_legend_handles_labels()
    figure.legend(
        lines, names, loc="outside lower center", ncols=min(4, len(names)), frameon=False, fontsize=LABEL_SIZE
    )
    figure_title(figure, f"AUC against the size of the map: {rows[0]['dataset']}")
    return {"auc_memory": figure}


def _bytes(value: float) -> str:
    """1 KB is 1000 bytes."""
    for unit, size in (("GB", 1e9), ("MB", 1e6), ("KB", 1e3)):
        if value >= size:
            return f"{value / size:g} {unit}"
    return f"{value:g} B"

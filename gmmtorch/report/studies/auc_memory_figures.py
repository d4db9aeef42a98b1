"""AUC against the bytes of the map (thesis Table 3.1)."""

from __future__ import annotations

from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator

from gmmtorch.report.labels import Label, around, place_labels
from gmmtorch.report.quantities import byte_text
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


def figures(rows: Rows) -> dict[str, Figure]:
    """`auc_memory`: one panel a resolution, one line a method, a point for each size it was given.

    Args:
        rows: dataset, method, size, resolution (m), auc, auc_low, auc_high, nbytes.
    """
    resolutions = list(dict.fromkeys(float(row["resolution"]) for row in rows))
    methods = list(dict.fromkeys(str(row["method"]) for row in rows))
    figure = new_figure(1.2 + 6.2 * len(resolutions), 5.2)
    grid = figure.subplots(1, len(resolutions), squeeze=False, sharey=True)
    labels: list[Label] = []
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
            look = {"fontsize": TICK_SIZE - 1, "color": colour(index)}
            labels += [
                Label(axes, f"{row['size']:,}", around(row["nbytes"], row["auc"]), look)
                for row in here
                if row["size"] is not None
            ]
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator())
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: byte_text(value, digits=1)))
        dress(axes, f"cells of {metres(resolution)}", "bytes of the map", "")
        draw_grid(axes)
    grid[0][0].set_ylabel("area under the ROC curve", fontsize=LABEL_SIZE)
    lines, names = grid[0][0].get_legend_handles_labels()
    figure.legend(
        lines, names, loc="outside lower center", ncols=min(4, len(names)), frameon=False, fontsize=LABEL_SIZE
    )
    figure_title(figure, f"AUC against the size of the map: {rows[0]['dataset']}")
    place_labels(figure, labels)
    return {"auc_memory": figure}

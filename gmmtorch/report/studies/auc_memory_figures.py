"""Figure of AUC against the bytes of the map (thesis Table 3.1)."""

from __future__ import annotations

from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator

from gmmtorch.report import style
from gmmtorch.report.labels import Label, place_labels
from gmmtorch.report.quantities import byte_text


def figures(rows: style.Rows) -> dict[str, Figure]:
    """Draws `auc_memory`: one panel per resolution, one line per method, one point per size of its map.

    Args:
        rows: dataset, method, size, resolution (m), auc, auc_low, auc_high, nbytes.
    """
    resolutions = list(dict.fromkeys(float(row["resolution"]) for row in rows))
    methods = list(dict.fromkeys(str(row["method"]) for row in rows))
    figure = style.new_figure(1.2 + 6.2 * len(resolutions), 5.2)
    grid = figure.subplots(1, len(resolutions), squeeze=False, sharey=True)
    labels: list[Label] = []
    for axes, resolution in zip(grid[0], resolutions, strict=True):
        for index, method in enumerate(methods):
            own = [r for r in rows if r["method"] == method and float(r["resolution"]) == resolution]
            own.sort(key=lambda row: row["nbytes"])
            sizes = [row["nbytes"] for row in own]
            areas = [row["auc"] for row in own]
            axes.plot(sizes, areas, label=style.label_of(method), **style.line_look(index))
            style.draw_intervals(axes, sizes, own, style.colour(index))
            look = {"fontsize": style.TICK_SIZE - 1, "color": style.colour(index)}
            labels += [
                Label(axes, f"{row['size']:,}", row["nbytes"], row["auc"], look)
                for row in own
                if row["size"] is not None
            ]
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator())
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: byte_text(value, digits=1)))
        style.label_axes(axes, f"cells of {style.metres(resolution)}", "map size", "")
        style.draw_grid(axes)
    grid[0][0].set_ylabel("area under the ROC curve", fontsize=style.LABEL_SIZE)
    style.legend_below(figure, max_columns=4)
    style.figure_title(figure, f"AUC against map size: {rows[0]['dataset']}")
    place_labels(figure, labels)
    return {"auc_memory": figure}

"""Figure of rules that choose the number of components, compared with all fixed numbers."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gmmtorch.report import style
from gmmtorch.report.curve_panels import Panel, subject
from gmmtorch.report.labels import Label, place_labels

_FITS = (
    Panel("held_out_psnr2_db", "PSNR2 of held-out points", "dB"),
    Panel("held_out_log_likelihood", "log-likelihood of held-out points", "nats per point"),
    Panel("seconds", "time to choose the number and to fit", "seconds", log=True),
)
_AUC = Panel("auc", "maps of all scans: AUC of held-out beams", "area under the ROC curve")
_NAMES = {
    "fixed": "fixed number",
    "flat_pieces": "flat pieces (multiple of the noise)",
    "bic": "lowest BIC",
    "mean_shift": "mean shift (bandwidth)",
    "hierarchical": "tree with flat leaves (multiple of the noise)",
}
_MAP = "map_"
_SHOWN_NATS = 2.0
"""Range of log-likelihoods below the best that is shown: those of overfitted mixtures have no limit."""


def figures(rows: style.Rows) -> dict[str, Figure]:
    """Draws `component_count`: PSNR2 and log-likelihood of held-out points, time, and the AUC of maps,
    against bytes.

    Fixed numbers of components form a line; the choices of each rule are marks, labelled with its setting.

    Args:
        rows: of `gmmtorch.evaluation.studies.component_count`.
    """
    figure = style.new_figure(12.0, 9.4)
    grid = figure.subplots(2, 2)
    fits = [row for row in rows if not str(row["rule"]).startswith(_MAP)]
    maps = [
        {**row, "rule": str(row["rule"]).removeprefix(_MAP)}
        for row in rows
        if str(row["rule"]).startswith(_MAP)
    ]
    labels: list[Label] = []
    for axes, panel in zip(grid.flat, _FITS, strict=False):
        labels += _draw(axes, fits, panel)
    likelihoods = [row["held_out_log_likelihood"] for row in fits]
    best = max((value for value in likelihoods if value is not None), default=0.0)
    grid.flat[1].set_ylim(bottom=max(grid.flat[1].get_ylim()[0], best - _SHOWN_NATS))
    if maps:
        labels += _draw(grid.flat[3], maps, _AUC)
    grid.flat[3].set_visible(bool(maps))
    style.legend_below(figure, max_columns=5)
    style.figure_title(figure, f"Number of components: {subject(fits)}")
    place_labels(figure, labels)
    return {"component_count": figure}


def _draw(axes: Axes, rows: style.Rows, panel: Panel) -> list[Label]:
    """Draws a panel, and returns the labels of its marks."""
    labels: list[Label] = []
    measured = [row for row in rows if row[panel.field] is not None]
    for index, name in enumerate(_NAMES):
        own = sorted((row for row in measured if row["rule"] == name), key=lambda row: row["component_bytes"])
        if own:
            labels += _draw_rule(axes, own, panel.field, name, index)
    style.label_axes(axes, panel.title, "size of the components [bytes, float32]", panel.unit)
    style.log_axis(axes, "x", [row["component_bytes"] for row in measured])
    if panel.log:
        style.log_axis(axes, "y", [row[panel.field] for row in measured])
    style.draw_grid(axes)
    return labels


def _draw_rule(axes: Axes, rows: style.Rows, field: str, name: str, index: int) -> list[Label]:
    """Draws the line of fixed numbers, or the marks of a rule with a label for the setting of each."""
    sizes, values = [row["component_bytes"] for row in rows], [row[field] for row in rows]
    if name == "fixed":
        axes.plot(sizes, values, ".-", color="#333333", linewidth=1.6, label=_NAMES[name], zorder=2)
        return []
    look = style.line_look(index - 1) | {"linestyle": ":", "linewidth": 1.0, "markersize": 8}
    axes.plot(sizes, values, label=_NAMES[name], zorder=3, **look)
    if name == "bic":
        return []
    text = {"fontsize": style.TICK_SIZE, "color": look["color"], "zorder": 5}
    return [
        Label(axes, f"{row['setting']:g}", x, y, text) for row, x, y in zip(rows, sizes, values, strict=True)
    ]

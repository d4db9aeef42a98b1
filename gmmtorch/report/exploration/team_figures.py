"""Figure of a team whose robots are processes: the map of each robot over time, and what it sent."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from gmmtorch.report import style
from gmmtorch.report.exploration.trial_groups import REMAINING, check_rows, percent_left
from gmmtorch.report.labels import LineEnd, label_ends
from gmmtorch.report.quantities import byte_text
from gmmtorch.report.style import PALETTE, Rows

_HUES = {
    "components": PALETTE[0],
    "counts": PALETTE[5],
    "supersessions": PALETTE[4],
    "corrections": PALETTE[1],
    "points": PALETTE[6],
    "views": PALETTE[2],
    "plans": PALETTE[3],
    "announcements": "#9a9a9a",
}
"""Colours of the kinds of datagrams, in the order of the bars."""
_MAX_LABELS = 10


def team_run_figure(rows: Rows, title: str | None = None) -> Figure:
    """Draws the map of each robot over time (left), and the bytes it sent by kind, each datagram once
    (right).

    The left panel shows the remaining observable entropy of robots in a simulated world, and the number of
    records of other robots. Names on the right have the colours of the lines.

    Args:
        rows: rows of robots in `results.json`.
        title: title of the figure; by default the number of robots, and whether their maps are the same.

    Raises:
        InvalidArgumentError: no row.
    """
    check_rows(rows)
    figure = style.new_figure(11.6, max(4.2, 2.4 + 0.3 * len(rows)))
    left, right = figure.subplots(1, 2)
    _draw_maps(left, rows)
    _draw_bytes(right, rows)
    style.legend_below(figure, max_columns=8)
    style.figure_title(figure, title or _title(rows))
    return figure


def _title(rows: Rows) -> str:
    if len(rows) == 1:
        return f"Robot {rows[0]['robot']}"
    same = len({row["digest"] for row in rows}) == 1
    return f"{len(rows)} robots with {'the same map' if same else 'different maps'}"


def _draw_maps(axes: Axes, rows: Rows) -> None:
    explores = all(row.get("entropy_bits") and row.get("observable_bits") for row in rows)
    ends = []
    for index, row in enumerate(rows):
        values = percent_left(row) if explores else np.asarray(row["records_over_time"], dtype=np.float64)
        look = style.line_look(index, with_marker=False)
        axes.plot(np.asarray(row["times"], dtype=np.float64), values, **look)
        ends.append(LineEnd(float(values[-1]), f"{row['robot']}", style.colour(index)))
    style.label_axes(axes, "", "time of the robot [s]", REMAINING if explores else "number of records")
    begin, end = axes.dataLim.intervalx
    axes.set(xlim=(begin, end if end > begin else begin + 1), ylim=(0, axes.get_ylim()[1]))
    style.draw_grid(axes)
    if 1 < len(rows) <= _MAX_LABELS:
        label_ends(axes, ends)


def _draw_bytes(axes: Axes, rows: Rows) -> None:
    sizes = {kind: np.array([row["bytes_by_kind"].get(kind, 0.0) for row in rows]) for kind in _HUES}
    sizes = {kind: size for kind, size in sizes.items() if size.any()}
    totals = style.stacked_bars(axes, sizes, [_HUES[kind] for kind in sizes])
    for place, total in enumerate(totals):
        axes.text(total, place, f" {byte_text(float(total))}", va="center", fontsize=style.TICK_SIZE)
    style.label_axes(axes, "", "bytes sent, without headers", "")
    axes.set_yticks(range(len(rows)), [f"robot {row['robot']}" for row in rows], fontsize=style.LABEL_SIZE)
    for index, label in enumerate(axes.get_yticklabels()):
        label.set_color(style.colour(index))
    axes.set_xlim(0, 1.2 * max(float(totals.max(initial=0.0)), 1.0))
    axes.xaxis.set_major_locator(MaxNLocator(4))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: byte_text(value)))

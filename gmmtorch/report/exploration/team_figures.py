"""What became of a team whose robots are processes: each robot's map over time, and what it sent."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.report.exploration.mission_style import label_ends, percent_left
from gmmtorch.report.quantities import byte_text
from gmmtorch.report.style import (
    LABEL_SIZE,
    PALETTE,
    TICK_SIZE,
    Rows,
    colour,
    draw_grid,
    dress,
    figure_title,
    line_style,
    new_figure,
)

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
"""Of kinds of datagrams, in the order in which they are drawn."""
_MOST_LABELS = 10


def team_run_figure(rows: Rows, title: str | None = None) -> Figure:
    """Left, each robot's map over its time; right, what it sent, each datagram once, by kind.

    Of robots in a simulated world the left is the share of the observable entropy that their maps lack, of
    others how many records they hold. Names on the right are in the colours of the lines.

    Args:
        rows: of robots in `results.json`.
        title: of the figure; how many robots, and whether their maps are the same, if not given.

    Raises:
        InvalidArgumentError: no row.
    """
    if not rows:
        raise InvalidArgumentError("rows is empty; give the row of one robot at least.")
    figure = new_figure(11.6, max(4.2, 2.4 + 0.3 * len(rows)))
    left, right = figure.subplots(1, 2)
    _draw_maps(left, rows)
    _draw_bytes(right, rows)
    if right.containers:
        figure.legend(loc="outside lower center", ncols=8, frameon=False, fontsize=LABEL_SIZE)
    figure_title(figure, title or _title(rows))
    return figure


def _title(rows: Rows) -> str:
    if len(rows) == 1:
        return f"Robot {rows[0]['robot']}"
    same = len({row["digest"] for row in rows}) == 1
    return f"{len(rows)} robots: {'all hold the same map' if same else 'their maps differ'}"


def _draw_maps(axes: Axes, rows: Rows) -> None:
    explores = all(row.get("entropy_bits") and row.get("observable_bits") for row in rows)
    ends = []
    for index, row in enumerate(rows):
        times, values = np.asarray(row["times"], dtype=np.float64), _values(row, explores)
        look: dict[str, Any] = {"color": colour(index), "linestyle": line_style(index)}
        axes.plot(times, values, linewidth=1.8, **look)
        ends.append((float(values[-1]), f"{row['robot']}", colour(index)))
    dress(axes, "", "robot's time [s]", "entropy left [% of the observable]" if explores else "records held")
    begin, end = axes.dataLim.intervalx
    axes.set(xlim=(begin, end if end > begin else begin + 1), ylim=(0, axes.get_ylim()[1]))
    draw_grid(axes)
    if 1 < len(rows) <= _MOST_LABELS:
        label_ends(axes, ends)


def _values(row: Mapping[str, Any], explores: bool) -> np.ndarray:
    if explores:
        return percent_left(row)
    return np.asarray(row["records_over_time"], dtype=np.float64)


def _draw_bytes(axes: Axes, rows: Rows) -> None:
    start = np.zeros(len(rows))
    for kind, hue in _HUES.items():
        sizes = np.array([row["bytes_by_kind"].get(kind, 0) for row in rows], dtype=np.float64)
        if not sizes.any():
            continue
        look: dict[str, Any] = {"color": hue, "height": 0.66, "edgecolor": "white", "linewidth": 0.8}
        axes.barh(range(len(rows)), sizes, left=start, label=kind, **look)
        start += sizes
    for place, total in enumerate(start):
        axes.text(total, place, f" {byte_text(float(total))}", va="center", fontsize=TICK_SIZE)
    axes.set_yticks(range(len(rows)), [f"robot {row['robot']}" for row in rows], fontsize=LABEL_SIZE)
    dress(axes, "", "sent, without headers", "")
    for index, label in enumerate(axes.get_yticklabels()):
        label.set(color=colour(index), fontsize=LABEL_SIZE)
    axes.invert_yaxis()
    axes.set_xlim(0, 1.2 * max(float(start.max()), 1.0))
    axes.xaxis.set_major_locator(MaxNLocator(4))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: byte_text(value)))
    draw_grid(axes, "x")

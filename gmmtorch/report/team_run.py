"""What became of a team whose robots are processes: each robot's map over time, and what it sent."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.report.exploration_style import GRID, Rows, byte_text
from gmmtorch.report.style import LABEL_SIZE, TICK_SIZE, colour, dress, figure_title, line_style, new_figure

KINDS = ("components", "counts", "supersessions", "corrections", "points", "views", "plans", "announcements")
"""Of datagrams, in the order in which they are drawn."""
_HUES = dict(zip(KINDS, (0, 5, 4, 1, 6, 2, 3, 4), strict=True))
_HATCHED = ("announcements",)


def team_run_figure(rows: Rows, title: str | None = None) -> Figure:
    """Left, each robot's map over its time; right, what it sent, each datagram once, by kind.

    Of robots in a simulated world the left is the share of the observable entropy that their maps lack, of
    others how many records they hold. At its end a line has the robot's number.

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
    figure_title(figure, title or _title(rows))
    return figure


def _title(rows: Rows) -> str:
    if len(rows) == 1:
        return f"Robot {rows[0]['robot']}"
    same = len({row["digest"] for row in rows}) == 1
    return f"{len(rows)} robots: {'all hold the same map' if same else 'their maps differ'}"


def _draw_maps(axes: Axes, rows: Rows) -> None:
    explores = all(row.get("entropy_bits") and row.get("observable_bits") for row in rows)
    for index, row in enumerate(rows):
        times, values = np.asarray(row["times"], dtype=np.float64), _values(row, explores)
        look: dict[str, Any] = {"color": colour(index), "linestyle": line_style(index)}
        axes.plot(times, values, linewidth=1.8, **look)
        # Some lie on each other: the numbers stand side by side.
        axes.annotate(
            str(row["robot"]),
            (times[-1], values[-1]),
            (6 + 13 * index, 0),
            textcoords="offset points",
            va="center",
            color=colour(index),
            fontsize=LABEL_SIZE,
            annotation_clip=False,
        )
    dress(axes, "", "robot's time [s]", "entropy left [% of the observable]" if explores else "records held")
    axes.set_ylim(bottom=0)
    axes.grid(color=GRID, linewidth=0.8)


def _values(row: Mapping[str, Any], explores: bool) -> np.ndarray:
    if explores:
        return 100 * np.asarray(row["entropy_bits"], dtype=np.float64) / float(row["observable_bits"])
    return np.asarray(row["records_over_time"], dtype=np.float64)


def _draw_bytes(axes: Axes, rows: Rows) -> None:
    kinds = [kind for kind in KINDS if any(row["bytes_by_kind"].get(kind) for row in rows)]
    start = np.zeros(len(rows))
    for kind in kinds:
        sizes = np.array([row["bytes_by_kind"].get(kind, 0) for row in rows], dtype=np.float64)
        axes.barh(
            range(len(rows)),
            sizes,
            left=start,
            label=kind,
            color=colour(_HUES[kind]),
            hatch="///" if kind in _HATCHED else None,
            height=0.66,
            edgecolor="white",
            linewidth=0.8,
        )
        start += sizes
    for place, total in enumerate(start):
        axes.text(total, place, f" {byte_text(float(total))}", va="center", fontsize=TICK_SIZE)
    axes.set_yticks(range(len(rows)), [f"robot {row['robot']}" for row in rows], fontsize=LABEL_SIZE)
    for index, label in enumerate(axes.get_yticklabels()):
        label.set_color(colour(index))
    axes.invert_yaxis()
    axes.set_xlim(0, 1.2 * max(float(start.max()), 1.0))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: byte_text(value)))
    dress(axes, "", "sent, without headers", "")
    axes.grid(axis="x", color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    if kinds:
        axes.legend(
            loc="upper center",
            bbox_to_anchor=(0.5, -0.16),
            ncols=min(len(kinds), 4),
            fontsize=LABEL_SIZE - 1,
            frameon=False,
        )

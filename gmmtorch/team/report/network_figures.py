"""Figures of sharing: the cost of unreliable networks, and what each robot of a team of processes sent."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, NullLocator

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.report import (
    LABEL_SIZE,
    PALETTE,
    TICK_SIZE,
    TITLE_SIZE,
    LineEnd,
    Rows,
    byte_text,
    colour,
    draw_grid,
    figure_title,
    label_axes,
    label_ends,
    legend_below,
    line_look,
    line_style,
    new_figure,
    ratio_text,
    stacked_bars,
    tick_text,
)
from gmmtorch.team.exploration import Band
from gmmtorch.team.report.trial_groups import (
    REMAINING,
    TIME,
    about,
    by_variant,
    check_rows,
    curves_of,
    known,
    milestone_text,
    percent_left,
    seeds_note,
)

_MAX_COLUMNS = 5
_N_WINDOWS = 30  # the share of missing records is smoothed over this part of a mission
_LINEAR_BELOW = 0.1  # % of the records, below which the axis of missing ones is linear
_PERCENT_TICKS = (0.0, 0.1, 1.0, 10.0, 100.0)
_SERIES = ("entropy_bits", "wire_bytes_over_time", "missing_share")


def loss_figure(rows: Rows) -> Figure:
    """Draws remaining entropy and bytes with headers over simulated time, and below them one panel per
    variant with the share of all records that the robot with the most gaps is missing.

    Variants are named by the options in which they differ; lines are means over seeds in 95 % bands. Missing
    records are a median over a thirtieth of the mission, because every datagram on its way counts as missing;
    a thin line shows the values of a single mission. Partitions are shaded. Labels give the mean t90 and
    total bytes, and their mean ratios to the lossless mission of the same seed, if every seed has one. Titles
    give the share of cells that two robots classify differently at the end, and the time after a partition
    until all records are complete.

    Args:
        rows: explore rows of `results.json`, with the fields that `with_network_costs` adds.

    Raises:
        InvalidArgumentError: no row, or one without the series drawn or without observable entropy.
    """
    _check(rows)
    variants = by_variant(rows, otherwise="loss")
    last = max(float(row["times"][-1]) for row in rows) or 1.0
    window = last / _N_WINDOWS
    figure, left, sent, multiples = _panels(len(variants), window)
    entropy_ends, byte_ends = [], []
    for index, (axes, (name, trials)) in enumerate(zip(multiples, variants.items(), strict=True)):
        look: dict[str, Any] = {"color": colour(index), "linestyle": line_style(index)}
        entropy = curves_of(trials, [percent_left(row) for row in trials])
        n_bytes = curves_of(trials, [row["wire_bytes_over_time"] for row in trials])
        entropy.draw(left, **look)
        n_bytes.draw(sent, **look)
        lines, total = name.replace(", ", ",\n"), float(n_bytes.band.mean[-1])
        note = f"{milestone_text(trials, 't90')}{_ratio_note(trials, 't90_ratio')}"
        entropy_ends.append(LineEnd(float(entropy.band.mean[-1]), f"{lines}\n{note}", colour(index)))
        note = f"{byte_text(total)}{_ratio_note(trials, 'wire_ratio')}"
        byte_ends.append(LineEnd(total, f"{lines}\n{note}", colour(index)))
        _draw_missing(axes, trials, window, look)
        label_axes(axes, "", TIME, "% of all records")
        axes.label_outer()
        heading = "\n".join([name, *_map_texts(trials)])
        axes.set_title(heading, fontsize=LABEL_SIZE - 1, color=colour(index))
        _shade(axes, trials)
    label_axes(left, "remaining entropy", TIME, "% of observable")
    left.set_ylim(0, max(100.0, left.dataLim.y1) * 1.015)
    label_axes(sent, "bytes sent, with headers", TIME, "cumulative bytes")
    sent.set_ylim(0, max(sent.dataLim.y1, 1.0) * 1.03)
    tick_text(sent.yaxis, lambda value: byte_text(value, digits=2))
    for axes in (left, sent, *multiples):
        axes.set_xlim(0, last)
        draw_grid(axes)
    for axes, ends in ((left, entropy_ends), (sent, byte_ends)):
        _shade(axes, rows, "partition")
        label_ends(axes, ends, LABEL_SIZE - 1)
    figure_title(figure, f"Sharing over unreliable networks: {about(rows)}\n{seeds_note(rows)}")
    return figure


def _check(rows: Rows) -> None:
    check_rows(rows)
    for row in rows:
        missing = [name for name in _SERIES if not row.get(name)]
        if missing or not row["observable_bits"] > 0:
            raise InvalidArgumentError(
                f"A row of seed {row['seed']} has no {', '.join(missing) or 'observable_bits above zero'}; "
                "give rows of gmmtorch-explore."
            )


def _panels(n: int, window: float) -> tuple[Figure, Axes, Axes, list[Axes]]:
    """Returns a figure with two panels, and below them one for each of n variants, with common axes."""
    n_columns = min(n, _MAX_COLUMNS)
    n_rows = math.ceil(n / n_columns)
    heights = (4.2, 3.2 * n_rows)
    figure = new_figure(13.0, 0.8 + sum(heights))
    above, below = np.asarray(figure.subfigures(2, 1, height_ratios=heights))
    left, sent = above.subplots(1, 2)
    places = below.subplots(n_rows, n_columns, sharex=True, sharey=True, squeeze=False).ravel()
    text = f"missing records of the robot with the most gaps, median over {window:.3g} s"
    below.suptitle(text, fontsize=TITLE_SIZE)
    for spare in places[n:]:
        spare.set_visible(False)
    return figure, left, sent, list(places[:n])


def _draw_missing(axes: Axes, trials: Rows, window: float, look: Mapping[str, Any]) -> None:
    curves = curves_of(trials, [_percent_missing(row, window) for row in trials])
    mean, low, high = curves.band
    # Student's interval may exceed the bounds of a share.
    curves._replace(band=Band(mean, np.clip(low, 0, 100), np.clip(high, 0, 100))).draw(axes, **look)
    if len(trials) == 1:
        share = 100 * np.asarray(trials[0]["missing_share"], dtype=np.float64)
        axes.plot(trials[0]["times"], share, linewidth=0.6, alpha=0.4, color=look["color"])
    axes.set_yscale("symlog", linthresh=_LINEAR_BELOW, linscale=0.4)
    axes.set_ylim(0, 100)
    axes.set_yticks(_PERCENT_TICKS, [f"{share:g}" for share in _PERCENT_TICKS])
    axes.yaxis.set_minor_locator(NullLocator())


def _percent_missing(row: Mapping[str, Any], window: float) -> np.ndarray:
    """Returns the median (T,) within half a window (s) around each time."""
    times, share = (np.asarray(row[name], dtype=np.float64) for name in ("times", "missing_share"))
    first = np.searchsorted(times, times - window / 2 - 1e-9)
    end = np.searchsorted(times, times + window / 2 + 1e-9)
    return 100 * np.array([np.median(share[a:b]) for a, b in zip(first, end, strict=True)])


def _ratio_note(trials: Rows, field: str) -> str:
    """Returns the mean ratio to lossless missions, if every seed has one and these trials have faults."""
    ratios = known(trials, field)
    has_faults = any(row.get("loss") or row.get("partitions") for row in trials)
    return f", {ratio_text(float(np.mean(ratios)))}" if has_faults and len(ratios) == len(trials) else ""


def _map_texts(trials: Rows) -> list[str]:
    notes = []
    if len(differ := known(trials, "map_disagreement")) == len(trials):
        notes.append(f"{100 * np.mean(differ):.2g} % of cells differ")
    if len(healed := known(trials, "healed_after")) == len(trials):
        notes.append(f"complete after {np.mean(healed):.0f} s")
    return notes


def _shade(axes: Axes, rows: Rows, name: str = "") -> None:
    """Shades the times at which robots are cut off."""
    spans = {(float(cut["begin"]), float(cut["end"])) for row in rows for cut in row.get("partitions") or []}
    for begin, end in sorted(spans):
        axes.axvspan(begin, end, color="#ececec", zorder=0)
        axes.annotate(
            name,
            ((begin + end) / 2, 1),
            xytext=(0, -3),
            xycoords=("data", "axes fraction"),
            textcoords="offset points",
            ha="center",
            va="top",
            fontsize=TICK_SIZE - 1,
            color="#555555",
        )


_HUES = {
    "components": PALETTE[0],
    "counts": PALETTE[5],
    "supersessions": PALETTE[4],
    "corrections": PALETTE[1],
    "frames": "#8a6d3b",
    "points": PALETTE[6],
    "views": PALETTE[2],
    "plans": PALETTE[3],
    "announcements": "#9a9a9a",
}
"""Colours of the kinds of datagrams, in the order of the bars."""
_MAX_LABELS = 10


def team_run_figure(rows: Rows) -> Figure:
    """Draws the map of each robot over time (left), and the bytes it sent by kind, each datagram once
    (right).

    The left panel shows the remaining observable entropy of robots in a simulated world, and the number of
    records of other robots. Names on the right have the colours of the lines.

    Args:
        rows: rows of robots in `results.json`.

    Raises:
        InvalidArgumentError: no row.
    """
    check_rows(rows)
    figure = new_figure(11.6, max(4.2, 2.4 + 0.3 * len(rows)))
    left, right = figure.subplots(1, 2)
    _draw_maps(left, rows)
    _draw_bytes(right, rows)
    legend_below(figure, max_columns=8)
    figure_title(figure, _title(rows))
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
        look = line_look(index, with_marker=False)
        axes.plot(np.asarray(row["times"], dtype=np.float64), values, **look)
        ends.append(LineEnd(float(values[-1]), f"{row['robot']}", colour(index)))
    label_axes(axes, "", "time of the robot [s]", REMAINING if explores else "number of records")
    begin, end = axes.dataLim.intervalx
    axes.set(xlim=(begin, end if end > begin else begin + 1), ylim=(0, axes.get_ylim()[1]))
    draw_grid(axes)
    if 1 < len(rows) <= _MAX_LABELS:
        label_ends(axes, ends)


def _draw_bytes(axes: Axes, rows: Rows) -> None:
    sizes = {kind: np.array([row["bytes_by_kind"].get(kind, 0.0) for row in rows]) for kind in _HUES}
    sizes = {kind: size for kind, size in sizes.items() if size.any()}
    totals = stacked_bars(axes, sizes, [_HUES[kind] for kind in sizes])
    for place, total in enumerate(totals):
        axes.text(total, place, f" {byte_text(float(total))}", va="center", fontsize=TICK_SIZE)
    label_axes(axes, "", "bytes sent, without headers", "")
    axes.set_yticks(range(len(rows)), [f"robot {row['robot']}" for row in rows], fontsize=LABEL_SIZE)
    for index, label in enumerate(axes.get_yticklabels()):
        label.set_color(colour(index))
    axes.set_xlim(0, 1.2 * max(float(totals.max(initial=0.0)), 1.0))
    axes.xaxis.set_major_locator(MaxNLocator(4))
    tick_text(axes.xaxis, byte_text)

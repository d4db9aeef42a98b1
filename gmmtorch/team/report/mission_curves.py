"""Figures of exploring teams over simulated time (thesis Figs 4.4 and 4.5), and of what sharing costs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, NullLocator

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.report import (
    EDGE,
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
    log_axis,
    new_figure,
    ratio_text,
    stacked_bars,
    tick_text,
)
from gmmtorch.team.exploration import Band, time_to_share
from gmmtorch.team.report.trial_groups import (
    REMAINING,
    TIME,
    Curves,
    about,
    by_framework,
    by_variant,
    check_rows,
    curves_of,
    framework_colour,
    framework_name,
    known,
    milestone_text,
    observable,
    percent_left,
    seeds_note,
)

_MILESTONES = (("t50", 0.5, "o"), ("t90", 0.9, "s"))
_SIZE = (9.6, 5.4)  # inches
_DISTINCT = 2.0  # percent; a line closer to the team's line touches it
_BYTE_LINES = (
    ("gmm_shared", "bytes_over_time", "E0, as sent", framework_colour("gmm_shared"), "-"),
    ("grid_shared", "bytes_over_time", "E1, as sent", framework_colour("grid_shared"), "-"),
    ("gmm_thesis", "bytes_over_time", "E0 of the thesis, as sent", framework_colour("gmm_thesis"), "-"),
    ("gmm_shared", "raw_points_bytes_over_time", "E0's novel points, raw", PALETTE[6], "--"),
    ("gmm_shared", "draco_bytes_over_time", "same points, Draco", PALETTE[3], "-."),
    ("gmm_shared", "octree_bytes_over_time", "same points, zstd octree", PALETTE[4], ":"),
)


def entropy_figure(rows: Rows) -> Figure:
    """Draws the share of the observable entropy that remains in the team's union of maps (Fig 4.4).

    There is a line for each framework: the mean over seeds in its 95 % band. Marks show the mean t50 and
    t90 if every seed has one; dotted lines show the levels at which they are taken. A framework with one
    trial has no band, but thin lines for the maps of its robots, unless all are within 2 % of the team's.

    rows: explore rows of `results.json`.

    Raises `InvalidArgumentError`: no row, or one without observable entropy.
    """
    groups = by_framework(rows)
    whose = "E1's final reduction" if "grid_shared" in groups else "the final reduction"
    figure, axes, handles = _entropy_axes(_reference(groups.get("grid_shared", rows)), whose)
    ends, robots_drawn = [], False
    for framework, trials in groups.items():
        hue = framework_colour(framework)
        ends.append(_draw_trials(axes, framework_name(framework), trials, {"color": hue}))
        if len(trials) == 1:
            robots_drawn |= _draw_robots(axes, trials[0], hue)
    if robots_drawn:
        handles.append(Line2D([], [], color=EDGE, linewidth=0.8, label="map of one robot"))
    title = f"Entropy of the team's map: {about(rows)}\n{seeds_note(rows)}"
    return _finished(figure, axes, ends, rows, handles, title)


def planner_comparison_figure(rows: Rows) -> Figure:
    """Draws the share of the observable entropy that remains, one line per variant of the planner.

    Variants differ in any option; a label lists those in which they do. Lines are means over seeds in 95 %
    bands. t50 and t90 are times to 50 and 90 % of the largest mean reduction of any variant, so all variants
    are measured alike; marks show their means if every seed has one.

    Raises `InvalidArgumentError`: no row, or one without observable entropy.
    """
    check_rows(rows)
    variants = by_variant(rows)
    reference = max(_mean_reduction(trials) for trials in variants.values())
    figure, axes, handles = _entropy_axes(reference, "the best reduction")
    ends = []
    for index, (name, trials) in enumerate(variants.items()):
        look = {"color": colour(index), "linestyle": line_style(index)}
        ends.append(_draw_trials(axes, name, [_timed(row, reference) for row in trials], look))
    title = f"Planners: {about(rows)}\n{seeds_note(rows)}"
    return _finished(figure, axes, ends, rows, handles, title)


def bandwidth_figure(rows: Rows, draco_error: float = 0.03) -> Figure:
    """Draws the cumulative bytes that the team shared over time, on a logarithmic axis (Fig 4.5).

    Lines are what E0, E1 and the thesis's E0 sent, and the novel points of the frames that E0 learned from in
    other codecs: means over seeds in 95 % bands. Labels give the mean total, and its ratio to that of E0.

    rows: explore rows; E2 sends nothing and has no line. Series that are null are left out. draco_error: RMS
    error (m) of Draco's points: `FrameRule.noise` of the missions.

    Raises `InvalidArgumentError`: nothing was sent in any row.
    """
    groups = by_framework(rows)
    found = {}
    for framework, field, *_ in _BYTE_LINES:
        trials = [row for row in groups.get(framework, []) if row.get(field)]
        curves = curves_of(trials, [row[field] for row in trials]) if trials else None
        if curves is not None and curves.band.mean[-1] > 0:
            found[framework, field] = curves
    if not found:
        raise InvalidArgumentError(
            "rows contain no byte that was sent; give trials of teams that share maps."
        )
    base = found.get(("gmm_shared", "bytes_over_time"))
    figure = new_figure(*_SIZE)
    axes = figure.subplots()
    ends = []
    for framework, field, text, hue, dashes in _BYTE_LINES:
        if (curves := found.get((framework, field))) is None:
            continue
        curves.draw(axes, color=hue, linestyle=dashes)
        total = float(curves.band.mean[-1])
        note = byte_text(total)
        if base is not None and curves is not base:
            note += f", {ratio_text(total / float(base.band.mean[-1]))} E0"
        if field == "draco_bytes_over_time":
            text += f", {100 * draco_error:g} cm RMS"
        ends.append(LineEnd(total, f"{text}\n{note}", hue))
    label_axes(axes, "", TIME, "cumulative bytes")
    _byte_axis(axes, list(found.values()))
    title = f"Data shared by the team: {about(rows)}\n{seeds_note(rows)}"
    return _finished(figure, axes, ends, rows, [], title)


def _entropy_axes(reference: float | None, whose: str) -> tuple[Figure, Axes, list[Line2D]]:
    """Returns a figure with the levels of the milestones, and its legend entries. `reference` is the
    reduction, as a share of the observable entropy, that milestones are shares of; `whose` is its name."""
    figure = new_figure(*_SIZE)
    axes = figure.subplots()
    label_axes(axes, "", TIME, REMAINING)
    handles = [
        Line2D([], [], color=EDGE, marker=shape, linestyle="", markersize=7, label=name)
        for name, _, shape in _MILESTONES
    ]
    if reference is not None:
        look: dict[str, Any] = {"color": "#777777", "linewidth": 1, "linestyle": (0, (1, 2))}
        for _, share, _ in _MILESTONES:
            axes.axhline(100 * (1 - share * reference), zorder=1, **look)
        handles.append(Line2D([], [], label=f"50 % and 90 % of {whose}", **look))
    return figure, axes, handles


def _draw_trials(axes: Axes, name: str, trials: Rows, look: dict[str, Any]) -> LineEnd:
    """Draws the mean of trials with marks at their milestones, and returns the label of the line."""
    curves = curves_of(trials, [percent_left(row) for row in trials])
    curves.draw(axes, **look)
    for field, _, shape in _MILESTONES:
        times = known(trials, field)
        if len(times) == len(trials):
            mean = float(np.mean(times))
            height = float(np.interp(mean, curves.times, curves.band.mean))
            axes.plot(
                mean, height, shape, color=look["color"], markersize=8, markeredgecolor="white", zorder=5
            )
    notes = ", ".join(milestone_text(trials, field) for field, *_ in _MILESTONES)
    return LineEnd(float(curves.band.mean[-1]), f"{name}\n{notes}", look["color"])


def _draw_robots(axes: Axes, row: Mapping[str, Any], hue: str) -> bool:
    """Draws the maps of a trial's robots, and returns True; draws nothing if no line would be distinct."""
    shares = [percent_left(row, bits) for bits in row.get("entropy_bits_per_robot") or []]
    distinct = any(np.abs(share - percent_left(row)).max() > _DISTINCT for share in shares)
    for share in shares if distinct else []:
        axes.plot(row["times"], share, color=hue, linewidth=0.8, alpha=0.7, zorder=2)
    return distinct


def _finished(
    figure: Figure, axes: Axes, ends: Sequence[LineEnd], rows: Rows, handles: Sequence[Line2D], title: str
) -> Figure:
    """Sets limits and grid, and draws the labels of the lines, legend and title."""
    axes.set_xlim(0, max(float(row["times"][-1]) for row in rows) or 1.0)
    if handles:
        axes.set_ylim(0, max(100.0, axes.dataLim.y1) * 1.015)
    draw_grid(axes)
    label_ends(axes, ends, LABEL_SIZE - 0.5)
    legend_below(figure, handles)
    figure_title(figure, title)
    return figure


def _reference(rows: Rows) -> float | None:
    """Returns the stated reference reduction as a share of the observable entropy, or None if rows disagree;
    without a stated one, the mean reduction."""
    stated = {float(row["reference_bits"]) / observable(row) for row in rows if row.get("reference_bits")}
    if not stated:
        return _mean_reduction(rows)
    return stated.pop() if len(stated) == 1 else None


def _mean_reduction(rows: Rows) -> float:
    return float(np.mean([row["entropy_reduction_bits"] / observable(row) for row in rows]))


def _timed(row: Mapping[str, Any], reference: float) -> dict[str, Any]:
    """Returns the row with times to shares of a common reference, a share of the observable entropy."""
    reduction = 1 - percent_left(row) / 100
    times = {name: time_to_share(row["times"], reduction, reference, share) for name, share, _ in _MILESTONES}
    return {**row, **times}


def _byte_axis(axes: Axes, curves: Sequence[Curves]) -> None:
    """Makes the y axis logarithmic, from the first bytes of any curve, but over at most five decades."""
    highest = max(float(c.band.mean[-1]) for c in curves)
    lowest = max(min(float(c.band.mean[c.band.mean > 0][0]) for c in curves), highest / 1e5)
    low, high = lowest / 1.3, 1.3 * highest
    log_axis(axes, "y", (low, high))
    axes.set_ylim(low, high)
    tick_text(axes.yaxis, lambda value: byte_text(value, 2).replace(".0 ", " "))


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

    rows: explore rows of `results.json`, with the fields that `with_network_costs` adds.

    Raises `InvalidArgumentError`: no row, or one without the series drawn or without observable entropy.
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

    rows: rows of robots in `results.json`.

    Raises `InvalidArgumentError`: no row.
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

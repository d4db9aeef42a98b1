"""Figures of entropy and bytes of exploring teams over simulated time (thesis Figs 4.4 and 4.5)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.report import (
    EDGE,
    LABEL_SIZE,
    PALETTE,
    LineEnd,
    Rows,
    byte_text,
    colour,
    draw_grid,
    figure_title,
    label_axes,
    label_ends,
    legend_below,
    line_style,
    log_axis,
    new_figure,
    ratio_text,
    tick_text,
)
from gmmtorch.team.exploration import time_to_share
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

    Args:
        rows: explore rows of `results.json`.

    Raises:
        InvalidArgumentError: no row, or one without observable entropy.
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

    Raises:
        InvalidArgumentError: no row, or one without observable entropy.
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

    Args:
        rows: explore rows; E2 sends nothing and has no line. Series that are null are left out.
        draco_error: RMS error (m) of Draco's points: `map.noise` of the missions.

    Raises:
        InvalidArgumentError: nothing was sent in any row.
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
    """Returns a figure with the levels of the milestones, and its legend entries.

    `reference` is the reduction, as a share of the observable entropy, that milestones are shares of; `whose`
    is its name.
    """
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
    figure: Figure,
    axes: Axes,
    ends: Sequence[LineEnd],
    rows: Rows,
    handles: Sequence[Line2D],
    title: str,
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

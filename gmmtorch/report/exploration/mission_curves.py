"""Entropy and bytes of exploring teams over simulated time (thesis Figs 4.4 and 4.5)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import Normal, Stroke
from matplotlib.ticker import FuncFormatter

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.evaluation.paired_statistics import time_to_share
from gmmtorch.report.exploration.mission_style import (
    TIME,
    Curves,
    about,
    by_framework,
    curves_of,
    draw_curves,
    framework_colour,
    framework_name,
    label_ends,
    observable,
    percent_left,
    seeds_note,
)
from gmmtorch.report.exploration.variant_figures import by_variant
from gmmtorch.report.labels import Label, along, place_labels
from gmmtorch.report.quantities import byte_text, ratio_text
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
    log_axis,
    new_figure,
)

_MILESTONES = (("t50", 0.5, "o"), ("t90", 0.9, "s"))
_LEFT = "entropy left [% of the observable]"


def entropy_figure(rows: Rows, title: str | None = None) -> Figure:
    """Share of the observable entropy that the team's union still lacks, over time (Fig 4.4).

    A line for each framework: the mean over seeds, in its 95 % band. Marks at the mean t50 and t90,
    where every seed has one; dotted, the levels they stand for, where rows of E1 say how far it got.
    A framework with one trial has no band, and its robots' own maps as thin lines.

    Args:
        rows: explore rows of `results.json`.
        title: of the figure; world, robots and number of seeds if not given.

    Raises:
        InvalidArgumentError: no row, or one with nothing to observe.
    """
    groups = by_framework(rows)
    figure = new_figure(9.6, 5.4)
    axes = figure.subplots()
    whose = "E1's" if "grid_shared" in groups else "the"
    levels = _draw_levels(axes, _reference(list(groups.get("grid_shared", rows))))
    ends = []
    for framework, trials in groups.items():
        hue = framework_colour(framework)
        curves = curves_of(trials, [percent_left(row) for row in trials])
        draw_curves(axes, curves, color=hue)
        if len(trials) == 1:
            _draw_robots(axes, trials[0], hue)
        notes = [_mark(axes, trials, curves, levels, *milestone, hue) for milestone in _MILESTONES]
        text = "\n".join([framework_name(framework), ", ".join(notes)])
        ends.append((float(curves.band.mean[-1]), text, hue))
    _finish(axes, ends, rows)
    handles = _milestone_handles()
    if any(len(trials) == 1 for trials in groups.values()):
        handles.append(Line2D([], [], color="#555555", linewidth=0.8, label="each robot's own map"))
    _legend(figure, handles)
    figure_title(figure, title or f"Entropy of the team's map: {about(rows)}\n{seeds_note(rows)}")
    place_labels(figure, _level_labels(axes, levels, f"{whose} final reduction"))
    return figure


def bandwidth_figure(rows: Rows, title: str | None = None, draco_error: float = 0.03) -> Figure:
    """Bytes of what the team shared, cumulative over time on a logarithmic axis (Fig 4.5).

    What E0 sent, the novel points of the very frames that it learned from by other codecs, and what
    E1 sent; means over seeds in 95 % bands. The labels give the mean total, and its ratio to E0's.

    Args:
        rows: explore rows; of E2, which sends nothing, none is drawn. Series that are null are left out.
        title: of the figure; world, robots and number of seeds if not given.
        draco_error: RMS (m) of Draco's points, `map.noise` of the missions.

    Raises:
        InvalidArgumentError: rows among which no byte was sent.
    """
    groups = by_framework(rows)
    lines = [
        (framework, field, text, hue, style)
        for framework, field, text, hue, style in _BYTE_LINES
        if any(row.get(field) for row in groups.get(framework, []))
    ]
    found = {(f, field): _byte_curves(groups[f], field) for f, field, *_ in lines}
    found = {key: curves for key, curves in found.items() if curves.band.mean[-1] > 0}
    if not found:
        raise InvalidArgumentError("rows hold no byte that was sent; give trials of teams that share maps.")
    base = found.get(("gmm_shared", "bytes_over_time"))
    figure = new_figure(9.6, 5.4)
    axes = figure.subplots()
    ends = []
    for framework, field, text, hue, style in lines:
        if (curves := found.get((framework, field))) is None:
            continue
        draw_curves(axes, _above_zero(curves), color=hue, linestyle=style)
        total = float(curves.band.mean[-1])
        note = byte_text(total)
        if base is not None and curves is not base:
            note += f", {ratio_text(total / float(base.band.mean[-1]))} E0"
        if field == "draco_bytes_over_time":
            text += f", {100 * draco_error:g} cm RMS"
        ends.append((total, f"{text}\n{note}", hue))
    _byte_axis(axes, list(found.values()))
    _finish(axes, ends, rows, percent=False)
    figure_title(figure, title or f"What the team shared: {about(rows)}\n{seeds_note(rows)}")
    return figure


def planner_comparison_figure(rows: Rows, title: str | None = None) -> Figure:
    """Share of the observable entropy left over time, a line for each planner variant.

    Variants are told apart by every option that one may set; a label names those in which they differ.
    Means over seeds in 95 % bands. Marks at the mean t50 and t90 where every seed has one: times to 50
    and 90 % of the largest mean reduction of any variant, whatever rows say of their own, so that all are
    measured alike.

    Raises:
        InvalidArgumentError: no row, or one with nothing to observe.
    """
    if not rows:
        raise InvalidArgumentError("rows is empty; give the rows of one trial at least.")
    variants = {
        name: [{**row, "reference_bits": None} for row in trials] for name, trials in by_variant(rows).items()
    }
    reference = max(_reference(trials) or 0.0 for trials in variants.values())
    figure = new_figure(9.6, 5.4)
    axes = figure.subplots()
    levels = _draw_levels(axes, reference)
    ends = []
    for index, (name, trials) in enumerate(variants.items()):
        trials = [_timed(row, reference) for row in trials]
        look: dict[str, Any] = {"color": colour(index), "linestyle": line_style(index)}
        curves = curves_of(trials, [percent_left(row) for row in trials])
        draw_curves(axes, curves, **look)
        notes = [_mark(axes, trials, curves, levels, *milestone, colour(index)) for milestone in _MILESTONES]
        ends.append((float(curves.band.mean[-1]), f"{name}\n{', '.join(notes)}", colour(index)))
    _finish(axes, ends, rows)
    _legend(figure, _milestone_handles())
    figure_title(figure, title or f"Planners: {about(rows)}\n{seeds_note(rows)}")
    place_labels(figure, _level_labels(axes, levels, "the best"))
    return figure


_BYTE_LINES = (
    ("gmm_shared", "bytes_over_time", "E0 as sent", framework_colour("gmm_shared"), "-"),
    ("grid_shared", "bytes_over_time", "E1 as sent", framework_colour("grid_shared"), "-"),
    ("gmm_shared", "raw_points_bytes_over_time", "raw novel points", PALETTE[6], "--"),
    ("gmm_shared", "draco_bytes_over_time", "same points, Draco", PALETTE[3], "-."),
    ("gmm_shared", "octree_bytes_over_time", "same points, zstd octree", PALETTE[4], ":"),
)


def _timed(row: Mapping[str, Any], reference: float) -> dict[str, Any]:
    """The row with its times to shares of a common reference, a share of the observable."""
    reduction = 1 - percent_left(row) / 100
    times = {name: time_to_share(row["times"], reduction, reference, share) for name, share, _ in _MILESTONES}
    return {**row, **times}


def _milestone_handles() -> list[Line2D]:
    return [
        Line2D([], [], color="#555555", marker=shape, linestyle="", markersize=7, label=name)
        for name, _, shape in _MILESTONES
    ]


def _legend(figure: Figure, handles: Sequence[Line2D]) -> None:
    """Beneath the axes: within them a curve may be anywhere."""
    figure.legend(
        handles=list(handles),
        loc="outside lower center",
        ncols=len(handles),
        fontsize=LABEL_SIZE - 1,
        frameon=False,
    )


def _reference(rows: Rows) -> float | None:
    """The reduction that milestones are shares of, as a share of the observable; None if rows disagree."""
    said = {float(row["reference_bits"]) / observable(row) for row in rows if row.get("reference_bits")}
    if said:
        return said.pop() if len(said) == 1 else None
    return float(np.mean([row["entropy_reduction_bits"] / observable(row) for row in rows]))


def _draw_levels(axes: Axes, reference: float | None) -> dict[str, float]:
    """The entropy left (%) at each milestone, drawn and by name."""
    if reference is None:
        return {}
    levels = {name: 100 * (1 - share * reference) for name, share, _ in _MILESTONES}
    for level in levels.values():
        axes.axhline(level, color="#777777", linewidth=1, linestyle=(0, (1, 2)), zorder=1)
    return levels


def _level_labels(axes: Axes, levels: Mapping[str, float], of: str) -> list[Label]:
    halo = [Stroke(linewidth=3, foreground="white"), Normal()]
    look = {"fontsize": TICK_SIZE, "color": "#555555", "path_effects": halo}
    return [
        Label(axes, f"{100 * share:.0f} % of {of}", along(levels[name]), look)
        for name, share, _ in _MILESTONES
        if name in levels
    ]


def _draw_robots(axes: Axes, row: Mapping[str, Any], hue: str) -> None:
    for bits in row.get("entropy_bits_per_robot") or []:
        axes.plot(row["times"], percent_left(row, bits), color=hue, linewidth=0.8, alpha=0.7, zorder=2)


def _mark(
    axes: Axes,
    trials: Rows,
    curves: Curves,
    levels: Mapping[str, float],
    name: str,
    share: float,
    shape: str,
    hue: str,
) -> str:
    """A mark at the mean of a milestone, where every trial has reached it; and what a label says of it."""
    reached = [float(row[name]) for row in trials if row.get(name) is not None]
    if len(reached) < len(trials):
        return f"{name} in {len(reached)} of {len(trials)}" if reached else f"{name} not reached"
    when = float(np.mean(reached))
    height = levels.get(name, float(np.interp(when, curves.times, curves.band.mean)))
    axes.plot(when, height, shape, color=hue, markersize=8, markeredgecolor="white", zorder=5)
    return f"{name} {when:.0f} s"


def _finish(axes: Axes, ends: Sequence[tuple[float, str, str]], rows: Rows, percent: bool = True) -> None:
    """Labels, limits, grid, and the names beside the lines."""
    last = max(float(row["times"][-1]) for row in rows)
    dress(axes, "", TIME, _LEFT if percent else "bytes, cumulative")
    axes.set_xlim(0, last or 1.0)
    if percent:
        axes.set_ylim(0, max(100.0, axes.dataLim.y1) * 1.015)
    draw_grid(axes)
    label_ends(axes, ends, LABEL_SIZE - 0.5)


def _byte_curves(trials: Rows, field: str) -> Curves:
    kept = [row for row in trials if row.get(field)]
    return curves_of(kept, [row[field] for row in kept])


def _above_zero(curves: Curves) -> Curves:
    """For a logarithmic axis: nothing where nothing was sent yet, and no band below a tenth of the mean."""
    mean, low, high = curves.band
    shown = np.where(mean > 0, mean, np.nan)
    band = type(curves.band)(shown, np.fmax(low, shown / 10), np.where(mean > 0, high, np.nan))
    return curves._replace(band=band)


def _byte_axis(axes: Axes, curves: Sequence[Curves]) -> None:
    """A logarithmic axis from the first bytes of any curve on, as far as these are within five decades."""
    highest = max(float(c.band.mean[-1]) for c in curves)
    lowest = max(min(float(c.band.mean[c.band.mean > 0][0]) for c in curves), highest / 1e5)
    low, high = lowest / 1.3, 1.3 * highest
    log_axis(axes, "y", (low, high))
    axes.set_ylim(low, high)
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: byte_text(value, 2).replace(".0 ", " ")))

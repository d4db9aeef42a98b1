"""Figures that compare frameworks: results with paired differences."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.report import (
    LABEL_SIZE,
    TICK_SIZE,
    Rows,
    byte_text,
    draw_grid,
    figure_title,
    label_axes,
    new_figure,
    tick_text,
)
from gmmtorch.team.exploration import mean_band
from gmmtorch.team.report.trial_groups import (
    about,
    by_framework,
    by_variant,
    framework_colour,
    framework_name,
    paired_difference,
    seeds_note,
    short_name,
)


class _Measure(NamedTuple):
    """A field of the rows, its title and unit; whether to compare logarithms, on a logarithmic axis."""

    field: str
    title: str
    unit: str = ""
    by_ratio: bool = False


_MOST_ALL_PAIRS = 3  # frameworks that are all compared with each other; more are compared with the first only
_MEASURES = (
    _Measure("bytes_sent", "bytes sent", by_ratio=True),
    _Measure("t90", "t90", "s"),
    _Measure("auc", "AUC"),
    _Measure("coverage_per_metre", "coverage per metre flown", "m³/m"),
)


def summary_bars(rows: Rows) -> Figure:
    """Draws bytes sent, t90, AUC and coverage per metre of each framework, and below them the differences.

    Above: a dot per seed, and the mean with its 95 % interval. If a seed has no value (it never reached t90),
    text says how many have one, because a mean of these would be biased. Below: the mean difference of two
    frameworks over their common seeds with its paired 95 % interval, and a line at zero; for bytes, the
    geometric mean of the ratio, and a line at one. "none" if a seed has no value. With more than three
    frameworks, only the first is compared with the others.

    rows: explore rows of `results.json`.

    Raises `InvalidArgumentError`: no row.
    """
    groups = by_framework(rows)
    pairs = list(itertools.combinations(groups, 2))
    if len(groups) > _MOST_ALL_PAIRS:
        pairs = [pair for pair in pairs if pair[0] == next(iter(groups))]
    figure = new_figure(3.2 * len(_MEASURES) + 1.0, 5.9 if pairs else 3.9)
    grid = figure.subplots(
        2 if pairs else 1, len(_MEASURES), squeeze=False, height_ratios=[1.25, 1] if pairs else [1]
    )
    for measure, column in zip(_MEASURES, grid.T, strict=True):
        values = {name: _by_seed(trials, measure) for name, trials in groups.items()}
        for place, (framework, trials) in enumerate(groups.items()):
            _draw_group(column[0], place, values[framework], len(trials), framework_colour(framework))
        if measure.by_ratio:
            _log_ticks(column[0], lambda value: byte_text(value, digits=1))
        _name_places(column[0], [short_name(name) for name in groups])
        label_axes(column[0], measure.title, "", measure.unit)
        if pairs:
            _draw_differences(column[1], values, pairs, measure)
    for axes in grid.flat:
        draw_grid(axes, "y")
    names = ", ".join(framework_name(name) for name in groups)
    figure_title(figure, f"{about(rows)}: {names}\n{seeds_note(rows, '95 % interval')}")
    return figure


def deviations_figure(rows: Rows) -> Figure:
    """Draws, for each variant, its mean difference to the first one, over common seeds with the paired 95 %
    interval: entropy removed (ratio), t90 (t50 unless all missions reach t90), AUC, and bytes sent (ratio).

    An interval that does not contain the line of no difference has the variant's colour, others are grey. A
    variant without a value for some seed has none.

    Raises `InvalidArgumentError`: no row, or only one variant.
    """
    (usual, first), *others = by_variant(rows, otherwise="framework").items()
    if not others:
        raise InvalidArgumentError(f"rows contain one variant, {usual}; give another one to compare.")
    time = "t90" if all(row.get("t90") is not None for row in rows) else "t50"
    measures = (
        _Measure("entropy_reduction_bits", "entropy removed", by_ratio=True),
        _Measure(time, time, "s"),
        _Measure("auc", "AUC"),
        _Measure("bytes_sent", "bytes sent", by_ratio=True),
    )
    figure = new_figure(2.9 * len(measures) + 2.4, 1.9 + 0.36 * len(others))
    columns = figure.subplots(1, len(measures), sharey=True)
    for axes, measure in zip(columns, measures, strict=True):
        none = 1.0 if measure.by_ratio else 0.0
        axes.axvline(none, color="#777777", linewidth=1)
        values = _by_seed(first, measure)
        for place, (_, trials) in enumerate(others):
            interval = paired_difference(_by_seed(trials, measure), values, by_ratio=measure.by_ratio)
            if interval is None:
                continue
            mean, low, high = interval
            hue = "#888888" if low <= none <= high else framework_colour(str(trials[0]["framework"]))
            if math.isfinite(low) and math.isfinite(high):
                axes.plot([low, high], [place, place], color=hue, linewidth=2)
            axes.plot(mean, place, "o", color=hue, markersize=6)
        if measure.field == "bytes_sent":
            axes.set_xscale("log")
            axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            tick_text(axes.xaxis, lambda value: f"{value:g}×")
            axes.xaxis.set_minor_formatter(NullFormatter())
        kind = "ratio" if measure.by_ratio else f"difference{f' [{measure.unit}]' if measure.unit else ''}"
        label_axes(axes, measure.title, kind, "")
        draw_grid(axes, "x")
    columns[0].set_yticks(range(len(others)), [name for name, _ in others], fontsize=LABEL_SIZE)
    columns[0].set_ylim(len(others) - 0.5, -0.5)
    figure_title(figure, f"{about(rows)}: variants beside {usual}\n{seeds_note(rows, '95 % interval')}")
    return figure


def _by_seed(trials: Rows, measure: _Measure) -> dict[Any, float | None]:
    """Returns the value of each seed; None if there is none, or none to take a ratio of."""
    values: dict[Any, float | None] = {}
    for row in trials:
        value = math.nan if row.get(measure.field) is None else float(row[measure.field])
        valid = math.isfinite(value) and (value > 0 or not measure.by_ratio)
        values[row.get("seed")] = value if valid else None
    return values


def _draw_group(
    axes: Axes, place: float, by_seed: Mapping[Any, float | None], n_trials: int, hue: str
) -> None:
    values = np.array([value for value in by_seed.values() if value is not None])
    spread = place + np.linspace(-0.12, 0.12, len(values)) if len(values) > 1 else [place] * len(values)
    axes.plot(spread, values, "o", color=hue, alpha=0.45, markersize=5, markeredgewidth=0)
    if not len(values):
        _say_none(axes, place, hue)
        return
    if len(values) < n_trials:
        look: dict[str, Any] = {"textcoords": "offset points", "ha": "center", "color": hue}
        axes.annotate(f"{len(values)} of {n_trials}", (place, values.max()), (0, 6), **look)
        axes.margins(y=0.14)  # room for the text above the highest dot
        return
    _draw_interval(axes, place, [float(part[0]) for part in mean_band(values[:, None])], hue)


def _draw_interval(axes: Axes, place: float, interval: Sequence[float], hue: str) -> None:
    """Draws mean, low and high."""
    mean, low, high = interval
    axes.plot([place - 0.24, place + 0.24], [mean, mean], color=hue, linewidth=2.4)
    if math.isfinite(low):
        axes.errorbar(place, mean, [[mean - low], [high - mean]], color=hue, capsize=5, linewidth=1.5)


def _draw_differences(
    axes: Axes,
    values: Mapping[str, Mapping[Any, float | None]],
    pairs: Sequence[tuple[str, str]],
    measure: _Measure,
) -> None:
    axes.axhline(1 if measure.by_ratio else 0, color="#777777", linewidth=1)
    for place, (first, second) in enumerate(pairs):
        interval = paired_difference(values[first], values[second], by_ratio=measure.by_ratio)
        if interval is None:
            _say_none(axes, place, "#333333")
        else:
            _draw_interval(axes, place, interval, hue="#333333")
    if measure.by_ratio:
        _log_ticks(axes, lambda value: f"{value:g}×")
    if len(axes.lines) == 1:  # no difference: the scale has no meaning
        axes.set_yticks([])
    sign = "/" if measure.by_ratio else "\N{MINUS SIGN}"
    _name_places(axes, [f"{short_name(a)} {sign} {short_name(b)}" for a, b in pairs])
    kind = "ratio" if measure.by_ratio else "difference"
    label_axes(axes, "", "", f"{kind} [{measure.unit}]" if measure.unit else kind)


def _say_none(axes: Axes, place: float, hue: str) -> None:
    """Writes that there is no value, in the middle of the axes."""
    axes.text(place, 0.5, "none", ha="center", color=hue, transform=axes.get_xaxis_transform())


def _log_ticks(axes: Axes, text: Callable[[float], str]) -> None:
    axes.set_yscale("log")
    tick_text(axes.yaxis, text)


def _name_places(axes: Axes, names: Sequence[str]) -> None:
    axes.set_xticks(range(len(names)), names, fontsize=TICK_SIZE)
    axes.set_xlim(-0.6, len(names) - 0.4)

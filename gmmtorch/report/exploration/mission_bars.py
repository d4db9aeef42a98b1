"""What frameworks came to, side by side with their paired differences, and where their time went."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.evaluation.paired_statistics import Interval, mean_band, paired_interval
from gmmtorch.report.exploration.mission_style import (
    about,
    by_framework,
    framework_colour,
    framework_name,
    seeds_note,
)
from gmmtorch.report.quantities import byte_text
from gmmtorch.report.style import (
    LABEL_SIZE,
    TICK_SIZE,
    Rows,
    colour,
    draw_grid,
    dress,
    figure_title,
    label_of,
    new_figure,
)


class _Measure(NamedTuple):
    """A field of the rows, its name and unit; whether of many magnitudes, and compared by ratios."""

    field: str
    title: str
    unit: str = ""
    by_ratio: bool = False


_MEASURES = (
    _Measure("bytes_sent", "bytes sent", by_ratio=True),
    _Measure("t90", "t90", "s"),
    _Measure("auc", "AUC"),
    _Measure("coverage_per_metre", "coverage per metre flown", "m³/m"),
)


def summary_bars(rows: Rows, title: str | None = None) -> Figure:
    """Bytes sent, t90, AUC and coverage per metre of each framework, and beneath them what differs.

    Above, a dot for each seed, and the mean with its 95 % interval. Where some seeds have no value (a t90
    never reached) there is no mean, which would be that of the lucky ones, but how many have one.
    Beneath, the mean difference of each two frameworks over the seeds that both ran, with its paired
    95 % interval, which does not touch the line at zero where there is a difference; of bytes, the
    geometric mean of the ratio, and the line at one. Nothing where a seed lacks a value.

    Raises:
        InvalidArgumentError: no row.
    """
    groups = by_framework(rows)
    n = len(_MEASURES)
    pairs = list(itertools.combinations(groups, 2))
    figure = new_figure(3.2 * n + 1.0, (5.6 if pairs else 3.6) + 0.3)
    grid = figure.subplots(2 if pairs else 1, n, squeeze=False, height_ratios=[1.25, 1] if pairs else [1])
    for measure, column in zip(_MEASURES, grid.T, strict=True):
        for place, (framework, trials) in enumerate(groups.items()):
            values = [value for value in _by_seed(trials, measure).values() if value is not None]
            _draw_group(column[0], place, np.array(values), len(trials), framework_colour(framework))
        if measure.by_ratio:
            column[0].set_yscale("log")
            column[0].yaxis.set_major_formatter(FuncFormatter(lambda value, _: byte_text(value, digits=1)))
        _name_places(column[0], [framework_name(name).split()[0] for name in groups])
        dress(column[0], measure.title, "", measure.unit)
        if pairs:
            _draw_differences(column[1], groups, pairs, measure)
    for axes in grid.flat:
        draw_grid(axes, "y")
    names = ", ".join(framework_name(name) for name in groups)
    figure_title(figure, title or f"{about(rows)}: {names}\n{seeds_note(rows, '95 % interval')}")
    return figure


def stage_means(rows: Rows) -> tuple[dict[str, dict[str, float]], dict[str, float]]:
    """Mean wall seconds of each stage, and mean simulated seconds, of each framework, as `profile_figure`
    takes them. Rows: explore rows with `stage_seconds`."""
    stages, simulated = {}, {}
    for framework, trials in by_framework(rows).items():
        names = dict.fromkeys(name for row in trials for name in row["stage_seconds"])
        stages[framework] = {
            name: float(np.mean([row["stage_seconds"].get(name, 0.0) for row in trials])) for name in names
        }
        simulated[framework] = float(np.mean([row["times"][-1] for row in trials]))
    return stages, simulated


def profile_figure(
    stages: Mapping[str, Mapping[str, float]],
    simulated_seconds: Mapping[str, float] | float,
    title: str | None = "Wall time of a simulated second",
) -> Figure:
    """Where the time goes: milliseconds a simulated second by stage, a bar for each framework.

    At its end how many simulated seconds pass in one of the wall.

    Args:
        stages: by framework, wall seconds of each stage of a mission, of all robots together.
        simulated_seconds: how long the missions were, by framework or one for all.
        title: of the figure.

    Raises:
        InvalidArgumentError: no framework, negative times, or a mission of no length.
    """
    if not stages:
        raise InvalidArgumentError("stages is empty; give the wall seconds of one framework at least.")
    names = list(dict.fromkeys(stage for times in stages.values() for stage in times))
    hues = {name: colour(index + 3) for index, name in enumerate(names)}
    figure = new_figure(9.6, 1.9 + 0.62 * len(stages))
    axes = figure.subplots()
    costs = {f: _milliseconds(f, times, simulated_seconds) for f, times in stages.items()}
    longest = max(sum(cost.values()) for cost in costs.values()) or 1.0
    for place, cost in enumerate(costs.values()):
        start = 0.0
        for name, width in cost.items():
            axes.barh(
                place, width, left=start, color=hues[name], height=0.62, edgecolor="white", linewidth=0.8
            )
            if width > 0.05 * longest:
                ink = "white" if _luminance(hues[name]) < 0.4 else "#111111"
                axes.text(
                    start + width / 2,
                    place,
                    f"{width:.0f}",
                    ha="center",
                    va="center",
                    fontsize=TICK_SIZE,
                    color=ink,
                )
            start += width
        pace = f"{1000 / start:.1f}× real time" if start > 0 else ""
        axes.text(start + 0.01 * longest, place, f" {start:.0f} ms, {pace}", va="center", fontsize=LABEL_SIZE)
    axes.set_yticks(range(len(costs)), [framework_name(f) for f in costs], fontsize=LABEL_SIZE)
    axes.invert_yaxis()
    axes.set_xlim(0, 1.3 * longest)
    dress(axes, "", "wall time [ms a simulated second]", "")
    draw_grid(axes, "x")
    for name in names:
        axes.barh(0, 0, color=hues[name], label=label_of(name))
    figure.legend(loc="outside lower center", ncols=min(len(names), 7), frameon=False, fontsize=LABEL_SIZE)
    figure_title(figure, title)
    return figure


def _by_seed(trials: Rows, measure: _Measure) -> dict[Any, float | None]:
    """The value of each seed; None for one that has no number, or nothing to take ratios of."""
    values: dict[Any, float | None] = {}
    for row in trials:
        value = math.nan if row.get(measure.field) is None else float(row[measure.field])
        sound = math.isfinite(value) and (value > 0 or not measure.by_ratio)
        values[row.get("seed")] = value if sound else None
    return values


def _draw_group(axes: Axes, place: float, values: np.ndarray, n_trials: int, hue: str) -> None:
    spread = place + np.linspace(-0.12, 0.12, len(values)) if len(values) > 1 else [place] * len(values)
    axes.plot(spread, values, "o", color=hue, alpha=0.45, markersize=5, markeredgewidth=0)
    if len(values) < n_trials:
        text = f"{len(values)} of {n_trials}" if len(values) else "none"
        axes.text(place, 0.5, text, ha="center", color=hue, transform=axes.get_xaxis_transform())
        return
    mean, low, high = (float(part[0]) for part in mean_band(values[:, None]))
    _draw_interval(axes, place, mean, low, high, hue)


def _draw_interval(axes: Axes, place: float, mean: float, low: float, high: float, hue: str) -> None:
    axes.plot([place - 0.24, place + 0.24], [mean, mean], color=hue, linewidth=2.4)
    if math.isfinite(low):
        axes.errorbar(place, mean, [[mean - low], [high - mean]], color=hue, capsize=5, linewidth=1.5)


def _draw_differences(
    axes: Axes,
    groups: Mapping[str, Rows],
    pairs: Sequence[tuple[str, str]],
    measure: _Measure,
) -> None:
    axes.axhline(1 if measure.by_ratio else 0, color="#777777", linewidth=1)
    short = {name: framework_name(name).split()[0] for name in groups}
    for place, (first, second) in enumerate(pairs):
        a, b = _by_seed(groups[first], measure), _by_seed(groups[second], measure)
        shared = [(a[seed], b[seed]) for seed in a if seed in b]
        known = [(x, y) for x, y in shared if x is not None and y is not None]
        if not shared or len(known) < len(shared):
            continue
        scale = math.log if measure.by_ratio else float
        interval = paired_interval([scale(x) for x, _ in known], [scale(y) for _, y in known])
        if measure.by_ratio:
            interval = Interval(*np.exp(interval).tolist())
        _draw_interval(axes, place, *interval, hue="#333333")
    if measure.by_ratio:
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}×"))
    sign = "/" if measure.by_ratio else "\N{MINUS SIGN}"
    _name_places(axes, [f"{short[a]} {sign} {short[b]}" for a, b in pairs])
    kind = "ratio" if measure.by_ratio else "difference"
    dress(axes, "", "", f"{kind} [{measure.unit}]" if measure.unit else kind)


def _name_places(axes: Axes, names: Sequence[str]) -> None:
    axes.set_xticks(range(len(names)), names, fontsize=TICK_SIZE)
    axes.set_xlim(-0.6, len(names) - 0.4)


def _milliseconds(
    framework: str, stages: Mapping[str, float], simulated_seconds: Mapping[str, float] | float
) -> dict[str, float]:
    length = simulated_seconds[framework] if isinstance(simulated_seconds, Mapping) else simulated_seconds
    if not length > 0 or any(not seconds >= 0 for seconds in stages.values()):
        raise InvalidArgumentError(
            f"{framework}: simulated_seconds={length} must be above zero, and no stage below: {dict(stages)}."
        )
    return {name: 1000 * seconds / length for name, seconds in stages.items()}


def _luminance(hue: str) -> float:
    red, green, blue = to_rgb(hue)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue

"""What bad networks cost a team: entropy left, bytes on the wire and records missing, over time."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullLocator

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.evaluation.paired_statistics import Band
from gmmtorch.report.exploration.mission_style import (
    TIME,
    Curves,
    about,
    curves_of,
    draw_curves,
    label_ends,
    percent_left,
    seeds_note,
)
from gmmtorch.report.exploration.variant_figures import by_variant
from gmmtorch.report.quantities import byte_text, ratio_text
from gmmtorch.report.style import (
    LABEL_SIZE,
    TICK_SIZE,
    TITLE_SIZE,
    Rows,
    colour,
    draw_grid,
    dress,
    figure_title,
    line_style,
    new_figure,
)

_MOST_COLUMNS = 5
_N_WINDOWS = 30  # in a mission, over which what a robot lacks is smoothed
_LEAST = 0.1  # % of the records, below which the axis of those missing is linear
_SHARES = (0.0, 0.1, 1.0, 10.0, 100.0)
_SERIES = ("entropy_bits", "wire_bytes_over_time", "missing_share")


def loss_figure(rows: Rows, title: str | None = None) -> Figure:
    """Over simulated time: the entropy that the team's union still lacks, bytes on the wire with the headers
    of UDP and IP, and beneath, a panel a variant, of the records that any robot holds the share that the
    robot lacks that lacks the most.

    Variants are named by the options in which they differ; lines are means over seeds, in their 95 % bands.
    What robots lack jumps with every datagram that is on its way, so it is the median around each time, over
    a thirtieth of the mission; thin, what a single mission had. Partitions are shaded. Labels give the mean
    t90 where every seed has one, the mean total of bytes, and the mean ratio of each to the lossless mission
    of the same seed where every seed has one; and the share of cells at the end that two robots put into
    different classes, with how long after its partition a team was whole again.

    Args:
        rows: explore rows of `results.json`, with what `with_network_costs` adds.
        title: of the figure; world, robots and number of seeds if not given.

    Raises:
        InvalidArgumentError: no row, one without the series that are drawn, or with nothing to observe.
    """
    _check(rows)
    variants = by_variant(rows, otherwise="loss")
    last = max(float(row["times"][-1]) for row in rows) or 1.0
    window = last / _N_WINDOWS
    figure, left, sent, multiples = _panels(len(variants), window)
    ends: tuple[list[tuple[float, str, str]], ...] = ([], [])
    for index, (axes, (name, trials)) in enumerate(zip(multiples, variants.items(), strict=True)):
        look: dict[str, Any] = {"color": colour(index), "linestyle": line_style(index)}
        drawn = (
            (left, curves_of(trials, [percent_left(row) for row in trials]), _t90_text(trials)),
            (sent, curves_of(trials, [row["wire_bytes_over_time"] for row in trials]), _wire_text(trials)),
        )
        for (above, curves, note), notes in zip(drawn, ends, strict=True):
            draw_curves(above, curves, **look)
            text = "\n".join([name.replace(", ", ",\n"), note])
            notes.append((float(curves.band.mean[-1]), text, colour(index)))
        _draw_lacking(axes, trials, window, look)
        dress(axes, "", TIME, "% of all that are held")
        axes.label_outer()
        heading = "\n".join([name, *_map_texts(trials)])
        axes.set_title(heading, fontsize=LABEL_SIZE - 1, color=colour(index))
    _dress_panels(left, sent)
    for axes in (left, sent, *multiples):
        axes.set_xlim(0, last)
        draw_grid(axes)
    for axes, notes in zip((left, sent), ends, strict=True):
        _shade(axes, rows, "partition")
        label_ends(axes, notes, LABEL_SIZE - 1)
    for axes, trials in zip(multiples, variants.values(), strict=True):
        _shade(axes, trials)
    figure_title(figure, title or f"Sharing over bad networks: {about(rows)}\n{seeds_note(rows)}")
    return figure


def _check(rows: Rows) -> None:
    if not rows:
        raise InvalidArgumentError("rows is empty; give the rows of one trial at least.")
    for row in rows:
        missing = [name for name in _SERIES if not row.get(name)]
        if missing or not row["observable_bits"] > 0:
            raise InvalidArgumentError(
                f"A row of seed {row['seed']} has no {', '.join(missing) or 'observable_bits above zero'}; "
                "give rows of gmmtorch-explore."
            )


def _panels(n: int, window: float) -> tuple[Figure, Axes, Axes, list[Axes]]:
    """Two panels, and beneath them one for each of n variants, all of these alike."""
    n_columns = min(n, _MOST_COLUMNS)
    n_rows = math.ceil(n / n_columns)
    heights = (4.2, 3.2 * n_rows)
    figure = new_figure(13.0, 0.8 + sum(heights))
    above, beneath = np.asarray(figure.subfigures(2, 1, height_ratios=heights))
    left, sent = above.subplots(1, 2)
    places = beneath.subplots(n_rows, n_columns, sharex=True, sharey=True, squeeze=False).ravel()
    beneath.suptitle(f"records that a robot lacks, at most: median over {window:.3g} s", fontsize=TITLE_SIZE)
    for spare in places[n:]:
        spare.set_visible(False)
    return figure, left, sent, list(places[:n])


def _draw_lacking(axes: Axes, trials: Rows, window: float, look: Mapping[str, Any]) -> None:
    draw_curves(axes, _shares(curves_of(trials, [_percent_lacking(row, window) for row in trials])), **look)
    if len(trials) == 1:
        (row,) = trials
        share = 100 * np.asarray(row["missing_share"], dtype=np.float64)
        axes.plot(row["times"], share, linewidth=0.6, alpha=0.4, color=look["color"])
    axes.set_yscale("symlog", linthresh=_LEAST, linscale=0.4)
    axes.set_ylim(0, 100)
    axes.set_yticks(_SHARES, [f"{share:g}" for share in _SHARES])
    axes.yaxis.set_minor_locator(NullLocator())


def _percent_lacking(row: Mapping[str, Any], window: float) -> np.ndarray:
    """The median (T,) within half a window (s) of each time."""
    times, share = (np.asarray(row[name], dtype=np.float64) for name in ("times", "missing_share"))
    first = np.searchsorted(times, times - window / 2 - 1e-9)
    end = np.searchsorted(times, times + window / 2 + 1e-9)
    return 100 * np.array([np.median(share[a:b]) for a, b in zip(first, end, strict=True)])


def _shares(curves: Curves) -> Curves:
    """With a band that is a share too: Student's interval knows of no bounds."""
    mean, low, high = curves.band
    return curves._replace(band=Band(mean, np.clip(low, 0, 100), np.clip(high, 0, 100)))


def _t90_text(trials: Rows) -> str:
    times = _known(trials, "t90")
    if len(times) < len(trials):
        return f"t90 in {len(times)} of {len(trials)}" if times else "t90 not reached"
    return f"t90 {np.mean(times):.0f} s{_ratio_note(trials, 't90_ratio')}"


def _wire_text(trials: Rows) -> str:
    total = float(np.mean([row["wire_bytes_over_time"][-1] for row in trials]))
    return f"{byte_text(total)}{_ratio_note(trials, 'wire_ratio')}"


def _ratio_note(trials: Rows, field: str) -> str:
    """The mean ratio to lossless missions, if there is one in every seed, and they are not the trials."""
    ratios = _known(trials, field)
    disturbed = any(row.get("loss") or row.get("partitions") for row in trials)
    return f", {ratio_text(float(np.mean(ratios)))}" if disturbed and len(ratios) == len(trials) else ""


def _map_texts(trials: Rows) -> list[str]:
    notes = []
    if len(differ := _known(trials, "map_disagreement")) == len(trials):
        notes.append(f"{100 * np.mean(differ):.2g} % of cells differ")
    if len(healed := _known(trials, "healed_after")) == len(trials):
        notes.append(f"whole again in {np.mean(healed):.0f} s")
    return notes


def _known(trials: Rows, field: str) -> list[float]:
    return [float(row[field]) for row in trials if row.get(field) is not None]


def _dress_panels(left: Axes, sent: Axes) -> None:
    dress(left, "entropy left", TIME, "% of the observable")
    left.set_ylim(0, max(100.0, left.dataLim.y1) * 1.015)
    dress(sent, "sent, with headers", TIME, "bytes, cumulative")
    sent.set_ylim(0, max(sent.dataLim.y1, 1.0) * 1.03)
    sent.yaxis.set_major_formatter(FuncFormatter(lambda value, _: byte_text(value, digits=2)))


def _shade(axes: Axes, rows: Rows, name: str = "") -> None:
    """The times at which robots are cut off."""
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

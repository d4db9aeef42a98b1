"""What bad networks cost a team: entropy left, bytes on the wire and records missing, over time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullLocator

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.evaluation.trials import Band
from gmmtorch.report.exploration_style import (
    TIME,
    Curves,
    about,
    curves_of,
    draw_curves,
    label_ends,
    percent_left,
    seeds_note,
)
from gmmtorch.report.exploration_variants import by_variant
from gmmtorch.report.quantities import byte_text, ratio_text
from gmmtorch.report.style import (
    LABEL_SIZE,
    TICK_SIZE,
    Rows,
    colour,
    draw_grid,
    dress,
    figure_title,
    line_style,
    new_figure,
)

_LEAST = 0.1  # % of the records, below which the axis of those missing is linear
_SHARES = (0.0, 0.1, 1.0, 10.0, 100.0)
_SERIES = ("entropy_bits", "wire_bytes_over_time", "missing_share")


def loss_figure(rows: Rows, title: str | None = None) -> Figure:
    """Three panels over simulated time: the entropy that the team's union still lacks, bytes on the wire
    with the headers of UDP and IP, and, of the records that any robot holds, the share that the robot lacks
    that lacks the most.

    A line for each variant, named by the options in which variants differ: the mean over seeds, in its 95 %
    band. Partitions are shaded. Labels give the mean t90 where every seed has one, the mean total of bytes,
    and the mean ratio of each to the lossless mission of the same seed where every seed has one; and the
    share of cells at the end that two robots put into different classes, with how long after its partition
    a team was whole again.

    Args:
        rows: explore rows of `results.json`, with what `with_network_costs` adds.
        title: of the figure; world, robots and number of seeds if not given.

    Raises:
        InvalidArgumentError: no row, one without the series that are drawn, or with nothing to observe.
    """
    if not rows:
        raise InvalidArgumentError("rows is empty; give the rows of one trial at least.")
    for row in rows:
        missing = [name for name in _SERIES if not row.get(name)]
        if missing or not row["observable_bits"] > 0:
            raise InvalidArgumentError(
                f"A row of seed {row['seed']} has no {', '.join(missing) or 'observable_bits above zero'}; "
                "give rows of gmmtorch-explore."
            )
    figure = new_figure(17.5, 5.6)
    left, sent, lacking = figure.subplots(1, 3)
    ends: tuple[list[tuple[float, str, str]], ...] = ([], [], [])
    for index, (name, trials) in enumerate(by_variant(rows, otherwise="loss").items()):
        look: dict[str, Any] = {"color": colour(index), "linestyle": line_style(index)}
        drawn = (
            (left, curves_of(trials, [percent_left(row) for row in trials]), [_t90_text(trials)]),
            (sent, curves_of(trials, [row["wire_bytes_over_time"] for row in trials]), [_wire_text(trials)]),
            (lacking, _shares(curves_of(trials, [_percent_lacking(r) for r in trials])), _map_texts(trials)),
        )
        for (axes, curves, note), notes in zip(drawn, ends, strict=True):
            draw_curves(axes, curves, **look)
            text = "\n".join([name.replace(", ", ",\n"), *note])
            notes.append((float(curves.band.mean[-1]), text, colour(index)))
    _dress_panels(left, sent, lacking)
    last = max(float(row["times"][-1]) for row in rows)
    for axes, notes in zip((left, sent, lacking), ends, strict=True):
        axes.set_xlim(0, last or 1.0)
        draw_grid(axes)
        _shade(axes, rows)
        label_ends(axes, notes, LABEL_SIZE - 1)
    figure_title(figure, title or f"Sharing over bad networks: {about(rows)}\n{seeds_note(rows)}")
    return figure


def _percent_lacking(row: Mapping[str, Any]) -> np.ndarray:
    return 100 * np.asarray(row["missing_share"], dtype=np.float64)


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


def _dress_panels(left: Axes, sent: Axes, lacking: Axes) -> None:
    dress(left, "entropy left", TIME, "% of the observable")
    left.set_ylim(0, max(100.0, left.dataLim.y1) * 1.015)
    dress(sent, "sent, with headers", TIME, "bytes, cumulative")
    sent.set_ylim(0, max(sent.dataLim.y1, 1.0) * 1.03)
    sent.yaxis.set_major_formatter(FuncFormatter(lambda value, _: byte_text(value, digits=2)))
    dress(lacking, "records that a robot lacks, at most", TIME, "% of all that are held")
    lacking.set_yscale("symlog", linthresh=_LEAST, linscale=0.4)
    lacking.set_ylim(0, 100)
    lacking.set_yticks(_SHARES, [f"{share:g}" for share in _SHARES])
    lacking.yaxis.set_minor_locator(NullLocator())


def _shade(axes: Axes, rows: Rows) -> None:
    """The times at which robots are cut off."""
    spans = {(float(cut["begin"]), float(cut["end"])) for row in rows for cut in row.get("partitions") or []}
    for begin, end in sorted(spans):
        axes.axvspan(begin, end, color="#ececec", zorder=0)
        axes.annotate(
            "partition",
            ((begin + end) / 2, 1),
            xytext=(0, -3),
            xycoords=("data", "axes fraction"),
            textcoords="offset points",
            ha="center",
            va="top",
            fontsize=TICK_SIZE - 1,
            color="#555555",
        )

"""What a study found, as text: means and ranges of each variant, and what differs between them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.evaluation.paired_statistics import paired_interval
from gmmtorch.exploration.mission.variants import NETWORK, differing
from gmmtorch.report.exploration.mission_style import Rows
from gmmtorch.report.exploration.variant_figures import by_variant

_NOTHING = "\N{EN DASH}"
_MOST_TO_PAIR = 3  # variants of which all pairs are compared; more are compared with the first


class _Measure(NamedTuple):
    """A field of the rows, or more of one within it; what it is called, with its unit; how it is written."""

    path: str
    title: str
    scale: float = 1.0
    digits: int = 0
    percent: bool = False
    of_networks: bool = False  # of interest only where these differ


_MEASURES = (
    _Measure("entropy_reduction_bits", "entropy taken away (kbit)", 1e-3),
    _Measure("t50", "t50 (s)"),
    _Measure("t90", "t90 (s)"),
    _Measure("auc", "AUC, all observable cells", digits=3),
    _Measure("cross_entropy_bits", "cross-entropy (bits a cell)", digits=3),
    _Measure("observed_share", "cells observed", 100.0, 1, percent=True),
    _Measure("map_disagreement", "cells on which two robots differ", 100.0, 1, percent=True),
    _Measure("coverage_per_metre", "coverage (m³/m)", digits=1),
    _Measure("path_length", "flown (m)"),
    _Measure("overlap", "seen by two or more", 100.0, percent=True),
    _Measure("collisions", "collisions"),
    _Measure("bytes_sent", "sent (kB)", 1e-3),
    _Measure("bytes_by_kind.components", "of it components (kB)", 1e-3),
    _Measure("bytes_raw_points", "novel points, 12 B each (kB)", 1e-3),
    _Measure("bytes_octree", "the same as an octree (kB)", 1e-3),
    _Measure("bytes_draco", "the same by Draco (kB)", 1e-3),
    _Measure("wire_bytes", "on the wire, with headers (kB)", 1e-3),
    _Measure("bits_per_byte", "entropy a byte on the wire (bits)", digits=2),
    _Measure("wire_ratio", "bytes on the wire, lossless = 1", digits=2, of_networks=True),
    _Measure("t90_ratio", "t90, lossless = 1", digits=2, of_networks=True),
    _Measure("healed_after", "whole again after a cut (s)"),
    _Measure("converged_after", "maps equal after the end (s)"),
    _Measure("simulated_per_wall_seconds", "simulated s a wall second", digits=1),
)


def study_summary(rows: Rows) -> str:
    """Two Markdown tables: what was measured of each variant, and what differs.

    First the mean over seeds, and in brackets the least and the most, of those that have a value; "2 of 5"
    where others have none, as a t90 that was never reached. Then mean differences over the seeds that both
    ran, with Student's 95 % interval of pairs (`evaluation.paired_interval`); a dash where a seed has no
    value. Up to three variants are compared each with each, more with the first alone. What no row has is
    left out.

    Raises `InvalidArgumentError`: no row.
    """
    if not rows:
        raise InvalidArgumentError("rows is empty; give the rows of one trial at least.")
    groups = by_variant(rows, otherwise="framework")
    n_seeds = len({row.get("seed") for row in rows})
    shown = [m for m in _MEASURES if not m.of_networks or {*differing(rows)} & {*NETWORK}]
    measures = [m for m in shown if any(_value(row, m) is not None for row in rows)]
    measured = {name: [_spread(group, measure) for measure in measures] for name, group in groups.items()}
    lines = _table(f"{n_seeds} seeds: mean (range)", measures, measured)
    pairs = list(itertools.combinations(groups, 2))
    if len(groups) > _MOST_TO_PAIR:
        pairs = [(other, first) for first, other in pairs if first == next(iter(groups))]
    if pairs and n_seeds > 1:
        compared = {
            f"{a} \N{MINUS SIGN} {b}": [_difference(groups[a], groups[b], measure) for measure in measures]
            for a, b in pairs
        }
        lines += ["", "Differences by seed: mean, and 95 % interval.", "", *_table("", measures, compared)]
    return "\n".join(lines) + "\n"


def _table(head: str, measures: Sequence[_Measure], columns: Mapping[str, Sequence[str]]) -> list[str]:
    """Lines of a table: a row for each measure of which there is anything to say."""
    titles = [measure.title for measure in measures]
    heads = [name.replace("|", "\\|") for name in columns]  # as partitions have them
    rows = [row for row in zip(titles, *columns.values(), strict=True) if {*row[1:]} != {_NOTHING}]
    return [f"| {' | '.join(row)} |" for row in ([head, *heads], ["---"] * (1 + len(columns)), *rows)]


def _value(row: Mapping[str, Any], measure: _Measure) -> float | None:
    value: Any = row
    for key in measure.path.split("."):
        value = value.get(key) if isinstance(value, Mapping) else None
    return float(value) * measure.scale if isinstance(value, int | float) and math.isfinite(value) else None


def _text(value: float, measure: _Measure, sign: str = "") -> str:
    rounded = round(value, measure.digits) + 0.0  # no zero is negative
    text = f"{rounded:{sign},.{measure.digits}f}".replace("-", "\N{MINUS SIGN}")
    return f"{text} %" if measure.percent else text


def _spread(group: Rows, measure: _Measure) -> str:
    values = [value for row in group if (value := _value(row, measure)) is not None]
    if not values:
        return _NOTHING
    mean, low, high = (_text(v, measure) for v in (sum(values) / len(values), min(values), max(values)))
    text = mean if low == high else f"{mean} ({low} to {high})"
    return text if len(values) == len(group) else f"{text}, {len(values)} of {len(group)}"


def _difference(first: Rows, second: Rows, measure: _Measure) -> str:
    a, b = ({row.get("seed"): _value(row, measure) for row in group} for group in (first, second))
    shared = [(a[seed], b[seed]) for seed in a if seed in b]
    known = [(x, y) for x, y in shared if x is not None and y is not None]
    if len(known) < 2 or len(known) < len(shared):
        return _NOTHING
    mean, low, high = paired_interval([x for x, _ in known], [y for _, y in known])
    if low == high == 0:
        return "0"
    return f"{_text(mean, measure, '+')} ({_text(low, measure, '+')} to {_text(high, measure, '+')})"

"""The summary of a study: as Markdown with means, ranges and paired differences, and in TensorBoard."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from gmmtorch.report import Board, Rows
from gmmtorch.team.exploration import NETWORK, differing
from gmmtorch.team.report.trial_groups import by_variant, check_rows, named_fields, paired_difference

_EMPTY = "\N{EN DASH}"
_MAX_ALL_PAIRS = 3  # variants that are all compared with each other; more are compared with the first only


class _Measure(NamedTuple):
    """A field of the rows (dots lead into nested ones), its title with unit, and its number format."""

    path: str
    title: str
    scale: float = 1.0
    digits: int = 0
    percent: bool = False
    for_networks: bool = False  # shown only if the variants differ in their network


_MEASURES = (
    _Measure("entropy_reduction_bits", "entropy removed (kbit)", 1e-3),
    _Measure("t50", "t50 (s)"),
    _Measure("t90", "t90 (s)"),
    _Measure("auc", "AUC, all observable cells", digits=3),
    _Measure("cross_entropy_bits", "cross-entropy (bits per cell)", digits=3),
    _Measure("observed_share", "cells observed", 100.0, 1, percent=True),
    _Measure("map_disagreement", "cells on which two robots differ", 100.0, 1, percent=True),
    _Measure("coverage_per_metre", "coverage (m³/m)", digits=1),
    _Measure("path_length", "path length (m)"),
    _Measure("overlap", "cells seen by two or more robots", 100.0, percent=True),
    _Measure("collisions", "collisions"),
    _Measure("bytes_sent", "sent (kB)", 1e-3),
    _Measure("bytes_by_kind.components", "sent as components (kB)", 1e-3),
    _Measure("bytes_raw_points", "novel points, 12 B each (kB)", 1e-3),
    _Measure("bytes_octree", "novel points as an octree (kB)", 1e-3),
    _Measure("bytes_draco", "novel points by Draco (kB)", 1e-3),
    _Measure("wire_bytes", "sent with headers (kB)", 1e-3),
    _Measure("bits_per_byte", "entropy removed per byte with headers (bits)", digits=2),
    _Measure("wire_ratio", "bytes with headers, lossless = 1", digits=2, for_networks=True),
    _Measure("t90_ratio", "t90, lossless = 1", digits=2, for_networks=True),
    _Measure("healed_after", "records complete after a partition (s)"),
    _Measure("converged_after", "maps equal after the mission (s)"),
    _Measure("simulated_per_wall_seconds", "simulated s per wall second", digits=1),
)


def study_summary(rows: Rows) -> str:
    """Returns two Markdown tables: the results of each variant, and their differences.

    The first gives the mean over seeds, and in brackets the range; "2 of 5" if only these have a value, for
    example a t90. The second gives mean differences over common seeds with Student's paired 95 % interval; a
    dash if a seed has no value. Up to three variants are all compared with each other, more only with the
    first. Measures without any value are left out.

    Raises `InvalidArgumentError` if there is no row.
    """
    check_rows(rows)
    groups = by_variant(rows, otherwise="framework")
    n_seeds = len({row.get("seed") for row in rows})
    shown = [m for m in _MEASURES if not m.for_networks or {*differing(rows)} & {*NETWORK}]
    measures = [m for m in shown if any(_value(row, m) is not None for row in rows)]
    results = {name: [_spread(group, measure) for measure in measures] for name, group in groups.items()}
    lines = _table(f"{n_seeds} seeds: mean (range)", measures, results)
    pairs = list(itertools.combinations(groups, 2))
    if len(groups) > _MAX_ALL_PAIRS:
        pairs = [(other, first) for first, other in pairs if first == next(iter(groups))]
    if pairs and n_seeds > 1:
        differences = {
            f"{a} \N{MINUS SIGN} {b}": [_difference(groups[a], groups[b], measure) for measure in measures]
            for a, b in pairs
        }
        heading = "Differences by seed: mean, and 95 % interval."
        lines += ["", heading, "", *_table("", measures, differences)]
    return "\n".join(lines) + "\n"


def _table(head: str, measures: Sequence[_Measure], columns: Mapping[str, Sequence[str]]) -> list[str]:
    """Returns the lines of a table: one row for each measure with a value."""
    titles = [measure.title for measure in measures]
    heads = [name.replace("|", "\\|") for name in columns]  # names of partitions contain "|"
    rows = [row for row in zip(titles, *columns.values(), strict=True) if {*row[1:]} != {_EMPTY}]
    return [f"| {' | '.join(row)} |" for row in ([head, *heads], ["---"] * (1 + len(columns)), *rows)]


def _value(row: Mapping[str, Any], measure: _Measure) -> float | None:
    value: Any = row
    for key in measure.path.split("."):
        value = value.get(key) if isinstance(value, Mapping) else None
    return float(value) * measure.scale if isinstance(value, int | float) and math.isfinite(value) else None


def _text(value: float, measure: _Measure, sign: str = "") -> str:
    rounded = round(value, measure.digits) + 0.0  # turns −0.0 into 0.0
    text = f"{rounded:{sign},.{measure.digits}f}".replace("-", "\N{MINUS SIGN}")
    return f"{text} %" if measure.percent else text


def _spread(group: Rows, measure: _Measure) -> str:
    values = [value for row in group if (value := _value(row, measure)) is not None]
    if not values:
        return _EMPTY
    mean, low, high = (_text(v, measure) for v in (sum(values) / len(values), min(values), max(values)))
    text = mean if low == high else f"{mean} ({low} to {high})"
    return text if len(values) == len(group) else f"{text}, {len(values)} of {len(group)}"


def _difference(first: Rows, second: Rows, measure: _Measure) -> str:
    a, b = ({row.get("seed"): _value(row, measure) for row in group} for group in (first, second))
    interval = paired_difference(a, b)
    if interval is None or not math.isfinite(interval.low):  # no value, or a single seed
        return _EMPTY
    mean, low, high = (_text(value, measure, "+") for value in interval)
    return "0" if interval.low == interval.high == 0 else f"{mean} ({low} to {high})"


_SERIES = (
    "entropy_bits",
    "bytes_over_time",
    "wire_bytes_over_time",
    "missing_share",
    "raw_points_bytes_over_time",
    "octree_bytes_over_time",
    "draco_bytes_over_time",
)


def write_exploration_board(board: Board, rows: Rows) -> None:
    """Writes trials to one TensorBoard run.

    Tags name the framework, the options in which rows differ, and the seed. Each trial has its entropy (bits,
    and as a share of the observable), the entropies of its robots, cumulative bytes and the share of missing
    records over simulated seconds, and every number of the row at the end.

    Args:
        board: the run; the caller closes it.
        rows: explore rows of `results.json`.
    """
    fields = differing(rows, without=["framework"])
    for row in rows:
        tag = f"{row['framework']}/{_variant(row, named_fields(row, rows[0], fields))}seed_{row['seed']}"
        _write_series(board, row, tag)
        board.scalars(row, tag, step=int(row["times"][-1]))


def _variant(row: Mapping[str, Any], fields: Sequence[str]) -> str:
    """Returns each field with its value as part of a tag: planner_mcts_loss_0.3/; "" without fields."""
    parts = [f"{field}_{_short(row.get(field))}" for field in fields]
    return "_".join(parts) + "/" if parts else ""


def _short(value: Any) -> str:
    """Returns a value as part of a tag; partitions as times and groups: 60-120_0_1.2."""
    if not isinstance(value, list):
        return str(value)
    cuts = [(f"{cut['begin']:g}-{cut['end']:g}", cut["groups"]) for cut in value]
    names = ["_".join([span, *(".".join(map(str, group)) for group in groups)]) for span, groups in cuts]
    return "_".join(names) or "none"


def _write_series(board: Board, row: Mapping[str, Any], tag: str) -> None:
    observable = max(float(row["observable_bits"]), 1.0)
    for i, time in enumerate(row["times"]):
        numbers = {name: row[name][i] for name in _SERIES if row.get(name)}
        numbers["entropy_left"] = row["entropy_bits"][i] / observable
        robots = row.get("entropy_bits_per_robot") or []
        numbers |= {f"robot_{n}/entropy_bits": bits[i] for n, bits in enumerate(robots)}
        board.scalars(numbers, tag, step=int(time))

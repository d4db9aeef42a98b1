"""Groups of trials, by framework or by variant: names, colours, mean curves; and the summary of a study."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.report import PALETTE, Board, Rows, as_array, byte_text, count_text, label_of
from gmmtorch.scan import ArrayLike
from gmmtorch.team.exploration import (
    NETWORK,
    THESIS,
    Band,
    Interval,
    differing,
    mean_band,
    on_common_times,
    paired_interval,
    variant_of,
)

FRAMEWORKS = {
    "gmm_shared": "E0 shared mixtures",
    "grid_shared": "E1 shared grids",
    "grid_isolated": "E2 isolated grids",
    "gmm_thesis": "E0 of the thesis",
}
"""Names of the thesis's frameworks, in the order of figures."""
_COLOURS = dict(zip(FRAMEWORKS, (*PALETTE[:3], PALETTE[5]), strict=True))

TIME = "simulated time [s]"
REMAINING = "remaining entropy [% of observable]"

_NAMES = {"mcts": "MCTS", "csqmi": "CSQMI", "fsmi": "FSMI"}
_UNLIMITED = {"bandwidth": "no limit", "reach": "any reach", "budget": "no budget"}


def framework_name(framework: str) -> str:
    """Returns the name of a framework as shown in figures."""
    return FRAMEWORKS.get(framework, label_of(framework))


def short_name(framework: str) -> str:
    """Returns E0, E1, E2 or thesis for the thesis's frameworks, else the name."""
    if framework == "gmm_thesis":
        return "thesis"
    name = framework_name(framework)
    return name.split()[0] if framework in FRAMEWORKS else name


def framework_colour(framework: str) -> str:
    """Returns the colour of a framework; the same in every figure."""
    return _COLOURS.get(framework, PALETTE[-1])


def by_framework(rows: Rows) -> dict[str, list[Mapping[str, Any]]]:
    """Groups rows by framework: E0, E1, E2, E0 of the thesis, then others in order of occurrence. Raises
    `InvalidArgumentError` if there is no row."""
    check_rows(rows)
    found = list(dict.fromkeys(str(row["framework"]) for row in rows))
    order = [name for name in FRAMEWORKS if name in found]
    order += [name for name in found if name not in FRAMEWORKS]
    return {name: [row for row in rows if row["framework"] == name] for name in order}


def check_rows(rows: Rows) -> None:
    """Raises `InvalidArgumentError` if there is no row."""
    if not rows:
        raise InvalidArgumentError("rows is empty; give the rows of one trial at least.")


def by_variant(rows: Rows, otherwise: str = "planner") -> dict[str, list[Mapping[str, Any]]]:
    """Groups rows by the options in which they differ, in order of occurrence; the names list these options.

    If rows differ in none, the name is the value of the field `otherwise`. A variant whose name would be
    empty, because its network has no faults, is called lossless. Options of `THESIS` are named where they
    differ from those of the first row.
    """
    fields = differing(rows) or [otherwise]
    groups: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        is_thesis = row.get("framework") == "gmm_thesis"
        implied = {field for field in THESIS if is_thesis or row.get(field) == rows[0].get(field)}
        named = [field for field in fields if field not in implied] or fields
        groups.setdefault(_variant_name(row, named), []).append(row)
    return groups


def _variant_name(row: Mapping[str, Any], fields: Sequence[str]) -> str:
    texts = {field: _option_text(field, row.get(field)) for field in fields}
    of_network = [texts[field] for field in fields if field in NETWORK]
    if of_network and not any(of_network):
        texts["loss"] = "lossless"
    return ", ".join(text for text in texts.values() if text)


def _option_text(field: str, value: Any) -> str:
    """Returns the text of one option in a name; "" for a fault that a network does not have."""
    match field, value:
        case "planning_prior", _:
            return "no prior" if value is None else f"prior {value:g}"
        case "framework", _:
            return short_name(str(value))
        case (("loss" | "duplication" | "partitions"), (None | 0 | [])):
            return ""
        case "loss", _:
            return f"{100 * value:g} % lost"
        case "duplication", _:
            return f"{100 * value:g} % duplicated"
        case "partitions", _:
            return ", ".join(map(_partition_text, value))
        case (("bandwidth" | "reach" | "budget"), None):
            return _UNLIMITED[field]
        case (("bandwidth" | "budget"), _):
            return f"{'budget ' if field == 'budget' else ''}{byte_text(value)}/s"
        case "reach", _:
            return f"reach {value:g} m"
        case (("delay" | "jitter" | "announce"), (int() | float())):
            return f"{field} {value:g} s"
        case _ if field in THESIS:
            text = f"{value:g}" if isinstance(value, float) else str(value).lower()
            return f"{field}={'null' if value is None else text}"
        case _:
            return _NAMES.get(str(value), label_of(str(value)))


def _partition_text(partition: Mapping[str, Any]) -> str:
    """Returns, for example: partition 0 | 1 2, 60–120 s."""
    groups = " | ".join(" ".join(map(str, group)) for group in partition["groups"])
    return f"partition {groups}, {partition['begin']:g}\N{EN DASH}{partition['end']:g} s"


class Curves(NamedTuple):
    """A quantity of several trials at common times (T,), seconds: its mean and band, and number of trials."""

    times: np.ndarray
    band: Band
    n_trials: int

    def draw(self, axes: Axes, **look: Any) -> None:
        """Draws the mean as a line in its band; a single trial has no band."""
        axes.plot(self.times, self.band.mean, **{"linewidth": 2.2, "zorder": 3, **look})
        if self.n_trials > 1:
            _, low, high = self.band
            area: dict[str, Any] = {"color": look["color"], "alpha": 0.18, "linewidth": 0, "zorder": 2}
            axes.fill_between(self.times, low, high, **area)


def curves_of(rows: Rows, values: Sequence[Any]) -> Curves:
    """Returns mean and 95 % band of one series (T,) per row, at the times that all rows cover."""
    times, curves = on_common_times([row["times"] for row in rows], values)
    return Curves(times, mean_band(curves), len(curves))


def observable(row: Mapping[str, Any]) -> float:
    """Returns the entropy of all observable cells, bits; raises `InvalidArgumentError` if it is not
    positive."""
    bits = float(row["observable_bits"])
    if not bits > 0:
        raise InvalidArgumentError(
            f"observable_bits={bits} must be above zero; the world has no observable cell."
        )
    return bits


def percent_left(row: Mapping[str, Any], entropy_bits: ArrayLike | None = None) -> np.ndarray:
    """Returns the remaining entropy (T,) in percent of the observable: of the team's union of maps, or of
    `entropy_bits` (T,) if given."""
    bits = as_array(row["entropy_bits"] if entropy_bits is None else entropy_bits)
    return 100 * bits / observable(row)


def known(rows: Rows, field: str) -> list[float]:
    """Returns the values of a field in the rows that have one."""
    return [float(row[field]) for row in rows if row.get(field) is not None]


def milestone_text(rows: Rows, field: str) -> str:
    """Returns the mean of a milestone such as t90 (s), or in how many rows it was reached if not in all."""
    times = known(rows, field)
    if len(times) < len(rows):
        return f"{field} in {len(times)} of {len(rows)}" if times else f"{field} not reached"
    return f"{field} {np.mean(times):.0f} s"


def paired_difference(
    first: Mapping[Any, float | None], second: Mapping[Any, float | None], by_ratio: bool = False
) -> Interval[float] | None:
    """Returns the mean of first − second over common seeds, with its paired 95 % interval. Arguments are
    values by seed. Returns None if no seed is common, or if a common one has no value. With `by_ratio`,
    returns the geometric mean of first / second and its interval."""
    pairs = [(first[seed], second[seed]) for seed in first if seed in second]
    complete = np.array([(a, b) for a, b in pairs if a is not None and b is not None]).reshape(-1, 2)
    if not pairs or len(complete) < len(pairs):
        return None
    if by_ratio:
        return Interval(*np.exp(paired_interval(*np.log(complete).T)).tolist())
    return paired_interval(*complete.T)


def seeds_note(rows: Rows, confidence: str = "95 % confidence band") -> str:
    """Returns what lines and bands show: mean of 5 seeds with 95 % confidence band; or one mission of E0,
    seed 0."""
    sizes = sorted({len(group) for group in _same_but_seed(rows)})
    if sizes[-1] > 1:
        n = f"{sizes[0]} to {sizes[-1]}" if len(sizes) > 1 else str(sizes[0])
        return f"mean of {n} seeds with {confidence}"
    which = f"of {short_name(str(rows[0]['framework']))}" if len(rows) == 1 else "each"
    seeds = {int(row["seed"]) for row in rows}
    return f"one mission {which}" + (f", seed {seeds.pop()}" if len(seeds) == 1 else "")


def about(rows: Rows) -> str:
    """Returns the world and the number of robots that all rows share."""
    worlds = {str(row.get("world", "")) for row in rows}
    numbers = {int(row["n_robots"]) for row in rows}
    parts = [label_of(world) for world in worlds if world and len(worlds) == 1]
    parts += [count_text(n, "robot") for n in numbers if len(numbers) == 1]
    return ", ".join(parts)


def _same_but_seed(rows: Rows) -> list[list[Mapping[str, Any]]]:
    groups: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row.get("world"), *variant_of(row)), []).append(row)
    return list(groups.values())


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

    Tags name the variant and the seed. Each trial has its entropy (bits, and as a share of the observable),
    the entropies of its robots, cumulative bytes and the share of missing records over simulated seconds, and
    every number of the row at the end.

    board: the run; the caller closes it. rows: explore rows of `results.json`.
    """
    for name, group in by_variant(rows, otherwise="framework").items():
        for row in group:
            tag = f"{name.replace('/', ' per ')}/seed_{row['seed']}"  # a slash begins a part of a tag
            _write_series(board, row, tag)
            board.scalars(row, tag, step=int(row["times"][-1]))


def _write_series(board: Board, row: Mapping[str, Any], tag: str) -> None:
    observable = max(float(row["observable_bits"]), 1.0)
    for i, time in enumerate(row["times"]):
        numbers = {name: row[name][i] for name in _SERIES if row.get(name)}
        numbers["entropy_left"] = row["entropy_bits"][i] / observable
        robots = row.get("entropy_bits_per_robot") or []
        numbers |= {f"robot_{n}/entropy_bits": bits[i] for n, bits in enumerate(robots)}
        board.scalars(numbers, tag, step=int(time))

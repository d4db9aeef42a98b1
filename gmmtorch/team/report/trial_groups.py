"""Groups of trials, by framework or by variant: their names, colours, mean curves and titles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.report import PALETTE, Rows, as_array, byte_text, count_text, label_of
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
    """Groups rows by framework: E0, E1, E2, E0 of the thesis, then others in order of occurrence.

    Raises `InvalidArgumentError` if there is no row.
    """
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
        named = named_fields(row, rows[0], fields) or fields
        groups.setdefault(_variant_name(row, named), []).append(row)
    return groups


def named_fields(row: Mapping[str, Any], first: Mapping[str, Any], fields: Sequence[str]) -> list[str]:
    """Returns the `fields` that name the variant of a row: without options of `THESIS` that are as in the
    first row, or that the framework implies."""
    is_thesis = row.get("framework") == "gmm_thesis"
    implied = {field for field in THESIS if is_thesis or row.get(field) == first.get(field)}
    return [field for field in fields if field not in implied]


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
) -> Interval | None:
    """Returns the mean of first − second over common seeds, with its paired 95 % interval.

    Arguments are values by seed. Returns None if no seed is common, or if a common one has no value. With
    `by_ratio`, returns the geometric mean of first / second and its interval.
    """
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

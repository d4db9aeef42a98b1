"""What every picture of an exploration shares: names and colours of frameworks, robots, labels at lines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.evaluation.paired_statistics import Band, mean_band, on_common_times
from gmmtorch.exploration.mission.variants import variant_of
from gmmtorch.report.style import LABEL_SIZE, PALETTE, Rows, as_array, colour, label_of
from gmmtorch.scan import ArrayLike

FRAMEWORKS = {
    "gmm_shared": "E0 mixtures shared",
    "grid_shared": "E1 grids shared",
    "grid_isolated": "E2 grids alone",
}
"""The thesis's three, as readers are to see them, in the order in which they are drawn."""

TIME = "simulated time [s]"

_BAND_ALPHA = 0.18
_LABEL_GAP = 1.25  # height of a line of text, in its size


class Curves(NamedTuple):
    """A quantity of some trials at common times (T,), seconds: its mean and band, and how many trials."""

    times: np.ndarray
    band: Band
    n_trials: int


def framework_name(framework: str) -> str:
    return FRAMEWORKS.get(framework, label_of(framework))


def short_name(framework: str) -> str:
    """Of the thesis's three the letter and number alone."""
    name = framework_name(framework)
    return name.split()[0] if framework in FRAMEWORKS else name


def framework_colour(framework: str) -> str:
    """The same in every figure."""
    return colour(list(FRAMEWORKS).index(framework)) if framework in FRAMEWORKS else PALETTE[-1]


def by_framework(rows: Rows) -> dict[str, list[Mapping[str, Any]]]:
    """Rows of each framework: E0, E1, E2, then others as they come. Raises where there is no row."""
    if not rows:
        raise InvalidArgumentError("rows is empty; give the rows of one trial at least.")
    found = list(dict.fromkeys(str(row["framework"]) for row in rows))
    order = [name for name in FRAMEWORKS if name in found]
    order += [name for name in found if name not in FRAMEWORKS]
    return {name: [row for row in rows if row["framework"] == name] for name in order}


def percent_left(row: Mapping[str, Any], entropy_bits: ArrayLike | None = None) -> np.ndarray:
    """Entropy left (T,), in percent of the observable: the union's, or `entropy_bits` (T,) if given.

    Raises `InvalidArgumentError` where nothing was to be observed.
    """
    return 100 * as_array(row["entropy_bits"] if entropy_bits is None else entropy_bits) / observable(row)


def observable(row: Mapping[str, Any]) -> float:
    """Bits of the observable cells. Raises `InvalidArgumentError` where there is none."""
    bits = float(row["observable_bits"])
    if not bits > 0:
        raise InvalidArgumentError(f"observable_bits={bits} must be above zero; the world shows nothing.")
    return bits


def curves_of(rows: Rows, values: Sequence[Any]) -> Curves:
    """Mean and band of one series (T,) of each row, on the times that all rows cover."""
    times, curves = on_common_times([row["times"] for row in rows], values)
    return Curves(times, mean_band(curves), len(curves))


def draw_curves(axes: Axes, curves: Curves, **look: Any) -> None:
    """The mean as a line, and behind it the band; a single trial has none."""
    axes.plot(curves.times, curves.band.mean, **{"linewidth": 2.2, "zorder": 3, **look})
    if curves.n_trials > 1:
        _, low, high = curves.band
        axes.fill_between(
            curves.times, low, high, color=look["color"], alpha=_BAND_ALPHA, linewidth=0, zorder=2
        )


def label_ends(axes: Axes, ends: Sequence[tuple[float, str, str]], size: float = LABEL_SIZE) -> None:
    """Labels (height at the right end, text, colour) beside their lines, moved apart as little as need be.

    Limits and scale of the axes must be final.
    """
    from sklearn.isotonic import isotonic_regression

    if not ends:
        return
    order = sorted(range(len(ends)), key=lambda i: ends[i][0])
    to_share = axes.transScale + axes.transLimits
    left = axes.get_xlim()[0]
    figure = cast(Figure, axes.figure)
    wanted = np.array([to_share.transform((left, ends[i][0]))[1] for i in order])
    line = _LABEL_GAP * size / 72 * figure.dpi / axes.bbox.height  # of the height of the axes
    tall = np.array([line * (ends[i][1].count("\n") + 1.3) for i in order])
    # Least squares under "no label begins before the one below it ends" is an isotonic regression.
    offsets = np.cumsum(tall) - tall / 2
    room = max(1 - float(tall.sum()), 0.0)
    placed = np.asarray(isotonic_regression(wanted - offsets, y_min=0.0, y_max=room)) + offsets
    for share, there, i in zip(placed, wanted, order, strict=True):
        _, text, hue = ends[i]
        look: dict[str, Any] = {"color": hue, "transform": axes.transAxes}
        axes.plot([1.0, 1.025], [there, share], linewidth=0.9, clip_on=False, **look)
        axes.text(1.032, share, text, fontsize=size, va="center", linespacing=1.15, **look)


def seeds_note(rows: Rows, confidence: str = "95 % band of the mean") -> str:
    """What lines and bands are, for a title: mean of 5 seeds with the 95 % band of the mean; or one mission
    of E0, seed 0."""
    sizes = sorted({len(group) for group in _groups(rows)})
    if sizes[-1] > 1:
        n = f"{sizes[0]} to {sizes[-1]}" if len(sizes) > 1 else str(sizes[0])
        return f"mean of {n} seeds with the {confidence}"
    whose = f"of {short_name(str(rows[0]['framework']))}" if len(rows) == 1 else "each"
    seeds = {int(row["seed"]) for row in rows}
    return f"one mission {whose}" + (f", seed {seeds.pop()}" if len(seeds) == 1 else "")


def about(rows: Rows) -> str:
    """World, robots and duration, as far as all rows share them."""
    parts = []
    worlds = {str(row.get("world", "")) for row in rows}
    if len(worlds) == 1 and (world := worlds.pop()):
        parts.append(label_of(world))
    robots = {int(row["n_robots"]) for row in rows}
    if len(robots) == 1:
        n = robots.pop()
        parts.append(f"{n} robot" + "s" * (n != 1))
    return ", ".join(parts)


def _groups(rows: Rows) -> list[list[Mapping[str, Any]]]:
    """Rows that differ by seed alone."""
    groups: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row.get("world"), *variant_of(row)), []).append(row)
    return list(groups.values())

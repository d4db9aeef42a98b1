"""How every figure looks: colours that colour-blind readers tell apart, sizes, bare axes."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator

from gmmtorch.scan import ArrayLike

Rows = Sequence[Mapping[str, Any]]
"""Of `results.json`."""

PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#333333")
"""Okabe and Ito's colours, less the yellow that white paper swallows."""

MARKERS = ("o", "s", "^", "D", "v", "P", "X")
LINE_STYLES = ("-", "--", ":", "-.")

UNKNOWN = "#94b0cb"
"""Blue-grey: as light as the grey of θ near ½, yet no grey of the scale."""

HEIGHTS = "viridis"

SAVED_DPI = 150
"""Pixels an inch of the pictures that are written."""

TITLE_SIZE, LABEL_SIZE, TICK_SIZE = 12.0, 11.0, 9.5

_GRID = "#e4e4e4"
_LOG_STEPS = ((1.0,), (1.0, 2.0, 5.0), (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0))
_FEWEST_TICKS = 4


def new_figure(width: float, height: float) -> Figure:
    """An empty white figure of this size (inches), drawn by Agg, that lays itself out."""
    figure = Figure(
        figsize=(width, height), layout=ConstrainedLayoutEngine(h_pad=0.09, w_pad=0.06), facecolor="white"
    )
    FigureCanvasAgg(figure)
    return figure


def figure_title(figure: Figure, text: str | None) -> None:
    if text:
        figure.suptitle(text, fontsize=TITLE_SIZE + 2, fontweight="bold")


def dress(axes: Axes, title: str = "", x_label: str = "", y_label: str = "") -> None:
    """Title, labels and ticks of one size; no frame at the top and right."""
    axes.set_title(title, fontsize=TITLE_SIZE)
    axes.set_xlabel(x_label, fontsize=LABEL_SIZE)
    axes.set_ylabel(y_label, fontsize=LABEL_SIZE)
    axes.tick_params(labelsize=TICK_SIZE)
    for side in ("top", "right"):
        if side in axes.spines:
            axes.spines[side].set_visible(False)


def draw_grid(axes: Axes, axis: Literal["both", "x", "y"] = "both") -> None:
    """Light lines at the ticks, beneath all that is drawn."""
    axes.grid(axis=axis, color=_GRID, linewidth=0.8)
    axes.set_axisbelow(True)


def log_axis(axes: Axes, name: str, values: Iterable[float]) -> None:
    """Make the axis "x" or "y" logarithmic for these values, its labels in full: 0.2, 0.5, 1, 2, …

    As few steps a decade as give a handful of ticks; within a fraction of one, those of a linear axis.
    """
    positive = [value for value in values if value > 0] or [1.0, 10.0]
    low, high = min(positive), max(positive)
    enough = [steps for steps in _LOG_STEPS if _n_ticks(steps, low, high) >= _FEWEST_TICKS]
    axes.set(**{f"{name}scale": "log"})
    axis = getattr(axes, f"{name}axis")
    if enough:
        axis.set_major_locator(LogLocator(subs=enough[0]))
    else:
        axis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
        axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.10g}"))
    axis.set_minor_formatter(NullFormatter())


def _n_ticks(steps: Sequence[float], low: float, high: float) -> int:
    """How many products of a step and a power of ten lie between low and high."""
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    return sum(low <= step * 10.0**decade <= high for decade in decades for step in steps)


def colour(index: int) -> str:
    """Colour of the index-th line."""
    return PALETTE[index % len(PALETTE)]


def line_style(index: int) -> str:
    """Line style of the index-th line: another one each time the colours are used up."""
    return LINE_STYLES[index // len(PALETTE) % len(LINE_STYLES)]


def marker(index: int) -> str:
    """Marker of the index-th line."""
    return MARKERS[index % len(MARKERS)]


def label_of(name: str) -> str:
    """A method's name as a reader would write it: monte_carlo → monte carlo."""
    return name.replace("_", " ")


def as_array(value: ArrayLike) -> np.ndarray:
    """A float64 array of a tensor on any device, with or without gradient, or of anything like it."""
    return torch.as_tensor(value).detach().cpu().double().numpy()


def evenly(n: int, n_max: int) -> np.ndarray:
    """At most `n_max` indices into `n` things, evenly spread, the same every time."""
    if n <= n_max:
        return np.arange(n)
    return np.arange(n_max, dtype=np.int64) * n // n_max


def metres(value: float) -> str:
    """A length in full where it is a round one, else to the centimetre: 0.025 m, −0.03 m, 12.5 m."""
    text = f"{value:.4g}" if len(f"{abs(value):.4g}") <= 5 else f"{value:.2f}"
    return f"{text} m".replace("-", "\N{MINUS SIGN}")

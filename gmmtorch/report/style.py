"""The common style of all figures: colours, line styles, sizes, axes, legends and colour bars."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patheffects import Normal, Stroke
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.files import write_atomically
from gmmtorch.scan import ArrayLike

Rows = Sequence[Mapping[str, Any]]
"""Rows of `results.json`."""

PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#333333")
"""The colour-blind safe colours of Okabe and Ito, without yellow, which is too light on white."""

MARKERS = ("o", "s", "^", "D", "v", "P", "X")
LINE_STYLES = ("-", "--", ":", "-.")

UNKNOWN = "#94b0cb"
"""Blue-grey for unknown space: as light as the grey of θ near ½, but not a grey."""

HEIGHTS = "viridis"
"""Colour map of heights."""

SAVED_DPI = 150
"""Pixels per inch of saved pictures."""

TITLE_SIZE, LABEL_SIZE, TICK_SIZE = 12.0, 11.0, 9.5
"""Font sizes in points."""

EDGE = "#666666"
"""Outline of legend patches, and the colour of legend marks that stand for all lines."""

_SUFFIXES = (".png", ".pdf", ".svg")
_GRID = "#e4e4e4"
_LOG_STEPS = ((1.0,), (1.0, 2.0, 5.0), (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0))
_MIN_TICKS = 4


class _ShownFigure(Figure):
    """A figure that notebooks show as a picture, also before pyplot has made a figure."""

    def _repr_png_(self) -> bytes:
        content = BytesIO()
        self.savefig(content, format="png")
        return content.getvalue()


def new_figure(width: float, height: float) -> Figure:
    """Returns an empty white figure of this size (inches) with an automatic layout and the Agg renderer."""
    figure = _ShownFigure(
        figsize=(width, height), layout=ConstrainedLayoutEngine(h_pad=0.09, w_pad=0.06), facecolor="white"
    )
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: Figure, path: str | Path, dpi: float = SAVED_DPI) -> Path:
    """Writes the figure atomically in the format of the suffix, and returns the path.

    `dpi` is the number of pixels per inch of PNG. Raises `InvalidArgumentError` for other suffixes than .png,
    .pdf and .svg.
    """
    path = Path(path)
    if path.suffix.lower() not in _SUFFIXES:
        raise InvalidArgumentError(f"path={path} must end in one of {', '.join(_SUFFIXES)}.")
    return write_atomically(path, lambda temporary: figure.savefig(temporary, dpi=dpi))


def figure_title(figure: Figure, text: str | None) -> None:
    """Writes the title of the figure; None or "" writes nothing."""
    if text:
        figure.suptitle(text, fontsize=TITLE_SIZE + 2, fontweight="bold")


def label_axes(axes: Axes, title: str = "", x_label: str = "", y_label: str = "") -> None:
    """Sets title, axis labels and font sizes, and hides the frame at the top and right."""
    axes.set_title(title, fontsize=TITLE_SIZE)
    axes.set_xlabel(x_label, fontsize=LABEL_SIZE)
    axes.set_ylabel(y_label, fontsize=LABEL_SIZE)
    axes.tick_params(labelsize=TICK_SIZE)
    for side in ("top", "right"):
        if side in axes.spines:
            axes.spines[side].set_visible(False)


def draw_grid(axes: Axes, axis: Literal["both", "x", "y"] = "both") -> None:
    """Draws light lines at the ticks, below everything else."""
    axes.grid(axis=axis, color=_GRID, linewidth=0.8)
    axes.set_axisbelow(True)


def legend_below(figure: Figure, handles: Iterable[Artist] | None = None, max_columns: int = 6) -> None:
    """Draws one legend below the panels, with as many columns as the width of the figure allows.

    Args:
        figure: the figure, with all its panels.
        handles: labelled artists; if None, one for each label that occurs in the panels.
        max_columns: largest number of columns.
    """
    if handles is None:
        by_label: dict[str, Any] = {}
        for axes in figure.axes:
            for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
                by_label.setdefault(label, handle)
        handles = by_label.values()
    entries = list(handles)
    for columns in range(min(len(entries), max_columns), 0, -1):
        legend = figure.legend(
            handles=entries,
            loc="outside lower center",
            ncols=columns,
            frameon=False,
            fontsize=LABEL_SIZE,
        )
        if columns == 1 or legend.get_window_extent().width <= figure.bbox.width:
            return
        legend.remove()


def colour_bar(
    figure: Figure, colours: ScalarMappable, axes: Axes | Sequence[Axes], label: str, **options: Any
) -> None:
    """Draws the colour bar of one or several panels; `options` are those of `Figure.colorbar`."""
    bar = figure.colorbar(colours, ax=axes, **{"pad": 0.015, "aspect": 25, **options})
    bar.set_label(label, fontsize=LABEL_SIZE)
    bar.ax.tick_params(labelsize=TICK_SIZE)


def height_scale(heights: Tensor) -> Normalize:
    """Returns the colour scale from the 1st to the 99th percentile of heights (N,), metres."""
    if not len(heights):
        return Normalize(0.0, 1.0, clip=True)
    low, high = np.quantile(heights.detach().cpu().double().numpy(), [0.01, 0.99])
    return Normalize(float(low), float(max(high, low + 1e-3)), clip=True)


def log_axis(axes: Axes, name: str, values: Iterable[float]) -> None:
    """Makes the axis "x" or "y" logarithmic for these values, with plain tick labels: 0.2, 0.5, 1, 2, …

    Uses the fewest steps per decade that give at least four ticks. If the values span less than that, uses
    the ticks of a linear axis.
    """
    positive = [value for value in values if value > 0] or [1.0, 10.0]
    low, high = min(positive), max(positive)
    sufficient = [steps for steps in _LOG_STEPS if _n_ticks(steps, low, high) >= _MIN_TICKS]
    axes.set(**{f"{name}scale": "log"})
    axis = getattr(axes, f"{name}axis")
    if sufficient:
        axis.set_major_locator(LogLocator(subs=sufficient[0]))
    else:
        axis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10], min_n_ticks=3))
        axis.set_minor_locator(NullLocator())
    tick_text(axis, lambda value: f"{value:,.10g}")
    axis.set_minor_formatter(NullFormatter())


def _n_ticks(steps: Sequence[float], low: float, high: float) -> int:
    """Counts the products of a step and a power of ten between low and high."""
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    return sum(low <= step * 10.0**decade <= high for decade in decades for step in steps)


def tick_text(axis: Axis, text: Callable[[float], str]) -> None:
    """Labels the major ticks of an axis with the text of their values."""
    axis.set_major_formatter(FuncFormatter(lambda value, _: text(value)))


def colour(index: int) -> str:
    """Returns the colour of the index-th line."""
    return PALETTE[index % len(PALETTE)]


def line_style(index: int) -> str:
    """Returns the line style of the index-th line; it changes each time the colours start again."""
    return LINE_STYLES[index // len(PALETTE) % len(LINE_STYLES)]


def line_look(index: int, with_marker: bool = True) -> dict[str, Any]:
    """Returns the options for `Axes.plot` that make the index-th line distinct: colour, style and marker."""
    look: dict[str, Any] = {"color": colour(index), "linestyle": line_style(index), "linewidth": 2}
    if with_marker:
        look |= {"marker": marker(index), "markersize": 6}
    return look


def marker(index: int) -> str:
    """Returns the marker of the index-th line."""
    return MARKERS[index % len(MARKERS)]


def draw_intervals(axes: Axes, x: Sequence[float], rows: Rows, hue: str) -> None:
    """Draws error bars from auc_low to auc_high of rows at x, for those that have both."""
    known = [(at, row) for at, row in zip(x, rows, strict=True) if row.get("auc_low") is not None]
    if known:
        below = [max(0.0, row["auc"] - row["auc_low"]) for _, row in known]
        above = [max(0.0, row["auc_high"] - row["auc"]) for _, row in known]
        areas, places = [row["auc"] for _, row in known], [at for at, _ in known]
        axes.errorbar(places, areas, [below, above], fmt="none", ecolor=hue, capsize=3, linewidth=1.2)


def stacked_bars(axes: Axes, sizes: Mapping[str, np.ndarray], hues: Sequence[str]) -> np.ndarray:
    """Draws horizontal bars, with one part (N,) per label; returns their lengths (N,)."""
    ends = np.zeros(len(next(iter(sizes.values()), ())))
    for (label, size), hue in zip(sizes.items(), hues, strict=True):
        look: dict[str, Any] = {"color": hue, "height": 0.64, "edgecolor": "white", "linewidth": 0.8}
        axes.barh(range(len(size)), size, left=ends, label=label, **look)
        ends = ends + size
    axes.invert_yaxis()
    draw_grid(axes, "x")
    return ends


def halo(width: float) -> list[Any]:
    """Returns path effects that draw a white outline of this width (points) behind a line or text."""
    return [Stroke(linewidth=width, foreground="white"), Normal()]


def label_of(name: str) -> str:
    """Returns the name of a method with spaces: monte_carlo → monte carlo."""
    return name.replace("_", " ")


def as_array(value: ArrayLike) -> np.ndarray:
    """Converts an array or a tensor, on any device and with or without gradient, to a float64 array."""
    return torch.as_tensor(value).detach().cpu().double().numpy()


def even_sample(n: int, n_max: int) -> np.ndarray:
    """Returns at most `n_max` evenly spaced indices into `n` items; deterministic."""
    if n <= n_max:
        return np.arange(n)
    return np.arange(n_max, dtype=np.int64) * n // n_max


def metres(value: float) -> str:
    """Formats a length with up to four digits if that is short, else to the centimetre: 0.025 m, −0.03 m."""
    text = f"{value:.4g}" if len(f"{abs(value):.4g}") <= 5 else f"{value:.2f}"
    return f"{text} m".replace("-", "\N{MINUS SIGN}")

"""The common elements of all figures: colours, sizes, axes, legends, colour bars, and text labels."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any, Literal, NamedTuple, cast

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
from matplotlib.path import Path as MarkPath
from matplotlib.patheffects import Normal, Stroke
from matplotlib.text import Annotation
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator
from matplotlib.transforms import Bbox
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.files import write_atomically, write_bytes
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
        return picture(self, self.dpi)


def new_figure(width: float, height: float) -> Figure:
    """Returns an empty white figure of this size (inches) with an automatic layout and the Agg renderer."""
    figure = _ShownFigure(
        figsize=(width, height), layout=ConstrainedLayoutEngine(h_pad=0.09, w_pad=0.06), facecolor="white"
    )
    FigureCanvasAgg(figure)
    return figure


def picture(figure: Figure, dpi: float = SAVED_DPI) -> bytes:
    """Returns the figure as a PNG file. `Figure.savefig` would draw it twice, with the same result."""
    content, before = BytesIO(), figure.dpi
    figure.dpi = dpi
    FigureCanvasAgg(figure).print_png(content)
    figure.dpi = before
    return content.getvalue()


def save_figure(figure: Figure, path: str | Path, dpi: float = SAVED_DPI) -> Path:
    """Writes the figure atomically as .png, with `dpi` pixels per inch, .pdf or .svg, and returns the path.

    Raises `InvalidArgumentError` for other suffixes.
    """
    path = Path(path)
    if path.suffix.lower() not in _SUFFIXES:
        raise InvalidArgumentError(f"path={path} must end in one of {', '.join(_SUFFIXES)}.")
    if path.suffix.lower() == ".png":
        return write_bytes(path, picture(figure, dpi))
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

    handles: labelled artists; if None, one for each label that occurs in the panels of the figure.
    """
    if handles is None:
        by_label: dict[str, Any] = {}
        for axes in figure.axes:
            for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
                by_label.setdefault(label, handle)
        handles = by_label.values()
    entries = list(handles)
    for columns in range(min(len(entries), max_columns), 0, -1):
        look: dict[str, Any] = {"ncols": columns, "frameon": False, "fontsize": LABEL_SIZE}
        legend = figure.legend(handles=entries, loc="outside lower center", **look)
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
    return {**look, "marker": marker(index), "markersize": 6} if with_marker else look


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


_OVER_TEXT, _OUTSIDE, _OVER_MARK, _OVER_LINE = 8.0, 8.0, 4.0, 1.0  # costs of a place
_MARK_RADIUS = 5.0  # pixels
_SIDES = {1: "left", 0: "center", -1: "right"}
_HEIGHTS = {1: "bottom", 0: "center", -1: "top"}
_DIRECTIONS = ((1, -1), (1, 1), (-1, 1), (-1, -1), (0, -1), (0, 1), (1, 0), (-1, 0))
_GAPS = ((7, 4), (12, 8))  # points between mark and text, straight and diagonal: near, then farther
_LINE_HEIGHT = 1.25  # of a line of text, in font sizes


class Label(NamedTuple):
    """A label for the mark at (x, y), in data coordinates, with the text properties `look`."""

    axes: Axes
    text: str
    x: float
    y: float
    look: dict[str, Any]


class LineEnd(NamedTuple):
    """A label for a line: the value at its right end, text and colour."""

    value: float
    text: str
    colour: str


_PLACES: list[dict[str, Any]] = [
    {"position": (gap * right, gap * up), "ha": _SIDES[right], "va": _HEIGHTS[up]}
    for straight, diagonal in _GAPS
    for right, up in _DIRECTIONS
    for gap in (diagonal if right and up else straight,)
]
"""Places of a label relative to its mark: offset in points, and alignment."""


def place_labels(figure: Figure, labels: Sequence[Label]) -> None:
    """Writes each label beside its mark, at the place where it covers the fewest labels, marks and lines; the
    lower right is preferred.

    Call this last: limits, scales, legends and titles must be final.
    """
    figure.draw_without_rendering()
    texts: list[Bbox] = []
    for label in labels:
        axes = label.axes
        note = axes.annotate(label.text, (label.x, label.y), (0, 0), textcoords="offset points", **label.look)
        note.set_in_layout(False)
        paths = [line.get_path().transformed(line.get_transform()) for line in axes.lines]
        boxes = [_moved(note, place) for place in _PLACES]
        costs = [_cost(box, axes.get_window_extent(), texts, paths) for box in boxes]
        texts.append(_moved(note, _PLACES[int(np.argmin(costs))]))


def label_ends(axes: Axes, ends: Sequence[LineEnd], size: float = LABEL_SIZE) -> None:
    """Writes labels to the right of the axes, beside the ends of their lines, and moves them apart as little
    as possible (least squares).

    Limits and scale of the axes must be final.
    """
    from sklearn.isotonic import isotonic_regression

    if not ends:
        return
    ends = sorted(ends, key=lambda end: end.value)
    to_share = axes.transScale + axes.transLimits  # from data to shares of the axes
    left = axes.get_xlim()[0]
    wanted = np.array([to_share.transform((left, end.value))[1] for end in ends])
    line = _LINE_HEIGHT * size / 72 * cast(Figure, axes.figure).dpi / axes.bbox.height
    heights = np.array([line * (end.text.count("\n") + 1.3) for end in ends])
    # Least squares under the constraint "no label begins below the end of the previous one" is an isotonic
    # regression.
    offsets = np.cumsum(heights) - heights / 2
    room = max(1 - float(heights.sum()), 0.0)
    placed = np.asarray(isotonic_regression(wanted - offsets, y_min=0.0, y_max=room)) + offsets
    for share, target, end in zip(placed, wanted, ends, strict=True):
        look: dict[str, Any] = {"color": end.colour, "transform": axes.transAxes}
        axes.plot([1.0, 1.025], [target, share], linewidth=0.9, clip_on=False, **look)
        axes.text(1.032, share, end.text, fontsize=size, va="center", linespacing=1.15, **look)


def _moved(note: Annotation, place: dict[str, Any]) -> Bbox:
    """Moves the text to the place, and returns the pixels that it covers there."""
    note.set(**place)
    return note.get_window_extent()


def _cost(box: Bbox, frame: Bbox, texts: Sequence[Bbox], paths: Sequence[MarkPath]) -> float:
    """Adds up what a label in this box covers, and whether it leaves the axes; all in pixels."""
    n_texts = sum(bool(other.overlaps(box)) for other in texts)
    padded = box.padded(_MARK_RADIUS)
    n_marks = sum(bool(padded.count_contains(path.vertices)) for path in paths)
    n_lines = sum(bool(path.intersects_bbox(box, filled=False)) for path in paths)
    outside = frame.count_contains(box.corners()) < 4
    return _OUTSIDE * outside + _OVER_TEXT * n_texts + _OVER_MARK * n_marks + _OVER_LINE * n_lines

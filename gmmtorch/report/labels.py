"""Text labels in figures: beside marks or at the ends of lines, without overlaps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.path import Path
from matplotlib.text import Annotation
from matplotlib.transforms import Bbox

from gmmtorch.report.style import LABEL_SIZE

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


class _Place(NamedTuple):
    """A place of a label relative to its mark: offset in points, and alignment."""

    offset: tuple[float, float]
    ha: str
    va: str


_PLACES = [
    _Place((gap * right, gap * up), _SIDES[right], _HEIGHTS[up])
    for straight, diagonal in _GAPS
    for right, up in _DIRECTIONS
    for gap in (diagonal if right and up else straight,)
]


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


def _moved(note: Annotation, place: _Place) -> Bbox:
    """Moves the text to the place, and returns the pixels that it covers there."""
    note.set(position=place.offset, ha=place.ha, va=place.va)
    return note.get_window_extent()


def _cost(box: Bbox, frame: Bbox, texts: Sequence[Bbox], paths: Sequence[Path]) -> float:
    """Adds up what a label in this box covers, and whether it leaves the axes; all in pixels."""
    n_texts = sum(bool(other.overlaps(box)) for other in texts)
    padded = box.padded(_MARK_RADIUS)
    n_marks = sum(bool(padded.count_contains(path.vertices)) for path in paths)
    n_lines = sum(bool(path.intersects_bbox(box, filled=False)) for path in paths)
    outside = frame.count_contains(box.corners()) < 4
    return _OUTSIDE * outside + _OVER_TEXT * n_texts + _OVER_MARK * n_marks + _OVER_LINE * n_lines

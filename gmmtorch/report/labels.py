"""Where words go in a picture: beside what they name, and clear of lines, marks, bands and other words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.path import Path
from matplotlib.text import Annotation
from matplotlib.transforms import Bbox

_OVER_WORDS, _OVER_MARK, _OVER_LINE, _OVER_BAND = 8.0, 4.0, 1.0, 0.5
_OUTSIDE = 8.0
_NOTHING = ("None", "none", " ", "", None)  # a line style or a marker that is not drawn


class Spot(NamedTuple):
    """A place for a label: so many points from `xy`, which is given in `coordinates` of the axes."""

    xy: tuple[float, float]
    offset: tuple[float, float]
    ha: str
    va: str
    coordinates: str | tuple[str, str] = "data"


class Label(NamedTuple):
    """Words, the spots that they may have in the order in which they are liked, and how they look."""

    axes: Axes
    text: str
    spots: Sequence[Spot]
    look: dict[str, Any]


def around(x: float, y: float) -> list[Spot]:
    """Spots around a mark at (x, y) of the data: near and a little farther, the lower right first."""
    sides = {1: "left", 0: "center", -1: "right"}
    heights = {1: "bottom", 0: "center", -1: "top"}
    directions = [(1, -1), (1, 1), (-1, 1), (-1, -1), (0, -1), (0, 1), (1, 0), (-1, 0)]
    return [
        Spot((x, y), (gap * right, gap * up), sides[right], heights[up])
        for straight, diagonal in ((7, 4), (12, 8))
        for right, up in directions
        for gap in (diagonal if right and up else straight,)
    ]


def along(y: float) -> list[Spot]:
    """Spots above and beneath a horizontal line at y of the data, from the right end to the left one."""
    ends = [(1.0, "right", -4), *((x / 20, "center", 0) for x in range(17, 3, -1)), (0.0, "left", 4)]
    return [
        Spot((x, y), (shift, up), side, height, ("axes fraction", "data"))
        for x, side, shift in ends
        for up, height in ((3, "bottom"), (-3, "top"))
    ]


def place_labels(figure: Figure, labels: Sequence[Label]) -> None:
    """Write each label where it covers least, one after the other.

    To be called last, as everything must be where it stays: limits, scales, legends and titles.
    """
    figure.draw_without_rendering()
    drawn = {axes: _Drawn.of(axes) for axes in dict.fromkeys(label.axes for label in labels)}
    for label in labels:
        first, there = label.spots[0], drawn[label.axes]
        note = label.axes.annotate(
            label.text, first.xy, first.offset, first.coordinates, "offset points", **label.look
        )
        note.set_in_layout(False)
        boxes = [_box(note, spot) for spot in label.spots]
        least = int(np.argmin([there.beneath(box) for box in boxes]))  # the first of equals
        there.words.append(_box(note, label.spots[least]))


def _box(note: Annotation, spot: Spot) -> Bbox:
    """What the words cover, pixels, once they are moved to the spot."""
    note.set(position=spot.offset, ha=spot.ha, va=spot.va)
    note.xy, note.xycoords = spot.xy, spot.coordinates
    return note.get_window_extent()


@dataclass
class _Drawn:
    """What is drawn in axes, in pixels: the paths of lines, marks with half their size, bands, words."""

    frame: Bbox
    lines: list[Path]
    marks: list[tuple[np.ndarray, float]]
    bands: list[Path]
    words: list[Bbox]

    @classmethod
    def of(cls, axes: Axes) -> _Drawn:
        paths = [(line, line.get_path().transformed(line.get_transform())) for line in axes.lines]
        pixels = axes.figure.dpi / 72
        return cls(
            frame=axes.get_window_extent(),
            lines=[path for line, path in paths if line.get_linestyle() not in _NOTHING],
            marks=[
                (np.asarray(path.vertices), pixels * line.get_markersize() / 2)
                for line, path in paths
                if line.get_marker() not in _NOTHING
            ],
            bands=[
                path.transformed(band.get_transform())
                for band in axes.collections
                for path in band.get_paths()
                if np.size(path.vertices)
            ],
            words=[words.get_window_extent() for words in axes.texts],
        )

    def beneath(self, box: Bbox) -> float:
        """How much this box would cover, or stick out of the axes."""
        frame = self.frame
        inside = frame.x0 <= box.x0 <= box.x1 <= frame.x1 and frame.y0 <= box.y0 <= box.y1 <= frame.y1
        marks = sum(_any_within(points, box.padded(size)) for points, size in self.marks)
        lines = sum(bool(line.intersects_bbox(box, filled=False)) for line in self.lines)
        bands = sum(bool(band.intersects_bbox(box)) for band in self.bands)
        words = sum(bool(other.overlaps(box)) for other in self.words)
        return (
            _OUTSIDE * (not inside)
            + _OVER_WORDS * words
            + _OVER_MARK * marks
            + _OVER_LINE * lines
            + _OVER_BAND * bands
        )


def _any_within(points: np.ndarray, box: Bbox) -> bool:
    return bool(((points > box.min) & (points < box.max)).all(1).any())

"""Placement of labels beside marks."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.axes import Axes

from gmmtorch.report.style import Label, figure_title, label_axes, new_figure, place_labels


def pixels(axes: Axes, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Many points (P, 2) on the straight lines from corner to corner."""
    corners = axes.transData.transform(np.stack([x, y], 1))
    place = np.linspace(0, len(corners) - 1, 2000)
    return np.stack([np.interp(place, np.arange(len(corners)), column) for column in corners.T], 1)


def is_under(points: np.ndarray, box) -> bool:
    return bool(((points > box.min) & (points < box.max)).all(1).any())


@given(st.lists(st.floats(0, 1), min_size=4, max_size=5), st.booleans())
@settings(max_examples=2)
def test_labels_do_not_overlap_marks_lines_or_labels(heights, has_legend):
    figure = new_figure(7.0, 5.0)
    axes = figure.subplots()
    x = np.arange(1.0, len(heights) + 1)
    lines = [np.array(heights), 2.5 - np.array(heights)]
    for y in lines:
        axes.plot(x, y, "o-", label="line")
    label_axes(axes, "two lines", "x", "y")
    if has_legend:
        figure.legend(loc="outside lower center")
    figure_title(figure, "Labels\nin two lines of title")
    corners = [(a, b) for y in lines for a, b in zip(x, y, strict=True)]
    labels = [Label(axes, f"{b:.2f}", a, b, {"fontsize": 9.0}) for a, b in corners]
    place_labels(figure, labels)
    figure.canvas.draw()
    boxes = [note.get_window_extent() for note in axes.texts]
    frame = axes.get_window_extent()
    marks = np.concatenate([axes.transData.transform(np.stack([x, y], 1)) for y in lines])
    assert [note.get_text() for note in axes.texts] == [label.text for label in labels]
    for i, (box, mark) in enumerate(zip(boxes, marks, strict=True)):
        assert frame.contains(*box.min)
        assert frame.contains(*box.max)
        assert not is_under(marks, box)
        assert not any(is_under(pixels(axes, x, y), box) for y in lines)
        assert not any(box.overlaps(other) for other in boxes[:i])
        assert np.abs((box.min + box.max) / 2 - mark).max() < 60  # beside its own mark


def test_labels_are_drawn_without_free_space():
    figure = new_figure(3.0, 3.0)
    axes = figure.subplots()
    axes.set(xlim=(0, 1), ylim=(0, 1))
    for height in np.linspace(0, 1, 60):
        axes.plot([0, 1], [height, height])
    place_labels(figure, [Label(axes, "x", 0.5, 0.5, {})])
    assert axes.texts[0].get_text() == "x"

"""Logarithmic axes, grids, and placement of labels beside marks."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.axes import Axes

from gmmtorch.report import Label, draw_grid, figure_title, label_axes, log_axis, new_figure, place_labels


def labelled(values: list[float], axis: str = "y") -> list[float]:
    """The ticks with a label between the limits of an axis that holds these values."""
    figure = new_figure(4.0, 4.0)
    axes = figure.subplots()
    axes.plot(values, values)
    log_axis(axes, axis, values)
    figure.canvas.draw()
    low, high = getattr(axes, f"get_{axis}lim")()
    ticks = getattr(axes, f"{axis}axis").get_major_ticks()
    shown = [tick for tick in ticks if low <= tick.get_loc() <= high and tick.label1.get_text()]
    for tick in shown:
        assert float(tick.label1.get_text().replace(",", "").replace("\N{MINUS SIGN}", "-")) == pytest.approx(
            tick.get_loc()
        )
    return [tick.get_loc() for tick in shown]


@given(st.floats(-6, 6), st.floats(0.05, 5))
@settings(max_examples=6)
def test_log_axis_has_three_to_thirteen_ticks(start, decades):
    ticks = labelled([10**start, 10 ** (start + decades)])
    assert 3 <= len(ticks) <= 13


def test_log_axis_uses_the_fewest_sufficient_steps():
    assert labelled([17, 60], "x") == pytest.approx([20, 30, 40, 50])
    assert labelled([0.06, 4.9]) == pytest.approx([0.05, 0.1, 0.2, 0.5, 1, 2, 5])
    assert labelled([0.9, 2e4]) == pytest.approx([1, 10, 100, 1000, 10_000])
    assert labelled([31, 32]) == pytest.approx([31, 31.5, 32])


@pytest.mark.parametrize("values", [[], [0.0, -1.0], [3.0, 3.0]])
def test_log_axis_accepts_values_without_a_range(values):
    figure = new_figure(4.0, 4.0)
    axes = figure.subplots()
    log_axis(axes, "x", values)
    figure.canvas.draw()
    assert axes.get_xscale() == "log"
    assert all(math.isfinite(limit) for limit in axes.get_xlim())


def test_grid_is_below_the_data():
    axes = new_figure(4.0, 4.0).subplots()
    bar = axes.bar([0, 1], [1, 2])[0]
    draw_grid(axes, "y")
    lines = axes.get_ygridlines()
    assert lines
    assert all(line.get_visible() for line in lines)
    assert axes.yaxis.get_zorder() < bar.get_zorder()
    assert not any(line.get_visible() for line in axes.get_xgridlines())


def test_a_notebook_shows_a_figure_as_a_picture():
    assert new_figure(2.0, 2.0)._repr_png_().startswith(b"\x89PNG")


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

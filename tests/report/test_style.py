"""Logarithmic axes and grids."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gmmtorch.report.style import draw_grid, log_axis, new_figure


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

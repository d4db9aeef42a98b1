"""Reliability diagrams."""

from __future__ import annotations

import numpy as np
import pytest

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.experiments.evaluation.calibration import Reliability
from gmmtorch.report.maps.accuracy_figures import reliability_figure

CURVE = Reliability(np.array([0.1, 0.4, 0.9]), np.array([0.0, 0.5, 1.0]), np.array([50, 25, 25]))


def test_reliability_draws_each_method_in_both_panels():
    curves = {"point": CURVE, "occupancy_grid": CURVE._replace(observed=CURVE.predicted)}
    figure = reliability_figure(curves, title="Kinect, 0.05 m")
    upper, lower = figure.axes
    drawn = [line for line in upper.lines if len(line.get_xdata()) == 3]
    np.testing.assert_array_equal(drawn[0].get_ydata(), CURVE.observed)
    np.testing.assert_array_equal(drawn[1].get_ydata(), CURVE.predicted)
    for line in lower.lines:
        np.testing.assert_allclose(line.get_ydata(), [0.5, 0.25, 0.25])
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["calibrated", "point, ECE 0.100", "occupancy grid, ECE 0.000"]
    assert figure.get_suptitle() == "Kinect, 0.05 m"


def test_reliability_markers_grow_with_the_share_of_points():
    figure = reliability_figure({"point": CURVE})
    (markers,) = [c for c in figure.axes[0].collections if len(c.get_sizes()) == 3]
    sizes = markers.get_sizes()
    assert sizes[0] > sizes[1] == sizes[2]


def test_reliability_needs_a_curve():
    with pytest.raises(InvalidArgumentError, match="curves is empty"):
        reliability_figure({})

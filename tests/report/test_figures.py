"""Figures of mixtures, of accuracy and of calibration, and saving them."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import torch

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.experiments.evaluation.metrics import Reliability
from gmmtorch.report.accuracy_figures import (
    auc_against_kept_figure,
    convergence_figure,
    reliability_figure,
    roc_figure,
    trajectory_figure,
)
from gmmtorch.report.mixture_figures import mixture_figure
from gmmtorch.report.style import save_figure


def mixture(k: int, dim: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    means = torch.randn(k, dim, dtype=torch.float64, generator=generator)
    factors = torch.randn(k, dim, dim, dtype=torch.float64, generator=generator)
    return means, factors @ factors.mT * 0.01, torch.full((k,), 1 / max(k, 1))


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize(("n", "k"), [(200, 5), (5, 0), (0, 3)])
def test_mixture_figure_states_the_numbers_drawn(dim, n, k):
    points = torch.randn(n, dim, generator=torch.Generator().manual_seed(1))
    figure = mixture_figure(points, *mixture(k, dim))
    title = figure.get_suptitle()
    points_said = f", {n} point{'s' * (n != 1)}" if n else ""
    assert title == f"Gaussian mixture: {k} component{'s' * (k != 1)}{points_said}"
    plane = figure.axes[dim - 2]
    assert [plane.get_xlabel(), plane.get_ylabel()] == ["x [m]", "y [m]"]


@pytest.mark.parametrize("dim", [2, 3])
def test_mixture_figure_draws_the_components_with_the_largest_weights(dim):
    means, covariances, _ = mixture(6, dim)
    weights = torch.tensor([0.1, 0.3, 0.0, 0.2, 0.3, 0.1])
    figure = mixture_figure(means, means, covariances, weights, max_components=3)
    assert "3 largest of 6 components" in figure.get_suptitle()
    plane = figure.axes[0] if dim == 2 else figure.axes[1]
    ellipses = [c for c in plane.collections if len(c.get_paths()) == 3]
    centres = np.sort([path.vertices[:-1].mean(0)[0] for path in ellipses[0].get_paths()])
    np.testing.assert_allclose(centres, np.sort(means[[1, 3, 4], 0].numpy()), atol=1e-9)


def test_mixture_figure_accepts_arrays_and_identical_points():
    points = np.ones((10, 2))
    mixture_figure(points, points[:1], np.zeros((1, 2, 2)), np.ones(1)).canvas.draw()


def test_mixture_figure_errors_name_the_argument():
    means, covariances, weights = mixture(3, 2)
    with pytest.raises(InvalidArgumentError, match="covariances"):
        mixture_figure(means, means, covariances[:2], weights)


def test_roc_legend_gives_the_auc():
    curve = (np.array([0.0, 0.2, 1.0]), np.array([0.0, 0.9, 1.0]), 0.85)
    figure = roc_figure({"monte_carlo": curve, "grid": curve}, "lab")
    texts = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert texts == ["chance, AUC 0.5", "monte carlo, AUC 0.8500", "grid, AUC 0.8500"]
    roc_figure({}).canvas.draw()


def test_convergence_draws_each_fit():
    figure = convergence_figure({"fit": [-3.0, -2.0, -1.5], "none": [], "one": [-1.0]})
    assert [len(line.get_xdata()) for line in figure.axes[0].lines] == [3, 1, 1, 1]
    convergence_figure({}).canvas.draw()


def test_a_trajectory_is_drawn_beside_the_truth_with_the_distances():
    truth = np.stack([np.arange(5.0), np.zeros(5)], 1)
    estimate = truth + np.array([0.0, 0.3])
    figure = trajectory_figure(estimate, truth, np.array([True, True, False, True, True]))
    upper, lower = figure.axes
    assert np.array_equal(upper.lines[0].get_xydata(), truth)
    assert np.array_equal(upper.lines[2].get_xydata(), estimate[2:3])
    assert np.allclose(lower.lines[0].get_ydata(), 0.3)
    assert len(trajectory_figure(estimate, truth, np.ones(5, dtype=bool)).axes[0].lines) == 2


def row(method: str, resolution: float, kept: float, auc: float | None, **more: object) -> dict[str, object]:
    facts = {"dataset": "lab", "method": method, "resolution": resolution, "removal": "beams"}
    return {**facts, "kept": kept, "auc": auc, **more}


def test_auc_against_kept_draws_a_panel_per_resolution_and_a_line_per_method():
    rows = [
        row(method, resolution, kept, 0.9 * kept**0.1, auc_low=0.5, auc_high=0.95)
        for method in ("monte_carlo", "occupancy_grid")
        for resolution in (0.02, 0.1)
        for kept in (0.1, 1.0, 0.3)
    ]
    figure = auc_against_kept_figure([*rows, row("broken", 0.1, 0.5, None)])
    assert [axes.get_title() for axes in figure.axes] == ["cells of 0.1 m", "cells of 0.02 m"]
    axes = figure.axes[0]
    assert axes.get_xscale() == "log"
    assert axes.get_xlim()[0] > axes.get_xlim()[1]
    lines = {line.get_label(): line for line in axes.lines}
    assert list(lines["monte carlo"].get_xdata()) == pytest.approx([10.0, 30.0, 100.0])
    assert "broken" not in lines
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["monte carlo", "occupancy grid"]


def test_auc_against_kept_separates_datasets_and_removals():
    rows = [row("a", 0.1, 1.0, 0.9), {**row("a", 0.1, 1.0, 0.8), "dataset": "hall", "removal": "scans"}]
    titles = [axes.get_title() for axes in auc_against_kept_figure(rows).axes]
    assert titles == ["hall, scans removed, cells of 0.1 m", "lab, beams removed, cells of 0.1 m"]
    auc_against_kept_figure([]).canvas.draw()


def test_save_figure_writes_atomically_and_checks_the_suffix(tmp_path):
    figure = roc_figure({})
    path = save_figure(figure, tmp_path / "new" / "roc.png")
    assert path.read_bytes().startswith(b"\x89PNG")
    with pytest.raises(InvalidArgumentError, match=r"\.png"):
        save_figure(figure, tmp_path / "roc.txt")
    assert [p.name for p in tmp_path.rglob("*.*")] == ["roc.png"]


PROGRAM = """
import sys, torch
import gmmtorch.report
assert "matplotlib" not in sys.modules and "tensorboard" not in sys.modules
from gmmtorch.report.tensorboard_writer import Board
from gmmtorch.report.accuracy_figures import roc_figure
from gmmtorch.report.map_figures import map_figure
from gmmtorch.report.map_images import MapPanel
from gmmtorch.report.mixture_figures import mixture_figure
from gmmtorch.report.style import picture, save_figure
eye, panel = torch.eye(2)[None], MapPanel("m", lambda x: x[:, 0] * 0 + 0.2, 0.5, (0, 0, 0), (1, 1, 1))
with Board(sys.argv[1]) as board:
    board.figure("map", picture(map_figure([panel], [torch.zeros(2, 3)])))
    mixture = mixture_figure(torch.zeros(1, 2), torch.zeros(1, 2), eye, torch.ones(1))
    board.figure("mixture", picture(mixture))
    board.curve("c", torch.tensor([0, 1]), torch.tensor([0.1, 0.9]))
save_figure(roc_figure({}), sys.argv[1] + "/roc.png")
assert "matplotlib.pyplot" not in sys.modules
"""


@pytest.mark.slow
def test_figures_never_import_pyplot(tmp_path):
    done = subprocess.run([sys.executable, "-c", PROGRAM, str(tmp_path)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


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

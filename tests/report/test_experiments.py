"""Figures of fitting and of the studies of gmmtorch-fit."""

from __future__ import annotations

import numpy as np
import pytest

from gmmtorch.experiments.report import component_count_figures, initialization_figures, sensor_model_figures
from gmmtorch.report.accuracy_figures import comparison_figure


def study_row(init: str, k: int, seed: int, **more: object) -> dict[str, object]:
    return {
        "dataset": "bunny",
        "n_points": 5000,
        "start": init,
        "n_components": k,
        "seed": seed,
        "init_seconds": 0.01 * k + seed,
        "n_iterations": 10 + seed,
        "seconds": 0.1 * k + seed,
        "psnr2_db": 60.0 + k + 2 * seed,
        "psnr_forward_db": 30.0,
        "psnr_backward_db": 30.0 + k + 2 * seed,
        "held_out_psnr2_db": 60.0 + k,
        "held_out_log_likelihood": -1.0 if init == "kmeans" else -1.5,
        **more,
    }


STUDY = [study_row(i, k, s) for s in (0, 1) for k in (8, 4) for i in ("random_points", "kmeans")]


def test_initialization_figure_draws_mean_and_range_of_each_initialization():
    figure = initialization_figures(STUDY)["initialization"]
    titles = [axes.get_title() for axes in figure.axes]
    assert titles == ["initialization time", "iterations of EM", "time of initialization and EM", "PSNR2"]
    assert "bunny, 5,000 points" in figure.get_suptitle()
    assert "2 seeds" in figure.get_suptitle()
    for axes in figure.axes:
        assert [line.get_label() for line in axes.lines] == ["random points", "k-means"]
        assert axes.get_xscale() == "log"
        assert [int(x) for x in axes.lines[0].get_xdata()] == [4, 8]
    assert [axes.get_yscale() for axes in figure.axes] == ["log", "log", "log", "linear"]
    quality = figure.axes[3]
    assert quality.lines[0].get_ydata() == pytest.approx([65.0, 69.0])
    band = quality.collections[0].get_paths()[0].vertices
    assert (band[:, 1].min(), band[:, 1].max()) == (64.0, 70.0)
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names == ["random points", "k-means"]


def test_quality_is_relative_to_the_first_initialization():
    figure = initialization_figures(STUDY)["initialization_quality"]
    assert "Gain over random points" in figure.get_suptitle()
    first, other = figure.axes[3].lines
    assert first.get_ydata() == pytest.approx([0.0, 0.0])
    assert other.get_ydata() == pytest.approx([0.5, 0.5])


def test_values_that_are_none_are_left_out():
    rows = [study_row("kmeans", k, 0, psnr2_db=None if k == 4 else 60.0) for k in (4, 8)]
    rows = [{**row, "held_out_psnr2_db": None, "held_out_log_likelihood": None} for row in rows]
    drawn = initialization_figures(rows)
    for figure in drawn.values():
        figure.canvas.draw()
    assert [int(x) for x in drawn["initialization"].axes[3].lines[0].get_xdata()] == [8]
    assert not drawn["initialization_quality"].axes[3].lines[0].get_xdata().size


def fit_row(method: str, seconds: float, **more: object) -> dict[str, object]:
    return {
        "dataset": "hall",
        "method": method,
        "n_points": 900,
        "n_components": 50,
        "n_components_used": 40,
        "seconds": seconds,
        "log_likelihood": -1.0,
        "psnr2_db": 80.0,
        "held_out_log_likelihood": -1.25,
        "held_out_psnr2_db": 79.0,
        **more,
    }


def test_comparison_draws_a_mark_per_method_against_seconds():
    figure = comparison_figure([fit_row("em", 0.2), fit_row("scikit_learn", 11.0)])
    left, right = figure.axes
    assert left.get_xscale() == right.get_xscale() == "log"
    marks = [(float(*line.get_xdata()), float(*line.get_ydata())) for line in left.lines]
    assert marks == [(0.2, -1.25), (11.0, -1.25)]
    assert [float(*line.get_ydata()) for line in right.lines] == [79.0, 79.0]
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names == ["em: 40 components", "scikit learn: 40 components"]
    assert "hall, 900 points" in figure.get_suptitle()
    assert "held-out" in left.get_title()


def test_comparison_uses_training_points_if_none_are_held_out():
    row = fit_row("em", 0.2, held_out_log_likelihood=None, held_out_psnr2_db=None, psnr2_db=None)
    figure = comparison_figure([row])
    left, right = figure.axes
    assert "held-out" not in left.get_title()
    assert float(*left.lines[0].get_ydata()) == -1.0
    assert np.isnan(right.lines[0].get_ydata()).all()


def test_sensor_model_figure_draws_variants_against_bytes():
    rows = [
        {
            "dataset": "hall",
            "variant": variant,
            "n_points": 900,
            "nbytes": nbytes + shift,
            "held_out_log_likelihood": -3.0,
            "thickness": 0.01,
            "auc": 0.9,
            "auc_near_surface": 0.8,
        }
        for nbytes in (30_000, 9_000)
        for shift, variant in enumerate(("plain", "noise_planar"))
    ]
    figure = sensor_model_figures(rows)["sensor_model"]
    assert len(figure.axes) == 4
    for axes in figure.axes:
        assert axes.get_xlabel() == "map size [bytes]"
        assert [line.get_label() for line in axes.lines] == ["plain", "noise planar"]
        assert [int(x) for x in axes.lines[1].get_xdata()] == [9_001, 30_001]
    assert "seeds" not in figure.get_suptitle()


def count_row(rule: str, setting: float, k: int, **more: object) -> dict[str, object]:
    is_map = rule.startswith("map_")
    return {
        "dataset": "hall",
        "n_points": 900,
        "rule": rule,
        "setting": setting,
        "component_bytes": 40 * k,
        "held_out_psnr2_db": None if is_map else 80.0 + k,
        "held_out_log_likelihood": -0.01 * k,
        "seconds": 0.1 * k,
        "auc": 0.9 + 0.001 * k if is_map else None,
        **more,
    }


COUNTS = [
    *(count_row("fixed", k, k) for k in (32, 8, 16)),
    *(count_row("flat_pieces", m, int(20 / m)) for m in (1.0, 2.0)),
    count_row("bic", 16, 16),
    *(count_row("map_fixed", k, 3 * k) for k in (8, 16)),
    count_row("map_flat_pieces", 1.0, 40),
]


def test_component_count_marks_each_rule_with_its_setting():
    figure = component_count_figures(COUNTS)["component_count"]
    psnr, likelihood, seconds, auc = figure.axes
    names = [line.get_label() for line in psnr.lines]
    assert names == ["fixed number", "flat pieces (multiple of the noise)", "lowest BIC"]
    assert psnr.lines[0].get_xdata().tolist() == [320, 640, 1280]
    assert psnr.lines[0].get_ydata().tolist() == [88.0, 96.0, 112.0]
    assert psnr.lines[1].get_xdata().tolist() == [400, 800]
    assert [text.get_text() for text in psnr.texts] == ["2", "1"]
    assert [line.get_label() for line in auc.lines] == names[:2]
    assert auc.lines[0].get_xdata().tolist() == [960, 1920]
    assert [axes.get_yscale() for axes in figure.axes] == ["linear", "linear", "log", "linear"]
    assert {axes.get_xscale() for axes in figure.axes} == {"log"}
    assert "hall, 900 points" in figure.get_suptitle()
    assert likelihood.get_ylim()[1] > -0.08
    assert len(seconds.lines) == 3


def test_component_count_limits_the_likelihood_axis():
    far = count_row("fixed", 64, 64, held_out_log_likelihood=-900.0)
    figure = component_count_figures([*COUNTS, far])["component_count"]
    assert -5 < figure.axes[1].get_ylim()[0] < -0.3

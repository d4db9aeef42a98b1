"""The studies of gmmtorch-occupancy at small sizes: rows, figures, events and errors."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from command_runs import QUIET, Finished, refused, run_here, shrink, succeeded

from gmmtorch.experiments.studies import (
    ApproximationErrorStudy,
    AucMemoryStudy,
    PoseCorrectionStudy,
    VarianceThresholdStudy,
)

Run = Callable[..., Finished]
SHOWN = ["report.figures=true", "report.tensorboard=true"]
SMALL_2D = "dataset.n_scans=8 evaluation.test_every=4 evaluation.resolution=[0.5] map.n_samples=20000"
TINY = {
    "fig3_4_auc_sparsity_2d": f"{SMALL_2D} evaluation.kept=[1.0,0.5]",
    "fig3_5_maps_2d": f"{SMALL_2D} method=[occupancy_grid,monte_carlo]",
    "fig3_6_auc_sparsity_3d": "dataset.n_scans=4 evaluation.test_every=2 evaluation.kept=[1.0,0.1] "
    "map.n_samples=20000",
    "fig3_7_maps_3d": "dataset.n_scans=3 evaluation.test_every=2 map.n_components=40 map.n_samples=20000 "
    "method_options.bgk_points.max_points=300 evaluation.resolution=[0.5]",
    "fig3_3_approximation_error": "",
    "tab3_1_auc_memory": "dataset=synthetic_building_2d dataset.n_scans=12 study.n_components=[5,10]",
    "pose_correction": "dataset.n_scans=10 evaluation.pose_noise=[0.3,0.1] map.n_samples=20000",
    "pruning": "dataset=synthetic_building_2d dataset.n_scans=8 evaluation.max_beams=500",
    "fig3_8_variance_threshold": "study.n_components=[20,40]",
}
FIELDS: dict[str, tuple[type, dict[str, Any]]] = {
    "fig3_3_approximation_error": (
        ApproximationErrorStudy,
        {"dims": (2,), "n_pixels": 2, "n_components": 2, "n_cells": 2, "n_rays": (64,), "tolerance": (0.1,)}
        | {"n_large_samples": 256, "n_samples": 64, "resolution": 3.0},
    ),
    "tab3_1_auc_memory": (
        AucMemoryStudy,
        {"forms": ("point",), "bgk_points": (64,), "others": ("occupancy_grid",)},
    ),
    "pose_correction": (PoseCorrectionStudy, {"methods": ("point", "monte_carlo")}),
    "fig3_8_variance_threshold": (
        VarianceThresholdStudy,
        {"railing_scans": 4, "max_beams": 300, "method": ("counts", "point"), "resolution": (0.25,)}
        | {"prior": (1, None), "test_every": 3},
    ),
}
"""Fields of the studies that are no options."""


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    """Runs a small experiment in this process."""

    def run_experiment(name: str, *options: str) -> Finished:
        if name in FIELDS:
            study, values = FIELDS[name]
            shrink(monkeypatch, study, **values)
        given = [f"experiment={name}", *QUIET, *TINY[name].split(), *options]
        return run_here(monkeypatch, "occupancy", tmp_path / "run", *given)

    return run_experiment


def assert_shown(done: Finished, pictures: set[str], *tags: str) -> None:
    """The figures exist as files and as events, and curves or single numbers have these tags."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
    from tensorboard.util.tensor_util import make_ndarray

    assert {Path(name).stem for name in done.files() if name.endswith(".png")} == pictures
    for name in pictures:
        assert (done.folder / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    events = EventAccumulator(str(done.folder / "tensorboard")).Reload()
    found, single = events.Tags(), set()
    if "results/text_summary" in found["tensors"]:
        text = make_ndarray(events.Tensors("results/text_summary")[0].tensor_proto)[0].decode()
        (_, *prefixes), _, *lines = (
            [cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines()
        )
        single = {f"{prefix}/{line[0]}" for line in lines for prefix in prefixes}
    assert set(found["images"]) == {f"figures/{name}" for name in pictures}
    assert set(tags) <= {*found["scalars"], *single}


@pytest.mark.parametrize(
    ("name", "shares", "resolution", "methods"),
    [
        ("fig3_4_auc_sparsity_2d", (1.0, 0.5), 0.5, "occupancy_grid hilbert cone flux monte_carlo point"),
        ("fig3_6_auc_sparsity_3d", (1.0, 0.1), 0.25, "occupancy_grid monte_carlo point"),
    ],
)
def test_auc_against_sparsity(name, shares, resolution, methods, run):
    rows = succeeded(run(name)).results()["rows"]
    expected = [(share, method) for share in shares for method in methods.split()]
    assert [(row["kept"], row["method"]) for row in rows] == expected
    assert all(0 < row["auc_low"] <= row["auc"] <= row["auc_high"] <= 1 for row in rows)
    assert {row["resolution"] for row in rows} == {resolution}


def test_maps_in_2d_with_magnified_regions(run):
    done = succeeded(run("fig3_5_maps_2d", "report.figures=true"))
    assert "map_0.5m.png" in done.files()
    first, second = ((done.folder / f"map_0.5m_region_{number}.png").read_bytes() for number in (1, 2))
    assert first != second


@pytest.mark.slow
def test_maps_in_3d_are_drawn_in_space(run):
    done = succeeded(run("fig3_7_maps_3d", "report.figures=true"))
    rows = done.results()["rows"]
    assert [row["method"] for row in rows] == ["monte_carlo", "bgk_points"]
    assert rows[0]["n_components"] <= 40
    assert "scene_0.5m.png" in done.files()


def test_approximation_error(run):
    done = succeeded(run("fig3_3_approximation_error", *SHOWN))
    rows = done.results()["rows"]
    assert {(row["study"], row["dim"]) for row in rows} == {(study, 2) for study in ("map", "sweep", "curve")}
    for row in rows:
        if row["study"] == "map":
            assert len(row["error"]) == len(row["distances"]) == len(row["depths"]) == 2
        if row["study"] == "sweep":
            assert row["n_cases"] >= 2 * 2
        if row["study"] == "curve":
            assert row["n_cells"] > 0
    settings = {(row["method"], row["setting"]) for row in rows if row["study"] == "curve"}
    assert {("flux", 0.1), ("monte_carlo_sobol", 64.0), ("cone", None)} <= settings
    parts = ("", "_probability", "_sweep", "_curve")
    assert_shown(done, {f"approximation_error{part}" for part in parts}, "flux/hits_max", "cone/misses_p99")
    assert "errors per ray of random single components" in done.stdout


def test_auc_memory(run):
    done = succeeded(run("tab3_1_auc_memory", *SHOWN))
    rows = {(row["method"], row["size"]): row for row in done.results()["rows"]}
    assert list(rows) == [("point", 5), ("point", 10), ("bgk_points", 64), ("occupancy_grid", None)]
    for (method, size), row in rows.items():
        assert row["auc_low"] <= row["auc"] <= row["auc_high"]
        assert row["nbytes"] > 0
        assert (row["n_components"] or 0) <= (size if method == "point" else 0)
    assert rows["point", 5]["nbytes"] < rows["point", 10]["nbytes"] < rows["occupancy_grid", None]["nbytes"]
    assert_shown(done, {"auc_memory"}, "point/auc", "bgk_points/nbytes", "occupancy_grid/auc")


def test_pose_correction(run):
    done = succeeded(run("pose_correction", *SHOWN))
    rows = done.results()["rows"]
    assert [row["method"] for row in rows] == ["point", "monte_carlo"]
    for row in rows:
        assert (row["pose_noise_m"], row["pose_noise_rad"]) == (0.3, 0.1)
        assert row["nbytes"] > row["n_components"] > 0
        assert row["auc"] < row["auc_corrected"] <= 1
        assert row["auc_corrected"] == pytest.approx(row["auc_clean"], abs=0.02)
    assert_shown(done, {"pose_correction"}, "point/auc_corrected", "monte_carlo/auc")


def test_pruning(run):
    done = succeeded(run("pruning", *SHOWN))
    rows = {row["variant"]: row for row in done.results()["rows"]}
    assert list(rows)[:3] == ["flat_pieces", "support", "density"]
    first = rows["flat_pieces"]
    assert first["auc_gain"] == 0
    for row in rows.values():
        assert row["auc_gain_low"] <= row["auc_gain"] <= row["auc_gain_high"]
        assert row["auc_gain"] == pytest.approx(row["auc"] - first["auc"], abs=1e-9)
        assert row["nbytes"] > row["n_components"] > row["n_free_components"] >= 0
    assert rows["support"]["n_components"] < first["n_components"]
    assert rows["free_points"]["n_free_components"] > first["n_free_components"]
    assert rows["tree_support"]["n_components"] < rows["tree"]["n_components"]
    assert_shown(done, {"map_variants"}, "flat_pieces/auc", "tree/held_out_log_likelihood")


def test_variance_threshold(run):
    done = succeeded(run("fig3_8_variance_threshold", *SHOWN))
    rows = done.results()["rows"]
    assert len(rows) == 3 * 2 * 2  # sources, priors, thresholds
    assert [row["variance_threshold"] for row in rows] == [0.06, 0.24] * 6
    assert {row["method"] for row in rows[:4]} == {"counts"}
    assert all(row["n_components"] is None for row in rows[:4])
    for strict, lenient in zip(rows[::2], rows[1::2], strict=True):
        assert strict["auc"] == lenient["auc"]
        assert strict["share_decided"] <= lenient["share_decided"]  # with v = ¼ only ½ is unknown
        assert strict["thin_recall"] <= strict["thin_kept"]
    assert rows[4]["nbytes"] < rows[8]["nbytes"]
    assert_shown(done, {"variance_threshold", "variance_threshold_cells"}, "point/free_recall", "point/auc")


def test_variance_threshold_of_a_data_set_in_2d(run):
    data = "dataset=synthetic_building_2d dataset.n_scans=12 study.railing=null"
    done = succeeded(run("fig3_8_variance_threshold", *data.split()))
    assert {row["dataset"] for row in done.results()["rows"]} == {"synthetic_building_2d"}


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("fig3_3_approximation_error", "study.name=errors", "study.name='errors' auc_memory pose_correction"),
        ("pose_correction", "map=incremental", "map=per_scan"),
        ("fig3_8_variance_threshold", "study.railing=0", "study.railing=0"),
        ("pruning", "study.variants.support.prune=weight", "prune='weight' density"),
        ("pruning", "+study.variants.support.novel=1", "study.variants.support.novel map=incremental"),
        ("pruning", "study.variants.support=1", "study.variants={support: prune: support"),
    ],
)
def test_an_invalid_study_option_gives_a_one_line_error(name, options, words, run):
    line = refused(run(name, *options.split()))
    assert all(word in line for word in words.split()), line

"""The study of approximation errors: rows, seed, the known errors of each form, and figures."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from pillar_room import timeless

from gmmtorch.experiments.report.approximation_error_figures import approximation_figures
from gmmtorch.experiments.studies import ApproximationErrorStudy, run_approximation_error
from gmmtorch.experiments.studies.approximation_error import (
    Scene,
    cast_rays,
    map_rows,
    methods,
    random_scene,
    sweep_rows,
)

SMALL = ApproximationErrorStudy(
    dims=(2,),
    n_pixels=6,
    n_components=12,
    n_cells=4,
    n_samples=256,
    n_large_samples=1 << 14,
    resolution=0.5,
    n_rays=(256, 4096),
    tolerance=(0.1, 1e-3),
)


EVENTS: list[tuple[str, int, int | None]] = []
SEEN: list[int] = []


@pytest.fixture(scope="module")
def rows() -> list[dict[str, Any]]:
    """Rows of the small study; its events and the numbers of rows so far are noted."""
    return run_approximation_error(
        SMALL, 0, lambda *event: EVENTS.append(event), lambda rows: SEEN.append(len(rows))
    )


def of(rows: list[dict[str, Any]], study: str) -> Iterator[dict[str, Any]]:
    return (row for row in rows if row["study"] == study)


def test_rows_are_serializable_and_name_their_study(rows):
    json.dumps(rows, allow_nan=False)
    assert {row["study"] for row in rows} == {"map", "sweep", "curve"}
    assert [row["method"] for row in of(rows, "sweep")] == [
        name for name in methods(1, 1) if name != "cone_exact"
    ]
    first = next(of(rows, "map"))
    assert len(first["error"]) == len(first["depths"]) == 6
    assert len(first["error"][0]) == len(first["distances"]) == 6


def test_flux_error_is_below_a_thousandth_unlike_the_approximations(rows):
    worst = {row["method"]: max(row["hits_max"], row["misses_max"]) for row in of(rows, "sweep")}
    median = {row["method"]: max(row["hits_median"], row["misses_median"]) for row in of(rows, "sweep")}
    for method in ("flux", "flux_float32"):
        assert worst[method] < 1e-3
        assert median[method] < 1e-4
    assert min(worst["cone"], worst["point"]) > 0.01
    assert 1e-4 < worst["monte_carlo_sobol"] < 0.1
    assert worst["monte_carlo_large"] < 3e-3
    flux = next(row for row in of(rows, "sweep") if row["method"] == "flux")
    assert flux["probability_max"] < 1e-3


def test_flux_error_is_below_a_thousandth_in_3d():
    options = ApproximationErrorStudy(n_components=2, n_cells=2, n_samples=64, n_large_samples=64)
    rows = {row["method"]: row for row in sweep_rows(3, options, torch.Generator().manual_seed(1))}
    assert max(rows["flux"]["hits_max"], rows["flux"]["misses_max"]) < 1e-3
    assert list(rows) == list(methods(1, 1))


def test_cone_error_falls_with_distance_and_cells_at_the_sensor_are_none():
    options = ApproximationErrorStudy(n_pixels=9)
    rows = {row["method"]: row for row in map_rows(2, options, torch.Generator().manual_seed(0))}
    error = rows["cone"]["error"]
    near, far = ([line[column] for line in error if line[column] is not None] for column in (2, 8))
    assert max(near) > 0.05
    assert max(far) < 0.01
    behind = [(i, j) for i, line in enumerate(error) for j, value in enumerate(line) if value is None]
    assert behind
    for i, j in behind:
        assert rows["cone"]["depths"][i] + rows["cone"]["distances"][j] <= 1e-6


def test_monte_carlo_and_flux_converge_on_a_grid(rows):
    curve = list(of(rows, "curve"))
    for method in ("monte_carlo_plain", "monte_carlo_stratified", "monte_carlo_sobol"):
        few, many = (row["error"] for row in curve if row["method"] == method)
        assert many < 0.6 * few
    coarse, fine = (row["error"] for row in curve if row["method"] == "flux")
    assert fine < coarse
    assert fine < 1e-3
    at_most = {row["method"]: row["error"] for row in curve if row["setting"] in (4096.0, None)}
    assert at_most["monte_carlo_sobol"] < at_most["monte_carlo_stratified"] < at_most["monte_carlo_plain"]
    assert 1e-3 < at_most["cone"] < 0.5


def test_rows_depend_only_on_the_seed_and_progress_is_complete(rows):
    assert [done for _, done, _ in EVENTS] == [0, 1, 2, 3]
    assert list(range(1, len(rows) + 1)) == SEEN
    same, other = (timeless(sweep_rows(2, SMALL, torch.Generator().manual_seed(seed))) for seed in (0, 1))
    assert same != other
    assert [{"dataset": "one component", **row} for row in same] == timeless(of(rows, "sweep"))


def test_cast_rays_distinguishes_hits_misses_and_no_crossing(generator):
    scene = random_scene(2, 1, generator)
    mean, origin = scene.cone.means, scene.cone.origins
    cone = scene.cone._replace(covariances=1e-18 * torch.eye(2).double()[None])
    along = [origin - 0.01, 0.5 * mean - 0.01, mean - 0.01, 1.5 * mean, -mean]
    low = torch.cat(along)
    hits, misses = cast_rays(Scene(cone, low, low + 0.02), 50, generator)
    assert hits.tolist() == pytest.approx([0, 0, 1, 0, 0])
    assert misses.tolist() == pytest.approx([1, 1, 0, 0, 0])


def test_every_study_has_a_figure(rows):
    drawn = approximation_figures(rows)
    assert list(drawn) == [
        "approximation_error",
        "approximation_error_probability",
        "approximation_error_sweep",
        "approximation_error_curve",
    ]
    for figure in drawn.values():
        figure.canvas.draw()
        assert figure.get_suptitle()
    assert list(approximation_figures(list(of(rows, "sweep")))) == ["approximation_error_sweep"]

"""The initialization study: its rows match GaussianMixture, with a separate time for the initialization."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch
from pillar_room import timeless

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.experiments.evaluation.fits import FitData, Row, compare, split
from gmmtorch.experiments.evaluation.protocol_options import FitOptions
from gmmtorch.experiments.studies import fit_studies as initialization
from gmmtorch.experiments.studies.fit_studies import box_covariances, fit_timed, run_initialization
from gmmtorch.experiments.studies.study_options import InitializationStudy
from gmmtorch.mixture.em.initialization import INITIALIZATIONS
from gmmtorch.report import ignore

EM = FitOptions(max_iter=20, algorithm="exact")
SMALL = InitializationStudy(n_components=(2, 5), init_params=("random_points", "kmeans"), seeds=(7, 8))


@pytest.fixture
def data(generator) -> FitData:
    points = torch.randn(600, 3, generator=generator, dtype=torch.float64) * torch.tensor([3.0, 1.0, 0.1])
    return split("slab", points + 500.0, 0.5, 0)


def rows_of(data: FitData, study: InitializationStudy = SMALL) -> list[Row]:
    return run_initialization(data, study, EM, ignore, lambda rows: None)


def test_a_row_for_each_initialization_number_and_seed(data):
    rows = rows_of(data)
    cases = [(row["seed"], row["n_components"], row["init_params"]) for row in rows]
    assert cases == [(s, k, i) for s in (7, 8) for k in (2, 5) for i in ("random_points", "kmeans")]
    for row in rows:
        assert row["method"] == "em"
        assert row["seconds"] == pytest.approx(row["init_seconds"] + row["em_seconds"])
        assert min(row["init_seconds"], row["em_seconds"]) > 0
    json.dumps(rows, allow_nan=False)


def test_starts_of_means_run_with_each_initial_covariance(data):
    study = replace(SMALL, initial_covariance=("tiles", "box"), n_components=(3,), seeds=(0,))
    rows = rows_of(data, study)
    found = [(row["start"], row["init_params"], row["initial_covariance"]) for row in rows]
    assert found == [
        ("random_points", "random_points", "tiles"),
        ("random_points_box", "random_points", "box"),
        ("kmeans", "kmeans", None),
    ]
    alone = rows_of(data, replace(study, initial_covariance=("tiles",)))
    assert timeless(alone) == timeless([rows[0], rows[2]])


def test_box_covariances_are_the_square_of_the_longest_side(data):
    points = data.train.double()
    side = max(float(points[:, i].max() - points[:, i].min()) for i in range(3))
    expected = torch.eye(3, dtype=torch.float64) * side**2
    found = box_covariances(points, 4)
    assert found.shape == (4, 3, 3)
    torch.testing.assert_close(found[2], expected)


@pytest.mark.parametrize("init_params", INITIALIZATIONS)
def test_a_timed_fit_matches_the_estimator(init_params, data):
    options = replace(EM, n_components=5, init_params=init_params)
    ours = fit_timed(data, 5, options, seed=3)
    theirs = compare(data, ["em"], options, 3, ignore).rows[0]
    for name, value in theirs.items():
        if name in ("nbytes", "seconds"):  # the estimator's file also contains its options
            continue
        expected = pytest.approx(value, rel=1e-9) if isinstance(value, float) else value
        assert ours[name] == expected, name


def test_rows_depend_only_on_the_seeds(data):
    assert timeless(rows_of(data)) == timeless(rows_of(data))
    assert timeless(rows_of(data)) != timeless(rows_of(data, replace(SMALL, seeds=(8, 7))))


def test_rows_are_reported_one_by_one_and_progress_is_complete(data):
    seen: list[int] = []
    events: list[tuple[str, int, int | None]] = []
    run_initialization(
        data, SMALL, EM, lambda *event: events.append(event), lambda rows: seen.append(len(rows))
    )
    assert seen == list(range(1, 9))
    assert events == [("starts", done, 8) for done in range(9)]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"seeds": ()}, r"seeds=\[\] is empty"),
        ({"seeds": (-1,)}, "seeds=-1"),
        ({"n_components": ()}, r"n_components=\[\] is empty"),
        ({"initial_covariance": ("sphere",)}, "initial_covariance='sphere'"),
        ({"n_components": (2, 400)}, "n_components=400 is more than the n_samples=300"),
        ({"n_components": (0,)}, "n_components=0"),
        ({"init_params": ("kmeans", "sorted")}, "init_params='sorted'"),
    ],
)
def test_invalid_options_raise_before_the_first_fit(options, message, data, monkeypatch):
    monkeypatch.setattr(initialization, "fit_timed", lambda *_: pytest.fail("something was fitted"))
    with pytest.raises(InvalidArgumentError, match=message):
        rows_of(data, replace(SMALL, **options))

"""The sensor noise study in a room with a closed form."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from evaluation.pillar_room import room_scan
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from gmmtorch import GaussianMap, Scan
from gmmtorch.datasets import load
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.experiments.evaluation import queries
from gmmtorch.experiments.studies.sensor_noise import VARIANTS, run_sensor_noise
from gmmtorch.experiments.studies.study_options import SensorModelStudy
from gmmtorch.mixture import LaserModel

NOISE = 0.04
SENSOR = LaserModel(noise=NOISE, divergence=1e-4)
STUDY = SensorModelStudy(
    SENSOR,
    (6, 20),
    n_points=1500,
    test_every=5,
    max_beams=800,
    max_iter=40,
    tol=1e-6,
    n_samples=20_000,
)
SMALL = replace(STUDY, n_components=(5,), n_points=300, resolution=0.2, max_beams=100, max_iter=5, tol=1e-4)


@pytest.fixture(scope="module")
def scans() -> list[Scan]:
    return [room_scan(number, 100, noise=NOISE) for number in range(30)]


@pytest.fixture(scope="module")
def rows(scans: list[Scan]) -> dict[tuple[int, str], dict]:
    found = run_sensor_noise("room", scans, STUDY)
    order = [(k, variant) for k in STUDY.n_components for variant in VARIANTS]
    assert [row["variant"] for row in found] == [variant for _, variant in order]
    return dict(zip(order, found, strict=True))


def test_rows_are_serializable_and_consistent(rows):
    for (k, variant), row in rows.items():
        assert json.loads(json.dumps(row)) == row
        assert (row["dataset"], row["variant"], row["n_train_points"]) == ("room", variant, 1500)
        assert 1 <= row["n_components"] <= k
        assert row["n_test_beams"] == 6 * 90
        assert row["seconds"] > 0
        assert 10 * row["n_components"] < row["nbytes"] < 1000 * row["n_components"] + 10_000
        assert row["auc_low"] <= row["auc"] <= row["auc_high"]
        assert row["sensor_deviation"] == pytest.approx(NOISE, rel=0.01)


def test_each_variant_is_scored_by_its_own_density(rows):
    for (_, variant), row in rows.items():
        own = "log_likelihood_noise_added" if variant.startswith("noise") else "log_likelihood_as_fitted"
        assert row["held_out_log_likelihood"] == row[own]


def test_scores_match_scipy_densities_and_pair_counts(scans, monkeypatch):
    """Recomputes one variant's likelihood by SciPy and its AUC by counting pairs."""
    kept: list[GaussianMap] = []
    make = GaussianMap.from_components
    monkeypatch.setattr(
        GaussianMap,
        "from_components",
        lambda *args, **options: kept.append(make(*args, **options)) or kept[-1],
    )
    study = replace(SMALL, n_components=(6,), n_points=800, max_iter=10, n_neighbors=0, n_samples=5000)
    row = run_sensor_noise("room", scans, study)[2]
    built = kept[2]
    origins, ends = queries.test_beams(scans[::5], 100, 0)
    noise = SENSOR.noise_covariances(ends, origins).numpy()
    weight = (built.support / built.support.sum()).numpy()
    logs = np.array(
        [
            [
                np.log(w) + multivariate_normal(m, c + r).logpdf(x)
                for w, m, c in zip(weight, built.means.numpy(), built.covariances.numpy(), strict=True)
            ]
            for x, r in zip(ends.numpy(), noise, strict=True)
        ]
    )
    # The parameters of a map are quantized.
    assert row["held_out_log_likelihood"] == pytest.approx(logsumexp(logs, axis=1).mean(), abs=1e-3)
    asked = queries.hit_and_free(origins, ends, "uniform", 0.2, 0)
    theta = built.occupancy(asked.points, 0.2)
    hit, free = theta[asked.labels == 1], theta[asked.labels == 0]
    pairs = (hit[:, None] > free).double() + 0.5 * (hit[:, None] == free).double()
    assert row["auc"] == pytest.approx(float(pairs.mean()), abs=1e-9)
    assert row["nbytes"] == built.nbytes


def test_the_noise_model_gives_thinner_walls_and_higher_likelihood(rows):
    plain, noise = rows[20, "plain"], rows[20, "noise"]
    assert noise["thickness"] < 0.7 * plain["thickness"]
    assert noise["held_out_log_likelihood"] > plain["held_out_log_likelihood"]
    # Counting the noise twice, or not at all, lowers the likelihood.
    assert plain["log_likelihood_noise_added"] < plain["held_out_log_likelihood"]
    assert noise["log_likelihood_as_fitted"] < noise["held_out_log_likelihood"]


def test_planar_components_are_at_most_as_thick_as_the_noise(rows):
    for (_, variant), row in rows.items():
        if variant.endswith("planar"):
            assert row["thickness"] <= row["sensor_deviation"] * (1 + 1e-6)


def test_a_sensor_without_noise_gives_the_plain_mixture(scans):
    exact = LaserModel(noise=1e-9, divergence=1e-9)
    study = replace(SMALL, sensor=exact, n_components=(10,), n_points=600, max_iter=10)
    plain, _, noise, _ = run_sensor_noise("room", scans, study)
    for name in ("held_out_log_likelihood", "auc", "thickness"):
        assert noise[name] == pytest.approx(plain[name], rel=1e-5)


@pytest.mark.slow
def test_rows_depend_only_on_the_seed_and_progress_is_complete(scans):
    events: list[tuple[str, int, int | None]] = []
    first = run_sensor_noise("room", scans, SMALL, 3, lambda *event: events.append(event))
    again, other = (run_sensor_noise("room", scans, SMALL, seed) for seed in (3, 4))
    for row in (*first, *again):
        row.pop("seconds")
    assert first == again
    assert first[0]["held_out_log_likelihood"] != other[0]["held_out_log_likelihood"]
    assert events == [("sensor model", done, 4) for done in range(5)]


@pytest.mark.parametrize("n_components", [(), (5, 0)])
def test_invalid_sizes_raise(n_components):
    with pytest.raises(InvalidArgumentError, match="n_components"):
        SensorModelStudy(n_components=n_components)


def test_scans_without_points_raise(scans):
    empty = [Scan(np.empty((0, 2)), scan.origin) if i % 5 else scan for i, scan in enumerate(scans)]
    with pytest.raises(InvalidArgumentError, match="no points"):
        run_sensor_noise("room", empty, STUDY)


@pytest.mark.real_data
@pytest.mark.slow
def test_the_noise_model_improves_likelihood_on_real_scans(real_data: Path):
    path = real_data / "laser2d" / "intel.log.gz"
    if not path.is_file():
        pytest.skip(f"{path} is not there")
    study = SensorModelStudy(LaserModel(), n_components=(200,), n_points=8000, max_beams=2000, max_iter=15)
    scans, thinner = list(load("carmen", path, stride=4)), 0.0
    for seed in range(3):
        plain, _, noise, _ = run_sensor_noise("intel", scans, study, seed)
        assert noise["held_out_log_likelihood"] > plain["held_out_log_likelihood"]
        thinner += plain["thickness"] - noise["thickness"]
    assert thinner > 0, "on average of the seeds; a single start can be thicker"

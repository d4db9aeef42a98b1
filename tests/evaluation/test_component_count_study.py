"""The study of the number of components: rules, curve and maps."""

from __future__ import annotations

import json
import math

import pytest
import torch
from evaluation.pillar_room import room_scans
from sklearn.cluster import MeanShift

from gmmtorch import GaussianMap, GaussianMixture, Scan
from gmmtorch.datasets import load
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.experiments.evaluation.fits import FitData, Row, split
from gmmtorch.experiments.evaluation.protocol_options import FitOptions
from gmmtorch.experiments.studies import ComponentCountStudy, fit_studies, middle, run_component_count
from gmmtorch.experiments.studies.fit_studies import count_modes

STUDY = ComponentCountStudy(
    n_components=(2, 6, 12, 24),
    noise=0.02,
    multiples=(1.0, 4.0),
    bandwidths=(0.5,),
    window=5,
    window_components=(3, 10),
    test_every=4,
    max_beams=300,
    n_samples=20_000,
)
EM = FitOptions(max_iter=20)


@pytest.fixture(scope="module")
def scans() -> list[Scan]:
    return room_scans(12)


@pytest.fixture(scope="module")
def data(scans) -> FitData:
    return split("room", torch.cat([scan.points for scan in middle(scans, 8)]), 0.3, 0)


@pytest.fixture(scope="module")
def rows(data, scans) -> list[Row]:
    return run_component_count(data, scans, STUDY, EM)


def of(rows: list[Row], rule: str) -> list[Row]:
    return [row for row in rows if row["rule"] == rule]


def test_every_rule_has_a_row_per_setting(rows):
    settings = {rule: [row["setting"] for row in of(rows, rule)] for rule in {row["rule"] for row in rows}}
    bic = settings.pop("bic")
    assert settings == {
        "fixed": [2, 6, 12, 24],
        "flat_pieces": [1, 4],
        "mean_shift": [0.5],
        "hierarchical": [1, 4],
        "map_flat_pieces": [1, 4],
        "map_fixed": [3, 10],
    }
    assert len(bic) == 1
    assert len(rows) == 14
    assert [row["n_components"] for row in of(rows, "fixed")] == [2, 6, 12, 24]
    assert len({frozenset(row) for row in rows}) == 1  # all rows have the same fields
    json.dumps(rows, allow_nan=False)
    for row in rows:
        assert row["component_bytes"] == 24 * row["n_components"]  # 4 bytes for each of 6 parameters in 2D
        assert 0 <= (row["count_seconds"] or 0) <= row["seconds"] or row["rule"] == "flat_pieces"


def test_flat_pieces_match_the_estimator(rows, data):
    for row in of(rows, "flat_pieces"):
        mixture = GaussianMixture(None, noise=0.02 * row["setting"], max_iter=20).fit(data.train)
        assert row["n_components"] == len(mixture.means_)
        assert row["held_out_log_likelihood"] == pytest.approx(mixture.score(data.test), abs=1e-9)
        assert row["bic"] == pytest.approx(mixture.bic(data.train))


def test_bic_row_is_the_minimum_with_the_time_of_the_whole_curve(rows, data):
    curve, (chosen,) = of(rows, "fixed"), of(rows, "bic")
    best = min(curve, key=lambda row: row["bic"])
    n = len(data.train)
    free = 6 * best["n_components"] - 1  # weights, means and covariances in 2D
    assert best["bic"] == pytest.approx(-2 * n * best["log_likelihood"] + free * math.log(n))
    assert chosen["n_components"] == best["n_components"]
    assert chosen["held_out_psnr2_db"] == best["held_out_psnr2_db"]
    assert chosen["seconds"] == pytest.approx(sum(row["seconds"] for row in curve))
    assert chosen["count_seconds"] == pytest.approx(chosen["seconds"] - best["seconds"])


def test_modes_match_scikit_learn_mean_shift(generator):
    blobs = torch.randn(200, 3, generator=generator, dtype=torch.float64) * 0.05
    blobs += 4 * torch.eye(3, dtype=torch.float64)[torch.arange(200) % 3]
    assert count_modes(blobs, 0.3) == 3
    assert count_modes(1000 * blobs + 5e4, 0.3) == 3
    assert count_modes(torch.ones(5, 2), 0.3) == 1
    spread = float((blobs - blobs.mean(0)).square().sum(1).mean().sqrt())
    peer = MeanShift(bandwidth=0.02 * spread).fit(blobs.numpy())  # from every point, not from bins of them
    assert count_modes(blobs, 0.02) == pytest.approx(len(peer.cluster_centers_), rel=0.25)


def test_map_row_matches_a_map_with_that_rule(rows, scans):
    first = of(rows, "map_flat_pieces")[0]
    rule = fit_studies.WindowedRule(noise=0.02, window=5)
    built = GaussianMap(rule, n_samples=20_000, cutoff=5.0, prior=1.0)  # as the study's maps
    for number, scan in enumerate(scans):
        if number % 4:
            built.insert(scan)
    built.finish()
    assert (first["n_components"], first["nbytes"]) == (built.n_components, built.nbytes)
    assert 0.5 < first["auc_low"] <= first["auc"] <= first["auc_high"] <= 1
    test = torch.cat([scan.points for scan in scans[::4]])
    hits = ~built.max_range
    weight = built.support[hits] / built.support[hits].sum()
    normal = torch.distributions.MultivariateNormal(built.means[hits], built.covariances[hits])
    expected = (normal.log_prob(test[:, None]) + weight.log()).logsumexp(1).mean()
    assert first["held_out_log_likelihood"] == pytest.approx(float(expected), abs=1e-6)


def test_a_fixed_map_has_its_number_of_components_per_window(rows, scans):
    """No-return beams are fitted separately, with at most as many components again."""
    for row in of(rows, "map_fixed"):
        n_windows = math.ceil(9 / 5)
        assert n_windows * row["setting"] <= row["n_components"] <= 2 * n_windows * row["setting"]


def test_rows_are_reported_one_by_one(data, scans):
    seen: list[int] = []
    events: list[tuple[str, int, int | None]] = []
    study = ComponentCountStudy((2,), multiples=(1.0,), bandwidths=(), window_components=())
    found = run_component_count(
        data, scans, study, EM, 0, lambda *event: events.append(event), lambda r: seen.append(len(r))
    )
    assert [row["rule"] for row in found] == ["fixed", "flat_pieces", "hierarchical", "bic"]
    assert seen == [1, 2, 3, 4]
    assert events == [("components", done, 3) for done in range(4)]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"n_components": ()}, r"n_components=\[\] is empty"),
        ({"n_components": (0,)}, "n_components=0"),
        ({"n_components": (10**6,)}, r"n_components=\[1000000\]: all exceed"),
    ],
)
def test_invalid_options_raise(options, message, data, scans):
    with pytest.raises(InvalidArgumentError, match=message):
        run_component_count(data, scans, ComponentCountStudy(**options), EM)


@pytest.mark.real_data
@pytest.mark.slow
def test_flat_pieces_match_the_curve_on_a_depth_image(real_data):
    path = real_data / "kinect"
    if not path.is_dir():
        pytest.skip(f"{path} is not there")
    scan = load("depth_frames", path, pixel_stride=4)[40]
    study = ComponentCountStudy((64, 128, 256), multiples=(1.0,), bandwidths=(), window_components=())
    found = run_component_count(split("kinect", scan.points, 0.5, 0), [scan], study, FitOptions())
    pieces, (few, *_, many) = of(found, "flat_pieces")[0], of(found, "fixed")
    assert few["n_components"] < pieces["n_components"] < many["n_components"]
    assert pieces["held_out_log_likelihood"] > few["held_out_log_likelihood"] - 0.05

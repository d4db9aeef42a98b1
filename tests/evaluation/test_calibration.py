"""Calibration, against scikit-learn, brute force and closed forms."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch
from sklearn.calibration import calibration_curve
from sklearn.metrics import brier_score_loss, log_loss

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.experiments.evaluation.calibration import (
    SeenPredictions,
    accuracy,
    brier_score,
    log_loss_bits,
    prior_and_dead_band,
    reliability,
    scores,
)
from gmmtorch.experiments.evaluation.queries import hit_and_free
from gmmtorch.occupancy.calibrator import N_BINS, Calibrator
from gmmtorch.occupancy.evidence import occupancy_probability
from gmmtorch.occupancy.reliability import reliability_of, scores_of
from gmmtorch.scan import Scan


def drawn(n: int = 5000, seed: int = 0, bend: float = 1.0) -> tuple[torch.Tensor, torch.Tensor]:
    """Probabilities, some of them exactly 0, ½ and 1, and labels that are 1 with probability θ^bend."""
    rng = np.random.default_rng(seed)
    theta = rng.beta(0.6, 0.8, n)
    theta[: n // 20] = 0.5
    theta[n // 20 : n // 10] = rng.integers(2, size=n // 10 - n // 20)
    labels = (rng.random(n) < theta**bend).astype(np.int64)
    return torch.from_numpy(theta), torch.from_numpy(labels)


def test_reliability_matches_scikit_learn():
    theta, labels = drawn()
    curve = reliability(theta, labels)
    observed, predicted = calibration_curve(labels, theta, n_bins=N_BINS)
    np.testing.assert_allclose(curve.observed, observed, atol=1e-12)
    np.testing.assert_allclose(curve.predicted, predicted, atol=1e-12)
    assert curve.n_points.sum() == len(theta)


def test_calibration_errors_match_a_loop_over_bins():
    theta, labels = drawn(700, bend=2.0)
    gaps, sizes = [], []
    for low, high in itertools.pairwise(np.linspace(0, 1, N_BINS + 1)):
        inside = [i for i, p in enumerate(theta.tolist()) if low < p <= high or (low == 0 and p == 0)]
        if inside:
            gaps.append(abs(float(theta[inside].mean()) - float(labels[inside].double().mean())))
            sizes.append(len(inside))
    curve = reliability(theta, labels)
    assert curve.expected_error == pytest.approx(np.average(gaps, weights=sizes), abs=1e-12)
    assert curve.maximum_error == pytest.approx(max(gaps), abs=1e-12)
    assert curve.n_points.tolist() == sizes


def test_expected_error_matches_a_known_miscalibration():
    theta, labels = drawn(200_000)
    assert reliability(theta, labels).expected_error < 0.005
    theta, labels = drawn(200_000, bend=2.0)
    expected = float((theta - theta**2).abs().mean())
    assert reliability(theta, labels).expected_error == pytest.approx(expected, abs=0.005)


def test_log_loss_matches_scikit_learn():
    theta, labels = drawn()
    assert log_loss_bits(theta, labels) == pytest.approx(log_loss(labels, theta) / math.log(2), rel=1e-9)


def test_log_loss_is_one_bit_at_one_half_and_52_for_a_certain_mistake():
    labels = torch.tensor([0, 1])
    assert log_loss_bits(torch.tensor([0.5, 0.5]), labels) == 1
    assert log_loss_bits(torch.tensor([0.0, 1.0]), labels) == pytest.approx(0, abs=1e-12)
    assert log_loss_bits(torch.tensor([1.0, 0.0]), labels) == pytest.approx(52)


def test_brier_score_matches_scikit_learn():
    theta, labels = drawn()
    assert brier_score(theta, labels) == pytest.approx(brier_score_loss(labels, theta), rel=1e-9)
    assert brier_score(torch.full((10,), 0.5), torch.arange(10) % 2) == 0.25


def test_a_tally_of_predictions_has_the_scores_of_its_points():
    theta, labels = drawn()
    theta = (theta.round(decimals=3) + 1e-5).clamp(max=1)  # inside the bins
    tally = Calibrator.of(10.0, 1)._tallied(theta, labels.double(), torch.tensor([len(theta)]))[0]
    found, expected = scores_of(tally), scores(theta, labels)
    assert list(found) == list(expected)
    for name, value in found.items():
        assert value == pytest.approx(expected[name], rel=1e-9), name
    for one, other in zip(reliability_of(tally), reliability(theta, labels), strict=True):
        assert one == pytest.approx(other)


@pytest.mark.parametrize("power", [0.4, 1.0, 3.0])
def test_predictions_calibrate_a_map_that_has_no_calibration(power):
    """The ends of beams have the density 2x/25 up to 5 m, so a point at x is an end with probability x/5. The
    log-odds of the map are wrong by a factor, like those of rays that are counted as independent."""
    seen, generator = SeenPredictions(0.1), torch.Generator().manual_seed(0)

    def beams(n: int) -> torch.Tensor:
        ends = torch.zeros(n, 2, dtype=torch.float64)
        ends[:, 0] = 5 * torch.rand(n, generator=generator, dtype=torch.float64).sqrt()
        return ends

    def answer(points: torch.Tensor) -> torch.Tensor:
        return torch.sigmoid(power * torch.logit(points[:, 0] / 5))

    for number in range(60):
        seen.note(answer, Scan(beams(200), torch.zeros(2, dtype=torch.float64)), number)
    ends = beams(20_000)
    asked = hit_and_free(torch.zeros_like(ends), ends, "uniform", 0.1, 3)
    theta = seen.calibrated(answer(asked.points))
    assert reliability(theta, asked.labels).expected_error < 0.02
    assert float((theta - asked.points[:, 0] / 5).abs().mean()) < 0.02


def test_predictions_keep_the_order_of_probabilities_and_one_half():
    seen = SeenPredictions(0.2)
    theta = torch.tensor([0.0, 0.1, 0.5, 0.9, 1.0])
    assert torch.equal(seen.calibrated(theta), theta)  # nothing is seen yet
    scan = Scan(torch.rand(50, 3, dtype=torch.float64) + 1, torch.zeros(3, dtype=torch.float64))
    seen.note(lambda points: torch.full((len(points),), 0.8), scan, 0)
    found = seen.calibrated(theta)
    assert (found.diff() > 0).all()
    assert float(found[2]) == 0.5


def test_bins_of_a_tally_with_few_predictions_are_pooled():
    tally = torch.zeros(15, 6, dtype=torch.float64)
    tally[2, :3] = torch.tensor([12.0, 2.0, 3.0])
    tally[5, :3] = torch.tensor([9.0, 3.5, 3.0])
    tally[14, :3] = torch.tensor([4.0, 3.9, 4.0])
    curve = reliability_of(tally)
    assert curve.n_points.tolist() == [21, 4]
    assert curve.predicted == pytest.approx([5.5 / 21, 3.9 / 4])
    assert curve.observed == pytest.approx([6 / 21, 1])


def test_scores_contain_ece_brier_log_loss_and_accuracy():
    theta, labels = drawn()
    found = scores(theta.float(), labels)
    assert list(found) == ["ece", "brier", "log_loss_bits", "accuracy"]
    assert found["ece"] == pytest.approx(reliability(theta, labels).expected_error, abs=1e-4)
    assert found["accuracy"] == accuracy(theta, labels)
    assert all(type(value) is float for value in found.values())


def test_prior_and_dead_band_match_counting():
    generator = torch.Generator().manual_seed(0)
    labels = torch.randint(2, (400,), generator=generator)
    hits = labels * torch.randint(0, 9, (400,), generator=generator).double()
    misses = torch.randint(0, 9, (400,), generator=generator).double()
    rows = prior_and_dead_band(
        lambda prior: occupancy_probability(hits, misses, prior), labels, (0.5, 1.0), (0.25, 0.1)
    )
    assert [(row["prior"], row["variance_threshold"]) for row in rows] == [
        (0.5, 0.25), (0.5, 0.1), (1.0, 0.25), (1.0, 0.1),
    ]  # fmt: skip
    for row in rows:
        theta = (hits + row["prior"]) / (hits + misses + 2 * row["prior"])
        decided = [i for i in range(400) if theta[i] * (1 - theta[i]) < row["variance_threshold"] - 1e-15]
        right = [i for i in decided if (theta[i] > 0.5) == (labels[i] == 1)]
        assert row["decided"] == pytest.approx(len(decided) / 400)
        assert row["accuracy_decided"] == pytest.approx(len(right) / len(decided))
        assert row["brier"] == pytest.approx(float(((theta - labels) ** 2).mean()))
        assert row["ece"] == pytest.approx(reliability(theta, labels).expected_error)
    # A larger prior and a wider dead band both decide fewer points.
    assert rows[0]["decided"] > rows[1]["decided"] > rows[3]["decided"]


def test_accuracy_decided_is_none_if_nothing_is_decided():
    theta, labels = torch.full((4,), 0.5), torch.tensor([0, 1, 0, 1])
    (row,) = prior_and_dead_band(lambda prior: theta, labels, (1.0,), (0.25,))
    assert row["decided"] == 0
    assert row["accuracy_decided"] is None
    assert row["accuracy"] == 0.5


@pytest.mark.parametrize(
    ("theta", "labels", "says"),
    [
        ([0.5], [2], "labels must be 0"),
        ([0.5, 0.5], [1], "labels \\(1,\\)"),
        ([], [], "M ≥ 1"),
        ([1.5], [1], "outside \\[0, 1\\]"),
        ([float("nan")], [1], "NaN"),
        ([[0.5]], [[1]], "must be \\(M,\\)"),
    ],
)
@pytest.mark.parametrize("score", [reliability, brier_score, log_loss_bits, accuracy])
def test_invalid_probabilities_and_labels_raise(score, theta, labels, says):
    with pytest.raises(InvalidArgumentError, match=says):
        score(torch.tensor(theta), torch.tensor(labels))

"""Scores and calibration against scikit-learn, enumeration, brute force and closed forms."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.distance import cdist
from sklearn.calibration import calibration_curve
from sklearn.metrics import brier_score_loss, log_loss, roc_auc_score
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.experiments.evaluation import auc_gain, auc_interval, hit_and_free, reliability, roc
from gmmtorch.experiments.evaluation.metrics import SeenPredictions, psnr2, psnr_terms, scores, unknown_scores
from gmmtorch.occupancy.calibrator import N_BINS, Calibrator, reliability_of, scores_of
from gmmtorch.scan import Scan

eighths = st.lists(st.integers(0, 8).map(lambda n: n / 8), min_size=1, max_size=12)
"""Few values, so that many scores tie."""


def probabilities(n: int, shift: float, seed: int, levels: int | None = None) -> Tensor:
    """Probabilities (n,) that grow with the shift; `levels` rounds them, so that many tie."""
    raw = np.random.default_rng(seed).normal(shift, 1.0, n)
    theta = torch.from_numpy(1 / (1 + np.exp(-raw)))
    return theta if levels is None else (theta * levels).round() / levels


def labelled(occupied: Tensor, free: Tensor) -> tuple[np.ndarray, np.ndarray]:
    truth = np.r_[np.ones(len(occupied)), np.zeros(len(free))]
    return truth, torch.cat([occupied, free]).numpy()


# -- area under the curve -------------------------------------------------------------------------


@given(eighths, eighths)
def test_auc_is_the_share_of_ordered_pairs_and_ties_count_half(occupied, free):
    pairs = [0.5 * ((p > q) + (p >= q)) for p, q in itertools.product(occupied, free)]
    found = roc(torch.tensor(occupied).double(), torch.tensor(free).double()).auc
    assert found == pytest.approx(sum(pairs) / len(pairs), abs=1e-12)


@given(occupied=eighths, free=eighths)
def test_the_separating_threshold_is_the_best_of_all(occupied, free):
    hits, misses = (torch.tensor(values).double() for values in (occupied, free))

    def gain(threshold: float) -> float:
        return float((hits >= threshold).double().mean() - (misses >= threshold).double().mean())

    best = max(gain(k / 8) for k in range(10))
    assert gain(roc(hits, misses).separating) == pytest.approx(best)


@pytest.mark.parametrize(("n_occupied", "n_free"), [(0, 3), (3, 0), (0, 0)])
def test_roc_of_one_class_raises(n_occupied, n_free):
    with pytest.raises(InvalidArgumentError, match="at least one occupied and one free point"):
        roc(torch.rand(n_occupied), torch.rand(n_free))


# -- its bootstrap interval -----------------------------------------------------------------------


def interval(occupied: Tensor, free: Tensor, seed: int = 0) -> tuple[float, float, float]:
    """Lower end, AUC, upper end."""
    auc = roc(occupied, free).auc
    low, high = auc_interval(occupied, free, auc, seed)
    return low, auc, high


@pytest.mark.parametrize("levels", [None, 6])
def test_interval_matches_resampling_of_single_points(levels):
    occupied, free = probabilities(150, 0.9, 2, levels), probabilities(250, 0.0, 3, levels)
    generator = np.random.default_rng(0)
    replicates = []
    for _ in range(400):
        drawn = [x[torch.from_numpy(generator.integers(0, len(x), len(x)))] for x in (occupied, free)]
        replicates.append(roc_auc_score(*labelled(*drawn)))
    low, _, high = interval(occupied, free)
    expected = np.quantile(replicates, [0.025, 0.975])
    assert low == pytest.approx(expected[0], abs=0.01)
    assert high == pytest.approx(expected[1], abs=0.01)
    assert high - low == pytest.approx(expected[1] - expected[0], rel=0.12)


def test_interval_depends_only_on_the_seed_and_that_of_equal_scores_is_a_point():
    occupied, free = probabilities(200, 0.7, 0), probabilities(200, 0.0, 1)
    assert interval(occupied, free, seed=1) == interval(occupied, free, seed=1)
    assert interval(occupied, free, seed=1) != interval(occupied, free, seed=2)
    half = torch.full((30,), 0.5)
    assert interval(half, half) == (0.5, 0.5, 0.5)


# -- the gain of another classifier ---------------------------------------------------------------


@pytest.mark.parametrize("levels", [None, 10])
def test_auc_gain_matches_scikit_learn_and_a_bootstrap(levels):
    rng = np.random.default_rng(3)
    before = probabilities(400, 0.8, 0, levels), probabilities(600, -0.2, 1, levels)
    changes = (torch.from_numpy(rng.normal(0.05, 0.2, len(x))) for x in before)
    occupied, free = ((x + change).clamp(0, 1) for x, change in zip(before, changes, strict=True))
    mean, low, high = auc_gain(before, (occupied, free))

    def area(occupied: Tensor, free: Tensor) -> float:
        return float(roc_auc_score(*labelled(occupied, free)))

    assert mean == pytest.approx(area(occupied, free) - area(*before), abs=1e-12)
    gains = []
    for _ in range(300):
        rows, columns = rng.integers(0, 400, 400), rng.integers(0, 600, 600)
        gains.append(area(occupied[rows], free[columns]) - area(before[0][rows], before[1][columns]))
    assert high - low == pytest.approx(2 * 1.96 * np.std(gains), rel=0.15)
    assert auc_gain(before, before) == (0.0, 0.0, 0.0)


# -- the other scores -----------------------------------------------------------------------------


def test_unknown_scores_match_a_hand_count_and_are_none_without_unknown_points():
    unknown, free = torch.tensor([0.5, 0.5, 0.125, 0.75]), torch.tensor([0.125, 0.25, 0.0625, 0.5])
    # |θ − ½|: unknown 0, 0, 3/8, 1/4; free 3/8, 1/4, 7/16, 0. Ordered pairs, ties count ½:
    right = (3 + 0.5) + (3 + 0.5) + (1 + 0.5) + (2 + 0.5)
    names = ("unknown_auc", "unknown_called_free", "unknown_called_occupied", "free_recall")
    expected = (pytest.approx(right / 16), 1 / 4, 1 / 4, 2 / 4)
    assert unknown_scores(unknown, free) == dict(zip(names, expected, strict=True))
    found = unknown_scores(torch.empty(0), torch.tensor([0.1, 0.9]))
    assert found == dict(zip(names, (None, None, None, 0.5), strict=True))


# -- PSNR2 ----------------------------------------------------------------------------------------


def psnr2_by_all_pairs(x: np.ndarray, y: np.ndarray) -> float:
    distance = cdist(x, y)
    diagonal = np.sqrt(((x.max(0) - x.min(0)) ** 2).sum())
    errors = [np.sqrt((distance.min(axis) ** 2).mean()) for axis in (1, 0)]
    return float(sum(20 * np.log10(diagonal / error) for error in errors))


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_psnr2_matches_all_pairs(generator, dim, dtype):
    points = torch.randn(80, dim, generator=generator, dtype=dtype) * 3 + 5
    sampled = torch.randn(80, dim, generator=generator, dtype=dtype) * 3 + 5
    expected = psnr2_by_all_pairs(points.double().numpy(), sampled.double().numpy())
    assert psnr2(points, sampled) == pytest.approx(expected, rel=1e-6)
    assert sum(psnr_terms(points, sampled)) == pytest.approx(expected, rel=1e-6)


def test_psnr_terms_separate_missing_from_extra_points(generator):
    points = torch.rand(200, 2, generator=generator)
    forward, backward = psnr_terms(points, points[:20])  # most of the cloud is missing
    assert backward == math.inf
    assert forward < 40
    forward, backward = psnr_terms(points, torch.cat([points, points[:50] + 3]))
    assert forward == math.inf
    assert backward < 0
    assert psnr2(points, points[:20]) == math.inf
    assert psnr2(points[:1], points[:1]) == math.inf
    assert psnr2(points[:1], points[:1] + 1) == -math.inf


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
    assert curve.n_points.tolist() == sizes


def test_scores_match_scikit_learn():
    theta, labels = drawn()
    found = scores(theta, labels)
    assert list(found) == ["ece", "brier", "log_loss_bits", "accuracy"]
    assert all(type(value) is float for value in found.values())
    assert found["ece"] == reliability(theta, labels).expected_error
    assert found["brier"] == pytest.approx(brier_score_loss(labels, theta), rel=1e-9)
    assert found["log_loss_bits"] == pytest.approx(log_loss(labels, theta) / math.log(2), rel=1e-9)
    called = (theta > 0.5).double()
    called[theta == 0.5] = 0.5  # counts one half
    assert found["accuracy"] == pytest.approx(1 - float((called - labels).abs().mean()))
    for certain, bits in (([0.5, 0.5], 1), ([0.0, 1.0], 0), ([1.0, 0.0], 52)):
        found = scores(torch.tensor(certain), torch.tensor([0, 1]))
        assert found["log_loss_bits"] == pytest.approx(bits, abs=1e-12)


def test_a_tally_of_predictions_has_the_scores_of_its_points():
    theta, labels = drawn()
    theta = (theta.round(decimals=3) + 1e-5).clamp(max=1)  # inside the bins
    tally = Calibrator.of(10.0, 1)._tallied(theta.numpy(), labels.double().numpy(), [len(theta)])[0]
    tally = torch.from_numpy(tally)
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
@pytest.mark.parametrize("score", [reliability, scores])
def test_invalid_probabilities_and_labels_raise(score, theta, labels, says):
    with pytest.raises(InvalidArgumentError, match=says):
        score(torch.tensor(theta), torch.tensor(labels))

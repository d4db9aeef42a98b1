"""Scores against scikit-learn, enumeration and explicit formulas."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.distance import cdist
from sklearn.metrics import roc_auc_score
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.experiments.evaluation.metrics import (
    auc_gain,
    auc_interval,
    psnr2,
    psnr_terms,
    roc,
    separating_threshold,
    unknown_scores,
)

eighths = st.lists(st.integers(0, 8).map(lambda n: n / 8), min_size=1, max_size=12)
"""Few values, so that many scores tie."""


def scores(n: int, shift: float, seed: int, levels: int | None = None) -> Tensor:
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


@pytest.mark.parametrize("levels", [None, 10, 2])
def test_auc_matches_scikit_learn(levels):
    occupied, free = scores(700, 0.8, 0, levels), scores(1300, -0.2, 1, levels)
    assert roc(occupied, free).auc == pytest.approx(roc_auc_score(*labelled(occupied, free)), abs=1e-12)


def test_auc_of_perfect_reversed_and_constant_maps():
    low, high, half = torch.full((4,), 0.1), torch.full((3,), 0.9), torch.full((4,), 0.5)
    assert roc(high, low).auc == 1
    assert roc(low, high).auc == 0
    assert roc(half, half).auc == 0.5


@given(occupied=eighths, free=eighths)
def test_the_separating_threshold_is_the_best_of_all(occupied, free):
    hits, misses = (torch.tensor(values).double() for values in (occupied, free))

    def gain(threshold: float) -> float:
        return float((hits >= threshold).double().mean() - (misses >= threshold).double().mean())

    best = max(gain(k / 8) for k in range(10))
    assert gain(separating_threshold(hits, misses)) == pytest.approx(best)


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
    occupied, free = scores(150, 0.9, 2, levels), scores(250, 0.0, 3, levels)
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


def test_interval_width_matches_delong():
    occupied, free = scores(20_000, 1.0, 4), scores(30_000, 0.0, 5)
    ranks = [np.searchsorted(np.sort(b.numpy()), a.numpy()) / len(b) for a, b in
             ((occupied, free), (free, occupied))]  # fmt: skip
    sigma = math.sqrt(ranks[0].var() / len(occupied) + ranks[1].var() / len(free))
    low, auc, high = interval(occupied, free)
    assert high - low == pytest.approx(2 * 1.96 * sigma, rel=0.08)
    assert (low + high) / 2 == pytest.approx(auc, abs=0.2 * sigma)


def test_interval_depends_only_on_the_seed():
    occupied, free = scores(200, 0.7, 0), scores(200, 0.0, 1)
    assert interval(occupied, free, seed=1) == interval(occupied, free, seed=1)
    assert interval(occupied, free, seed=1) != interval(occupied, free, seed=2)


def test_interval_of_equal_scores_is_a_point():
    half = torch.full((30,), 0.5)
    assert interval(half, half) == (0.5, 0.5, 0.5)


# -- the gain of another classifier ---------------------------------------------------------------


@pytest.mark.parametrize("levels", [None, 10])
def test_auc_gain_matches_scikit_learn_and_a_bootstrap(levels):
    rng = np.random.default_rng(3)
    before = scores(400, 0.8, 0, levels), scores(600, -0.2, 1, levels)
    changes = (torch.from_numpy(rng.normal(0.05, 0.2, len(x))) for x in before)
    occupied, free = ((x + change).clamp(0, 1) for x, change in zip(before, changes, strict=True))
    found = auc_gain(before, (occupied, free))

    def area(occupied: Tensor, free: Tensor) -> float:
        return float(roc_auc_score(*labelled(occupied, free)))

    assert found.mean == pytest.approx(area(occupied, free) - area(*before), abs=1e-12)
    gains = []
    for _ in range(300):
        rows, columns = rng.integers(0, 400, 400), rng.integers(0, 600, 600)
        gains.append(area(occupied[rows], free[columns]) - area(before[0][rows], before[1][columns]))
    assert found.high - found.low == pytest.approx(2 * 1.96 * np.std(gains), rel=0.15)


def test_auc_gain_of_equal_answers_is_exactly_zero():
    same = scores(50, 0.8, 0), scores(60, -0.2, 1)
    assert auc_gain(same, same) == (0.0, 0.0, 0.0)


# -- the other scores -----------------------------------------------------------------------------


def test_unknown_scores_match_a_hand_count():
    unknown, free = torch.tensor([0.5, 0.5, 0.125, 0.75]), torch.tensor([0.125, 0.25, 0.0625, 0.5])
    # |θ − ½|: unknown 0, 0, 3/8, 1/4; free 3/8, 1/4, 7/16, 0. Ordered pairs, ties count ½:
    right = (3 + 0.5) + (3 + 0.5) + (1 + 0.5) + (2 + 0.5)
    assert unknown_scores(unknown, free) == {
        "unknown_auc": pytest.approx(right / 16),
        "unknown_called_free": 1 / 4,
        "unknown_called_occupied": 1 / 4,
        "free_recall": 2 / 4,
    }


def test_unknown_scores_are_none_without_unknown_points():
    found = unknown_scores(torch.empty(0), torch.tensor([0.1, 0.9]))
    assert found == {
        "unknown_auc": None,
        "unknown_called_free": None,
        "unknown_called_occupied": None,
        "free_recall": 0.5,
    }


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


def test_psnr2_is_invariant_to_translation_and_scale(generator):
    points, sampled = torch.rand(2, 50, 3, generator=generator, dtype=torch.float64)
    assert psnr2(7 * points - 3, 7 * sampled - 3) == pytest.approx(psnr2(points, sampled))


def test_psnr_terms_separate_missing_from_extra_points(generator):
    points = torch.rand(200, 2, generator=generator)
    forward, backward = psnr_terms(points, points[:20])  # most of the cloud is missing
    assert backward == math.inf
    assert forward < 40
    forward, backward = psnr_terms(points, torch.cat([points, points[:50] + 3]))
    assert forward == math.inf
    assert backward < 0
    assert psnr2(points, points[:20]) == math.inf


def test_psnr2_of_a_single_point_is_infinite():
    point = torch.tensor([[1.0, 2.0, 3.0]])
    assert psnr2(point, point) == math.inf
    assert psnr2(point, point + 1) == -math.inf

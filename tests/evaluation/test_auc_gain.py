"""Differences of AUC against scikit-learn and a bootstrap."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from sklearn.metrics import roc_auc_score
from torch import Tensor

from gmmtorch.evaluation.metrics import auc_gain


def probabilities(n: int, shift: float, seed: int, levels: int | None = None) -> Tensor:
    """Probabilities (n,) that grow with the shift; `levels` rounds them, so that many tie."""
    theta = torch.from_numpy(1 / (1 + np.exp(-np.random.default_rng(seed).normal(shift, 1.0, n))))
    return theta if levels is None else (theta * levels).round() / levels


def area(occupied: Tensor, free: Tensor) -> float:
    truth = np.r_[np.ones(len(occupied)), np.zeros(len(free))]
    return float(roc_auc_score(truth, torch.cat([occupied, free]).numpy()))


@pytest.mark.parametrize("levels", [None, 10])
def test_auc_gain_matches_scikit_learn_and_a_bootstrap(levels):
    rng = np.random.default_rng(3)
    before = probabilities(400, 0.8, 0, levels), probabilities(600, -0.2, 1, levels)
    changes = (torch.from_numpy(rng.normal(0.05, 0.2, len(x))) for x in before)
    occupied, free = ((x + change).clamp(0, 1) for x, change in zip(before, changes, strict=True))
    found = auc_gain(before, (occupied, free))
    assert found.mean == pytest.approx(area(occupied, free) - area(*before), abs=1e-12)
    gains = []
    for _ in range(300):
        rows, columns = rng.integers(0, 400, 400), rng.integers(0, 600, 600)
        gains.append(area(occupied[rows], free[columns]) - area(before[0][rows], before[1][columns]))
    assert found.high - found.low == pytest.approx(2 * 1.96 * np.std(gains), rel=0.15)


def test_auc_gain_of_equal_answers_is_exactly_zero():
    same = probabilities(50, 0.8, 0), probabilities(60, -0.2, 1)
    assert auc_gain(same, same) == (0.0, 0.0, 0.0)

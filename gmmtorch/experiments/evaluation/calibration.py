"""Calibration of occupancy probabilities: of the points with θ = 0.7, are 70 % occupied?

All scores are relative to the test. The test has one hit and one free point for each beam, so half of its
points are occupied, while most of real space is free. Scores of two tests with different free points
(`evaluation.free=uniform` and `near_surface`) are not comparable.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.experiments.evaluation import queries
from gmmtorch.experiments.evaluation.queries import OCCUPIED
from gmmtorch.occupancy import N_BINS, Calibrator, CellClass, Prediction, Reliability, classify
from gmmtorch.scan import Scan

PRIORS = (0.1, 0.5, 1.0, 2.0, 5.0)
_BEAMS = 100  # of a scan whose prediction calibrates a map
_RAYS = 1e4  # that stand for a probability
VARIANCE_THRESHOLDS = (0.25, 0.2, 0.15, 0.1, 0.06, 0.03)


def reliability(theta: Tensor, labels: Tensor) -> Reliability:
    """Reliability curve of probabilities (M,) of points with labels (M,), 1 occupied and 0 free.

    Bins have equal widths. A bin contains its upper edge; the first bin also contains its lower edge.
    """
    truth, p = _checked(theta, labels)
    member = np.searchsorted(np.linspace(0, 1, N_BINS + 1)[1:-1], p)
    count = np.bincount(member)
    kept = count > 0
    sums = [np.bincount(member, weights)[kept] for weights in (p, truth)]
    return Reliability(sums[0] / count[kept], sums[1] / count[kept], count[kept])


def log_loss_bits(theta: Tensor, labels: Tensor) -> float:
    """Cross-entropy (bits per point) of labels (M,) under probabilities (M,); θ = ½ everywhere scores 1.

    Probabilities are clipped to [2⁻⁵², 1 − 2⁻⁵²], so one certain mistake costs 52 bits.
    """
    truth, p = _checked(theta, labels)
    least = 2.0**-52
    given = np.clip(np.where(truth == 1, p, 1 - p), least, 1 - least)
    return float(-np.log2(given).mean())


def accuracy(theta: Tensor, labels: Tensor) -> float:
    """Share of the points classified correctly with threshold ½; a point with θ = ½ counts one half."""
    truth, p = _checked(theta, labels)
    return float(np.where(p == 0.5, 0.5, (p > 0.5) == (truth == 1)).mean())


def brier_score(theta: Tensor, labels: Tensor) -> float:
    """Mean squared difference of probabilities (M,) and labels (M,); θ = ½ everywhere scores ¼."""
    truth, p = _checked(theta, labels)
    return float(np.square(p - truth).mean())


def scores(theta: Tensor, labels: Tensor) -> dict[str, float]:
    """`ece`, `brier`, `log_loss_bits` and `accuracy` of occupied and free points."""
    return {
        "ece": reliability(theta, labels).expected_error,
        "brier": brier_score(theta, labels),
        "log_loss_bits": log_loss_bits(theta, labels),
        "accuracy": accuracy(theta, labels),
    }


class SeenPredictions:
    """The calibration of a map that has none of its own: it learns as a `GaussianMap` does, from what the map
    says about some scans before it learns from them. side: of the map's cells (m)."""

    def __init__(self, side: float) -> None:
        self._side = side
        start = Calibrator.of(2 * side, 1)  # with these numbers the map's own probabilities, to start with
        self._calibrator = replace(start, mean=torch.zeros_like(start.mean))
        self._dim = 0

    def note(self, answer: Callable[[Tensor], Tensor], scan: Scan, seed: int) -> None:
        """Learns from a scan that the map, which answers with probabilities, has not learned from yet."""
        if not bool((scan.points != scan.origin).any()):
            return
        origins, ends = queries.test_beams([scan], _BEAMS, seed)
        asked = queries.hit_and_free(origins, ends, "uniform", self._side, seed)
        theta = answer(asked.points).cpu().double()
        seen = Prediction(*_counts(theta), asked.labels == OCCUPIED, self._side)
        self._dim = scan.dim
        self._calibrator = self._calibrator.updated([seen], scan.dim, farthest=math.inf)

    def calibrated(self, theta: Tensor) -> Tensor:
        """The calibrated probabilities (M,) where the map says theta (M,)."""
        if not self._dim:
            return theta
        found = self._calibrator.calibration
        return found.probability(*_counts(theta.double()), self._side, self._dim)


def _counts(theta: Tensor) -> tuple[Tensor, Tensor]:
    """Hits and misses that stand for a probability; none for ½ exactly."""
    n = _RAYS * (theta != 0.5)
    return n * theta, n * (1 - theta)


def prior_and_dead_band(
    theta_of: Callable[[float], Tensor],
    labels: Tensor,
    priors: Sequence[float] = PRIORS,
    variance_thresholds: Sequence[float] = VARIANCE_THRESHOLDS,
) -> list[dict[str, Any]]:
    """Effect of the prior count N_p and of the dead band (3.10): one row for each pair of both.

    Args:
        theta_of: returns the probabilities (M,) of one test for a prior count.
        labels: (M,), 1 occupied and 0 free.
        priors: counts N_p.
        variance_thresholds: v of the dead band; with 0.25 only θ = ½ is unknown.

    Rows have `prior, variance_threshold`; `ece, mce, brier, log_loss_bits, accuracy`, which do not depend on
    the dead band; `decided`, the share of the points classified as occupied or free; and
    `accuracy_decided`, the share of the decided points that are correct (None if no point is decided).
    """
    rows: list[dict[str, Any]] = []
    occupied = labels == OCCUPIED
    for prior in priors:
        theta = theta_of(prior).cpu()
        of_prior = {
            "prior": float(prior),
            **scores(theta, labels),
            "mce": reliability(theta, labels).maximum_error,
        }
        for threshold in variance_thresholds:
            called = classify(theta, threshold)
            decided = called != CellClass.UNKNOWN
            right = (called == CellClass.OCCUPIED) == occupied.cpu()
            rows.append(
                {
                    **of_prior,
                    "variance_threshold": float(threshold),
                    "decided": float(decided.double().mean()),
                    "accuracy_decided": float(right[decided].double().mean())
                    if bool(decided.any())
                    else None,
                }
            )
    return rows


def _checked(theta: Tensor, labels: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Labels and probabilities as float64; raises `InvalidArgumentError` for invalid ones."""
    p = torch.as_tensor(theta).detach().cpu().double().numpy()
    truth = torch.as_tensor(labels).detach().cpu().double().numpy()
    if p.ndim != 1 or p.shape != truth.shape or p.size == 0:
        raise InvalidArgumentError(
            f"theta has shape {p.shape} and labels {truth.shape}; both must be (M,) with M ≥ 1."
        )
    if not np.isin(truth, (0, 1)).all():
        raise InvalidArgumentError("labels must be 0, free, or 1, occupied; leave out unknown points.")
    if not ((p >= 0) & (p <= 1)).all():
        raise InvalidArgumentError("theta has values outside [0, 1], or NaN; give probabilities.")
    return truth, p

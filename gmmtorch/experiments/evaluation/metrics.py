"""Scores of occupancy probabilities, their calibration, and the distance of a mixture from its points."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.experiments.evaluation import queries
from gmmtorch.experiments.evaluation.queries import OCCUPIED
from gmmtorch.occupancy import N_BINS, Calibrator, Prediction, Reliability
from gmmtorch.scan import Scan

_BINS = 4096
_N_RESAMPLES = 1000
CALLED_FREE, CALLED_OCCUPIED = 0.2, 0.65
"""In `unknown_scores`, cells with θ below the first value are free, and above the second are occupied."""


class Roc(NamedTuple):
    """False and true positive rates (T,) at thresholds (T,), of which the first is infinite; and the area."""

    false_positive: np.ndarray
    true_positive: np.ndarray
    thresholds: np.ndarray
    auc: float

    @property
    def separating(self) -> float:
        """The θ that separates occupied from free points best: points with at least it count as occupied.

        The true minus the false positive rate is then largest (Youden 1950).
        """
        return float(self.thresholds[np.argmax(self.true_positive - self.false_positive)])


def roc(occupied: Tensor, free: Tensor) -> Roc:
    """ROC curve of the probabilities of occupied (P,) and free (Q,) points; ties count one half."""
    from sklearn.metrics import auc, roc_curve

    if occupied.numel() == 0 or free.numel() == 0:
        raise InvalidArgumentError("An ROC curve needs at least one occupied and one free point.")
    labels = np.concatenate([np.ones(occupied.numel()), np.zeros(free.numel())])
    false_positive, true_positive, thresholds = roc_curve(labels, torch.cat([occupied, free]).cpu().numpy())
    return Roc(false_positive, true_positive, thresholds, float(auc(false_positive, true_positive)))


def auc_interval(occupied: Tensor, free: Tensor, auc: float, seed: int) -> tuple[float, float]:
    """Bootstrap interval (95 %) of an AUC: occupied and free points are resampled with replacement.

    Resamples the counts of 4096 quantile bins, which are multinomial. The replicates are shifted so that
    their mean is the exact AUC.
    """
    generator = np.random.default_rng(seed)
    scores = torch.cat([occupied, free]).cpu().numpy()
    edges = np.unique(np.quantile(scores, np.linspace(0, 1, _BINS + 1)[1:-1]))
    share = [
        np.bincount(np.searchsorted(edges, x.cpu().numpy()), minlength=len(edges) + 1)
        for x in (free, occupied)
    ]
    below, above = (
        generator.multinomial(counts.sum(), counts / counts.sum(), _N_RESAMPLES) / counts.sum()
        for counts in share
    )
    replicates = (above * (np.cumsum(below, 1) - below / 2)).sum(1)
    low, high = np.quantile(replicates - replicates.mean(), [0.025, 0.975]) + auc
    return max(0.0, float(low)), min(1.0, float(high))


def auc_gain(before: tuple[Tensor, Tensor], after: tuple[Tensor, Tensor]) -> tuple[float, float, float]:
    """Difference of the AUCs of two classifiers of the same points, and the limits of its 95 % interval.

    Each argument has the probabilities of occupied (P,) and free (Q,) points. The variance is that of
    DeLong, DeLong & Clarke-Pearson (1988): of the differences of the points' shares of the AUC.
    """
    (occupied, free), (other_occupied, other_free) = _shares_of_auc(*before), _shares_of_auc(*after)
    up, down = other_occupied - occupied, other_free - free
    mean = float(up.mean())
    variance = float(up.var() / len(up) + down.var() / len(down))
    half = NormalDist().inv_cdf(0.975) * math.sqrt(variance)
    return mean, mean - half, mean + half


def _shares_of_auc(occupied: Tensor, free: Tensor) -> tuple[Tensor, Tensor]:
    """Share (P,) of free points below each occupied one, and (Q,) of occupied points above each free one."""

    def below(values: Tensor, others: Tensor) -> Tensor:
        ordered = others.double().sort().values
        ends = [torch.searchsorted(ordered, values.double(), right=right) for right in (False, True)]
        return (ends[0] + ends[1]).double() / (2 * len(ordered))

    return below(occupied, free), 1 - below(free, occupied)


def unknown_scores(unknown: Tensor, free: Tensor) -> dict[str, float | None]:
    """Scores of unknown points (U,) against free points (Q,), given their probabilities.

    unknown_auc: AUC of classifying unknown points by |θ − ½|. unknown_called_free, unknown_called_occupied:
    shares of the unknown points. These three are None without unknown points. free_recall: share of the free
    points classified as free.
    """
    some = unknown.numel() > 0
    return {
        "free_recall": float((free < CALLED_FREE).double().mean()),
        "unknown_auc": roc(-(unknown - 0.5).abs(), -(free - 0.5).abs()).auc if some else None,
        "unknown_called_free": float((unknown < CALLED_FREE).double().mean()) if some else None,
        "unknown_called_occupied": float((unknown > CALLED_OCCUPIED).double().mean()) if some else None,
    }


def psnr_terms(points: Tensor, sampled: Tensor) -> tuple[float, float]:
    """20 log₁₀(B/RMSE(X, X̂)) and 20 log₁₀(B/RMSE(X̂, X)) in dB, for points X (N, D) and samples X̂ (M, D).

    The first term, forward, is low if the model misses part of the cloud, the second, backward, if it has
    samples outside the cloud. B is the diagonal of the bounding box of X, and RMSE that of nearest-neighbour
    distances. A term is infinite if all these distances are zero.
    """
    from scipy.spatial import cKDTree

    x, y = points.cpu().numpy(), sampled.cpu().numpy()
    diagonal = float(np.linalg.norm(x.max(0) - x.min(0)))
    terms = []
    for one, other in ((x, y), (y, x)):
        error = math.sqrt(float((cKDTree(other).query(one)[0] ** 2).mean()))
        if error == 0:
            terms.append(math.inf)
        else:
            terms.append(20 * math.log10(diagonal / error) if diagonal > 0 else -math.inf)
    return terms[0], terms[1]


def psnr2(points: Tensor, sampled: Tensor) -> float:
    """PSNR2 (2.10) in dB of a cloud (N, D) and as many samples (N, D) of its model.

    It is the sum of the terms of `psnr_terms`, and infinite if one of them is.
    """
    terms = psnr_terms(points, sampled)
    return math.inf if math.inf in terms else sum(terms)


_BEAMS = 100  # of a scan whose prediction calibrates a map
_RAYS = 1e4  # that stand for a probability


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


def scores(theta: Tensor, labels: Tensor) -> dict[str, float]:
    """Scores of probabilities (M,) of points with labels (M,), 1 occupied and 0 free.

    ece: expected calibration error. brier: mean squared difference. log_loss_bits: cross-entropy (bits per
    point), of probabilities clipped to [2⁻⁵², 1 − 2⁻⁵²]: a certain mistake costs 52 bits. accuracy: share
    of the points that the threshold ½ classifies correctly; a point with θ = ½ counts one half.
    """
    truth, p = _checked(theta, labels)
    least = 2.0**-52
    given = np.clip(np.where(truth == 1, p, 1 - p), least, 1 - least)
    return {
        "ece": reliability(theta, labels).expected_error,
        "brier": float(np.square(p - truth).mean()),
        "log_loss_bits": float(-np.log2(given).mean()),
        "accuracy": float(np.where(p == 0.5, 0.5, (p > 0.5) == (truth == 1)).mean()),
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

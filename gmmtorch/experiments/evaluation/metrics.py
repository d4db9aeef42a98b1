"""Scores of occupancy probabilities, and of a mixture against a point cloud."""

from __future__ import annotations

import math
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.team.exploration import Interval

_BINS = 4096
_N_RESAMPLES = 1000
CALLED_FREE, CALLED_OCCUPIED = 0.2, 0.65
"""In `unknown_scores`, cells with θ below the first value are free, and above the second are occupied."""


class Roc(NamedTuple):
    """false_positive (T,), true_positive (T,): the ROC curve; auc: the area under it."""

    false_positive: np.ndarray
    true_positive: np.ndarray
    auc: float


def roc(occupied: Tensor, free: Tensor) -> Roc:
    """ROC curve of the probabilities of occupied (P,) and free (Q,) points; ties count one half."""
    from sklearn.metrics import auc

    false_positive, true_positive, _ = _roc_curve(occupied, free)
    return Roc(false_positive, true_positive, float(auc(false_positive, true_positive)))


def separating_threshold(occupied: Tensor, free: Tensor) -> float:
    """The θ that separates occupied (P,) from free (Q,) points best.

    Points with at least this probability count as occupied; the true minus the false positive rate is then
    largest (Youden 1950).
    """
    false_positive, true_positive, thresholds = _roc_curve(occupied, free)
    return float(thresholds[np.argmax(true_positive - false_positive)])


def _roc_curve(occupied: Tensor, free: Tensor) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """False and true positive rates (T,) at thresholds (T,), of which the first is infinite."""
    from sklearn.metrics import roc_curve

    if occupied.numel() == 0 or free.numel() == 0:
        raise InvalidArgumentError("An ROC curve needs at least one occupied and one free point.")
    labels = np.concatenate([np.ones(occupied.numel()), np.zeros(free.numel())])
    scores = torch.cat([occupied, free]).cpu().numpy()
    false_positive, true_positive, thresholds = roc_curve(labels, scores)
    return false_positive, true_positive, thresholds


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


def auc_gain(before: tuple[Tensor, Tensor], after: tuple[Tensor, Tensor]) -> Interval:
    """Difference of the AUCs of two classifiers of the same points, with its 95 % interval.

    Each argument has the probabilities of occupied (P,) and free (Q,) points. The variance is that of
    DeLong, DeLong & Clarke-Pearson (1988): of the differences of the points' shares of the AUC.
    """
    (occupied, free), (other_occupied, other_free) = _shares_of_auc(*before), _shares_of_auc(*after)
    up, down = other_occupied - occupied, other_free - free
    mean = float(up.mean())
    variance = float(up.var() / len(up) + down.var() / len(down))
    half = NormalDist().inv_cdf(0.975) * math.sqrt(variance)
    return Interval(mean, mean - half, mean + half)


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
    recall = float((free < CALLED_FREE).double().mean())
    if unknown.numel() == 0:
        names = ("unknown_auc", "unknown_called_free", "unknown_called_occupied")
        return {**dict.fromkeys(names), "free_recall": recall}
    return {
        "unknown_auc": roc(-(unknown - 0.5).abs(), -(free - 0.5).abs()).auc,
        "unknown_called_free": float((unknown < CALLED_FREE).double().mean()),
        "unknown_called_occupied": float((unknown > CALLED_OCCUPIED).double().mean()),
        "free_recall": recall,
    }


class Psnr(NamedTuple):
    """The two terms of PSNR2 (dB).

    forward: from each point to the nearest sample; low if the model misses part of the cloud.
    backward: from each sample to the nearest point; low if the model has samples outside the cloud.
    """

    forward: float
    backward: float


def psnr_terms(points: Tensor, sampled: Tensor) -> Psnr:
    """20 log₁₀(B/RMSE(X, X̂)) and 20 log₁₀(B/RMSE(X̂, X)) in dB, for points X (N, D) and samples X̂ (M, D).

    B is the diagonal of the bounding box of X; RMSE is taken over nearest-neighbour distances. A term is
    infinite if all these distances are zero.
    """
    x, y = points.cpu().numpy(), sampled.cpu().numpy()
    diagonal = float(np.linalg.norm(x.max(0) - x.min(0)))
    return Psnr(_psnr(cKDTree(y).query(x)[0], diagonal), _psnr(cKDTree(x).query(y)[0], diagonal))


def _psnr(distances: np.ndarray, diagonal: float) -> float:
    error = math.sqrt(float((distances**2).mean()))
    if error == 0:
        return math.inf
    return 20 * math.log10(diagonal / error) if diagonal > 0 else -math.inf


def psnr2(points: Tensor, sampled: Tensor) -> float:
    """PSNR2 (2.10) in dB of a cloud (N, D) and as many samples (N, D) of its model.

    It is the sum of the terms of `psnr_terms`, and infinite if one of them is.
    """
    terms = psnr_terms(points, sampled)
    return math.inf if math.inf in terms else sum(terms)

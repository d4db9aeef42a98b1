"""Calibration: whether what is called 70 % occupied is occupied 70 times in a hundred.

All of it is relative to the test: one hit and one free point a beam, half of all points occupied,
where most of space is free. A map that is calibrated here is calibrated for places as likely occupied
as not; scores of two tests (`evaluation.free=uniform` and `near_surface`, say) are not comparable.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, check_whole
from gmmtorch.evaluation.queries import OCCUPIED
from gmmtorch.occupancy.evidence import CellClass, classify

Binning = Literal["width", "count"]
N_BINS = 15
"""Bins of the expected calibration error, of equal width, as in Guo et al. 2017."""

PRIORS = (0.1, 0.5, 1.0, 2.0, 5.0)
VARIANCE_THRESHOLDS = (0.25, 0.2, 0.15, 0.1, 0.06, 0.03)


class Reliability(NamedTuple):
    """A reliability curve: of each bin that is not empty (B,), in order of θ,

    predicted: mean θ of its points; observed: share of them that is occupied; n_points: how many they are.
    """

    predicted: np.ndarray
    observed: np.ndarray
    n_points: np.ndarray

    @property
    def expected_error(self) -> float:
        """Expected calibration error: mean |observed − predicted| over the points."""
        return float(self._gap() @ self.n_points / self.n_points.sum())

    @property
    def maximum_error(self) -> float:
        """Maximum calibration error: the largest |observed − predicted| of a bin."""
        return float(self._gap().max())

    def _gap(self) -> np.ndarray:
        return np.abs(self.observed - self.predicted)


def reliability(
    theta: Tensor, labels: Tensor, n_bins: int = N_BINS, binning: Binning = "width"
) -> Reliability:
    """Reliability curve of probabilities (M,) of points with labels (M,), 1 occupied and 0 free.

    Bins are of equal width, or hold equally many points ("count"; equal θ are never parted, so ties
    make fewer bins). A bin holds its upper edge, and the first its lower one too.
    """
    truth, p = _checked(theta, labels)
    member = _bins(p, n_bins, binning)
    count = np.bincount(member)
    kept = count > 0
    sums = [np.bincount(member, weights)[kept] for weights in (p, truth)]
    return Reliability(sums[0] / count[kept], sums[1] / count[kept], count[kept])


class BrierParts(NamedTuple):
    """brier = reliability − resolution + uncertainty + within (Murphy 1973; Stephenson et al. 2008).

    reliability: mean squared gap of observed and predicted, 0 is calibrated; resolution: how far the
    bins' shares differ from the overall one, as large as can be is best; uncertainty: variance of the
    labels, ¼ for a balanced test; within: what θ varies inside a bin, less what that explains.
    """

    brier: float
    reliability: float
    resolution: float
    uncertainty: float
    within: float


def brier_parts(
    theta: Tensor, labels: Tensor, n_bins: int = N_BINS, binning: Binning = "width"
) -> BrierParts:
    """The Brier score of probabilities (M,) of points with labels (M,), taken apart by bins."""
    truth, p = _checked(theta, labels)
    member = _bins(p, n_bins, binning)
    count = np.maximum(np.bincount(member), 1)  # an empty bin has no member to ask for its mean
    predicted, observed = (np.bincount(member, values)[member] / count[member] for values in (p, truth))
    spread, explained = p - predicted, truth - observed
    return BrierParts(
        brier=float(np.mean((p - truth) ** 2)),
        reliability=float(np.mean((predicted - observed) ** 2)),
        resolution=float(np.mean((observed - truth.mean()) ** 2)),
        uncertainty=float(truth.mean() * (1 - truth.mean())),
        within=float(np.mean(spread**2) - 2 * np.mean(spread * explained)),
    )


def log_loss_bits(theta: Tensor, labels: Tensor) -> float:
    """Cross-entropy of labels (M,) under probabilities (M,), bits a point: 1 is knowing nothing.

    Probabilities are kept 2⁻⁵² away from 0 and 1, so that one certain mistake costs 52 bits.
    """
    truth, p = _checked(theta, labels)
    least = 2.0**-52
    given = np.clip(np.where(truth == 1, p, 1 - p), least, 1 - least)
    return float(-np.log2(given).mean())


def accuracy(theta: Tensor, labels: Tensor) -> float:
    """Share of the points called rightly at ½; one of exactly ½ is half right, as if by tossing a coin."""
    truth, p = _checked(theta, labels)
    return float(np.where(p == 0.5, 0.5, (p > 0.5) == (truth == 1)).mean())


def scores(theta: Tensor, labels: Tensor) -> dict[str, float]:
    """`ece`, `log_loss_bits` and `accuracy`, of points that are occupied or free."""
    return {
        "ece": reliability(theta, labels).expected_error,
        "log_loss_bits": log_loss_bits(theta, labels),
        "accuracy": accuracy(theta, labels),
    }


def prior_and_dead_band(
    theta_of: Callable[[float], Tensor],
    labels: Tensor,
    priors: Sequence[float] = PRIORS,
    variance_thresholds: Sequence[float] = VARIANCE_THRESHOLDS,
) -> list[dict[str, Any]]:
    """What the prior count N_p and the dead band of (3.10) do, as a row for each pair of the two.

    Args:
        theta_of: probabilities (M,) under a prior count, of one test.
        labels: (M,), 1 occupied and 0 free.
        priors: counts N_p.
        variance_thresholds: v of the dead band; 0.25 leaves none but exactly ½.

    Rows have `prior, variance_threshold`; `ece, mce, brier, log_loss_bits, accuracy`, which the dead
    band does not enter; `decided`, the share of the points called occupied or free, and
    `accuracy_decided`, the share of those called rightly (None if there are none).
    """
    rows: list[dict[str, Any]] = []
    occupied = labels == OCCUPIED
    for prior in priors:
        theta = theta_of(prior).cpu()
        curve = reliability(theta, labels)
        common = {
            "prior": float(prior),
            "ece": curve.expected_error,
            "mce": curve.maximum_error,
            "brier": brier_parts(theta, labels).brier,
            "log_loss_bits": log_loss_bits(theta, labels),
            "accuracy": accuracy(theta, labels),
        }
        for threshold in variance_thresholds:
            called = classify(theta, threshold)
            decided = called != CellClass.UNKNOWN
            right = (called == CellClass.OCCUPIED) == occupied.cpu()
            rows.append(
                {
                    **common,
                    "variance_threshold": float(threshold),
                    "decided": float(decided.double().mean()),
                    "accuracy_decided": float(right[decided].double().mean())
                    if bool(decided.any())
                    else None,
                }
            )
    return rows


def _checked(theta: Tensor, labels: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Labels and probabilities, float64; raises `InvalidArgumentError` for what is neither."""
    p = torch.as_tensor(theta).detach().cpu().double().numpy()
    truth = torch.as_tensor(labels).detach().cpu().double().numpy()
    if p.ndim != 1 or p.shape != truth.shape or p.size == 0:
        raise InvalidArgumentError(
            f"theta has shape {p.shape} and labels {truth.shape}; both must be (M,), of one point at least."
        )
    if not np.isin(truth, (0, 1)).all():
        raise InvalidArgumentError("labels must be 0, free, or 1, occupied; leave out unknown points.")
    if not ((p >= 0) & (p <= 1)).all():
        raise InvalidArgumentError("theta holds values outside [0, 1], or NaN; give probabilities.")
    return truth, p


def _bins(p: np.ndarray, n_bins: int, binning: Binning) -> np.ndarray:
    """Bin (M,) of each probability: bins hold their upper edges."""
    check_whole("n_bins", n_bins, 1)
    if binning not in get_args(Binning):
        raise InvalidArgumentError(f"binning={binning!r} is not one of {', '.join(get_args(Binning))}.")
    share = np.linspace(0, 1, n_bins + 1)[1:-1]
    edges = share if binning == "width" else np.quantile(p, share)
    return np.searchsorted(edges, p)

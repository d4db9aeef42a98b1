"""Reliability of predicted probabilities: of the cells predicted with θ = 0.7, are 70 % occupied?"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

_FEWEST = 20  # predictions of a bin; fewer show little but chance


class Reliability(NamedTuple):
    """A reliability curve: one entry for each non-empty bin (B,), in order of θ.

    predicted: mean θ of the bin's points; observed: share of them that is occupied; n_points: their number.
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


def reliability_of(tally: Tensor) -> Reliability:
    """Reliability curve of a tally (15, 6) of predictions, see `occupancy.calibrator.Calibrator`.

    Neighbouring bins are pooled until they hold 20 predictions; the last one may have fewer.
    """
    before = tally[:, 0].cumsum(0) - tally[:, 0]
    pool = torch.unique((before / _FEWEST).floor(), return_inverse=True)[1]
    pooled = torch.zeros_like(tally).index_add(0, pool, tally)
    count, predicted, observed = pooled[pooled[:, 0] > 0, :3].T.numpy()
    return Reliability(predicted / count, observed / count, count)


def scores_of(tally: Tensor) -> dict[str, float]:
    """`scores` of a tally (15, 6) of at least one prediction."""
    brier, log_loss, right = (tally[:, 3:].sum(0) / tally[:, 0].sum()).tolist()
    ece = reliability_of(tally).expected_error
    return {"ece": ece, "brier": brier, "log_loss_bits": log_loss, "accuracy": right}

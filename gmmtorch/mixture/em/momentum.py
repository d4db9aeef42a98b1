"""Momentum: M-steps that go on in the direction of the last ones."""

from __future__ import annotations

import torch
from torch import Tensor

from gmmtorch.mixture.em.exact import Parameters, maximization, shift_features


class Momentum:
    """M-steps that go on in the direction of the last ones (Nesterov's schedule, on the statistics).

    The statistics of the new parameters are those of EM plus a share of their change, for the
    components whose mass and thinnest direction do not suffer by it; the others take EM's own.
    """

    def __init__(self, reg_covar: float) -> None:
        self._reg_covar = reg_covar
        self._age = 0
        self._last: tuple[Tensor, Tensor] | None = None  # statistics, and the means they are about
        self._plain: Parameters | None = None
        self.is_moving = False

    def step(self, statistics: Tensor, parameters: Parameters) -> Parameters:
        """The next parameters, from statistics (K, F) about the means of those they were taken at."""
        plain = _moved(maximization(statistics, self._reg_covar, _centered(parameters)), parameters.means)
        last, self._last = self._last, (statistics, parameters.means)
        self._plain = plain
        self.is_moving = False
        if last is None:
            return plain
        share = self._age / (self._age + 3)
        self._age += 1
        if share == 0:
            return plain
        before = shift_features(last[0], last[1] - parameters.means)
        ahead = statistics + share * (statistics - before)
        trusted = ahead[:, 0] > 0.2 * statistics[:, 0]
        ahead = torch.where(trusted[:, None], ahead, statistics)
        moved = _moved(maximization(ahead, self._reg_covar, _centered(parameters)), parameters.means)
        thickness, plain_thickness = (torch.linalg.eigvalsh(p.covariances)[:, 0] for p in (moved, plain))
        trusted &= thickness > 0.3 * plain_thickness
        self.is_moving = True
        weights = torch.where(trusted, moved.weights, plain.weights)
        return Parameters(
            weights / weights.sum(),
            torch.where(trusted[:, None], moved.means, plain.means),
            torch.where(trusted[:, None, None], moved.covariances, plain.covariances),
        )

    def undo(self) -> Parameters:
        """EM's own parameters of the last step; the momentum starts anew."""
        assert self._plain is not None
        self._last, self._age, self.is_moving = None, 0, False
        return self._plain


def _centered(parameters: Parameters) -> Parameters:
    return Parameters(parameters.weights, torch.zeros_like(parameters.means), parameters.covariances)


def _moved(parameters: Parameters, means: Tensor) -> Parameters:
    return Parameters(parameters.weights, parameters.means + means, parameters.covariances)

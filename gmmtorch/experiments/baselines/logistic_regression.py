"""Logistic regression on features of the position: by stochastic gradients, and by variational inference.

The first is the learning of Hilbert maps, the second that of Bayesian Hilbert maps.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import torch
from torch import Tensor

from gmmtorch.experiments.baselines.hilbert_features import DenseDesign, LatticeDesign

_CONJUGATE_STEPS = 10  # each step lowers the error, and each round starts from the last round's mean

Design = DenseDesign | LatticeDesign
Covariance = Literal["diagonal", "mean_field", "full"]


# -- stochastic gradients ---------------------------------------------------------------------------


def logistic_regression(
    design: Design,
    is_hit: Tensor,
    weights: Tensor,
    *,
    alpha: float,
    l1_ratio: float,
    epochs: int,
    batch_size: int,
    learning_rate: float,
    generator: torch.Generator,
) -> Tensor:
    """Weights w (F,), float64, that minimize a loss by stochastic gradients from initial `weights` w₀.

        Σ ln(1 + exp(−y wᵀφ)) + α (ρ‖w − w₀‖₁ + ½(1 − ρ)‖w − w₀‖²),   y = ±1, ρ = l1_ratio

    Ramos & Ott 2016, (6), with an elastic net. The penalty applies to the change from the initial weights, so
    that an earlier map is not forgotten.

    Each batch makes one composite step of AdaGrad (Duchi, Hazan & Singer 2011). Every weight has its own
    step size, which features with few points need. Soft thresholds apply the L1 term exactly. The loss is
    divided by the number of points, so that step sizes do not depend on it.
    """
    n = is_hit.shape[0]
    labels = is_hit.double()
    change, squares = torch.zeros_like(weights), torch.zeros_like(weights)
    l1, l2 = alpha * l1_ratio / n, alpha * (1 - l1_ratio) / n
    for _ in range(epochs):
        order = torch.randperm(n, generator=generator).to(is_hit.device)
        for batch in order.split(batch_size):
            rows = design.rows(batch)
            residual = torch.sigmoid(rows.dot(weights + change)) - labels[batch]
            gradient = rows.transpose_dot(residual) / batch.shape[0] + l2 * change
            squares += gradient.square()
            step = learning_rate / squares.sqrt().clamp_min(1e-12)
            change = change - step * gradient
            change = change.sign() * (change.abs() - step * l1).clamp_min(0)
    return weights + change


# -- variational inference --------------------------------------------------------------------------


@dataclass(frozen=True)
class Posterior:
    """Normal distribution of F weights: mean (F,), float64; precision (F,) if diagonal, else (F, F)."""

    mean: Tensor
    precision: Tensor

    @property
    def is_full(self) -> bool:
        return self.precision.ndim == 2

    @cached_property
    def factor(self) -> Tensor:
        """Lower Cholesky factor (F, F) of a full precision."""
        return torch.linalg.cholesky(self.precision)

    @classmethod
    def from_factor(cls, mean: Tensor, factor: Tensor) -> Posterior:
        """The posterior of a full precision with a known Cholesky factor (F, F)."""
        made = cls(mean, factor @ factor.mT)
        made.__dict__["factor"] = factor  # the cached property
        return made


def jaakkola_lambda(xi: Tensor) -> Tensor:
    """λ(ξ) = tanh(ξ/2)/4ξ for ξ ≥ 0, ⅛ at zero: the curvature of Jaakkola & Jordan's bound at ξ."""
    return torch.where(xi > 1e-4, (0.5 * xi).tanh() / (4 * xi).clamp_min(1e-300), 0.125)


def moments(design: LatticeDesign, posterior: Posterior) -> tuple[Tensor, Tensor]:
    """Mean and variance (M,) of wᵀφ(x)."""
    mean = design.dot(posterior.mean)
    if not posterior.is_full:
        return mean, design.dot_squared(1 / posterior.precision)
    solved = torch.linalg.solve_triangular(posterior.factor, design.dense().mT, upper=False)
    return mean, solved.square().sum(0)


def moderated(mean: Tensor, variance: Tensor) -> Tensor:
    """σ(m/√(1 + πv/8)) ≈ E[σ(a)] for a ~ N(m, v): MacKay 1992."""
    return torch.sigmoid(mean / (1 + math.pi / 8 * variance).sqrt())


def variational_step(
    design: LatticeDesign,
    is_hit: Tensor,
    prior: Posterior,
    xi: Tensor,
    covariance: Covariance,
    start: Tensor | None = None,
) -> Posterior:
    """The posterior for given ξ (M,) from the prior and the labelled points.

    precision = prior's + 2 Σ λ(ξ) φφᵀ; the mean m solves precision · m = prior's · m₀ + Σ (y − ½) φ.
    "full" computes exactly that. "mean_field" is the best normal distribution with independent weights: the
    same mean, and the diagonal of that precision. "diagonal" is the authors' fast form: it also ignores the
    off-diagonal entries in the equation of the mean, as if features did not overlap.

    `start` (F,) is an initial guess of the mean; default the prior's mean.
    """
    curvature = 2 * jaakkola_lambda(xi)
    pull = design.transpose_dot(is_hit.double() - 0.5)
    if prior.is_full:
        phi = design.dense()
        precision = prior.precision + phi.mT @ (phi * curvature[:, None])
        right = prior.precision @ prior.mean + pull
        mean = torch.cholesky_solve(right[:, None], torch.linalg.cholesky(precision))[:, 0]
        return Posterior(mean, precision)
    precision = prior.precision + design.transpose_dot_squared(curvature)
    right = prior.precision * prior.mean + pull
    if covariance == "diagonal":
        return Posterior(right / precision, precision)

    def times(x: Tensor) -> Tensor:
        return prior.precision * x + design.transpose_dot(curvature * design.dot(x))

    start = prior.mean if start is None else start
    return Posterior(_conjugate_gradients(times, right, start, precision), precision)


def _conjugate_gradients(
    times: Callable[[Tensor], Tensor], right: Tensor, start: Tensor, diagonal: Tensor
) -> Tensor:
    """x of A x = right for positive definite A, by conjugate gradients preconditioned with A's diagonal."""
    x = start
    residual = right - times(x)
    preconditioned = residual / diagonal
    direction, power = preconditioned, residual @ preconditioned
    goal = 1e-10 * float(right @ (right / diagonal))
    for _ in range(_CONJUGATE_STEPS):
        if float(power) <= goal:
            break
        image = times(direction)
        step = power / (direction @ image)
        x, residual = x + step * direction, residual - step * image
        preconditioned = residual / diagonal
        power, previous = residual @ preconditioned, power
        direction = preconditioned + power / previous * direction
    return x


def fit_posterior(
    design: LatticeDesign, is_hit: Tensor, prior: Posterior, covariance: Covariance, n_iter: int
) -> Posterior:
    """The posterior after `n_iter` rounds from ξ = 1; each updates the weights, then ξ."""
    xi = torch.ones(is_hit.shape[0], dtype=torch.float64, device=is_hit.device)
    posterior = prior
    for _ in range(n_iter):
        posterior = variational_step(design, is_hit, prior, xi, covariance, posterior.mean)
        mean, variance = moments(design, posterior)
        xi = (mean.square() + variance).sqrt()
    return posterior

"""Moment-preserving merges of components, and what a merge costs.

A merged component keeps the total weight, mean and covariance of its members. The cost of merging a
pair is a bound on the divergence that the merge causes, or a distance between the two components.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.linalg import safe_cholesky
from gmmtorch.mixture.em.exact import Parameters


def merge_components(
    weights: Tensor, means: Tensor, covariances: Tensor, labels: Tensor, n: int
) -> Parameters:
    """Merge each group of components into one component.

    w = Σ w_i, μ = Σ w_i μ_i / w and Σ = Σ (w_i/w)(Σ_i + (μ_i − μ)(μ_i − μ)ᵀ). The mean and covariance
    of the whole mixture do not change.

    Args:
        weights: (K,), not negative; they need not add up to one, so supports (points) are allowed.
            If all weights of a group are zero, its members count equally.
        means, covariances: (K, D), (K, D, D).
        labels: (K,) whole numbers, the group of each component.
        n: number of groups.

    Raises:
        InvalidArgumentError: labels outside 0 … n − 1, or an empty group.
    """
    if labels.shape != weights.shape or (
        labels.numel() and not 0 <= int(labels.min()) <= int(labels.max()) < n
    ):
        raise InvalidArgumentError(
            f"labels has shape {tuple(labels.shape)}; expected one whole number of 0 … n − 1 = {n - 1} for "
            f"each of {weights.shape[0]} components."
        )
    members = torch.bincount(labels, minlength=n)
    if bool((members == 0).any()):
        raise InvalidArgumentError(
            f"labels leaves {int((members == 0).sum())} of n={n} groups empty; number them without gaps."
        )
    total = weights.new_zeros(n).index_add_(0, labels, weights)
    share = torch.where(total[labels] > 0, weights / total[labels], 1 / members[labels])
    mean = means.new_zeros(n, means.shape[1]).index_add_(0, labels, share[:, None] * means)
    offset = means - mean[labels]
    scatter = share[:, None, None] * (covariances + offset[:, :, None] * offset[:, None, :])
    covariance = torch.zeros_like(covariances[:n]).index_add_(0, labels, scatter)
    return Parameters(total, mean, covariance)


def merge_pairs(first: Parameters, second: Parameters) -> Parameters:
    """Merge each component of `first` (P of them) with the component of `second` in the same row.

    Without cancellation: with a = w₁/w and b = w₂/w, Σ = a Σ₁ + b Σ₂ + ab (μ₁ − μ₂)(μ₁ − μ₂)ᵀ. If both
    weights are zero, both components count equally.
    """
    weight = first.weights + second.weights
    b = torch.where(weight > 0, second.weights / weight, 0.5)[:, None]
    offset = second.means - first.means
    mean = first.means + b * offset
    scatter = (1 - b)[:, None] * b[:, None] * offset[:, :, None] * offset[:, None, :]
    return Parameters(
        weight, mean, (1 - b)[:, None] * first.covariances + b[:, None] * second.covariances + scatter
    )


# -- costs ------------------------------------------------------------------------------------------


class Gaussians(NamedTuple):
    """Weighted Gaussians (K,) with ½ log|Σ| (K,) of each, which the costs use repeatedly."""

    weights: Tensor
    means: Tensor
    covariances: Tensor
    half_log_dets: Tensor

    @classmethod
    def of(cls, parameters: Parameters) -> Gaussians:
        return cls(*parameters, _half_log_det(safe_cholesky(parameters.covariances)))

    def at(self, index: Tensor | slice) -> Gaussians:
        return Gaussians(*(value[index] for value in self))

    def merged(self, other: Gaussians) -> Gaussians:
        """Each component merged with the one in the same row of `other`."""
        return Gaussians.of(merge_pairs(Parameters(*self[:3]), Parameters(*other[:3])))


def _half_log_det(factors: Tensor) -> Tensor:
    return factors.diagonal(dim1=-2, dim2=-1).log().sum(-1)


Cost = Callable[[Gaussians, Gaussians], Tensor]
"""Cost (P,) of merging P components with P others, row by row; either side may be a single component."""


def kullback_leibler_bound(first: Gaussians, second: Gaussians) -> Tensor:
    """Runnalls' bound B = ½ [(w₁+w₂) log|Σ| − w₁ log|Σ₁| − w₂ log|Σ₂|], Σ of the merged pair, (P,).

    B is an upper bound of w KL(p‖q), with p the mixture (of total weight w) before the merge and q the
    mixture after it. The unit is nats per point if weights add up to one, and nats if weights are
    supports in points. The bounds of successive merges add up to a bound for all of them.
    Source: Runnalls, IEEE Trans. AES 43(3), 2007.
    """
    half_log_det = first.merged(second).half_log_dets
    cost = first.weights * (half_log_det - first.half_log_dets)
    return (cost + second.weights * (half_log_det - second.half_log_dets)).clamp_min(0)


def squared_hellinger(first: Gaussians, second: Gaussians) -> Tensor:
    """H² = 1 − |Σ₁|^¼ |Σ₂|^¼ |Σ|^−½ exp(−⅛ (μ₁−μ₂)ᵀ Σ⁻¹ (μ₁−μ₂)), Σ = ½(Σ₁+Σ₂), (P,).

    0 for equal Gaussians, 1 for Gaussians without overlap. Weights have no effect.
    """
    factors = safe_cholesky((first.covariances + second.covariances) / 2)
    offset = (first.means - second.means)[:, :, None]
    squared = torch.linalg.solve_triangular(factors, offset, upper=False).square().sum((1, 2))
    log_overlap = (first.half_log_dets + second.half_log_dets) / 2 - _half_log_det(factors) - squared / 8
    return -torch.expm1(log_overlap.clamp_max(0))


COSTS: dict[str, Cost] = {"kullback_leibler": kullback_leibler_bound, "hellinger": squared_hellinger}

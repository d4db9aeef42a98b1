"""Moment-preserving merges: what becomes one component keeps its weight, mean and covariance."""

from __future__ import annotations

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.mixture.em.exact import Parameters


def merge_components(
    weights: Tensor, means: Tensor, covariances: Tensor, labels: Tensor, n: int
) -> Parameters:
    """One component for each group of components: w = Σ w_i, μ = Σ w_i μ_i / w and
    Σ = Σ (w_i/w)(Σ_i + (μ_i − μ)(μ_i − μ)ᵀ), so the mixture's mean and covariance stay what they were.

    Args:
        weights: (K,), not negative; supports in points will do, they need not add up to one. In a
            group without weight all members count alike.
        means, covariances: (K, D), (K, D, D).
        labels: (K,) whole numbers, the group of each component.
        n: number of groups.

    Raises:
        InvalidArgumentError: labels outside 0 … n − 1, or a group without a member.
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
    """Each component of `first` (P of them) merged with the one of `second` in the same row.

    Free of cancellation: with a = w₁/w and b = w₂/w, Σ = a Σ₁ + b Σ₂ + ab (μ₁ − μ₂)(μ₁ − μ₂)ᵀ. Where
    neither has weight, both count alike.
    """
    weight = first.weights + second.weights
    b = torch.where(weight > 0, second.weights / weight, 0.5)[:, None]
    offset = second.means - first.means
    mean = first.means + b * offset
    scatter = (1 - b)[:, None] * b[:, None] * offset[:, :, None] * offset[:, None, :]
    return Parameters(
        weight, mean, (1 - b)[:, None] * first.covariances + b[:, None] * second.covariances + scatter
    )

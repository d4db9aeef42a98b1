"""What merging two components costs: a bound on the divergence it causes, or how little they overlap."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.linalg import safe_cholesky
from gmmtorch.mixture.em.exact import Parameters
from gmmtorch.mixture.reduction.moments import merge_pairs


class Gaussians(NamedTuple):
    """Weighted Gaussians (K,) and ½ log|Σ| (K,) of each, which costs ask for again and again."""

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
"""From P components, and P others, or one for all, to what merging each pair costs, (P,)."""


def kullback_leibler_bound(first: Gaussians, second: Gaussians) -> Tensor:
    """Runnalls' B = ½ [(w₁+w₂) log|Σ| − w₁ log|Σ₁| − w₂ log|Σ₂|], Σ that of the merged pair, (P,).

    It bounds w KL(p‖q) from above, p the mixture (of total weight w) before the merge, q after it:
    nats a point where weights add up to one, nats where they are supports in points. The bounds of
    successive merges add up to one on all of them.
    """
    half_log_det = first.merged(second).half_log_dets
    cost = first.weights * (half_log_det - first.half_log_dets)
    return (cost + second.weights * (half_log_det - second.half_log_dets)).clamp_min(0)


def squared_hellinger(first: Gaussians, second: Gaussians) -> Tensor:
    """H² = 1 − |Σ₁|^¼ |Σ₂|^¼ |Σ|^−½ exp(−⅛ (μ₁−μ₂)ᵀ Σ⁻¹ (μ₁−μ₂)), Σ = ½(Σ₁+Σ₂), (P,).

    From 0, the same Gaussian, to 1, no overlap; weights do not matter.
    """
    factors = safe_cholesky((first.covariances + second.covariances) / 2)
    offset = (first.means - second.means)[:, :, None]
    squared = torch.linalg.solve_triangular(factors, offset, upper=False).square().sum((1, 2))
    log_overlap = (first.half_log_dets + second.half_log_dets) / 2 - _half_log_det(factors) - squared / 8
    return -torch.expm1(log_overlap.clamp_max(0))


COSTS: dict[str, Cost] = {"kullback_leibler": kullback_leibler_bound, "hellinger": squared_hellinger}

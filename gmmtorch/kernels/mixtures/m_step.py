"""M-step of EM (2.4)-(2.6) with its extrapolation, and natural parameters; the twins are in `mixture.em`.

One item is one component. The results differ from the twins' by rounding: by at most 10⁻¹² of the largest
entry of a component, and for natural parameters by this times the condition number of its covariance.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gmmtorch.kernels.choice import is_fused
from gmmtorch.kernels.compiler import FusedKernel

DIMENSIONS = (1, 2, 3)

_NATURALS = {dim: FusedKernel("mixtures/m_step.h", f"natural_parameters<{dim}>") for dim in DIMENSIONS}
_STEPS = {dim: FusedKernel("mixtures/m_step.h", f"m_step<{dim}>") for dim in DIMENSIONS}

Mixture = tuple[Tensor, Tensor, Tensor]
"""Weights (K,), means (K, D) and covariances (K, D, D)."""


def is_m_step_fused(dim: int, *tensors: Tensor) -> bool:
    """Whether the fused kernels compute with these tensors in `dim` dimensions."""
    return dim in DIMENSIONS and all(t.dtype == torch.float64 for t in tensors) and is_fused(*tensors)


def fused_natural_parameters(
    weights: Tensor, means: Tensor | None, covariances: Tensor
) -> tuple[Tensor, Tensor]:
    """W (K, F) such that φ(x)·W_k = log π_k + log N(x | μ_k, Σ_k); `means` None: zeros.

    Also whether (a scalar) a weight or a covariance is not positive, NaN or infinite: W is not valid then.
    """
    k, dim = covariances.shape[:2]
    natural = weights.new_empty(k, 1 + dim + dim * (dim + 1) // 2)
    failed = torch.zeros(1, dtype=torch.bool, device=weights.device)
    given = weights.contiguous(), None if means is None else means.contiguous(), covariances.contiguous()
    _NATURALS[dim](k, *given, natural, failed, device=weights.device)
    return natural, failed[0]


def fused_maximization(statistics: Tensor, dim: int, reg_covar: float, previous: Mixture | None) -> Mixture:
    """M-step from statistics (K, F), in their frame; components without points keep `previous` values."""
    k = statistics.shape[0]
    made = statistics.new_empty(k * (1 + dim + dim * dim))
    masses, means = made[:k], made[k : k + k * dim].view(k, dim)
    covariances = made[k + k * dim :].view(k, dim, dim)
    _, *kept = (None, None, None) if previous is None else (part.contiguous() for part in previous)
    given = statistics.contiguous(), *kept, False, reg_covar, None, None, 0.0
    _STEPS[dim](k, *given, masses, means, covariances, *[None] * 4, device=statistics.device)
    return masses / masses.sum(), means, covariances


def fused_steps(
    statistics: Tensor, before: Mixture, reg_covar: float, last: tuple[Tensor, Tensor] | None, share: float
) -> tuple[Mixture, Mixture | None]:
    """EM's own step, and the step from statistics that are extrapolated by a `share` of their last change.

    Args:
        statistics: (K, F) about the means `before`. last: the statistics (K, F) of the step before, and the
            means (K, D) that they are about; with None, nothing is extrapolated.
    """
    _, means, covariances = (part.contiguous() for part in before)
    k, dim = means.shape
    em = means.new_empty(k), torch.empty_like(means), torch.empty_like(covariances)
    given = statistics.contiguous(), means, covariances, True, reg_covar
    if last is None:
        _STEPS[dim](k, *given, None, None, share, *em, *[None] * 4, device=means.device)
        return (em[0] / em[0].sum(), *em[1:]), None
    new = torch.empty_like(em[0]), torch.empty_like(means), torch.empty_like(covariances)
    trusted = torch.empty(k, dtype=torch.bool, device=means.device)
    old = last[0].contiguous(), last[1].contiguous()
    _STEPS[dim](k, *given, *old, share, *em, *new, trusted, device=means.device)
    em_weights = em[0] / em[0].sum()
    weights = torch.where(trusted, new[0] / new[0].sum(), em_weights)
    return (em_weights, *em[1:]), (weights / weights.sum(), *new[1:])

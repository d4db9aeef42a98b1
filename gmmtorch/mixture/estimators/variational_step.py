"""One iteration of variational Bayes, for `loop.run_em`."""

from __future__ import annotations

import torch
from torch import Tensor

from gmmtorch.mixture.em import exact as em
from gmmtorch.mixture.em import loop
from gmmtorch.mixture.em.exact import Parameters
from gmmtorch.mixture.estimators.gaussian_wishart import (
    Posterior,
    Prior,
    assigned_log_density,
    expected_log_density,
    log_evidence,
    update,
)


def variational_step(
    points: Tensor,
    sample_weight: Tensor,
    prior: Prior,
    process: bool,
    reg_covar: float,
    softmax_dtype: torch.dtype,
    covariance_type: str = "full",
) -> loop.Step[Posterior]:
    """One iteration for `loop.run_em`: responsibilities given a posterior, and their posterior.

    The bound (nats a point) is that of the returned posterior. Covariances of the points of a component
    include `reg_covar` (m²).
    """
    features = em.quadratic_features(points)
    total = float(sample_weight.sum())

    def step(posterior: Posterior) -> tuple[Posterior, float]:
        log_weight, gaussians = expected_log_density(posterior)
        found, value = _expected_moments(
            features, points, sample_weight, log_weight, gaussians, reg_covar, softmax_dtype
        )
        new = update(prior, found, process, covariance_type)
        entropy = value - assigned_log_density(_unregularized(found, reg_covar), log_weight, gaussians)
        return new, float(entropy + log_evidence(prior, new, total)) / total

    return step


def _expected_moments(
    features: Tensor,
    points: Tensor,
    sample_weight: Tensor,
    log_weight: Tensor,
    gaussians: Parameters,
    reg_covar: float,
    softmax_dtype: torch.dtype,
) -> tuple[Parameters, Tensor]:
    """Moments of γ_nk ∝ exp(ω_k) N(x_n | m_k, Σ_k), and Σ_n p_n times the log of their normaliser.

    Computed as two products with `features`, or directly from `points` if the products would cancel.
    """
    weights = torch.exp(log_weight - log_weight.max())
    unnormalised = gaussians._replace(weights=weights)
    if not em.is_ill_conditioned(unnormalised):
        natural = em.natural_parameters(gaussians)
        natural[:, 0] += log_weight
        sums, value = em.expectation(features, sample_weight, natural, softmax_dtype)
        found = em.maximization(sums, reg_covar)
        found = found._replace(weights=sums[:, 0])
        least = torch.linalg.eigvalsh(found.covariances)[:, 0]
        second = sums[:, 1:].abs().amax(1) / sums[:, 0].clamp_min(1e-300)
        has_cancelled = torch.finfo(least.dtype).eps * second > 1e-6 * least
        if not bool((has_cancelled & (sums[:, 0] > 1e-9)).any()):
            return found, value
    found, value = em.direct_step(points, sample_weight, unnormalised, reg_covar)
    total = sample_weight.sum()
    return found._replace(weights=found.weights * total), value + log_weight.max() * total


def _unregularized(moments: Parameters, reg_covar: float) -> Parameters:
    eye = torch.eye(moments.means.shape[1], dtype=moments.means.dtype, device=moments.means.device)
    return moments._replace(covariances=moments.covariances - reg_covar * eye)

"""Variational Bayes of a mixture: its posterior given the moments of each component's points, and the
iteration between both (Bishop, 2006, section 10.2; Blei & Jordan, 2006).

    p(μ_k, Λ_k) = N(μ_k | m₀, (β₀Λ_k)⁻¹) Wishart(Λ_k | W₀, ν₀)
    p(π)        = Dirichlet(γ₀, …, γ₀), or for a Dirichlet process π_k = v_k Π_{j<k} (1 − v_j) with
                  sticks v_k ~ Beta(1, γ₀)

Given the moments, the posterior has the same form (`update`). Its expected log-density is that of Gaussians
with modified weights (`expected_log_density`), so the E-step is that of EM (`variational_step`).
"""

from __future__ import annotations

import copy
import functools
import math
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.kernels import fused_em, is_small
from gmmtorch.linalg import eigen, safe_cholesky
from gmmtorch.mixture.em import by_type, loop
from gmmtorch.mixture.em.exact import LOG_2PI, Parameters, compact, constrain, type_shape


class Prior(NamedTuple):
    """γ₀ (), β₀ (), m₀ (D,), ν₀ () and W₀⁻¹ (D, D); a typical covariance is W₀⁻¹/ν₀."""

    concentration: Tensor
    mean_precision: Tensor
    mean: Tensor
    degrees_of_freedom: Tensor
    covariance: Tensor


class Posterior(NamedTuple):
    """Posterior of K components.

    concentration: (2, K) the Beta parameters of the sticks, or (1, K) the Dirichlet parameters.
    mean_precision: β (K,), the number of points that determine each mean. means: m (K, D).
    degrees_of_freedom: ν (K,). covariances: W⁻¹/ν, the inverse of the expected precision, in the shape of the
    covariance type.
    """

    concentration: Tensor
    mean_precision: Tensor
    means: Tensor
    degrees_of_freedom: Tensor
    covariances: Tensor


def unbiased_covariance(
    points: Tensor, weight: Tensor, thickness: float, covariance_type: str = "full"
) -> Tensor:
    """Covariance (D, D), of the type, of points whose mean is the origin.

    In directions in which the points are flat, the variance is `thickness` (m²) instead of zero.
    """
    total = float(weight.sum())
    # No unbiased estimate exists below two points; W/2 continues W − 1 continuously.
    count = max(total - 1, total / 2)
    if covariance_type in ("diag", "spherical"):
        parts = [p @ x.square() for x, p in by_type.in_chunks(points, weight)]
        variances = torch.stack(parts).sum(0) / count
        flat = ~(variances > 1e-14 * variances.amax())
        variances = torch.where(flat, variances.clamp_min(thickness), variances)
        return constrain(torch.diag(variances)[None], covariance_type)[0]
    covariance = (points * weight[:, None]).T @ points / count
    variances, directions = eigen(covariance)
    if float(variances[0]) > 1e-14 * float(variances[-1]):
        return covariance
    return (directions * variances.clamp_min(thickness)) @ directions.T


def update(prior: Prior, moments: Parameters, process: bool, covariance_type: str = "full") -> Posterior:
    """The posterior given the points N_k (K,) of each component, their means and their covariances.

    `moments` has N_k in place of weights, and covariances in the shape of the type. process: whether the
    weights have a Dirichlet process prior.
    Bishop (10.58)–(10.63); Blei & Jordan (18)–(19). For other types than full covariances, the Wishart
    factors are the best ones whose scale matrix is of the type: tied ones are equal.
    """
    count, mean, covariance = moments
    mean_precision = prior.mean_precision + count
    degrees_of_freedom = prior.degrees_of_freedom + count
    offset = mean - prior.mean
    pull = count * prior.mean_precision / mean_precision
    scatter = compact(prior.covariance[None], covariance_type)
    if covariance_type == "full":
        outer = offset[:, :, None] * offset[:, None, :]
        scatter = scatter + count[:, None, None] * covariance + pull[:, None, None] * outer
    elif covariance_type == "tied":
        scatter = scatter + (count.sum() * covariance + (pull[:, None] * offset).T @ offset) / len(count)
        degrees_of_freedom = degrees_of_freedom.mean().expand_as(degrees_of_freedom).clone()
    elif covariance_type == "diag":
        scatter = scatter + count[:, None] * covariance + pull[:, None] * offset.square()
    else:
        scatter = scatter + count * covariance + pull * offset.square().mean(1)
    if process:  # 1 + N_k for taking stick k, and γ₀ + Σ_{j>k} N_j for passing it
        later = (count.sum() - count.cumsum(0)).clamp_min_(0)
        concentration = torch.stack([1 + count, prior.concentration + later])
    else:
        concentration = (prior.concentration + count)[None]
    return Posterior(
        concentration,
        mean_precision,
        (prior.mean_precision * prior.mean + count[:, None] * mean) / mean_precision[:, None],
        degrees_of_freedom,
        scatter / _of_each(degrees_of_freedom, scatter, covariance_type),
    )


def _of_each(value: Tensor, covariances: Tensor, covariance_type: str) -> Tensor:
    """A value (K,) of each component, in a shape that broadcasts with covariances; tied: that of all."""
    return value[0] if covariance_type == "tied" else value.view(-1, *[1] * (covariances.ndim - 1))


def expected_weights(concentration: Tensor) -> Tensor:
    """E[π] (K,). For a Dirichlet process, the expected weights of the K sticks, scaled to add up to one."""
    if concentration.shape[0] == 1:
        return concentration[0] / concentration.sum()
    share = concentration / concentration.sum(0)
    passed = torch.cat([share.new_ones(1), share[1].cumprod(0)[:-1]])
    return share[0] * passed / (share[0] * passed).sum()


def expected_log_weights(concentration: Tensor) -> Tensor:
    """E[log π] (K,). Bishop (10.66); for sticks E[log v_k] + Σ_{j<k} E[log(1 − v_j)]."""
    expected = torch.digamma(concentration)
    if concentration.shape[0] == 1:
        return expected[0] - torch.digamma(concentration.sum())
    expected = expected - torch.digamma(concentration.sum(0))
    return expected[0] + expected[1].cumsum(0) - expected[1]


def expected_log_density(posterior: Posterior) -> tuple[Tensor, Parameters]:
    """ω (K,) and Gaussians such that E[log π_k + log N(x | μ_k, Λ_k⁻¹)] = ω_k + log N(x | m_k, Σ_k).

    Σ = E[Λ]⁻¹, and ω is E[log π] + ½(E[log|Λ|] − log|E[Λ]|) − D/2β. Bishop (10.64)–(10.66).
    """
    dim = posterior.means.shape[1]
    dof = posterior.degrees_of_freedom
    steps = torch.arange(dim, dtype=dof.dtype, device=dof.device)
    log_det = torch.digamma(0.5 * (dof[:, None] - steps)).sum(1) - dim * torch.log(0.5 * dof)
    weight = expected_log_weights(posterior.concentration)
    weight = weight + 0.5 * (log_det - dim / posterior.mean_precision)
    # Log-weights a million nats below the largest have no effect, but must not be infinite.
    weight = torch.maximum(weight, weight.amax() - 1e6)
    return weight, Parameters(torch.ones_like(weight), posterior.means, posterior.covariances)


def assigned_log_density(moments: Parameters, log_weight: Tensor, factors: by_type.Factors) -> Tensor:
    """Σ_n Σ_k γ_nk (ω_k + log N(x_n | m_k, Σ_k)), a scalar, of points with moments (N_k, x̄_k, S_k).

    Covariances have the shape of their type. factors: of weights 1, m and Σ.
    """
    count, mean, covariance = moments
    whiten, offset = factors.whiten, mean - factors.means
    if factors.kind in ("full", "tied"):
        trace = (whiten.mT @ whiten * covariance).sum((-2, -1))
        shift = whiten @ offset[:, :, None]
    else:
        n_equal = factors.dim if factors.kind == "spherical" else 1
        trace = (whiten.square() * covariance).view(len(count), -1).sum(1) * n_equal
        shift = offset * whiten.view(len(count), -1)
    squared = trace + shift.square().flatten(1).sum(1)
    return (count * (log_weight + factors.constant - 0.5 * squared)).sum()


def log_evidence(
    of_prior: Tensor, posterior: Posterior, n_points: float, covariance_type: str = "full"
) -> Tensor:
    """log p(X | assignments) + log p(assignments), nats, of the points that `posterior` includes.

    The ratio of the normalisers of posterior and prior, times (2π)^(−ND/2). Plus the entropy of the
    responsibilities, it is the lower bound of log p(X) once q(θ) is optimal for them. For sticks it is that
    of the whole process: components beyond the K-th have no points and equal the prior.
    of_prior: `log_normaliser` of the posterior without points.
    """
    dim = posterior.means.shape[1]
    return log_normaliser(posterior, covariance_type) - of_prior - 0.5 * n_points * dim * LOG_2PI


def log_normaliser(posterior: Posterior, covariance_type: str = "full") -> Tensor:
    """The logarithm of the normaliser of q(μ, Λ) q(π), without the factors π of the Gaussians."""
    dim, dof = posterior.means.shape[1], posterior.degrees_of_freedom
    log_det = _log_det(posterior.covariances, covariance_type, dim) + dim * dof.log()
    log_wishart = 0.5 * dof * (dim * math.log(2) - log_det) + torch.mvlgamma(0.5 * dof, dim)
    components = log_wishart - 0.5 * dim * posterior.mean_precision.log()
    sticks = posterior.concentration if len(posterior.concentration) == 2 else posterior.concentration.T
    log_dirichlet = torch.lgamma(sticks).sum(0) - torch.lgamma(sticks.sum(0))
    return components.sum() + log_dirichlet.sum()


def _log_det(covariances: Tensor, kind: str, dim: int) -> Tensor:
    """log |Σ| of covariances in the shape of their type: (K,), tied (1,)."""
    if kind in ("full", "tied"):
        factors = safe_cholesky(covariances.view(-1, dim, dim))
        return 2 * torch.log(factors.diagonal(dim1=-2, dim2=-1)).sum(1)
    log = covariances.log()
    return log.sum(1) if kind == "diag" else dim * log


def log_predictive(points: Tensor, posterior: Posterior, covariance_type: str = "full") -> Tensor:
    """log p(x | X) (N,) of new points (N, D): Σ_k E[π_k] Student-t(x | m_k, L_k⁻¹, ν_k + 1 − D).

    The scale L_k⁻¹ is W_k⁻¹ (1 + β_k) / (β_k (ν_k + 1 − D)). Bishop (10.81)–(10.82).
    """
    k, dim = posterior.means.shape
    dof = posterior.degrees_of_freedom + 1 - dim
    ratio = posterior.degrees_of_freedom / dof * (1 + 1 / posterior.mean_precision)
    weights = expected_weights(posterior.concentration)
    factors = by_type.Factors(Parameters(weights, posterior.means, posterior.covariances), covariance_type)
    constant = torch.lgamma(0.5 * (dof + dim)) - torch.lgamma(0.5 * dof) + factors.constant
    constant = constant - 0.5 * dim * torch.log(0.5 * dof * ratio)
    joint = factors.direct()

    def log_sum(part: Tensor) -> Tensor:
        squared = 2 * (factors.constant[:, None] - joint(part))
        term = torch.log1p(squared / (ratio * dof)[:, None])
        return torch.logsumexp(constant[:, None] - 0.5 * (dof + dim)[:, None] * term, 0)

    rows = by_type.rows_of_chunk(k, dim, covariance_type, points.device)
    return torch.cat([log_sum(part) for part in points.split(rows)])


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

    The bound (nats per point) is that of the returned posterior. Covariances of the points of a component
    include `reg_covar` (m²).
    """
    rows = by_type.rows_of_few_dimensions(points, sample_weight)
    total = float(sample_weight.sum())
    kind = covariance_type

    @functools.cache
    def of_prior(n_components: int) -> Tensor:
        shapes = (
            (n_components,),
            (n_components, points.shape[1]),
            type_shape(kind, n_components, points.shape[1]),
        )
        none = Parameters(*(points.new_zeros(shape) for shape in shapes))
        return log_normaliser(update(prior, none, process, kind), kind)

    def step(posterior: Posterior) -> tuple[Posterior, float]:
        log_weight, gaussians = expected_log_density(posterior)
        if is_small(points, sample_weight, len(log_weight), kind):
            start = Parameters(*(part.clone()[None] for part in gaussians))
            small = fused_em(points, sample_weight, start, kind, reg_covar, log_weights=log_weight)
            if not small.failed[0]:
                found = Parameters(small.counts[0], small.means[0], small.covariances[0])
                new = update(prior, found, process, kind)
                return new, float(
                    small.entropy[0] + log_evidence(of_prior(len(log_weight)), new, total, kind)
                ) / total
        factors = by_type.Factors(gaussians, kind)
        weighted = copy.copy(factors)  # responsibilities γ_nk ∝ exp(ω_k) N(x_n | m_k, Σ_k)
        weighted.constant = factors.constant + log_weight
        weighted.weights = torch.exp(log_weight - log_weight.max())
        given = points, sample_weight, weighted, softmax_dtype
        gather = functools.partial(by_type.expected_moments, *given, rows=rows)
        moved = by_type.exact_step(gather, weighted, reg_covar, None, linear=True)
        found = moved.parameters._replace(weights=moved.points)
        new = update(prior, found, process, kind)
        plain = found.covariances.clone()
        diagonal = plain.diagonal(dim1=-2, dim2=-1) if kind in ("full", "tied") else plain
        diagonal.sub_(reg_covar)
        entropy = moved.value - assigned_log_density(found._replace(covariances=plain), log_weight, factors)
        return new, float(entropy + log_evidence(of_prior(len(log_weight)), new, total, kind)) / total

    return step

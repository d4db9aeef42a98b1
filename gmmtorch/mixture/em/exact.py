"""Exact expectation–maximisation of a Gaussian mixture, thesis (2.1)-(2.6), as two matrix products.

With the features φ(x) = [1, x, x_i x_j (i ≤ j)], the log-density plus log-weight of every component
is linear in φ: L = φ Wᵀ, with natural parameters W. One iteration is Γ = softmax(L) (2.3), S = Γᵀ diag(p) φ.
S (K × F) contains all sufficient statistics: N_k, Σ γ x and Σ γ xxᵀ. `maximization` turns them into
weights (2.4), means (2.5) and covariances (2.6).

A row of features may also stand for a cell of points. The mean feature of the cell, weighted by its
number of points, gives the cell's expected log-density exactly. All points of a cell then share one
responsibility, the M-step stays exact, and Σ_c n_c logsumexp_k is a lower bound of the log-likelihood
that never decreases (Verbeek, Nunnink & Vlassis, 2006).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.kernels import expectation as expectation
from gmmtorch.kernels import exponent_floor as exponent_floor
from gmmtorch.kernels import fused_maximization, fused_natural_parameters, is_m_step_fused, most_likely
from gmmtorch.linalg import inverse_factor, pack_symmetric, safe_cholesky, unpack_symmetric

SOFTMAX_DTYPES = {"float32": torch.float32, "float64": torch.float64}
"""Dtypes for the exponentials of the E-step, by name."""

LOG_2PI = 1.8378770664093453
MIN_LOG_WEIGHT = -1e30  # replaces log 0: finite, so that products are not NaN


class Parameters(NamedTuple):
    """Mixture parameters in the frame of the features: weights (K,), means (K, D), covariances (K, D, D)."""

    weights: Tensor
    means: Tensor
    covariances: Tensor


def quadratic_features(points: Tensor) -> Tensor:
    """φ(x) = [1, x, x_i x_j (i ≤ j)]: (N, D) → (N, 1 + D + D(D+1)/2)."""
    return torch.cat([points.new_ones(points.shape[0], 1), points, products(points, points)], 1)


def products(left: Tensor, right: Tensor) -> Tensor:
    """x_i y_j, i ≤ j: (…, D) and (…, D) → (…, D(D+1)/2). Slices are much faster here than index arrays."""
    return torch.cat([left[..., i : i + 1] * right[..., i:] for i in range(left.shape[-1])], -1)


def shift_features(features: Tensor, offset: Tensor) -> Tensor:
    """Features (…, F) of points x + d from those of points x, for offsets d (…, D); also for sums of
    features.
    """
    dim = offset.shape[-1]
    count, first, second = features[..., :1], features[..., 1 : 1 + dim], features[..., 1 + dim :]
    second = second + products(first, offset) + products(offset, first) + count * products(offset, offset)
    return torch.cat([count, first + count * offset, second], -1)


def natural_parameters(parameters: Parameters) -> Tensor:
    """W (K, F) such that φ(x)·W_k = log π_k + log N(x | μ_k, Σ_k)."""
    weights, means, covariances = parameters
    if is_m_step_fused(means.shape[1], *parameters):
        found, failed = fused_natural_parameters(*parameters)
        if not bool(failed):
            return found
    factors = safe_cholesky(covariances)
    whiten = inverse_factor(factors)
    log_weight = torch.log(weights).clamp_min(MIN_LOG_WEIGHT)
    half_log_det = torch.log(factors.diagonal(dim1=-2, dim2=-1)).sum(-1)
    constant = log_weight - half_log_det - 0.5 * means.shape[1] * LOG_2PI
    return natural_of_precisions(whiten @ whiten.transpose(-2, -1), means, constant)


def natural_of_precisions(precision: Tensor, means: Tensor, constant: Tensor) -> Tensor:
    """W (K, F) such that φ(x)·W_k = c_k − ½ (x − μ_k)ᵀ Λ_k (x − μ_k), with Λ (K, D, D), c (K,)."""
    linear = (precision @ means[:, :, None]).squeeze(-1)
    constant = constant - 0.5 * (linear * means).sum(1)
    # φ has each off-diagonal product once, for two matrix entries.
    twice = pack_symmetric(0.5 * torch.eye(means.shape[1], dtype=means.dtype, device=means.device) - 1)
    return torch.cat([constant[:, None], linear, twice * pack_symmetric(precision)], 1)


def most_likely_component(features: Tensor, parameters: Parameters) -> Tensor:
    """The component (N,) with the largest responsibility for each row of features."""
    return most_likely(features, natural_parameters(parameters))


def maximization(statistics: Tensor, reg_covar: float, previous: Parameters | None = None) -> Parameters:
    """M-step (2.4)-(2.6): parameters from sufficient statistics. `reg_covar` (m²) is added to each variance.

    A component that lost all its points keeps its `previous` mean and covariance, with weight 0.
    """
    dim = feature_dimension(statistics.shape[1])
    if is_m_step_fused(dim, statistics, *(previous or ())):
        return Parameters(*fused_maximization(statistics, dim, reg_covar, previous))
    eps = 10 * torch.finfo(statistics.dtype).eps
    count = statistics[:, 0] + eps
    means = statistics[:, 1 : 1 + dim] / count[:, None]
    second = unpack_symmetric(statistics[:, 1 + dim :] / count[:, None], dim)
    covariances = second - means[:, :, None] * means[:, None, :]
    covariances.diagonal(dim1=-2, dim2=-1).clamp_min_(0).add_(reg_covar)
    new, alive = Parameters(count / count.sum(), means, covariances), statistics[:, 0] > eps
    if previous is None:
        return new
    return Parameters(
        torch.where(alive, new.weights, 0.0),
        torch.where(alive[:, None], new.means, previous.means),
        torch.where(alive[:, None, None], new.covariances, previous.covariances),
    )


def feature_dimension(n_features: int) -> int:
    """D such that 1 + D + D(D+1)/2 = n_features."""
    return int(((8 * n_features + 1) ** 0.5 - 3) / 2 + 0.5)


COVARIANCE_TYPES = ("full", "tied", "diag", "spherical")
"""Those of scikit-learn: which covariances a mixture may have."""


def constrain(matrices: Tensor, covariance_type: str, weights: Tensor | None = None) -> Tensor:
    """The nearest matrices (K, D, D) of the type; tied: their mean, weighted by `weights` (K,).

    The M-step of a type is this projection of the full M-step, because the likelihood depends on the scatter
    only through its product with precisions of the type.
    """
    if covariance_type == "full":
        return matrices
    if covariance_type == "tied":
        share = torch.ones_like(matrices[:, 0, 0]) if weights is None else weights
        mean = (matrices * (share / share.sum())[:, None, None]).sum(0)
        return mean.expand_as(matrices).clone()
    diagonal = matrices.diagonal(dim1=-2, dim2=-1)
    if covariance_type == "spherical":
        diagonal = diagonal.mean(-1, keepdim=True).expand_as(diagonal)
    return torch.diag_embed(diagonal)


def compact(matrices: Tensor, covariance_type: str) -> Tensor:
    """The distinct entries of matrices (K, D, D) of the type, in the shape of scikit-learn's attributes."""
    if covariance_type == "full":
        return matrices
    if covariance_type == "tied":
        return matrices[0]
    diagonal = matrices.diagonal(dim1=-2, dim2=-1)
    return (diagonal if covariance_type == "diag" else diagonal[:, 0]).clone()


def expand(values: Tensor, covariance_type: str, n_components: int, dim: int) -> Tensor:
    """Matrices (K, D, D) from their distinct entries: the inverse of `compact`."""
    if covariance_type == "full":
        return values
    if covariance_type == "tied":
        return values.expand(n_components, dim, dim).clone()
    columns = values if covariance_type == "diag" else values[:, None]
    return torch.diag_embed(columns.expand(n_components, dim))


def type_shape(covariance_type: str, n_components: int, dim: int) -> tuple[int, ...]:
    """The shape of `compact`."""
    k = n_components
    return {"full": (k, dim, dim), "tied": (dim, dim), "diag": (k, dim), "spherical": (k,)}[covariance_type]


def count_free_entries(covariance_type: str, n_components: int, dim: int) -> int:
    """Number of free parameters of the covariances."""
    k, symmetric = n_components, dim * (dim + 1) // 2
    return {"full": k * symmetric, "tied": symmetric, "diag": k * dim, "spherical": k}[covariance_type]


def check_type(covariances: Tensor, covariance_type: str) -> Tensor:
    """Returns covariances (K, D, D). Raises `InvalidArgumentError` unless they are of the type."""
    difference = (constrain(covariances, covariance_type) - covariances).abs()
    if bool((difference > 1e-9 * covariances.abs().amax()).any()):
        raise InvalidArgumentError(
            f"covariance_type={covariance_type!r}, but the covariances are not {covariance_type}; "
            "set covariance_type='full'."
        )
    return covariances

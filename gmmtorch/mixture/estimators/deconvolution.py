"""EM for points that each come with the covariance of their noise: extreme deconvolution.

A point is x_n = v_n + ε_n, with v_n from the mixture and ε_n ~ N(0, R_n), R_n known. So x_n has the
density Σ_k π_k N(x | μ_k, T_nk), T_nk = Σ_k + R_n, and EM learns the mixture of v, what the sensor
would have measured had it no noise (Bovy, Hogg & Roweis, 2011). Given component k, v_n has

    mean        b_nk = μ_k + Σ_k T⁻¹(x_n − μ_k) = x_n − R_n T⁻¹(x_n − μ_k)
    covariance  B_nk = Σ_k − Σ_k T⁻¹ Σ_k        = R_n T⁻¹ Σ_k

(the second forms lose no digits where R is small: with R = 0 they are x_n and 0, plain EM). The
M-step takes b for x and b bᵀ + B for x xᵀ. Here moments are taken about the component's last mean.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.linalg import inverse_factor, safe_cholesky, unpack_symmetric
from gmmtorch.mixture.em import exact as em
from gmmtorch.mixture.em.exact import Parameters
from gmmtorch.mixture.estimators.noisy_pairs import chunks, dot, gathered

_WORTH_SHARING = 256
"""Points a distinct covariance must have on average before it is taken for itself."""

_ROUNDING = 1e-13
"""Least variance of a component, as a share of its largest: less would be rounding's."""


class Block(NamedTuple):
    """Points (n, D) of weights (n,), whose noise is one covariance (D, D) or one each (n, D, D)."""

    points: Tensor
    weight: Tensor
    noise: Tensor


class Moments(NamedTuple):
    """Of the noise-free positions about the components' means: Σγ (K,), Σγ(b−μ) (K, D), and the
    second moments Σγ[(b−μ)(b−μ)ᵀ + B] (K, D, D)."""

    mass: Tensor
    first: Tensor
    second: Tensor


def blocks(points: Tensor, weight: Tensor, noise: Tensor) -> list[Block]:
    """Points (N, D) with noise (D, D) or (N, D, D): a block each covariance if these are few."""
    if noise.ndim == 2:
        return [Block(points, weight, noise)]
    distinct, group, sizes = torch.unique(noise.flatten(1), dim=0, return_inverse=True, return_counts=True)
    if distinct.shape[0] * _WORTH_SHARING > points.shape[0]:
        return [Block(points, weight, noise)]
    members = group.argsort(stable=True).split(sizes.tolist())
    return [Block(points[rows], weight[rows], noise[rows[0]]) for rows in members]


def expectation(block: Block, parameters: Parameters) -> tuple[Moments, Tensor]:
    """One E-step: moments of the block, and Σ_n p_n log p(x_n) (a scalar)."""
    if block.noise.ndim == 3:
        return _expectation_each(block, parameters)
    noisy = parameters._replace(covariances=parameters.covariances + block.noise)
    if em.is_ill_conditioned(noisy):
        return _expectation_each(
            block._replace(noise=block.noise.expand(len(block.points), -1, -1)), parameters
        )
    return _expectation_shared(block, parameters, noisy)


def log_likelihood(points: Tensor, noise: Tensor, parameters: Parameters) -> Tensor:
    """log Σ_k π_k N(x_n | μ_k, Σ_k + R_n) of points (N, D) with noise (D, D) or (N, D, D): (N,)."""
    noise = noise.expand(points.shape[0], -1, -1)
    return torch.cat([pairs.log_likelihood for _, pairs in chunks(points, noise, parameters)])


def maximization(
    moments: Moments, parameters: Parameters, least: float = 0.0, thickness: float | None = None
) -> Parameters:
    """M-step from moments about the means of `parameters`, with variances bounded as in `constrained`.

    A component that lost all its points keeps its mean and covariance, at weight 0.
    """
    alive = moments.mass > 10 * torch.finfo(moments.mass.dtype).eps
    count = torch.where(alive, moments.mass, 1.0)
    shift = moments.first / count[:, None]
    covariances = moments.second / count[:, None, None] - shift[:, :, None] * shift[:, None, :]
    covariances = torch.where(alive[:, None, None], covariances, parameters.covariances)
    return Parameters(
        torch.where(alive, moments.mass, 0.0) / moments.mass.sum(),
        parameters.means + torch.where(alive[:, None], shift, 0.0),
        constrained(covariances, least, thickness),
    )


def constrained(covariances: Tensor, least: float = 0.0, thickness: float | None = None) -> Tensor:
    """The likeliest covariances (K, D, D) whose every variance is at least `least` (m²) and whose
    smallest is at most `thickness`² (thickness in metres), given the unconstrained M-step's.

    The M-step maximises −½N(log|Σ| + tr Σ⁻¹S), S the unconstrained covariance. For given eigenvalues
    λ₁ ≤ … ≤ λ_D of Σ, tr Σ⁻¹S ≥ Σ s_i/λ_i (von Neumann), with equality when Σ has S's eigenvectors in
    the same order. What is left, Σ (log λ_i + s_i/λ_i), falls up to λ_i = s_i and rises beyond: every
    λ_i is s_i clamped to its interval. Bounding another than the smallest from above would cost
    log(t²/s) + s/t² − 1 at a larger s, and so more. Hence, from parameters that keep the bounds, EM
    with them never lowers the likelihood; adding a constant to Σ each time would, and because Σ is
    part of B, what is added would pile up.
    """
    variances, directions = torch.linalg.eigh(covariances)
    variances = variances.clone()
    if thickness is not None:
        variances[:, 0].clamp_(max=thickness**2)
    floor = (_ROUNDING * variances[:, -1:]).clamp_min(least)
    variances = torch.maximum(variances, floor)
    return (directions * variances[:, None, :]) @ directions.transpose(-2, -1)


def deconvolution_step(
    parts: list[Block], least: float = 0.0, thickness: float | None = None
) -> Callable[[Parameters], tuple[Parameters, float]]:
    """EM steps for `em.run_em`: better parameters, and the mean log-likelihood of those given."""
    total = float(sum(block.weight.sum() for block in parts))

    def step(parameters: Parameters) -> tuple[Parameters, float]:
        found = [expectation(block, parameters) for block in parts]
        sums = Moments(*(torch.stack(values).sum(0) for values in zip(*(m for m, _ in found), strict=True)))
        value = sum(float(likelihood) for _, likelihood in found)
        return maximization(sums, parameters, least, thickness), value / total

    return step


# -- one covariance for all points of a block -------------------------------------------------------


def _expectation_shared(block: Block, parameters: Parameters, noisy: Parameters) -> tuple[Moments, Tensor]:
    """Plain EM's sums with covariances T = Σ + R, of which b and B are linear functions."""
    dim = block.points.shape[1]
    features = em.quadratic_features(block.points)
    sums, value = em.expectation(features, block.weight, em.natural_parameters(noisy), torch.float64)
    count, means = sums[:, 0], parameters.means
    first = sums[:, 1 : 1 + dim] - count[:, None] * means
    cross = sums[:, 1 : 1 + dim, None] * means[:, None, :]
    second = unpack_symmetric(sums[:, 1 + dim :], dim) - cross - cross.transpose(-2, -1)
    second = second + count[:, None, None] * means[:, :, None] * means[:, None, :]
    whiten = inverse_factor(safe_cholesky(noisy.covariances))
    lost = block.noise @ whiten @ whiten.transpose(-2, -1)  # R T⁻¹: b − μ = (I − R T⁻¹)(x − μ)
    gain = torch.eye(dim, dtype=lost.dtype, device=lost.device) - lost
    remaining = count[:, None, None] * (lost @ parameters.covariances)
    moved = (gain @ first[:, :, None]).squeeze(-1)
    return Moments(count, moved, gain @ second @ gain.transpose(-2, -1) + _symmetric(remaining)), value


def _symmetric(matrices: Tensor) -> Tensor:
    return (matrices + matrices.transpose(-2, -1)) / 2


# -- a covariance for every point -------------------------------------------------------------------


def _expectation_each(block: Block, parameters: Parameters) -> tuple[Moments, Tensor]:
    """b and B of every pair that matters, summed by component; Σγ B = (Σγ R T⁻¹) Σ."""
    k, dim = parameters.means.shape
    axes = range(dim)
    sums = parameters.means.new_zeros(k, 1 + dim + 2 * dim * dim)
    value = sums.new_zeros(())
    for part, pairs in chunks(block.points, block.noise, parameters):
        value += torch.dot(block.weight[part], pairs.log_likelihood)
        noise = gathered(block.noise[part], pairs.row)
        share = torch.exp(pairs.joint - pairs.log_likelihood[pairs.row]) * block.weight[part][pairs.row]
        white = [dot(line, pairs.offset[: len(line)]) for line in pairs.whiten]
        upper = [[line[i] for line in pairs.whiten[i:]] for i in axes]
        pull = [dot(upper[i], white[i:]) for i in axes]  # T⁻¹(x − μ)
        moved = [pairs.offset[i] - dot(noise[i], pull) for i in axes]  # b − μ
        lower = [[dot(upper[i], upper[j][i - j :]) for j in axes[: i + 1]] for i in axes]
        precision = [[lower[max(i, j)][min(i, j)] for j in axes] for i in axes]  # T⁻¹
        columns = [torch.ones_like(share), *moved]
        columns += [moved[i] * moved[j] for i in axes for j in axes]
        columns += [dot(noise[i], precision[j]) for i in axes for j in axes]  # R T⁻¹
        sums.index_add_(0, pairs.component, torch.stack(columns, 1) * share[:, None])
    mass, first, second, lost = sums.split([1, dim, dim * dim, dim * dim], 1)
    remaining = lost.reshape(k, dim, dim) @ parameters.covariances
    return Moments(mass[:, 0], first, second.reshape(k, dim, dim) + _symmetric(remaining)), value

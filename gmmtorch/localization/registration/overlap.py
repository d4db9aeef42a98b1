"""The overlap of two mixtures as a function of a rigid motion of one of them, and its derivatives.

The overlap of densities f and g is ∫ f g dx, for mixtures a sum over pairs of components:

    S(R, t) = Σ_ij π_i π_j N(R μ_i + t | μ_j, R Σ_i Rᵀ + Σ_j)

(Jian & Vemuri 2011; distribution-to-distribution NDT, Stoyanov et al. 2012). A motion is perturbed by a
shift v and a turn ω as `localization.rigid_motions` defines it. With d = R μ_i + t − μ_j, A = R Σ_i Rᵀ,
C = A + Σ_j, W = C⁻¹, z = W d and lever l = R μ_i, of each pair

    ∂ log N/∂v = −z,   ∂ log N/∂ω_k = −zᵀ G_k (l − A z) − tr(G_k A W).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.kernels.choice import is_fused
from gmmtorch.kernels.mixtures.pair_overlap import overlap_sums
from gmmtorch.localization.rigid_motions import Motions, generators
from gmmtorch.mixture.em.exact import Parameters

_CHUNK = 1 << 14  # pairs processed at a time, so that they stay in a core's cache


class Pairs(NamedTuple):
    """Pairs of components, (P,) each: row of the motion, of the source, of the target."""

    motion: Tensor
    source: Tensor
    target: Tensor

    def of(self, kept: Tensor) -> Pairs:
        return Pairs(*(rows[kept] for rows in self))


class Overlap(NamedTuple):
    """Of B motions: log S (B,), −∞ where no pair is near; its gradient (B, F) over F = D + D(D−1)/2 degrees
    of freedom (v, ω); the mean information of a pair (B, F, F), JᵀWJ and ½ tr(W ∂C W ∂C); and the
    covariance of the pairs' gradients (B, F, F).

    Pairs are weighted by their share of S. Information less covariance approximates −∇² log S, as the
    missing information of EM does (Louis 1982).
    """

    log_score: Tensor
    gradient: Tensor
    information: Tensor
    scatter: Tensor

    def at(self, rows: Tensor) -> Overlap:
        return Overlap(*(value[rows] for value in self))


def overlap(source: Parameters, target: Parameters, motions: Motions, pairs: Pairs) -> Overlap:
    """Log score, gradient, information and scatter of each motion, over the given pairs only."""
    if is_fused(*source, *target, *motions, *pairs):
        turned = motions.rotations[:, None]
        levers = (turned @ source.means[..., None]).squeeze(-1)
        moved = turned @ source.covariances @ turned.mT
        weights = source.weights, target.weights
        sums = overlap_sums(pairs, levers, moved, motions.translations, target[1:], weights)
    else:
        sums = _batched_sums(source, target, motions, pairs)
    total, first, second, squares = sums
    scale = total.clamp_min(1e-300)[:, None]
    gradient = first / scale
    scatter = squares / scale[:, None] - gradient[:, :, None] * gradient[:, None]
    return Overlap(total.log(), gradient, second / scale[:, None], scatter)


def _batched_sums(
    source: Parameters, target: Parameters, motions: Motions, pairs: Pairs
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The twin of `kernels.pair_overlap`."""
    n, dim = motions.translations.shape
    n_free = dim + dim * (dim - 1) // 2
    lever = torch.einsum("bij,kj->ibk", motions.rotations, source.means).flatten(1)
    moved = torch.einsum("bij,kjl,bml->imbk", motions.rotations, source.covariances, motions.rotations)
    moved = moved.flatten(2)
    there, still = target.means.T, target.covariances.permute(1, 2, 0)
    total = lever.new_zeros(n)
    first, second, squares = (lever.new_zeros(n, n_free**power) for power in (1, 2, 2))
    for rows in torch.arange(len(pairs.motion), device=lever.device).split(_CHUNK):
        b, i, j = pairs.of(rows)
        row = b * len(source.weights) + i
        shift = motions.translations.T[:, b] - there[:, j]
        log_density, slope, information = _pair_terms(lever[:, row], shift, moved[..., row], still[..., j])
        share = source.weights[i] * target.weights[j] * torch.exp(log_density)
        total.index_add_(0, b, share)
        weighted = share * slope
        first.index_add_(0, b, weighted.T)
        second.index_add_(0, b, (share * information).flatten(0, 1).T)
        squares.index_add_(0, b, (weighted[:, None] * slope).flatten(0, 1).T)
    return total, first, second.view(n, n_free, n_free), squares.view(n, n_free, n_free)


def _pair_terms(lever: Tensor, shift: Tensor, moved: Tensor, still: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Of P pairs log N (P,), its gradient (F, P) and information (F, F, P).

    Args:
        lever: R μ_i (D, P). shift: t − μ_j (D, P). moved: A (D, D, P). still: Σ_j (D, D, P).
    """
    dim = len(lever)
    spins = generators(dim).to(lever)
    precision, half_log_det = _inverse(moved + still)
    offset = lever + shift
    pull = _times(precision, offset[:, None])[:, 0]
    log_density = -0.5 * (offset * pull).sum(0) - half_log_det - 0.5 * dim * math.log(2 * math.pi)

    arm = lever - _times(moved, pull[:, None])[:, 0]
    matched = _times(moved, precision)
    turned = torch.einsum("kij,jp->kip", spins, arm)
    slope = -(pull * turned).sum(1) - torch.einsum("kij,jip->kp", spins, matched)

    jacobian = torch.cat([torch.eye(dim).to(lever)[..., None].expand(-1, -1, lever.shape[1]),
                          torch.einsum("kij,jp->ikp", spins, lever)], 1)  # fmt: skip
    information = _times(jacobian.transpose(0, 1), _times(precision, jacobian))
    swept = torch.einsum("kij,jlp->kilp", spins, moved)
    change = [_times(precision, s + s.transpose(0, 1)) for s in swept]
    for k, one in enumerate(change):
        for m, other in enumerate(change):
            information[dim + k, dim + m] += 0.5 * (one * other.transpose(0, 1)).sum((0, 1))
    return log_density, torch.cat([-pull, slope]), information


def _inverse(matrices: Tensor) -> tuple[Tensor, Tensor]:
    """Inverses (D, D, P) and ½ log det (P,) of positive definite matrices (D, D, P), by Cholesky's factors.

    Written out: LAPACK takes a microsecond for each small matrix.
    """
    dim = len(matrices)
    factor = torch.zeros_like(matrices)
    for j in range(dim):
        rest = matrices[j:, j] - (factor[j:, :j] * factor[j, :j]).sum(1)
        factor[j:, j] = rest / rest[0].sqrt()
    inverse = torch.zeros_like(matrices)  # of the factor
    for j in range(dim):
        inverse[j, j] = 1 / factor[j, j]
        for i in range(j + 1, dim):
            inverse[i, j] = -(factor[i, j:i] * inverse[j:i, j]).sum(0) / factor[i, i]
    half_log_det = torch.stack([factor[j, j] for j in range(dim)]).log().sum(0)
    return _times(inverse.transpose(0, 1), inverse), half_log_det


def _times(a: Tensor, b: Tensor) -> Tensor:
    """Matrix products (I, J, P) of (I, K, P) and (K, J, P)."""
    return (a[:, :, None] * b[None]).sum(1)


def deviations(mixture: Parameters) -> Tensor:
    """Standard deviations (K, D) along the principal axes, in rising order."""
    return torch.linalg.eigvalsh(mixture.covariances).clamp_min(0).sqrt()

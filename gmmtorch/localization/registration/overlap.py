"""The overlap of two mixtures as a function of a rigid motion of one of them, its derivatives and its ascent.

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

from gmmtorch.kernels import MOST_TESTED, is_fused, near_pairs, overlap_sums
from gmmtorch.linalg import safe_cholesky
from gmmtorch.localization.rigid_motions import Motions, chosen_rows, generators
from gmmtorch.mapping import touching
from gmmtorch.mixture import Parameters

_CUTOFF = 4.0  # deviations beyond which a pair is left out: its term is below 4e-4 of its maximum
_SLACK = 0.5  # of the thickness: components may move this far before pairs are listed again
_LEAST_CURVATURE = 0.05  # of the information
_LONGEST = 1.0  # step, as the root mean square of the Mahalanobis distances that pairs move by,
_THICKNESSES = 4  # and in thicknesses of the components
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


class Ascent:
    """Climbs log S from B motions in parallel, with one evaluation of the score for each step.

    Steps are Newton's with the absolute values of the curvatures, cut until the score rises. Except for pairs
    near the cutoff the score never falls. Pairs are listed again after components have moved by a fraction of
    their thickness.

    Args:
        source, target: mixtures near the origin.
        radius: metres that the source moves when it turns by a radian.
    """

    def __init__(self, source: Parameters, target: Parameters, radius: float) -> None:
        self.source, self.target = source, target
        self.reach = tuple(_CUTOFF * deviations(mixture)[:, -1] for mixture in (source, target))
        dim = source.means.shape[1]
        self.scale = source.means.new_ones(dim + dim * (dim - 1) // 2)
        self.scale[dim:] = 1 / radius  # a unit of every degree of freedom moves the source by a metre
        self.thickness = float(deviations(source)[:, 0].median() + deviations(target)[:, 0].median())
        self.slack = _SLACK * self.thickness
        self.n_evaluated = 0

    def run(self, motions: Motions, max_iterations: int, tolerance: float) -> tuple[Motions, Overlap, Tensor]:
        """The final motions (B), their overlap, and which of them converged (B,)."""
        listed, pairs = motions, self.pairs(motions)
        state = self.evaluate(motions, pairs)
        share = torch.ones_like(state.log_score)  # of the proposed step that is taken
        active = torch.isfinite(state.log_score)
        for _ in range(max_iterations):
            if not bool(active.any()):
                break
            steps = torch.where(active[:, None], self._steps(state) * share[:, None], 0.0)
            trial = motions.moved(steps)
            if self._strayed(trial, listed):
                rows = active.nonzero().squeeze(1)
                listed, pairs = trial, self.pairs(trial.at(rows))
                pairs = pairs._replace(motion=rows[pairs.motion])
            tried = self.evaluate(trial, pairs.of(active[pairs.motion]))
            better = active & (tried.log_score > state.log_score)
            active &= (steps / self.scale).norm(dim=1) > tolerance
            motions = Motions(*chosen_rows(better, trial, motions))
            state = Overlap(*chosen_rows(better, tried, state))
            share = torch.where(better, (2 * share).clamp_max(1), share / 4)
        return motions, state, ~active & torch.isfinite(state.log_score)

    def evaluate(self, motions: Motions, pairs: Pairs) -> Overlap:
        self.n_evaluated += 1
        return overlap(self.source, self.target, motions, pairs)

    def _steps(self, state: Overlap) -> Tensor:
        """Ascent steps (B, F).

        In coordinates in which the information is the identity, lengths are the Mahalanobis distances that
        pairs move by, so their limit lets a wall slide far along itself. There each axis of the Hessian takes
        Newton's step with the curvature's absolute value, which climbs where the score is convex, too.
        """
        outer = self.scale[:, None] * self.scale
        fisher = state.information * outer
        ridge = 1e-9 * fisher.diagonal(dim1=1, dim2=2).amax(1).clamp_min(1e-12)
        root = safe_cholesky(fisher + ridge[:, None, None] * torch.eye(len(outer)).to(fisher))
        scatter = torch.linalg.solve_triangular(root, state.scatter * outer, upper=False)
        scatter = torch.linalg.solve_triangular(root, scatter.mT, upper=False)
        missing, axes = torch.linalg.eigh((scatter + scatter.mT) / 2)
        slope = torch.linalg.solve_triangular(root, (state.gradient * self.scale)[:, :, None], upper=False)
        parts = (axes.mT @ slope)[:, :, 0] / (1 - missing).abs().clamp_min(_LEAST_CURVATURE)
        parts = parts * (_LONGEST / parts.norm(dim=1, keepdim=True).clamp_min(_LONGEST))
        steps = torch.linalg.solve_triangular(root.mT, axes @ parts[:, :, None], upper=True)[:, :, 0]
        longest = _THICKNESSES * self.thickness
        length = steps.norm(dim=1, keepdim=True)
        return steps * (longest / length.clamp_min(longest)) * self.scale

    def pairs(self, motions: Motions) -> Pairs:
        """Pairs within the cutoff now, or after components have moved by the slack."""
        k, n = len(self.source.weights), len(motions.translations)
        moved = torch.einsum("bij,kj->bki", motions.rotations, self.source.means)
        moved = moved + motions.translations[:, None]
        shapes = motions.rotations[:, None] @ self.source.covariances @ motions.rotations[:, None].mT
        # This ellipsoid contains the ellipsoid of the cutoff enlarged by the ball of the slack.
        scale, wide = 1.2 * _CUTOFF**2, 6 * self.slack**2
        few = n * k * len(self.target.weights) <= MOST_TESTED
        if few and is_fused(moved, *self.target, *self.source):
            reaches = self.reach[0] + self.slack, self.reach[1]
            return Pairs(*near_pairs(moved, shapes, reaches, *self.target[1:], scale, wide))
        moved, shapes = moved.flatten(0, 1), shapes.flatten(0, 1)
        reach = (self.reach[0] + self.slack).repeat(n)
        found = [torch.zeros(2, 0, dtype=torch.int64, device=moved.device)]
        for point, center in touching(self.target.means, self.reach[1], moved, reach):
            near = scale * (shapes[point] + self.target.covariances[center])
            near.diagonal(dim1=1, dim2=2).add_(wide)
            offset = (moved[point] - self.target.means[center])[:, :, None]
            inside = (offset.mT @ torch.linalg.solve(near, offset))[:, 0, 0] <= 1
            found.append(torch.stack([point[inside], center[inside]]))
        point, center = torch.cat(found, 1)
        return Pairs(point // k, point % k, center)

    def _strayed(self, motions: Motions, listed: Motions) -> bool:
        """Whether a component may have moved by more than the slack since pairs were listed."""
        size = float((self.source.means.norm(dim=1) + self.reach[0]).max())
        turn = torch.linalg.matrix_norm(motions.rotations - listed.rotations) / math.sqrt(2)
        shift = (motions.translations - listed.translations).norm(dim=1)
        return bool((shift + turn * size > self.slack).any())


def log_self_overlap(mixture: Parameters) -> float:
    """log ∫ f² dx of a mixture."""
    dim = mixture.means.shape[1]
    still = Motions(torch.eye(dim).to(mixture.means)[None], mixture.means.new_zeros(1, dim))
    ascent = Ascent(mixture, mixture, 1.0)
    return float(ascent.evaluate(still, ascent.pairs(still)).log_score[0])


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

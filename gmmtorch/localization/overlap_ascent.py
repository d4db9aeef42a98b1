"""The ascent of the overlap of two mixtures over rigid motions, many starts at once."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gmmtorch.localization.overlap import Motions, Overlap, Pairs, overlap
from gmmtorch.mapping.surfaces import touching
from gmmtorch.mixture.em.exact import Parameters

CUTOFF = 4.0
"""Deviations beyond which a pair is left out: its term is below 4e-4 of what it could be."""

_SLACK = 0.5  # of the thickness: components may move so far before pairs are listed again
_SADDLE = 0.05  # of the information: with less curvature Newton's step has no sensible length


class Ascent:
    """Climbs log S from B motions at once, with one evaluation of the score a step.

    Newton's steps where −∇² log S is positive definite, else Fisher's, cut until the score rises: over
    the pairs that are listed it never falls. Pairs are listed again when components have moved by a share
    of their thickness.

    Args:
        source, target: mixtures near the origin.
        radius: metres that the source moves when it turns by a radian.
    """

    def __init__(self, source: Parameters, target: Parameters, radius: float) -> None:
        self.source, self.target = source, target
        self.reach = tuple(CUTOFF * deviations(mixture)[:, -1] for mixture in (source, target))
        dim = source.means.shape[1]
        self.scale = source.means.new_ones(dim + dim * (dim - 1) // 2)
        self.scale[dim:] = 1 / radius  # a unit of every degree of freedom moves the source by a metre
        self.thickness = float(deviations(source)[:, 0].median() + deviations(target)[:, 0].median())
        self.slack = _SLACK * self.thickness
        self.n_evaluated = 0

    def run(self, motions: Motions, max_iterations: int, tolerance: float) -> tuple[Motions, Overlap, Tensor]:
        """The motions climbed to (B), what they reach, and which converged (B,)."""
        listed, pairs = motions, self.pairs(motions)
        state = self.evaluate(motions, pairs)
        share = torch.ones_like(state.log_score)  # of the proposed step that is taken
        active = torch.isfinite(state.log_score)
        for _ in range(max_iterations):
            if not bool(active.any()):
                break
            steps = self._steps(state) * share[:, None]
            trial = motions.moved(steps)
            tried = self.evaluate(trial, pairs.of(active[pairs.motion]))
            better = active & (tried.log_score > state.log_score)
            active &= (steps / self.scale).norm(dim=1) > tolerance
            motions = Motions(*(_where(better, n, o) for n, o in zip(trial, motions, strict=True)))
            state = Overlap(*(_where(better, n, o) for n, o in zip(tried, state, strict=True)))
            share = torch.where(better, (2 * share).clamp_max(1), share / 4)
            if self._strayed(motions, listed):
                listed, pairs = motions, self.pairs(motions)
                state = self.evaluate(motions, pairs)
        return motions, state, ~active & torch.isfinite(state.log_score)

    def evaluate(self, motions: Motions, pairs: Pairs) -> Overlap:
        self.n_evaluated += 1
        return overlap(self.source, self.target, motions, pairs)

    def _steps(self, state: Overlap) -> Tensor:
        """Steps uphill (B, F), Newton's or Fisher's, no longer than components are thick."""
        outer = self.scale[:, None] * self.scale
        fisher = state.information * outer
        ridge = 1e-9 * fisher.diagonal(dim1=1, dim2=2).amax(1).clamp_min(1e-12)
        fisher = fisher + ridge[:, None, None] * torch.eye(len(outer)).to(fisher)
        newton = fisher - state.scatter * outer
        _, flawed = torch.linalg.cholesky_ex(newton - _SADDLE * fisher)
        curvature = torch.where((flawed == 0)[:, None, None], newton, fisher)
        steps = torch.linalg.solve(curvature, state.gradient * self.scale)
        length = steps.norm(dim=1, keepdim=True)
        return steps * (self.thickness / length.clamp_min(self.thickness)) * self.scale

    def pairs(self, motions: Motions) -> Pairs:
        """Pairs within the cutoff, and those that may be once components have moved by the slack."""
        k, n = len(self.source.weights), len(motions.translations)
        moved = torch.einsum("bij,kj->bki", motions.rotations, self.source.means)
        moved = (moved + motions.translations[:, None]).flatten(0, 1)
        reach = (self.reach[0] + self.slack).repeat(n)
        shapes = motions.rotations[:, None] @ self.source.covariances @ motions.rotations[:, None].mT
        shapes = shapes.flatten(0, 1)
        found = [torch.zeros(2, 0, dtype=torch.int64, device=moved.device)]
        for point, center in touching(self.target.means, self.reach[1], moved, reach):
            # An ellipsoid of the cutoff and a ball of the slack lie together in this ellipsoid.
            near = CUTOFF**2 * 1.2 * (shapes[point] + self.target.covariances[center])
            near.diagonal(dim1=1, dim2=2).add_(6 * self.slack**2)
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


def deviations(mixture: Parameters) -> Tensor:
    """Standard deviations (K, D) along the principal axes, rising."""
    return torch.linalg.eigvalsh(mixture.covariances).clamp_min(0).sqrt()


def _where(chosen: Tensor, new: Tensor, old: Tensor) -> Tensor:
    """Rows of `new` where `chosen` (B,), else of `old`."""
    return torch.where(chosen.reshape(-1, *[1] * (new.ndim - 1)), new, old)

"""Ascent: climbs the overlap of two mixtures from many rigid motions at once."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gmmtorch.kernels.choice import is_fused
from gmmtorch.kernels.mixtures.near_pairs import MOST_TESTED, near_pairs
from gmmtorch.linalg import safe_cholesky
from gmmtorch.localization.registration.overlap import Overlap, Pairs, deviations, overlap
from gmmtorch.localization.rigid_motions import Motions, chosen_rows
from gmmtorch.mapping.surfaces import touching
from gmmtorch.mixture.em.exact import Parameters

CUTOFF = 4.0
"""Deviations beyond which a pair is left out: its term is below 4e-4 of its maximum."""

_SLACK = 0.5  # of the thickness: components may move this far before pairs are listed again
_LEAST_CURVATURE = 0.05  # of the information
_LONGEST = 1.0  # step, as the root mean square of the Mahalanobis distances that pairs move by,
_THICKNESSES = 4  # and in thicknesses of the components


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
        self.reach = tuple(CUTOFF * deviations(mixture)[:, -1] for mixture in (source, target))
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
        scale, wide = 1.2 * CUTOFF**2, 6 * self.slack**2
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

"""Pairs of a noisy point and a component that may have a share in it, worked on all at once.

A point with noise covariance R has under component k the covariance T = Σ_k + R, its own in every
pair; so there are N·K small matrices to factorise. Two things keep that cheap. Most pairs have no share
that double precision could tell from nothing, and two plain mixtures, evaluated as matrix products,
say which these are. And small matrices are kept entry by entry, so that each step of a factorisation
is one operation on a whole tensor of pairs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.errors import NumericalError
from gmmtorch.mixture.em import exact as em
from gmmtorch.mixture.em.exact import Parameters

_CHUNK_ELEMENTS = 1 << 16
"""Entries of the N×K block worked on at once, so that it stays in a core's cache."""

_NEGLIGIBLE = 40.0
"""Nats below a point's likeliest component at which another has no share in double precision."""

Entries = list[list[Tensor]]
"""A batch of small matrices as a tensor for each entry."""


class Pairs(NamedTuple):
    """P pairs of one of n points and one of K components that may have a share in it.

    row (P,), component (P,); joint (P,): log π + log N(x | μ, T); log_likelihood (n,): log Σ_k of all
    the pairs of a point; the entries of W, WᵀW = T⁻¹, and of x − μ, (P,) each.
    """

    row: Tensor
    component: Tensor
    joint: Tensor
    log_likelihood: Tensor
    whiten: Entries
    offset: list[Tensor]


def chunks(points: Tensor, noise: Tensor, parameters: Parameters) -> Iterator[tuple[slice, Pairs]]:
    """Rows of the points, a chunk at a time, and their pairs, but those surely below e^−40 of the largest."""
    bounds = _log_bounds(noise, parameters)
    rows = max(1, _CHUNK_ELEMENTS // parameters.weights.shape[0])
    for begin in range(0, points.shape[0], rows):
        part = slice(begin, begin + rows)
        at_least, at_most = bounds(points[part].detach())
        at_most = torch.maximum(at_most, at_least)  # whatever the rounding, the likeliest stays
        row, component = (at_most >= at_least.amax(1, keepdim=True) - _NEGLIGIBLE).nonzero(as_tuple=True)
        yield part, _pairs(points[part], noise[part], parameters, row, component)


def _log_bounds(noise: Tensor, parameters: Parameters) -> Callable[[Tensor], tuple[Tensor, Tensor]]:
    """What gives log π_k + log N(x | μ_k, Σ_k + R) (n, K) of points from below and above, for any of the R.

    As low I ≼ R ≼ high I, both the determinant and the quadratic form of Σ + R lie between those of
    Σ + low I and Σ + high I: two plain mixtures, cheap to evaluate, bound every log-density.
    """
    spread = torch.linalg.eigvalsh(noise)
    low, high = spread[:, 0].amin().clamp_min(0), spread[:, -1].amax()
    eye = torch.eye(noise.shape[-1], dtype=noise.dtype, device=noise.device)
    thin, wide = (parameters._replace(covariances=parameters.covariances + r * eye) for r in (low, high))
    slack = 0.5 * (torch.logdet(wide.covariances) - torch.logdet(thin.covariances))
    if em.is_ill_conditioned(thin):
        return lambda x: (em.log_joint(x, thin) - slack, em.log_joint(x, wide) + slack)
    lower, upper = em.natural_parameters(thin).T, em.natural_parameters(wide).T

    def bounds(points: Tensor) -> tuple[Tensor, Tensor]:
        features = em.quadratic_features(points)
        return features @ lower - slack, features @ upper + slack

    return bounds


def _pairs(points: Tensor, noise: Tensor, parameters: Parameters, row: Tensor, component: Tensor) -> Pairs:
    """What there is to know of the pairs (row, component), of which every row has one at least."""
    weights, means, covariances = parameters
    axes = range(points.shape[1])
    own, other = gathered(covariances, component), gathered(noise, row)
    whiten, half_log_det = _inverse_factor_entries(
        [[own[i][j] + other[i][j] for j in axes[: i + 1]] for i in axes]
    )
    offset = list((points.T.index_select(1, row) - means.T.index_select(1, component)).unbind())
    squared = torch.zeros_like(half_log_det)
    for line in whiten:
        squared = squared + dot(line, offset[: len(line)]).square()
    constant = torch.log(weights).clamp_min(-1e30) - 0.5 * len(axes) * math.log(2 * math.pi)
    joint = constant[component] - half_log_det - 0.5 * squared
    peak = joint.detach().new_empty(points.shape[0])
    peak.scatter_reduce_(0, row, joint.detach(), "amax", include_self=False)
    total = torch.zeros_like(peak).index_add(0, row, torch.exp(joint - peak[row]))
    likelihood = peak + torch.log(total)
    return Pairs(row, component, joint, likelihood, whiten, offset)


def gathered(matrices: Tensor, index: Tensor) -> Entries:
    """Entries of the matrices (M, D, D) at an index (P,): each (P,), contiguous."""
    dim = matrices.shape[-1]
    entries = matrices.flatten(1).T.contiguous().index_select(1, index).unbind()
    return [list(entries[i * dim : (i + 1) * dim]) for i in range(dim)]


def dot(left: list[Tensor], right: list[Tensor]) -> Tensor:
    total = left[0] * right[0]
    for a, b in zip(left[1:], right[1:], strict=True):
        total = torch.addcmul(total, a, b)
    return total


def _inverse_factor_entries(lower: Entries) -> tuple[Entries, Tensor]:
    """L⁻¹ and log|L| of symmetric matrices M = LLᵀ given by the entries of their lower triangle."""
    dim = len(lower)
    factor: Entries = []
    inverse: Entries = []
    log_det = torch.zeros_like(lower[0][0])
    for i in range(dim):
        row: list[Tensor] = []
        for j in range(i):
            rest = lower[i][j] - dot(row, factor[j][:j]) if j else lower[i][j]
            row.append(rest * inverse[j][j])
        pivot = lower[i][i] - dot(row, row) if i else lower[i][i]
        if not bool((pivot > 0).all()):  # NaN fails too
            raise NumericalError(
                "A component's covariance with a point's noise is not positive definite; raise reg_covar "
                "(1e-6 m² is usual), and check noise_covariances."
            )
        root = pivot.rsqrt()
        log_det = log_det + 0.5 * pivot.log()
        inverse.append(
            [-dot(row[j:], [inverse[m][j] for m in range(j, i)]) * root for j in range(i)] + [root]
        )
        factor.append([*row, pivot * root])
    return inverse, log_det

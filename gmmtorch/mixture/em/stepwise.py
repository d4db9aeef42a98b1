"""Stepwise EM: a mixture that is updated batch by batch.

The running statistics are S ← (1 − η) S + η s, with s the statistics of the batch a point, and the
M-step gives the parameters from S (Cappé & Moulines, 2009; Liang & Klein, 2009). Weights, means and
covariances are equivalent to S, so no statistics are stored. Each update merges, component by
component, the mixture with the result of one EM step on the batch. Nothing cancels at any distance
from the origin, and covariances stay positive definite.
"""

from __future__ import annotations

import numbers

import torch

from gmmtorch.errors import InvalidArgumentError, check_number
from gmmtorch.mixture.em.exact import Parameters
from gmmtorch.mixture.reduction.moments import merge_pairs


def step_size(batch: float, seen: float, kappa: float) -> float:
    """η = (n / (m + n))^κ, for a batch of weight n after points of weight m.

    For batches of equal size η is (t + 1)^−κ, t = 0, 1, …: Liang & Klein's (t + 2)^−κ after a first batch
    with η = 1. With κ = 1 every point counts equally, in batches of any size.
    """
    return float((batch / (seen + batch)) ** kappa)


def blend(previous: Parameters, update: Parameters, step: float, kind: str = "full") -> Parameters:
    """The M-step on (1 − η) S + η s, η = `step`, where `previous` and `update` are the parameters of S and s.

    `update` is an EM step from `previous`, in the same frame. The regularisation variance, which is part
    of both, is in the result once. Covariances have the shape of their type, `kind`.
    """
    first = previous._replace(weights=(1 - step) * previous.weights)
    second = update._replace(weights=step * update.weights)
    if kind == "full":
        return merge_pairs(first, second)
    weights = first.weights + second.weights
    share = torch.where(weights > 0, second.weights / weights, 0.5)[:, None]
    offset = second.means - first.means
    means = first.means + share * offset
    if kind == "tied":
        between = (weights[:, None] * share * (1 - share) * offset).T @ offset
        within = first.weights.sum() * first.covariances + second.weights.sum() * second.covariances
        return Parameters(weights, means, (within + between) / weights.sum())
    square = offset.square()
    if kind == "spherical":
        share, square = share[:, 0], square.mean(1)
    covariances = (1 - share) * first.covariances + share * second.covariances + (1 - share) * share * square
    return Parameters(weights, means, covariances)


def weight_of_past(seen: float | None, memory: float | None) -> float:
    """Number of points that the current mixture counts as: `seen` (None: unknown), at most `memory`.

    Raises:
        InvalidArgumentError: an invalid memory, or memory=None if `seen` is unknown.
    """
    if memory is None:
        if seen is None:
            raise InvalidArgumentError(
                "memory=None, but the number of points that this mixture stands for is unknown; pass memory, "
                "the number of points that it counts as."
            )
        return seen
    check_number("memory", memory)
    return float(memory) if seen is None else min(seen, float(memory))


def check_kappa(kappa: object) -> float:
    """Returns κ of `step_size`.

    Raises `InvalidArgumentError` unless 0.5 < κ ≤ 1, for which steps converge.
    """
    if not isinstance(kappa, numbers.Real) or not 0.5 < float(kappa) <= 1:
        raise InvalidArgumentError(f"kappa={kappa!r} must be above 0.5 and at most 1.")
    return float(kappa)

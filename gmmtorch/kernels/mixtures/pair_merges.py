"""Mixtures reduced in rounds of merges, as in `mixture.reduction`; and the choice of the viewpoints that
components keep, as in `mapping.learning.merging`.

One launch does all rounds.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gmmtorch.kernels.compiler import Team, templated

_MERGES = templated("mixtures/pair_merges.h", "pair_merges", range(2, 7), shares=True, rounds_each=True)
SELECTION_COUNTS = 16 * 256
"""Counts by which a team finds the smallest numbers, as in `selection.h`."""


def is_pair_merges_fused(dim: int) -> bool:
    """Whether there is a kernel for this number of dimensions."""
    return dim in _MERGES


def pair_merges(
    order: Tensor,
    weights: Tensor,
    means: Tensor,
    covariances: Tensor,
    least: int,
    limit: float,
    is_hellinger: bool,
    neighbors: int,
) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor, Tensor]] | None:
    """Merge pairs of K components until `least` are left, or the cost of every pair is above `limit`.

    order: (K,), their rows along an axis. weights (K,), means (K, D), covariances (K, D, D), float64.

    Returns the first member (K,) of the component that each was merged into; at these rows the number of
    members (K,), and weights, means and covariances. Returns None if a covariance, given or to be merged, is
    not positive definite, or its determinant is beyond 10^±280.
    """
    k, dim = means.shape
    given = weights, means, covariances
    made = weights.new_empty(k), weights.new_empty(k, dim), weights.new_empty(k, dim, dim)
    members, lead = torch.empty_like(order), torch.empty_like(order)
    block = 8 * max(4, math.isqrt(k) // 8)  # about as many blocks as rows in each
    scratch = weights.new_empty((k + 2 * block) * (3 + 3 * dim + dim**2 + 2 * neighbors))
    whole = order.new_empty(k * (5 + neighbors))
    counts = torch.empty(SELECTION_COUNTS, dtype=torch.int32, device=order.device)
    failed = torch.zeros(1, dtype=torch.bool, device=order.device)
    team = Team.of(order.device)
    rule = least, limit, is_hellinger, neighbors, block
    _MERGES[dim](
        team.n, *team, k, order, *given, *rule, *made, members, lead, failed, scratch, whole, counts,
    )  # fmt: skip
    return None if bool(failed) else (lead, members, made)


_CHOICES = templated("mixtures/viewpoint_choice.h", "viewpoint_choice", (2, 3), shares=True, rounds_each=True)


def viewpoint_choice(
    by: Tensor, seen_from: Tensor, count: Tensor, origins: Tensor, support: Tensor, most: int, limit: int
) -> tuple[Tensor, Tensor | None, bool]:
    """Choose at most `most` of the viewpoints (E,) of each of K components, and at most `limit` in all.

    by, seen_from, count (E,), origins (S, D), support (K,): as in `Components`.

    Returns counts (E,), those of the chosen ones scaled to add up to the support; the rows of the chosen ones
    (J,), None for all; and whether it is known that every origin has one.
    """
    device, (n_origins, dim), e = by.device, origins.shape, len(by)
    given = by.argsort(stable=True), by, seen_from, count, origins
    gain, nearest, scaled = torch.empty(3, e, dtype=count.dtype, device=device)
    flags = torch.zeros(e + n_origins, dtype=torch.bool, device=device)
    counts = torch.zeros(SELECTION_COUNTS + 2, dtype=torch.int32, device=device)
    team, is_kept = Team.of(device), flags[:e]
    choice = gain, nearest, scaled, is_kept, flags[e:], counts[SELECTION_COUNTS:]
    sizes, table = (len(support), e), (n_origins, support)
    _CHOICES[dim](team.n, *team, *sizes, *given, *table, *choice, most, limit, counts)
    n_kept, n_used = counts[SELECTION_COUNTS:].tolist()
    return scaled, None if n_kept == e else is_kept.nonzero().squeeze(1), n_used == n_origins

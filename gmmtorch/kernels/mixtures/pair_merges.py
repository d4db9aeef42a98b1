"""Mixtures reduced in rounds of merges, as in `mixture.reduction`; and the choice of the viewpoints that
components keep, as in `mapping.learning.merging`.

One launch does all rounds.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gmmtorch.kernels.compiler import Team, buffers, templated

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

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
) -> tuple[Ints, Ints, Floats, Floats, Floats] | None:
    """Merge pairs of K components until `least` are left, or the cost of every pair is above `limit`.

    order: (K,), their rows along an axis. weights (K,), means (K, D), covariances (K, D, D), float64.

    Returns the first member (K,) of the component that each was merged into; at these rows the number of
    members (K,), and weights, means and covariances. Returns None if a covariance, given or to be merged, is
    not positive definite, or its determinant is beyond 10^±280.
    """
    k, dim = means.shape
    block = 8 * max(4, math.isqrt(k) // 8)  # about as many blocks as rows in each
    n_scratch, device = (k + 2 * block) * (3 + 3 * dim + dim**2 + 2 * neighbors), order.device
    sizes = k * (1 + dim + dim * dim), n_scratch
    found, scratch = buffers(device, torch.float64, sizes)
    rows, whole = buffers(device, torch.int64, (2 * k, k * (5 + neighbors)))
    counts, failed = buffers(device, torch.int32, (SELECTION_COUNTS, 1), is_zero=True)
    made = found[:k], found[k : k + k * dim], found[k + k * dim :]
    team, rule = Team.of(device), (least, limit, is_hellinger, neighbors, block)
    given = k, order, weights, means, covariances
    _MERGES[dim](
        team.n, *team, *given, *rule, *made, rows[:k], rows[k:], failed, scratch, whole, counts,
    )  # fmt: skip
    if not isinstance(found, np.ndarray):  # one wait for all
        every = [torch.as_tensor(part).view(-1) for part in (rows, failed)]
        both = torch.cat([found.view(torch.int64), *(part.long() for part in every)]).cpu().numpy()
        found, rows, failed = both[: len(found)].view(np.float64), both[len(found) : -1], both[-1:]
    if failed[0]:
        return None
    values, numbers = np.asarray(found), np.asarray(rows)
    shapes = values[k : k + k * dim].reshape(k, dim), values[k + k * dim :].reshape(k, dim, dim)
    return numbers[k:], numbers[:k], values[:k], *shapes


_CHOICES = templated("mixtures/viewpoint_choice.h", "viewpoint_choice", (2, 3), shares=True, rounds_each=True)


def viewpoint_choice(
    by: Ints, seen_from: Ints, count: Floats, origins: Tensor, support: Tensor, most: int, limit: int
) -> tuple[Floats, NDArray[np.bool_], bool]:
    """Choose at most `most` of the viewpoints (E,) of each of K components, and at most `limit` in all.

    by, seen_from, count (E,), origins (S, D), support (K,): as in `Components`, on the CPU.

    Returns counts (E,), those of the chosen ones scaled to add up to the support; which are chosen (E,); and
    whether it is known that every origin has one.
    """
    (n_origins, dim), e = origins.shape, len(by)
    given = by.argsort(kind="stable"), by, seen_from, count, origins
    gain, nearest, scaled = np.empty((3, e))
    is_kept, is_used = np.zeros(e, bool), np.zeros(n_origins, bool)
    counts, found = np.zeros(SELECTION_COUNTS, np.int32), np.zeros(2, np.int32)
    choice, team = (gain, nearest, scaled, is_kept, is_used, found), Team(1, None)
    sizes, table = (len(support), e), (n_origins, support)
    _CHOICES[dim](team.n, *team, *sizes, *given, *table, *choice, most, limit, counts)
    return scaled, is_kept, int(found[1]) == n_origins

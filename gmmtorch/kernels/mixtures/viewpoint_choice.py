"""Which viewpoints components keep; the twin, with the rule, is in `mapping.learning.merging`."""

from __future__ import annotations

import torch
from torch import Tensor

from gmmtorch.kernels.compiler import FusedKernel, Team
from gmmtorch.kernels.mixtures.pair_merges import SELECTION_COUNTS

_CHOICES = {
    dim: FusedKernel("mixtures/viewpoint_choice.h", f"viewpoint_choice<{dim}>", shares=True, rounds_each=True)
    for dim in (2, 3)
}


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

"""Whence components were seen: sightings united as components merge, and the few that are kept."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, check_whole
from gmmtorch.mapping.components import Components


def united_sightings(components: Components, labels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """seen_by, seen_from, seen_count (E′,) of components merged by label (K,): each pair once, in order.

    Counts of the same origin add up.
    """
    n_origins = max(1, components.origins.shape[0])
    keys, row = torch.unique(
        labels[components.seen_by] * n_origins + components.seen_from, return_inverse=True
    )
    count = components.seen_count.new_zeros(keys.shape[0]).index_add_(0, row, components.seen_count)
    return keys // n_origins, keys % n_origins, count


def limit_origins(components: Components, max_origins: int, mean_origins: float | None = None) -> Components:
    """At most `max_origins` sightings of each component, and `mean_origins` on average; the counts of
    what is left again add up to each component's support.

    Of each component the sighting of the largest count is kept, then again and again the one with the
    largest √count times its distance from the nearest origin kept: neighbouring places tell the same of
    space, and a place that saw little of a component would claim to have seen all of it. Where that
    leaves too many, those further ones go, over all components, whose product was least: so large
    surfaces keep many origins and small ones one. Origins are real ones: centroids lose the space
    around the sensors.

    Origins that nothing was seen from are dropped. Raises `InvalidArgumentError` for less than one.
    """
    check_whole("max_origins", max_origins, 1)
    if mean_origins is not None and not 1 <= mean_origins < math.inf:
        raise InvalidArgumentError(f"mean_origins={mean_origins} must be at least 1.")
    kept = _most_worth(components, max_origins, mean_origins)
    by, count = components.seen_by[kept], components.seen_count[kept]
    total = count.new_zeros(len(components)).index_add_(0, by, count)
    share = components.support / total.clamp_min(torch.finfo(total.dtype).tiny)
    used, seen_from = torch.unique(components.seen_from[kept], return_inverse=True)
    return replace(
        components,
        origins=components.origins[used],
        seen_by=by,
        seen_from=seen_from,
        seen_count=count * share[by],
    )


def _most_worth(components: Components, max_origins: int, mean_origins: float | None) -> Tensor:
    """Which sightings (E,) to keep."""
    by, count = components.seen_by, components.seen_count
    n, rows = len(components), torch.arange(components.seen_by.shape[0], device=components.seen_by.device)
    limit = n * max_origins if mean_origins is None else int(n * mean_origins)
    left = count > 0
    if n == 0 or (int(left.sum()) <= limit and int(torch.bincount(by[left]).max()) <= max_origins):
        return left
    worth, position = count.sqrt(), components.origins[components.seen_from]
    apart = torch.ones_like(count)
    rank = torch.full_like(count, -1.0)  # of what is chosen: how much it adds
    for step in range(max_origins):
        adds = torch.where(left, worth * apart, -1.0)
        most = adds.new_full((n,), -1.0).scatter_reduce_(0, by, adds, "amax")
        best = left & (adds == most[by])
        first = rows.new_full((n,), len(rows)).scatter_reduce_(0, by[best], rows[best], "amin")
        chosen = first[first < len(rows)]
        if len(chosen) == 0:
            break
        rank[chosen] = torch.inf if step == 0 else adds[chosen]
        left = left.index_fill(0, chosen, False)
        place = position.new_full((n, components.dim), torch.inf).index_copy_(0, by[chosen], position[chosen])
        distance = (position - place[by]).norm(dim=1)
        apart = distance if step == 0 else torch.minimum(apart, distance)
    kept = torch.zeros_like(left)
    kept[rank.argsort(descending=True, stable=True)[:limit]] = True
    return kept & (rank >= 0)

"""Viewpoints of components: their assignment when components are learned, their union and their reduction.

A viewpoint is a sensor origin from which a component was observed, with the count of points observed from it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, check_whole
from gmmtorch.linalg import on_cpu
from gmmtorch.mapping.components import Components


class AssignedViewpoints(NamedTuple):
    """kept (K′,): rows of the components that keep at least one viewpoint; their support (K′,); and
    seen_by, seen_from, seen_count (E,) of their viewpoints, as in `Components`. On the CPU."""

    kept: Tensor
    support: Tensor
    seen_by: Tensor
    seen_from: Tensor
    seen_count: Tensor


AssignViewpoints = Callable[[Tensor, Tensor, float], AssignedViewpoints]
"""From the points (K, S) of each component in each scan, the weights (K,) and the number of points.

A component that is no point's most likely one has no points; it is dropped.
"""


def all_origins(weight: float = 1.0) -> AssignViewpoints:
    """Keeps every origin. `weight`: number of measured points for which each point stands.

    The support of the components that are kept adds up to weight · N.
    """

    def assign(counts: Tensor, weights: Tensor, n_points: float) -> AssignedViewpoints:
        counts, weights = on_cpu(counts, weights)
        kept = (counts.sum(1) > 0).nonzero().squeeze(1)
        counts, support = counts[kept], weights[kept]
        support = support * (n_points * weight / support.sum())
        counts *= (support / counts.sum(1))[:, None]
        seen_by, seen_from = (counts > 0).nonzero(as_tuple=True)
        return AssignedViewpoints(kept, support, seen_by, seen_from, counts[seen_by, seen_from])

    return assign


def sampled_origins(max_origins: int, generator: torch.Generator) -> AssignViewpoints:
    """Keeps at most `max_origins` origins of a component, drawn by their counts without replacement.

    The origins that are kept share the component's support, weight · N. They are real sensor origins:
    a centroid of several would lose the free space around the sensors.
    """

    def assign(counts: Tensor, weights: Tensor, n_points: float) -> AssignedViewpoints:
        counts, weights = on_cpu(counts, weights)
        support = weights * n_points
        n_kept = min(max_origins, counts.shape[1])
        if n_kept < counts.shape[1]:
            race = torch.empty(counts.shape, dtype=torch.float64).exponential_(generator=generator)
            key = torch.where(counts > 0, race / counts.clamp_min(1), float("inf"))
            drawn = key.topk(n_kept, dim=1, largest=False).indices
            counts = torch.zeros_like(counts).scatter_(1, drawn, counts.gather(1, drawn))
        share = counts * (support / counts.sum(1).clamp_min(1e-12))[:, None]
        seen_by, seen_from = (share > 0).nonzero(as_tuple=True)
        has_one = (share > 0).any(1)
        number = torch.cumsum(has_one.long(), 0) - 1
        kept, seen_count = has_one.nonzero().squeeze(1), share[seen_by, seen_from]
        return AssignedViewpoints(kept, support[kept], number[seen_by], seen_from, seen_count)

    return assign


def union_of_viewpoints(components: Components, labels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """seen_by, seen_from, seen_count (E′,) of components merged by label (K,); counts of an origin add up.

    Each pair of component and origin occurs once, in rising order.
    """
    n_origins = max(1, components.origins.shape[0])
    keys, row = torch.unique(
        labels[components.seen_by] * n_origins + components.seen_from, return_inverse=True
    )
    count = components.seen_count.new_zeros(keys.shape[0]).index_add_(0, row, components.seen_count)
    return keys // n_origins, keys % n_origins, count


def limit_origins(components: Components, max_origins: int, mean_origins: float | None = None) -> Components:
    """Components with at most `max_origins` viewpoints each, and at most `mean_origins` on average.

    The viewpoint with the largest count is kept first. Then, repeatedly, the viewpoint with the largest
    √count · distance to the nearest kept origin: close origins observe the same free space, and an origin
    with a small count would claim to have observed all of the component. If the average is still too large,
    the viewpoints with the smallest such product are removed over all components, so large surfaces keep
    many origins and small ones one. Kept counts are scaled to add up to each component's support; origins
    without a viewpoint are dropped. Origins stay real positions: a centroid loses the space around sensors.

    Raises `InvalidArgumentError` for limits below 1.
    """
    check_whole("max_origins", max_origins, 1)
    if mean_origins is not None and not 1 <= mean_origins < math.inf:
        raise InvalidArgumentError(f"mean_origins={mean_origins} must be at least 1.")
    kept, all_used = _kept_viewpoints(components, max_origins, mean_origins)
    by, count, seen_from = components.seen_by, components.seen_count, components.seen_from
    if kept is not None:
        by, count, seen_from = by[kept], count[kept], seen_from[kept]
    total = count.new_zeros(len(components)).index_add_(0, by, count)
    share = components.support / total.clamp_min(torch.finfo(total.dtype).tiny)
    limited = replace(components, seen_by=by, seen_from=seen_from, seen_count=count * share[by])
    return limited if all_used else limited.with_used_origins()


def _kept_viewpoints(
    components: Components, max_origins: int, mean_origins: float | None
) -> tuple[Tensor | None, bool]:
    """The viewpoints (E′,) that `limit_origins` keeps, in rising order, None: all; and whether it is known
    that every origin then has one.
    """
    by, count = components.seen_by, components.seen_count
    n, n_rows = len(components), components.seen_by.shape[0]
    limit = n * max_origins if mean_origins is None else int(n * mean_origins)
    left = count > 0
    if n == 0:
        return None, False
    n_origins = components.origins.shape[0]
    per_component = by.new_zeros(n).index_add_(0, by, left.long())
    used = by.new_zeros(n_origins).index_fill_(0, components.seen_from, 1)
    n_left, most, n_used = torch.stack([left.sum(), per_component.max(), used.sum()]).tolist()
    if n_left <= limit and most <= max_origins:
        if n_left == n_rows:
            return None, n_used == n_origins
        return left.nonzero().squeeze(1), False
    worth, position = count.sqrt(), components.origins[components.seen_from]
    nearest = torch.ones_like(count)  # distance to the nearest kept origin of the same component
    # A component without a viewpoint that is left chooses one more row at the end, which does not count.
    rows, left = torch.arange(n_rows, device=by.device), torch.cat([left, left.new_zeros(1)])
    gain = count.new_full((n_rows + 1,), -1.0)  # √count · distance at which a viewpoint was chosen
    nowhere = position.new_full((1, components.dim), torch.inf)
    for step in range(min(max_origins, most)):
        score = torch.where(left[:-1], worth * nearest, -1.0)
        largest = score.new_full((n,), -1.0).scatter_reduce_(0, by, score, "amax")
        best = torch.where(left[:-1] & (score == largest[by]), rows, n_rows)
        chosen = rows.new_full((n,), n_rows).scatter_reduce_(0, by, best, "amin")
        gain.scatter_(0, chosen, torch.inf if step == 0 else torch.cat([score, score[:1]])[chosen])
        left.index_fill_(0, chosen, False)
        distance = (position - torch.cat([position, nowhere])[chosen][by]).norm(dim=1)
        nearest = distance if step == 0 else torch.minimum(nearest, distance)
    gain, kept = gain[:-1], torch.zeros_like(left[:-1])
    kept[gain.argsort(descending=True, stable=True)[:limit]] = True
    return (kept & (gain >= 0)).nonzero().squeeze(1), False

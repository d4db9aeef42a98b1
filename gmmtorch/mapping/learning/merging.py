"""Fewer components for nearly the same map: merging under an error bound and under a budget."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, check_whole
from gmmtorch.mapping.components import UNNUMBERED, Components
from gmmtorch.mapping.learning.viewpoints import limit_origins, union_of_viewpoints
from gmmtorch.mixture.em.exact import Parameters
from gmmtorch.mixture.reduction.merge import simplify
from gmmtorch.mixture.reduction.moments import merge_components

Size = Callable[[Components], int]
"""Bytes that components take once written."""


def estimated_bytes(components: Components) -> int:
    """About what a file of the components takes: 16 bytes each, 2 for each sighting beyond the first, 7
    for each origin, 300 in all."""
    further = components.seen_by.shape[0] - len(components)
    return 300 + 16 * len(components) + 2 * max(0, further) + 7 * components.origins.shape[0]


def merged(components: Components, labels: Tensor) -> Components:
    """Components with the same label (K,) as one each, moments and counts preserved, origins united.

    `labels` are numbered without gaps; who has a label of its own keeps every bit. Those that were
    merged have no number (`UNNUMBERED`) and the robot of the first of them.
    """
    n = int(labels.max()) + 1 if labels.numel() else 0
    members = torch.bincount(labels, minlength=n)
    rows = torch.arange(len(components), device=labels.device)
    first = rows.new_full((n,), len(components)).scatter_reduce_(0, labels, rows, "amin")
    joined = merge_components(components.support, components.means, components.covariances, labels, n)
    alone = members == 1
    ids = components.ids[first]
    ids[~alone, 1] = UNNUMBERED
    by, whence, count = union_of_viewpoints(components, labels)
    return replace(
        components,
        means=torch.where(alone[:, None], components.means[first], joined.means),
        covariances=torch.where(alone[:, None, None], components.covariances[first], joined.covariances),
        support=torch.where(alone, components.support[first], joined.weights),
        max_range=components.max_range[first],
        ids=ids,
        seen_by=by,
        seen_from=whence,
        seen_count=count,
    )


def compact(
    components: Components, max_components: int | None = None, max_cost: float | None = None
) -> Components:
    """Components merged, the cheapest pairs first, until they are few enough; what costs little always.

    Surfaces merge with surfaces, and the ends of beams without return with their like; where both are
    too many, both shrink in proportion. Total support, mean and covariance of either stay as they are.

    Args:
        components: with any number of origins each.
        max_components: left at most; the pair to merge is that of the least bound on the
            Kullback–Leibler divergence of the map, weighted by support (Runnalls).
        max_cost: squared Hellinger distance, from 0 to 1, up to which two components are merged even
            if there is room for both.

    Raises:
        InvalidArgumentError: neither, or one that cannot be.
    """
    if max_components is None and max_cost is None:
        raise InvalidArgumentError("max_components=None and max_cost=None: give one, or both.")
    if max_components is not None:
        check_whole("max_components", max_components, 1)
    if max_cost is not None:
        components = _merged_by_kind(components, None, max_cost)
    if max_components is not None and len(components) > max_components:
        components = _merged_by_kind(components, max_components, None)
    return components


def _merged_by_kind(components: Components, limit: int | None, max_cost: float | None) -> Components:
    labels = torch.zeros(len(components), dtype=torch.int64, device=components.means.device)
    n_labels = 0
    for flag, share in _shares(components.max_range, limit).items():
        rows = (components.max_range == flag).nonzero().squeeze(1)
        if len(rows) == 0:
            continue
        if share == 0:  # a budget of one for both kinds: surfaces stay
            return _merged_by_kind(_only(components, ~components.max_range), limit, max_cost)
        given = Parameters(components.support[rows], components.means[rows], components.covariances[rows])
        cost = "hellinger" if limit is None else "kullback_leibler"
        found = simplify(given, share, max_cost, cost, most_exact=0)
        labels[rows] = found.labels + n_labels
        n_labels += found.parameters.weights.shape[0]
    return merged(components, _by_first_member(labels))


def _shares(max_range: Tensor, limit: int | None) -> dict[bool, int | None]:
    """Components left of each kind."""
    if limit is None:
        return {False: None, True: None}
    n, n_empty = max_range.shape[0], int(max_range.sum())
    if n_empty in (0, n):
        return {False: limit, True: limit}
    empty = min(max(1, round(limit * n_empty / n)), limit - 1)
    return {False: limit - empty, True: empty}


def _only(components: Components, chosen: Tensor) -> Components:
    """The components marked in `chosen` (K,)."""
    number = torch.cumsum(chosen.long(), 0) - 1
    sighting = chosen[components.seen_by]
    return replace(
        components,
        means=components.means[chosen],
        covariances=components.covariances[chosen],
        support=components.support[chosen],
        max_range=components.max_range[chosen],
        ids=components.ids[chosen],
        seen_by=number[components.seen_by[sighting]],
        seen_from=components.seen_from[sighting],
        seen_count=components.seen_count[sighting],
    )


def _by_first_member(labels: Tensor) -> Tensor:
    """Labels (K,) renumbered in the order in which they first occur."""
    n = int(labels.max()) + 1 if labels.numel() else 0
    rows = torch.arange(labels.shape[0], device=labels.device)
    first = rows.new_full((n,), labels.shape[0]).scatter_reduce_(0, labels, rows, "amin")
    rank = torch.empty_like(first)
    rank[first.argsort()] = torch.arange(n, device=labels.device)
    return rank[labels]


def compact_to_bytes(
    components: Components,
    max_bytes: int,
    max_origins: int,
    mean_origins: float | None = None,
    size: Size = estimated_bytes,
) -> Components:
    """Components merged until they take at most `max_bytes` by `size`; origins as by `limit_origins`.

    Raises `InvalidArgumentError` where not even one component fits.
    """
    check_whole("max_bytes", max_bytes, 1)
    components = limit_origins(components, max_origins, mean_origins)
    while len(components) and (taken := size(components)) > max_bytes:
        if len(components) == 1:
            if components.seen_by.shape[0] == 1:
                raise InvalidArgumentError(
                    f"max_bytes={max_bytes} is less than the {taken} that one component takes; allow more."
                )
            components = limit_origins(components, 1)
            continue
        fixed = size(Components.empty(components.dim, components.means.device))
        room = max(0, max_bytes - fixed) / max(1, taken - fixed)
        wanted = max(1, min(len(components) - 1, int(len(components) * room)))
        components = limit_origins(compact(components, wanted), max_origins, mean_origins)
    return components

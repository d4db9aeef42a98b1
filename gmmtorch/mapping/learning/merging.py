"""Merging of components: fewer components for nearly the same map, under an error bound or a budget."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, check_whole
from gmmtorch.mapping.components import UNNUMBERED, Components
from gmmtorch.mapping.learning.viewpoints import limit_origins, union_of_viewpoints
from gmmtorch.mixture import Parameters, merge_components, simplify

Size = Callable[[Components], int]
"""Number of bytes of the file of given components."""

_GROWTH = 1.08
"""A share s of the bytes holds about s^_GROWTH of the components, because merged ones take more bytes."""


def estimated_bytes(components: Components) -> int:
    """Estimate of the file size: 16 bytes a component, 2 a viewpoint beyond the first, 7 an origin, 300 in
    all."""
    further = components.seen_by.shape[0] - len(components)
    return 300 + 16 * len(components) + 2 * max(0, further) + 7 * components.origins.shape[0]


def merged(components: Components, labels: Tensor) -> Components:
    """Merges the components of each label (K,). Moments and counts are preserved, viewpoints are united.

    Labels are 0, 1, … without gaps. A component with a label of its own stays bit-identical. A merged
    component is `UNNUMBERED` and has the robot of its first member.
    """
    n = int(labels.max()) + 1 if labels.numel() else 0
    members = torch.bincount(labels, minlength=n)
    first = _first_rows(labels, n)
    joined = merge_components(components.support, components.means, components.covariances, labels, n)
    single = members == 1
    ids = components.ids[first]
    ids[~single, 1] = UNNUMBERED
    seen_by, seen_from, seen_count = union_of_viewpoints(components, labels)
    return replace(
        components,
        means=torch.where(single[:, None], components.means[first], joined.means),
        covariances=torch.where(single[:, None, None], components.covariances[first], joined.covariances),
        support=torch.where(single, components.support[first], joined.weights),
        max_range=components.max_range[first],
        ids=ids,
        seen_by=seen_by,
        seen_from=seen_from,
        seen_count=seen_count,
    )


def compact(
    components: Components, max_components: int | None = None, max_cost: float | None = None
) -> Components:
    """Merges pairs, cheapest first: all pairs up to `max_cost`, then more until `max_components` are left.

    Surfaces merge with surfaces, and `max_range` components with `max_range` components; both kinds shrink in
    proportion. The total support, mean and covariance of each kind do not change.

    Args:
        max_components: largest number of components. The next pair is the one with the smallest bound on the
            Kullback–Leibler divergence of the map, weighted by support (Runnalls).
        max_cost: squared Hellinger distance, 0 to 1, up to which two components are always merged.

    Raises `InvalidArgumentError` if both are None, or for a value out of range.
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
        if share == 0:  # a budget of one component for both kinds: surfaces stay
            surfaces = (~components.max_range).nonzero().squeeze(1)
            return _merged_by_kind(components.selected(surfaces), limit, max_cost)
        given = Parameters(components.support[rows], components.means[rows], components.covariances[rows])
        cost = "hellinger" if limit is None else "kullback_leibler"
        found = simplify(given, share, max_cost, cost, most_exact=0)
        labels[rows] = found.labels + n_labels
        n_labels += found.parameters.weights.shape[0]
    return merged(components, _by_first_member(labels))


def _shares(max_range: Tensor, limit: int | None) -> dict[bool, int | None]:
    """Number of components of each kind that are left."""
    if limit is None:
        return {False: None, True: None}
    n, n_empty = max_range.shape[0], int(max_range.sum())
    if n_empty in (0, n):
        return {False: limit, True: limit}
    empty = min(max(1, round(limit * n_empty / n)), limit - 1)
    return {False: limit - empty, True: empty}


def _by_first_member(labels: Tensor) -> Tensor:
    """Labels (K,) renumbered in the order of their first occurrence."""
    n = int(labels.max()) + 1 if labels.numel() else 0
    first = _first_rows(labels, n)
    rank = torch.empty_like(first)
    rank[first.argsort()] = torch.arange(n, device=labels.device)
    return rank[labels]


def _first_rows(labels: Tensor, n: int) -> Tensor:
    """The first row (n,) of each label."""
    rows = torch.arange(labels.shape[0], device=labels.device)
    return rows.new_full((n,), labels.shape[0]).scatter_reduce_(0, labels, rows, "amin")


def compact_to_bytes(
    components: Components,
    max_bytes: int,
    max_origins: int,
    mean_origins: float | None = None,
    size: Size = estimated_bytes,
) -> Components:
    """Merges components until their `size` is at most `max_bytes`; origins are limited as by `limit_origins`.

    Raises `InvalidArgumentError` if a single component with one origin is too large.
    """
    components = limit_origins(components, max_origins, mean_origins)
    fixed = None
    while len(components) and (taken := size(components)) > max_bytes:
        if len(components) == 1:
            if components.seen_by.shape[0] == 1:
                raise InvalidArgumentError(
                    f"max_bytes={max_bytes} is less than the {taken} that one component takes; allow more."
                )
            components = limit_origins(components, 1)
            continue
        if fixed is None:
            fixed = size(Components.empty(components.dim, components.means.device))
        room = max(0, max_bytes - fixed) / max(1, taken - fixed)
        wanted = max(1, min(len(components) - 1, int(len(components) * room**_GROWTH)))
        components = limit_origins(compact(components, wanted), max_origins, mean_origins)
    return components

"""Merging of components: fewer components for nearly the same map, under an error bound or a budget.

Also their viewpoints: how they are assigned when components are learned, united and reduced. A viewpoint is a
sensor origin from which a component was observed, with the count of points observed from it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, check_number, check_whole
from gmmtorch.kernels import is_fused, viewpoint_choice
from gmmtorch.linalg import as_tensors
from gmmtorch.mapping.attributes import moments
from gmmtorch.mapping.components import UNNUMBERED, Components
from gmmtorch.mixture import MergedInRounds, Parameters, merge_in_rounds

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
AssignedViewpoints = tuple[Ints, Floats, Ints, Ints, Floats]
"""kept (K′,): rows of the components that keep at least one viewpoint; their support (K′,); and seen_by,
seen_from, seen_count (E,) of their viewpoints, as in `Components`."""

AssignViewpoints = Callable[[Tensor, Tensor, float], AssignedViewpoints]
"""From the points (K, S) of each component in each scan, the weights (K,) and the number of points. All is on
the CPU. A component that is no point's most likely one has no points; it is dropped.
"""


def all_origins(weight: float = 1.0) -> AssignViewpoints:
    """Keeps every origin. `weight`: number of measured points for which each point stands.

    The support of the components that are kept adds up to weight · N.
    """

    def assign(counts: Tensor, weights: Tensor, n_points: float) -> AssignedViewpoints:
        of_each = counts.numpy().sum(1)
        kept = np.flatnonzero(of_each > 0)
        support = weights.numpy()[kept]
        total = torch.from_numpy(support).sum().numpy()  # in torch's order
        support = support * (n_points * weight * (1 / max(float(total), 1e-300)))
        share = counts.numpy()[kept] * (support / of_each[kept])[:, None]
        seen_by, seen_from = share.nonzero()
        return kept, support, seen_by, seen_from, share[seen_by, seen_from]

    return assign


def sampled_origins(max_origins: int, generator: torch.Generator) -> AssignViewpoints:
    """Keeps at most `max_origins` origins of a component, drawn by their counts without replacement.

    The origins that are kept share the component's support, weight · N. They are real sensor origins:
    a centroid of several would lose the free space around the sensors.
    """

    def assign(counts: Tensor, weights: Tensor, n_points: float) -> AssignedViewpoints:
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
        made = kept, support[kept], number[seen_by], seen_from, seen_count
        return tuple(part.numpy() for part in made)  # type: ignore[return-value]

    return assign


def union_of_viewpoints(components: Components, labels: Ints) -> tuple[Ints, Ints, Floats]:
    """seen_by, seen_from, seen_count (E′,) of components merged by label (K,); counts of an origin add up.

    Each pair of component and origin occurs once, in rising order.
    """
    n_origins = max(1, len(components.origins))
    given = labels[components.seen_by.numpy()] * n_origins + components.seen_from.numpy()
    keys, row = np.unique(given, return_inverse=True)
    count: Floats = np.bincount(row, components.seen_count.numpy(), len(keys)).astype(np.float64, copy=False)
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
    c, device = components.on_cpu(), components.means.device
    limit = len(c) * (max_origins if mean_origins is None else mean_origins)
    by, seen_from, count = c.seen_by.numpy(), c.seen_from.numpy(), c.seen_count.numpy()
    given = by, seen_from, count, c.origins, c.support
    choose = viewpoint_choice if is_fused(c.origins, c.support) else _choice
    count, is_kept, all_used = choose(*given, max_origins, int(min(limit, len(by))))
    limited = replace(c, seen_count=torch.from_numpy(count))
    if not is_kept.all():
        limited = limited.with_viewpoints(torch.from_numpy(np.flatnonzero(is_kept)))
    return (limited if all_used else limited.with_used_origins()).to(device)


def _choice(
    rows: Ints, seen: Ints, counts: Floats, origins: Tensor, support: Tensor, most: int, limit: int
) -> tuple[Floats, NDArray[np.bool_], bool]:
    """The twin of `viewpoint_choice`."""
    by, seen_from, count = torch.from_numpy(rows), torch.from_numpy(seen), torch.from_numpy(counts)
    n_rows, is_kept = len(by), count > 0
    of_each = torch.zeros_like(support).index_add_(0, by, is_kept.to(support))
    is_used = torch.zeros_like(origins[:, 0]).index_fill_(0, seen_from, 1.0)
    sizes = torch.stack([is_kept.sum(), of_each.amax() if len(support) else is_kept.sum(), is_used.sum()])
    n_left, most_left, n_used = sizes.tolist()
    fits = n_left <= limit and most_left <= most
    if not fits:
        gain = _gains(by, count, origins[seen_from], len(support), int(min(most, most_left)))
        largest = gain.argsort(descending=True, stable=True)[:limit]
        is_kept = torch.zeros_like(is_kept).index_fill_(0, largest, True) & (gain >= 0)
    total = torch.zeros_like(support).index_add_(0, by, torch.where(is_kept, count, 0.0))
    scaled = count * (support / total.clamp_min(torch.finfo(total.dtype).tiny))[by]
    return scaled.numpy(), is_kept.numpy(), fits and n_left == n_rows and n_used == len(origins)


def _gains(by: Tensor, count: Tensor, position: Tensor, n: int, most: int) -> Tensor:
    """√count · distance (E,) at which a viewpoint was chosen; ∞: the first of a component; −1: not chosen."""
    worth = count.sqrt()
    nearest = torch.ones_like(count)  # distance to the nearest kept origin of the same component
    # A component without a viewpoint that is left chooses one more row at the end, which does not count.
    n_rows, left = len(by), torch.cat([count > 0, count.new_zeros(1, dtype=torch.bool)])
    rows, gain = torch.arange(n_rows, device=by.device), count.new_full((n_rows + 1,), -1.0)
    nowhere = position.new_full((1, position.shape[1]), torch.inf)
    for step in range(most):
        score = torch.where(left[:-1], worth * nearest, -1.0)
        largest = score.new_full((n,), -1.0).scatter_reduce_(0, by, score, "amax")
        best = torch.where(left[:-1] & (score == largest[by]), rows, n_rows)
        chosen = rows.new_full((n,), n_rows).scatter_reduce_(0, by, best, "amin")
        gain.scatter_(0, chosen, torch.inf if step == 0 else torch.cat([score, score[:1]])[chosen])
        left.index_fill_(0, chosen, False)
        distance = (position - torch.cat([position, nowhere])[chosen][by]).norm(dim=1)
        nearest = distance if step == 0 else torch.minimum(nearest, distance)
    return gain[:-1]


Size = Callable[[Components], int]
"""Number of bytes of the file of given components."""


def united(components: Components, found: MergedInRounds) -> Components:
    """The components, on the CPU, after the merges that were found for them. Viewpoints are united.

    A component that is not merged stays bit-identical. A merged component is `UNNUMBERED` and has the robot
    of its first member.
    """
    first, is_merged = found.first, found.members > 1
    weights, means, covariances = found.parameters
    ids, flags = components.ids.numpy()[first.numpy()], components.max_range.numpy()[first.numpy()]
    ids[is_merged.numpy(), 1] = UNNUMBERED
    by, seen, seen_count = union_of_viewpoints(components, found.labels.numpy())
    numbers, seen_by, seen_from = as_tensors(ids, by, seen)
    attributes = components.attributes
    if attributes:
        rows, groups = is_merged[found.labels].nonzero().squeeze(1), is_merged.nonzero().squeeze(1)
        number = (is_merged.cumsum(0) - 1)[found.labels[rows]]
        before = components.means[rows], components.covariances[rows]
        after = means[groups], covariances[groups]
        made = moments.merged(attributes.selected(rows), number, components.support[rows], before, after)
        attributes = attributes.selected(first).replaced(groups, made)
    return replace(
        components,
        means=means,
        covariances=covariances,
        attributes=attributes,
        support=weights,
        max_range=torch.from_numpy(flags),
        ids=numbers,
        seen_by=seen_by,
        seen_from=seen_from,
        seen_count=torch.from_numpy(seen_count),
    )


def compact(
    components: Components,
    max_components: int | None = None,
    max_cost: float | None = None,
    device: torch.device | None = None,
) -> Components:
    """Merges pairs, cheapest first: all pairs up to `max_cost`, then more until `max_components` are left.

    Surfaces merge with surfaces, and `max_range` components with `max_range` components; both kinds shrink in
    proportion. The total support, mean and covariance of each kind do not change.

    Args:
        max_components: largest number of components. The next pair is the one with the smallest bound on the
            Kullback–Leibler divergence of the map, weighted by support (Runnalls).
        max_cost: squared Hellinger distance, 0 to 1, up to which two components are always merged.
        device: where pairs are searched; None: where the components are, as the result is.

    Raises `InvalidArgumentError` if both are None, or for a value out of range.
    """
    if max_components is None and max_cost is None:
        raise InvalidArgumentError("max_components=None and max_cost=None: give one, or both.")
    if max_components is not None:
        check_whole("max_components", max_components, 1)
    here, c = components.means.device, components.on_cpu()
    device = device or here
    if max_cost is not None:
        check_number("max_cost", max_cost)
        c = _merged_by_kind(c, None, max_cost, device)
    if max_components is not None and len(c) > max_components:
        c = _merged_by_kind(c, max_components, None, device)
    return c.to(here)


def _merged_by_kind(
    components: Components, limit: int | None, max_cost: float | None, device: torch.device
) -> Components:
    n, n_empty = len(components), np.count_nonzero(components.max_range.numpy())
    if n_empty in (0, n):
        return united(components, _merged(components, n_empty == 0, limit, max_cost, device))
    surfaces, empty = ((components.max_range == flag).nonzero().squeeze(1) for flag in (False, True))
    if limit == 1:  # a budget of one component for both kinds: surfaces stay
        return _merged_by_kind(components.selected(surfaces), limit, max_cost, device)
    limits: tuple[int | None, int | None] = (None, None)
    if limit is not None:  # both kinds shrink in proportion
        share = min(max(1, round(limit * n_empty / n)), limit - 1)
        limits = limit - share, share
    one = _merged(components.selected(surfaces), True, limits[0], max_cost, device)
    other = _merged(components.selected(empty), False, limits[1], max_cost, device)
    order = torch.cat([surfaces[one.first], empty[other.first]]).argsort()
    place = torch.empty_like(order).scatter_(0, order, torch.arange(len(order), device=order.device))
    labels = torch.empty_like(components.max_range, dtype=torch.int64)
    labels[surfaces], labels[empty] = place[one.labels], place[len(one.first) + other.labels]
    first = torch.cat([surfaces[one.first], empty[other.first]])[order]
    parts = zip(one.parameters, other.parameters, strict=True)
    parameters = Parameters(*(torch.cat(part)[order] for part in parts))
    both = MergedInRounds(parameters, labels, first, torch.cat([one.members, other.members])[order])
    return united(components, both)


def _merged(
    components: Components,
    with_attributes: bool,
    limit: int | None,
    max_cost: float | None,
    device: torch.device,
) -> MergedInRounds:
    """Merges among components of one kind, up to one of the limits."""
    given = Parameters(components.support, components.means, components.covariances)
    is_joint = bool(components.attributes) and with_attributes
    if is_joint:  # numbers among them are further dimensions
        given = Parameters(given.weights, *moments.joint_moments(components.attributes, *given))
    if max_cost is None:
        found = merge_in_rounds(given, limit or 1, device=device)
    else:
        found = merge_in_rounds(given, 1, max_cost, "hellinger", device=device)
    if not is_joint:
        return found
    (weights, means, covariances), dim = found.parameters, components.dim
    return found._replace(parameters=Parameters(weights, means[:, :dim], covariances[:, :dim, :dim]))


def compact_to_bytes(
    components: Components, max_bytes: int, max_origins: int, mean_origins: float | None, size: Size
) -> Components:
    """Merges components until their `size` is at most `max_bytes`; origins are limited as by `limit_origins`.

    Beyond that size, components lose their numbers: numbered anew, in the order of space, each takes a byte
    less. Few sizes are measured, because each predicts the next number of components: the size is taken for
    a power of that number, which the last two sizes tell (the first alone: proportional to it), and aims at
    a thousandth below `max_bytes`.

    Raises `InvalidArgumentError` if a single component with one origin is too large.
    """
    device = components.means.device
    here = components.on_cpu()  # where the size is measured
    components = limit_origins(here, max_origins, mean_origins)
    last: tuple[int, int] | None = None
    numbered = True
    while (k := len(components)) and (taken := size(components)) > max_bytes:
        if numbered:
            numbered = False
            ids = components.ids.numpy().copy()
            if (ids[:, 1] != UNNUMBERED).any():
                ids[:, 1] = UNNUMBERED
                components = replace(components, ids=torch.from_numpy(ids))
                continue
        if k > 1:
            power = math.log(last[1] / taken) / math.log(last[0] / k) if last else 1.0
            wanted = min(k - 1, int(k * (0.999 * max_bytes / taken) ** (1 / max(power, 0.25))))
            last = k, taken
            fewer = compact(components, max(1, wanted), device=device)
            components = limit_origins(fewer, max_origins, mean_origins)
        elif components.seen_by.shape[0] > 1:
            components = limit_origins(components, 1)
        else:
            raise InvalidArgumentError(
                f"max_bytes={max_bytes} is less than the {taken} that one component takes; allow more."
            )
    return components.to(device)

"""Association: adds the points that a map explains to the counts of components (thesis 4.1.3)."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.kernels import explained_points, is_fused
from gmmtorch.linalg import dense_ranks
from gmmtorch.mapping.components import Components
from gmmtorch.occupancy import whitening

_LEAST_DISTANCE = 1e-6  # squared Mahalanobis: the thesis's shares are undefined at a mean
_PAIRS_AT_ONCE = 1 << 20
_POINTS_AT_ONCE = 512  # neighbouring points that few components can explain


class Explained(NamedTuple):
    """components: with the new counts; explained (N,) bool: the points that are counted."""

    components: Components
    explained: Tensor


def count_explained(
    components: Components,
    points: Tensor,
    origin: Tensor,
    distance: float,
    explained: float | None = None,
    max_range: bool = False,
    weight: float = 1.0,
    frees: Tensor | None = None,
) -> Explained:
    """Adds points (N, D), observed from `origin` (D,), to the counts of the components that explain them.

    A component explains a point if d = (z − μ)ᵀ Σ⁻¹ (z − μ) < `explained`, and if one of its origins is
    within `distance` (m) of the sensor: then it also explains the free space before the point. The components
    share the point in proportion to 1/d, N_k += Σ_n w_nk; each share goes to the origin nearest to the
    sensor. Means and covariances do not change.

    Args:
        explained: squared Mahalanobis distance; None: the 95 % quantile of χ² with D degrees of freedom.
        max_range: the points are ends of no-return beams, which only `max_range` components explain.
        weight: number of measured points for which each point stands.
        frees: (N,) bool, points whose beams contribute free space. Only these need an origin within
            `distance`, as in the thesis. None: all points need it.
    """
    n, k = points.shape[0], len(components)
    found = torch.zeros(n, dtype=torch.bool, device=points.device)
    near, nearest = _nearest_viewpoints(components, origin, distance)
    is_candidate = components.max_range == max_range
    rows = (is_candidate & near if frees is None else is_candidate).nonzero().squeeze(1)
    if n == 0 or len(rows) == 0:
        return Explained(components, found)
    limit = explained_within(components.dim, explained)
    inverse, _ = whitening(components.covariances[rows])
    means = components.means[rows].double()
    if is_fused(points, means):
        gained, found = explained_points(points, means, inverse, limit, _LEAST_DISTANCE, near[rows], frees)
    else:
        gained, found = _shared_out(components.selected(rows), points, inverse, limit, near[rows], frees)
    gain = components.support.new_zeros(k).index_copy_(0, rows, gained * weight)
    counts = components.seen_count.index_add(0, nearest[rows], gain[rows])
    return Explained(replace(components, support=components.support + gain, seen_count=counts), found)


def _shared_out(
    components: Components,
    points: Tensor,
    inverse: Tensor,
    limit: float,
    near: Tensor,
    frees: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """`explained_points` in tensor operations; inverse (K, D, D)."""
    means = components.means.double()
    gained = means.new_zeros(len(components))
    found = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    reach = None if frees is None else box_around(components, limit)
    for part, some in _portions(points, len(components), reach):
        offset = points[part, None].double() - means[some]
        squared = torch.einsum("kij,nkj->nki", inverse[some], offset).square().sum(-1)
        explains = squared < limit
        if frees is not None:
            explains &= near[some] | ~frees[part, None]
        share = torch.where(explains, squared.clamp_min(_LEAST_DISTANCE).reciprocal(), 0.0)
        total = share.sum(1)
        found[part] = total > 0
        gained[some] += (share / total.clamp_min(torch.finfo(total.dtype).tiny)[:, None]).sum(0)
    return gained, found


def explained_within(dim: int, explained: float | None) -> float:
    """The squared Mahalanobis distance within which components explain points; see `count_explained`."""
    return _quantile(dim) if explained is None else explained


@functools.cache
def _quantile(dim: int) -> float:
    """The 95 % quantile of χ² with `dim` degrees of freedom."""
    from scipy.stats import chi2

    return float(chi2.ppf(0.95, dim))


def box_around(components: Components, squared: float) -> tuple[Tensor, Tensor]:
    """Lowest and highest corners (K, D) of boxes around the points within a squared Mahalanobis distance."""
    half = (components.covariances.diagonal(dim1=1, dim2=2).double() * (squared * (1 + 1e-9))).sqrt()
    return components.means.double() - half, components.means.double() + half


def summed(components: Components) -> Components:
    """Each id once, in order, with the sum of the counts of all rows with this id.

    Every component must have one viewpoint.
    """
    robot, sequence = components.ids.unbind(1)
    row, n_ids = dense_ranks(robot * (int(sequence.max()) + 1 if len(robot) else 1) + sequence)
    order = torch.arange(len(components), device=row.device)
    first = torch.full_like(order[:n_ids], len(components)).scatter_reduce_(0, row, order, "amin")
    support = components.support.new_zeros(n_ids).index_add_(0, row, components.support)
    kept = components.selected(first)
    return replace(kept, support=support, seen_count=support[kept.seen_by])


def _portions(points: Tensor, k: int, boxes: tuple[Tensor, Tensor] | None) -> Iterator[tuple[Tensor, Tensor]]:
    """Portions of points (N, D), as indices, and the indices of the components that may explain them.

    boxes: lowest and highest corners (K, D) of what the components explain. Portions are then neighbouring
        points, with the few of the K components whose boxes meet them. None: all components.
    """
    n, device = len(points), points.device
    if boxes is None:
        for part in torch.arange(n, device=device).split(max(1, _PAIRS_AT_ONCE // k)):
            yield part, torch.arange(k, device=device)
        return
    low, high = boxes
    order = torch.arange(n, device=device)
    for axis in range(points.shape[1]):  # the last axis, in rising order within cells of a metre
        order = order[points[order, axis].floor().argsort(stable=True)]
    for part in order.split(min(_POINTS_AT_ONCE, max(1, _PAIRS_AT_ONCE // k))):
        first, last = points[part].double().aminmax(dim=0)
        yield part, ((low <= last) & (high >= first)).all(1).nonzero().squeeze(1)


def _nearest_viewpoints(components: Components, origin: Tensor, distance: float) -> tuple[Tensor, Tensor]:
    """Which components (K,) have an origin within `distance` of a position; their nearest viewpoints (K,)."""
    k, n_viewpoints = len(components), components.seen_by.shape[0]
    apart = (components.origins[components.seen_from].double() - origin.double()).norm(dim=1)
    least = apart.new_full((k,), torch.inf).scatter_reduce_(0, components.seen_by, apart, "amin")
    best = (apart == least[components.seen_by]).nonzero().squeeze(1)
    nearest = best.new_full((k,), n_viewpoints).scatter_reduce_(0, components.seen_by[best], best, "amin")
    return least <= distance, nearest

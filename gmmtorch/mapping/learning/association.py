"""Association: points that a map explains are counted to the components that explain them (thesis 4.1.3)."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.linalg import dense_ranks
from gmmtorch.mapping.components import Components
from gmmtorch.occupancy.cones import whitening

_LEAST_DISTANCE = 1e-6  # squared Mahalanobis: the thesis's shares are undefined at a mean
_PAIRS_AT_ONCE = 1 << 20


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
) -> Explained:
    """Counts points (N, D), observed from `origin` (D,), to the components that explain them.

    A component explains a point if d = (z − μ)ᵀ Σ⁻¹ (z − μ) < `explained`, and if one of its origins is
    within `distance` (m) of the sensor: then it also explains the free space before the point. The components
    share the point in proportion to 1/d, N_k += Σ_n w_nk; each share goes to the origin nearest to the
    sensor. Means and covariances do not change.

    Args:
        explained: squared Mahalanobis distance; None: the 95 % quantile of χ² with D degrees of freedom.
        max_range: the points are ends of no-return beams, which only `max_range` components explain.
        weight: number of measured points for which each point stands.
    """
    n, k = points.shape[0], len(components)
    found = torch.zeros(n, dtype=torch.bool, device=points.device)
    near, nearest = _nearest_viewpoints(components, origin, distance)
    rows = (near & (components.max_range == max_range)).nonzero().squeeze(1)
    if n == 0 or len(rows) == 0:
        return Explained(components, found)
    if explained is None:
        from scipy.stats import chi2

        explained = float(chi2.ppf(0.95, components.dim))
    inverse, _ = whitening(components.covariances[rows])
    gained = components.support.new_zeros(len(rows))
    step = max(1, _PAIRS_AT_ONCE // len(rows))
    for begin in range(0, n, step):
        offset = points[begin : begin + step, None].double() - components.means[rows].double()
        squared = torch.einsum("kij,nkj->nki", inverse, offset).square().sum(-1)
        share = torch.where(squared < explained, squared.clamp_min(_LEAST_DISTANCE).reciprocal(), 0.0)
        total = share.sum(1)
        found[begin : begin + step] = total > 0
        gained += (share / total.clamp_min(torch.finfo(total.dtype).tiny)[:, None]).sum(0)
    gain = components.support.new_zeros(k).index_copy_(0, rows, gained * weight)
    counts = components.seen_count.index_add(0, nearest[rows], gain[rows])
    return Explained(replace(components, support=components.support + gain, seen_count=counts), found)


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


def _nearest_viewpoints(components: Components, origin: Tensor, distance: float) -> tuple[Tensor, Tensor]:
    """Which components (K,) have an origin within `distance` of a position; their nearest viewpoints (K,)."""
    k, n_viewpoints = len(components), components.seen_by.shape[0]
    apart = (components.origins[components.seen_from].double() - origin.double()).norm(dim=1)
    least = apart.new_full((k,), torch.inf).scatter_reduce_(0, components.seen_by, apart, "amin")
    best = (apart == least[components.seen_by]).nonzero().squeeze(1)
    nearest = best.new_full((k,), n_viewpoints).scatter_reduce_(0, components.seen_by[best], best, "amin")
    return least <= distance, nearest

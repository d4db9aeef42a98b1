"""Points that a map explains already are counted to the components that explain them (thesis 4.1.3)."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from scipy.stats import chi2
from torch import Tensor

from gmmtorch.linalg import dense_ranks
from gmmtorch.mapping.components import Components
from gmmtorch.occupancy.cones import whitening

_LEAST_DISTANCE = 1e-6  # squared Mahalanobis: at a mean itself the thesis's shares are undefined
_PAIRS_AT_ONCE = 1 << 20


class Explained(NamedTuple):
    """components: with the counts of what they explain; explained (N,): which points are counted there."""

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
    """Points (N, D) seen from `origin` (D,) counted to the components that explain them.

    A component explains a point if d = (z − μ)ᵀ Σ⁻¹ (z − μ) < `explained` (None: the 95 % quantile of
    χ²_D) and it has an origin within `distance` (m) of the sensor: then it explains the free space
    before the point, too. The point is shared by those in proportion to 1/d, and what each gets goes to
    its nearest origin: N_k += Σ_n w_nk. Moments stay as they are. `max_range`: the points are ends of
    beams without return, which only components of their kind explain. `weight`: measured points that each
    point stands for.
    """
    n, k = points.shape[0], len(components)
    found = torch.zeros(n, dtype=torch.bool, device=points.device)
    near, nearest = _nearest_sightings(components, origin, distance)
    rows = (near & (components.max_range == max_range)).nonzero().squeeze(1)
    if n == 0 or len(rows) == 0:
        return Explained(components, found)
    limit = float(chi2.ppf(0.95, components.dim)) if explained is None else explained
    inverse, _ = whitening(components.covariances[rows])
    gained = components.support.new_zeros(len(rows))
    step = max(1, _PAIRS_AT_ONCE // len(rows))
    for begin in range(0, n, step):
        offset = points[begin : begin + step, None].double() - components.means[rows].double()
        squared = torch.einsum("kij,nkj->nki", inverse, offset).square().sum(-1)
        share = torch.where(squared < limit, squared.clamp_min(_LEAST_DISTANCE).reciprocal(), 0.0)
        total = share.sum(1)
        found[begin : begin + step] = total > 0
        gained += (share / total.clamp_min(torch.finfo(total.dtype).tiny)[:, None]).sum(0)
    gain = components.support.new_zeros(k).index_copy_(0, rows, gained * weight)
    counts = components.seen_count.index_add(0, nearest[rows], gain[rows])
    return Explained(replace(components, support=components.support + gain, seen_count=counts), found)


def summed(components: Components) -> Components:
    """Each id once, in order, with the sum of the counts of all its rows.

    For components that were each seen from one place, of which some rows add counts to others.
    """
    robot, sequence = components.ids.unbind(1)
    row, n_ids = dense_ranks(robot * (int(sequence.max()) + 1 if len(robot) else 1) + sequence)
    order = torch.arange(len(components), device=row.device)
    first = torch.full_like(order[:n_ids], len(components)).scatter_reduce_(0, row, order, "amin")
    support = components.support.new_zeros(n_ids).index_add_(0, row, components.support)
    kept = components.selected(first)
    return replace(kept, support=support, seen_count=support[kept.seen_by])


def _nearest_sightings(components: Components, origin: Tensor, distance: float) -> tuple[Tensor, Tensor]:
    """Whether each component (K,) was seen from within `distance` of a place, and its sighting (K,) from
    the place nearest to it."""
    k, n_sightings = len(components), components.seen_by.shape[0]
    apart = (components.origins[components.seen_from].double() - origin.double()).norm(dim=1)
    least = apart.new_full((k,), torch.inf).scatter_reduce_(0, components.seen_by, apart, "amin")
    best = (apart == least[components.seen_by]).nonzero().squeeze(1)
    nearest = best.new_full((k,), n_sightings).scatter_reduce_(0, components.seen_by[best], best, "amin")
    return least <= distance, nearest

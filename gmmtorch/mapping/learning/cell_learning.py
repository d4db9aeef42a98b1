"""From a window of point clouds to components, through the moments of small cells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gmmtorch.mapping.components import UNNUMBERED, Components
from gmmtorch.mixture.em import exact as em
from gmmtorch.mixture.em.cells import pool_into_cells
from gmmtorch.mixture.em.partition import FlatnessRule, partition, pool

_FEW_POINTS, _MOST_CELLS = 1_000, 50_000  # fewer are not pooled; no more cells are worth their time


@dataclass(frozen=True)
class CellRule:
    """What `learn_cells` goes by; the fields are those of `IncrementalRule`."""

    noise: float
    length: float
    cell: float
    window_components: int
    iterations: int


def learn_cells(
    clouds: Sequence[Tensor],
    origins: Tensor,
    rule: CellRule,
    max_range: bool = False,
    weight: float = 1.0,
) -> Components:
    """Components of S point clouds (N_s, D), each seen from its origin (S, D), and of how many points.

    The points are summed into cells, the cells cut into flat pieces, and EM is run on the cells from
    there (see `mixture.em`). Every origin is kept. Components are not numbered. `weight`: how many
    measured points each one stands for.
    """
    sizes = torch.tensor([cloud.shape[0] for cloud in clouds], device=origins.device)
    points = torch.cat(list(clouds)).double()
    n, dim, n_scans = points.shape[0], origins.shape[1], origins.shape[0]
    if n == 0:
        return Components.empty(dim, origins.device)
    center = points.mean(0)
    cells = pool_into_cells(points.sub_(center), min(_MOST_CELLS, max(_FEW_POINTS, n - 1)), rule.cell)
    found = _mixture_of(cells.features, cells.weight, rule)
    owner = em.most_likely(cells.features, found)
    pair = owner[cells.member] * n_scans + torch.repeat_interleave(sizes)
    counts = torch.bincount(pair, minlength=found.weights.shape[0] * n_scans).view(-1, n_scans).double()
    # One that is no cell's likeliest is dropped: its points are others' already.
    alive = counts.sum(1) > 0
    counts, support = counts[alive], found.weights[alive]
    support = support * (n * weight / support.sum())
    counts *= (support / counts.sum(1))[:, None]
    seen_by, seen_from = (counts > 0).nonzero(as_tuple=True)
    ids = torch.zeros(support.shape[0], 2, dtype=torch.int64, device=origins.device)
    ids[:, 1] = UNNUMBERED
    return Components(
        means=found.means[alive] + center,
        covariances=found.covariances[alive],
        support=support,
        max_range=torch.full_like(ids[:, 0], max_range, dtype=torch.bool),
        ids=ids,
        origins=origins.double(),
        seen_by=seen_by,
        seen_from=seen_from,
        seen_count=counts[seen_by, seen_from],
    )


def _mixture_of(features: Tensor, weight: Tensor, rule: CellRule) -> em.Parameters:
    dim = em.feature_dimension(features.shape[1])
    flatness = FlatnessRule(
        thickness=2 * rule.noise,
        length=rule.length,
        min_weight=3 * (dim - 1),
        max_components=rule.window_components,
        apart=10 * rule.length,
    )
    pieces = partition(features[:, 1 : 1 + dim].contiguous(), weight, flatness, features)
    floor = rule.noise**2
    first = em.maximization(pool(features, weight, pieces.labels, pieces.n_pieces), floor)
    step = em.natural_step(features, weight, floor)
    return em.run_em(step, first, tol=1e-4, max_iter=rule.iterations).parameters

"""From a window of scans to components: how many, where, and whence they were seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from gmmtorch.mapping.components import UNNUMBERED, Components
from gmmtorch.mapping.learning.rules import WindowedRule
from gmmtorch.mixture.em import exact as em
from gmmtorch.mixture.em.cells import pool_into_cells
from gmmtorch.mixture.em.partition import FlatnessRule, partition, pool
from gmmtorch.mixture.em.surface_rule import surface_rule
from gmmtorch.scan import Scan


def flatness_rule(rule: WindowedRule, dim: int) -> FlatnessRule:
    """When a piece of a window's points is cut further, in `dim` dimensions."""
    # In 2D a few points that span several surfaces are better told apart, down to single ones
    # (5 % of intel, 0.1 m: AUC 0.948 against 0.940); in 3D that only adds components.
    least = surface_rule(rule.noise, dim, rule.min_points)
    return replace(
        least,
        length=rule.length,
        min_weight_thick=1 if dim == 2 else least.min_weight,
        max_components=rule.n_components,
        apart=10 * rule.length,
    )


def learn_window(scans: Sequence[Scan], rule: WindowedRule, generator: torch.Generator) -> Components:
    """Components of the returns, and flagged ones of the no-returns, of neighbouring scans.

    Not numbered: the owner of the map does that.
    """
    origins = torch.stack([scan.origin.double() for scan in scans])
    returns = _learn([scan.points for scan in scans], origins, rule, generator, max_range=False)
    empty = _learn([scan.no_return for scan in scans], origins, rule, generator, max_range=True)
    return Components.concatenate([returns, empty])


def _learn(
    clouds: list[Tensor], origins: Tensor, rule: WindowedRule, generator: torch.Generator, max_range: bool
) -> Components:
    sizes = torch.tensor([cloud.shape[0] for cloud in clouds], device=origins.device)
    scan_index = torch.repeat_interleave(sizes)
    points = torch.cat(clouds).double()
    dim = points.shape[1]
    if points.shape[0] == 0:
        return Components.empty(dim, points.device)
    center = points.mean(0)
    cells = pool_into_cells(points - center, rule.max_cells, rule.noise)
    pieces = partition(cells.features[:, 1 : 1 + dim].contiguous(), cells.weight, flatness_rule(rule, dim))
    reg = rule.noise**2
    first = em.maximization(pool(cells.features, cells.weight, pieces.labels, pieces.n_pieces), reg)
    step = em.natural_step(cells.features, cells.weight, reg, em.SOFTMAX_DTYPES[rule.dtype])
    found = em.run_em(step, first, tol=1e-4, max_iter=rule.iterations).parameters
    owner = em.most_likely(cells.features, found)[cells.member]
    n_scans, n_components = len(clouds), found.weights.shape[0]
    counts = torch.bincount(owner * n_scans + scan_index, minlength=n_components * n_scans)
    support = found.weights * points.shape[0]
    seen_by, seen_from, seen_count = _sample_origins(
        counts.view(n_components, n_scans).double(), support, rule.max_origins, generator
    )
    alive = torch.bincount(seen_by, minlength=n_components) > 0
    renumber = torch.cumsum(alive.long(), 0) - 1
    return Components(
        means=(found.means + center)[alive],
        covariances=found.covariances[alive],
        support=support[alive],
        max_range=torch.full((int(alive.sum()),), max_range, device=points.device),
        ids=torch.full((int(alive.sum()), 2), UNNUMBERED, device=points.device),
        origins=origins,
        seen_by=renumber[seen_by],
        seen_from=seen_from,
        seen_count=seen_count,
    )


def _sample_origins(
    counts: Tensor, support: Tensor, max_origins: int, generator: torch.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Sightings from the points each component (row) has in each scan (column).

    At most `max_origins` scans are kept for a component, drawn by their counts without
    replacement, and share its support. Real origins, not their centroid: a centroid loses the
    space around the sensors. A component that is no point's likeliest one has no sighting; it
    is dropped, and its points are others' already.
    """
    n_scans = counts.shape[1]
    n_kept = min(max_origins, n_scans)
    if n_kept < n_scans:
        race = torch.empty(counts.shape, dtype=torch.float64).exponential_(generator=generator)
        key = torch.where(counts > 0, race.to(counts.device) / counts.clamp_min(1), float("inf"))
        kept = key.topk(n_kept, dim=1, largest=False).indices
        counts = torch.zeros_like(counts).scatter_(1, kept, counts.gather(1, kept))
    share = counts * (support / counts.sum(1).clamp_min(1e-12))[:, None]
    seen_by, seen_from = (share > 0).nonzero(as_tuple=True)
    return seen_by, seen_from, share[seen_by, seen_from]

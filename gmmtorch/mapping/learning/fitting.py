"""Fitting of components to the scans of a window: the one learner of every map.

The points are summed into small cells, the cells are cut into flat pieces, and EM on the cells starts from
the pieces (see `mixture.em`). Every point belongs to its most likely component; the points of each scan in a
component give the component's viewpoints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gmmtorch.mapping.components import UNNUMBERED, Components
from gmmtorch.mapping.learning.depth_frame import DepthFrame, pool_frames
from gmmtorch.mapping.learning.viewpoints import AssignedViewpoints, AssignViewpoints
from gmmtorch.mixture.em import exact as em
from gmmtorch.mixture.em import loop
from gmmtorch.mixture.em.cells import pool_into_cells
from gmmtorch.mixture.em.partition import FlatnessRule, partition, pool
from gmmtorch.scan import Scan

_FEW_POINTS, _MOST_CELLS = 1_000, 50_000  # fewer points are not pooled; more cells are not worth their time
_TOLERANCE = 1e-4  # of EM: relative change of the log-likelihood


@dataclass(frozen=True)
class SurfaceFit:
    """How points become components.

    noise: standard deviation of the range sensor (m); its square is added to every variance.
    cell: side (m) of the cells into which points are summed.
    flatness: when a piece is cut further.
    iterations: largest number of EM iterations.
    max_cells: clouds with more points are summed into cells, at most this many. None: between 1,000 and
        50,000, and fewer than points.
    dtype: type of the exponentials in EM.
    partition_by_moments: cut pieces by the moments of the cells, not only by their means.
    """

    noise: float
    cell: float
    flatness: FlatnessRule
    iterations: int
    max_cells: int | None = None
    dtype: torch.dtype = torch.float32
    partition_by_moments: bool = True


def fit_window(
    scans: Sequence[Scan], fit: SurfaceFit, viewpoints: AssignViewpoints, empty_fit: SurfaceFit | None = None
) -> Components:
    """Components of the returns of S scans, then `max_range` components of the ends of no-return beams.

    `empty_fit`: for the no-return beams, if it differs from `fit`. Components are not numbered.
    """
    origins = torch.stack([scan.origin.double() for scan in scans])
    returns = fit_points([scan.points for scan in scans], origins, fit, viewpoints)
    ends = [scan.no_return for scan in scans]
    empty = fit_points(ends, origins, empty_fit or fit, viewpoints, max_range=True)
    return Components.concatenate([returns, empty])


def fit_points(
    clouds: Sequence[Tensor],
    origins: Tensor,
    fit: SurfaceFit,
    viewpoints: AssignViewpoints,
    *,
    max_range: bool = False,
) -> Components:
    """Components of S clouds of points (N_s, D), each observed from its sensor origin (S, D), in metres.

    `max_range`: the points are ends of no-return beams. Components are not numbered.
    """
    sizes = torch.tensor([cloud.shape[0] for cloud in clouds], device=origins.device)
    points = torch.cat(list(clouds)).double()
    n_points, dim = points.shape[0], origins.shape[1]
    if n_points == 0:
        return Components.empty(dim, origins.device)
    center = points.mean(0)
    max_cells = fit.max_cells or min(_MOST_CELLS, max(_FEW_POINTS, n_points - 1))
    cells = pool_into_cells(points.sub_(center), max_cells, fit.cell)
    found = _mixture_of(cells.features, cells.weight, dim, fit)
    owner = em.most_likely(cells.features, found)
    n_found, n_scans = found.weights.shape[0], len(clouds)
    pair = owner[cells.member] * n_scans + torch.repeat_interleave(sizes)
    counts = torch.bincount(pair, minlength=n_found * n_scans).view(-1, n_scans).double()
    found = found._replace(means=found.means + center)
    return _components(found, viewpoints(counts, found.weights, n_points), origins, max_range)


def fit_frames(frames: Sequence[DepthFrame], fit: SurfaceFit, viewpoints: AssignViewpoints) -> Components:
    """Components of the points of depth images, each observed from its camera; see `fit_points`.

    The images are summed into cells at once, without a list of their points. Components are not numbered.
    """
    origins = torch.stack([frame.origin for frame in frames])
    if sum(frame.depth.numel() for frame in frames) <= _FEW_POINTS:
        return fit_points([frame.scan().points for frame in frames], origins, fit, viewpoints)
    cells = pool_frames(frames, fit.cell, fit.max_cells or _MOST_CELLS)
    if cells.weight.shape[0] == 0:
        return Components.empty(3, origins.device)
    found = _mixture_of(cells.features, cells.weight, 3, fit)
    owner = em.most_likely(cells.features, found)
    counts = cells.counts.new_zeros(found.weights.shape[0], len(frames)).index_add_(0, owner, cells.counts)
    found = found._replace(means=found.means + cells.center)
    assigned = viewpoints(counts, found.weights, int(cells.weight.sum()))
    return _components(found, assigned, origins, max_range=False)


def _components(
    found: em.Parameters, assigned: AssignedViewpoints, origins: Tensor, max_range: bool
) -> Components:
    """The components that keep a viewpoint; not numbered."""
    kept, support, seen_by, seen_from, seen_count = assigned
    ids = torch.zeros(support.shape[0], 2, dtype=torch.int64, device=origins.device)
    ids[:, 1] = UNNUMBERED
    return Components(
        means=found.means[kept],
        covariances=found.covariances[kept],
        support=support,
        max_range=torch.full_like(ids[:, 0], max_range, dtype=torch.bool),
        ids=ids,
        origins=origins.double(),
        seen_by=seen_by,
        seen_from=seen_from,
        seen_count=seen_count,
    )


def _mixture_of(features: Tensor, weight: Tensor, dim: int, fit: SurfaceFit) -> em.Parameters:
    """The mixture of cells with mean features (N, F) and weights (N,), by EM from flat pieces."""
    means = features[:, 1 : 1 + dim].contiguous()
    moments = (features,) if fit.partition_by_moments else ()
    pieces = partition(means, weight, fit.flatness, *moments)
    smallest_variance = fit.noise**2
    first = em.maximization(pool(features, weight, pieces.labels, pieces.n_pieces), smallest_variance)
    step = loop.natural_step(features, weight, smallest_variance, fit.dtype)
    return loop.run_em(step, first, tol=_TOLERANCE, max_iter=fit.iterations).parameters

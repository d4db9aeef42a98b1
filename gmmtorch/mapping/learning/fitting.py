"""Fitting of components to the scans of a window: the one learner of every map.

The points are summed into small cells, the cells are cut into flat pieces, and EM on the cells starts from
the pieces (see `mixture.em`). Every point belongs to its most likely component; the points of each scan in a
component give the component's viewpoints.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from gmmtorch.mapping.components import UNNUMBERED, Components
from gmmtorch.mapping.learning.depth_frame import DepthFrame, pool_frames
from gmmtorch.mapping.learning.rules import MixtureRule
from gmmtorch.mapping.learning.viewpoints import AssignedViewpoints, AssignViewpoints
from gmmtorch.mixture import (
    Cells,
    FlatnessRule,
    Parameters,
    maximization,
    most_likely_component,
    natural_step,
    partition,
    pool,
    pool_into_cells,
    run_em,
)
from gmmtorch.scan import Scan

if TYPE_CHECKING:
    from gmmtorch.mixture import SensorModel

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
    rule: learner and pruning.
    """

    noise: float
    cell: float
    flatness: FlatnessRule
    iterations: int
    max_cells: int | None = None
    dtype: torch.dtype = torch.float32
    partition_by_moments: bool = True
    rule: MixtureRule = field(default_factory=MixtureRule)


def fit_window(
    scans: Sequence[Scan], fit: SurfaceFit, viewpoints: AssignViewpoints, empty_fit: SurfaceFit | None = None
) -> Components:
    """Components of the returns of S scans, then `max_range` components of the ends of no-return beams.

    `empty_fit`: for the no-return beams, if it differs from `fit`. `fit.rule.free_points` points on each
    other beam are treated as ends of no-return beams. Components are not numbered.
    """
    origins = torch.stack([scan.origin.double() for scan in scans])
    returns = fit_points([scan.points for scan in scans], origins, fit, viewpoints)
    n_free = fit.rule.free_points
    ends = [scan.no_return for scan in scans]
    if n_free:
        ends = [torch.cat([scan.no_return, _points_before(scan, n_free)]) for scan in scans]
    if not any(len(end) for end in ends):
        return returns
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
    sizes = [cloud.shape[0] for cloud in clouds]
    n_points, dim = sum(sizes), origins.shape[1]
    if n_points == 0:
        return Components.empty(dim, origins.device)
    points = torch.cat(list(clouds)).double()
    scan = torch.repeat_interleave(torch.tensor(sizes, device=origins.device), output_size=n_points)
    center = points.mean(0)
    rule = replace(fit.rule, prune="none") if max_range else fit.rule
    sensor = _measured_sensor(clouds, origins) if rule.prune == "density" else None
    window = _Window(points.sub_(center), scan, origins.double() - center, sensor)
    learn = _LEARNERS[rule.learner]
    found, counts, n_learned = learn(window, replace(fit, rule=rule))
    found = found._replace(means=found.means + center)
    return _components(found, viewpoints(counts, found.weights, n_learned), origins, max_range)


def fit_frames(frames: Sequence[DepthFrame], fit: SurfaceFit, viewpoints: AssignViewpoints) -> Components:
    """Components of the points of depth images, each observed from its camera; see `fit_points`.

    The images are summed into cells at once, without a list of their points. Components are not numbered.
    """
    origins = torch.stack([frame.origin for frame in frames])
    if fit.rule.needs_points:
        return fit_window([frame.scan() for frame in frames], fit, viewpoints)
    if sum(frame.depth.numel() for frame in frames) <= _FEW_POINTS:
        return fit_points([frame.scan().points for frame in frames], origins, fit, viewpoints)
    cells = pool_frames(frames, fit.cell, fit.max_cells or _MOST_CELLS)
    if cells.weight.shape[0] == 0:
        return Components.empty(3, origins.device)
    found = _mixture_of(cells.features, cells.weight, 3, fit)
    owner = most_likely_component(cells.features, found)
    counts = cells.counts.new_zeros(found.weights.shape[0], len(frames)).index_add_(0, owner, cells.counts)
    found = found._replace(means=found.means + cells.center)
    assigned = viewpoints(counts, found.weights, int(cells.weight.sum()))
    return _components(found, assigned, origins, max_range=False)


def _components(
    found: Parameters, assigned: AssignedViewpoints, origins: Tensor, max_range: bool
) -> Components:
    """The components that keep a viewpoint; not numbered."""
    kept, support, seen_by, seen_from, seen_count = (part.to(origins.device) for part in assigned)
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


def _points_before(scan: Scan, n: int) -> Tensor:
    """n points (n·N, D) at equal distances on each beam with a return."""
    shares = (torch.arange(n, dtype=torch.float64, device=scan.points.device) + 0.5) / n
    origin = scan.origin.double()
    return (origin + shares[:, None, None] * (scan.points.double() - origin)).flatten(0, 1)


def _measured_sensor(clouds: Sequence[Tensor], origins: Tensor) -> SensorModel:
    """A sensor with the spacing of the beams of the largest scan."""
    from gmmtorch.mixture import measured_sensor

    largest = max(range(len(clouds)), key=lambda number: len(clouds[number]))
    return measured_sensor(clouds[largest], origins[largest])


class _Window(NamedTuple):
    """points (N, D) and origins (S, D), relative to the centre of the points; scan (N,) of each point.

    sensor: for pruning by density.
    """

    points: Tensor
    scan: Tensor
    origins: Tensor
    sensor: SensorModel | None

    def pooled(self, fit: SurfaceFit, side: float) -> Cells:
        """The points summed into cells of this side (m)."""
        most = fit.max_cells or min(_MOST_CELLS, max(_FEW_POINTS, len(self.points) - 1))
        return pool_into_cells(self.points, most, side)

    def counts(self, group: Tensor, n_groups: int) -> Tensor:
        """Points (n_groups, S) of each group in each scan; group (N,) of each point."""
        n_scans = self.origins.shape[0]
        pair = group * n_scans + self.scan
        counts = torch.zeros(n_groups * n_scans, dtype=torch.float64, device=pair.device)
        return counts.index_add_(0, pair, counts.new_ones(1).expand(len(pair))).view(-1, n_scans)


class _Learned(NamedTuple):
    """mixture; counts (K, S): its points in each scan, of which each belongs to its most likely component;
    n_points: number of points that pruning leaves.
    """

    mixture: Parameters
    counts: Tensor
    n_points: float


def _from_flat_pieces(window: _Window, fit: SurfaceFit) -> _Learned:
    """EM on cells from flat pieces; pruned components lose their points."""
    cells = window.pooled(fit, fit.cell)
    mixture = _mixture_of(cells.features, cells.weight, window.points.shape[1], fit)
    owner = most_likely_component(cells.features, mixture)
    counts = window.counts(owner[cells.member], mixture.weights.shape[0])
    n_points, rule = len(window.points), fit.rule
    if rule.prune == "none":
        return _Learned(mixture, counts, n_points)
    support = mixture.weights * n_points
    if window.sensor is None:
        kept = support >= rule.min_support
    else:
        from gmmtorch.mixture import density_share

        share = density_share(support, mixture, window.sensor, window.origins, counts)
        kept = share >= rule.min_density_share
    weights = mixture.weights[kept]
    left = Parameters(weights / weights.sum(), mixture.means[kept], mixture.covariances[kept])
    return _Learned(left, counts[kept], float(support[kept].sum()))


def _from_tree(window: _Window, fit: SurfaceFit) -> _Learned:
    """The leaves of a tree over cells; the points of pruned children go to their siblings."""
    # Loaded here, because they load scikit-learn, which a replica does not need.
    from gmmtorch.mixture import DensityLimit, HierarchicalGaussianMixture, grow

    rule, flatness = fit.rule, fit.flatness
    cells = window.pooled(fit, fit.noise)  # a tree uses the means of cells only
    thickness = flatness.thickness if rule.planarity is None else 0.0
    tree = HierarchicalGaussianMixture(
        flatness.max_components,
        reg_covar=fit.noise**2,
        planarity_threshold=rule.planarity or 0.0,
        thickness=thickness,
        min_support=rule.min_support if rule.prune == "support" else flatness.min_weight,
    )
    limit = None
    if window.sensor is not None:
        seen = window.counts(cells.member, cells.weight.shape[0])
        limit = DensityLimit(rule.min_density_share, window.sensor, window.origins, seen)
    means = cells.features[:, 1 : 1 + window.points.shape[1]].contiguous()
    grown = grow(means, cells.weight, tree, density=limit).tree
    leaves = grown.leaves()
    mixture = Parameters(grown.weights[leaves], grown.means[leaves], grown.covariances[leaves])
    owner = most_likely_component(cells.features, mixture)
    return _Learned(mixture, window.counts(owner[cells.member], len(leaves)), len(window.points))


_LEARNERS: dict[str, Callable[[_Window, SurfaceFit], _Learned]] = {
    "flat_pieces": _from_flat_pieces,
    "hierarchical": _from_tree,
}


def _mixture_of(features: Tensor, weight: Tensor, dim: int, fit: SurfaceFit) -> Parameters:
    """The mixture of cells with mean features (N, F) and weights (N,), by EM from flat pieces."""
    means = features[:, 1 : 1 + dim].contiguous()
    moments = (features,) if fit.partition_by_moments else ()
    pieces = partition(means, weight, fit.flatness, *moments)
    smallest_variance = fit.noise**2
    first = maximization(pool(features, weight, pieces.labels, pieces.n_pieces), smallest_variance)
    step = natural_step(features, weight, smallest_variance, fit.dtype)
    return run_em(step, first, tol=_TOLERANCE, max_iter=fit.iterations).parameters

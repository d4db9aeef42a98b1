"""Starting parameters of EM (thesis 2.1.3): k-means, random points, the bounding box, or flat pieces.

Random draws are made among the distinct points, with summed weights, in an order that depends on the values
only. A point of weight 2 and the same point given twice therefore give the same start, up to rounding.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.kernels import fused_label_moments, fused_moments, is_m_step_fused, is_small
from gmmtorch.linalg import argsort
from gmmtorch.mixture.em import by_type
from gmmtorch.mixture.em import exact as em
from gmmtorch.mixture.em.by_type import chunk_rows
from gmmtorch.mixture.em.exact import Parameters
from gmmtorch.mixture.em.kmeans import kmeans, mean_variance, spread_out
from gmmtorch.mixture.em.partition import FlatnessRule, partition, pool, pool_into_cells, surface_rule

_FEWEST_CELLS, _CELLS_OF_A_COMPONENT = 4096, 8  # lower limits of the cells for flat pieces
_FINEST_CELLS = 1 << 14  # along the longest side
_DISTANCES = 1 << 20  # of runs of k-means that are made at once
_SURFACE_CELLS = 1 << 17  # `surface_pieces` partitions cells from twice this number of points on


class Start(NamedTuple):
    """What a start is computed from: points (N, D), centred, float64, with weights (N,), and the settings.

    rows: (M,) one point of each place, in an order that depends on the values only: by the first column,
    then by a hash of the others. mass: (M,) the summed weights of the points there.
    """

    points: Tensor
    weight: Tensor
    rows: Tensor
    mass: Tensor
    n_components: int
    reg_covar: float
    generator: torch.Generator
    kind: str

    def drawn(self) -> Tensor:
        """K distinct points (K, D), drawn by weight: the smallest of E/w, E exponential."""
        race = torch.empty(self.mass.shape, dtype=torch.float64).exponential_(generator=self.generator)
        first = (race.to(self.mass.device) / self.mass).argsort()[: self.n_components]
        return self.points[self.rows[first]]

    def tiling(self, means: Tensor) -> Parameters:
        """Components with the cloud's mean variance, reduced as if they tile the cloud: σ² K^(−2/D)."""
        spread = mean_variance(self.points, self.weight)
        return self.isotropic(means, spread * len(means) ** (-2 / means.shape[1]) + self.reg_covar)

    def isotropic(self, means: Tensor, variance: Tensor | float) -> Parameters:
        """Components of equal weight and variance at the means (K, D)."""
        k, dim = means.shape
        values = means.new_ones(em.type_shape(self.kind, k, dim)) * variance
        if self.kind in ("full", "tied"):
            values *= torch.eye(dim, dtype=means.dtype, device=means.device)
        return Parameters(means.new_full((k,), 1 / k), means, values)


def distinct(points: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """`rows` and `mass` of a `Start`."""
    order = argsort(points[:, 0].contiguous())
    column = points[order, 0]
    same = column[1:] == column[:-1]
    if not bool(same.any()):
        return order, weight[order]
    # Only rows that are equal in the first column need the other columns.
    tied = torch.cat([same.new_zeros(1), same]) | torch.cat([same, same.new_zeros(1)])
    among = order[tied]
    among = among[argsort(_hash(points, among))]
    order[tied] = among[argsort(points[among, 0])]
    for some in same.nonzero().squeeze(1).split(chunk_rows(points)):
        same[some] = (points[order[some + 1]] == points[order[some]]).all(1)
    is_new = torch.cat([~same.new_zeros(1), ~same])
    mass = weight.new_zeros(int(is_new.sum())).index_add_(0, is_new.cumsum(0) - 1, weight[order])
    return order[is_new], mass


def _hash(points: Tensor, rows: Tensor) -> Tensor:
    """A whole number (n,) for each of some rows; equal rows have equal ones."""
    odd = torch.randint(2**62, (points.shape[1],), generator=torch.Generator().manual_seed(0)) * 2 + 1
    odd, found = odd.to(points.device), []
    for some in rows.split(chunk_rows(points)):
        bits = (points[some] + 0.0).view(torch.int64)  # + 0, because −0 equals 0
        found.append(((bits ^ (bits >> 32)) * odd).sum(1))
    return torch.cat(found)


Method = Callable[[Start, int], Iterator[Parameters]]
"""Gives a number of starts."""


def _one_by_one(make: Callable[[Start], Parameters]) -> Method:
    return lambda start, n_starts: (make(start) for _ in range(n_starts))


def _kmeans_clusters(start: Start, n_starts: int) -> Iterator[Parameters]:
    """The moments of the clusters of each run of k-means."""
    labels, _ = kmeans(*start[:4], start.n_components, start.generator, n_starts)
    return (_moments_of_clusters(start, own) for own in labels)


def _best_clusters(start: Start) -> Parameters:
    """Of ten runs of k-means, the clustering with least scatter."""
    labels, scatter = kmeans(*start[:4], start.n_components, start.generator, 10)
    return _moments_of_clusters(start, labels[scatter.argmin()])


def _moments_of_clusters(start: Start, labels: Tensor) -> Parameters:
    points, weight, _, _, k, reg_covar, _, kind = start
    if is_small(points, weight, k, kind):
        return Parameters(*fused_moments(points, weight, labels, k, kind, reg_covar))
    if points.shape[1] > 3:
        found = by_type.moments_of_labels(points, weight, labels, k, kind)
        return by_type.maximized(found, reg_covar, None, kind)
    found = moments_of(em.quadratic_features(points), weight, labels, k, reg_covar, points)
    return by_type.compacted(found, kind)


def _far_points(start: Start, n_starts: int) -> Iterator[Parameters]:
    """Components of one point each, chosen far apart as k-means++ does, with variance `reg_covar`."""
    chosen = spread_out(*start[:4], start.n_components, start.generator, n_starts)
    return (start.isotropic(start.points[own], start.reg_covar) for own in chosen)


def _random_responsibilities(start: Start) -> Parameters:
    """The moments of uniformly random responsibilities: scikit-learn's "random"."""
    points, k, kind = start.points, start.n_components, start.kind
    linear = by_type.has_linear_form(k, points.shape[1], kind)
    sums = by_type.Sums(k, points, kind, None if linear else points.new_zeros(k, points.shape[1]))
    size = by_type.rows_of_chunk(k, points.shape[1], kind, points.device)
    for some, p in zip(start.rows.split(size), start.mass.split(size), strict=True):
        share = torch.rand(some.shape[0], k, generator=start.generator, dtype=torch.float64)
        share = share.to(points.device).T
        sums.add(points[some], share * (p / share.sum(0)))
    return by_type.maximized(sums.moments()[0], start.reg_covar, None, kind)


def _bounding_box(start: Start) -> Parameters:
    """Means uniform in the bounding box; isotropic covariance, uniform weights."""
    low, high = start.points.aminmax(dim=0)
    uniform = torch.rand(start.n_components, len(low), generator=start.generator, dtype=torch.float64)
    return start.tiling(low + (high - low) * uniform.to(low.device))


def _one_of_each_piece(start: Start) -> Parameters:
    """One component for each of the cloud's flat pieces: deterministic, and fast for any K."""
    k = start.n_components
    found, _ = flat_pieces(start.points[start.rows], start.mass, k, start.reg_covar)
    return by_type.compacted(replicated(found, k), start.kind)


def flat_pieces(
    points: Tensor, weight: Tensor, n_components: int, reg_covar: float, features: Tensor | None = None
) -> tuple[Parameters, Tensor]:
    """At most K components, and the component (N,) of each point (N, D).

    The cloud is halved repeatedly; long and thick pieces are halved first (see `partition`). In 2D and 3D,
    if there are many points a component, cells are partitioned instead of points. The points may already
    be the means of cells, with mean features `features` (N, F).
    """
    rule = FlatnessRule(
        0.0, 0.0, min_weight=0.0, min_weight_thick=0.0, max_components=n_components, outlier_gap=0.0
    )
    n_cells = max(_FEWEST_CELLS, _CELLS_OF_A_COMPONENT * n_components)
    low, high = points.aminmax(dim=0)
    finest = float((high - low).max()) / _FINEST_CELLS
    return partition_components(rule, points, weight, reg_covar, n_cells, finest, features)


def surface_pieces(
    points: Tensor, weight: Tensor, noise: float, reg_covar: float, features: Tensor | None = None
) -> tuple[Parameters, Tensor]:
    """As many components as the cloud has flat pieces, and the component (N,) of each point (N, D).

    The cloud, centred, is partitioned by `surface_rule`. Outliers aside, there are at most as many
    components as the total weight divided by `least_support`. `noise`: standard deviation of the sensor, in
    the unit of the points. The points may be the means of cells, with mean `features` (N, F).
    """
    rule = surface_rule(noise, points.shape[1])
    return partition_components(rule, points, weight, reg_covar, _SURFACE_CELLS, noise, features)


def partition_components(
    rule: FlatnessRule,
    points: Tensor,
    weight: Tensor,
    reg_covar: float,
    n_cells: int,
    finest: float,
    features: Tensor | None = None,
) -> tuple[Parameters, Tensor]:
    """Components of the pieces that `rule` gives, and the component (N,) of each point (N, D).

    If there are at least twice `n_cells` points (2D, 3D), cells of side `finest` or more are partitioned.
    """
    dim = points.shape[1]
    exact = None
    if features is not None:
        mass, member = weight, None
    elif dim > 3 or points.shape[0] < 2 * n_cells:
        features, mass, member, exact = em.quadratic_features(points), weight, None, points
    else:
        features, mass, member = pool_into_cells(points, n_cells, finest, weight)
    pieces = partition(features[:, 1 : 1 + dim].contiguous(), mass, rule, features)
    labels = pieces.labels if member is None else pieces.labels[member]
    return moments_of(features, mass, pieces.labels, pieces.n_pieces, reg_covar, exact), labels


def moments_of(
    features: Tensor,
    weight: Tensor,
    labels: Tensor,
    n_components: int,
    reg_covar: float,
    points: Tensor | None = None,
) -> Parameters:
    """Weight, mean and covariance of the rows (N, F) of each label (N,), labels below K.

    Pass `points` (N, D) if the features are those of points: far from the origin, points have digits that
    their products lack.
    """
    dim = em.feature_dimension(features.shape[1])
    if features.device.type == "cpu" and is_m_step_fused(dim, features, weight):
        rows = features if points is None else points
        return Parameters(*fused_label_moments(rows, weight, labels, n_components, dim, reg_covar))
    sums = pool(features[:, : 1 + dim], weight, labels, n_components)
    means = sums[:, 1:] / sums[:, :1].clamp_min(1e-300)
    # Second moments are taken about each piece's own mean, because pieces may be thin and far apart.
    center = means.index_select(0, labels)
    local = em.shift_features(features, -center) if points is None else em.quadratic_features(points - center)
    found = em.maximization(pool(local, weight, labels, n_components), reg_covar)
    return Parameters(found.weights, means + found.means, found.covariances)


INITIALIZATIONS: dict[str, Method] = {
    "kmeans": _kmeans_clusters,
    "kmeans_restarts": _one_by_one(_best_clusters),
    "k-means++": _far_points,
    "random": _one_by_one(_random_responsibilities),
    "random_from_data": _one_by_one(lambda start: start.isotropic(start.drawn(), start.reg_covar)),
    "random_points": _one_by_one(lambda start: start.tiling(start.drawn())),
    "bounding_box": _one_by_one(_bounding_box),
    "flat_pieces": _one_by_one(_one_of_each_piece),
}
"""Methods by name. "random_from_data", of scikit-learn, gives each drawn point the variance `reg_covar`."""


def initialize(
    method: str,
    points: Tensor,
    weight: Tensor,
    n_components: int,
    reg_covar: float,
    generator: torch.Generator,
    covariance_type: str = "full",
) -> Parameters:
    """The first of the `initializations`."""
    settings = n_components, reg_covar, generator, covariance_type
    return next(initializations(method, points, weight, *settings))


def initializations(
    method: str,
    points: Tensor,
    weight: Tensor,
    n_components: int,
    reg_covar: float,
    generator: torch.Generator,
    covariance_type: str,
    n_starts: int = 1,
) -> Iterator[Parameters]:
    """Starting parameters of K components for centred points with any number of distinct rows.

    Covariances have the shape of the type. Runs of k-means on small tables are made at once.

    If there are fewer distinct points than components, each distinct point gives one component, and the
    other components are copies that share its weight. The density is then that of the distinct points.
    """
    rows, mass = distinct(points, weight)
    n = min(n_components, rows.shape[0])
    start = Start(points, weight, rows, mass, n, reg_covar, generator, covariance_type)
    at_once = max(1, _DISTANCES // (len(points) * (2 + n.bit_length())))
    while n_starts > 0:
        found = INITIALIZATIONS[method](start, min(at_once, n_starts))
        n_starts -= at_once
        for one in found:
            yield replicated(one, n_components, covariance_type)


def replicated(found: Parameters, n_components: int, kind: str = "full") -> Parameters:
    """K components from fewer: copies share the weight."""
    n = found.weights.shape[0]
    if n == n_components:
        return found
    copy = torch.arange(n_components, device=found.weights.device) % n
    shares = torch.bincount(copy, minlength=n)[copy]
    covariances = found.covariances if kind == "tied" else found.covariances[copy]
    return Parameters(found.weights[copy] / shares, found.means[copy], covariances)

"""Starting parameters of EM (thesis 2.1.3): k-means, random points, the bounding box, or flat pieces.

Random draws are made among the distinct points, with summed weights, in an order that depends on the values
only. A point of weight 2 and the same point given twice therefore give the same start, up to rounding.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
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
_SURFACE_CELLS = 1 << 17  # `surface_pieces` partitions cells from twice this number of points on

Initialization = Callable[["Distinct", int, float, torch.Generator, str], Parameters]
"""(points, K, reg_covar, generator, covariance type) → parameters, with covariances in the shape of the
type. Points centred, float64.
"""


class Distinct(NamedTuple):
    """Points (N, D) with weights (N,), and which of them are distinct.

    rows: (M,) one point of each place, in an order that depends on the values only: by the first column,
    then by a hash of the others. mass: (M,) the summed weights of the points there.
    """

    points: Tensor
    weight: Tensor
    rows: Tensor
    mass: Tensor

    @staticmethod
    def of(points: Tensor, weight: Tensor) -> Distinct:
        order = argsort(points[:, 0].contiguous())
        column = points[order, 0]
        same = column[1:] == column[:-1]
        if not bool(same.any()):
            return Distinct(points, weight, order, weight[order])
        # Only rows that are equal in the first column need the other columns.
        tied = torch.cat([same.new_zeros(1), same]) | torch.cat([same, same.new_zeros(1)])
        among = order[tied]
        among = among[argsort(_hash(points, among))]
        order[tied] = among[argsort(points[among, 0])]
        for some in same.nonzero().squeeze(1).split(chunk_rows(points)):
            same[some] = (points[order[some + 1]] == points[order[some]]).all(1)
        is_new = torch.cat([~same.new_zeros(1), ~same])
        mass = weight.new_zeros(int(is_new.sum())).index_add_(0, is_new.cumsum(0) - 1, weight[order])
        return Distinct(points, weight, order[is_new], mass)

    def drawn(self, n: int, generator: torch.Generator) -> Tensor:
        """A draw (n, D) without replacement, by weight: the n smallest of E/w, E exponential."""
        race = torch.empty(self.mass.shape, dtype=torch.float64).exponential_(generator=generator)
        return self.points[self.rows[(race.to(self.mass.device) / self.mass).argsort()[:n]]]


def _hash(points: Tensor, rows: Tensor) -> Tensor:
    """A whole number (n,) for each of some rows; equal rows have equal ones."""
    odd = torch.randint(2**62, (points.shape[1],), generator=torch.Generator().manual_seed(0)) * 2 + 1
    odd, found = odd.to(points.device), []
    for some in rows.split(chunk_rows(points)):
        bits = (points[some] + 0.0).view(torch.int64)  # + 0, because −0 equals 0
        found.append(((bits ^ (bits >> 32)) * odd).sum(1))
    return torch.cat(found)


def from_kmeans(
    cloud: Distinct,
    n_components: int,
    reg_covar: float,
    generator: torch.Generator,
    kind: str,
    n_init: int = 1,
) -> Parameters:
    """The moments of k-means clusters; of `n_init` runs, the clustering with least scatter."""
    points, weight = cloud.points, cloud.weight
    labels, scatter = kmeans(*cloud, n_components, generator, n_init)
    best = labels[scatter.argmin()]
    if is_small(points, weight, n_components, kind):
        return Parameters(*fused_moments(points, weight, best, n_components, kind, reg_covar))
    if points.shape[1] > 3:
        found = by_type.moments_of_labels(points, weight, best, n_components, kind)
        return by_type.maximized(found, reg_covar, None, kind)
    found = moments_of(em.quadratic_features(points), weight, best, n_components, reg_covar, points)
    return by_type.compacted(found, kind)


def from_random_points(
    cloud: Distinct, n_components: int, reg_covar: float, generator: torch.Generator, kind: str
) -> Parameters:
    """Means at distinct random points, drawn by weight; isotropic covariance, uniform weights."""
    return _tiling(cloud.drawn(n_components, generator), cloud, reg_covar, kind)


def from_single_points(
    cloud: Distinct, n_components: int, reg_covar: float, generator: torch.Generator, kind: str
) -> Parameters:
    """Components of one random point each, with variance `reg_covar`: scikit-learn's "random_from_data"."""
    return _isotropic(cloud.drawn(n_components, generator), reg_covar, kind)


def from_kmeans_plus_plus(
    cloud: Distinct, n_components: int, reg_covar: float, generator: torch.Generator, kind: str
) -> Parameters:
    """Components of one point each, chosen far apart as k-means++ does, with variance `reg_covar`."""
    chosen = spread_out(*cloud, n_components, generator)[0]
    return _isotropic(cloud.points[chosen], reg_covar, kind)


def from_random_responsibilities(
    cloud: Distinct, n_components: int, reg_covar: float, generator: torch.Generator, kind: str
) -> Parameters:
    """The moments of uniformly random responsibilities: scikit-learn's "random"."""
    dim, device = cloud.points.shape[1], cloud.points.device
    linear = by_type.has_linear_form(n_components, dim, kind)
    about = None if linear else cloud.points.new_zeros(n_components, dim)
    sums = by_type.Sums(n_components, cloud.points, kind, about)
    size = by_type.rows_of_chunk(n_components, dim, kind, device)
    for some, p in zip(cloud.rows.split(size), cloud.mass.split(size), strict=True):
        share = torch.rand(some.shape[0], n_components, generator=generator, dtype=torch.float64)
        share = share.to(device).T
        sums.add(cloud.points[some], share * (p / share.sum(0)))
    return by_type.maximized(sums.moments()[0], reg_covar, None, kind)


def from_bounding_box(
    cloud: Distinct, n_components: int, reg_covar: float, generator: torch.Generator, kind: str
) -> Parameters:
    """Means uniform in the bounding box; isotropic covariance, uniform weights."""
    low, high = cloud.points.amin(0), cloud.points.amax(0)
    uniform = torch.rand(n_components, len(low), generator=generator, dtype=torch.float64)
    return _tiling(low + (high - low) * uniform.to(low.device), cloud, reg_covar, kind)


def _tiling(means: Tensor, cloud: Distinct, reg_covar: float, kind: str) -> Parameters:
    """Components with the cloud's mean variance, reduced as if they tile the cloud: σ² K^(−2/D)."""
    n_components, dim = means.shape
    spread = mean_variance(cloud.points, cloud.weight)
    return _isotropic(means, spread * n_components ** (-2 / dim) + reg_covar, kind)


def _isotropic(means: Tensor, variance: Tensor | float, kind: str) -> Parameters:
    """Components of equal weight and variance at the means (K, D)."""
    k, dim = means.shape
    weights = means.new_full((k,), 1 / k)
    values = means.new_ones(em.type_shape(kind, k, dim)) * variance
    if kind in ("full", "tied"):
        values *= torch.eye(dim, dtype=means.dtype, device=means.device)
    return Parameters(weights, means, values)


def from_flat_pieces(
    cloud: Distinct, n_components: int, reg_covar: float, generator: torch.Generator, kind: str
) -> Parameters:
    """One component for each of the cloud's flat pieces: deterministic, and fast for any K."""
    found, _ = flat_pieces(cloud.points[cloud.rows], cloud.mass, n_components, reg_covar)
    return by_type.compacted(replicated(found, n_components)[0], kind)


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


INITIALIZATIONS: dict[str, Initialization] = {
    "kmeans": from_kmeans,
    "kmeans_restarts": functools.partial(from_kmeans, n_init=10),
    "k-means++": from_kmeans_plus_plus,
    "random": from_random_responsibilities,
    "random_from_data": from_single_points,
    "random_points": from_random_points,
    "bounding_box": from_bounding_box,
    "flat_pieces": from_flat_pieces,
}


def initialize(
    method: str,
    points: Tensor,
    weight: Tensor,
    n_components: int,
    reg_covar: float,
    generator: torch.Generator,
    covariance_type: str = "full",
) -> Parameters:
    """Starting parameters of K components for centred points with any number of distinct rows.

    Covariances have the shape of the type.

    If there are fewer distinct points than components, each distinct point gives one component, and the
    other components are copies that share its weight. The density is then that of the distinct points.
    """
    cloud = Distinct.of(points, weight)
    n = min(n_components, cloud.rows.shape[0])
    found = INITIALIZATIONS[method](cloud, n, reg_covar, generator, covariance_type)
    return replicated(found, n_components, covariance_type)[0]


def replicated(found: Parameters, n_components: int, kind: str = "full") -> tuple[Parameters, Tensor]:
    """K components from fewer: copies share the weight.

    Also the index (K,) of the component each one copies.
    """
    n = found.weights.shape[0]
    copy = torch.arange(n_components, device=found.weights.device) % n
    if n == n_components:
        return found, copy
    shares = torch.bincount(copy, minlength=n)[copy]
    covariances = found.covariances if kind == "tied" else found.covariances[copy]
    return Parameters(found.weights[copy] / shares, found.means[copy], covariances), copy

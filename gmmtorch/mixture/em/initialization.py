"""Where EM starts (thesis 2.1.3): k-means, random points, uniform in the bounding box, or flat pieces.

Starts are drawn from the distinct points, in sorted order, with their summed weights: so a point of
weight 2 and the same point given twice start EM from the very same place.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable

import numpy as np
import torch
from sklearn.cluster import KMeans
from sklearn.exceptions import ConvergenceWarning
from torch import Tensor

from gmmtorch.mixture.em.cells import pool_into_cells
from gmmtorch.mixture.em.exact import (
    Parameters,
    feature_dimension,
    maximization,
    quadratic_features,
    shift_features,
)
from gmmtorch.mixture.em.partition import FlatnessRule, partition, pool

_FEWEST_CELLS, _CELLS_OF_A_COMPONENT = 4096, 8  # that flat pieces are cut from
_FINEST_CELLS = 1 << 14  # along the longest side

Initialization = Callable[[Tensor, Tensor, int, float, torch.Generator], Parameters]
"""(points (N, D), weight (N,), K, reg_covar, generator) → parameters. Points centred, float64."""


def distinct_points(points: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Distinct rows in lexicographic order, and the sum of the weights of each."""
    unique, inverse = np.unique(points.detach().cpu().numpy(), axis=0, return_inverse=True)
    sums = np.bincount(inverse.reshape(-1), weights=weight.detach().cpu().numpy(), minlength=unique.shape[0])
    return torch.from_numpy(unique).to(points.device), torch.from_numpy(sums).to(points.device)


def from_kmeans(
    points: Tensor,
    weight: Tensor,
    n_components: int,
    reg_covar: float,
    generator: torch.Generator,
    n_init: int = 1,
) -> Parameters:
    """One covariance for each of scikit-learn's k-means clusters, the tightest of `n_init` runs."""
    seed = int(torch.randint(2**31 - 1, (), generator=generator))
    kmeans = KMeans(n_components, n_init=n_init, random_state=seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # fewer clusters than asked for: see start()
        labels = kmeans.fit(points.cpu().numpy(), sample_weight=weight.cpu().numpy()).labels_
    labels = torch.from_numpy(labels.astype(np.int64)).to(points.device)
    return moments_of(quadratic_features(points), weight, labels, n_components, reg_covar, points)


def from_kmeans_restarts(
    points: Tensor, weight: Tensor, n_components: int, reg_covar: float, generator: torch.Generator
) -> Parameters:
    """The tightest of ten k-means clusterings."""
    return from_kmeans(points, weight, n_components, reg_covar, generator, n_init=10)


def from_random_points(
    points: Tensor, weight: Tensor, n_components: int, reg_covar: float, generator: torch.Generator
) -> Parameters:
    """Means at distinct random points, drawn by weight; isotropic covariance, uniform weights."""
    # Exponential race: the K smallest of E/w are a weighted draw without replacement.
    race = torch.empty(weight.shape, dtype=torch.float64).exponential_(generator=generator)
    chosen = (race.to(weight.device) / weight).argsort()[:n_components]
    return _isotropic(points[chosen], points, weight, reg_covar)


def from_bounding_box(
    points: Tensor, weight: Tensor, n_components: int, reg_covar: float, generator: torch.Generator
) -> Parameters:
    """Means uniform in the bounding box; isotropic covariance, uniform weights."""
    low, high = points.amin(0), points.amax(0)
    uniform = torch.rand(n_components, points.shape[1], generator=generator, dtype=torch.float64)
    return _isotropic(low + (high - low) * uniform.to(points.device), points, weight, reg_covar)


def _isotropic(means: Tensor, points: Tensor, weight: Tensor, reg_covar: float) -> Parameters:
    """The cloud's mean variance, shrunk as if the components tiled it: σ² K^(−2/D)."""
    n_components, dim = means.shape
    center = (weight[:, None] * points).sum(0) / weight.sum()
    spread = (weight[:, None] * (points - center) ** 2).sum() / weight.sum() / dim
    variance = spread * n_components ** (-2 / dim) + reg_covar
    covariances = torch.eye(dim, dtype=means.dtype, device=means.device) * variance
    weights = means.new_full((n_components,), 1 / n_components)
    return Parameters(weights, means, covariances.expand(n_components, dim, dim).clone())


def from_flat_pieces(
    points: Tensor, weight: Tensor, n_components: int, reg_covar: float, generator: torch.Generator
) -> Parameters:
    """One component for each of the cloud's flat pieces: nothing random, and cheap for any K."""
    found, _ = flat_pieces(points, weight, n_components, reg_covar)
    return copied(found, n_components)[0]


def flat_pieces(
    points: Tensor, weight: Tensor, n_components: int, reg_covar: float, features: Tensor | None = None
) -> tuple[Parameters, Tensor]:
    """At most K components, and the one that each point (N, D) belongs to, (N,).

    The cloud is halved again and again, the longest and thickest pieces first (see `partition`). In
    2D and 3D, that is done on cells where there are many points to a component. The points may be
    the means of cells already, and `features` (N, F) their mean features.
    """
    rule = FlatnessRule(
        0.0, 0.0, min_weight=0.0, min_weight_thick=0.0, max_components=n_components, apart=0.0
    )
    n_cells = max(_FEWEST_CELLS, _CELLS_OF_A_COMPONENT * n_components)
    finest = float((points.amax(0) - points.amin(0)).max()) / _FINEST_CELLS
    return pieces_by(rule, points, weight, reg_covar, n_cells, finest, features)


def pieces_by(
    rule: FlatnessRule,
    points: Tensor,
    weight: Tensor,
    reg_covar: float,
    n_cells: int,
    finest: float,
    features: Tensor | None = None,
) -> tuple[Parameters, Tensor]:
    """What `flat_pieces` gives, of the pieces that a rule cuts.

    Where there are more than twice `n_cells` points (2D, 3D), cells of side `finest` or more are cut.
    """
    dim = points.shape[1]
    exact = None
    if features is not None:
        mass, member = weight, None
    elif dim > 3 or points.shape[0] < 2 * n_cells:
        features, mass, member, exact = quadratic_features(points), weight, None, points
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
    """Weight, mean and covariance of the rows of each label: (N, F) features, labels (N,) below K.

    `points` (N, D), if the features are those of points: far out, they have digits that products lack.
    """
    dim = feature_dimension(features.shape[1])
    sums = pool(features[:, : 1 + dim], weight, labels, n_components)
    means = sums[:, 1:] / sums[:, :1].clamp_min(1e-300)
    # Second moments about each one's own mean: pieces may be thin, and far apart.
    center = means.index_select(0, labels)
    local = shift_features(features, -center) if points is None else quadratic_features(points - center)
    found = maximization(pool(local, weight, labels, n_components), reg_covar)
    return Parameters(found.weights, means + found.means, found.covariances)


INITIALIZATIONS: dict[str, Initialization] = {
    "kmeans": from_kmeans,
    "kmeans_restarts": from_kmeans_restarts,
    "random_points": from_random_points,
    "bounding_box": from_bounding_box,
    "flat_pieces": from_flat_pieces,
}


def start(
    method: str,
    points: Tensor,
    weight: Tensor,
    n_components: int,
    reg_covar: float,
    generator: torch.Generator,
) -> Parameters:
    """Starting parameters of K components for centred points, whatever their number of distinct rows.

    Fewer distinct points than components: the start has one component for each, and the rest are
    copies that share the weight, so the density is what the distinct points ask for.
    """
    points, weight = distinct_points(points, weight)
    n = min(n_components, points.shape[0])
    found = INITIALIZATIONS[method](points, weight, n, reg_covar, generator)
    return copied(found, n_components)[0]


def copied(found: Parameters, n_components: int) -> tuple[Parameters, Tensor]:
    """K components from fewer: copies that share the weight; and which (K,) each is a copy of."""
    n = found.weights.shape[0]
    copy = torch.arange(n_components, device=found.weights.device) % n
    shares = torch.bincount(copy, minlength=n)[copy]
    parameters = Parameters(found.weights[copy] / shares, found.means[copy], found.covariances[copy])
    return parameters, copy

"""Where EM starts (thesis 2.1.3): k-means, random points, or uniform in the bounding box.

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

from gmmtorch.mixture.em import Parameters, maximization, quadratic_features
from gmmtorch.mixture.partition import pool

Initialization = Callable[[Tensor, Tensor, int, float, torch.Generator], Parameters]
"""(points (N, D), weight (N,), K, reg_covar, generator) → parameters. Points centred, float64."""


def distinct_points(points: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Distinct rows in lexicographic order, and the sum of the weights of each."""
    unique, inverse = np.unique(points.detach().cpu().numpy(), axis=0, return_inverse=True)
    sums = np.bincount(inverse.reshape(-1), weights=weight.detach().cpu().numpy(), minlength=unique.shape[0])
    return torch.from_numpy(unique).to(points.device), torch.from_numpy(sums).to(points.device)


def from_kmeans(
    points: Tensor, weight: Tensor, n_components: int, reg_covar: float, generator: torch.Generator
) -> Parameters:
    """One covariance for each of scikit-learn's k-means clusters."""
    seed = int(torch.randint(2**31 - 1, (), generator=generator))
    kmeans = KMeans(n_components, n_init=1, random_state=seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # fewer clusters than asked for: see start()
        labels = kmeans.fit(points.cpu().numpy(), sample_weight=weight.cpu().numpy()).labels_
    labels = torch.from_numpy(labels.astype(np.int64)).to(points.device)
    # Second moments about each cluster's own mean: clusters may be thin, and far apart.
    count = points.new_zeros(n_components).index_add_(0, labels, weight).clamp_min(1e-300)
    means = points.new_zeros(n_components, points.shape[1])
    means = means.index_add_(0, labels, points * weight[:, None]) / count[:, None]
    statistics = pool(quadratic_features(points - means[labels]), weight, labels, n_components)
    found = maximization(statistics, reg_covar)
    return Parameters(found.weights, means + found.means, found.covariances)


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


INITIALIZATIONS: dict[str, Initialization] = {
    "kmeans": from_kmeans,
    "random_points": from_random_points,
    "bounding_box": from_bounding_box,
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
    if n == n_components:
        return found
    copy = torch.arange(n_components, device=points.device) % n
    shares = torch.bincount(copy, minlength=n)[copy]
    return Parameters(found.weights[copy] / shares, found.means[copy], found.covariances[copy])

"""k-means of weighted points, for starts of EM: all its runs are one batch of products.

Draws are made among the distinct points in a given order. Points of weight 2 and the same points given
twice therefore give the same clusters.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gmmtorch.kernels import fused_kmeans, is_kmeans_fused, nearest_centers
from gmmtorch.mixture.em.by_type import in_chunks

_MAX_ITER, _TOLERANCE = 300, 1e-4  # the tolerance is a share of the mean variance, as in scikit-learn
_STEPS_AHEAD = 8  # on a GPU: steps of Lloyd's between two waits for its convergence


def kmeans(
    points: Tensor,
    weight: Tensor,
    rows: Tensor,
    mass: Tensor,
    n_clusters: int,
    generator: torch.Generator,
    n_runs: int = 1,
) -> tuple[Tensor, Tensor]:
    """Clusters (R, N) of points (N, D), centred, of each of R runs, and the scatter (R,) within them.

    Lloyd's iterations from the centers of `spread_out`. A cluster that loses all its points continues at
    the point that is farthest from its center. `rows`, `mass`: see `spread_out`.
    """
    centers = points[spread_out(points, weight, rows, mass, n_clusters, generator, n_runs)]
    least = _TOLERANCE * mean_variance(points, weight)
    if is_kmeans_fused(points, weight):
        nearest, distance = fused_kmeans(points, weight, centers, _MAX_ITER, float(least))
        return nearest, distance @ weight
    every = 1 if points.device.type == "cpu" else _STEPS_AHEAD
    for step in range(_MAX_ITER):
        _, distance, sums = nearest_centers(points, weight, centers)
        count = sums[:, :, :1]
        new = torch.where(count > 0, sums[:, :, 1:] / count.clamp_min(1e-300), centers)
        shift, centers = (new - centers).square().sum((1, 2)), new
        if step % every == every - 1:
            if not bool((count > 0).all()):
                centers = _refilled(points, distance, centers, count[:, :, 0] == 0)
            elif bool((shift <= least).all()):
                break
    nearest, distance, _ = nearest_centers(points, weight, centers)
    return nearest, distance @ weight


def mean_variance(points: Tensor, weight: Tensor) -> Tensor:
    """The variance of weighted points (N, D) along an axis, on average over the axes."""
    center, total = weight @ points / weight.sum(), weight.sum()
    spread = weight.new_zeros(())
    for some, p in in_chunks(points, weight):
        spread = spread + (p @ (some - center).square_()).sum() / total / points.shape[1]
    return spread


def spread_out(
    points: Tensor,
    weight: Tensor,
    rows: Tensor,
    mass: Tensor,
    n_centers: int,
    generator: torch.Generator,
    n_runs: int = 1,
) -> Tensor:
    """Indices (R, K) of points far apart, by the greedy k-means++ (Arthur & Vassilvitskii, 2007).

    Each is drawn with a probability that grows with the squared distance to the chosen ones; of 2 + log K
    draws, the one that leaves the least scatter is chosen. Needs memory for 2 R (2 + log K) N numbers.

    Args:
        rows: (M,) the distinct points, in an order that does not depend on that of the points.
        mass: (M,) their weights.
    """

    def draw(heights: Tensor, at: Tensor) -> Tensor:
        heights = heights.cumsum(1)
        found = torch.searchsorted(heights, at * heights[:, -1:], right=True)
        return rows[found.clamp_max_(len(rows) - 1)]

    def distances(chosen: Tensor) -> Tensor:
        """Squared distances (R, n, N) to points of indices (R, n)."""
        centers = points[chosen.flatten()]
        found = torch.addmm(centers.square().sum(1, keepdim=True), centers, points.T, alpha=-2)
        found.add_(square).clamp_min_(0).scatter_(1, chosen.flatten()[:, None], 0.0)
        return found.view(*chosen.shape, -1)

    square = torch.linalg.vector_norm(points, dim=1).square()
    n_trials = 2 + int(math.log(n_centers))
    n_draws = 1 + (n_centers - 1) * n_trials  # of a run, which has the same draws alone
    at = torch.rand(n_runs, n_draws, generator=generator, dtype=torch.float64).to(points.device)
    chosen = [draw(mass.expand(n_runs, -1), at[:, :1])]
    closest = distances(chosen[0])
    for begin in range(1, n_draws, n_trials):
        trials = draw(closest[:, 0, rows] * mass, at[:, begin : begin + n_trials])
        left = torch.minimum(distances(trials), closest)
        best = (left @ weight).argmin(1, keepdim=True)
        chosen.append(trials.gather(1, best))
        closest = left.gather(1, best[:, :, None].expand(-1, -1, len(points)))
    return torch.cat(chosen, 1)


def _refilled(points: Tensor, distance: Tensor, centers: Tensor, empty: Tensor) -> Tensor:
    """Centers (R, K, D) with the `empty` (R, K) ones at the points of the largest `distance` (R, N)."""
    far = distance.topk(min(int(empty.sum(1).max()), distance.shape[1]), 1).indices
    place = (empty.cumsum(1) - 1).clamp(0, far.shape[1] - 1)
    return torch.where(empty[:, :, None], points[far.gather(1, place)], centers)

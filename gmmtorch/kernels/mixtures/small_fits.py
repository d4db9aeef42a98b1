"""Whole fits of small tables on a CPU: all runs of k-means, and all starts of EM, in one launch each.

A step in tensor operations takes a hundred microseconds whatever it computes, which is longer than the
arithmetic of a small table. The twins are the loops of `mixture.em`. Everything is in the direct form, with
second moments about the new means: nothing cancels.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.kernels.choice import is_fused
from gmmtorch.kernels.compiler import CPU_LANES, FusedKernel

# The runs share their scratch.
_LLOYD = FusedKernel("mixtures/small_fits.h", "lloyd_runs", shares=True)
_EM = FusedKernel("mixtures/small_fits.h", "em_runs", shares=True)
_KINDS = ("full", "tied", "diag", "spherical")
_MOST_PRODUCTS = {"full": 1 << 25, "tied": 1 << 22, "diag": 1 << 22, "spherical": 3 << 19}
"""Products of an iteration, N K D or N K D², up to which one launch is faster than tensor operations."""
_MOST_PAIRS = 1 << 17  # of point and component, in up to three dimensions, whose twin is fused as well
_PRODUCTS_OF_A_LAUNCH = 1 << 31  # less than a second: Python can stop a fit only between launches


def is_kmeans_fused(points: Tensor, weight: Tensor) -> bool:
    """Whether `fused_kmeans` computes k-means of points (N, D): on a CPU in float64."""
    return points.device.type == "cpu" and points.dtype == weight.dtype == torch.float64 and is_fused(points)


def is_small(points: Tensor, weight: Tensor, n_components: int, kind: str) -> bool:
    """Whether `fused_em` is the fastest for points (N, D) and K components."""
    (n, dim), k = points.shape, n_components
    few = n * k * dim ** (2 if kind in ("full", "tied") else 1) <= _MOST_PRODUCTS[kind]
    return few and (dim > 3 or n * k <= _MOST_PAIRS) and is_kmeans_fused(points, weight)


def fused_kmeans(
    points: Tensor, weight: Tensor, centers: Tensor, max_iter: int, least_shift: float
) -> tuple[Tensor, Tensor]:
    """The nearest center (R, N) of each point, and the squared distance to it, after Lloyd's iterations.

    They start at centers (R, K, D), and end if these move by a sum of squares of at most `least_shift`.
    """
    (n, dim), (n_runs, k, _) = points.shape, centers.shape
    padded = torch.nn.functional.pad(centers, (0, 0, 0, -k % 4)).contiguous()
    n_padded, done = padded.shape[1], torch.zeros(n_runs, dtype=torch.bool)
    scratch = points.new_empty(dim * CPU_LANES + n_padded * (dim + 2))
    nearest, distance = torch.empty(n_runs, n, dtype=torch.int64), points.new_empty(n_runs, n)
    given = points, weight, n, dim, k, n_padded
    results = least_shift, padded, scratch, nearest, distance, done
    n_steps = max(1, _PRODUCTS_OF_A_LAUNCH // (n_runs * n * k * dim))
    for begin in range(0, max_iter, n_steps):
        _LLOYD(n_runs, *given, min(n_steps, max_iter - begin), *results)
        if bool(done.all()):
            break
    _LLOYD(n_runs, *given, 0, *results)
    return nearest, distance


class Runs(NamedTuple):
    """Parameters of R mixtures, and what the last iterations of each gave.

    weights (R, K), means (R, K, D), covariances (R, …) in the shape of their type. counts: (R, K), the points
    of each component. entropy: (R,), of the responsibilities. bounds: of each run, its mean log-likelihoods.
    failed: of each run, whether the next iteration needs the checks of the twin.
    """

    weights: Tensor
    means: Tensor
    covariances: Tensor
    counts: Tensor
    entropy: Tensor
    bounds: list[list[float]]
    failed: list[bool]


def fused_moments(
    points: Tensor, weight: Tensor, labels: Tensor, n_components: int, kind: str, reg_covar: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Share, mean and covariance of the points (N, D) of each label (N,) below K."""
    k, dim = n_components, points.shape[1]
    size = {"full": (k, dim, dim), "tied": (dim, dim), "diag": (k, dim), "spherical": (k,)}[kind]
    given = points.new_zeros(1, k), points.new_zeros(1, k, dim), points.new_zeros(1, *size)
    found = fused_em(points, weight, given, kind, reg_covar, labels=labels)
    return found.weights[0], found.means[0], found.covariances[0]


def fused_em(
    points: Tensor,
    weight: Tensor,
    starts: tuple[Tensor, Tensor, Tensor],
    kind: str,
    reg_covar: float,
    tol: float = 0.0,
    max_iter: int = 1,
    last_bound: float = -math.inf,
    log_weights: Tensor | None = None,
    labels: Tensor | None = None,
) -> Runs:
    """EM of points (N, D) from weights (R, K), means (R, K, D) and covariances, which are overwritten.

    A run ends when its mean log-likelihood changes by less than `tol`, at first from `last_bound`, or after
    `max_iter` iterations. With log_weights (K,), these replace those of the weights. With labels (R, N),
    there is no iteration, but the moments of the points of each label.
    """
    weights, means, covariances = (part.contiguous() for part in starts)
    (n, dim), (n_runs, k) = points.shape, weights.shape
    n_blocks, n_sums = -(-n // CPU_LANES), dim * dim if kind in ("full", "tied") else dim
    n_vectors = n_blocks * (dim + 1 + k) + dim + n_sums
    scratch = points.new_empty(n_vectors * CPU_LANES + dim * dim + k * (dim + 3) * dim + k)
    counts, entropy = torch.empty_like(weights), points.new_empty(n_runs)
    last, state = points.new_full((n_runs,), last_bound), torch.zeros(n_runs, dtype=torch.int64)
    given = points, weight, n, dim, k, _KINDS.index(kind), reg_covar, tol
    found: list[list[float]] = [[] for _ in range(n_runs)]
    stopped, most = [0], max(1, _PRODUCTS_OF_A_LAUNCH // (n_runs * n * k * n_sums))
    while not all(stopped) and len(found[stopped.index(0)]) < max_iter:
        n_steps = min(most, max_iter - max(map(len, found)))
        bounds, n_done = points.new_empty(n_runs, n_steps), torch.empty(n_runs, dtype=torch.int64)
        results = counts, weights, means, covariances, last, bounds, entropy, n_done, state
        _EM(n_runs, *given, n_steps, log_weights, labels, scratch, *results)
        if labels is not None:
            break
        for run, (row, done) in enumerate(zip(bounds.tolist(), n_done.tolist(), strict=True)):
            found[run] += row[:done]
        stopped = state.tolist()
    return Runs(weights, means, covariances, counts, entropy, found, [value == 2 for value in stopped])

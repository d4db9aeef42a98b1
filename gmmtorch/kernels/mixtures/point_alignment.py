"""Sums over the points of a scan that is aligned with a mixture (`registration.alignment`); and their twin.

The fused kernel keeps the sums of a part of the points. They differ from the twin's by at most 10⁻¹¹ of their
largest entry.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.kernels.choice import is_fused
from gmmtorch.kernels.compiler import FusedKernel

_GPU_PARTS = 64  # of the points of a motion; each part has its own sums
_LEAST_POINTS = 256  # of a part on a CPU

_KERNELS = {dim: FusedKernel("mixtures/point_alignment.h", f"point_alignment<{dim}>") for dim in (2, 3)}


class AlignmentSums(NamedTuple):
    """Of each of B motions, with q_n = Σ_k exp(−½ d_nk²) over the components listed for point n:

    score: Σ log(1 + q_n/ε) (B,). n_explained: number of points with q above the given height (B,).
    gradient: of the score in a shift and a turn, (B, F), F = D + D(D−1)/2.
    complete: information (B, F, F) if the component of each point were known, as in a step of EM.
    observed: the complete information less the missing one (Louis 1982), about −∇² of the score.
    """

    score: Tensor
    n_explained: Tensor
    gradient: Tensor
    complete: Tensor
    observed: Tensor


def alignment_sums(
    points: Tensor,
    motions: tuple[Tensor, Tensor],
    lists: tuple[Tensor, Tensor, Tensor],
    target: tuple[Tensor, Tensor, Tensor],
    limits: tuple[float, float, float, float],
) -> AlignmentSums:
    """The sums over N points under B motions.

    Args:
        points: (N, D), float64. motions: rotations (B, D, D) and translations (B, D).
        lists: the bucket of each moved point (B N,), or −1; starts and entries of the buckets' lists.
        target: means (K, D), precisions (K, D, D) and normals (K, D) of the components, zero for those that
            are seen from all sides.
        limits: metres behind a component's face from which on the sensor does not see it; d² beyond which a
            component is left out; ε; q above which a point counts as explained.
    """
    n, dim = motions[1].shape
    behind, farthest, outliers, height = limits
    if not is_fused(points, *motions, *lists, *target):
        return _batched(points, motions, lists, target, limits)
    free = dim + dim * (dim - 1) // 2
    on_cpu = points.device.type == "cpu"
    n_parts = max(1, min(torch.get_num_threads(), len(points) // _LEAST_POINTS)) if on_cpu else _GPU_PARTS
    n_triangle = free * (free + 1) // 2
    sums = points.new_empty(n, n_parts, 2 + free + 2 * n_triangle)
    given = [part.contiguous() for part in (*motions, *lists, *target)]
    counts = len(points), n_parts
    bounds = behind, farthest, outliers, outliers + height
    _KERNELS[dim](n * n_parts, points.contiguous(), *counts, *given, *bounds, sums, device=points.device)
    score, n_explained, gradient, *triangles = sums.sum(1).split([1, 1, free, n_triangle, n_triangle], 1)
    rows, columns = torch.triu_indices(free, free, device=points.device)
    full = points.new_zeros(2, n, free, free)
    full[:, :, rows, columns] = full[:, :, columns, rows] = torch.stack(triangles)
    return AlignmentSums(score[:, 0], n_explained[:, 0], gradient, full[0], full[1])


def _batched(
    points: Tensor,
    motions: tuple[Tensor, Tensor],
    lists: tuple[Tensor, Tensor, Tensor],
    target: tuple[Tensor, Tensor, Tensor],
    limits: tuple[float, float, float, float],
) -> AlignmentSums:
    """The twin."""
    (rotations, translations), (means, precisions, normals) = motions, target
    behind, farthest, outliers, height = limits
    n, (count, dim) = len(translations), points.shape
    lever = (points @ rotations.mT).flatten(0, 1)
    moved = lever + translations.repeat_interleave(count, 0)
    row, component = _listed(*lists)
    offset = moved[row] - means[component]
    precision = precisions[component]
    pulls = (precision @ offset[:, :, None])[:, :, 0]
    square = (offset * pulls).sum(1)
    above = (normals[component] * (translations[row // count] - means[component])).sum(1)
    hidden = (square > farthest) | (above < -behind)
    heights = torch.where(hidden, 0.0, torch.exp(-0.5 * square))
    total = lever.new_full((n * count,), outliers).index_add(0, row, heights)

    def mean(terms: Tensor) -> Tensor:
        """Means over the components of each point, weighted by their share in it."""
        weighted = heights.view(-1, *[1] * (terms.ndim - 1)) * terms
        summed = lever.new_zeros(n * count, *terms.shape[1:]).index_add(0, row, weighted)
        return summed / total.view(-1, *[1] * (terms.ndim - 1))

    pull, weight = mean(pulls), mean(precision)
    spread = weight - mean(pulls[:, :, None] * pulls[:, None]) + pull[:, :, None] * pull[:, None]
    jacobian = torch.cat([torch.eye(dim).to(lever).expand(n * count, dim, dim), _arms(lever)], 2)
    gradient = -(jacobian.mT @ pull[:, :, None])[:, :, 0]
    complete, observed = (jacobian.mT @ inner @ jacobian for inner in (weight, spread))
    return AlignmentSums(
        (total / outliers).log().view(n, count).sum(1),
        (total > outliers + height).to(lever).view(n, count).sum(1),
        *(terms.unflatten(0, (n, count)).sum(1) for terms in (gradient, complete, observed)),
    )


def _listed(bucket: Tensor, starts: Tensor, entries: Tensor) -> tuple[Tensor, Tensor]:
    """Pairs of a point and a component (P,) of its bucket's list."""
    known = (bucket >= 0).nonzero()[:, 0]
    begin = starts[bucket[known]]
    length = starts[bucket[known] + 1] - begin
    row = torch.repeat_interleave(length)
    within = torch.arange(len(row), device=row.device) - (length.cumsum(0) - length)[row]
    return known[row], entries[begin[row] + within].long()


def _arms(lever: Tensor) -> Tensor:
    """G_k x (M, D, D(D−1)/2) of points x (M, D): their motion in a turn of one radian about each axis."""
    if lever.shape[1] == 2:
        return torch.stack([-lever[:, 1], lever[:, 0]], 1)[:, :, None]
    x, y, z = lever.unbind(1)
    zero = torch.zeros_like(x)
    columns = [torch.stack(column, 1) for column in ((zero, -z, y), (z, zero, -x), (-y, x, zero))]
    return torch.stack(columns, 2)

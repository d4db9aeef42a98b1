"""A cloud in parts: flat pieces, which give the number of components and the start of EM, and cells.

A piece is halved at its mean, across its longest direction, while it is thicker than the sensor's
noise explains, or longer than a component may be, and both halves keep enough points. All pieces of
a level are halved as one batch of tensor operations. So a wall gives few pieces, a curved surface
more pieces the lower the noise, and edges and clutter as many as their points support. If the number
of pieces is limited, pieces with many points, large extent and above all large thickness come first.

Nothing is random, and only the noise has a unit: points and noise in millimetres give the same pieces.
For points that are not on surfaces, or noise in another unit than the points, the result is one piece
if the noise explains all points, and otherwise as many pieces as have enough points.
docs/decisions.md compares this rule with BIC and mean shift.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor

from gmmtorch.kernels import (
    KEY_BITS,
    CutRule,
    are_cell_moments_fused,
    are_piece_cuts_fused,
    cell_moments,
    piece_cuts,
)
from gmmtorch.linalg import dense_ranks, eigen, on_cpu, unpack_symmetric
from gmmtorch.mixture.em.exact import quadratic_features

_MAX_LEVELS = 64
_MOST_ON_CPU = 1 << 17  # cells of another device: each level of cuts waits for the one before it
_THICKNESS_PRIORITY = 30.0
"""Weight of a piece's smallest variance, relative to its largest, in the priority of halving it. Thick
pieces span several surfaces, and so put matter into free space (docs/decisions.md, "Where EM starts")."""
_FLAT = 2.0  # largest thickness of a flat piece, in standard deviations of the noise
_OUTLIER_GAP = 100.0  # from which on a few stray points form a piece, in standard deviations
_MAX_CELLS_ALONG = (1 << KEY_BITS) - 2  # along the longest side
_CHUNK_POINTS = 1 << 17
T = TypeVar("T")


@dataclass(frozen=True)
class FlatnessRule:
    """When a piece is halved. Standard deviations are in metres, weights in points.

    thickness: a piece whose smallest standard deviation is larger is not flat. length: a piece whose
    largest standard deviation is larger is too long. min_weight: smallest weight of a half.
    min_weight_thick: smallest weight of a half of a piece of over twice the thickness, which spans several
    surfaces. max_components: largest number of pieces; then at most half of the pieces are halved per
    level, heavy, long and above all thick ones first. outlier_gap: a half may have any weight if farther
    than this from the other half (m), as outliers are.
    """

    thickness: float = 0.02
    length: float = 0.3
    min_weight: float = 3.0
    min_weight_thick: float = 1.0
    max_components: int | None = None
    outlier_gap: float = 3.0


def least_support(dim: int) -> int:
    """Fewest points of a component: 6 in 2D, 20 in 3D, and twice its parameters in more dimensions."""
    return 6 if dim <= 2 else 2 + dim * (dim + 3)


def surface_rule(noise: float, dim: int, min_points: float | None = None) -> FlatnessRule:
    """The rule for a cloud (N, dim) measured with this noise (standard deviation, unit of the points).

    `min_points`: fewest points of a piece; None: `least_support`.
    """
    least = least_support(dim) if min_points is None else min_points
    return FlatnessRule(
        thickness=_FLAT * noise,
        length=math.inf,
        min_weight=least,
        min_weight_thick=least,
        outlier_gap=_OUTLIER_GAP * noise,
    )


class Partition(NamedTuple):
    """labels (N,): the piece of each point; n_pieces: number of pieces, none of them empty."""

    labels: Tensor
    n_pieces: int


def pool(features: Tensor, weight: Tensor, labels: Tensor, n_pieces: int) -> Tensor:
    """Weighted sums (n_pieces, F) of features (N, F) by label: the statistics of each piece."""
    sums = features.new_zeros(n_pieces, features.shape[1])
    return sums.index_add_(0, labels, features * weight[:, None])


def partition(
    points: Tensor, weight: Tensor, rule: FlatnessRule, features: Tensor | None = None
) -> Partition:
    """Partition points (N, D), centred, float64, N ≥ 1, with weights (N,), into flat pieces.

    If the points are the means of cells, pass the cells' mean features `features` (N, F), so that the
    extent within the cells counts towards the thickness.
    """
    n, dim = points.shape
    features = quadratic_features(points) if features is None else features
    if are_piece_cuts_fused(points, weight, features, rule.max_components):
        limit = -1 if rule.max_components is None else rule.max_components
        given = vars(rule) | {"n_levels": _MAX_LEVELS, "max_components": limit}
        cuts = CutRule(**given, thickness_priority=_THICKNESS_PRIORITY)
        return Partition(*piece_cuts(points, weight, features, cuts))
    if points.device.type != "cpu" and n <= _MOST_ON_CPU:
        points_cpu, weight_cpu, features_cpu = on_cpu(points, weight, features)
        found = partition(points_cpu, weight_cpu, rule, features_cpu)
        return found._replace(labels=found.labels.to(points.device))
    labels = torch.zeros(n, dtype=torch.int64, device=points.device)
    n_pieces = 1
    for _ in range(_MAX_LEVELS):
        statistics = pool(features, weight, labels, n_pieces)
        count = statistics[:, 0].clamp_min(1e-300)
        means = statistics[:, 1 : 1 + dim] / count[:, None]
        second = unpack_symmetric(statistics[:, 1 + dim :] / count[:, None], dim)
        variances, directions = eigen(second - means[:, :, None] * means[:, None, :])
        deviation = variances.clamp_min(0).sqrt()
        wanted = (deviation[:, 0] > rule.thickness) | (deviation[:, -1] > rule.length)
        thick = (deviation[:, 0] > 2 * rule.thickness).to(count)
        least = rule.min_weight + thick * (rule.min_weight_thick - rule.min_weight)
        longest = directions[:, :, -1]
        largest = longest.gather(1, longest.abs().argmax(1, keepdim=True))
        longest = torch.where(largest < 0, -longest, longest)  # its sign tells which half is the new piece
        along = torch.linalg.vecdot(points - means.index_select(0, labels), longest.index_select(0, labels))
        beyond = along > 0
        supported = _is_supported(along, labels, weight, n_pieces, least, rule.outlier_gap)
        cut = wanted & supported & (count >= 2 * least) & (deviation[:, -1] > 0)
        priority = count * (variances[:, -1] + _THICKNESS_PRIORITY * variances[:, 0].clamp_min(0))
        cut = _limit_splits(cut, priority, n_pieces, rule.max_components)
        n_new = int(cut.sum())
        if n_new == 0:
            break
        new_label = torch.cumsum(cut.long(), 0) - 1 + n_pieces
        labels = torch.where(cut[labels] & beyond, new_label[labels], labels)
        n_pieces += n_new
    return Partition(labels, n_pieces)


def _limit_splits(cut: Tensor, priority: Tensor, n_pieces: int, limit: int | None) -> Tensor:
    """The pieces of highest priority among those to halve, within the limit, and half of all once there
    are many.
    """
    if limit is None:
        return cut
    order = torch.where(cut, priority, -torch.inf).argsort(descending=True, stable=True)
    chosen = torch.zeros_like(cut)
    # While there are few pieces, the limit allows halving all of them.
    at_once = n_pieces if 4 * n_pieces <= limit else (n_pieces + 1) // 2
    chosen[order[: max(0, min(limit - n_pieces, at_once))]] = True
    return chosen & cut


def _is_supported(
    along: Tensor, labels: Tensor, weight: Tensor, n_pieces: int, least: Tensor, outlier_gap: float
) -> Tensor:
    """Whether a cut at 0 of the positions (N,) along each piece's axis leaves enough points, (n_pieces,).

    Both halves must weigh `least` (n_pieces,). A smaller half is also allowed if it is an outlier: farther
    than `outlier_gap` (m), and farther than six standard deviations of the larger half. Otherwise a few stray
    returns would prevent the partition of their whole piece.
    """
    side = labels * 2 + (along > 0)
    if not bool(least.any()):
        return torch.bincount(side, minlength=2 * n_pieces).view(n_pieces, 2).amin(1) > 0
    moments = torch.stack([torch.ones_like(along), along, along**2], 1) * weight[:, None]
    sums = moments.new_zeros(2 * n_pieces, 3).index_add_(0, side, moments).view(n_pieces, 2, 3)
    count = sums[..., 0]
    mean, square = (sums[..., i] / count.clamp_min(1e-300) for i in (1, 2))
    deviation = (square - mean**2).clamp_min(0).sqrt().gather(1, count.argmax(1, keepdim=True)).squeeze(1)
    gap = mean[:, 1] - mean[:, 0]
    is_outlier = (gap > outlier_gap) & (gap > 6 * deviation)
    return (count.amin(1) > 0) & ((count.amin(1) >= least) | is_outlier)


class Cells(NamedTuple):
    """features (C, F): mean feature of each cell; weight (C,): its points; member (N,): cell of each
    point.
    """

    features: Tensor
    weight: Tensor
    member: Tensor


def pool_into_cells(points: Tensor, max_cells: int, finest: float, weight: Tensor | None = None) -> Cells:
    """Sum centred points (N, D), float64, D ≤ 3, into at most `max_cells` cubic cells of one size.

    The cost of EM on cells depends on their number, not on that of the points (see `exact`).

    The cells have side `finest` (m; the sensor's noise is a good choice). If that gives too many cells,
    the side grows in steps of a third of an octave until the limit holds. At most `max_cells` points are
    not pooled. `weight` (N,): number of points that each row stands for, above zero; default one.
    """
    n = points.shape[0]
    if n <= max_cells:
        weight = points.new_ones(n) if weight is None else weight
        return Cells(quadratic_features(points), weight, torch.arange(n, device=points.device))
    low, high = points.aminmax(dim=0)
    if are_cell_moments_fused(points, weight, max_cells):
        return Cells(*cell_moments(points, weight, (low, high), finest, _MAX_CELLS_ALONG, max_cells))

    def pooled(thirds: int) -> tuple[Tensor, Tensor, Tensor] | None:
        """Cells of side · 2^(thirds/3); None if there are too many."""
        return _moments_by_key(points, weight, (low, high), finest, 2 ** (-thirds / 3), max_cells)

    found = pooled(0)
    if found is None:
        extent = float((high - low).max())
        side = max(extent / _MAX_CELLS_ALONG, finest)
        found = coarsest_allowed(pooled, 3 * math.ceil(math.log2(extent / side + 2)))[1]
    return Cells(*found)


def coarsest_allowed(pooled: Callable[[int], T | None], enough: int) -> tuple[int, T]:
    """The least step from 1 to `enough` that has a result, and the result, by bisection. Step 0 has none."""
    too_fine, best = 0, None
    while enough - too_fine > 1:
        middle = (too_fine + enough) // 2
        found = pooled(middle)
        if found is None:
            too_fine = middle
        else:
            enough, best = middle, found
    best = best or pooled(enough)
    assert best is not None
    return enough, best


def _moments_by_key(
    points: Tensor,
    weight: Tensor | None,
    box: tuple[Tensor, Tensor],
    finest: float,
    factor: float,
    max_cells: int,
) -> tuple[Tensor, Tensor, Tensor] | None:
    """The twin of `kernels.cell_moments`."""
    low, high = box
    side = ((high - low).max() / _MAX_CELLS_ALONG).clamp_min(finest)
    side = torch.where(side > 0, side, 1.0)  # equal points share one cell
    cells = ((points - low) / side * factor).long()
    key = cells[:, 0]
    for axis in range(1, cells.shape[1]):
        key = key << KEY_BITS | cells[:, axis]
    member, n_cells = dense_ranks(key)
    if n_cells > max_cells:
        return None
    weight = points.new_ones(len(points)) if weight is None else weight
    sums = points.new_zeros(n_cells, quadratic_features(points[:1]).shape[1])
    for part, cell, p in zip(*(t.split(_CHUNK_POINTS) for t in (points, member, weight)), strict=True):
        sums.index_add_(0, cell, quadratic_features(part) * p[:, None])
    return sums / sums[:, :1], sums[:, 0].clone(), member

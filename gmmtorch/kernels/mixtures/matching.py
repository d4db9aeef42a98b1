"""Mixtures registered with mixtures, scans aligned with components or laid over a raster, explained points.

The twin of `fused_registration` is in `localization.registration`, and that of `explained_points` in
`mapping.learning.novelty`.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gmmtorch.errors import MemoryLimitError
from gmmtorch.kernels.choice import is_fused
from gmmtorch.kernels.compiler import FusedKernel, Team, templated
from gmmtorch.kernels.evidence.point_evidence import Lists

_KEPT = 4  # motions of a result at most
_ROW = 32  # numbers of a component in the work space, and of a climb
_CLIMB = 256
_PARTS = 256  # of the components of the source on a GPU; each part has its own sums
_MOST_PAIRS = 1 << 26
_REGISTRATIONS = templated("mixtures/registration.h", "registration", (2, 3))


class Registered(NamedTuple):
    """The best motions of a registration (at most four), best first, on the CPU.

    transforms: (B, D+1, D+1), target ← source. hessians: (B, F, F) of the log score, F = D + D(D−1)/2.
    widths: of the peak in its loosest direction, metres. n_evaluated: evaluations of the score. radius: of
    the smaller mixture. own: Σ log ∫ f² of both.
    """

    transforms: Tensor
    log_scores: list[float]
    converged: list[bool]
    widths: list[float]
    hessians: Tensor
    n_evaluated: int
    radius: float
    own: float


def fused_registration(
    source: tuple[Tensor, Tensor, Tensor],
    target: tuple[Tensor, Tensor, Tensor],
    starts: tuple[Tensor, Tensor],
    by_area: bool,
    blurs: tuple[float | None, float | None],
    limits: tuple[float, int],
) -> Registered:
    """`localization.register` in one launch, which waits once; the twin is there.

    Args:
        source, target: weights (K,), means (K, D) and covariances (K, D, D).
        starts: rotations (B, D, D) and translations (B, D) in the world. by_area: the weights are not used.
        blurs: the coarsest and the finest. limits: tolerance and largest number of steps of a level.

    Raises `MemoryLimitError` for tens of millions of pairs.
    """
    device, (n_starts, dim) = starts[1].device, starts[1].shape
    free = dim + dim * (dim - 1) // 2
    sizes = len(source[0]), len(target[0])
    tables = [
        value for weights, means, covariances in (source, target)
        for order in (means[:, 0].argsort(),)
        for value in (weights[order], means[order], covariances[order])
    ]  # fmt: skip
    n_parts = 1 if device.type == "cpu" else _PARTS
    most = max(n_starts, _KEPT + 1)
    n_rows = max(most * sizes[0], sizes[1])
    capacity = min(n_rows * max(sizes), _MOST_PAIRS)
    space = starts[1].new_empty(
        _ROW * sum(sizes) + most * (1 + n_parts) * _CLIMB + n_rows * (dim + dim * dim)
    )
    whole = torch.empty(2 * sum(sizes) + n_rows, dtype=torch.int64, device=device)
    lists = torch.empty(capacity, dtype=torch.int32, device=device)
    parts = dim * dim + dim, (dim + 1) ** 2, 1, 1, 1, free * free  # of a motion, as the kernel states them
    width = sum(parts)
    found = starts[1].new_empty(_KEPT * width + 6)
    team = Team.of(device)
    coarsest, finest = (-1.0 if blur is None else blur for blur in blurs)
    _REGISTRATIONS[dim](
        team.n, *team, sizes[0], *tables[:3], sizes[1], *tables[3:], n_starts,
        *starts, by_area, coarsest, finest, *limits, n_parts, capacity,
        space, whole, lists, found,
    )  # fmt: skip
    found = found.cpu()
    n, n_evaluated, radius, *own, is_crowded = found[-6:].tolist()
    if is_crowded:
        raise MemoryLimitError(
            f"mixtures of {sizes[0]} and {sizes[1]} components have too many pairs within reach of each "
            "other; merge components first (gmmtorch.simplify)."
        )
    rows = found[: int(n) * width].view(int(n), width)
    _, world, score, converged, widths, hessian = rows.split(parts, 1)
    return Registered(
        world.unflatten(1, (dim + 1, dim + 1)), score[:, 0].tolist(), converged[:, 0].bool().tolist(),
        widths[:, 0].tolist(), hessian.unflatten(1, (free, free)), int(n_evaluated), radius, sum(own),
    )  # fmt: skip


_AT_ONCE = 256  # motions, whose scores the twin computes
_PARTS_OF_POINTS = 64  # of a motion on a GPU; each part has its own sums
_ALIGNMENTS = templated("mixtures/point_alignment.h", "alignment", (2, 3))
_SCORES = templated("mixtures/point_alignment.h", "point_scores", (2, 3))


class NearLists(NamedTuple):
    """Components near each cell of a lattice.

    low: (D,) corner of the lattice, metres. side: of a cell. shape: (D,) int64, cells along each axis.
    starts: (cells + 1,) int64, row-major, of each cell's part of the entries (E,), int32.
    """

    low: Tensor
    side: float
    shape: Tensor
    starts: Tensor
    entries: Tensor

    def cells(self, places: Tensor) -> Tensor:
        """The cells (M,) of places (M, D); −1 outside the lattice."""
        at = ((places - self.low) / self.side).floor()
        inside = ((at >= 0) & (at < self.shape)).all(1)
        cell = torch.zeros_like(at[:, 0], dtype=torch.int64)
        for axis, column in enumerate(torch.where(inside[:, None], at, 0.0).long().unbind(1)):
            cell = cell * self.shape[axis] + column
        return torch.where(inside, cell, -1)


_STRIPS = 16  # of the cells of each first coordinate on a GPU, which one worker fills
_BOXES = templated("mixtures/point_alignment.h", "box_lists", (2, 3))


def fused_box_lists(first: Tensor, last: Tensor, sizes: list[int], n_entries: int) -> Lists:
    """For each of the cells of a lattice of `sizes` (D), row-major, the boxes that hold it, in order.

    The boxes are `first` to `last` (K, D) with `n_entries` cells in all. The twin is in
    `localization.alignment`.
    """
    n_strips = 1 if first.device.type == "cpu" else _STRIPS
    totals = torch.empty(sizes[0] * n_strips, dtype=torch.int64, device=first.device)
    starts = torch.empty(math.prod(sizes) + 1, dtype=torch.int64, device=first.device)
    entries = torch.empty(n_entries, dtype=torch.int32, device=first.device)
    team, boxes = Team.of(first.device), (first, last, len(first))
    high = sizes[2] if len(sizes) == 3 else 1
    _BOXES[first.shape[1]](team.n, *team, *boxes, *sizes[:2], high, n_strips, totals, starts, entries)
    return Lists(starts, entries)


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


class AlignmentTable(NamedTuple):
    """K surfaces with which a scan is aligned.

    lists: of the components near each cell. means (K, D), precisions (K, D, D), and normals (K, D), zero for
    those that are seen from all sides. rows: `surface_rows` of these. behind: metres behind a component's
    face from which on the sensor does not see it. farthest: d² beyond which a component is left out.
    outliers: ε. explained: ε + q, above which a point counts as explained.
    """

    lists: NearLists
    means: Tensor
    precisions: Tensor
    normals: Tensor
    rows: Tensor
    behind: float
    farthest: float
    outliers: float
    explained: float


def surface_rows(means: Tensor, precisions: Tensor, normals: Tensor) -> Tensor:
    """A row for each surface, as the kernels read it: its mean, its normal, the upper triangle of its
    precision, and zeros up to a whole number of quadruples."""
    upper = torch.triu_indices(*precisions.shape[1:], device=means.device)
    rows = torch.cat([means, normals, precisions[:, upper[0], upper[1]]], 1)
    return torch.nn.functional.pad(rows, (0, -rows.shape[1] % 4))


def alignment_sums(points: Tensor, motions: tuple[Tensor, Tensor], table: AlignmentTable) -> AlignmentSums:
    """The sums over points (N, D), float64, under motions, rotations (B, D, D) and translations (B, D)."""
    if is_fused(points, *motions, table.means):
        return fused_alignment(points, motions, table, 0.0, 0)[1]
    return _batched_alignment(points, motions, table)


def fused_alignment(
    points: Tensor, motions: tuple[Tensor, Tensor], table: AlignmentTable, settled: float, max_steps: int
) -> tuple[tuple[Tensor, Tensor], AlignmentSums, Tensor]:
    """`localization.alignment.align` in one launch: the motions after at most `max_steps` steps, their sums,
    and whether the last step moved all points by less than `settled` (m). The twin is there.
    """
    n, dim = motions[1].shape
    free = dim + dim * (dim - 1) // 2
    parts = dim * dim, dim, 1, 1, free, free * free, free * free, 1  # of a result, as the kernel states them
    n_sums = 2 + free * (free + 2)
    width = sum(parts) + dim * dim + dim + n_sums + 2
    n_parts = 1 if points.device.type == "cpu" else _PARTS_OF_POINTS
    space = points.new_empty(n * (width + n_parts * n_sums))
    team = Team.of(points.device)
    _ALIGNMENTS[dim](
        team.n, *team, points, len(points), n_parts, n, *motions, *table.lists, *table[4:],
        settled, max_steps, space,
    )  # fmt: skip
    rows = space[: n * width].view(n, width)[:, : sum(parts)]
    turn, shift, score, n_explained, gradient, *information, is_settled = rows.split(parts, 1)
    matrices = (matrix.unflatten(1, (free, free)) for matrix in information)
    sums = AlignmentSums(score[:, 0], n_explained[:, 0], gradient, *matrices)
    return (turn.unflatten(1, (dim, dim)), shift), sums, is_settled[:, 0] > 0


def alignment_scores(points: Tensor, motions: tuple[Tensor, Tensor], table: AlignmentTable) -> Tensor:
    """The scores (B,) of `alignment_sums`, of many motions."""
    n, dim = motions[1].shape
    if not is_fused(points, *motions, table.means):
        rows = torch.arange(n, device=points.device).split(_AT_ONCE)
        parts = [tuple(part[some] for part in motions) for some in rows]
        return torch.cat([_batched_alignment(points, (turn, shift), table).score for turn, shift in parts])
    scores = points.new_empty(n)
    _SCORES[dim](n, points, len(points), *motions, *table.lists, *table[4:], scores)
    return scores


_RASTER = FusedKernel("mixtures/point_alignment.h", "raster_sums")
_NO_PRIOR = None, None, 0, *[0.0] * 8


class Prior(NamedTuple):
    """Where a scan is expected, for `fused_bounds`.

    places: (B, 2), the last one that of the shift zero; metres. turned: (H, B), rad, from their headings to
    those of the scan. distance, angle: standard deviations. share: of the sum. cell: metres. max_step,
    max_turn: to the nearest place, at most, or `never` is subtracted.
    tail: see `localization.pose_search.Expectation.against`.
    """

    places: Tensor
    turned: Tensor
    n_places: int
    share: float
    cell: float
    distance: float
    angle: float
    max_step: float
    max_turn: float
    tail: float
    never: float


def raster_sums(cells: Tensor, heading: Tensor, shift: Tensor, raster: Tensor, outside: float) -> Tensor:
    """Sums (C,), float64, of a raster's values at the cells of a scan under C placements.

    Args:
        cells: (H, N, 2) int64, of N points under each of H headings. heading: (C,) int64, in rising order,
            and shift: (C, 2) int64, of each placement, in steps of W cells, a power of two. raster:
            (W, W, nx, ny) float32, of which [x, y, i, j] is the value of the cell (W i + x, W j + y).
            outside: value of cells outside it.
    """
    if is_fused(cells, heading, shift, raster):
        return fused_bounds(cells, heading, shift, raster, outside, _NO_PRIOR)
    width = raster.shape[0]
    at, part = cells[heading].div(width, rounding_mode="floor") + shift[:, None], cells[heading] % width
    size = torch.tensor(raster.shape[2:], device=at.device)
    is_inside = ((at >= 0) & (at < size)).all(2)
    x, y = at.clamp_min(0).minimum(size - 1).unbind(2)
    return torch.where(is_inside, raster[part[:, :, 0], part[:, :, 1], x, y].double(), outside).sum(1)


def fused_bounds(
    cells: Tensor,
    heading: Tensor,
    shift: Tensor,
    raster: Tensor,
    outside: float,
    prior: Prior | tuple[Any, ...],
) -> Tensor:
    """`raster_sums` less the nats against placements by a prior. `localization.pose_search` has the twin."""
    sums = torch.empty(len(heading), dtype=torch.float64, device=cells.device)
    n_headings, n_points, _ = cells.shape
    level = len(raster).bit_length() - 1
    first = torch.searchsorted(heading, torch.arange(n_headings + 1, device=cells.device))
    _RASTER(
        n_headings, cells, n_points, first, shift, raster, level, *raster.shape[2:], outside, *prior, sums
    )
    return sums


def _batched_alignment(
    points: Tensor, motions: tuple[Tensor, Tensor], table: AlignmentTable
) -> AlignmentSums:
    """The twin."""
    rotations, translations = motions
    lists, means, precisions, normals, _, behind, farthest, outliers, explained = table
    n, (count, dim) = len(translations), points.shape
    lever = (points @ rotations.mT).flatten(0, 1)
    moved = lever + translations.repeat_interleave(count, 0)
    cell = lists.cells(moved)
    known = (cell >= 0).nonzero()[:, 0]
    place, component = Lists(lists.starts, lists.entries).taken(cell[known])
    row = known[place]
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
        (total > explained).to(lever).view(n, count).sum(1),
        *(terms.unflatten(0, (n, count)).sum(1) for terms in (gradient, complete, observed)),
    )


def _arms(lever: Tensor) -> Tensor:
    """G_k x (M, D, D(D−1)/2) of points x (M, D): their motion in a turn of one radian about each axis."""
    if lever.shape[1] == 2:
        return torch.stack([-lever[:, 1], lever[:, 0]], 1)[:, :, None]
    x, y, z = lever.unbind(1)
    zero = torch.zeros_like(x)
    columns = [torch.stack(column, 1) for column in ((zero, -z, y), (z, zero, -x), (-y, x, zero))]
    return torch.stack(columns, 2)


_EXPLAINED = templated("mixtures/explained_points.h", "explained_points", (2, 3), shares=True)


def explained_points(
    points: Tensor,
    means: Tensor,
    whitening: Tensor,
    limit: float,
    least: float,
    near: Tensor,
    frees: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """Sums (K,) of the shares of K components in the points (N, D) that they explain, and whether any
    component explains each point, (N,) bool.

    A component explains a point if its squared Mahalanobis distance d is below `limit`. The components that
    explain a point share it in proportion to 1/max(d, least).

    Args:
        means: (K, D), whitening: (K, D, D), lower triangular, float64; see `occupancy.cones.whitening`.
        near: (K,) bool, frees: (N,) bool: components that are not near explain no point that frees space.
            frees=None: no point does.
    """
    k, dim = means.shape
    table = torch.cat([means.T, whitening.flatten(1).T])
    gained = torch.zeros(k, dtype=torch.float64, device=points.device)
    found = torch.empty(len(points), dtype=torch.bool, device=points.device)
    given = points.double(), frees, table, k, near, limit, least
    _EXPLAINED[dim](len(points), *given, gained, found)
    return gained, found

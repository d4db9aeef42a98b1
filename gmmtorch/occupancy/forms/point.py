"""Point form: evidence of the cube around a point in closed form, without a grid and without samples.

KeptEvidence keeps the evidence of the cells of a grid from one state of a map to the next. Queries along rays
tell where a beam ends, given the occupancy of the cells on its way.
"""

from __future__ import annotations

import copy
import functools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike, as_tensor
from gmmtorch.errors import InvalidArgumentError, MemoryLimitError
from gmmtorch.kernels import (
    GROUP,
    PointTable,
    chunked,
    glances,
    grouped_evidence,
    is_fused,
    listed_evidence,
    pair_evidence,
)
from gmmtorch.linalg import order_along_curve, safe_cholesky
from gmmtorch.occupancy.cone_index import ConeIndex, chunks_of, replaced_rows, spectrum_of
from gmmtorch.occupancy.cones import CUTOFF, Cones, former_rows
from gmmtorch.occupancy.evidence import occupancy_probability
from gmmtorch.occupancy.grid import MEMORY_LIMIT, VoxelGrid, check_resolution
from gmmtorch.occupancy.protocol import check_queries


class PointBlocks(NamedTuple):
    """Points sorted by position, in b blocks of B points; all points of a block lie in one bucket.

    points (D, B, b); bucket (b,); centers (b, D) and radius (b,): a ball around the points of each block.
    slot (n,): the places of the given points among the b·B slots. Free slots of a block repeat its last
    point.
    """

    points: Tensor
    bucket: Tensor
    centers: Tensor
    radius: Tensor
    slot: Tensor

    @classmethod
    def of(cls, points: Tensor, bucket: Tensor) -> PointBlocks:
        """Blocks of points (n, D), at least one, in rising buckets (n,)."""
        touched, count = torch.unique_consecutive(bucket, return_counts=True)
        (n_points, dim), n_touched = points.shape, touched.shape[0]
        size = 16 if n_points > 24 * n_touched else 4 if n_points > 4 * n_touched else 1
        n_blocks = (count + size - 1) // size
        first, begin = torch.cumsum(count, 0) - count, (torch.cumsum(n_blocks, 0) - n_blocks) * size
        number = torch.arange(n_points, device=points.device)
        slot = number + torch.repeat_interleave(begin - first, count)
        filled = torch.zeros(int(n_blocks.sum()) * size, dtype=torch.int64, device=points.device)
        filled[slot] = number
        filled = filled.cummax(0).values
        gathered = points[filled].view(-1, size, dim)
        fixed = gathered.detach()
        centers = 0.5 * (fixed.amin(1) + fixed.amax(1))
        radius = (fixed - centers[:, None]).norm(dim=2).amax(1)
        owner = torch.repeat_interleave(touched, n_blocks)
        return cls(gathered.permute(2, 1, 0).contiguous(), owner, centers, radius, slot)


CHUNK_PAIRS = 1 << 16
"""Pairs of a point and a cone evaluated in one pass. It bounds the memory and does not change the result."""

_CHUNK_POINTS = 1 << 20  # points sorted in one pass
_FARTHEST = 1e15  # metres: products of larger positions are infinite
_FEW_POINTS = 1 << 11
_FEW_PAIRS = 1 << 23  # of a point and a cone: for at most so many an index does not pay


class PointGroups:
    """Points (M, D), float64. Few need no index: cones are found for groups of `GROUP` neighbours.

    order (R,): the points that are not too far away, group by group. box: low, high (G, D) of each group.
    """

    def __init__(self, points: Tensor) -> None:
        self.points, self.are_few = points, len(points) <= _FEW_POINTS

    @functools.cached_property
    def order(self) -> Tensor:
        order = (self.points.abs() <= _FARTHEST).all(1).nonzero().squeeze(1)
        return order[order_along_curve(self.points[order])] if len(order) else order

    @functools.cached_property
    def box(self) -> tuple[Tensor, Tensor]:
        missing = -len(self.order) % GROUP
        order = torch.cat([self.order, self.order[-1:].expand(missing)]) if missing else self.order
        grouped = self.points.detach()[order].view(-1, GROUP, self.points.shape[1])
        return grouped.amin(1), grouped.amax(1)


class PointEvidence(NamedTuple):
    """hits (M,), misses (M,): expected rays that end in the cube at each point, and that pass through it."""

    hits: Tensor
    misses: Tensor


def point_evidence(
    cones: Cones, points: ArrayLike, resolution: float, cutoff: float = CUTOFF
) -> PointEvidence:
    """Evidence of the cube of side `resolution` (m) centred at each point (M, D), world metres.

    For several calls with the same cones use a `PointForm`.
    """
    return PointForm(cones, resolution, cutoff)(points)


def few_point_evidence(
    cones: Cones, axes: Tensor, points: Tensor, resolutions: Sequence[float], cutoff: float
) -> Tensor:
    """Hits and misses (S, 2, M) of a few points (M, D), float64, from all cones; for cubes of S sides (m).

    The twin of `kernels.few_points_evidence`. axes: (C, D, D), see `spectrum_of`.
    """
    blocks, every = points.T[:, :, None], torch.arange(len(axes), device=axes.device)
    each = [
        pair_evidence(blocks, torch.zeros_like(every), *_table_of(cones, axes, side), every, side, cutoff)
        for side in resolutions
    ]
    return torch.stack([torch.stack([values.sum(1) for values in pairs]) for pairs in each])


class PointForm:
    """The point form of evidence of fixed cones, for cubes of one side h; float64, closed form.

    A component N(μ, Σ) with count N, seen from s, gives to the cube at x, with u = x − s:

        hits = N h^D N(x | μ, Σ + h²/12 I)
        misses = N h^{D−1} (Σ_i |u_i|/|u|) |u| ∫_τ^∞ t^{D−1} N(s + tu | μ, Σ + κI) dt

    h²/12 I is the covariance of the cube, and κ = (h²/12) |μ − s|²/|u|² is the same spread projected from the
    sensor origin to the component. Both average a cone that is narrower than the cube over the cube. The
    area of the cube perpendicular to the ray is h^{D−1} Σ|u_i|/|u|, and its mean chord is h |u|/Σ|u_i|. τ
    lies half a chord beyond x: a ray that passes ends beyond the cube, not in its second half.

    A cone gives at most N rays: hits ≤ N and misses ≤ N − hits. A cube that contains the sensor origin gets
    exactly N − hits misses, because every ray starts there. Both fade to zero over the last unit of the
    squared Mahalanobis distance before `cutoff`, and are exactly zero beyond it.

    Gradients flow to the points, and to the means, covariances, origins and counts of the cones.

    Args:
        cones: must not change afterwards.
        resolution: h (m).
        cutoff: Mahalanobis distance beyond which a component gives no evidence.
        share: see `ConeIndex`.
        axes: (C, D, D), see `spectrum_of`; None: computed for each cone.
    """

    def __init__(
        self,
        cones: Cones,
        resolution: float,
        cutoff: float = CUTOFF,
        share: float = 1.0,
        axes: Tensor | None = None,
    ) -> None:
        self.resolution = check_resolution(resolution)
        cones = cones.checked()
        if not 0 < cutoff < math.inf:
            raise InvalidArgumentError(f"cutoff={cutoff} must be finite and above zero.")
        self.dim, self.cutoff = cones.dim, float(cutoff)
        safe_cholesky(cones.covariances.double().detach())  # raises if one is not positive definite
        axes = spectrum_of(cones.covariances)[1] if axes is None else axes
        self._share = share
        self._set(_table_of(cones, axes, self.resolution))

    def _set(self, table: PointTable) -> None:
        self._table = table
        self._index: ConeIndex | Callable[[], ConeIndex] = self._new_index
        self._glanced: Tensor | None = None  # of the fused kernel, once it is needed

    def _new_index(self) -> ConeIndex:
        return ConeIndex(self.rows, self.resolution, self.cutoff, smoothed=True, share=self._share)

    @property
    def index(self) -> ConeIndex:
        """Lists the cones near a point. Made when it is needed first."""
        if not isinstance(self._index, ConeIndex):
            self._index = self._index()
        return self._index

    @property
    def rows(self) -> Tensor:
        """(C, n) what the evidence depends on, a row for each cone. Equal rows give equal evidence."""
        return self._table.rows

    def replaced(self, cones: Cones, former: Tensor) -> PointForm:
        """The form of other cones, which keeps what it can; arguments as for `ConeIndex.replaced`."""
        made, is_new, cones = copy.copy(self), former < 0, cones.checked()
        new = cones.taken(is_new)
        safe_cholesky(new.covariances.double().detach())
        table = _table_of(new, spectrum_of(new.covariances)[1], self.resolution)
        pairs = zip(self._table, table, strict=True)
        made._set(PointTable(*(replaced_rows(rows, former, rest) for rows, rest in pairs)))
        if isinstance(self._index, ConeIndex):
            made._index = functools.partial(self._index.replaced, made.rows, former)
        return made

    def extended(self, other: PointForm) -> PointForm:
        """The form of these cones and, after them, those of another one, for cubes of the same side."""
        made, n = copy.copy(self), len(self.rows)
        made._set(PointTable(*map(torch.cat, zip(self._table, other._table, strict=True))))
        if isinstance(self._index, ConeIndex):
            number = torch.arange(len(made.rows), device=made.rows.device)
            former = torch.where(number < n, number, -1)
            made._index = functools.partial(self._index.replaced, made.rows, former)
        return made

    def __call__(self, points: ArrayLike | PointGroups, before: PointEvidence | None = None) -> PointEvidence:
        """Hits and misses at points (M, D), world metres; zero at infinite points. `before`: of other cones,
        to which these are added, in its memory if possible.

        Raises `InvalidArgumentError` for another shape, or NaN.
        """
        given = points if isinstance(points, PointGroups) else PointGroups(check_queries(points, self.dim))
        query = given.points
        before = before or PointEvidence(*torch.zeros(2, len(query), dtype=query.dtype, device=query.device))
        if given.are_few and is_fused(query, self.rows):
            return self._added(given, before)

        def evaluated(part: slice) -> PointEvidence:
            points, hits, misses = query[part], before.hits[part], before.misses[part]
            if is_fused(points, self.rows):
                return self._added(PointGroups(points), PointEvidence(hits, misses))
            for rows, blocks, chunks in self._blocks(points):
                evidence = torch.cat([self._of_blocks(blocks, chunk) for chunk in chunks], 1)
                hit, miss = evidence.flatten(1)[:, blocks.slot]
                hits, misses = hits.index_add(0, rows, hit), misses.index_add(0, rows, miss)
            return PointEvidence(hits, misses)

        parts = list(chunked(len(query), _CHUNK_POINTS, evaluated)) or [before]
        hits, misses = parts[0] if len(parts) == 1 else map(torch.cat, zip(*parts, strict=True))
        return PointEvidence(hits, misses)

    def _blocks(self, points: Tensor) -> Iterator[tuple[Tensor, PointBlocks, Iterator[slice]]]:
        """Rows (R,) of points near cones, their blocks, and chunks of the blocks."""
        for rows, number in self.index.parts(points):
            if len(rows):
                blocks = PointBlocks.of(points[rows], number[rows])
                yield rows, blocks, chunks_of(self.index.lists.lengths()[blocks.bucket], CHUNK_PAIRS)

    def _added(self, points: PointGroups, found: PointEvidence) -> PointEvidence:
        """`found`, to which hits and misses at M points are added by the fused kernel."""
        every = points.points
        if self._glanced is None:
            self._glanced = glances(self.rows, self.dim, self.resolution, self.cutoff)
        settings = self.rows, self._glanced, self.resolution, self.cutoff, found
        if len(every) * len(self.rows) > _FEW_PAIRS:
            for rows, number in self.index.parts(every):
                listed_evidence(every, rows, number, self.index.lists, *settings)
        elif len(self.rows) and len(points.order):
            grouped_evidence(every, points.order, points.box, *settings)
        return found

    def _near_cones(self, blocks: PointBlocks, part: slice) -> tuple[Tensor, Tensor]:
        """Pairs of a block (R,), counted from the start of `part`, and a cone (R,) near it."""
        bucket, index = blocks.bucket[part], self.index
        found = index.hulls.near(index.lists, bucket, blocks.centers[part], blocks.radius[part])
        return found.taken(torch.arange(len(bucket), device=bucket.device))

    def _of_blocks(self, blocks: PointBlocks, part: slice) -> Tensor:
        """Hits and misses (2, b, B) of the blocks in `part`."""
        block, cone = self._near_cones(blocks, part)
        points = blocks.points[..., part]
        hits = points.new_zeros(points.shape[2], points.shape[1])
        misses = hits.clone()
        n_rows = max(1, CHUNK_PAIRS // points.shape[1])
        for rows, cones in zip(block.split(n_rows), cone.split(n_rows), strict=True):
            hit, miss = pair_evidence(points, rows, *self._table, cones, self.resolution, self.cutoff)
            hits, misses = hits.index_add(0, rows, hit.T), misses.index_add(0, rows, miss.T)
        return torch.stack([hits, misses])

    def visited(self, points: Tensor) -> float:
        """Average number of cones evaluated for each of the points (M, D)."""
        query = check_queries(points, self.dim)
        n_rows = 0
        for _, blocks, chunks in self._blocks(query):
            n_pairs = sum(len(self._near_cones(blocks, part)[0]) for part in chunks)
            n_rows += n_pairs * blocks.points.shape[1]
        return n_rows / query.shape[0]


def _table_of(cones: Cones, axes: Tensor, resolution: float) -> PointTable:
    """The table of cones with the axes V (C, D, D), for cubes of side `resolution` (m).

    V has no gradient where variances are equal. It is held constant, which is exact to first order in Σ.
    """
    dim, covariances = cones.dim, cones.covariances.double()
    turned = axes.transpose(1, 2) @ covariances @ axes
    variances = turned.diagonal(dim1=1, dim2=2)
    variances = variances.clamp_min(1e-12 * float(resolution) ** 2)
    means, origins, counts = cones.means.double(), cones.origins.double(), cones.counts.double()
    toward = means - origins
    seen = (axes.transpose(1, 2) @ toward[:, :, None]).squeeze(2)
    spread = resolution**2 / 12
    log_scale = -0.5 * (2 * math.pi * (variances + spread)).log().sum(1) + dim * math.log(resolution)
    rows = [axes.flatten(1), means, origins, seen, variances, 1 / (variances + spread)]
    last = spread * (toward * toward).sum(1), log_scale, counts, counts * ~cones.max_range
    rows += [column[:, None] for column in last]
    above = torch.triu_indices(dim, dim, 1, device=covariances.device)
    tilts = turned[:, above[0], above[1]] if covariances.requires_grad else turned.new_zeros(len(means), 0)
    return PointTable(torch.cat(rows, 1), tilts)


class KeptEvidence:
    """Evidence of the cells of a grid in the point form, for a map whose cones change.

    `update` evaluates the cells near cones that are new or gone since the last call, and the cells that the
    last grid did not have. With fused kernels its numbers are, to the bit, those of a `PointForm` of all
    cones at `centers`; the twins of the kernels differ by rounding.

    Args:
        resolution: side (m) of the cells, which lie at its multiples.
    """

    def __init__(self, resolution: float) -> None:
        self.resolution = check_resolution(resolution)
        self._form: PointForm | None = None
        self._cones: Cones
        self._first: Tensor
        self._hits: Tensor
        self._misses: Tensor
        self.n_evaluated = 0
        """Cells that the last call evaluated."""

    def update(self, cones: Cones, grid: VoxelGrid, cutoff: float = CUTOFF) -> PointEvidence:
        """Hits and misses, in the shape of the grid.

        Args:
            cones: all cones of the map now; must not change afterwards.
            grid: cells at multiples of the resolution.
            cutoff: Mahalanobis distance beyond which a component gives no evidence.
        """
        cones = cones.checked()
        form, changed = self._next_form(cones, cutoff)
        first = self._first_cell(grid, cones.means.device)
        points = self.centers(grid, cones.means.device)
        hits, misses = torch.zeros(2, *grid.shape, dtype=torch.float64, device=points.device)
        is_asked = torch.ones(grid.shape, dtype=torch.bool, device=points.device)
        if self._form is not None:
            new, old = _overlap(first, grid.shape, self._first, self._hits.shape)
            hits[new], misses[new], is_asked[new] = self._hits[old], self._misses[old], False
            index = ConeIndex(changed, self.resolution, cutoff, smoothed=True, smallest=True)
            is_asked |= (index.buckets(points) >= 0).view(grid.shape)
        asked = is_asked.flatten().nonzero().squeeze(1)
        found = form(points[asked])
        for values, new_values in zip((hits, misses), found, strict=True):
            values.view(-1)[asked] = new_values
        self.n_evaluated = len(asked)
        self._form, self._cones = form, cones
        self._first, self._hits, self._misses = first, hits, misses
        return PointEvidence(hits, misses)

    def centers(self, grid: VoxelGrid, device: torch.device | None = None) -> Tensor:
        """Centres (M, D) of the cells of a grid: the same for a cell of any grid, to the bit."""
        flat = torch.arange(grid.n_cells, device=device)
        cell = torch.stack(torch.unravel_index(flat, grid.shape), 1) + self._first_cell(grid, device)
        return (cell.double() + 0.5) * self.resolution

    def _first_cell(self, grid: VoxelGrid, device: torch.device | None) -> Tensor:
        """The lowest cell (D,) of a grid, counted from the origin of the world."""
        units = torch.tensor(grid.origin, dtype=torch.float64, device=device) / self.resolution
        first = units.round()
        if grid.resolution != self.resolution or bool(((units - first).abs() > 1e-6).any()):
            raise InvalidArgumentError(
                f"grid={grid} must have cells at multiples of resolution={self.resolution} m; make it with "
                "VoxelGrid.covering."
            )
        return first.long()

    def _next_form(self, cones: Cones, cutoff: float) -> tuple[PointForm, Cones]:
        """The form of the cones, and those that are new or gone."""
        if self._form is None or self._form.cutoff != cutoff or self._cones.dim != cones.dim:
            self._form = None
            return PointForm(cones, self.resolution, cutoff), cones
        former = former_rows(self._cones, cones)
        gone = torch.ones_like(self._cones.max_range)
        gone[former[former >= 0]] = False
        parts = zip(self._cones.taken(gone), cones.taken(former < 0), strict=True)
        return self._form.replaced(cones, former), Cones(*map(torch.cat, parts))


def _overlap(
    first: Tensor, shape: tuple[int, ...], other_first: Tensor, other_shape: tuple[int, ...]
) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    """The cells that two grids share, as slices of each, from the lowest cells and shapes of both."""
    shift = (other_first - first).tolist()
    mine, others = [], []
    for offset, size, other_size in zip(shift, shape, other_shape, strict=True):
        low, high = max(offset, 0), max(min(offset + other_size, size), max(offset, 0))
        mine.append(slice(low, high))
        others.append(slice(low - offset, high - offset))
    return tuple(mine), tuple(others)


_CHUNK_CELLS = 1 << 18


class RayHits(NamedTuple):
    """Where R beams end: probability (R, S) of ending in each cell, and no_hit (R,) of ending in none.

    depth (S,): distance (m) of the cell centres from the sensor origin. A row and its no_hit sum to 1.
    """

    depth: Tensor
    probability: Tensor
    no_hit: Tensor


class ExpectedRange(NamedTuple):
    """Expected range `mean` (R,) in metres, counting no hit as `max_range`; no_hit (R,): its probability."""

    mean: Tensor
    no_hit: Tensor


def first_hit(occupancy: Tensor) -> tuple[Tensor, Tensor]:
    """o_i Π_{j<i} (1 − o_j), (…, S), for cells in the order along a beam, and Π_j (1 − o_j), (…)."""
    passed = torch.cumprod(1 - occupancy, -1)
    reached = torch.cat([torch.ones_like(passed[..., :1]), passed[..., :-1]], -1)
    return occupancy * reached, passed[..., -1]


def hit_probability(
    cones: Cones | PointForm,
    origins: ArrayLike,
    directions: ArrayLike,
    max_range: float,
    resolution: float,
    prior: float = 1.0,
) -> RayHits:
    """Probability that a beam ends in each cell on its way.

    Cells are cubes of side h = `resolution` with centres on the beam at (i + ½)h, up to `max_range`. Their
    occupancy comes from the point form.

    Args:
        cones: the cones, or for several calls a `PointForm` of them at this resolution.
        origins: (R, D) sensor origins, world metres.
        directions: (R, D), of any length above zero.
        max_range: range of the sensor (m).
        resolution: h (m).
        prior: N_p of thesis (3.9).

    Raises:
        InvalidArgumentError: shapes that do not match, values that are not finite, a direction of length
            zero, a range that is not above zero, or a form made for another resolution.
        MemoryLimitError: R·S cells exceed the memory limit.
    """
    depth, occupancies = _along(cones, origins, directions, max_range, resolution, prior)
    if len(origins) * depth.shape[0] * 8 > MEMORY_LIMIT:
        raise MemoryLimitError(
            f"{len(origins):,} rays of {depth.shape[0]:,} cells take more than {MEMORY_LIMIT:,} bytes; "
            "pass fewer rays per call, or use expected_range, which does not store the cells."
        )
    probability, no_hit = zip(*map(first_hit, occupancies), strict=True)
    return RayHits(depth, torch.cat(probability), torch.cat(no_hit))


def expected_range(
    cones: Cones | PointForm,
    origins: ArrayLike,
    directions: ArrayLike,
    max_range: float,
    resolution: float,
    prior: float = 1.0,
) -> ExpectedRange:
    """Expected range of a beam, Σ p_i d_i + p_none · max_range; arguments as for `hit_probability`."""
    depth, occupancies = _along(cones, origins, directions, max_range, resolution, prior)
    reported = depth.clamp_max(max_range)  # the last cell can extend beyond the range
    means, none = [], []
    for occupancy in occupancies:
        probability, no_hit = first_hit(occupancy)
        means.append(probability @ reported + no_hit * max_range)
        none.append(no_hit)
    return ExpectedRange(torch.cat(means), torch.cat(none))


def _along(
    cones: Cones | PointForm,
    origins: ArrayLike,
    directions: ArrayLike,
    max_range: float,
    resolution: float,
    prior: float,
) -> tuple[Tensor, Iterator[Tensor]]:
    """Distance (S,) of the cell centres along a beam (m), and the occupancy (r, S) of chunks of r rays.

    Raises the errors of `hit_probability`.
    """
    form = cones if isinstance(cones, PointForm) else PointForm(cones, resolution)
    if form.resolution != resolution:
        raise InvalidArgumentError(
            f"resolution={resolution} m differs from that of the PointForm, {form.resolution} m; "
            "make a form for this resolution."
        )
    if not 0 < max_range < math.inf:
        raise InvalidArgumentError(f"max_range={max_range} must be metres above zero.")
    n_cells = math.ceil(max_range / form.resolution * (1 - 1e-12))
    if n_cells * 8 > MEMORY_LIMIT // 16:
        raise MemoryLimitError(
            f"max_range={max_range} m at resolution={form.resolution} m is {n_cells:,} cells a ray; "
            "take a larger resolution."
        )
    start = as_tensor(origins, "origins", torch.float64)
    direction = as_tensor(directions, "directions", torch.float64)
    if start.shape != direction.shape or start.ndim != 2 or start.shape[1] != form.dim:
        raise InvalidArgumentError(
            f"origins {tuple(start.shape)} and directions {tuple(direction.shape)} must both be "
            f"(R, {form.dim})."
        )
    for name, value in (("origins", start), ("directions", direction)):
        if not bool(torch.isfinite(value).all()):
            raise InvalidArgumentError(
                f"{name} contains NaN or infinite values; remove such rays before the query."
            )
    length = direction.norm(dim=1, keepdim=True)
    if bool((length == 0).any()):
        raise InvalidArgumentError("directions contains a vector of length zero; give each ray a direction.")
    steps = torch.arange(n_cells, dtype=torch.float64, device=start.device)
    depth = (steps + 0.5) * form.resolution

    def occupancies() -> Iterator[Tensor]:
        n_rays = max(1, _CHUNK_CELLS // n_cells)
        for begin, toward in zip(start.split(n_rays), (direction / length).split(n_rays), strict=True):
            points = begin[:, None] + toward[:, None] * depth[:, None]
            yield occupancy_probability(*form(points.flatten(0, 1)), prior).view(points.shape[:2])

    return depth, occupancies()

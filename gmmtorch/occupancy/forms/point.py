"""Point form: evidence of the cube around a point in closed form, without a grid and without samples."""

from __future__ import annotations

import copy
import functools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.kernels import (
    Lists,
    PointTable,
    chunked,
    is_fused,
    listed_evidence,
    pair_evidence,
)
from gmmtorch.linalg import safe_cholesky
from gmmtorch.occupancy.cone_index import ConeIndex, chunks_of, replaced_rows, spectrum_of
from gmmtorch.occupancy.cones import CUTOFF, Cones
from gmmtorch.occupancy.grid import check_resolution
from gmmtorch.occupancy.protocol import check_queries


class PointBlocks(NamedTuple):
    """Points sorted by position, in b blocks of B points; all points of a block lie in one bucket.

    points (D, B, b); bucket (b,); centers (b, D) and radius (b,): a ball around the points of each block.
    point (n,) and slot (n,): indices of the given points, and their places among the b·B slots. Free slots
    of a block repeat its last point.
    """

    points: Tensor
    bucket: Tensor
    centers: Tensor
    radius: Tensor
    point: Tensor
    slot: Tensor

    @classmethod
    def of(cls, points: Tensor, bucket: Tensor, index: ConeIndex) -> PointBlocks:
        """Blocks of points (M, D), at least one, in buckets (M,)."""
        point = index.in_space_order(points, bucket)
        touched, count = torch.unique_consecutive(bucket[point], return_counts=True)
        n_points, n_touched = point.shape[0], touched.shape[0]
        size = 16 if n_points > 24 * n_touched else 4 if n_points > 4 * n_touched else 1
        n_blocks = (count + size - 1) // size
        first, begin = torch.cumsum(count, 0) - count, (torch.cumsum(n_blocks, 0) - n_blocks) * size
        number = torch.arange(n_points, device=point.device)
        slot = number + torch.repeat_interleave(begin - first, count)
        filled = torch.zeros(int(n_blocks.sum()) * size, dtype=torch.int64, device=point.device)
        filled[slot] = number
        filled = filled.cummax(0).values
        gathered = points[point][filled].view(-1, size, index.dim)
        fixed = gathered.detach()
        centers = 0.5 * (fixed.amin(1) + fixed.amax(1))
        radius = (fixed - centers[:, None]).norm(dim=2).amax(1)
        owner = torch.repeat_interleave(touched, n_blocks)
        return cls(gathered.permute(2, 1, 0).contiguous(), owner, centers, radius, point, slot)


CHUNK_PAIRS = 1 << 16
"""Pairs of a point and a cone evaluated in one pass. It bounds the memory and does not change the result."""

_CHUNK_POINTS = 1 << 20  # points sorted in one pass
_FARTHEST = 1e15  # metres: products of larger positions are infinite
_FEW_PAIRS = 1 << 19  # of a point and a cone: for at most so many an index does not pay


class PointEvidence(NamedTuple):
    """hits (M,), misses (M,): expected rays that end in the cube at each point, and that pass through it."""

    hits: Tensor
    misses: Tensor


def point_evidence(
    cones: Cones,
    points: ArrayLike,
    resolution: float,
    cutoff: float = CUTOFF,
) -> PointEvidence:
    """Evidence of the cube of side `resolution` (m) centred at each point (M, D), world metres.

    For several calls with the same cones use a `PointForm`.
    """
    return PointForm(cones, resolution, cutoff)(points)


def listed_points(
    cones: Cones,
    axes: Tensor,
    points: Tensor,
    lists: tuple[Tensor, Tensor],
    resolutions: Sequence[float],
    cutoff: float,
) -> list[PointEvidence]:
    """Evidence (M,) of a few points (M, D), float64, each from the cones listed for it; for cubes of several
    sides (m). Needs no index.

    axes: (C, D, D), see `spectrum_of`. lists: point (P,) and cone (P,) of each entry; points ascend.
    """
    point, cone = lists
    tables = [_table_of(cones, axes, side) for side in resolutions]
    if not is_fused(points, axes):
        blocks, zeros = points.T[:, None].contiguous(), torch.zeros_like(points[:, 0])
        each = [
            pair_evidence(blocks, point, *table, cone, side, cutoff)
            for table, side in zip(tables, resolutions, strict=True)
        ]
        return [PointEvidence(*(zeros.index_add(0, point, v[0]) for v in pairs)) for pairs in each]
    order = torch.arange(len(points), device=points.device)
    lists = Lists.of(torch.bincount(point, minlength=len(points)), cone.int())
    found = points.new_zeros(len(tables), 2, len(points))
    for table, side, values in zip(tables, resolutions, found, strict=True):
        listed_evidence(points, order, order, lists, table.rows, side, cutoff, values)
    return [PointEvidence(*values) for values in found]


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
    """

    def __init__(
        self,
        cones: Cones,
        resolution: float,
        cutoff: float = CUTOFF,
    ) -> None:
        self.resolution = check_resolution(resolution)
        cones = cones.checked()
        if not 0 < cutoff < math.inf:
            raise InvalidArgumentError(f"cutoff={cutoff} must be finite and above zero.")
        self.dim, self.cutoff = cones.dim, float(cutoff)
        safe_cholesky(cones.covariances.double().detach())  # raises if one is not positive definite
        spectrum = spectrum_of(cones.covariances)
        self._table = _table_of(cones, spectrum[1], self.resolution)
        self._index: ConeIndex | Callable[[], ConeIndex]
        self._index = functools.partial(
            ConeIndex, cones, self.resolution, cutoff, smoothed=True, spectrum=spectrum
        )

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
        spectrum = spectrum_of(new.covariances)
        table = _table_of(new, spectrum[1], self.resolution)
        made._table = PointTable(
            *(replaced_rows(rows, former, rest) for rows, rest in zip(self._table, table, strict=True))
        )
        if isinstance(self._index, ConeIndex):
            made._index = functools.partial(self._index.replaced, cones, former, spectrum)
        else:
            made._index = functools.partial(ConeIndex, cones, self.resolution, self.cutoff, smoothed=True)
        return made

    def __call__(self, points: ArrayLike, before: PointEvidence | None = None) -> PointEvidence:
        """Hits and misses at points (M, D), world metres; zero at infinite points. `before`: of other cones,
        to which these are added.

        Raises `InvalidArgumentError` for another shape, or NaN.
        """
        query = check_queries(points, self.dim)
        zeros = torch.zeros_like(query[:, 0])
        before = before or PointEvidence(zeros, zeros)

        def evaluated(part: slice) -> PointEvidence:
            return self._evaluate(query[part], before.hits[part], before.misses[part])

        parts = list(chunked(len(query), _CHUNK_POINTS, evaluated)) or [before]
        hits, misses = parts[0] if len(parts) == 1 else map(torch.cat, zip(*parts, strict=True))
        return PointEvidence(hits, misses)

    def _evaluate(self, points: Tensor, hits: Tensor, misses: Tensor) -> PointEvidence:
        if is_fused(points, self.rows):
            return PointEvidence(*self._fused(points, torch.stack([hits, misses])))
        for rows, number in self.index.parts(points):
            if not len(rows):
                continue
            blocks = PointBlocks.of(points[rows], number, self.index)
            chunks = chunks_of(self.index.lists.lengths()[blocks.bucket], CHUNK_PAIRS)
            evidence = torch.cat([self._of_blocks(blocks, part) for part in chunks], 1)
            place, (hit, miss) = rows[blocks.point], evidence.flatten(1)[:, blocks.slot]
            hits, misses = hits.index_add(0, place, hit), misses.index_add(0, place, miss)
        return PointEvidence(hits, misses)

    def _fused(self, points: Tensor, found: Tensor) -> Tensor:
        """Adds hits and misses to `found` (2, M) by the fused kernel."""
        settings = self.rows, self.resolution, self.cutoff, found
        bucket = torch.zeros_like(points[:, 0], dtype=torch.int64)
        if len(points) * len(self.rows) <= _FEW_PAIRS:
            every = torch.arange(len(self.rows), dtype=torch.int32, device=points.device)
            order = torch.arange(len(points), device=points.device)
            bucket[(points.abs() > _FARTHEST).any(1)] = -1
            listed_evidence(points, order, bucket, Lists.of(order.new_tensor([len(every)]), every), *settings)
            return found
        for rows, number in self.index.parts(points):
            if len(rows) == len(points):
                bucket, order = number, self.index.in_space_order(points, number)
            else:
                bucket[rows] = number
                order = rows[self.index.in_space_order(points[rows], number)]
            listed_evidence(points, order, bucket, self.index.lists, *settings)
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
        for rows, number in self.index.parts(query):
            if len(rows):
                blocks = PointBlocks.of(query[rows], number, self.index)
                for part in chunks_of(self.index.lists.lengths()[blocks.bucket], CHUNK_PAIRS):
                    n_rows += len(self._near_cones(blocks, part)[0]) * blocks.points.shape[1]
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
    rows += [
        spread * (toward * toward).sum(1, keepdim=True),
        log_scale[:, None],
        counts[:, None],
        (counts * ~cones.max_range)[:, None],
    ]
    above = torch.triu_indices(dim, dim, 1, device=covariances.device)
    tilts = turned[:, above[0], above[1]] if covariances.requires_grad else turned.new_zeros(len(means), 0)
    return PointTable(torch.cat(rows, 1), tilts)

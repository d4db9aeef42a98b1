"""Evidence at single points, as of a cube around each: closed forms, no grid, no sampling."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.linalg import argsort, safe_cholesky
from gmmtorch.occupancy.cones import CUTOFF, Cones
from gmmtorch.occupancy.forms.radial import tail_moment
from gmmtorch.occupancy.grid import check_resolution
from gmmtorch.occupancy.index.cone_index import ConeIndex
from gmmtorch.occupancy.index.hulls import sum_of
from gmmtorch.occupancy.protocol import check_queries

CHUNK_PAIRS = 1 << 16
"""Pairs of point and cone worked on at once: bounds the memory, not the result."""

_SUBCELLS = 4  # along each axis of a bucket: points are sorted so finely that blocks are compact
_PORTION = 1 << 20  # points sorted at once
_FEW = 1 << 11  # points, for which an index is not worth building


class PointEvidence(NamedTuple):
    """hits (M,), misses (M,): expected rays that end in, and that pass through, the cube at each point."""

    hits: Tensor
    misses: Tensor


def point_evidence(
    cones: Cones,
    points: Tensor,
    resolution: float,
    cutoff: float = CUTOFF,
    *,
    hit_length: float | None = None,
    compiled: bool = False,
) -> PointEvidence:
    """Evidence of the cube of side `resolution` (m) centred at each point (M, D).

    For more than one question to the same cones keep a `PointForm`.
    """
    form = PointForm(cones, resolution, cutoff, compiled=compiled, indexed=points.shape[0] > _FEW)
    return form(points, hit_length)


class PointForm:
    """The point form of evidence of fixed cones, for cubes of one side h; float64, in closed form.

    Of a component N(μ, Σ) with count N, seen from s, at x with u = x − s:

        hits = N h^D N(x | μ, Σ + h²/12 I)
        misses = N h^{D−1} (Σ_i |u_i|/|u|) |u| ∫_τ^∞ t^{D−1} N(s + tu | μ, Σ + κI) dt

    h²/12 I is the spread of the cube, κ = (h²/12) |μ − s|²/|u|² the same as seen from the sensor: so a
    cone narrower than the cube is averaged over the cube, not met or missed by its centre. The area
    that the cube shows to the ray is h^{D−1} Σ|u_i|/|u|, the mean chord h |u|/Σ|u_i|, and τ lies half a
    chord beyond x: what passes ends beyond the cube, and not in its second half.

    No cone gives more than its N rays: hits at most N, misses at most N − hits, and just that in a cube
    that holds the sensor, where every ray begins. Both fade to zero over the last unit of squared
    deviations before `cutoff`, so that evidence has no edge; beyond it they are exactly zero.

    Gradients flow to the points, and to means, covariances, origins and counts that ask for them.

    Args:
        cones: not to be changed afterwards.
        resolution: h (m).
        cutoff: deviations beyond which a component is taken to end.
        compiled: use torch.compile; needs a C++ compiler, and tens of seconds for its first use.
        indexed: visit only the cones that can matter; else all of them, for a few questions.
    """

    def __init__(
        self,
        cones: Cones,
        resolution: float,
        cutoff: float = CUTOFF,
        *,
        compiled: bool = False,
        indexed: bool = True,
    ) -> None:
        self.resolution = check_resolution(resolution)
        if not 0 < cutoff < math.inf:
            raise InvalidArgumentError(f"cutoff={cutoff} must be a number of deviations above zero.")
        self.dim, self.cutoff, self.compiled = cones.dim, float(cutoff), compiled
        self._table = _Table.of(cones, self.resolution)
        entries = None if indexed else 0
        self.index = ConeIndex(cones, self.resolution, cutoff, smoothed=True, entries_per_cone=entries)

    def __call__(
        self, points: Tensor, hit_length: float | None = None, chunk_pairs: int = CHUNK_PAIRS
    ) -> PointEvidence:
        """Hits and misses at points (M, D), world metres; zero at infinity.

        hit_length: ℓ (m), hits per area and ℓ instead of h: recalibrates what thin surfaces say.
        Raises `InvalidArgumentError` for another shape, NaN, or a length that is not above zero.
        """
        query = check_queries(points, self.dim)
        scale = 1.0 if hit_length is None else _check_length(hit_length) / self.resolution
        hits, misses = [], []
        for part in query.split(_PORTION):
            found = self._portion(part, chunk_pairs)
            hits.append(found.hits * scale)
            misses.append(found.misses)
        return PointEvidence(torch.cat(hits), torch.cat(misses))

    def _portion(self, points: Tensor, chunk_pairs: int) -> PointEvidence:
        zeros = torch.zeros_like(points[:, 0])
        bucket = self.index.buckets(points)
        if not bool((bucket >= 0).any()):
            return PointEvidence(zeros, zeros.clone())
        blocks = _Blocks.of(points, bucket, self.index)
        parts = [
            self._blocks(blocks, part, chunk_pairs) for part in _portions(blocks, self.index, chunk_pairs)
        ]
        evidence = torch.cat(parts, 1).flatten(1)[:, blocks.slot]
        hits, misses = (zeros.index_copy(0, blocks.point, values) for values in evidence)
        return PointEvidence(hits, misses)

    def _rows(self, blocks: _Blocks, part: slice) -> tuple[Tensor, Tensor]:
        """Blocks (R,), counted in `part`, and the cones (R,) that can matter to them."""
        place, cone = self.index.listed(blocks.bucket[part])
        centers, radius = blocks.centers[part], blocks.radius[part]
        near = self.index.hulls.near(cone, centers[place], radius[place], self.compiled)
        return place[near], cone[near]

    def _blocks(self, blocks: _Blocks, part: slice, chunk_pairs: int) -> Tensor:
        """Hits and misses (2, b, B) of the blocks in `part`."""
        place, cone = self._rows(blocks, part)
        points = blocks.points[..., part]
        hits = points.new_zeros(points.shape[2], points.shape[1])
        misses = hits.clone()
        shares = _compiled_shares() if self.compiled else _shares
        settings = (self.resolution, self.cutoff, self._table.oblique)
        n_rows = max(1, chunk_pairs // points.shape[1])
        for of, which in zip(place.split(n_rows), cone.split(n_rows), strict=True):
            hit, miss = shares(points, of, self._table.columns, which, *settings)
            hits, misses = hits.index_add(0, of, hit.T), misses.index_add(0, of, miss.T)
        return torch.stack([hits, misses])

    def visited(self, points: Tensor, chunk_pairs: int = CHUNK_PAIRS) -> float:
        """Cones whose evidence is computed for a point, on average over these points (M, D)."""
        query = check_queries(points, self.dim)
        bucket = self.index.buckets(query)
        if not bool((bucket >= 0).any()):
            return 0.0
        blocks = _Blocks.of(query, bucket, self.index)
        parts = _portions(blocks, self.index, chunk_pairs)
        n_rows = sum(self._rows(blocks, part)[0].shape[0] for part in parts)
        return n_rows * blocks.points.shape[1] / query.shape[0]


def _check_length(length: float) -> float:
    if not 0 < float(length) < math.inf:
        raise InvalidArgumentError(
            f"hit_length={length} must be metres above zero, or None for the cube's side."
        )
    return float(length)


class _Table(NamedTuple):
    """One column a cone of what `_shares` needs, in the axes V of its component; see there.

    oblique: whether the columns end with the entries of VᵀΣV off the diagonal. They are zero, but
    gradients of the covariance pass through them.
    """

    columns: Tensor
    oblique: bool

    @staticmethod
    def of(cones: Cones, resolution: float) -> _Table:
        dim = cones.dim
        covariances = cones.covariances.double()
        safe_cholesky(covariances.detach())  # for its errors
        # V is held fixed: it has no gradient where variances are equal, and to first order Σ needs none.
        axes = torch.linalg.eigh(covariances.detach())[1]
        turned = axes.transpose(1, 2) @ covariances @ axes
        variances = turned.diagonal(dim1=1, dim2=2)
        variances = variances.clamp_min(1e-12 * float(resolution) ** 2)
        means, origins, counts = cones.means.double(), cones.origins.double(), cones.counts.double()
        toward = means - origins
        seen = (axes.transpose(1, 2) @ toward[:, :, None]).squeeze(2)
        spread = resolution**2 / 12
        log_scale = -0.5 * (2 * math.pi * (variances + spread)).log().sum(1) + dim * math.log(resolution)
        columns = [axes.flatten(1), means, origins, seen, variances]
        columns += [
            spread * (toward * toward).sum(1, keepdim=True),
            log_scale[:, None],
            counts[:, None],
            (counts * ~cones.max_range)[:, None],
        ]
        oblique = covariances.requires_grad
        if oblique:
            above = torch.triu_indices(dim, dim, 1, device=covariances.device)
            columns.append(turned[:, above[0], above[1]])
        return _Table(torch.cat(columns, 1).T.contiguous(), oblique)


def _shares(
    points: Tensor, of: Tensor, table: Tensor, cone: Tensor, resolution: float, cutoff: float, oblique: bool
) -> tuple[Tensor, Tensor]:
    """Hits and misses (B, R) at the points (D, B, b) of blocks `of` (R,), of cones (R,) of a table."""
    dim = points.shape[0]
    h = resolution
    columns = [column[cone] for column in table]
    axes = [columns[i * dim : (i + 1) * dim] for i in range(dim)]  # axes[i][j]: entry i of axis j
    mean, origin, seen, variances = (columns[dim * dim + i * dim :][:dim] for i in range(4))
    widening, log_scale, counts, surface = columns[dim * dim + 4 * dim :][:4]
    tilts = columns[dim * dim + 4 * dim + 4 :] if oblique else []

    x = [axis[:, of] for axis in points]
    offset = [a - m for a, m in zip(x, mean, strict=True)]
    ray = [a - s for a, s in zip(x, origin, strict=True)]
    size = [r.abs() for r in ray]
    begins = functools.reduce(torch.maximum, size) <= 0.5 * h  # the cube holds the sensor
    y = [sum_of(axes[i][j] * offset[i] for i in range(dim)) for j in range(dim)]
    # In a cube that holds the sensor all rays pass; the closed form is kept finite and not used.
    z = [torch.where(begins, 1.0, a + b) for a, b in zip(y, seen, strict=True)]
    squared_distance = torch.where(begins, 1.0, sum_of(r * r for r in ray))
    breadth = torch.where(begins, 1.0, sum_of(size))

    sharp = [1 / (v + h * h / 12) for v in variances]
    squared = _product(y, y, sharp, tilts)
    hit = (torch.exp(log_scale - 0.5 * squared) * (cutoff**2 - squared).clamp(0, 1)).clamp_max(1)

    kappa = widening / squared_distance
    sharp = [1 / (v + kappa) for v in variances]
    aa, bb = _product(z, z, sharp, tilts), _product(y, z, sharp, tilts)
    across = [a - bb / aa * b for a, b in zip(y, z, strict=True)]
    squared = _product(across, across, sharp, tilts)
    length = aa.sqrt()
    along = bb / length
    leaving = along + 0.5 * h * length / breadth
    determinant = functools.reduce(torch.mul, sharp)
    peak = torch.exp(-0.5 * squared) * (determinant / (2 * math.pi * aa) ** dim).sqrt()
    flux = peak * tail_moment(leaving, length - along, dim) * breadth * h ** (dim - 1)
    inside = (cutoff**2 - squared - leaving.clamp_min(0) ** 2).clamp(0, 1)
    miss = torch.minimum(torch.where(begins, 1.0, flux * inside), 1 - hit)
    return hit * surface, miss * counts


def _product(v: list[Tensor], w: list[Tensor], sharp: list[Tensor], tilts: list[Tensor]) -> Tensor:
    """vᵀ(VᵀΣV + κI)⁻¹w, to first order in the entries off the diagonal, which are zero."""
    dim = len(v)
    product = sum_of(g * a * b for g, a, b in zip(sharp, v, w, strict=True))
    pairs = [(i, j) for i in range(dim) for j in range(i + 1, dim)] if tilts else []
    for (i, j), tilt in zip(pairs, tilts, strict=True):
        product = product - tilt * sharp[i] * sharp[j] * (v[i] * w[j] + v[j] * w[i])
    return product


@functools.cache
def _compiled_shares() -> Callable[..., tuple[Tensor, Tensor]]:
    compiled: Callable[..., tuple[Tensor, Tensor]] = torch.compile(_shares, dynamic=True)
    return compiled


class _Blocks(NamedTuple):
    """Points sorted by place, in blocks of B that share a bucket, filled up by repeating one.

    points (D, B, b); bucket (b,); centers (b, D) and radius (b,) of a ball around them; point (n,) and
    slot (n,): which of the points given went into which of the b·B slots.
    """

    points: Tensor
    bucket: Tensor
    centers: Tensor
    radius: Tensor
    point: Tensor
    slot: Tensor

    @staticmethod
    def of(points: Tensor, bucket: Tensor, index: ConeIndex) -> _Blocks:
        """Those of the points (M, D) that have a bucket (M,) at all, −1 for those that have not."""
        point = (bucket >= 0).nonzero().squeeze(1)
        within = (points.detach()[point] - index.origin) / index.side % 1
        fine = bucket[point]
        for axis in range(index.dim):
            fine = fine * _SUBCELLS + (within[:, axis] * _SUBCELLS).long()
        point = point[argsort(fine)]
        touched, count = torch.unique_consecutive(bucket[point], return_counts=True)
        size = (
            16
            if point.shape[0] > 24 * touched.shape[0]
            else 4
            if point.shape[0] > 4 * touched.shape[0]
            else 1
        )
        n_blocks = (count + size - 1) // size
        first, begin = torch.cumsum(count, 0) - count, (torch.cumsum(n_blocks, 0) - n_blocks) * size
        number = torch.arange(point.shape[0], device=point.device)
        slot = number + torch.repeat_interleave(begin - first, count)
        # Slots left over repeat the last point before them.
        filled = torch.zeros(int(n_blocks.sum()) * size, dtype=torch.int64, device=point.device)
        filled[slot] = number
        filled = filled.cummax(0).values
        gathered = points[point][filled].view(-1, size, index.dim)
        fixed = gathered.detach()
        centers = 0.5 * (fixed.amin(1) + fixed.amax(1))
        radius = (fixed - centers[:, None]).norm(dim=2).amax(1)
        owner = torch.repeat_interleave(touched, n_blocks)
        return _Blocks(gathered.permute(2, 1, 0).contiguous(), owner, centers, radius, point, slot)


def _portions(blocks: _Blocks, index: ConeIndex, chunk_pairs: int) -> Iterator[slice]:
    """Consecutive blocks whose lists together hold about `chunk_pairs` entries, or one block's."""
    portion = torch.cumsum(index.list_lengths()[blocks.bucket], 0) // chunk_pairs
    begin = 0
    for count in torch.unique_consecutive(portion, return_counts=True)[1].tolist():
        yield slice(begin, begin + count)
        begin += count

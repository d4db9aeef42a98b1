"""Point form: evidence of the cube around a point in closed form, without a grid and without samples."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.linalg import safe_cholesky
from gmmtorch.occupancy.cones import CUTOFF, Cones
from gmmtorch.occupancy.grid import check_resolution
from gmmtorch.occupancy.index.cone_index import ConeIndex
from gmmtorch.occupancy.index.hulls import sum_of
from gmmtorch.occupancy.index.point_blocks import PointBlocks
from gmmtorch.occupancy.protocol import check_queries

CHUNK_PAIRS = 1 << 16
"""Pairs of a point and a cone evaluated in one pass. It bounds the memory and does not change the result."""

_CHUNK_POINTS = 1 << 20  # points sorted in one pass
_FEW = 1 << 11  # for at most this many points an index does not pay
_SQRT_HALF_PI = math.sqrt(math.pi / 2)


class PointEvidence(NamedTuple):
    """hits (M,), misses (M,): expected rays that end in the cube at each point, and that pass through it."""

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
    """Evidence of the cube of side `resolution` (m) centred at each point (M, D), world metres.

    For several calls with the same cones use a `PointForm`.
    """
    form = PointForm(cones, resolution, cutoff, compiled=compiled, indexed=points.shape[0] > _FEW)
    return form(points, hit_length)


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
        compiled: use torch.compile. It needs a C++ compiler, and tens of seconds for the first call.
        indexed: True evaluates only cones near a point, found by a `ConeIndex`; False evaluates all cones,
            which is faster for a few points.
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
            raise InvalidArgumentError(f"cutoff={cutoff} must be finite and above zero.")
        self.dim, self.cutoff, self.compiled = cones.dim, float(cutoff), compiled
        self._table = _ConeTable.of(cones, self.resolution)
        entries = None if indexed else 0
        self.index = ConeIndex(cones, self.resolution, cutoff, smoothed=True, entries_per_cone=entries)

    def __call__(
        self, points: Tensor, hit_length: float | None = None, chunk_pairs: int = CHUNK_PAIRS
    ) -> PointEvidence:
        """Hits and misses at points (M, D), world metres; zero at infinite points.

        hit_length: ℓ (m); hits are multiplied by ℓ/h. It recalibrates the evidence of thin surfaces.
        Raises `InvalidArgumentError` for another shape, NaN, or a length that is not above zero.
        """
        query = check_queries(points, self.dim)
        scale = 1.0 if hit_length is None else _check_length(hit_length) / self.resolution
        hits, misses = [], []
        for part in query.split(_CHUNK_POINTS):
            found = self._evaluate(part, chunk_pairs)
            hits.append(found.hits * scale)
            misses.append(found.misses)
        return PointEvidence(torch.cat(hits), torch.cat(misses))

    def _evaluate(self, points: Tensor, chunk_pairs: int) -> PointEvidence:
        zeros = torch.zeros_like(points[:, 0])
        bucket = self.index.buckets(points)
        if not bool((bucket >= 0).any()):
            return PointEvidence(zeros, zeros.clone())
        blocks = PointBlocks.of(points, bucket, self.index)
        parts = [
            self._of_blocks(blocks, part, chunk_pairs) for part in blocks.chunks(self.index, chunk_pairs)
        ]
        evidence = torch.cat(parts, 1).flatten(1)[:, blocks.slot]
        hits, misses = (zeros.index_copy(0, blocks.point, values) for values in evidence)
        return PointEvidence(hits, misses)

    def _near_cones(self, blocks: PointBlocks, part: slice) -> tuple[Tensor, Tensor]:
        """Pairs of a block (R,), counted from the start of `part`, and a cone (R,) near it."""
        block, cone = self.index.listed(blocks.bucket[part])
        centers, radius = blocks.centers[part], blocks.radius[part]
        near = self.index.hulls.near(cone, centers[block], radius[block], self.compiled)
        return block[near], cone[near]

    def _of_blocks(self, blocks: PointBlocks, part: slice, chunk_pairs: int) -> Tensor:
        """Hits and misses (2, b, B) of the blocks in `part`."""
        block, cone = self._near_cones(blocks, part)
        points = blocks.points[..., part]
        hits = points.new_zeros(points.shape[2], points.shape[1])
        misses = hits.clone()
        pair_evidence = _compiled_pair_evidence() if self.compiled else _pair_evidence
        settings = (self.resolution, self.cutoff, self._table.oblique)
        n_rows = max(1, chunk_pairs // points.shape[1])
        for rows, cones in zip(block.split(n_rows), cone.split(n_rows), strict=True):
            hit, miss = pair_evidence(points, rows, self._table.columns, cones, *settings)
            hits, misses = hits.index_add(0, rows, hit.T), misses.index_add(0, rows, miss.T)
        return torch.stack([hits, misses])

    def visited(self, points: Tensor, chunk_pairs: int = CHUNK_PAIRS) -> float:
        """Average number of cones evaluated for each of the points (M, D)."""
        query = check_queries(points, self.dim)
        bucket = self.index.buckets(query)
        if not bool((bucket >= 0).any()):
            return 0.0
        blocks = PointBlocks.of(query, bucket, self.index)
        parts = blocks.chunks(self.index, chunk_pairs)
        n_rows = sum(self._near_cones(blocks, part)[0].shape[0] for part in parts)
        return n_rows * blocks.points.shape[1] / query.shape[0]


def _check_length(length: float) -> float:
    if not 0 < float(length) < math.inf:
        raise InvalidArgumentError(
            f"hit_length={length} must be metres above zero, or None for the cube's side."
        )
    return float(length)


class _ConeTable(NamedTuple):
    """The quantities that `_pair_evidence` needs, one column for each cone, in the axes V of its component.

    oblique: whether the columns end with the off-diagonal entries of VᵀΣV. These are zero, but gradients with
    respect to the covariance pass through them.
    """

    columns: Tensor
    oblique: bool

    @staticmethod
    def of(cones: Cones, resolution: float) -> _ConeTable:
        dim = cones.dim
        covariances = cones.covariances.double()
        safe_cholesky(covariances.detach())  # raises if one is not positive definite
        # V has no gradient where variances are equal. It is held constant, which is exact to first order in
        # Σ.
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
        return _ConeTable(torch.cat(columns, 1).T.contiguous(), oblique)


def _pair_evidence(
    points: Tensor,
    block: Tensor,
    table: Tensor,
    cone: Tensor,
    resolution: float,
    cutoff: float,
    oblique: bool,
) -> tuple[Tensor, Tensor]:
    """Hits and misses (B, R) of R pairs of a block (R,) of points (D, B, b) and a cone (R,) of the table."""
    dim = points.shape[0]
    h = resolution
    columns = [column[cone] for column in table]
    axes = [columns[i * dim : (i + 1) * dim] for i in range(dim)]  # axes[i][j]: entry i of axis j
    mean, origin, seen, variances = (columns[dim * dim + i * dim :][:dim] for i in range(4))
    widening, log_scale, counts, surface = columns[dim * dim + 4 * dim :][:4]
    tilts = columns[dim * dim + 4 * dim + 4 :] if oblique else []

    x = [axis[:, block] for axis in points]
    offset = [a - m for a, m in zip(x, mean, strict=True)]
    ray = [a - s for a, s in zip(x, origin, strict=True)]
    size = [r.abs() for r in ray]
    at_sensor = functools.reduce(torch.maximum, size) <= 0.5 * h  # the cube contains the sensor origin
    y = [sum_of(axes[i][j] * offset[i] for i in range(dim)) for j in range(dim)]
    # There all rays pass. The closed form is not used; it is kept finite for the sake of gradients.
    z = [torch.where(at_sensor, 1.0, a + b) for a, b in zip(y, seen, strict=True)]
    squared_distance = torch.where(at_sensor, 1.0, sum_of(r * r for r in ray))
    breadth = torch.where(at_sensor, 1.0, sum_of(size))

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
    miss = torch.minimum(torch.where(at_sensor, 1.0, flux * inside), 1 - hit)
    return hit * surface, miss * counts


def _product(v: list[Tensor], w: list[Tensor], sharp: list[Tensor], tilts: list[Tensor]) -> Tensor:
    """vᵀ(VᵀΣV + κI)⁻¹w, to first order in the off-diagonal entries `tilts`, which are zero."""
    dim = len(v)
    product = sum_of(g * a * b for g, a, b in zip(sharp, v, w, strict=True))
    pairs = [(i, j) for i in range(dim) for j in range(i + 1, dim)] if tilts else []
    for (i, j), tilt in zip(pairs, tilts, strict=True):
        product = product - tilt * sharp[i] * sharp[j] * (v[i] * w[j] + v[j] * w[i])
    return product


@functools.cache
def _compiled_pair_evidence() -> Callable[..., tuple[Tensor, Tensor]]:
    compiled: Callable[..., tuple[Tensor, Tensor]] = torch.compile(_pair_evidence, dynamic=True)
    return compiled


def tail_moment(along: Tensor, depth: Tensor, dim: int) -> Tensor:
    """∫_a^∞ (w + b)^{D−1} e^{−w²/2} dw, the radial integral of the rays that end beyond a point; any shape.

    All lengths are in the deviations of one ray, measured from its point nearest to the mean: a (`along`)
    is the position of the query, and −b (`depth`) that of the sensor origin. With Q = √(π/2) erfc(a/√2) and
    g = e^{−a²/2} the integral is b Q + g in 2D and (b² + 1) Q + (2b + a) g in 3D.
    """
    tail = _SQRT_HALF_PI * torch.special.erfc(along * math.sqrt(0.5))
    edge = torch.exp(-0.5 * along * along)
    if dim == 2:
        return depth * tail + edge
    return (depth * depth + 1) * tail + (2 * depth + along) * edge

"""Cones: components seen from sensor origins, and their geometry in the whitened frame.

All forms of evidence are computed from cones. In the whitened frame of a cone its component is a unit ball
around the origin. Functions on whitened vectors have coordinates first: (D, P) for P pairs of a cell or face
and a cone, (E, D, P) for the E edges of each.

Culling finds the cells and faces of a grid, and the boxes, that a cone can meet. All its tests are
conservative: a cell that is left out has no evidence; a cell that is kept can have none.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.arrays import as_tensor
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.linalg import all_equal, inverse_factor, ragged_index, safe_cholesky
from gmmtorch.occupancy.grid import VoxelGrid

CUTOFF = 5.0
"""Default cutoff in standard deviations: beyond it a component gives no evidence."""

_MIXER = 0x1E3779B97F4A7C15


class Cones(NamedTuple):
    """C pairs of a component and a sensor origin that observed it.

    means (C, D), covariances (C, D, D): the component; origins (C, D): the sensor origin; counts (C,): the
    number of points measured from there; max_range (C,) bool: whether the points are ends of no-return beams.
    """

    means: Tensor
    covariances: Tensor
    origins: Tensor
    counts: Tensor
    max_range: Tensor

    @property
    def dim(self) -> int:
        """2 or 3."""
        return self.means.shape[1]

    def taken(self, rows: Tensor) -> Cones:
        """The cones of some rows: numbers (J,), or flags (C,)."""
        return Cones(*(part[rows] for part in self))

    def checked(self) -> Cones:
        """These cones as tensors on the device of the means.

        Raises `InvalidArgumentError` for fields that are not arrays of numbers, or of another shape.
        """
        means = as_tensor(self.means, "means")
        if means.ndim != 2 or means.shape[1] not in (2, 3):
            raise InvalidArgumentError(f"means has shape {tuple(means.shape)}; expected (C, 2) or (C, 3).")
        c, dim = means.shape
        found = Cones(
            means,
            as_tensor(self.covariances, "covariances", device=means.device),
            as_tensor(self.origins, "origins", device=means.device),
            as_tensor(self.counts, "counts", device=means.device),
            as_tensor(self.max_range, "max_range", torch.bool, means.device),
        )
        shapes = ((c, dim), (c, dim, dim), (c, dim), (c,), (c,))
        for name, value, shape in zip(self._fields, found, shapes, strict=True):
            if tuple(value.shape) != shape:
                raise InvalidArgumentError(f"{name} has shape {tuple(value.shape)}; expected {shape}.")
        return found


def former_rows(old: Cones, new: Cones) -> Tensor:
    """For each of `new` the number (C,) of an equal cone among `old`, in rising order; −1: there is none."""
    n_old, n_new = len(old.counts), len(new.counts)
    n = min(n_old, n_new)
    if all_equal((a[:n], b[:n]) for a, b in zip(old, new, strict=True)):  # cones were added at the end
        number = torch.arange(n_new, device=new.means.device)
        return torch.where(number < n, number, -1)
    tables = [
        torch.cat([part.detach().double().view(len(part), -1) for part in cones], 1) for cones in (old, new)
    ]
    mixer = torch.arange(1, tables[1].shape[1] + 1, device=new.means.device) * _MIXER
    bits = [rows.view(torch.int64) for rows in tables]
    keys = [((each >> 29 ^ each) * mixer).sum(1) for each in bits]
    order = keys[0].argsort(stable=True)
    if not n_old:
        return torch.full_like(keys[1], -1)
    place = order[torch.searchsorted(keys[0][order], keys[1]).clamp_max(n_old - 1)]
    place = torch.where((tables[0][place] == tables[1]).all(1), place, -1)
    before = torch.cat([place.new_full((1,), -1), place.cummax(0).values[:-1]])
    return torch.where(place > before, place, -1)


def cone_bounds(cones: Cones, cutoff: float = CUTOFF) -> tuple[Tensor, Tensor]:
    """Lowest and highest corner (C, D) of the box around each cone: its ellipsoid and its sensor origin."""
    means, origins = cones.means.double(), cones.origins.double()
    deviation = cutoff * cones.covariances.double().diagonal(dim1=-2, dim2=-1).sqrt()
    return torch.minimum(origins, means - deviation), torch.maximum(origins, means + deviation)


def whitening(covariances: Tensor) -> tuple[Tensor, Tensor]:
    """W (C, D, D), float64, with W Σ Wᵀ = I, and log √det 2πΣ (C,).

    Apply W to differences x − μ, not to positions. The whitened coordinates of a position can be large: in
    the thousands for a component 5 mm thick at 10 m. Subtracting two of them loses digits.
    """
    factors = safe_cholesky(covariances.double())
    log_norm = factors.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    return inverse_factor(factors).mT, log_norm + 0.5 * covariances.shape[-1] * math.log(2 * math.pi)


class WhitenedCones(NamedTuple):
    """The whitening of C cones, float64, coordinates first.

    matrix (D, D, C): W; mean, origin (D, C): world frame; toward (D, C): W(μ − s); log_norm (C,): log √det
    2πΣ.
    """

    matrix: Tensor
    mean: Tensor
    origin: Tensor
    toward: Tensor
    log_norm: Tensor

    @classmethod
    def of(cls, cones: Cones) -> WhitenedCones:
        inverse, log_norm = whitening(cones.covariances)
        mean, origin = cones.means.double().T, cones.origins.double().T
        matrix = inverse.permute(1, 2, 0).contiguous()
        return cls(matrix, mean, origin, (matrix * (mean - origin)).sum(1), log_norm)

    def take(self, cone: Tensor) -> WhitenedCones:
        """The cones with indices `cone` (P,)."""
        return WhitenedCones(*(part.index_select(-1, cone) for part in self))

    def apply(self, vector: Tensor) -> Tensor:
        """W v: (D, P) → (D, P)."""
        return (self.matrix * vector[None]).sum(1)


def dot(a: Tensor, b: Tensor) -> Tensor:
    """a·b over coordinates: (…, D, P) → (…, P)."""
    return (a * b).sum(-2)


def cross(a: Tensor, b: Tensor) -> Tensor:
    """a × b: (…, 3, P) in 3D, (…, 1, P) in 2D. Its length is |b| times the part of a perpendicular to b."""
    if a.shape[-2] == 2:
        return (a[..., 0, :] * b[..., 1, :] - a[..., 1, :] * b[..., 0, :])[..., None, :]
    a, b = torch.broadcast_tensors(a, b)
    return torch.linalg.cross(a, b, dim=-2)


def length(a: Tensor) -> Tensor:
    """|a| over coordinates: (…, D, P) → (…, P)."""
    return dot(a, a).sqrt()  # much faster than torch.norm over a leading dimension


def outside_cone(ray: Tensor, offset: Tensor, edges: Tensor, cutoff: float) -> Tensor:
    """Whether each cell or face (P,) certainly lies outside its cone.

    A place q is outside if its ray from the sensor origin s passes the mean μ at more than `cutoff`, or if q
    lies more than `cutoff` behind the point of the ray nearest to μ. The test uses lower bounds of both over
    centre + Σ f_i edge_i, |f_i| ≤ ½: it is never True for a cell that the cone meets, and can be False for
    one that it does not meet.

    Args:
        ray, offset: W(q − s) and W(q − μ) of the centres, (D, P).
        edges: whitened edges, (E, D, P).
    """
    reach = 0.5 * length(edges).sum(0)
    mean = ray - offset
    across = length(cross(offset, ray)) - 0.5 * length(cross(edges, mean[None])).sum(0)
    behind = dot(offset, ray) - 0.5 * dot(edges, (offset + ray)[None]).abs().sum(0)
    far = cutoff * (length(ray) + reach)
    return (across > far) | (behind > far)


def outside_ball(offset: Tensor, edges: Tensor, cutoff: float) -> Tensor:
    """Whether each cell (P,) certainly lies beyond `cutoff` from the mean; arguments as in `outside_cone`."""
    distance = length(offset)
    along = dot(edges, offset[None] / distance.clamp_min(1e-30)).abs().sum(0)
    return distance - 0.5 * along > cutoff


Pairs = tuple[Tensor, Tensor]
"""Indices of boxes and indices of cones, (P,) int64 each."""


_PAIRS_AT_ONCE = 1 << 18  # pairs of a box and a cone that are tested in one pass


def candidate_pairs(cones: Cones, low: Tensor, high: Tensor, cutoff: float = CUTOFF) -> Iterator[Pairs]:
    """All pairs of a box [low, high], (M, D) each, and a cone that can meet, by testing all pairs."""
    if not len(cones.counts) or not len(low):
        return
    cones = Cones(*(part.detach() for part in cones))
    low, high = low.detach().double(), high.detach().double()
    below, above = cone_bounds(cones, cutoff)
    white = WhitenedCones.of(cones)
    for rows in torch.arange(len(low), device=low.device).split(max(1, _PAIRS_AT_ONCE // len(cones.counts))):
        met = (low[rows, None] <= above).all(-1) & (high[rows, None] >= below).all(-1)
        box, cone = met.nonzero(as_tuple=True)
        box = rows[box]
        part = white.take(cone)
        center, side = 0.5 * (low[box] + high[box]).T, (high[box] - low[box]).T
        ray, offset = part.apply(center - part.origin), part.apply(center - part.mean)
        edges = part.matrix.transpose(0, 1) * side[:, None]
        kept = (~outside_cone(ray, offset, edges, cutoff)).nonzero().squeeze(1)
        yield box[kept], cone[kept]


def in_chunks(pairs: Iterable[Pairs], size: int) -> Iterator[Pairs]:
    """The same pairs in chunks of at most `size`."""
    for box, cone in pairs:
        yield from zip(box.split(size), cone.split(size), strict=True)


class FaceRows(NamedTuple):
    """R rectangles of faces, each in one plane of a grid, that the rays of a cone can cross.

    cone (R,): index of the cone. plane (R,): index of the grid plane. forward (R,) bool: whether rays cross
    it in the positive direction of the axis. first, number (R, D−1): lowest cell and number of cells along
    the other axes, in their order.
    """

    cone: Tensor
    plane: Tensor
    forward: Tensor
    first: Tensor
    number: Tensor


def face_rows(cones: Cones, grid: VoxelGrid, cutoff: float = CUTOFF) -> Iterator[FaceRows]:
    """Faces that the rays of each cone can cross: those perpendicular to each axis in turn.

    In the plane at c of axis a, the cone extends along another axis b over s_b + (c − s_a) m, where m lies
    between the slopes of the two tangents from the sensor origin s to the projection of the component's
    ellipsoid on the axes (a, b).
    """
    sensor = grid.to_units(cones.origins).detach()
    mean = grid.to_units(cones.means).detach()
    covariance = cones.covariances.detach().double() * (cutoff / grid.resolution) ** 2
    spread = covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    below, above = torch.minimum(sensor, mean - spread), torch.maximum(sensor, mean + spread)
    for axis, n in enumerate(grid.shape):
        # Forward: planes 1 … n above the sensor origin, each the upper face of a cell; backward: 0 … n − 1.
        begin = torch.stack([sensor[:, axis].floor() + 1, below[:, axis].floor() + 1])
        stop = torch.stack([above[:, axis].ceil(), sensor[:, axis].ceil()])
        begin, stop = (torch.stack([a.clamp(1, n + 1), b.clamp(0, n)]).long() for a, b in (begin, stop))
        row, within = ragged_index((stop - begin).clamp_min(0).flatten())
        plane = within + begin.flatten()[row]
        cone, forward = row % len(sensor), row < len(sensor)
        height = plane - sensor[cone, axis]
        first, count = [], []
        for other in (b for b in range(grid.dim) if b != axis):
            slopes = _tangent_slopes(mean - sensor, covariance, axis, other)
            ends = sensor[cone, other] + height * torch.stack(slopes)[:, cone]
            low = torch.maximum(ends.amin(0), below[cone, other])
            high = torch.minimum(ends.amax(0), above[cone, other])
            lowest = low.floor().clamp(0, grid.shape[other]).long()
            first.append(lowest)
            count.append((high.ceil().clamp(0, grid.shape[other]).long() - lowest).clamp_min(0))
        yield FaceRows(cone, plane, forward, torch.stack(first, 1), torch.stack(count, 1))


def _tangent_slopes(toward: Tensor, scaled: Tensor, a: int, b: int) -> tuple[Tensor, Tensor]:
    """Slopes m = db/da (C,) of the two tangents from the sensor origin to the ellipse of k²Σ (`scaled`).

    They solve (d_b − m d_a)² = k²(Σ_bb − 2mΣ_ab + m²Σ_aa) and are infinite where the ellipse extends to the
    sensor origin or behind it along axis a.
    """
    da, db = toward[:, a], toward[:, b]
    square = da * da - scaled[:, a, a]
    middle = da * db - scaled[:, a, b]
    rest = db * db - scaled[:, b, b]
    bounded = square > 1e-9 * da * da
    square = torch.where(bounded, square, 1.0)
    root = (middle * middle - square * rest).clamp_min(0).sqrt()
    slack = 1e-9 * (1 + middle.abs() / square + root / square)
    infinite = torch.full_like(root, torch.inf)
    low = torch.where(bounded, (middle - root) / square - slack, -infinite)
    high = torch.where(bounded, (middle + root) / square + slack, infinite)
    return low, high


def ball_rows(cones: Cones, grid: VoxelGrid, cutoff: float = CUTOFF) -> tuple[Tensor, Tensor, Tensor]:
    """Boxes of cells that ellipsoids can meet: cone (R,), lowest cell and number of cells (R, D) of each.

    Cones of no-return beams have none.
    """
    cone = (~cones.max_range).nonzero().squeeze(1)
    mean = grid.to_units(cones.means[cone].detach())
    variance = cones.covariances[cone].detach().double().diagonal(dim1=-2, dim2=-1)
    spread = cutoff / grid.resolution * variance.sqrt()
    size = torch.tensor(grid.shape, dtype=torch.float64, device=mean.device)
    low = (mean - spread).floor().clamp(mean.new_zeros(()), size).long()
    high = (mean + spread).ceil().clamp(mean.new_zeros(()), size).long()
    return cone, low, high - low

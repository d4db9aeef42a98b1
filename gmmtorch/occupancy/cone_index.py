"""ConeIndex: lists of the cones that can give evidence in each bucket of a lattice.

A bucket lists every cone whose hull (`Hulls`) meets a cube of side `extent` around any point of the
bucket. Lists are conservative: they can contain a cone that gives no evidence, and never miss one that
does.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.kernels.evidence.hull_test import near_hulls
from gmmtorch.linalg import argsort, dense_ranks, ragged_index
from gmmtorch.occupancy.cones import CUTOFF, Cones
from gmmtorch.occupancy.grid import check_resolution


class Hulls:
    """Hulls of C cones: all segments from the sensor origin to the component's ellipsoid at `cutoff`.

    A cone can give evidence to a cube of side `extent` (m) if its hull meets the cube. With `smoothed`, as
    in the point form, the cone is widened instead by a Gaussian with the variance of the cube.
    """

    def __init__(self, cones: Cones, extent: float, cutoff: float, smoothed: bool) -> None:
        dim = self.dim = cones.dim
        means, origins = cones.means.detach().double(), cones.origins.detach().double()
        variances, axes = torch.linalg.eigh(cones.covariances.detach().double())
        squares = cutoff**2 * variances.clamp_min(0)  # (C, D) squared half axes, ascending
        distance = (means - origins).norm(dim=1, keepdim=True)
        far = distance + squares[:, -1:].sqrt()
        self.means, self.origins, self.distance = means, origins, distance[:, 0]
        self.half = (axes**2 @ squares[:, :, None]).squeeze(2).sqrt()
        self.reach = 0.5 * extent * dim**0.5  # from the centre of the cube to its corners
        self.spread = cutoff * extent / 12**0.5 if smoothed else 0.0  # cutoff radius of the cube's Gaussian
        self.table = torch.cat([axes.flatten(1), means, origins, squares, distance, far], 1)

    def bounds(self) -> tuple[Tensor, Tensor]:
        """Boxes, lowest and highest corner (C, D), outside which a cone gives no evidence."""
        # The spread as seen from the sensor origin at range r is spread · distance / r, and at most r.
        widest = max(self.reach, self.spread)
        pad = torch.maximum((widest * self.distance).sqrt(), torch.full_like(self.distance, widest))
        low = torch.minimum(self.means - self.half, self.origins) - pad[:, None]
        high = torch.maximum(self.means + self.half, self.origins) + pad[:, None]
        return low, high

    def near(self, cone: Tensor, centers: Tensor, radius: Tensor | float, compiled: bool = False) -> Tensor:
        """Whether (T,) cone (T,) can give evidence to a cube centred in the ball around `centers` (T, D)."""
        return near_hulls(self.table, cone, centers, radius, self.reach, self.spread, compiled)


_ENTRIES_PER_CONE = {2: 64, 3: 512}  # limits memory and build time to a multiple of the number of cones
_SPAN = 4  # the search for a cone's buckets starts with at most this many along an axis
_KEY_BITS = {2: 31, 3: 21}  # bits of one bucket coordinate in a packed key
_TESTS_AT_ONCE = 1 << 13
_CHUNK_PAIRS = 1 << 20  # about as many candidates are listed at once, or those of a single box
_SUBCELLS = 4  # points are sorted into this many parts of a bucket along each axis


class ConeIndex:
    """Lists of cones, one for each bucket: bucket b, with packed coordinates keys[b], lists the cones
    `entries[starts[b] : starts[b + 1]]` in ascending order.

    Empty buckets are not stored. So memory is proportional to the number of cones, and the cost of a query
    depends on the cones near it, not on the size of the world.

    Args:
        cones: must not change afterwards; gradients do not pass through the index.
        extent: side (m) of the largest box that is queried.
        cutoff: Mahalanobis distance beyond which a component gives no evidence.
        smoothed: True for the point form, which widens cones by the spread of the cube (see `PointForm`);
            False for boxes that meet the cones themselves.
        entries_per_cone: the buckets are halved while at most this many entries per cone suffice; 0 makes a
            single bucket that lists all cones.
    """

    def __init__(
        self,
        cones: Cones,
        extent: float,
        cutoff: float = CUTOFF,
        smoothed: bool = False,
        entries_per_cone: int | None = None,
    ) -> None:
        self.extent = check_resolution(extent)
        cones = cones.checked()
        self.dim = cones.dim
        self._options = self.extent, cutoff, smoothed
        self._most_buckets = 1 << (_KEY_BITS[self.dim] - 1)  # along an axis
        hulls = self.hulls = Hulls(cones, *self._options)
        low, high = hulls.bounds()
        not_empty = len(cones.counts) > 0
        self.origin = low.amin(0) if not_empty else low.new_zeros(self.dim)
        self._top = high.amax(0) if not_empty else self.origin
        # The finest buckets whose coordinates fit the bits of the key.
        span = float((self._top - self.origin).amax()) * (1 + 1e-9)
        finest = max(self.extent, span / self._most_buckets)
        if entries_per_cone == 0:
            every = torch.arange(len(cones.counts), device=low.device)
            cone, cell, self.side = every, torch.zeros(len(every), self.dim).to(every), max(span, finest)
        else:
            budget = (entries_per_cone or _ENTRIES_PER_CONE[self.dim]) * len(cones.counts)
            lattice = _Lattice(low - self.origin, high - self.origin, self.origin, finest)
            cone, cell, self.side = _search(hulls, lattice, budget)
        self._list(self._pack(cell), cone)

    def _list(self, key: Tensor, cone: Tensor) -> None:
        """Makes the lists of pairs of a bucket's key (P,) and a cone (P,)."""
        order = argsort(cone)
        order = order[argsort(key[order])]
        bucket, n_buckets = dense_ranks(key[order])
        self.entries = cone[order]
        self.starts = torch.zeros(n_buckets + 1, dtype=torch.int64, device=key.device)
        self.starts[1:] = torch.cumsum(torch.bincount(bucket, minlength=n_buckets), 0)
        self.keys = key[order][self.starts[:-1]]

    def replaced(self, cones: Cones, former: Tensor) -> tuple[ConeIndex, Tensor]:
        """The index of other cones, and the buckets (n_buckets,) of it whose lists changed.

        Only the buckets of new cones are searched. They have the size of those of this index, unless the
        cones lie too far apart for it.

        Args:
            cones: C cones; must not change afterwards.
            former: (C,) the number of each cone in this index, −1 for a new one. The other numbers ascend.
        """
        cones = cones.checked()
        made = copy.copy(self)
        made.hulls = Hulls(cones, *self._options)
        added, kept = (former < 0).nonzero().squeeze(1), (former >= 0).nonzero().squeeze(1)
        hulls = Hulls(Cones(*(part[added] for part in cones)), *self._options)
        low, high = hulls.bounds()
        shift = ((self.origin - torch.cat([low, self.origin[None]]).amin(0)) / self.side).ceil().long()
        made.origin = self.origin - shift * self.side
        made._top = torch.cat([high, self._top[None]]).amax(0)
        if float((made._top - made.origin).amax()) > self.side * self._most_buckets:
            made = ConeIndex(cones, *self._options)
            return made, torch.ones_like(made.keys, dtype=torch.bool)
        lattice = _Lattice(low - made.origin, high - made.origin, made.origin, self.side)
        new, cell, _ = _search(hulls, lattice, math.inf)
        number = torch.full_like(self.hulls.distance, -1, dtype=torch.int64)
        number[former[kept]] = kept
        key = torch.repeat_interleave(self.keys + self._pack(shift[None]), self.list_lengths())
        cone = number[self.entries]
        stays, found = cone >= 0, self._pack(cell)
        made._list(torch.cat([key[stays], found]), torch.cat([cone[stays], added[new]]))
        return made, torch.isin(made.keys, torch.cat([key[~stays], found]))

    @property
    def n_buckets(self) -> int:
        """Number of cells of the index that list a cone."""
        return self.keys.shape[0]

    def _pack(self, cell: Tensor) -> Tensor:
        bits = _KEY_BITS[self.dim]
        key = cell[:, 0]
        for axis in range(1, self.dim):
            key = key << bits | cell[:, axis]
        return key

    def buckets(self, points: Tensor) -> Tensor:
        """Bucket (M,) that contains each point (M, D); −1 where no cone gives evidence."""
        if self.n_buckets == 0:
            return torch.full(points.shape[:1], -1, dtype=torch.int64, device=points.device)
        cell = ((points.detach().double() - self.origin) / self.side).floor()
        inside = ((cell >= 0) & (cell < 1 << _KEY_BITS[self.dim])).all(1)
        key = self._pack(torch.where(inside[:, None], cell, 0.0).long())
        place = torch.searchsorted(self.keys, key).clamp_max_(self.n_buckets - 1)
        return torch.where(inside & (self.keys[place] == key), place, -1)

    def in_space_order(self, points: Tensor, bucket: Tensor) -> Tensor:
        """An order (M,) of points (M, D), finite where they have a bucket (M,), in which neighbours follow.

        Points are sorted by bucket, and by the parts of their bucket.
        """
        part = ((points.detach() - self.origin) / self.side % 1 * _SUBCELLS).long()
        fine = bucket
        for axis in range(self.dim):
            fine = fine * _SUBCELLS + part[:, axis]
        return argsort(fine)

    def list_lengths(self) -> Tensor:
        """Number of cones (n_buckets,) in each list."""
        return self.starts[1:] - self.starts[:-1]

    def listed(self, buckets: Tensor) -> tuple[Tensor, Tensor]:
        """All entries of the lists of `buckets` (B,), in order: position in `buckets` (P,) and cone (P,)."""
        place, within = ragged_index(self.list_lengths()[buckets])
        return place, self.entries[self.starts[buckets][place] + within]

    def candidates(self, low: Tensor, high: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
        """Chunks of pairs, box (P,) and cone (P,): all cones whose hull meets a box [low, high], (M, D) each.

        Each pair occurs once, boxes ascend, and all pairs of a box are in the same chunk.

        Raises `InvalidArgumentError` for boxes larger than `extent`.
        """
        low, high = low.detach().double(), high.detach().double()
        if low.numel() and float((high - low).amax()) > self.extent * (1 + 1e-9) + 1e-9:
            raise InvalidArgumentError(
                f"A box of {float((high - low).amax()):.4g} m is larger than the index's "
                f"extent={self.extent:.4g} m; make the index with the extent of the largest box."
            )
        center = 0.5 * (low + high)
        bucket = self.buckets(center)
        box = (bucket >= 0).nonzero().squeeze(1)
        bucket = bucket[box]
        chunk = torch.cumsum(self.list_lengths()[bucket], 0) // _CHUNK_PAIRS
        sizes = torch.unique_consecutive(chunk, return_counts=True)[1].tolist()
        for boxes, buckets in zip(box.split(sizes), bucket.split(sizes), strict=True):
            place, cone = self.listed(buckets)
            pair = boxes[place]
            near = self.hulls.near(cone, center[pair], 0.0).nonzero().squeeze(1)
            yield pair[near], cone[near]


class _Lattice(NamedTuple):
    """Boxes around the hulls of cones, low and high (C, D), relative to `origin` (D,) of the world frame;
    and the side (m) of the finest buckets."""

    low: Tensor
    high: Tensor
    origin: Tensor
    finest: float

    def covering(self, cone: Tensor, side: float) -> tuple[Tensor, Tensor]:
        """All pairs of a cone (C,) and a bucket (P, D) of its box, for buckets of `side` (m)."""
        first, last = ((x[cone] / side).floor().long() for x in (self.low, self.high))
        size = last - first + 1
        row, rest = ragged_index(size.prod(1))
        cells = []
        for axis in range(size.shape[1]):
            cells.append(first[row, axis] + rest % size[row, axis])
            rest = rest // size[row, axis]
        return cone[row], torch.stack(cells, 1)


def _search(hulls: Hulls, lattice: _Lattice, budget: float) -> tuple[Tensor, Tensor, float]:
    """Entries of the lists, cone (P,) and bucket (P, D), and the side (m) of the buckets.

    The search starts with a few large buckets for each cone and halves those that its hull meets. It stops
    before there are more than `budget` entries, if the largest buckets allow that.
    """
    extent = (lattice.high - lattice.low).amax(1)
    cone = torch.zeros(0, dtype=torch.int64, device=extent.device)
    cell = cone.new_zeros(0, hulls.dim)
    if extent.numel() == 0:
        return cone, cell, lattice.finest
    level = (extent / (lattice.finest * (_SPAN - 1))).clamp_min(1).log2().ceil().long()
    corners = torch.cartesian_prod(*[torch.arange(2, device=extent.device)] * hulls.dim)
    for now in range(int(level.amax()), -1, -1):
        side = lattice.finest * 2**now
        halves = (2 * cell[:, None] + corners).flatten(0, 1)
        new_cone, new_cell = lattice.covering((level == now).nonzero().squeeze(1), side)
        pairs = torch.cat([cone.repeat_interleave(len(corners)), new_cone]), torch.cat([halves, new_cell])
        finer = _near(hulls, lattice, *pairs, side, budget if cone.numel() else math.inf)
        if finer is None:
            # All buckets have one size: cones whose search starts at this level or below use the larger one.
            pairs = lattice.covering((level <= now).nonzero().squeeze(1), 2 * side)
            rest = _near(hulls, lattice, *pairs, 2 * side, math.inf)
            assert rest is not None
            return torch.cat([cone, rest[0]]), torch.cat([cell, rest[1]]), 2 * side
        cone, cell = finer
    return cone, cell, lattice.finest


def _near(
    hulls: Hulls, lattice: _Lattice, cone: Tensor, cell: Tensor, side: float, budget: float
) -> tuple[Tensor, Tensor] | None:
    """The pairs of a cone (P,) and a bucket (P, D) that its hull meets; None if they exceed `budget`."""
    radius = 0.5 * side * hulls.dim**0.5
    found, n_found = [(cone[:0], cell[:0])], 0
    for cones, cells in zip(cone.split(_TESTS_AT_ONCE), cell.split(_TESTS_AT_ONCE), strict=True):
        near = hulls.near(cones, (cells.double() + 0.5) * side + lattice.origin, radius)
        found.append((cones[near], cells[near]))
        n_found += found[-1][0].shape[0]
        if n_found > budget:
            return None
    near_cones, near_cells = zip(*found, strict=True)
    return torch.cat(near_cones), torch.cat(near_cells)

"""ConeIndex: which cones can matter at a place, from lists kept for the buckets of a lattice.

A cone's hull is what lies on its rays: the component's ellipsoid at `cutoff` deviations and all
segments from it to the sensor. A cone is listed in every bucket that its hull comes near enough to
matter for a cube of side `extent` around a place in the bucket. Lists are conservative: they may
name a cone that turns out not to matter, and never miss one.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.linalg import argsort, dense_ranks
from gmmtorch.occupancy.cones import CUTOFF, Cones
from gmmtorch.occupancy.grid import check_resolution
from gmmtorch.occupancy.index.hulls import Hulls

_ENTRIES_PER_CONE = {2: 64, 3: 512}  # bounds memory and the time to build, in proportion to the map
_SPAN = 4  # buckets along an axis that a cone's search begins with, at most
_KEY_BITS = {2: 31, 3: 21}  # of a packed bucket coordinate
_TESTS_AT_ONCE = 1 << 13


class ConeIndex:
    """Lists of cones by bucket: bucket b, with packed coordinate keys[b], lists the cones
    `entries[starts[b] : starts[b + 1]]`, in rising order.

    Buckets that no cone comes near are not stored, so that memory is in proportion to the cones, and
    an answer costs what its neighbourhood holds, however large the world is.

    Args:
        cones: fixed; gradients do not pass through an index.
        extent: side (m) of the largest box that will be asked about.
        cutoff: deviations beyond which a component is taken to end.
        smoothed: lists are for the point form, whose cones are widened by the spread of the cube (see
            `PointForm`); else for boxes that meet the cones themselves.
        entries_per_cone: buckets are halved for as long as this many entries a cone suffice; 0: one
            bucket with every cone.
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
        self.dim = cones.dim
        hulls = self.hulls = Hulls(cones, self.extent, cutoff, smoothed)
        low, high = hulls.bounds()
        some = len(cones.counts) > 0
        self.origin = low.amin(0) if some else low.new_zeros(self.dim)
        # Fine enough to follow the cones, yet coordinates fit their bits.
        span = float((high.amax(0) - self.origin).amax()) * (1 + 1e-9) if some else 0.0
        finest = max(self.extent, span / (1 << (_KEY_BITS[self.dim] - 1)))
        if entries_per_cone == 0:
            every = torch.arange(len(cones.counts), device=low.device)
            cone, cell, self.side = every, torch.zeros(len(every), self.dim).to(every), max(span, finest)
        else:
            budget = (entries_per_cone or _ENTRIES_PER_CONE[self.dim]) * len(cones.counts)
            lattice = _Lattice(low - self.origin, high - self.origin, self.origin, finest)
            cone, cell, self.side = _search(hulls, lattice, budget)
        key = self._pack(cell)
        order = argsort(key)
        bucket, n_buckets = dense_ranks(key[order])
        self.entries = cone[order]
        self.starts = torch.zeros(n_buckets + 1, dtype=torch.int64, device=key.device)
        self.starts[1:] = torch.cumsum(torch.bincount(bucket, minlength=n_buckets), 0)
        self.keys = key[order][self.starts[:-1]]

    @property
    def n_buckets(self) -> int:
        return self.keys.shape[0]

    def _pack(self, cell: Tensor) -> Tensor:
        bits = _KEY_BITS[self.dim]
        key = cell[:, 0]
        for axis in range(1, self.dim):
            key = key << bits | cell[:, axis]
        return key

    def buckets(self, points: Tensor) -> Tensor:
        """Bucket (M,) that holds each point (M, D); −1 where no cone matters."""
        if self.n_buckets == 0:
            return torch.full(points.shape[:1], -1, dtype=torch.int64, device=points.device)
        cell = ((points.detach().double() - self.origin) / self.side).floor()
        inside = ((cell >= 0) & (cell < 1 << _KEY_BITS[self.dim])).all(1)
        key = self._pack(torch.where(inside[:, None], cell, 0.0).long())
        place = torch.searchsorted(self.keys, key).clamp_max_(self.n_buckets - 1)
        return torch.where(inside & (self.keys[place] == key), place, -1)

    def list_lengths(self) -> Tensor:
        """Cones (n_buckets,) that each bucket lists."""
        return self.starts[1:] - self.starts[:-1]

    def listed(self, buckets: Tensor) -> tuple[Tensor, Tensor]:
        """Place in `buckets` (P,) and cone (P,) of every entry of the lists of buckets (B,), in order."""
        count = self.list_lengths()[buckets]
        place = torch.repeat_interleave(count)
        within = torch.arange(place.shape[0], device=place.device) - (torch.cumsum(count, 0) - count)[place]
        return place, self.entries[self.starts[buckets][place] + within]

    def candidates(
        self, low: Tensor, high: Tensor, chunk_pairs: int = 1 << 20
    ) -> Iterator[tuple[Tensor, Tensor]]:
        """Pairs (box (P,), cone (P,)) such that no cone whose hull meets a box [low, high] (M, D) is missed.

        Each pair comes once, boxes in rising order, all pairs of a box in the same portion. Portions
        hold about `chunk_pairs`, or one box's.

        Raises `InvalidArgumentError` for boxes larger than `extent`.
        """
        low, high = low.detach().double(), high.detach().double()
        if low.numel() and float((high - low).amax()) > self.extent * (1 + 1e-9) + 1e-9:
            raise InvalidArgumentError(
                f"A box of {float((high - low).amax()):.4g} m is larger than the index's "
                f"extent={self.extent:.4g} m; make the index for the largest box."
            )
        bucket = self.buckets(0.5 * (low + high))
        box = (bucket >= 0).nonzero().squeeze(1)
        bucket = bucket[box]
        portion = torch.cumsum(self.list_lengths()[bucket], 0) // chunk_pairs
        sizes = torch.unique_consecutive(portion, return_counts=True)[1].tolist()
        for boxes, buckets in zip(box.split(sizes), bucket.split(sizes), strict=True):
            place, cone = self.listed(buckets)
            yield boxes[place], cone


class _Lattice(NamedTuple):
    """Boxes low (C, D), high (C, D) that the cones' hulls lie in, about `origin` (D,) in the world, and
    the side of the finest buckets."""

    low: Tensor
    high: Tensor
    origin: Tensor
    finest: float

    def covering(self, cone: Tensor, side: float) -> tuple[Tensor, Tensor]:
        """All pairs of these cones (C,) and a bucket (P, D) of their boxes."""
        first, last = ((x[cone] / side).floor().long() for x in (self.low, self.high))
        size = last - first + 1
        count = size.prod(1)
        row = torch.repeat_interleave(count)
        rest = torch.arange(row.shape[0], device=cone.device) - (torch.cumsum(count, 0) - count)[row]
        cells = []
        for axis in range(size.shape[1]):
            cells.append(first[row, axis] + rest % size[row, axis])
            rest = rest // size[row, axis]
        return cone[row], torch.stack(cells, 1)


def _search(hulls: Hulls, lattice: _Lattice, budget: int) -> tuple[Tensor, Tensor, float]:
    """At most `budget` entries of the lists, where it can be: cone (P,), bucket (P, D); the buckets' side.

    From a few large buckets a cone, by halving those that it comes near.
    """
    extent = (lattice.high - lattice.low).amax(1)
    if extent.numel() == 0:
        none = torch.zeros(0, dtype=torch.int64, device=extent.device)
        return none, none.new_zeros(0, hulls.dim), lattice.finest
    level = (extent / (lattice.finest * (_SPAN - 1))).clamp_min(1).log2().ceil().long()
    corners = torch.cartesian_prod(*[torch.arange(2, device=extent.device)] * hulls.dim)
    none = torch.zeros(0, dtype=torch.int64, device=extent.device)
    entries = _Entries(none, none.new_zeros(0, hulls.dim))
    for now in range(int(level.amax()), -1, -1):
        side = lattice.finest * 2**now
        halves = (2 * entries.cell[:, None] + corners).flatten(0, 1)
        cone, cell = lattice.covering((level == now).nonzero().squeeze(1), side)
        pairs = _Entries(
            torch.cat([entries.cone.repeat_interleave(len(corners)), cone]), torch.cat([halves, cell])
        )
        finer, fits = _near(hulls, lattice, pairs, side, budget if entries.cone.numel() else math.inf)
        if not fits:
            # One size for all: cones that would have begun here or below are put into the larger buckets.
            pairs = _Entries(*lattice.covering((level <= now).nonzero().squeeze(1), 2 * side))
            rest, _ = _near(hulls, lattice, pairs, 2 * side, math.inf)
            return torch.cat([entries.cone, rest.cone]), torch.cat([entries.cell, rest.cell]), 2 * side
        entries = finer
    return entries.cone, entries.cell, lattice.finest


class _Entries(NamedTuple):
    """Pairs of cone (P,) and bucket (P, D)."""

    cone: Tensor
    cell: Tensor


def _near(
    hulls: Hulls, lattice: _Lattice, pairs: _Entries, side: float, budget: float
) -> tuple[_Entries, bool]:
    """Those of the pairs that are near each other, and whether they are all: not if above `budget`."""
    radius = 0.5 * side * hulls.dim**0.5
    found, n_found = [_Entries(pairs.cone[:0], pairs.cell[:0])], 0
    for cone, cell in zip(*(part.split(_TESTS_AT_ONCE) for part in pairs), strict=True):
        near = hulls.near(cone, (cell.double() + 0.5) * side + lattice.origin, radius)
        found.append(_Entries(cone[near], cell[near]))
        n_found += found[-1].cone.shape[0]
        if n_found > budget:
            return found[0], False
    return _Entries(*(torch.cat(part) for part in zip(*found, strict=True))), True

"""ConeIndex: lists of the cones that can give evidence in each bucket of a lattice.

A bucket lists every cone whose hull (`Hulls`) meets a cube of side `extent` around any point of the
bucket. Lists are conservative: they can contain a cone that gives no evidence, and never miss one that
does. They are made when a point of the bucket is asked about.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.kernels.evidence.hull_test import Lists, near_lists
from gmmtorch.linalg import argsort, dense_ranks
from gmmtorch.occupancy.cones import CUTOFF, Cones
from gmmtorch.occupancy.grid import check_resolution


class Hulls:
    """Hulls of C cones: all segments from the sensor origin to the component's ellipsoid at `cutoff`.

    A cone can give evidence to a cube of side `extent` (m) if its hull meets the cube. With `smoothed`, as
    in the point form, the cone is widened instead by a Gaussian with the variance of the cube.

    Attributes:
        table: (C, n), see `near_lists`.
        low, high: (C, D) corners of the box outside which a cone gives no evidence.
    """

    def __init__(self, cones: Cones, extent: float, cutoff: float, smoothed: bool) -> None:
        dim = self.dim = cones.dim
        means, origins = cones.means.detach().double(), cones.origins.detach().double()
        variances, axes = torch.linalg.eigh(cones.covariances.detach().double())
        squares = cutoff**2 * variances.clamp_min(0)  # (C, D) squared half axes, ascending
        distance = (means - origins).norm(dim=1, keepdim=True)
        far = distance + squares[:, -1:].sqrt()
        self.reach = 0.5 * extent * dim**0.5  # from the centre of the cube to its corners
        self.spread = cutoff * extent / 12**0.5 if smoothed else 0.0  # cutoff radius of the cube's Gaussian
        self.table = torch.cat([axes.flatten(1), means, origins, squares, distance, far], 1)
        # The spread as seen from the sensor origin at range r is spread · distance / r, and at most r.
        widest = max(self.reach, self.spread)
        pad = (widest * distance).sqrt().clamp_min(widest)
        half = (axes**2 @ squares[:, :, None]).squeeze(2).sqrt()
        self.low = torch.minimum(means - half, origins) - pad
        self.high = torch.maximum(means + half, origins) + pad

    def taken(self, rows: Tensor) -> Hulls:
        """The hulls of some rows."""
        made = copy.copy(self)
        made.table, made.low, made.high = self.table[rows], self.low[rows], self.high[rows]
        return made

    def replaced(self, former: Tensor, new: Hulls) -> Hulls:
        """The hulls with numbers `former` (C,), and the `new` ones, in order, where it is −1."""
        made = copy.copy(self)
        made.table = replaced_rows(self.table, former, new.table)
        made.low, made.high = (
            replaced_rows(*rows) for rows in ((self.low, former, new.low), (self.high, former, new.high))
        )
        return made

    def near(
        self, given: Lists, lists: Tensor, centers: Tensor, radii: Tensor, compiled: bool = False
    ) -> Lists:
        """For each ball (T,), those cones of its list that can give evidence to a cube centred in the ball;
        arguments as for `near_lists`."""
        chunks = chunks_of(given.lengths()[lists], _TESTS_AT_ONCE)
        parts = [
            near_lists(
                self.table, given, lists[t], centers[t], radii[t], self.reach, self.spread, compiled
            )
            for t in chunks
        ]
        if len(parts) == 1:
            return parts[0]
        lengths = [part.lengths() for part in parts] or [lists]
        return Lists.of(torch.cat(lengths), torch.cat([given.entries[:0], *(part.entries for part in parts)]))


def replaced_rows(rows: Tensor, former: Tensor, new: Tensor) -> Tensor:
    """Rows with numbers `former` (C,), and the `new` ones, in order, where it is −1."""
    made = rows.new_empty(len(former), *rows.shape[1:])
    made[former >= 0], made[former < 0] = rows[former[former >= 0]], new
    return made


_ENTRIES_PER_CONE = {2: 64, 3: 512}  # of all buckets, which decides their side
_KEPT_PER_CONE, _KEPT = 64, 1 << 22  # entries of the lists that are kept, for each cone, and at least
_KEY_BITS = {2: 31, 3: 21}  # bits of one bucket coordinate in a packed key
_SAMPLE = 128  # cones, and places around each, by which the side is chosen
_FEW_GROUPS = 8  # of buckets, at which the search for lists starts
_SHIFT = 2  # a group of buckets is made of 2^_SHIFT smaller ones along an axis
_PER_LIST = 8  # entries that take as much memory as what else is kept of a list
_BUCKETS_AT_ONCE = 1 << 12
_PAIRS_AT_ONCE = 1 << 20
_TESTS_AT_ONCE = 1 << 22
_SUBCELLS = 4  # points are sorted into this many parts of a bucket along each axis


class ConeIndex:
    """Lists of cones, one for each bucket, made for the buckets that are asked about, and kept.

    What is kept is bounded in proportion to the number of cones; lists that were not used for the longest
    time go first. So the cost of a query depends on the cones near it; a bucket without a list also costs its
    share of a test of the boxes around all cones.

    Args:
        cones: must not change afterwards; gradients do not pass through the index.
        extent: side (m) of the largest box that is queried.
        cutoff: Mahalanobis distance beyond which a component gives no evidence.
        smoothed: True for the point form, which widens cones by the spread of the cube (see `PointForm`);
            False for boxes that meet the cones themselves.
        entries_per_cone: the buckets are halved while at most about this many entries per cone list all of
            them; 0 makes a single bucket that lists all cones.

    Attributes:
        lists: the kept lists; queries append to them, or drop the oldest.
        side: of the buckets, metres.
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
        self._options = self.extent, cutoff, smoothed, entries_per_cone
        self.hulls = Hulls(cones, self.extent, cutoff, smoothed)
        self._set_lattice()

    def _set_lattice(self) -> None:
        """Chooses the buckets for the present hulls, and drops all lists."""
        hulls, per_cone = self.hulls, self._options[3]
        n_cones, device = len(hulls.table), hulls.table.device
        self._n_chosen = n_cones  # the side is chosen for so many
        self.origin = hulls.low.amin(0) if n_cones else hulls.low.new_zeros(self.dim)
        span = float((hulls.high.amax(0) - self.origin).amax()) * (1 + 1e-9) if n_cones else 0.0
        # The finest buckets whose coordinates fit the bits of the key, with room to grow.
        finest = max(self.extent, span / (self._limit - 1))
        self._drop_all()
        if per_cone == 0:
            self.side = max(span, finest)
            cell = torch.zeros(min(n_cones, 1), self.dim, dtype=torch.int64, device=device)
            every = torch.arange(n_cones, dtype=torch.int32, device=device)
            self._add(self._pack(cell), Lists(cell.new_tensor([0, n_cones])[: len(cell) + 1], every))
        else:
            self.side = _chosen_side(hulls, finest, span, per_cone or _ENTRIES_PER_CONE[self.dim])

    def replaced(self, cones: Cones, former: Tensor) -> ConeIndex:
        """The index of other cones. It keeps the lists of buckets that no new cone, and none that is gone,
        can reach; none if there are too many new cones for the size of the buckets.

        Args:
            cones: C cones; must not change afterwards.
            former: (C,) the number of each cone in this index, −1 for a new one. The other numbers ascend.
        """
        cones, made = cones.checked(), copy.copy(self)
        is_new, stays = former < 0, torch.zeros_like(self.hulls.low[:, 0], dtype=torch.bool)
        stays[former[~is_new]] = True
        new = Hulls(Cones(*(part[is_new] for part in cones)), *self._options[:3])
        gone = self.hulls.taken(~stays)
        made.hulls = self.hulls.replaced(former, new)
        corners = (torch.cat([new.low, new.high]) - self.origin) / self.side
        if self._options[3] == 0 or len(former) > 2 * self._n_chosen or bool((corners.abs() > self._limit).any()):
            made._set_lattice()
            return made
        if not bool(stays.any()):
            made._drop_all()
            return made
        cells = self._unpack(self._keys)
        kept = torch.ones_like(self._used, dtype=torch.bool)
        for hulls in (new, gone):
            kept[self._numbers[self._lists_of(hulls, cells).lengths() > 0]] = False
        made._keep(kept)
        if bool(gone.low.numel()) and made.lists.entries.numel():
            number = torch.full_like(stays, -1, dtype=torch.int32)
            number[former[~is_new]] = (~is_new).nonzero().squeeze(1).int()
            made.lists.entries.copy_(number[made.lists.entries])
        return made

    # -- lists that are kept --------------------------------------------------------------------------

    def _drop_all(self) -> None:
        none = torch.zeros(0, dtype=torch.int64, device=self.hulls.table.device)
        self._keys, self._numbers = none, none  # of the buckets, sorted; and their lists
        self._used, self._now = none, 0  # when each list was used last
        self._buffer = none.int()  # begins with the entries of the lists
        self.lists = Lists.of(none, self._buffer)

    def _keep(self, kept: Tensor) -> None:
        """Drops the lists (n,) that are not kept."""
        lengths = self.lists.lengths()
        self._buffer = self.lists.entries[torch.repeat_interleave(kept, lengths)]
        self.lists = Lists.of(lengths[kept], self._buffer)
        self._used = self._used[kept]
        place = kept[self._numbers]
        self._keys, self._numbers = self._keys[place], (kept.cumsum(0) - 1)[self._numbers[place]]

    def _make_room(self, n_entries: int) -> None:
        """Drops lists that were not used for the longest time, if so many more entries are too many."""
        most = max(_KEPT, _KEPT_PER_CONE * len(self.hulls.table))
        sizes = self.lists.lengths() + _PER_LIST
        if int(sizes.sum()) + n_entries <= most:
            return
        newest = argsort(-self._used)
        kept = torch.zeros_like(self._used, dtype=torch.bool)
        kept[newest[sizes[newest].cumsum(0) <= most // 2]] = True
        self._keep(kept)

    def _add(self, keys: Tensor, lists: Lists) -> None:
        """Keeps the lists (n,) of new buckets with these keys (n,)."""
        n_lists, n_entries, n_added = len(self._used), len(self.lists.entries), len(lists.entries)
        if n_entries + n_added > len(self._buffer):
            self._buffer = torch.cat([self.lists.entries, lists.entries.new_empty(n_entries // 2 + n_added)])
        self._buffer[n_entries : n_entries + n_added] = lists.entries
        starts = torch.cat([self.lists.starts, n_entries + lists.starts[1:]])
        self.lists = Lists(starts, self._buffer[: n_entries + n_added])
        self._used = torch.cat([self._used, torch.full_like(keys, self._now)])
        numbers = torch.arange(n_lists, n_lists + len(keys), device=keys.device)
        keys, numbers = torch.cat([self._keys, keys]), torch.cat([self._numbers, numbers])
        order = argsort(keys)
        self._keys, self._numbers = keys[order], numbers[order]

    # -- the search for lists -------------------------------------------------------------------------

    def _lists_of(self, hulls: Hulls, cells: Tensor) -> Lists:
        """The lists of distinct buckets with these coordinates (B, D).

        Groups of buckets have lists too: each list is chosen from that of the group around it, and those of
        the largest groups from all cones.
        """
        levels, owners = [(cells, cells + 1, cells)], [torch.arange(len(cells), device=cells.device)]
        while len(owners[-1]) > _FEW_GROUPS:
            low, high, cell = levels[-1]
            cell = cell >> _SHIFT
            owner, n_groups = dense_ranks(self._pack(cell))
            row = owner[:, None].expand_as(cell)
            shape = cell.new_zeros(n_groups, self.dim)
            levels.append(
                (
                    shape.scatter_reduce(0, row, low, "amin", include_self=False),
                    shape.scatter_reduce(0, row, high, "amax", include_self=False),
                    shape.scatter(0, row, cell),
                )
            )
            owners[-1] = owner
            owners.append(torch.arange(n_groups, device=cells.device))
        boxes = [(self.origin + low * self.side, self.origin + high * self.side) for low, high, _ in levels]
        found = [
            ((hulls.low <= high) & (hulls.high >= low)).all(1).nonzero().squeeze(1).int()
            for low, high in zip(*boxes[-1], strict=True)
        ]
        lengths = cells.new_tensor([len(cones) for cones in found])
        lists = Lists.of(lengths, torch.cat(found) if found else cells.new_zeros(0).int())
        for (low, high), owner in zip(reversed(boxes), reversed(owners), strict=True):
            lists = hulls.near(lists, owner, 0.5 * (low + high), 0.5 * (high - low).norm(dim=1))
        return lists

    # -- queries --------------------------------------------------------------------------------------

    @property
    def _limit(self) -> int:
        """Largest coordinate of a bucket, or of its negative."""
        return (1 << (_KEY_BITS[self.dim] - 1)) - 1

    def _pack(self, cell: Tensor) -> Tensor:
        bits = _KEY_BITS[self.dim]
        key = cell[:, 0] + self._limit
        for axis in range(1, self.dim):
            key = key << bits | (cell[:, axis] + self._limit)
        return key

    def _unpack(self, keys: Tensor) -> Tensor:
        bits = _KEY_BITS[self.dim]
        parts = [keys >> bits * axis & ((1 << bits) - 1) for axis in reversed(range(self.dim))]
        return torch.stack(parts, 1) - self._limit

    def _find(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """The list (M,) of the bucket of each point (M, D), −1 for no or an empty list, −2 if there is none
        yet; and the keys (M,) of the buckets."""
        cell = ((points.detach().double() - self.origin) / self.side).floor()
        inside = (cell.abs() <= self._limit).all(1)
        key = self._pack(torch.where(inside[:, None], cell, 0.0).long())
        if len(self._keys) == 0:
            return torch.where(inside, -2, -1), key
        place = torch.searchsorted(self._keys, key).clamp_max_(len(self._keys) - 1)
        number = self._numbers[place]
        number = torch.where(self.lists.lengths()[number] > 0, number, -1)
        number = torch.where(self._keys[place] == key, number, -2)
        return torch.where(inside, number, -1), key

    def parts(self, points: Tensor, bounded: bool = True) -> Iterator[tuple[Tensor, Tensor]]:
        """Parts of points (M, D): their rows (R,), ascending, and the list (R,) in `lists` of all cones that
        can give evidence to each; −1 where there is none. Later parts change `lists`: use it part by part.

        bounded: False keeps the lists of all these points, beyond the bound.
        """
        if len(self.hulls.table) == 0:
            yield torch.arange(len(points), device=points.device), points.new_full((len(points),), -1).long()
            return
        self._now += 1
        number, key = self._find(points)
        missing = number == -2
        rows = (~missing).nonzero().squeeze(1)
        number = number[rows]
        self._used[number[number >= 0]] = self._now
        if len(rows):
            yield rows, number
        rows = missing.nonzero().squeeze(1)
        if not len(rows):
            return
        rank, n_missing = dense_ranks(key[rows])
        keys = torch.zeros_like(key[:n_missing]).scatter_(0, rank, key[rows])
        for first in range(0, n_missing, _BUCKETS_AT_ONCE):
            part = keys[first : first + _BUCKETS_AT_ONCE]
            made = self._lists_of(self.hulls, self._unpack(part))
            if bounded:
                self._make_room(len(made.entries) + _PER_LIST * len(part))
            n_before = len(self._used)
            self._add(part, made)
            chosen = ((rank >= first) & (rank < first + len(part))).nonzero().squeeze(1)
            number = rank[chosen] - first
            yield rows[chosen], torch.where(made.lengths()[number] > 0, number + n_before, -1)

    def buckets(self, points: Tensor) -> Tensor:
        """The list (M,) in `lists` of all cones that can give evidence to each point (M, D); −1 where there
        is none. Valid until the next query."""
        found = torch.full(points.shape[:1], -1, dtype=torch.int64, device=points.device)
        for rows, number in self.parts(points, bounded=False):
            found[rows] = number
        return found

    def in_space_order(self, points: Tensor, bucket: Tensor) -> Tensor:
        """An order (M,) of points (M, D), finite where they have a bucket (M,), in which neighbours follow.

        Points are sorted by bucket, and by the parts of their bucket.
        """
        part = ((points.detach() - self.origin) / self.side % 1 * _SUBCELLS).long()
        fine = bucket
        for axis in range(self.dim):
            fine = fine * _SUBCELLS + part[:, axis]
        return argsort(fine)

    def candidates(self, low: Tensor, high: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
        """Chunks of pairs, box (P,) and cone (P,): all cones whose hull meets a box [low, high], (M, D) each.

        Each pair occurs once; in a chunk boxes ascend, and all pairs of a box are in the same chunk.

        Raises `InvalidArgumentError` for boxes larger than `extent`.
        """
        low, high = low.detach().double(), high.detach().double()
        if low.numel() and float((high - low).amax()) > self.extent * (1 + 1e-9) + 1e-9:
            raise InvalidArgumentError(
                f"A box of {float((high - low).amax()):.4g} m is larger than the index's "
                f"extent={self.extent:.4g} m; make the index with the extent of the largest box."
            )
        center = 0.5 * (low + high)
        for rows, bucket in self.parts(center):
            box, bucket = rows[bucket >= 0], bucket[bucket >= 0]
            for part in chunks_of(self.lists.lengths()[bucket], _PAIRS_AT_ONCE):
                boxes = box[part]
                found = self.hulls.near(self.lists, bucket[part], center[boxes], torch.zeros_like(center[boxes, 0]))
                place, cone = found.taken(torch.arange(len(boxes), device=boxes.device))
                yield boxes[place], cone


def chunks_of(lengths: Tensor, size: int) -> Iterator[slice]:
    """Runs of lists (T,) of these lengths that together have about `size` entries, or a single list."""
    begin, chunk = 0, lengths.cumsum(0) // size
    for count in torch.unique_consecutive(chunk, return_counts=True)[1].tolist():
        yield slice(begin, begin + count)
        begin += count


def _chosen_side(hulls: Hulls, finest: float, span: float, per_cone: int) -> float:
    """The side (m) of the smallest buckets, `finest` times a power of two, for which a sample of the cones
    would have on average at most `per_cone` entries in the lists of all buckets."""
    n_cones, dim, device = len(hulls.table), hulls.dim, hulls.table.device
    if n_cones == 0:
        return finest
    sample = torch.linspace(0, n_cones - 1, min(n_cones, _SAMPLE), device=device).long()
    given = Lists.of(torch.ones_like(sample), sample.int())
    cone = torch.arange(len(sample), device=device).repeat_interleave(_SAMPLE)
    share = torch.rand(len(cone), dim, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    share, side = share.to(device), finest * 2.0 ** math.ceil(math.log2(max(span / finest, 1.0)))
    while side > finest:
        radius = 0.25 * side * dim**0.5
        low, size = hulls.low[sample] - radius, (hulls.high - hulls.low)[sample] + 2 * radius
        centers = low[cone] + share * size[cone]
        met = hulls.near(given, cone, centers, torch.full_like(share[:, 0], radius)).lengths()
        # Buckets on a lattice in any place: their centres lie in the volume that the cone reaches.
        n_entries = (size.prod(1)[cone] * met).mean() / (side / 2) ** dim
        if float(n_entries) > per_cone:
            break
        side /= 2
    return side

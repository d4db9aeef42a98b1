"""ConeIndex: lists of the cones that can give evidence in each bucket of a lattice.

A bucket lists every cone whose hull (`Hulls`) meets a cube of side `extent` around any point of the
bucket. Lists are conservative: they can contain a cone that gives no evidence, and never miss one that
does. They are made when a point of the bucket is asked about: from the list of a larger bucket around it,
and those of the largest buckets from all cones. Where there are few points, a larger bucket's list serves.
"""

from __future__ import annotations

import copy
import functools
import math
from collections.abc import Iterator

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.kernels import Lists, near_lists
from gmmtorch.linalg import argsort, dense_ranks
from gmmtorch.occupancy.cones import CUTOFF, Cones
from gmmtorch.occupancy.grid import check_resolution


def spectrum_of(covariances: Tensor) -> tuple[Tensor, Tensor]:
    """Variances (C, D), ascending, and axes V (C, D, D) of components with covariances (C, D, D), without
    gradients, float64."""
    variances, axes = torch.linalg.eigh(covariances.detach().double())
    return variances, axes


def hull_rows(cones: Cones) -> Tensor:
    """(C, n) the first columns of `PointTable.rows`, up to the variances, without gradients."""
    means, origins = cones.means.detach().double(), cones.origins.detach().double()
    variances, axes = spectrum_of(cones.covariances)
    seen = (axes.transpose(1, 2) @ (means - origins)[:, :, None]).squeeze(2)
    return torch.cat([axes.flatten(1), means, origins, seen, variances], 1)


class Hulls:
    """Hulls of C cones: all segments from the sensor origin to the component's ellipsoid at `cutoff`.

    A cone can give evidence to a cube of side `extent` (m) if its hull meets the cube. With `smoothed`, as
    in the point form, the cone is widened instead by a Gaussian with the variance of the cube.

    Args:
        cones: the cones, or their `PointTable.rows`, which are then kept instead of a copy.

    Attributes:
        table: (C, n), see `near_lists`.
        low, high: (C, D) corners of the box outside which a cone gives no evidence.
    """

    def __init__(self, cones: Cones | Tensor, extent: float, cutoff: float, smoothed: bool) -> None:
        self.table = rows = cones.detach() if isinstance(cones, Tensor) else hull_rows(cones)
        dim = self.dim = _dim_of(rows)
        self.cutoff = cutoff
        self.reach = 0.5 * extent * dim**0.5  # from the centre of the cube to its corners
        self.spread = cutoff * extent / 12**0.5 if smoothed else 0.0  # cutoff radius of the cube's Gaussian

    @functools.cached_property
    def _corners(self) -> tuple[Tensor, Tensor]:
        rows, dim = self.table, self.dim
        axes = rows[:, : dim * dim].view(-1, dim, dim)
        means, origins, _, variances = (rows[:, dim * dim + i * dim :][:, :dim] for i in range(4))
        squares = self.cutoff**2 * variances.clamp_min(0)  # (C, D) squared half axes, ascending
        distance = (means - origins).norm(dim=1, keepdim=True)
        # The spread as seen from the sensor origin at range r is spread · distance / r, and at most r.
        widest = max(self.reach, self.spread)
        pad = (widest * distance).sqrt().clamp_min(widest)
        half = (axes**2 @ squares[:, :, None]).squeeze(2).sqrt()
        return torch.minimum(means - half, origins) - pad, torch.maximum(means + half, origins) + pad

    @property
    def low(self) -> Tensor:
        return self._corners[0]

    @property
    def high(self) -> Tensor:
        return self._corners[1]

    def taken(self, rows: Tensor) -> Hulls:
        """The hulls of some rows."""
        made = copy.copy(self)
        made.table, made._corners = self.table[rows], (self.low[rows], self.high[rows])
        return made

    def replaced(self, former: Tensor, new: Hulls, table: Tensor | None) -> Hulls:
        """The hulls with numbers `former` (C,), and the `new` ones, in order, where it is −1. `table`: of all
        of them, if it is known."""
        made = copy.copy(self)
        made.table = replaced_rows(self.table, former, new.table) if table is None else table
        pairs = zip(self._corners, new._corners, strict=True)
        low, high = (replaced_rows(old, former, added) for old, added in pairs)
        made._corners = low, high
        return made

    def near(self, given: Lists, lists: Tensor, centers: Tensor, radii: Tensor) -> Lists:
        """For each ball (T,), those cones of its list that can give evidence to a cube centred in the ball;
        arguments as for `near_lists`."""
        sizes = self.reach, self.spread, self.cutoff
        if len(lists) * len(self.table) <= _TESTS_AT_ONCE:
            return near_lists(self.table, given, lists, centers, radii, *sizes)
        parts = [
            near_lists(self.table, given, lists[t], centers[t], radii[t], *sizes)
            for t in chunks_of(given.lengths()[lists], _TESTS_AT_ONCE)
        ]
        lengths = [part.lengths() for part in parts] or [lists]
        return Lists.of(torch.cat(lengths), torch.cat([given.entries[:0], *(part.entries for part in parts)]))


def _dim_of(rows: Tensor) -> int:
    """2 or 3, of rows of `hull_rows` or `PointTable.rows`."""
    return 2 if rows.shape[1] < 21 else 3


def replaced_rows(rows: Tensor, former: Tensor, new: Tensor) -> Tensor:
    """Rows with numbers `former` (C,), and the `new` ones, in order, where it is −1."""
    made = rows.new_empty(len(former), *rows.shape[1:])
    made[former >= 0], made[former < 0] = rows[former[former >= 0]], new
    return made


_ENTRIES_PER_CONE = {2: 64, 3: 512}  # of all buckets, which decides their side
_KEPT_PER_CONE, _KEPT = 48, 1 << 22  # entries of the lists that are kept, for each cone, and at least
_KEY_BITS = {2: 31, 3: 21}  # bits of one bucket coordinate in a packed key
_SAMPLE = 64  # cones, and places around each, by which the side is chosen
_SHIFT = 2  # buckets of the next level are 2^_SHIFT times as large
_PER_LIST = 8  # entries that take as much memory as what else is kept of a list
_POINTS_PER_LIST = 4
_FEW_PAIRS = 1 << 21  # of a point and a cone: for at most so many smaller buckets do not pay
_BUCKETS_AT_ONCE = 1 << 12
_PAIRS_AT_ONCE = 1 << 20
_TESTS_AT_ONCE = 1 << 22
_SUBCELL_BITS = 2
_SUBCELLS = 1 << _SUBCELL_BITS  # points are sorted into this many parts of a bucket along each axis
_TABLE, _CELLS_PER_POINT = 1 << 21, 4  # smallest buckets of which a table is made, at most, for many points
_MISSING, _OUTSIDE = -1, -2  # instead of a list's number: it is not made; no cone reaches the bucket


class ConeIndex:
    """Lists of cones, one for each bucket, made for the buckets that are asked about, and kept.

    What is kept is bounded in proportion to the number of cones; lists that were not used for the longest
    time go first. The cost of a query depends on the cones near its points; only the largest buckets, whose
    lists are kept like the others, are compared with the boxes of all cones.

    Args:
        cones: or the `PointTable.rows` of them, which are not copied. They must not change afterwards;
            gradients do not pass through the index.
        extent: side (m) of the largest box that is queried.
        cutoff: Mahalanobis distance beyond which a component gives no evidence.
        smoothed: True for the point form, which widens cones by the spread of the cube (see `PointForm`);
            False for boxes that meet the cones themselves.
        smallest: the lists of the smallest buckets serve always, which pays for many queries about the same
            places. False: a larger bucket's list serves its points if there are few.
        share: of the least number of entries that are kept, if other indices need memory, too.

    Attributes:
        lists: the kept lists; queries append to them, or drop the oldest.
        side: of the smallest buckets, metres. At level k, buckets are 4^k times as large.
    """

    def __init__(
        self,
        cones: Cones | Tensor,
        extent: float,
        cutoff: float = CUTOFF,
        smoothed: bool = False,
        smallest: bool = False,
        share: float = 1.0,
    ) -> None:
        self.extent = check_resolution(extent)
        self._options = self.extent, cutoff, smoothed
        self._smallest, self._share = smallest, share
        cones = cones if isinstance(cones, Tensor) else cones.checked()
        self.hulls = Hulls(cones, self.extent, cutoff, smoothed)
        self.dim = self.hulls.dim
        self._set_lattice()

    def _set_lattice(self) -> None:
        """Chooses the buckets for the present hulls, and drops all lists."""
        hulls, n_cones = self.hulls, len(self.hulls.table)
        self._n_chosen = n_cones  # the side is chosen for so many
        self.origin = hulls.low.amin(0) if n_cones else hulls.low.new_zeros(self.dim)
        span = float((hulls.high.amax(0) - self.origin).amax()) * (1 + 1e-9) if n_cones else 0.0
        # The finest buckets whose coordinates fit the bits of the key, with room to grow.
        finest = max(self.extent, span / (self._limit - 1))
        self.side = _chosen_side(hulls, finest, span, _ENTRIES_PER_CONE[self.dim])
        self._n_levels = 1 + math.ceil(math.log2(max(span / self.side, 1.0)) / _SHIFT)
        self._set_box()
        self._drop_all()

    def replaced(self, cones: Cones | Tensor, former: Tensor) -> ConeIndex:
        """The index of other cones. It keeps the lists of buckets that no new cone, and none that is gone,
        can reach; none if there are too many new cones for the size of the buckets.

        Args:
            cones: C cones, or their rows, as for `ConeIndex`; must not change afterwards.
            former: (C,) the number of each cone in this index, −1 for a new one. The other numbers ascend.
        """
        made, table = copy.copy(self), cones.detach() if isinstance(cones, Tensor) else None
        is_new, stays = former < 0, torch.zeros_like(self.hulls.low[:, 0], dtype=torch.bool)
        stays[former[~is_new]] = True
        given = cones[is_new] if isinstance(cones, Tensor) else cones.checked().taken(is_new)
        new = Hulls(given, *self._options)
        made.hulls = self.hulls.replaced(former, new, table)
        corners = (torch.cat([new.low, new.high]) - self.origin) / self.side
        is_far = bool((corners.abs() > self._limit).any())
        if is_far or len(former) > 2 * self._n_chosen:
            made._set_lattice()
            return made
        made._set_box()
        if bool(is_new.all()):
            made._drop_all()
            return made
        gone = self.hulls.taken(~stays)
        kept = torch.ones_like(self._used, dtype=torch.bool)
        for hulls in (new, gone):
            probe = copy.copy(self)
            probe.hulls = hulls
            probe._drop_all()
            for level in reversed(range(self._n_levels)):
                keys, numbers = self._buckets[level]
                found = probe._numbered(level, self._unpack(keys))
                kept[numbers[probe.lists.lengths()[found] > 0]] = False
        made._keep(kept)
        if len(gone.low) and len(made.lists.entries):
            number = torch.full_like(stays, -1, dtype=torch.int32)
            number[former[~is_new]] = (~is_new).nonzero().squeeze(1).int()
            made.lists.entries.copy_(number[made.lists.entries])
        return made

    def _set_box(self) -> None:
        """Sets the smallest buckets that cones reach, and one more at each end: along each axis the first of
        them, and how many they are."""
        if not len(self.hulls.low):
            return
        ends = torch.stack([self.hulls.low.amin(0), self.hulls.high.amax(0)])
        first, last = ((ends - self.origin) / self.side).floor().long().tolist()
        self._box = [a - 1 for a in first], [b - a + 3 for a, b in zip(first, last, strict=True)]

    def _drop_all(self) -> None:
        none = torch.zeros(0, dtype=torch.int64, device=self.hulls.table.device)
        self._buckets = [(none, none)] * self._n_levels  # of each level, sorted keys and the buckets' lists
        self._used, self._now = none, 0  # when each list was used last
        self._levels = none  # of the bucket of each list
        self._asked = none  # points that each list served
        self._buffer = none.int()  # begins with the entries of the lists
        self._table: Tensor | None = None  # of the smallest buckets of the box: the list of each
        self.lists = Lists.of(none, self._buffer)

    def _keep(self, kept: Tensor) -> None:
        """Drops the lists (n,) that are not kept."""
        lengths = self.lists.lengths()
        self._buffer = self.lists.entries[torch.repeat_interleave(kept, lengths)]
        self.lists = Lists.of(lengths[kept], self._buffer)
        self._used, self._levels, self._asked = (v[kept] for v in (self._used, self._levels, self._asked))
        rank, buckets = kept.cumsum(0) - 1, []
        for keys, numbers in self._buckets:
            stays = kept[numbers]
            buckets.append((keys[stays], rank[numbers[stays]]))
        self._buckets, self._table = buckets, None

    def _make_room(self) -> None:
        """Drops lists that were not used for the longest time, if there are more than the bound."""
        most = max(int(_KEPT * self._share), _KEPT_PER_CONE * len(self.hulls.table))
        sizes = self.lists.lengths() + _PER_LIST
        if int(sizes.sum()) <= most:
            return
        newest = argsort(-self._used)
        kept = torch.zeros_like(self._used, dtype=torch.bool)
        kept[newest[sizes[newest].cumsum(0) <= most // 2]] = True
        self._keep(kept)

    def _add(self, level: int, cells: Tensor, lists: Lists) -> Tensor:
        """Keeps the lists (n,) of new buckets with these coordinates (n, D), and returns their numbers."""
        n_lists, n_entries, n_added = len(self._used), len(self.lists.entries), len(lists.entries)
        if n_entries + n_added > len(self._buffer):
            self._buffer = torch.cat([self.lists.entries, lists.entries.new_empty(n_entries // 2 + n_added)])
        self._buffer[n_entries : n_entries + n_added] = lists.entries
        starts = torch.cat([self.lists.starts, n_entries + lists.starts[1:]])
        self.lists = Lists(starts, self._buffer[: n_entries + n_added])
        self._used = torch.cat([self._used, torch.full_like(cells[:, 0], self._now)])
        self._levels = torch.cat([self._levels, torch.full_like(cells[:, 0], level)])
        self._asked = torch.cat([self._asked, torch.zeros_like(cells[:, 0])])
        added = torch.arange(n_lists, n_lists + len(cells), device=cells.device)
        keys, numbers = self._buckets[level]
        keys, numbers = torch.cat([keys, self._pack(cells)]), torch.cat([numbers, added])
        order = argsort(keys)
        self._buckets[level], self._table = (keys[order], numbers[order]), None
        return added

    def _numbered(self, level: int, cells: Tensor) -> Tensor:
        """The lists (B,) of distinct buckets with these coordinates (B, D); makes those that are missing."""
        number = self._find(level, self._pack(cells))
        missing = (number < 0).nonzero().squeeze(1)
        self._used[number[number >= 0]] = self._now
        if not len(missing):
            return number
        hulls, side = self.hulls, self.side * (1 << _SHIFT * level)
        if level + 1 == self._n_levels:
            low = self.origin + cells[missing] * side
            boxes = zip(low, low + side, strict=True)
            met = [((hulls.low <= b) & (hulls.high >= a)).all(1).nonzero().squeeze(1).int() for a, b in boxes]
            lengths = cells.new_tensor([len(cones) for cones in met])
            number[missing] = self._add(level, cells[missing], Lists.of(lengths, torch.cat(met)))
            return number
        owner, n_owners = dense_ranks(self._pack(cells[missing] >> _SHIFT))
        order = argsort(owner)
        missing, owner = missing[order], owner[order]
        parents = cells.new_zeros(n_owners, self.dim)
        parents[owner] = cells[missing] >> _SHIFT
        lists = self._numbered(level + 1, parents)[owner]
        centers = self.origin + (cells[missing] + 0.5) * side
        radii = torch.full_like(centers[:, 0], 0.5 * side * self.dim**0.5)
        made = hulls.near(self.lists, lists, centers, radii)
        number[missing] = self._add(level, cells[missing], made)
        return number

    @property
    def _limit(self) -> int:
        """Largest coordinate of a bucket that is asked, or of its negative; its neighbours have keys."""
        return (1 << (_KEY_BITS[self.dim] - 1)) - (2 << _SHIFT)

    def _pack(self, cell: Tensor) -> Tensor:
        bits = _KEY_BITS[self.dim]
        cell = cell + (1 << (bits - 1))
        key = cell[:, 0]
        for axis in range(1, self.dim):
            key = key << bits | cell[:, axis]
        return key

    def _unpack(self, keys: Tensor) -> Tensor:
        bits = _KEY_BITS[self.dim]
        parts = [keys >> bits * axis & ((1 << bits) - 1) for axis in reversed(range(self.dim))]
        return torch.stack(parts, 1) - (1 << (bits - 1))

    def _find(self, level: int, key: Tensor) -> Tensor:
        """The list (B,) of each bucket with these keys (B,), −1 if there is none yet."""
        keys, numbers = self._buckets[level]
        if not len(keys):
            return torch.full_like(key, _MISSING)
        place = torch.searchsorted(keys, key).clamp_max_(len(keys) - 1)
        return torch.where(keys[place] == key, numbers[place], _MISSING)

    def parts(self, points: Tensor, bounded: bool = True) -> Iterator[tuple[Tensor, Tensor]]:
        """Parts of points (M, D): their rows (R,), in an order in which neighbours follow each other; and, at
        these rows of (M,), the list in `lists` of all cones that can give evidence to each. Later parts
        change both: use them part by part. Points that are in no part have no evidence.

        bounded: False keeps the lists of all these points, beyond the bound.
        """
        if not len(self.hulls.table):
            return
        self._now += 1
        if bounded:
            self._make_room()
        cells, part = self._places(points)
        number = self._lists_at(cells)
        if len(self._used):
            self._used.index_fill_(0, number.clamp_min(0), self._now)
        missing = (number == _MISSING).nonzero().squeeze(1)
        cell = torch.stack([axis[missing] for axis in cells], 1)
        rank, n_missing = dense_ranks(self._pack(cell))
        cell = cell.new_zeros(n_missing, self.dim).index_copy_(0, rank, cell)
        if n_missing <= _BUCKETS_AT_ONCE:
            if n_missing:
                number[missing] = self._serving(cell, rank)
            yield self._in_order(number, part), number
            return
        yield self._in_order(number, part), number
        chunk = rank // _BUCKETS_AT_ONCE
        chunks = argsort(chunk).split(torch.bincount(chunk).tolist())
        for chosen, some in zip(chunks, cell.split(_BUCKETS_AT_ONCE), strict=True):
            if bounded:
                self._make_room()
            rows = missing[chosen]
            number[rows] = served = self._serving(some, rank[chosen] % _BUCKETS_AT_ONCE)
            yield rows[self._in_order(served, part[rows])], number

    def _places(self, points: Tensor) -> tuple[list[Tensor], Tensor]:
        """Coordinates (M,) of the smallest bucket of points (M, D) along each axis, and the part (M,) of the
        bucket. Points outside the box of the cones are in the buckets around it."""
        cells, part = [], torch.zeros_like(points[:, 0], dtype=torch.int64)
        for axis, (first, n_cells) in enumerate(zip(*self._box, strict=True)):
            place = (points[:, axis].detach().double() - self.origin[axis]).div_(self.side / _SUBCELLS)
            place = place.floor_().clamp_(first * _SUBCELLS, (first + n_cells) * _SUBCELLS - 1).long()
            cells.append(place >> _SUBCELL_BITS)
            part = part << _SUBCELL_BITS | place & _SUBCELLS - 1
        return cells, part

    def _lists_at(self, cells: list[Tensor]) -> Tensor:
        """The list (M,) of the smallest buckets with these coordinates (M,) along each axis, or `_MISSING`,
        or `_OUTSIDE` the box of the cones."""
        firsts, sizes = self._box
        n_cells = math.prod(sizes)
        if self._table is None and n_cells <= min(_TABLE, _CELLS_PER_POINT * len(cells[0])):
            self._table = torch.full(sizes, _OUTSIDE, device=self.origin.device)
            self._table[(slice(1, -1),) * self.dim] = _MISSING
            keys, numbers = self._buckets[0]
            known = self._unpack(keys) - keys.new_tensor(firsts)
            inside = ((known >= 1) & (known < keys.new_tensor(sizes) - 1)).all(1)
            self._table[known[inside].unbind(1)] = numbers[inside]
        place, edge = torch.zeros_like(cells[0]), torch.zeros_like(cells[0], dtype=torch.bool)
        if self._table is not None:
            for cell, first, size in zip(cells, firsts, sizes, strict=True):
                place = place.mul_(size).add_(cell).sub_(first)
            return self._table.view(-1).index_select(0, place)
        for cell, first, size in zip(cells, firsts, sizes, strict=True):
            edge |= (cell == first) | (cell == first + size - 1)
        return torch.where(edge, _OUTSIDE, self._find(0, self._pack(torch.stack(cells, 1))))

    def _in_order(self, number: Tensor, part: Tensor) -> Tensor:
        """Rows (R,) of the points that have a list `number` (M,) with entries, by list, then by `part`."""
        none = torch.zeros(-min(_MISSING, _OUTSIDE), dtype=torch.bool, device=number.device)
        listed = torch.cat([self.lists.lengths() > 0, none])[number]  # negative numbers count from the end
        key = (number + 1 << _SUBCELL_BITS * self.dim | part) * listed
        return argsort(key)[len(key) - int(listed.count_nonzero()) :]

    def _serving(self, cells: Tensor, rank: Tensor) -> Tensor:
        """The list (R,) that serves each point, in the bucket with number `rank` (R,) among `cells` (B, D).

        Lists are made from those of the largest buckets on, as long as there are enough points: with those of
        earlier queries, so that places that are asked again and again get small buckets.
        """
        if self._smallest:  # with their neighbours, where the next points will be
            parents = torch.unique(cells >> _SHIFT, dim=0) << _SHIFT
            steps = torch.cartesian_prod(*[torch.arange(1 << _SHIFT, device=cells.device)] * self.dim)
            self._numbered(0, (parents[:, None] + steps).flatten(0, 1))
            return self._numbered(0, cells)[rank]
        groups, owners = [cells], []
        n_points = [torch.bincount(rank, minlength=len(cells))]
        n_children = [torch.zeros_like(cells[:, 0])]
        for _ in range(1, self._n_levels):
            cell = groups[-1] >> _SHIFT
            owner, n_groups = dense_ranks(self._pack(cell))
            groups.append(cell.new_zeros(n_groups, self.dim).index_copy_(0, owner, cell))
            owners.append(owner)
            n_points.append(torch.zeros_like(groups[-1][:, 0]).index_add_(0, owner, n_points[-1]))
            n_children.append(torch.bincount(owner, minlength=n_groups))
        number = self._numbered(self._n_levels - 1, groups[-1])
        divided = torch.ones_like(number, dtype=torch.bool)
        for level in reversed(range(self._n_levels - 1)):
            weight = n_points[level + 1] + self._asked[number]
            if int((self.lists.lengths()[number] * weight * divided).sum()) <= _FEW_PAIRS * self._share:
                for owner in reversed(owners[: level + 1]):
                    number = number[owner]
                break
            owner = owners[level]
            divided = (divided & (weight >= _POINTS_PER_LIST * n_children[level + 1]))[owner]
            number = number[owner]
            asked = divided.nonzero().squeeze(1)
            number[asked] = self._numbered(level, groups[level][asked])
        self._asked.index_add_(0, number, n_points[0])
        return number[rank]

    def buckets(self, points: Tensor) -> Tensor:
        """The list (M,) in `lists` of all cones that can give evidence to each point (M, D); −1 where there
        is none. Valid until the next query."""
        found = torch.full(points.shape[:1], -1, dtype=torch.int64, device=points.device)
        for rows, number in self.parts(points, bounded=False):
            found[rows] = number[rows]
        return found

    def candidates(self, low: Tensor, high: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
        """Chunks of pairs, box (P,) and cone (P,): all cones whose hull meets a box [low, high], (M, D) each.

        Each pair occurs once, and all pairs of a box follow each other in one chunk.

        Raises `InvalidArgumentError` for boxes larger than `extent`.
        """
        low, high = low.detach().double(), high.detach().double()
        if low.numel() and float((high - low).amax()) > self.extent * (1 + 1e-9) + 1e-9:
            raise InvalidArgumentError(
                f"A box of {float((high - low).amax()):.4g} m is larger than the index's "
                f"extent={self.extent:.4g} m; make the index with the extent of the largest box."
            )
        center = 0.5 * (low + high)
        for rows, number in self.parts(center):
            bucket = number[rows]
            for part in chunks_of(self.lists.lengths()[bucket], _PAIRS_AT_ONCE):
                boxes = rows[part]
                found = self.hulls.near(
                    self.lists, bucket[part], center[boxes], torch.zeros_like(center[boxes, 0])
                )
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

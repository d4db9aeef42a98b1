"""Batches as an adaptive binary code: each value is predicted from the components before it; docs/formats.md.

A slot of the `range_coder` is one bit of one field in one context, such as "the smallest deviation differs
from that of the neighbours". The model uses whole numbers, and sums, products and quotients of doubles, which
every machine rounds equally: a batch is read with the chances with which it was written.

The fused kernel does the work. This twin defines it, and takes about 100 times as long.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

import numpy as np
import torch

from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.kernels import ChanceTables, CodedBatch, context_coding, is_fused
from gmmtorch.mapping.codec.context_chances import CHANCES, OF_COARSE
from gmmtorch.mapping.codec.lattice import (
    AXIS_ORDERS,
    LARGEST_DEVIATION,
    LARGEST_RATIO,
    LEAST_DEVIATION,
    STEEPEST,
)
from gmmtorch.mapping.codec.quantization import LARGEST_COUNT, LEAST_SHARE, NO_COUNT, ORIGIN_STEP, offset_of
from gmmtorch.mapping.codec.range_coder import NUMBER, RangeCoder, copied, first_chances

_NEIGHBOURS = 64  # components before a component among which its neighbours are searched
_MOST_LEVELS = 52
_TOO_SLOW = -2  # of the fused kernel
_HERE = torch.empty(0)  # on the CPU

FIELDS = {
    "FLAG": (4, 1),
    "LEVEL": (3, NUMBER),
    "DIGIT": (8, 8),
    "LOWER": (12, 1),
    "ORDER": (26, 8),
    "WIDE": (4, NUMBER),
    "RATIO": (12, NUMBER),
    "THIN": (8, NUMBER),
    "TURN": (16, NUMBER),
    "TILT": (56, NUMBER),
    "SLOPE": (84, NUMBER),
    "ACROSS": (64, NUMBER),
    "COUNT": (4, NUMBER),
    "VIEWS": (8, NUMBER),
    "RANK": (4, NUMBER),
    "SHARE": (4, NUMBER),
    "ORIGIN": (6, NUMBER),
    "ROBOT": (2, NUMBER),
    "NUMBER": (2, NUMBER),
    "EYE": (2, NUMBER),
}
"""Contexts of each field, and slots of each context; the last one is of coarse batches."""
_OF_SPHERES = {"TILT": 14, "SLOPE": 21, "ACROSS": 8}
"""Further contexts in coarse batches."""


def write_batch(batch: CodedBatch) -> bytes:
    """The batch as bytes, without zeros at their end. Raises `InvalidArgumentError` for ids beyond 2^60."""
    size = 256 + 96 * len(batch.count) + 24 * (len(batch.origins) + len(batch.seen_from))
    stream = np.zeros(size, np.uint8)
    try:
        if is_fused(_HERE):
            n = context_coding(batch, copied(first_tables(batch.coarse)), stream, writes=True)
            if n == _TOO_SLOW:
                raise InvalidArgumentError(
                    f"{len(batch.count)} components have viewpoints that are farther than thousands of the "
                    f"{len(batch.origins)} origins, which takes too long to read; merge components, or write "
                    'codec="float".'
                )
            _require(n >= 0)
            return stream[:n].tobytes().rstrip(b"\0")
        writer = RangeCoder(first_tables(batch.coarse))
        _Walk(writer, batch).run()
        return writer.to_bytes().rstrip(b"\0")
    except DataError as error:
        low, high = int(batch.ids.min()), int(batch.ids.max())
        raise InvalidArgumentError(
            f"ids reach from {low} to {high}; numbers up to 2^60 are stored."
        ) from error


def read_batch(batch: CodedBatch, data: bytes) -> None:
    """Read what `write_batch` wrote into a batch of zeros of the same sizes; the viewpoints of a component
    are nearest first. Raises `DataError` for other bytes, as a batch has one form, and for those that take
    more time than a batch of that length may; the twin does not bound its time."""
    if is_fused(_HERE):
        stream = np.frombuffer(data or b"\0", np.uint8)
        _require(context_coding(batch, copied(first_tables(batch.coarse)), stream, writes=False) >= 0)
    else:
        _Walk(RangeCoder(first_tables(batch.coarse), data), batch).run()
    _require(write_batch(batch) == data.rstrip(b"\0"))


@functools.cache
def first_tables(coarse: bool) -> ChanceTables:
    """The tables before the first bit."""
    more = _OF_SPHERES if coarse else {}
    fields = list(FIELDS.items())[: len(FIELDS) if coarse else -1]
    sizes = [(contexts + more.get(name, 0)) * slots for name, (contexts, slots) in fields]
    return first_chances(OF_COARSE if coarse else CHANCES, sizes)


class _Walk:
    """Walks through the components of a batch, each value in place: written, or read into arrays of zeros.

    Contexts and predictions are stated in docs/formats.md.
    """

    def __init__(self, coder: RangeCoder, batch: CodedBatch) -> None:
        self._first = dict(zip(FIELDS, coder.first, strict=False))
        self.c, self.b, self.dim, self.side = coder, batch, batch.dim, batch.side
        self.places, self.normals = np.zeros(batch.mean.shape), np.zeros(batch.mean.shape)
        self.offset = offset_of(self.side)
        # Lists of Python numbers, which are faster one by one than arrays.
        self.v = {
            name: value.tolist() for name, value in vars(batch).items() if isinstance(value, np.ndarray)
        }
        self.last, self.unit = self.dim - 1, 1 + batch.coarse
        self.eye, self.eye_at = [0.0] * self.dim, 0  # the last only origin of a component, and its index
        self.is_round = False  # whether the component is near a sphere around its only origin
        self.radius = 0.0  # of that sphere; 0: not known

    def run(self) -> None:
        v = self.v
        for i in range(len(v["count"])):
            self._id(i)
        for i in range(len(v["origins"])):
            self._origin(i)
        self._origins = np.array(v["origins"], np.float64).reshape(-1, self.dim) * ORIGIN_STEP
        self._look_from(0)
        begin = 0
        for i in range(len(v["count"])):
            has_eye = self._only_eye(i, begin)
            near = self._component(i, has_eye)
            begin = begin + 1 if has_eye else self._viewpoints(i, near, begin)
        _require(begin == len(v["seen_from"]))
        if not self.c.writes:
            for name, values in v.items():
                found = getattr(self.b, name)
                found[...] = np.array(values, np.int64).reshape(found.shape)

    def _slots(self, field: str, context: int, size: int = NUMBER) -> int:
        return self._first[field] + context * size

    def _id(self, i: int) -> None:
        ids = self.v["ids"]
        same = i > 0 and bool(self.c.bit(self._slots("ROBOT", 1), int(ids[i][0] == ids[i - 1][0])))
        ids[i][0] = ids[i - 1][0] if same else self.c.whole(self._slots("ROBOT", 0), ids[i][0])
        after = ids[i - 1][1] + 1 if same else 0
        ids[i][1] = after + self.c.whole(self._slots("NUMBER", int(same)), ids[i][1] - after)
        _require(max(map(abs, ids[i])) <= 1 << 61)

    def _origin(self, i: int) -> None:
        own = self.v["origins"][i]
        for a in range(self.dim):
            before = self.v["origins"][i - 1][a] if i > 0 else 0
            own[a] = before + self.c.whole(self._slots("ORIGIN", a + 3 * (i > 0)), own[a] - before)
            _require(abs(own[a]) <= 1 << 36)

    def _cell(self, i: int, flag: int) -> None:
        """The cell of a mean: the level at which it leaves the block of the cell before, then its place."""
        c, v, dims = self.c, self.v, range(self.dim)
        if i > 0:
            before = [x + self.offset for x in v["cells"][i - 1]]
        elif v["origins"]:
            shift = self.side + 8
            before = [(x >> shift if shift >= 0 else x << -shift) + self.offset for x in v["origins"][0]]
        else:
            before = [self.offset] * self.dim
        now = [x + self.offset for x in v["cells"][i]]
        apart = max((x ^ y).bit_length() for x, y in zip(before, now, strict=True)) if c.writes else 0
        level = c.number(self._slots("LEVEL", flag if i > 0 else 2), apart)
        _require(level <= _MOST_LEVELS)
        corner, width = [x >> level << level for x in before], [1 << level] * self.dim
        if level > 0:
            old, digit = 0, 0
            for a in dims:
                old = old << 1 | before[a] >> (level - 1) & 1
                digit = digit << 1 | now[a] >> (level - 1) & 1
            digit = c.tree(self._slots("DIGIT", old, 8), self.dim, digit)
            _require(digit != old)
            width = [1 << (level - 1)] * self.dim
            corner = [x + (digit >> (self.last - a) & 1) * width[a] for a, x in enumerate(corner)]
        corner = [x - self.offset for x in corner]
        for at in range(level - 2, -1, -1):
            for a in dims:
                context = self._halving(i - 1, corner, width, a) + 6 * (level >= 4)
                width[a] >>= 1
                corner[a] += c.bit(self._slots("LOWER", context, 1), now[a] >> at & 1) * width[a]
        v["cells"][i] = corner
        _require(max(map(abs, corner)) <= 2.0 * 134217728.0 * math.ldexp(1, -self.side))

    def _halving(self, j: int, corner: Sequence[int], width: Sequence[int], a: int) -> int:
        """Which half of a block along axis a is nearer to the plane of component j: 0, the lower one, to 4;
        5: it has no plane."""
        if j < 0 or self.v["deviation"][j][-2] - self.v["deviation"][j][-1] < 4:
            return 5
        n, m, side = self.normals[j].tolist(), self.places[j].tolist(), math.ldexp(1, self.side)
        if abs(n[a]) < 0.25:
            return 5
        apart = 0.0
        for x in range(self.dim):
            apart = apart + n[x] * ((corner[x] + 0.5 * width[x]) * side - m[x])
        quarter = n[a] * (0.25 * width[a] * side)
        nearer, most = abs(apart - quarter) - abs(apart + quarter), 2.0 * abs(quarter)
        if nearer < -0.25 * most:
            return int(nearer >= -0.75 * most)
        return 2 if nearer <= 0.25 * most else 3 if nearer <= 0.75 * most else 4

    def _neighbours(self, i: int) -> tuple[int, int, float]:
        """Of the components before i, the two nearest to its cell, and the squared distance (m²) of one."""
        first = max(i - _NEIGHBOURS, 0)
        if i == 0:
            return 0, 0, math.inf
        apart = np.zeros(i - first)
        for a in range(self.dim):
            x = self.places[first:i, a] - (self.v["cells"][i][a] + 0.5) * math.ldexp(1, self.side)
            apart = apart + x * x
        order = np.argsort(apart, kind="stable")[:2].tolist()
        return first + order[0], first + order[-1], float(apart[order[0]])

    def _whole(self, slots: int, value: int, side: int = 0) -> int:
        """A whole number of units."""
        return self.unit * self.c.whole(slots, value // self.unit, side)

    def _number(self, slots: int, value: int) -> int:
        return self.unit * self.c.number(slots, value // self.unit)

    def _deviations(self, i: int, j: int, k: int, flag: int) -> None:
        last, unit = self.last, self.unit
        x, y, d = (self.v["deviation"][t] for t in (j, k, i))
        if i == 0:
            d[0] = self._whole(self._slots("WIDE", 2 + flag), d[0])
            if self.dim == 3:
                d[1] = d[0] - self._number(self._slots("RATIO", 10 + flag), d[0] - d[1])
            d[last] = d[last - 1] - self._number(self._slots("THIN", 6 + flag), d[last - 1] - d[last])
        else:
            wide = (x[0] + y[0]) // (2 * unit) * unit
            d[0] = wide + self._whole(self._slots("WIDE", flag), d[0] - wide)
            if self.dim == 3:
                ratio = (x[0] - x[1] + y[0] - y[1]) >> 2
                d[1] = d[0] - self._number(self._slots("RATIO", flag * 5 + min(ratio, 4)), d[0] - d[1])
            thin = min((x[last] + y[last]) // (2 * unit) * unit, d[last - 1])
            slots = self._slots("THIN", flag * 3 + min(abs(x[last] - y[last]) // 3, 2))
            d[last] = thin + self._whole(slots, d[last] - thin, int(thin == d[last - 1]))
        _require(max(d) <= LARGEST_DEVIATION and min(d) >= LEAST_DEVIATION and d == sorted(d, reverse=True))
        _require(d[0] - d[last] <= LARGEST_RATIO)

    def _look_from(self, origin: int) -> None:
        self.eye_at = origin
        if origin < len(self._origins):
            self.eye = self._origins[origin].tolist()

    def _only_eye(self, i: int, begin: int) -> bool:
        """Code whether component i has one viewpoint, `begin`, and then which: most often that of the
        component before."""
        c, v, n = self.c, self.v, len(self.v["origins"])
        if not self.b.coarse or n == 0 or begin >= len(v["seen_from"]):
            return False
        seen = v["seen_from"][begin] if c.writes else 0
        is_one = c.writes and v["n_viewpoints"][i] == 1
        slot = self._slots("EYE", 0)
        if not c.bit(slot, int(is_one and seen == self.eye_at)):
            if not c.bit(slot + 1, int(is_one)):
                return False
            ahead = c.number(self._slots("EYE", 1), (seen - self.eye_at - 1) % n)
            _require(ahead < n - 1)
            self._look_from((self.eye_at + 1 + ahead) % n)
        v["n_viewpoints"][i], v["seen_from"][begin], v["share"][begin] = 1, self.eye_at, 0
        return True

    def _component(self, i: int, has_eye: bool) -> int:
        """Code a component; returns its nearest neighbour. has_eye: whether it has one viewpoint."""
        c, v, last = self.c, self.v, self.last
        flags, orders = v["max_range"], v["axis_order"]
        before = 2 * (flags[i - 1] if i > 0 else 0) + (flags[i - 2] if i > 1 else 0)
        flag = flags[i] = c.bit(self._slots("FLAG", before, 1), flags[i])
        self.is_round = self.dim == 3 and flag == 1 and has_eye
        self._cell(i, flag)
        j, k, apart = self._neighbours(i)
        context = (flag * 2 + (orders[j] == orders[k])) * 6 + orders[j] if i > 0 else 24 + flag
        orders[i] = c.tree(self._slots("ORDER", context, 8), 3 if self.dim == 3 else 1, orders[i])
        _require(orders[i] < len(AXIS_ORDERS[self.dim]))
        axis = AXIS_ORDERS[self.dim][orders[i]].tolist()
        self._deviations(i, j, k, flag)
        d = v["deviation"][i]
        if self.is_round:
            self._mean(i, j, flag, axis, apart, None, [0.0, 0.0], 0)
            ray = [float(x) - o for x, o in zip(self.places[i], self.eye, strict=True)]
            squares = 0.0
            for x in ray:
                squares = squares + x * x
            distance = math.sqrt(squares)
            self.radius = distance + _sagitta(d, distance) if distance > 0 else 0.0
            own, _ = self._shears(i, j, flag, self._slopes(ray, axis))
        else:
            near = i > 0 and apart < 64.0 * math.ldexp(1, 2 * (d[0] // 4))
            given = self._plane(i, j, axis) if near else None
            own, off = self._shears(i, j, flag, given)
            self._mean(i, j, flag, axis, apart, given, own, off)
        self.normals[i, axis[last]] = 1.0
        for a in range(last):
            self.normals[i, axis[a]] = -own[a]
        self._count(i, j, k, flag)
        return j

    def _step(self, d: int) -> int:
        """log2 of the step of a mean with this deviation, or of a shear with this ratio of deviations."""
        return d // 4 - 2 + 2 * self.b.coarse

    def _mean(
        self,
        i: int,
        j: int,
        flag: int,
        axis: Sequence[int],
        apart: float,
        given: list[float] | None,
        own: list[float],
        off: int,
    ) -> None:
        """Code the mean in its cell: freely along the component; across it near the plane of component j, or
        the sphere."""
        c, v, last, d = self.c, self.v, self.last, self.v["deviation"][i]
        side, size = math.ldexp(1, self.side), math.ldexp(1, 2 * (d[0] // 4))
        across, squares = float(self.places[j, axis[last]]), 0.0
        for a in range(self.dim):
            exponent, where = self._step(d[a]), v["cells"][i][axis[a]]
            width, coarser = max(self.side - exponent, 0), max(exponent - self.side, 0)
            _require(where & (1 << coarser) - 1 == 0)
            base = where >> coarser << width
            inside = v["mean"][i][a] - base if c.writes else 0
            is_guessed = self.radius > 0 if self.is_round else given is not None
            if a == last and is_guessed and width > 0:
                corner, top = where * side, (1 << width) - 1
                if self.is_round:
                    near, o = self.radius - _sagitta(d, self.radius), self.eye[axis[a]]
                    rise = math.sqrt(max(near * near - squares, 0.0))
                    across = o + (-rise if corner + 0.5 * side < o else rise)
                wanted = math.floor((across - corner) * math.ldexp(1, -exponent) + 0.5)
                guess, is_in = min(max(wanted, 0), top), 0 <= wanted <= top
                far = sum(apart >= bound * size for bound in (1.0, 4.0, 9.0))
                context = ((flag * 2 + is_in) * 4 + far) * 4 + min(abs(off) // 3, 3)
                context = 64 + is_in * 4 + min(width, 3) if self.is_round else context
                edge = 0 if min(guess, top - guess) > 7 else 1 if guess < top - guess else 2
                inside = guess + c.whole(self._slots("ACROSS", context), inside - guess, edge)
                _require(0 <= inside <= top)
            else:
                inside = c.raw(width, inside)
            v["mean"][i][a] = base + inside
            place = (base + inside) * math.ldexp(1, exponent)
            self.places[i, axis[a]] = place
            squares = squares + (place - self.eye[axis[a]]) * (place - self.eye[axis[a]])
            if a < last and given is not None:
                across = across + 0.5 * (given[a] + own[a]) * (place - float(self.places[j, axis[a]]))

    def _plane(self, i: int, j: int, axis: Sequence[int]) -> list[float] | None:
        """The slopes of the plane of component j: of the last axis of i along its others; None if it has none
        or is too steep."""
        d, e = self.v["deviation"][i], self.v["deviation"][j]
        if e[-2] - e[-1] < 4 or d[-2] - d[-1] < 2:
            return None
        return self._slopes(self.normals[j].tolist(), axis)

    def _slopes(self, normal: Sequence[float], axis: Sequence[int]) -> list[float] | None:
        """Those on the plane with this normal."""
        upright = normal[axis[self.last]]
        if not abs(upright) > 0.25 * max(map(abs, normal)):
            return None
        slopes = [-normal[a] / upright for a in axis[: self.last]]
        return slopes if max(map(abs, slopes)) <= 2.0 else None

    def _shears(self, i: int, j: int, flag: int, given: list[float] | None) -> tuple[list[float], int]:
        """Code the shears; returns the slopes of the last axis, and how far they are from those given, in
        steps."""
        c, last, is_round = self.c, self.last, self.is_round
        d, e, shear = self.v["deviation"][i], self.v["deviation"][j], self.v["shear"][i]
        slopes, own, turn, off = given or [0.0, 0.0], [0.0, 0.0], 0.0, 0

        def value(pair: int, row: int, column: int) -> float:
            found = shear[pair] * math.ldexp(1, self._step(d[row] - d[column]))
            _require(abs(found) <= STEEPEST)
            return found

        if self.dim == 3:
            finer = -((d[1] - d[0]) // 4)
            shear[0] = c.whole(self._slots("TURN", flag * 8 + min(finer, 7)), shear[0])
            turn = value(0, 1, 0)
            step = self._step(d[2] - d[1])
            fine = min(-step // 2 + self.b.coarse, 6)
            about = math.floor(slopes[1] * math.ldexp(1, -step) + 0.5)
            context = fine if given is None else 7 + fine * 3 + min((e[1] - e[2]) // 6, 2)
            context = 56 + (given is not None) * 7 + fine if is_round else flag * 28 + context
            off = c.whole(self._slots("TILT", context), shear[2] - about, _side(about))
            shear[2] = about + off
            own[1] = value(2, 2, 1)
        step = self._step(d[last] - d[0])
        fine = min(-step // 2 + self.b.coarse, 6)
        about = math.floor((slopes[0] + own[1] * turn) * math.ldexp(1, -step) + 0.5)
        context = 84 if is_round else flag * 42 + (given is not None) * 21
        context += fine * 3 + min(abs(off) // 2, 2)
        pair = last - 1
        rest = c.whole(self._slots("SLOPE", context), shear[pair] - about, _side(about))
        shear[pair] = about + rest
        own[0] = value(pair, last, 0) - own[1] * turn
        return own, off if self.dim == 3 else rest

    def _count(self, i: int, j: int, k: int, flag: int) -> None:
        count, deviation = self.v["count"], self.v["deviation"]
        about = 0
        if i > 0:
            area = [sum(deviation[t][: self.last]) for t in (i, j, k)]
            both = count[j] + count[k]
            about = ((both - area[1] - area[2] >> 1) + area[0] + (both >> 1)) >> 1
        about = about // self.unit * self.unit
        count[i] = about + self._whole(self._slots("COUNT", flag + 2 * (i == 0)), count[i] - about)
        count[i] = NO_COUNT if count[i] == NO_COUNT - 1 and self.b.coarse else count[i]
        _require(NO_COUNT <= count[i] <= LARGEST_COUNT)

    def _viewpoints(self, i: int, j: int, begin: int) -> int:
        """Code the origins of component i by their rank among those left, by distance, and their shares."""
        c, v, n_origins = self.c, self.v, len(self.v["origins"])
        known = min(v["n_viewpoints"][j], 3) if i > 0 else 0
        n = v["n_viewpoints"][i] = c.number(
            self._slots("VIEWS", v["max_range"][i] * 4 + known), v["n_viewpoints"][i]
        )
        _require(n <= n_origins and begin + n <= len(v["seen_from"]))
        if n == 0:
            return begin
        distance = np.zeros(n_origins)
        for a in range(self.dim):
            x = self._origins[:, a] - self.places[i, a]
            distance = distance + x * x
        order = np.argsort(distance, kind="stable").tolist()
        place = {origin: rank for rank, origin in enumerate(order)}
        end, passed, is_largest = begin + n, -1, False
        rows = list(zip(v["seen_from"][begin:end], v["share"][begin:end], strict=True))
        rows.sort(key=lambda row: place[row[0]])
        found = []
        for q, (origin, share) in enumerate(rows):
            left, wanted = n_origins - 1 - passed, place[origin] - passed - 1
            _require(left >= n - q)
            rank = c.number(self._slots("RANK", min(n - q, 4) - 1), max(wanted, 0)) if left > n - q else 0
            _require(rank < left)
            if n > 1 and (q < n - 1 or is_largest):
                share = c.number(self._slots("SHARE", 2 * (n > 2) + is_largest), share)
            else:
                share = 0
            _require(share <= LEAST_SHARE)
            is_largest = is_largest or share == 0
            passed += 1 + rank
            found.append((order[passed], share))
        if not c.writes:
            v["seen_from"][begin:end], v["share"][begin:end] = map(list, zip(*found, strict=True))
        return end


def _sagitta(deviation: Sequence[int], distance: float) -> float:
    """By how much a component with this distance from the origin is before the sphere of its points."""
    return (math.ldexp(1, deviation[0] // 2) + math.ldexp(1, deviation[1] // 2)) / (2.0 * distance)


def _side(about: int) -> int:
    """The slot of the sign of what is coded relative to a guess."""
    return 0 if about == 0 else 1 if about > 0 else 2


def _require(valid: bool) -> None:
    if not valid:
        raise DataError("A value of a batch is out of range: it is damaged.")

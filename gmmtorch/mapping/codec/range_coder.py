"""An adaptive binary range coder: the twin of kernels/codes/range_coder.h.

It writes bits (Martin 1979), each with the chance of a 0 that its *slot* has learned from the bits that it
coded before. A slot is one bit of one field in one context.
"""

from __future__ import annotations

import base64
import itertools
import zlib
from collections.abc import Sequence

import numpy as np

from gmmtorch.errors import DataError
from gmmtorch.kernels import ChanceTables
from gmmtorch.mapping.codec.bitstream import Ints

ONE = 1 << 16
"""A chance of one."""
NUMBER = 32
"""Slots of a number."""
MOST_CODED = 120
"""Bits of a slot that count."""
_MOST_TRAINED = 12  # bits of a slot that count, of those from which its first chance comes
_LEAST_CHANCE = 64


def first_chances(packed: str, sizes: Sequence[int]) -> ChanceTables:
    """The tables before the first bit, of fields with these numbers of slots. packed: a byte for each slot,
    compressed, in base 85: the chance of a 0 in 1/256; 0: unknown."""
    text = base64.b85decode("".join(packed.split()))
    chances = np.array(list(zlib.decompress(text) if text else bytes(sum(sizes))))
    return ChanceTables(
        chances=np.where(chances == 0, ONE // 2, chances << 8).astype(np.int32),
        n_coded=np.where(chances == 0, 0, _MOST_TRAINED).astype(np.int32),
        rates=_rates(),
        first_slot=np.array([0, *itertools.accumulate(sizes[:-1])]),
    )


def copied(tables: ChanceTables) -> ChanceTables:
    """Tables for one stream, as its bits change them."""
    return tables._replace(chances=tables.chances.copy(), n_coded=tables.n_coded.copy())


def _rates() -> Ints:
    """How far a bit moves a slot that has coded 0 … `MOST_CODED` bits, in 1/65536."""
    return np.array([10 * ONE // (10 * n + 16) for n in range(MOST_CODED + 1)])


class RangeCoder:
    """Numbers as bits in slots: written, or read from `data`.

    Attributes:
        writes: whether a value that is given is written; otherwise it is unused.
        first: the first slot of each field.
    """

    def __init__(self, tables: ChanceTables, data: bytes | None = None) -> None:
        self.chances, self.n_coded = tables.chances.tolist(), tables.n_coded.tolist()
        self._rates, self.first = tables.rates.tolist(), tables.first_slot.tolist()
        self.writes, self._range = data is None, (1 << 32) - 1
        self._at = 4  # bytes written, with those of the range; or read
        self._data = data or b""
        # Where the range begins, of all bytes written; or how far above that the bytes read are.
        self._place = int.from_bytes(self._data[:4].ljust(4, b"\0"), "big")

    def bit(self, slot: int, value: int) -> int:
        """A bit; `value` is what a writer writes."""
        chance, n = self.chances[slot], self.n_coded[slot]
        bound = (self._range >> 16) * chance
        value = value if self.writes else int(self._place >= bound)
        self._move(bound if value else 0, self._range - bound if value else bound)
        moved = chance + (((0 if value else ONE) - chance) * self._rates[n] >> 16)
        self.chances[slot] = min(max(moved, _LEAST_CHANCE), ONE - _LEAST_CHANCE)
        self.n_coded[slot] = min(n + 1, MOST_CODED)
        return value

    def _move(self, step: int, width: int) -> None:
        """To the part of the range that begins after `step`, of this width; then to the next bytes."""
        self._place, self._range = self._place + (step if self.writes else -step), width
        while self._range < 1 << 24:
            self._range <<= 8
            following = self._data[self._at : self._at + 1]  # none at the end, where zeros are not written
            self._place = self._place << 8 | int.from_bytes(following, "big")
            self._place &= -1 if self.writes else 0xFFFFFFFF
            self._at += 1

    def to_bytes(self) -> bytes:
        """Of the numbers that say the same, the one with most zeros at its end."""
        last = self._place
        for n in range(1, 32):
            rounder = (self._place + (1 << n) - 1) >> n << n
            last = rounder if rounder < self._place + self._range else last
        return last.to_bytes(self._at, "big")

    def raw(self, n: int, value: int) -> int:
        """n bits without slots, highest first, eight at a time."""
        found = 0
        while n > 0:
            width = min(n, 8)
            n -= width
            size, most = self._range >> width, (1 << width) - 1
            part = value >> n & most if self.writes else min(self._place // size, most)
            self._move(part * size, size)
            found = found << width | part
        return found

    def tree(self, first: int, n: int, value: int) -> int:
        """n bits, each with a slot for every choice of the bits before it."""
        node = 1
        for i in range(n - 1, -1, -1):
            node = node << 1 | self.bit(first + node, value >> i & 1)
        return node - (1 << n)

    def number(self, first: int, value: int) -> int:
        """A number ≥ 0 below 2^60: the length of value + 1 in unary, then its other bits; the two highest of
        these have slots."""
        whole, length = value + 1, 0
        while self.bit(first + 4 + min(length, 11), int(whole >> (length + 1) != 0)):
            length += 1
            if length > 60:
                raise DataError("A number is too large: it is damaged.")
        found = 1
        if length > 0:
            found = 2 | self.bit(first + 15 + min(length, 8), whole >> (length - 1) & 1)
        if length > 1:
            slot = 24 + 2 * (length - 2) + (found & 1) if length < 5 else 30
            found = found << 1 | self.bit(first + slot, whole >> (length - 2) & 1)
        if length > 2:
            found = found << (length - 2) | self.raw(length - 2, whole & (1 << (length - 2)) - 1)
        return found - 1

    def whole(self, first: int, value: int, side: int = 0) -> int:
        """Any whole number. side: 0, 1 or 2, the slot of its sign."""
        if not self.bit(first, int(value != 0)):
            return 0
        negative = self.bit(first + 1 + side, int(value < 0))
        size = self.number(first, abs(value) - 1) + 1
        return -size if negative else size

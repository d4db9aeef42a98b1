"""Keys of records (the robot, its incarnation, and a number), and sets of keys stored as intervals.

A record's id is (robot, sequence), as a component's in a map; sequence = incarnation · 2²⁸ + number. A
robot draws a new incarnation whenever it starts, and numbers its records from 0. So it gives no id twice,
even if it lost its disk. Two of n incarnations are equal with probability n²/2²⁵: 3·10⁻⁶ for ten.

Here an id is one whole number, the key: robot · 2⁵² + sequence. An author is one incarnation of a robot, as
the number robot · 2²⁴ + incarnation.
"""

from __future__ import annotations

import secrets
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gmmtorch.errors import DataError, InvalidArgumentError

Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Intervals:
    """A set of 64-bit whole numbers. Memory is proportional to the number of intervals, not to their length.

    edges (2n,): strictly rising; the set has the numbers from edges[0] to edges[1] − 1, from edges[2] to
    edges[3] − 1, …. Intervals are sorted and do not touch, so equal sets have equal edges.
    """

    edges: Ints

    def __post_init__(self) -> None:
        edges = self.edges
        if edges.ndim != 1 or len(edges) % 2 or edges.dtype != np.int64 or (edges[1:] <= edges[:-1]).any():
            raise InvalidArgumentError(
                f"edges of shape {edges.shape} and {edges.dtype} must be pairs of int64 that rise strictly."
            )

    @classmethod
    def empty(cls) -> Intervals:
        return cls(np.zeros(0, np.int64))

    @classmethod
    def span(cls, begin: int, end: int) -> Intervals:
        """The numbers from `begin` to `end` − 1; the empty set unless `begin < end`."""
        return cls(np.array([begin, end] if begin < end else [], np.int64))

    @classmethod
    def of(cls, numbers: Ints) -> Intervals:
        """The set of these numbers (N,), in any order."""
        if not len(numbers):
            return cls.empty()
        rising = np.unique(numbers)
        breaks = np.flatnonzero(np.diff(rising) > 1)
        begins, lasts = rising[np.append(0, breaks + 1)], rising[np.append(breaks, len(rising) - 1)]
        return cls(np.stack([begins, lasts + 1], 1).reshape(-1).astype(np.int64))

    @classmethod
    def union(cls, sets: Iterable[Intervals]) -> Intervals:
        """The union of any number of sets, faster than repeated `|`."""
        parts = [one for one in sets if one]
        if len(parts) < 2:
            return parts[0] if parts else cls.empty()
        edges = np.concatenate([one.edges for one in parts]).reshape(-1, 2)
        begins, ends = edges[np.argsort(edges[:, 0])].T
        ends = np.maximum.accumulate(ends)
        is_first = np.ones(len(begins), np.bool_)
        is_first[1:] = begins[1:] > ends[:-1]
        is_last = np.append(is_first[1:], True)
        return cls(np.stack([begins[is_first], ends[is_last]], 1).reshape(-1))

    def __len__(self) -> int:
        """The number of intervals."""
        return len(self.edges) // 2

    @property
    def size(self) -> int:
        """The number of numbers."""
        return sum((self.edges[1::2] - self.edges[::2]).tolist())  # Python's integers do not overflow

    def up_to(self, most: int) -> Intervals:
        """The set; the empty set if it has more than `most` intervals."""
        return self if len(self) <= most else Intervals.empty()

    def pairs(self) -> list[tuple[int, int]]:
        """Begin and end (exclusive) of each interval."""
        return list(zip(self.edges[::2].tolist(), self.edges[1::2].tolist(), strict=True))

    def shifted(self, by: int) -> Intervals:
        """Each number plus `by`."""
        return Intervals(self.edges + by)

    def contains(self, numbers: Ints) -> NDArray[np.bool_]:
        """Which of the numbers (N,) are in the set: those with an odd number of edges at or below them."""
        return _inside(self.edges, numbers)

    def covers(self, other: Intervals) -> bool:
        """Whether the other set is a subset of this one."""
        return not (other - self)

    def __contains__(self, number: int) -> bool:
        return bool(self.edges.searchsorted(number, "right") % 2)

    def numbers(self) -> Ints:
        """All numbers (N,), rising."""
        begins, lengths = self.edges[::2], self.edges[1::2] - self.edges[::2]
        return np.arange(lengths.sum()) + np.repeat(begins + lengths - np.cumsum(lengths), lengths)

    # Often one set is large and the other small: only the part of the large one near the small one is
    # compared.

    def __or__(self, other: Intervals) -> Intervals:
        large, small = (self, other) if len(self) >= len(other) else (other, self)
        if not small:
            return large
        begin, end = large._range_near(small)
        places, in_large, in_small = _membership(large.edges[begin:end], small.edges)
        joined = _where(places, in_large | in_small)
        return Intervals(np.concatenate([large.edges[:begin], joined, large.edges[end:]]))

    def __and__(self, other: Intervals) -> Intervals:
        if not (self and other):
            return Intervals.empty()
        places, in_self, in_other = _membership(self._near(other), other._near(self))
        return Intervals(_where(places, in_self & in_other))

    def __sub__(self, other: Intervals) -> Intervals:
        if not (self and other):
            return self
        begin, end = self._range_near(other)
        places, in_self, in_other = _membership(self.edges[begin:end], other._near(self))
        left = _where(places, in_self & ~in_other)
        return Intervals(np.concatenate([self.edges[:begin], left, self.edges[end:]]))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Intervals) and np.array_equal(self.edges, other.edges)

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        return "Intervals(" + ", ".join(f"{begin}…{end - 1}" for begin, end in self.pairs()) + ")"

    def _range_near(self, other: Intervals) -> tuple[int, int]:
        """The range of edges of the intervals that may meet or touch the other set, which is not empty."""
        begin = int(self.edges.searchsorted(other.edges[0], "left"))
        end = int(self.edges.searchsorted(other.edges[-1], "right"))
        return begin - begin % 2, end + end % 2

    def _near(self, other: Intervals) -> Ints:
        """The edges of the intervals that may meet the other set."""
        begin, end = self._range_near(other)
        return self.edges[begin:end]


def evict(sets: Mapping[int, Intervals], most: int) -> list[int]:
    """The names of the largest sets to remove, so that the others have at most `most` intervals together."""
    removed: list[int] = []
    n_left = sum(map(len, sets.values()))
    by_size = sorted(sets, key=lambda name: len(sets[name])) if n_left > most else []
    while n_left > most:
        removed.append(by_size.pop())
        n_left -= len(sets[removed[-1]])
    return removed


def _inside(edges: Ints, numbers: Ints) -> NDArray[np.bool_]:
    """Which of the numbers (N,) are in the set with these edges."""
    return edges.searchsorted(numbers, "right") % 2 == 1


def _membership(one: Ints, other: Ints) -> tuple[Ints, NDArray[np.bool_], NDArray[np.bool_]]:
    """The edges of two sets, rising, and whether the numbers from each edge to the next are in each set."""
    places = np.concatenate([one, other])
    places.sort()  # equal edges do no harm: no number is between them
    return places, _inside(one, places), _inside(other, places)


def _where(places: Ints, inside: NDArray[np.bool_]) -> Ints:
    """The edges of the set of the numbers from each place to the next where `inside`, none after the last."""
    is_edge = inside.copy()
    is_edge[1:] ^= inside[:-1]
    return places[is_edge]


NUMBER_BITS, INCARNATION_BITS, ROBOT_BITS = 28, 24, 10
SEQUENCE_BITS = INCARNATION_BITS + NUMBER_BITS
LARGEST_ROBOT = (1 << ROBOT_BITS) - 1
LARGEST_INCARNATION = (1 << INCARNATION_BITS) - 1
MOST_RECORDS = 1 << NUMBER_BITS
"""Records of one author."""
END = 1 << (ROBOT_BITS + SEQUENCE_BITS)
"""Keys are below it."""
CHANNELS = -END
"""What is added to the key of a component: the key of its channels. These keys are below zero."""
WORLD = -1
"""The frame of records of authors that have no frame of their own; other frames have the number of their
author."""


def drawn_incarnation() -> int:
    """A random incarnation from the machine's entropy. A seeded one would be equal after a restart."""
    return secrets.randbits(INCARNATION_BITS)


def first_key(robot: int, incarnation: int = 0) -> int:
    """The smallest key of a robot's incarnation."""
    return robot << SEQUENCE_BITS | incarnation << NUMBER_BITS


def keys_of_robot(robot: int) -> Intervals:
    """All keys that a robot can give."""
    return Intervals.span(first_key(robot), first_key(robot + 1))


def keys_of_author(robot: int, incarnation: int) -> Intervals:
    """All keys that a robot can give in one incarnation."""
    begin = first_key(robot, incarnation)
    return Intervals.span(begin, begin + MOST_RECORDS)


def robot_of(key: int) -> int:
    return key >> SEQUENCE_BITS


def author_of(key: int) -> int:
    return key >> NUMBER_BITS


def authors(keys: Ints) -> Ints:
    """The authors (N,) of keys (N,)."""
    return keys >> NUMBER_BITS


def ids_of(keys: Ints) -> Tensor:
    """(robot, sequence) (N, 2) of keys (N,)."""
    return torch.from_numpy(np.stack([keys >> SEQUENCE_BITS, keys & ((1 << SEQUENCE_BITS) - 1)], 1))


def keys_of(ids: Tensor) -> Ints:
    """Keys (N,) of (robot, sequence) (N, 2). Raises `DataError` if they are out of range, or not distinct."""
    rows = ids.cpu().numpy().astype(np.int64)
    most = np.array([LARGEST_ROBOT, (1 << SEQUENCE_BITS) - 1])
    bad = ((rows < 0) | (rows > most)).any(1)
    if bad.any():
        raise DataError(
            f"Record {tuple(rows[bad][0].tolist())} is out of range: robots go from 0 to {LARGEST_ROBOT}, "
            f"sequences from 0 to {most[1]}."
        )
    keys = rows[:, 0] << SEQUENCE_BITS | rows[:, 1]
    is_rising = bool((keys[1:] > keys[:-1]).all())  # nearly always, and much faster than sorting
    if not is_rising and len(np.unique(keys)) != len(keys):
        raise DataError("Two records have the same id.")
    return keys

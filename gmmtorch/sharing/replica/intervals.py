"""Sets of whole numbers as intervals: what a robot holds of what others have numbered."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from gmmtorch.errors import InvalidArgumentError

Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Intervals:
    """A set of whole numbers of 64 bits; takes memory by its intervals, however long they are.

    edges (2n,): strictly rising; the numbers from edges[0] to edges[1] − 1, from edges[2] to edges[3] − 1, …
    So intervals are sorted, do not touch, and equal sets have equal edges.
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
        """The numbers from `begin` to `end` − 1; none if `end` is not above `begin`."""
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
        """The numbers of any of these sets: what `|` makes of them one by one, in one go."""
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

    def stored(self) -> torch.Tensor:
        """The edges (2n,), a copy, for a file."""
        return torch.from_numpy(self.edges.copy())

    @classmethod
    def loaded(cls, edges: torch.Tensor) -> Intervals:
        """What was `stored`. Raises `InvalidArgumentError` for what was not."""
        return cls(edges.numpy().astype(np.int64))

    def __len__(self) -> int:
        """How many intervals there are."""
        return len(self.edges) // 2

    @property
    def size(self) -> int:
        """How many numbers there are."""
        return sum((self.edges[1::2] - self.edges[::2]).tolist())  # Python's ints do not overflow

    def up_to(self, most: int) -> Intervals:
        """The set; the empty one where it has more intervals than that."""
        return self if len(self) <= most else Intervals.empty()

    def pairs(self) -> list[tuple[int, int]]:
        """Begin and end of each interval, the end not in it."""
        return list(zip(self.edges[::2].tolist(), self.edges[1::2].tolist(), strict=True))

    def contains(self, numbers: Ints) -> NDArray[np.bool_]:
        """Which of these numbers (N,) are in the set: those with an odd number of edges up to them."""
        return np.searchsorted(self.edges, numbers, side="right") % 2 == 1

    def covers(self, other: Intervals) -> bool:
        """Whether all of the other set is in this one."""
        return not (other - self)

    def __contains__(self, number: int) -> bool:
        return bool(self.contains(np.array([number], np.int64))[0])

    def numbers(self) -> Ints:
        """All numbers (N,), rising."""
        begins, lengths = self.edges[::2], self.edges[1::2] - self.edges[::2]
        return np.arange(lengths.sum()) + np.repeat(begins + lengths - np.cumsum(lengths), lengths)

    # Sets are often large here, and what changes them small: only what is close to it is compared.

    def __or__(self, other: Intervals) -> Intervals:
        large, small = (self, other) if len(self) >= len(other) else (other, self)
        if not small:
            return large
        begin, end = large._reach(small)
        places, here, there = large._part(begin, end)._against(small)
        joined = _where(places, here | there).edges
        return Intervals(np.concatenate([large.edges[:begin], joined, large.edges[end:]]))

    def __and__(self, other: Intervals) -> Intervals:
        if not (self and other):
            return Intervals.empty()
        places, here, there = self._near(other)._against(other._near(self))
        return _where(places, here & there)

    def __sub__(self, other: Intervals) -> Intervals:
        if not (self and other):
            return self
        begin, end = self._reach(other)
        places, here, there = self._part(begin, end)._against(other._near(self))
        left = _where(places, here & ~there).edges
        return Intervals(np.concatenate([self.edges[:begin], left, self.edges[end:]]))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Intervals) and np.array_equal(self.edges, other.edges)

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        return "Intervals(" + ", ".join(f"{begin}…{end - 1}" for begin, end in self.pairs()) + ")"

    def _reach(self, other: Intervals) -> tuple[int, int]:
        """From which edge to which the intervals lie that may meet or touch the other set, not empty."""
        begin = int(np.searchsorted(self.edges, other.edges[0], side="left"))
        end = int(np.searchsorted(self.edges, other.edges[-1], side="right"))
        return begin - begin % 2, end + end % 2

    def _part(self, begin: int, end: int) -> Intervals:
        return Intervals(self.edges[begin:end])

    def _near(self, other: Intervals) -> Intervals:
        """The intervals that may meet the other set."""
        return self._part(*self._reach(other))

    def _against(self, other: Intervals) -> tuple[Ints, NDArray[np.bool_], NDArray[np.bool_]]:
        """Where either set may change, and whether the numbers from there on are in each."""
        places = np.unique(np.concatenate([self.edges, other.edges]))
        return places, self.contains(places), other.contains(places)


def evict(sets: Mapping[int, Intervals], most: int) -> list[int]:
    """Whose sets to forget, the largest, so that the others have at most so many intervals together."""
    gone: list[int] = []
    n_left = sum(map(len, sets.values()))
    by_size = sorted(sets, key=lambda name: len(sets[name])) if n_left > most else []
    while n_left > most:
        gone.append(by_size.pop())
        n_left -= len(sets[gone[-1]])
    return gone


def _where(places: Ints, inside: NDArray[np.bool_]) -> Intervals:
    """The set that the numbers from each place to the next are in, or not; after the last none is."""
    return Intervals(places[np.diff(inside, prepend=False)])

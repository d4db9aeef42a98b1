"""Counters: the points that robots have assigned to components, summed over all authors."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from gmmtorch.sharing.messages.count_messages import counts_of
from gmmtorch.sharing.messages.record_messages import CountersMessage
from gmmtorch.sharing.replica.intervals import Ints
from gmmtorch.sharing.replica.record_keys import author_of

_Row = tuple[Ints, Ints]
"""Keys of components (N,), rising, and the largest counter of each, in steps."""
_EMPTY: _Row = np.zeros(0, np.int64), np.zeros(0, np.int64)


class Counters:
    """The records of counters.

    The largest counter of a component counts for each author, and authors are summed in rising order. So the
    sums depend neither on the order of the records nor on repetitions.
    """

    def __init__(self) -> None:
        self._records: dict[int, dict[int, CountersMessage]] = {}  # by author and key
        self._largest: dict[int, _Row] = {}  # by author

    def of(self, author: int) -> Mapping[int, CountersMessage]:
        """The records of an author, by key."""
        return self._records.get(author, {})

    def add(self, record: CountersMessage) -> None:
        author = author_of(record.key)
        self._records.setdefault(author, {})[record.key] = record
        self._largest[author] = _raised(self._largest.get(author, _EMPTY), record.components, record.steps)

    def drop(self, records: Iterable[CountersMessage]) -> None:
        """Remove records that were added."""
        by_author: dict[int, list[CountersMessage]] = {}
        for record in records:
            by_author.setdefault(author_of(record.key), []).append(record)
        for author, dropped in by_author.items():
            left = self._records[author]
            for record in dropped:
                del left[record.key]
            if left:
                stale = np.unique(np.concatenate([record.components for record in dropped]))
                self._largest[author] = _recomputed(self._largest[author], stale, list(left.values()))
            else:
                del self._records[author], self._largest[author]

    def keys(self) -> Ints:
        """Keys (N,), rising, of all components that have counters, held or not."""
        return np.unique(np.concatenate([_EMPTY[0], *(keys for keys, _ in self._largest.values())]))

    def sums(self, keys: Ints) -> NDArray[np.float64]:
        """Points (K,) that all authors have assigned to components (K,)."""
        total = np.zeros(len(keys))
        for author in sorted(self._largest):
            known_keys, steps = self._largest[author]
            place, is_known = _places(known_keys, keys)
            total[is_known] += counts_of(steps[place[is_known]])
        return total


def _places(rising: Ints, keys: Ints) -> tuple[Ints, NDArray[np.bool_]]:
    """Where each key (K,) is, or would be inserted, among rising keys; and which are there."""
    place = np.searchsorted(rising, keys)
    is_known = place < len(rising)
    is_known[is_known] = rising[place[is_known]] == keys[is_known]
    return place, is_known


def _raised(row: _Row, keys: Ints, steps: Ints) -> _Row:
    """The row with the counters of distinct keys (K,), where those are larger."""
    known_keys, largest = row
    place, is_known = _places(known_keys, keys)
    raised = largest.copy()
    raised[place[is_known]] = np.maximum(largest[place[is_known]], steps[is_known])
    order = np.argsort(keys[~is_known])  # keys inserted at one place keep this order
    new, value = keys[~is_known][order], steps[~is_known][order]
    at = place[~is_known][order]
    return np.insert(known_keys, at, new), np.insert(raised, at, value)


def _recomputed(row: _Row, stale: Ints, records: list[CountersMessage]) -> _Row:
    """The row, with the counters of stale keys taken from these records."""
    place, is_known = _places(row[0], stale)
    kept = np.delete(row[0], place[is_known]), np.delete(row[1], place[is_known])
    keys = np.concatenate([record.components for record in records])
    steps = np.concatenate([record.steps for record in records])
    is_stale = _places(stale, keys)[1]
    order = np.lexsort((steps[is_stale], keys[is_stale]))
    keys, steps = keys[is_stale][order], steps[is_stale][order]
    is_largest = np.append(np.diff(keys) != 0, True)[: len(keys)]
    return _raised(kept, keys[is_largest], steps[is_largest])

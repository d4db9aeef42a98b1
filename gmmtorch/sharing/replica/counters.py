"""Points that robots have counted to components, summed, kept as records come and go."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from gmmtorch.sharing.messages.count_messages import counts_of
from gmmtorch.sharing.messages.record_messages import CountersMessage
from gmmtorch.sharing.replica.intervals import Ints
from gmmtorch.sharing.replica.record_keys import author_of

_Row = tuple[Ints, Ints]
"""Keys of components (N,), rising, and the largest total of each, in steps."""
_NOTHING: _Row = np.zeros(0, np.int64), np.zeros(0, np.int64)


class Totals:
    """Records of totals. Of each life the largest total of a component counts, and lives are summed in their
    order: so it does not matter in which order records came, or how often."""

    def __init__(self) -> None:
        self._records: dict[int, dict[int, CountersMessage]] = {}  # by life and key
        self._largest: dict[int, _Row] = {}  # by life

    def of(self, life: int) -> Mapping[int, CountersMessage]:
        """The records of a life (`author_of` their keys), by key."""
        return self._records.get(life, {})

    def add(self, record: CountersMessage) -> None:
        life = author_of(record.key)
        self._records.setdefault(life, {})[record.key] = record
        self._largest[life] = _raised(self._largest.get(life, _NOTHING), record.components, record.steps)

    def drop(self, records: Iterable[CountersMessage]) -> None:
        """Forget these records, which are here."""
        by_life: dict[int, list[CountersMessage]] = {}
        for record in records:
            by_life.setdefault(author_of(record.key), []).append(record)
        for life, gone in by_life.items():
            left = self._records[life]
            for record in gone:
                del left[record.key]
            if left:
                stale = np.unique(np.concatenate([record.components for record in gone]))
                self._largest[life] = _looked_up(self._largest[life], stale, list(left.values()))
            else:
                del self._records[life], self._largest[life]

    def keys(self) -> Ints:
        """Of all components (N,) that somebody has counted to, rising; they need not be held."""
        return np.unique(np.concatenate([_NOTHING[0], *(names for names, _ in self._largest.values())]))

    def sums(self, keys: Ints) -> NDArray[np.float64]:
        """Points (K,) that all lives have counted to components (K,)."""
        total = np.zeros(len(keys))
        for life in sorted(self._largest):
            names, steps = self._largest[life]
            place, known = _places(names, keys)
            total[known] += counts_of(steps[place[known]])
        return total


def _places(names: Ints, keys: Ints) -> tuple[Ints, NDArray[np.bool_]]:
    """Where among rising names each key (K,) is, or would be; and which are there."""
    place = np.searchsorted(names, keys)
    known = place < len(names)
    known[known] = names[place[known]] == keys[known]
    return place, known


def _raised(row: _Row, keys: Ints, steps: Ints) -> _Row:
    """The row with the totals of distinct keys (K,), where they are larger."""
    names, largest = row
    place, known = _places(names, keys)
    raised = largest.copy()
    raised[place[known]] = np.maximum(largest[place[known]], steps[known])
    order = np.argsort(keys[~known])  # what goes to one place goes there in this order
    new, value = keys[~known][order], steps[~known][order]
    at = place[~known][order]
    return np.insert(names, at, new), np.insert(raised, at, value)


def _looked_up(row: _Row, stale: Ints, records: list[CountersMessage]) -> _Row:
    """The row with the totals of stale keys as these records have them."""
    place, known = _places(row[0], stale)
    fresh = np.delete(row[0], place[known]), np.delete(row[1], place[known])
    keys = np.concatenate([record.components for record in records])
    steps = np.concatenate([record.steps for record in records])
    about = _places(stale, keys)[1]
    order = np.lexsort((steps[about], keys[about]))
    keys, steps = keys[about][order], steps[about][order]
    last = np.append(np.diff(keys) != 0, True)[: len(keys)]  # the largest of each
    return _raised(fresh, keys[last], steps[last])

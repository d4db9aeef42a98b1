"""ComponentTable: components by key, in the order of arrival; and Counters: the points assigned to them."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gmmtorch.linalg import pack_symmetric
from gmmtorch.mapping import Components
from gmmtorch.team.sharing.messages.count_messages import counts_of
from gmmtorch.team.sharing.messages.record_messages import CountersMessage
from gmmtorch.team.sharing.replica.record_keys import Ints, author_of

_FINGERPRINT_BYTES = 16


class ComponentTable:
    """Components that are added and dropped, but never changed.

    Batches are numbered in the order of arrival. If components of a batch are dropped, the rest becomes a new
    batch.

    Attributes:
        dim: 2 or 3.
        end: number of the next batch.
    """

    def __init__(self, dim: int = 3) -> None:
        self.dim = dim
        self.end = 0
        self._places: dict[int, tuple[int, int]] = {}  # batch and row, by key
        self._batches: dict[int, tuple[Ints, Components]] = {}  # keys by row, and components
        self._fingerprints: dict[int, list[bytes]] = {}  # by batch, when needed
        self._keys: Ints | None = None

    def __len__(self) -> int:
        return len(self._places)

    def __contains__(self, key: int) -> bool:
        return key in self._places

    def contains(self, keys: Ints) -> NDArray[np.bool_]:
        """Which of the keys (K,) are in the table."""
        return np.array([key in self._places for key in keys.tolist()], np.bool_)

    def fingerprints(self, keys: Sequence[int]) -> list[bytes]:
        """`fingerprints` of the components with these keys (K,)."""
        places = [self._places[key] for key in keys]
        for batch in {batch for batch, _ in places} - self._fingerprints.keys():
            self._fingerprints[batch] = fingerprints(self._batches[batch][1])
        return [self._fingerprints[batch][row] for batch, row in places]

    def keys(self) -> Ints:
        """The keys of all components, rising."""
        if self._keys is None:
            self._keys = np.sort(np.fromiter(self._places, np.int64, len(self._places)))
        return self._keys

    def add(self, keys: Ints, components: Components) -> None:
        """Add a batch of components (K,) with new keys (K,)."""
        if not len(keys):
            return
        self._places.update((key, (self.end, row)) for row, key in enumerate(keys.tolist()))
        self._batches[self.end] = keys, components
        self.end += 1
        self.dim, self._keys = components.dim, None

    def drop(self, keys: Ints) -> None:
        """Remove the components with these keys, which are in the table."""
        batches = {self._places.pop(key)[0] for key in keys.tolist()}
        for batch in sorted(batches):
            members, components = self._batches.pop(batch)
            self._fingerprints.pop(batch, None)
            left = np.flatnonzero(~np.isin(members, keys))
            self.add(members[left], _normalized(components.selected(torch.from_numpy(left))))
        self._keys = None

    def since(self, batch: int) -> list[tuple[Ints, Components]]:
        """Keys and components of each batch from number `batch` on, in the order of arrival."""
        numbers = range(batch, self.end)
        return [self._batches[number] for number in numbers if number in self._batches]

    def selected(self, keys: Ints) -> Components:
        """The components with these keys (K,), in that order, each origin once."""
        if not len(keys):
            return Components.empty(self.dim)
        by_batch: dict[int, list[tuple[int, int]]] = {}
        for rank, key in enumerate(keys.tolist()):
            batch, row = self._places[key]
            by_batch.setdefault(batch, []).append((rank, row))
        parts, ranks = [], []
        for batch, members in by_batch.items():
            parts.append(self._batches[batch][1].selected(torch.tensor([row for _, row in members])))
            ranks += [rank for rank, _ in members]
        return _normalized(Components.concatenate(parts).rearranged(torch.tensor(ranks).argsort()))


def fingerprints(components: Components) -> list[bytes]:
    """A hash (BLAKE2b, 16 bytes) of each component (K,), without its id, in any batch."""
    c = components
    flags = c.max_range.double()[:, None]
    rows = _bits(torch.cat([c.means, pack_symmetric(c.covariances), c.support[:, None], flags], 1))
    order = torch.argsort(c.seen_by, stable=True)
    seen = _bits(torch.cat([c.origins[c.seen_from[order]], c.seen_count[order, None]], 1))
    ends = torch.bincount(c.seen_by, minlength=len(c)).cumsum(0).tolist()
    begins = [0, *ends][: len(ends)]
    return [
        hashlib.blake2b(row.tobytes() + seen[begin:end].tobytes(), digest_size=_FINGERPRINT_BYTES).digest()
        for row, begin, end in zip(rows, begins, ends, strict=True)
    ]


def most_viewpoints(components: Components) -> int:
    """The largest number of viewpoints of a component."""
    return int(torch.bincount(components.seen_by).max()) if len(components.seen_by) else 0


def _bits(values: Tensor) -> np.ndarray:
    return (values.double().cpu() + 0.0).numpy().astype("<f8")  # −0 becomes 0


def _normalized(components: Components) -> Components:
    """Viewpoints sorted by component, and distinct, rising origins: independent of the batches."""
    order = torch.argsort(components.seen_by, stable=True)
    seen_from = components.seen_from[order]
    origins, which = torch.unique(components.origins[seen_from] + 0.0, dim=0, return_inverse=True)
    return replace(
        components,
        origins=origins,
        seen_by=components.seen_by[order],
        seen_from=which,
        seen_count=components.seen_count[order],
    )


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
        dropped = {record.key: author_of(record.key) for record in records}
        for key, author in dropped.items():
            del self._records[author][key]
        for author in set(dropped.values()):
            if left := self._records[author]:
                self._largest[author] = _largest_of(left.values())
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


def _largest_of(records: Iterable[CountersMessage]) -> _Row:
    """The largest counter of each component in these records, at least one."""
    keys, steps = (np.concatenate(x) for x in zip(*((r.components, r.steps) for r in records), strict=True))
    order = np.lexsort((steps, keys))
    keys, steps = keys[order], steps[order]
    is_largest = np.append(np.diff(keys) != 0, True)[: len(keys)]
    return keys[is_largest], steps[is_largest]

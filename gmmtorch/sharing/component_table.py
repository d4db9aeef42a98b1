"""Components by their keys, as they came: batches, and where in them each is."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gmmtorch.linalg import pack_symmetric
from gmmtorch.mapping.components import Components
from gmmtorch.sharing.intervals import Intervals, Ints

_PRINT_BYTES = 16


class _Place(NamedTuple):
    """Where a component is, and what its content hashes to."""

    batch: int
    row: int
    print: bytes


class ComponentTable:
    """Components that are added, and dropped for good; nothing else changes."""

    def __init__(self) -> None:
        self._places: dict[int, _Place] = {}
        self._batches: dict[int, tuple[Ints, Components]] = {}  # keys by row
        self._n_batches = 0
        self._keys = np.zeros(0, np.int64)
        self._unsorted: list[Ints] = []

    def __len__(self) -> int:
        return len(self._places)

    def __contains__(self, key: int) -> bool:
        return key in self._places

    def print_of(self, key: int) -> bytes:
        """What the content of a component, but for its key, hashes to."""
        return self._places[key].print

    def keys(self) -> Ints:
        """Of all components, rising."""
        if self._unsorted:
            self._keys = np.sort(np.concatenate([self._keys, *self._unsorted]), kind="stable")
            self._unsorted = []
        return self._keys

    def add(self, keys: Ints, components: Components, prints: Sequence[bytes]) -> None:
        """Take in components (K,) of new keys, with their `fingerprints`."""
        if len(keys):
            self._put(keys, components, prints)
            self._unsorted.append(keys)

    def drop(self, dead: Intervals) -> None:
        """Forget the components of these keys."""
        keys = self.keys()
        gone = keys[dead.contains(keys)]
        for batch in {self._places[key].batch for key in gone.tolist()}:
            members, components = self._batches.pop(batch)
            left = np.flatnonzero(~dead.contains(members))
            if len(left):
                prints = [self._places[key].print for key in members[left].tolist()]
                self._put(members[left], _tidy(components.selected(torch.from_numpy(left))), prints)
        for key in gone.tolist():
            del self._places[key]
        self._keys = keys[~dead.contains(keys)]

    def taken(self, keys: Ints) -> Components:
        """The components of these keys (K,), in that order, each origin once."""
        by_batch: dict[int, list[tuple[int, int]]] = {}
        for rank, key in enumerate(keys.tolist()):
            place = self._places[key]
            by_batch.setdefault(place.batch, []).append((rank, place.row))
        parts, ranks = [], []
        for batch, members in by_batch.items():
            parts.append(self._batches[batch][1].selected(torch.tensor([row for _, row in members])))
            ranks += [rank for rank, _ in members]
        return _tidy(Components.concatenate(parts).rearranged(torch.tensor(ranks).argsort()))

    def _put(self, keys: Ints, components: Components, prints: Sequence[bytes]) -> None:
        for row, (key, print_) in enumerate(zip(keys.tolist(), prints, strict=True)):
            self._places[key] = _Place(self._n_batches, row, print_)
        self._batches[self._n_batches] = keys, components
        self._n_batches += 1


def fingerprints(components: Components) -> list[bytes]:
    """What each component (K,) hashes to: all but its id, whatever batch it is in."""
    c = components
    flags = c.max_range.double()[:, None]
    rows = _bits(torch.cat([c.means, pack_symmetric(c.covariances), c.support[:, None], flags], 1))
    order = torch.argsort(c.seen_by, stable=True)
    seen = _bits(torch.cat([c.origins[c.seen_from[order]], c.seen_count[order, None]], 1))
    ends = torch.bincount(c.seen_by, minlength=len(c)).cumsum(0).tolist()
    begins = [0, *ends][: len(ends)]
    return [
        hashlib.blake2b(row.tobytes() + seen[begin:end].tobytes(), digest_size=_PRINT_BYTES).digest()
        for row, begin, end in zip(rows, begins, ends, strict=True)
    ]


def most_sightings(components: Components) -> int:
    """Of a component."""
    return int(torch.bincount(components.seen_by).max()) if len(components.seen_by) else 0


def _bits(values: Tensor) -> np.ndarray:
    return (values.double().cpu() + 0.0).numpy().astype("<f8")  # −0 is 0


def _tidy(components: Components) -> Components:
    """The same whatever batches they came in: sightings by component, and distinct origins, rising."""
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

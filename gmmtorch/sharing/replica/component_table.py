"""Components by their keys, as they came: batches, and where in them each is."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gmmtorch.linalg import pack_symmetric
from gmmtorch.mapping.components import Components
from gmmtorch.sharing.replica.intervals import Ints

_PRINT_BYTES = 16


class ComponentTable:
    """Components that are added, and dropped for good; nothing else changes.

    Batches are numbered as they come; what is left of one from which some are dropped is a new batch.
    """

    def __init__(self, dim: int = 3) -> None:
        self.dim = dim
        self.end = 0
        """The number of the next batch."""
        self._places: dict[int, tuple[int, int]] = {}  # batch and row, by key
        self._batches: dict[int, tuple[Ints, Components]] = {}  # keys by row
        self._prints: dict[int, list[bytes]] = {}  # by batch: what was asked for
        self._keys: Ints | None = None

    def __len__(self) -> int:
        return len(self._places)

    def __contains__(self, key: int) -> bool:
        return key in self._places

    def holds(self, keys: Ints) -> NDArray[np.bool_]:
        """Which of these (K,) are here."""
        return np.array([key in self._places for key in keys.tolist()], np.bool_)

    def prints(self, keys: Sequence[int]) -> list[bytes]:
        """What the content of components (K,), but for their keys, hashes to."""
        places = [self._places[key] for key in keys]
        for batch in {batch for batch, _ in places} - self._prints.keys():
            self._prints[batch] = fingerprints(self._batches[batch][1])
        return [self._prints[batch][row] for batch, row in places]

    def print_of(self, key: int) -> bytes:
        return self.prints([key])[0]

    def keys(self) -> Ints:
        """Of all components, rising."""
        if self._keys is None:
            self._keys = np.sort(np.fromiter(self._places, np.int64, len(self._places)))
        return self._keys

    def add(self, keys: Ints, components: Components) -> None:
        """Take in a batch of components (K,) of new keys."""
        if not len(keys):
            return
        self._places.update((key, (self.end, row)) for row, key in enumerate(keys.tolist()))
        self._batches[self.end] = keys, components
        self.end += 1
        self.dim, self._keys = components.dim, None

    def drop(self, keys: Ints) -> None:
        """Forget the components of these keys, which are here."""
        batches = {self._places.pop(key)[0] for key in keys.tolist()}
        for batch in sorted(batches):
            members, components = self._batches.pop(batch)
            self._prints.pop(batch, None)
            left = np.flatnonzero(~np.isin(members, keys))
            self.add(members[left], _tidy(components.selected(torch.from_numpy(left))))
        self._keys = None

    def since(self, batch: int) -> list[tuple[Ints, Components]]:
        """Keys and components of each batch from this number on, as they came."""
        numbers = range(batch, self.end)
        return [self._batches[number] for number in numbers if number in self._batches]

    def taken(self, keys: Ints) -> Components:
        """The components of these keys (K,), in that order, each origin once."""
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
        return _tidy(Components.concatenate(parts).rearranged(torch.tensor(ranks).argsort()))


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


def most_viewpoints(components: Components) -> int:
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

"""ComponentTable: components by key, in the batches in which they arrived."""

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
    """A hash (BLAKE2b, 16 bytes) of each component (K,), without its id, whatever its batch."""
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

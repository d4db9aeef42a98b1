"""Changes of a replica's map since the last call, for users that derive something from the map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from gmmtorch.mapping.components import Components
from gmmtorch.sharing.messages.record_messages import CorrectionMessage
from gmmtorch.sharing.replica.component_table import ComponentTable
from gmmtorch.sharing.replica.counters import Counters
from gmmtorch.sharing.replica.intervals import Ints
from gmmtorch.sharing.replica.materialized_view import corrected, gains

_MOST_KEYS = 1 << 16
"""Keys of components with new counters that are remembered between two calls; of more, all counters are
read."""
_NO_KEYS = np.zeros(0, np.int64)


@dataclass(frozen=True, eq=False)
class Changes:
    """What a replica added to its map.

    added: batches of new components, this robot's own included, one for each datagram in the order of
    arrival, with their own counts.
    gained: components whose counters rose, by id; support and counts are the rise. Points that were
    assigned to a component before it arrived are included when it arrives.
    rebuilt: components were superseded or corrected, so that everything must be derived from `components()`
    again. `added` and `gained` are empty then; later changes continue from there.
    """

    added: list[Components]
    gained: Components
    rebuilt: bool


class ChangeLog:
    """Which components and counters were reported. It costs nothing until the first call of `read`."""

    def __init__(self) -> None:
        self._batch = 0  # the first batch that was not reported
        # Points reported, by component; None: before the first call.
        self._reported: dict[int, float] | None = None
        self._touched: list[Ints] | None = None  # components whose counters changed; None: any
        self._n_touched = 0
        self._rebuilt = False

    def counted(self, keys: Ints) -> None:
        """Counters of these components were added or dropped."""
        if self._touched is not None:
            self._touched.append(keys)
            self._n_touched += 1 + len(keys)
            if self._n_touched > _MOST_KEYS:
                self._touched = None

    def invalidate(self) -> None:
        """Components that were reported have changed."""
        self._rebuilt = self._reported is not None

    def read(
        self, table: ComponentTable, counters: Counters, corrections: Sequence[CorrectionMessage]
    ) -> Changes:
        """The changes since the last call."""
        before = {} if self._rebuilt or self._reported is None else self._reported
        batches = table.since(self._batch)
        if self._touched is None or self._rebuilt:
            keys = counters.keys()
        else:
            keys = np.unique(np.concatenate([_NO_KEYS, *self._touched, *(keys for keys, _ in batches)]))
        keys = keys[table.contains(keys)]  # others are read when the component arrives
        sums = counters.sums(keys)
        rise = sums - np.array([before.get(key, 0.0) for key in keys.tolist()])
        rebuilt = self._rebuilt or bool((rise < 0).any())
        before.update(zip(keys[rise != 0].tolist(), sums[rise != 0].tolist(), strict=True))
        self._batch, self._reported, self._rebuilt = table.end, before, False
        self._touched, self._n_touched = [], 0
        if rebuilt:
            return Changes([], Components.empty(table.dim), True)
        added = [corrected(batch, keys, corrections) for keys, batch in batches]
        risen = keys[rise > 0]
        if not len(risen):
            return Changes(added, Components.empty(table.dim), False)
        held = corrected(table.selected(risen), risen, corrections)
        return Changes(added, gains(held, torch.from_numpy(rise[rise > 0])), False)

"""What a replica has come to know since somebody last asked: for those who make something else of the map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from gmmtorch.errors import DataError
from gmmtorch.mapping.components import Components
from gmmtorch.sharing.messages.record_messages import CorrectionMessage
from gmmtorch.sharing.replica.component_table import ComponentTable
from gmmtorch.sharing.replica.counters import Totals
from gmmtorch.sharing.replica.intervals import Ints
from gmmtorch.sharing.replica.materialized_view import corrected, gains

_MOST_NAMED = 1 << 16
"""Records, and entries of them, that are remembered while nobody asks; beyond that all are looked at."""
_NO_KEYS = np.zeros(0, np.int64)


@dataclass(frozen=True, eq=False)
class Changes:
    """What has become known of a map.

    added: components that have come, this robot's own too, a batch for each datagram, in their order, with
    their own counts.
    gained: of components that are held, by id, what all robots have counted to them; support and counts are
    the rise. What was counted to components before they come is in it when they come.
    rebuilt: something was superseded or corrected: what was made of earlier changes holds no more, and is to
    be made anew of `components()`. The others are empty then; the next changes go on from there.
    """

    added: list[Components]
    gained: Components
    rebuilt: bool


class ChangeLog:
    """How far somebody has followed. It costs nothing until it is first asked."""

    def __init__(self, rebuilt: bool = False) -> None:
        self._batch = 0  # the first that was not told
        # What was told of totals, by component; None: nobody has asked yet.
        self._told: dict[int, float] | None = {} if rebuilt else None
        self._named: list[Ints] | None = None  # components whose totals have changed; None: any
        self._n_named = 0
        self._rebuilt = rebuilt

    def counted(self, keys: Ints) -> None:
        """Totals of these components have come, or have gone."""
        if self._named is not None:
            self._named.append(keys)
            self._n_named += 1 + len(keys)
            if self._n_named > _MOST_NAMED:
                self._named = None

    def broken(self) -> None:
        """What was told is true no more."""
        self._rebuilt = self._told is not None

    def taken(
        self, table: ComponentTable, totals: Totals, corrections: Sequence[CorrectionMessage]
    ) -> Changes:
        """What has changed, which is told then."""
        before = {} if self._rebuilt or self._told is None else self._told
        batches = table.since(self._batch)
        if self._named is None or self._rebuilt:
            named = totals.keys()
        else:
            named = np.unique(np.concatenate([_NO_KEYS, *self._named, *(keys for keys, _ in batches)]))
        named = named[table.holds(named)]  # what is not here yet is asked for when it comes
        sums = totals.sums(named)
        rise = sums - np.array([before.get(key, 0.0) for key in named.tolist()])
        rebuilt = self._rebuilt or bool((rise < 0).any())
        before.update(zip(named[rise != 0].tolist(), sums[rise != 0].tolist(), strict=True))
        self._batch, self._told, self._rebuilt = table.end, before, False
        self._named, self._n_named = [], 0
        if rebuilt:
            return Changes([], Components.empty(table.dim), True)
        added = [corrected(batch, keys, corrections) for keys, batch in batches]
        risen = named[rise > 0]
        if not len(risen):
            return Changes(added, Components.empty(table.dim), False)
        held = corrected(table.taken(risen), risen, corrections)
        return Changes(added, gains(held, torch.from_numpy(rise[rise > 0])), False)

    # -- keeping ----------------------------------------------------------------------------------

    def state(self, table: ComponentTable) -> dict[str, Any]:
        """Batches not told yet, by keys, and what was told."""
        batches = [keys for keys, _ in table.since(self._batch)]
        told = self._told or {}
        return {
            "asked": self._told is not None,
            "rebuilt": self._rebuilt,
            "sizes": torch.tensor([len(keys) for keys in batches], dtype=torch.int64),
            "keys": torch.from_numpy(np.concatenate([_NO_KEYS, *batches])),
            "told": torch.tensor(list(told), dtype=torch.int64),
            "sums": torch.tensor(list(told.values()), dtype=torch.float64),
        }

    @classmethod
    def restored(cls, state: dict[str, Any], n_batches: int) -> ChangeLog:
        """..., where so many batches are in the table that were told."""
        told, sums = state["told"].tolist(), state["sums"].tolist()
        if not (state["sums"].isfinite() & (state["sums"] >= 0)).all():
            raise DataError("What was told of totals is damaged.")
        log = cls()
        log._batch, log._rebuilt = n_batches, bool(state["rebuilt"])
        log._told = dict(zip(told, sums, strict=True)) if state["asked"] else None
        return log

"""Broadcast: components and counts said once, in any codec; what is lost stays lost (thesis 4.2)."""

from __future__ import annotations

import bisect
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from gmmtorch.errors import check_whole
from gmmtorch.mapping.codec.component_batch import spatial_order
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.learning.association import summed
from gmmtorch.sharing.messages.envelope import check_codec, within
from gmmtorch.sharing.messages.message_registry import (
    ComponentsMessage,
    CountsMessage,
    Message,
    decode,
    encode_components,
    encode_counts,
)
from gmmtorch.sharing.replica.changes import Changes
from gmmtorch.sharing.replica.intervals import Intervals

MOST_ROWS, MOST_BATCHES = 1 << 20, 1 << 17
"""Components and counts that are held, and the messages that they came in; more are not taken from others."""


class Broadcast:
    """A `Replica` that does not care what others have: for networks that lose nothing, and to compare.

    The sender holds what its datagrams decode to. Components that come twice count once. Counts count
    whenever they come, as nothing tells them apart; of components that have not come they are left out.

    Components are numbered from 0 in each life of a robot: what one says that starts again is taken for a
    repetition, until it has said more than before.
    """

    def __init__(self, robot: int, codec: str = "thesis") -> None:
        self.robot = check_whole("robot", robot, 0)
        self.codec = check_codec(codec)
        self.refused: Counter[str] = Counter()
        """How many messages were not taken in: "other" (none of components or counts), "unfit" (components
        that are not in 3D, or not numbered one after another), "full" (more than is held)."""
        self.version = 0
        self._n_rows = 0
        self._n_numbered = 0
        self._batches: list[Components] = []
        self._firsts: dict[int, list[tuple[int, int]]] = {}  # by robot: first sequence, row in `_batches`
        self._gained: list[Components] = []
        self._n_told = 0
        self._fresh: list[Components] = []  # of `_gained`
        self._due: list[bytes] = []

    @property
    def held(self) -> Intervals:
        """Nothing is asked for again, so nobody need know."""
        return Intervals.empty()

    @property
    def missing(self) -> Intervals:
        """Nobody knows."""
        return Intervals.empty()

    def add(self, new: Components) -> Tensor:
        """New components of this robot; returns the ids (K, 2) that they get, rising."""
        if len(new):
            new = new.rearranged(spatial_order(new))  # takes fewer bytes
        numbers = self._n_numbered + torch.arange(len(new))
        self._n_numbered += len(new)
        ids = torch.stack([torch.full_like(numbers, self.robot), numbers], 1)
        self._say(encode_components(replace(new, ids=ids), self.codec))
        return ids

    def count(self, gains: Mapping[tuple[int, int], float]) -> None:
        """Adds points gained since the last call by components (robot, sequence) of any robot."""
        self._say(encode_counts(self.robot, dict(gains), self.codec))

    def _say(self, datagrams: list[bytes]) -> None:
        for datagram in datagrams:
            self._take(decode(datagram))
        self._due += datagrams

    def receive(self, datagram: bytes, message: Message | None = None) -> bool:
        """Take in what a datagram says, if it is of components or counts. Raises `DataError` for a damaged
        one. message: what `decode` makes of it, for those who have that already."""
        message = decode(datagram) if message is None else message
        if self._is_full(message):
            self.refused["full"] += 1
            return False
        return self._take(message)

    def _is_full(self, message: Message) -> bool:
        """Whether there is no room for what a message says."""
        if isinstance(message, ComponentsMessage):
            n = len(message.components)
        else:
            n = len(message.counts) if isinstance(message, CountsMessage) else 0
        n_batches = len(self._batches) + len(self._gained)
        return n > 0 and (self._n_rows + n > MOST_ROWS or n_batches >= MOST_BATCHES)

    def _take(self, message: Message) -> bool:
        if isinstance(message, ComponentsMessage) and not _is_fit(message.components):
            self.refused["unfit"] += 1
            return False
        if isinstance(message, ComponentsMessage):
            self._enter(message.components)
        elif isinstance(message, CountsMessage):
            self._gain(message)
        else:
            self.refused["other"] += 1
            return False
        return True

    def _enter(self, batch: Components) -> None:
        """Take in a batch, unless any of it is here already."""
        if len(batch) == 0:
            return
        robot, first = batch.ids[0].tolist()
        if any(
            known + len(self._batches[row]) > first
            for known, row in self._near(robot, first + len(batch) - 1)
        ):
            return
        bisect.insort(self._firsts.setdefault(robot, []), (first, len(self._batches)))
        self._batches.append(batch)
        self._n_rows += len(batch)
        self.version += 1

    def _near(self, robot: int, number: int) -> list[tuple[int, int]]:
        """The batch, if any, that begins last of those up to a number."""
        entries = self._firsts.get(robot, [])
        at = bisect.bisect_right(entries, number, key=lambda entry: entry[0])
        return entries[max(at - 1, 0) : at]

    def _gain(self, message: CountsMessage) -> None:
        rows = []
        for (robot, number), count in message.counts.items():
            for first, which in self._near(robot, number):
                batch = self._batches[which]
                if number - first < len(batch):
                    one = batch.selected(torch.tensor([number - first]))
                    support = torch.full_like(one.support, count)
                    rows.append(replace(one, support=support, seen_count=support[one.seen_by]))
        if rows:
            self._gained.append(Components.concatenate(rows))
            self._fresh.append(self._gained[-1])
            self._n_rows += len(rows)
            self.version += 1

    def changes(self) -> Changes:
        """What has come since the last call: see `Replica.changes`."""
        added, self._n_told = self._batches[self._n_told :], len(self._batches)
        gained = Components.concatenate(self._fresh) if self._fresh else Components.empty(3)
        self._fresh = []
        return Changes(added, gained, False)

    def datagrams(self, *, budget: int | None = None) -> list[bytes]:
        """What is due, in so many bytes; what does not fit waits."""
        n = within(self._due, budget)
        sent, self._due = self._due[:n], self._due[n:]
        return sent

    def announcements(self) -> list[bytes]:
        """None: nobody would send again what is missing."""
        return []

    def components(self) -> Components:
        """All components with all their counts, in the order of their ids."""
        parts = [*self._batches, *self._gained]
        return summed(Components.concatenate(parts)) if parts else Components.empty(3)

    def digest(self) -> bytes:
        """None: what two robots hold may differ for good."""
        return b""


def _is_fit(batch: Components) -> bool:
    """Whether components are what a broadcaster numbers together, and can be found by the first."""
    following = batch.ids[:1] + torch.stack([torch.zeros(len(batch)), torch.arange(len(batch))], 1).long()
    return batch.dim == 3 and torch.equal(batch.ids, following)

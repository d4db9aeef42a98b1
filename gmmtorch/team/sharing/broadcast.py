"""Broadcast: components and counts that are sent once, in any codec; losses are not repaired (thesis 4.2)."""

from __future__ import annotations

import bisect
import itertools
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import check_whole
from gmmtorch.mapping import Attributes, Components, spatial_order, summed
from gmmtorch.simulation import DepthFrame
from gmmtorch.team.sharing.messages.component_messages import (
    ComponentsMessage,
    CountsMessage,
    encode_components,
    encode_counts,
)
from gmmtorch.team.sharing.messages.datagrams import check_codec
from gmmtorch.team.sharing.messages.message_registry import Message, decode
from gmmtorch.team.sharing.messages.mission_messages import MOST_PARTS, PointsMessage, encode_points
from gmmtorch.team.sharing.replica.materialized_view import Changes
from gmmtorch.team.sharing.replica.record_keys import Intervals

MOST_ROWS, MOST_BATCHES = 1 << 20, 1 << 17
"""Largest numbers of components and counts, and of their messages; beyond, messages of others are refused."""


class SendOnce:
    """Datagrams that are sent once. Losses are not repaired, so no records are announced."""

    version = 0
    held = missing = Intervals.empty()
    is_complete, waits, is_little = True, False, False

    def __init__(self) -> None:
        self._due: list[bytes] = []

    def datagrams(self, *, budget: int | None = None) -> list[bytes]:
        """The datagrams that are due, at most `budget` bytes together; the rest stays due."""
        sizes = itertools.accumulate(map(len, self._due))
        n = len(self._due) if budget is None else sum(size <= budget for size in sizes)
        sent, self._due = self._due[:n], self._due[n:]
        return sent

    def announcements(self) -> list[bytes]:
        """None: no robot would send missing records again."""
        return []

    def digest(self) -> bytes:
        """Empty: two robots may hold different records for good."""
        return b""


class Broadcast(SendOnce):
    """The counterpart of `Replica` without repair of losses: for networks without losses, and to compare.

    Components are without attributes. The sender holds the decoded values of its datagrams. Repeated
    components count once; repeated counts are added again, because nothing distinguishes them; counts of
    unknown components are ignored. A robot numbers its components from 0 in each session, so teammates ignore
    a restarted one until it has sent more.

    Attributes:
        refused: number of messages that were refused: "other" (neither components nor counts), "unfit"
            (components that are not in 3D, or not numbered consecutively), "full" (beyond the limits).
        version: rises with every change.
    """

    def __init__(self, robot: int, codec: str = "thesis") -> None:
        self.robot = check_whole("robot", robot, 0)
        self.codec = check_codec(codec)
        super().__init__()
        self.refused: Counter[str] = Counter()
        self._n_rows = 0
        self._n_numbered = 0
        self._batches: list[Components] = []
        self._firsts: dict[int, list[tuple[int, int]]] = {}  # by robot: first sequence, row in `_batches`
        self._gained: list[Components] = []
        self._n_reported = 0  # of `_batches`, by `changes`
        self._fresh: list[Components] = []  # of `_gained`, not yet reported

    def add(self, new: Components) -> Tensor:
        """New components of this robot; returns the ids (K, 2) that they get, rising."""
        if len(new):
            new = new.rearranged(spatial_order(new))  # takes fewer bytes
        numbers = self._n_numbered + torch.arange(len(new))
        self._n_numbered += len(new)
        ids = torch.stack([torch.full_like(numbers, self.robot), numbers], 1)
        self._send(encode_components(replace(new, ids=ids, attributes=Attributes()), self.codec))
        return ids

    def count(self, gains: Mapping[tuple[int, int], float]) -> None:
        """Add points that components (robot, sequence), of any robot, have gained since the last call."""
        self._send(encode_counts(self.robot, dict(gains), self.codec))

    def _send(self, datagrams: list[bytes]) -> None:
        for datagram in datagrams:
            self._merge(decode(datagram))
        self._due += datagrams

    def receive(self, datagram: bytes, message: Message | None = None) -> bool:
        """Merge a datagram of components or counts; returns whether it was merged.

        message: the result of `decode(datagram)`, if the caller has it. Raises `DataError` for damaged data.
        """
        message = decode(datagram) if message is None else message
        if isinstance(message, ComponentsMessage):
            n = len(message.components)
        else:
            n = len(message.counts) if isinstance(message, CountsMessage) else 0
        n_batches = len(self._batches) + len(self._gained)
        if n and (self._n_rows + n > MOST_ROWS or n_batches >= MOST_BATCHES):
            self.refused["full"] += 1
            return False
        return self._merge(message)

    def _merge(self, message: Message) -> bool:
        if isinstance(message, ComponentsMessage) and not _is_fit(message.components):
            self.refused["unfit"] += 1
            return False
        if isinstance(message, ComponentsMessage):
            self._add_batch(replace(message.components, attributes=Attributes()))
        elif isinstance(message, CountsMessage):
            self._add_counts(message)
        else:
            self.refused["other"] += 1
            return False
        return True

    def _add_batch(self, batch: Components) -> None:
        """Add a batch, unless one of its components is here already."""
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
        """First sequence and row of the last batch that begins at or below a sequence, if there is one."""
        entries = self._firsts.get(robot, [])
        at = bisect.bisect_right(entries, number, key=lambda entry: entry[0])
        return entries[max(at - 1, 0) : at]

    def _add_counts(self, message: CountsMessage) -> None:
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
        """The changes since the last call; see `Replica.changes`."""
        added, self._n_reported = self._batches[self._n_reported :], len(self._batches)
        gained = Components.concatenate(self._fresh) if self._fresh else Components.empty(3)
        self._fresh = []
        return Changes(added, gained, False)

    def components(self) -> Components:
        """All components with all their counts, by id."""
        parts = [*self._batches, *self._gained]
        return summed(Components.concatenate(parts)) if parts else Components.empty(3)


def _is_fit(batch: Components) -> bool:
    """Whether a batch is 3D, of one robot, and numbered consecutively."""
    following = batch.ids[:1] + torch.stack([torch.zeros(len(batch)), torch.arange(len(batch))], 1).long()
    return batch.dim == 3 and torch.equal(batch.ids, following)


MOST_INTERVALS = 1 << 14
"""Intervals of received parts kept for a teammate; beyond, the oldest gaps count as received."""


class SharedPoints(SendOnce):
    """The points that a robot sends, and which parts of its teammates' frames have arrived. No losses are
    repaired, so nothing is announced.

    A robot numbers its frames from 0 in each session. So teammates ignore a restarted robot until its frames
    have higher numbers than before.

    Args:
        robot: its id. size: robots of the team.

    Attributes:
        refused: messages of points that were not merged: "stranger" (not from a teammate), "repeated"
            (received before, or so late that this is no longer known).
    """

    def __init__(self, robot: int, size: int) -> None:
        super().__init__()
        self.refused: Counter[str] = Counter()
        self._robot, self._size = robot, size
        self._n_frames = 0
        self._received: dict[int, Intervals] = {}  # parts of frames, by sender

    def add(self, frame: DepthFrame, novel: Tensor) -> list[bytes]:
        """Queues the novel beams (N,) bool of the next frame; returns the datagrams."""
        datagrams = []
        if bool(novel.any()):
            datagrams = encode_points(
                self._robot,
                self._n_frames,
                frame.origin.cpu(),
                frame.ends[novel].cpu(),
                frame.is_hit[novel].cpu(),
            )
        self._n_frames += 1
        self._due += datagrams
        return datagrams

    def accept(self, message: PointsMessage) -> bool:
        """Whether this part of a teammate's frame is new; from now on it counts as received."""
        if message.sender == self._robot or message.sender >= self._size:
            self.refused["stranger"] += 1
            return False
        number = message.frame * MOST_PARTS + message.part
        received = self._received.get(message.sender, Intervals.empty())
        if number in received:
            self.refused["repeated"] += 1
            return False
        self._received[message.sender] = _bounded(received | Intervals.span(number, number + 1))
        return True


def _bounded(numbers: Intervals) -> Intervals:
    """The same set, with its first gaps closed if it has more than `MOST_INTERVALS` intervals."""
    excess = max(0, len(numbers) - MOST_INTERVALS)
    return Intervals(np.concatenate([numbers.edges[:1], numbers.edges[1 + 2 * excess :]]))

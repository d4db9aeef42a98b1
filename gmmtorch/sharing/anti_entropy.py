"""What is due to be sent: what is new here, and what others turn out to lack."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from gmmtorch.sharing.announce_messages import AnnouncementMessage
from gmmtorch.sharing.intervals import Intervals
from gmmtorch.sharing.record_ids import keys_of_robot

MOST_PEERS = 64
"""Robots whose gaps are remembered, those heard last."""

Packet = tuple[bytes, Intervals]
"""A datagram, and the keys of the records in it."""


class Backlog:
    """Keys that are due; and of some of them the datagrams, as they were made when they were written.

    What a robot lacks is sent to it at once by who made it. Others, whom it may hear where it does not hear
    the maker, send it when it is still lacking at that robot's next announcement: else all would answer at
    once. What somebody has just sent is on its way, and not due: the announcement may be older.
    """

    def __init__(self, robot: int) -> None:
        self._own = keys_of_robot(robot)
        self.due = Intervals.empty()
        self.ready: list[Packet] = []
        self._passing = Intervals.empty()  # heard, or sent by the last call
        self._gaps: OrderedDict[int, Intervals] = OrderedDict()

    def add(self, keys: Intervals, packets: Sequence[Packet] = ()) -> None:
        """Something new to say; packets: of some of it, ready to be sent."""
        self.due |= keys
        self.ready += packets

    def heard(self, keys: Intervals) -> None:
        """Somebody, perhaps this robot again, has said it."""
        self.due -= keys
        self._passing |= keys

    def sent(self, keys: Intervals) -> None:
        """All that this robot has sent since the last call."""
        self.due -= keys
        self._passing = keys
        self.ready = [packet for packet in self.ready if self.due.covers(packet[1])]

    def announced(self, message: AnnouncementMessage, held: Intervals) -> None:
        """Another robot says what it holds; `held`: what is here."""
        gap = (held & message.scope) - message.held
        before = self._gaps.pop(message.sender, Intervals.empty())
        self.due |= ((gap & self._own) | (gap & before)) - self._passing
        self._gaps[message.sender] = (before - message.scope) | gap
        while len(self._gaps) > MOST_PEERS:
            self._gaps.popitem(last=False)

    def state(self) -> dict[str, Any]:
        return {"due": torch.from_numpy(self.due.edges.copy())}

    def restore(self, state: dict[str, Any]) -> None:
        """Who lacked what is asked anew."""
        due = Intervals(state["due"].numpy().astype(np.int64))
        self.due, self._passing, self._gaps = due, Intervals.empty(), OrderedDict()
        self.ready = []

"""What is due to be sent: what is new here, and what others turn out to lack."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from typing import Any

from gmmtorch.sharing.messages.announcements import AnnouncementMessage
from gmmtorch.sharing.messages.envelope import loaded, stored
from gmmtorch.sharing.replica.intervals import Intervals, evict
from gmmtorch.sharing.replica.record_keys import keys_of_robot

_ON_THE_WAY = 3
"""Calls after which what was sent has come: a robot that sends, then hears, each tick, over a network as
quick as that, announces before it has heard what was sent a tick ago, and is heard a tick later."""
MOST_PEERS = 64
"""Robots whose gaps are remembered, those heard last."""
MOST_REMEMBERED = 1 << 16
"""Intervals of what these lack, all together, and of what they hold: 1 MiB each. As much as two honest robots
come to at their limits, or hundreds as a rule. Who takes most is forgotten: it will announce again."""
MOST_PASSING = 1 << 14
"""Intervals of what is taken to be on its way; where there are more nothing is, and some is said twice."""
PATIENCE = 1 << 7
"""Announcements after which a robot that has not been heard since is taken to be gone, with what it alone
claimed to hold: two minutes of them, longer than what cuts a team in two as a rule."""

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
        self._passing = [Intervals.empty()] * _ON_THE_WAY  # heard or sent; since the last call, and before
        self._gaps: OrderedDict[int, Intervals] = OrderedDict()  # what others lack, by who said so
        self._theirs: OrderedDict[int, Intervals] = OrderedDict()  # what others hold, and this robot lacked
        self._waited: dict[int, int] = {}  # announcements made here since those others were heard

    def add(self, keys: Intervals, packets: Sequence[Packet] = ()) -> None:
        """Something new to say; packets: of some of it, ready to be sent."""
        self.due |= keys
        self.ready += packets

    def heard(self, keys: Intervals) -> None:
        """Somebody, perhaps this robot again, has said it."""
        self.due -= keys
        self._passing[0] = (self._passing[0] | keys).up_to(MOST_PASSING)

    def buried(self, dead: Intervals) -> None:
        """These are superseded: nobody needs them any more."""
        self.due -= dead

    def sent(self, keys: Intervals) -> None:
        """All that this robot has sent since the last call."""
        self.due -= keys
        self._passing = [keys.up_to(MOST_PASSING), *self._passing[:-1]]
        self.ready = [packet for packet in self.ready if self.due.covers(packet[1])]

    def asks(self) -> None:
        """This robot announces what it holds. Who has not been heard for long enough is asked for nothing
        more: it is gone, or was never there."""
        self._waited = {robot: self._waited.get(robot, 0) + 1 for robot in self._theirs}
        for robot, n in self._waited.items():
            if n >= PATIENCE:
                del self._theirs[robot]

    def announced(self, message: AnnouncementMessage, held: Intervals, dead: Intervals) -> None:
        """Another robot says what it holds. held: what is here, or was; dead: what of it is superseded."""
        gap = (held & message.scope) - message.held
        before = self._gaps.get(message.sender, Intervals.empty())
        lacking = (gap & self._own) | (gap & before)
        for passing in self._passing:
            lacking -= passing
        self.due = (self.due | lacking) - dead
        self._waited.pop(message.sender, None)
        for table, now in ((self._gaps, gap), (self._theirs, message.held - held)):
            known = table.pop(message.sender, Intervals.empty())
            table[message.sender] = (known - message.scope) | now
            while len(table) > MOST_PEERS:
                table.popitem(last=False)
            for robot in evict(table, MOST_REMEMBERED):
                del table[robot]

    def missing(self, held: Intervals) -> Intervals:
        """What others have announced that they hold, and is not held here."""
        return Intervals.union(self._theirs.values()) - held

    def state(self) -> dict[str, Any]:
        return {
            "due": self.due.stored(),
            "passing": [keys.stored() for keys in self._passing],
            "gaps": [[robot, gap.stored()] for robot, gap in self._gaps.items()],
            "theirs": [[robot, keys.stored()] for robot, keys in self._theirs.items()],
            "waited": [[robot, n] for robot, n in self._waited.items()],
            "ready": [[stored(datagram), keys.stored()] for datagram, keys in self.ready],
        }

    def forget_others(self) -> None:
        """Ask anew who lacks what, and take nothing to be on its way: time has passed."""
        self._passing = [Intervals.empty()] * _ON_THE_WAY
        self._gaps.clear()
        self._theirs.clear()
        self._waited.clear()

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a `state`."""
        self.due = Intervals.loaded(state["due"])
        self._passing = [Intervals.loaded(keys) for keys in state["passing"]][:_ON_THE_WAY]
        self._gaps, self._theirs = (
            OrderedDict((int(robot), Intervals.loaded(keys)) for robot, keys in state[name])
            for name in ("gaps", "theirs")
        )
        self._waited = {int(robot): int(n) for robot, n in state["waited"]}
        self.ready = [(loaded(data), Intervals.loaded(keys)) for data, keys in state["ready"]]

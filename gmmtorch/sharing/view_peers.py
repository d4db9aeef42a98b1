"""Who in the team seems to hold the same views, and whom to answer, and when."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field
from typing import Any

from gmmtorch.sharing.replica.intervals import Intervals, evict
from gmmtorch.sharing.replica.record_keys import keys_of_robot, robot_of

MOST_PEERS = 64
"""Robots that are remembered, those heard last."""
MOST_LACKED = 1 << 16
"""Intervals of what these lack, all together: 1 MiB. What the one lacks that lacks most is forgotten; it will
say so again."""
_PRESENT = 3
"""Rounds for which a robot that is not heard counts as there."""
_DIFFERENT = 2
"""Rounds in which a robot's digest differs until that is no matter of what is on its way."""
_PAUSE = 2
"""Rounds from one detailed announcement to the next, at least: as many as it takes to answer the first."""
_MOST_DIGESTS = 64


@dataclass
class _Peer:
    """heard: the round it was last heard in. differs: rounds in which its digest, `digest`, was unknown.

    lacks: what it lacked when it last said in detail what it holds, in the round `asked`; waited: how often
    before that it had said so, and lacked something.
    """

    heard: int = -1
    differs: int = 0
    digest: bytes = b""
    lacks: Intervals = field(default_factory=Intervals.empty)
    waited: int = 0
    asked: int = -1


class Peers:
    """What is known of the others' views. A round goes from one announcement made here to the next.

    A digest that this robot's own set has had in this round or the last is no difference: its sender has not
    heard the last changes yet. Nor is one that this set comes to have: its sender had heard them first.

    Not all answer at once. All are in a row, and answer in the turn of their places: the first at once,
    the second where that has not helped by the next time, then the third and fourth, then the next four,
    … So one robot answers where all hear one another, and somebody does where they do not.
    """

    def __init__(self, robot: int) -> None:
        self._robot = robot
        self._round, self._detailed = 0, -_PAUSE
        self._recent: OrderedDict[bytes, int] = OrderedDict()  # own digests, and the round of each
        self._peers: OrderedDict[int, _Peer] = OrderedDict()

    def holds(self, digest: bytes) -> None:
        """This robot's set has this digest now."""
        self._recent.pop(digest, None)
        self._recent[digest] = self._round
        if len(self._recent) > _MOST_DIGESTS:
            self._recent.popitem(last=False)
        for peer in self._peers.values():
            if peer.digest == digest:
                _agree(peer)

    def announced(self, sender: int, digest: bytes) -> None:
        """Another robot's set has this digest."""
        peer = self._peers.pop(sender, None) or _Peer()
        self._peers[sender] = peer
        while len(self._peers) > MOST_PEERS:
            self._peers.popitem(last=False)
        if digest in self._recent:
            _agree(peer)
        else:
            peer.differs += peer.heard != self._round or not peer.differs
            peer.digest = digest
        peer.heard = self._round

    def differ(self) -> bool:
        """Whether somebody, when last heard, held something else than this robot."""
        return any(self._peers[robot].differs for robot in self._present())

    def lacking(self, sender: int, scope: Intervals, gap: Intervals) -> Intervals:
        """Of the keys in `scope` a robot that was just heard lacks `gap`; what of it this robot sends.

        Who found a view is first in the row, if it is there; then they go by their numbers.
        """
        peer = self._peers[sender]
        if peer.asked != self._round:
            peer.asked, peer.waited = self._round, peer.waited + 1 if peer.lacks else 0
        still = gap & peer.lacks
        peer.lacks = (peer.lacks - scope) | gap
        for robot in evict({robot: peer.lacks for robot, peer in self._peers.items()}, MOST_LACKED):
            self._peers[robot].lacks = Intervals.empty()
        others = [robot for robot in self._present() if robot != sender]
        due = Intervals.empty()
        for owner in _owners(gap):
            part = gap & keys_of_robot(owner)
            before = [robot for robot in others if robot < self._robot or robot == owner]
            turn = 0 if owner == self._robot else len(before).bit_length()
            if turn == 0:
                due |= part
            elif peer.waited >= turn:
                due |= part & still
        return due

    def next_round(self, digest: bytes) -> bool:
        """A round begins, with this digest; whether the announcement of it is to be a detailed one.

        Of those who seem to hold the same the first by number is the first in the row.
        """
        self._round += 1
        self.holds(digest)
        last = {digest: at for digest, at in self._recent.items() if at >= self._round - 1}
        self._recent = OrderedDict(last)
        there = self._present()
        before = [robot for robot in there if robot < self._robot and not self._peers[robot].differs]
        patience = _DIFFERENT + len(before).bit_length()
        asks = any(self._peers[robot].differs >= patience for robot in there)
        # In a large team something is always on its way, digests hardly ever agree, and many ask.
        if asks and self._round - self._detailed >= max(_PAUSE, len(there).bit_length()):
            self._detailed = self._round
            return True
        return False

    def _present(self) -> list[int]:
        return sorted(robot for robot, peer in self._peers.items() if self._round - peer.heard <= _PRESENT)

    # -- keeping ----------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        rows = []
        for robot, peer in self._peers.items():
            values = dict(vars(peer))
            rows.append({**values, "robot": robot, "digest": peer.digest.hex(), "lacks": peer.lacks.stored()})
        recent = [[digest.hex(), at] for digest, at in self._recent.items()]
        return {"round": self._round, "detailed": self._detailed, "recent": recent, "peers": rows}

    def restore(self, state: dict[str, Any]) -> None:
        self._round, self._detailed = int(state["round"]), int(state["detailed"])
        self._recent = OrderedDict((bytes.fromhex(digest), int(at)) for digest, at in state["recent"])
        self._peers = OrderedDict()
        for row in state["peers"]:
            numbers = {name: int(row[name]) for name in ("heard", "differs", "waited", "asked")}
            self._peers[int(row["robot"])] = _Peer(
                **numbers, digest=bytes.fromhex(row["digest"]), lacks=Intervals.loaded(row["lacks"])
            )


def _agree(peer: _Peer) -> None:
    peer.differs, peer.digest, peer.lacks, peer.waited = 0, b"", Intervals.empty(), 0


def _owners(keys: Intervals) -> list[int]:
    """Whose keys these are."""
    spans = {(robot_of(begin), robot_of(end - 1)) for begin, end in keys.pairs()}
    return sorted({robot for first, last in spans for robot in range(first, last + 1)})

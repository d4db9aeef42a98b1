"""Radio: what one robot says of its map, how often and in how many bytes; and what it hears."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

from gmmtorch.errors import DataError
from gmmtorch.exploration.robot.heartbeat import Heartbeat
from gmmtorch.sharing.messages.message_registry import Message, decode, kind_of
from gmmtorch.sharing.transport.simulated_network import Transport
from gmmtorch.sharing.transport.token_bucket import TokenBucket


class ReceivedMessage(NamedTuple):
    """A datagram as it arrived, and what it says."""

    sender: int
    datagram: bytes
    message: Message


class Logbook(Protocol):
    """Where what is said and heard is kept, before it is sent or announced: see `sharing.journal`."""

    def said(self, datagrams: Sequence[bytes]) -> None: ...
    def heard(self, datagrams: Sequence[bytes]) -> None: ...


class Radio:
    """A robot's end of a network. What it says is in its logbook before it is sent, if it has one.

    Args:
        robot: its number. transport: its end of the network.
        announce_every: seconds between announcements while there is news; see `Heartbeat`.
        budget: bytes a second, of records and of views; None: no limit.
        decode: says what a datagram says, or raises `DataError`.
    """

    def __init__(
        self,
        robot: int,
        transport: Transport,
        announce_every: float,
        budget: float | None = None,
        decode: Callable[[bytes], Message] = decode,
    ) -> None:
        self.robot, self.transport = robot, transport
        self.logbook: Logbook | None = None
        self.n_heard = 0
        """Datagrams that have come."""
        self.n_damaged = 0
        """Of them, those that say nothing that can be understood."""
        self._heartbeat = Heartbeat(announce_every)
        self._budget = None if budget is None else TokenBucket(budget)
        self._decode = decode

    def within_budget(
        self, made: Callable[[int | None], list[bytes]], now: float, spare: int = 0
    ) -> list[bytes]:
        """What `made` makes of the bytes that there are for it at the time `now` (s), None if there is no
        limit. To be told at once.

        spare: bytes; where fewer are left, nothing is made. A datagram's, for what comes after the records:
        a record that waits has first of all what it still needs.
        """
        if self._budget is None:
            return made(None)
        available = self._budget.available(now)
        if available < spare:
            return []
        datagrams = made(available)
        self._budget.take(sum(map(len, datagrams)))
        return datagrams

    def announces(self, now: float, content: tuple[int, ...], urgent: bool) -> bool:
        """Whether it is time to announce a content that these numbers stand for; it is taken to be done."""
        return self._heartbeat.due(now, content, urgent)

    def tell(self, datagrams: Sequence[bytes], now: float) -> None:
        """Broadcast datagrams."""
        if self.logbook is not None:
            self.logbook.said(datagrams)
        by_kind: dict[str, list[bytes]] = {}
        for datagram in datagrams:
            by_kind.setdefault(kind_of(datagram), []).append(datagram)
        for kind, some in by_kind.items():
            self.transport.send(self.robot, some, now, kind)

    def hear(self, now: float) -> list[ReceivedMessage]:
        """What has come by `now`, and can be understood, sorted by sender, which no longer tells who was
        quicker."""
        arrived = sorted(self.transport.deliver(self.robot, now), key=lambda pair: pair[0])
        self.n_heard += len(arrived)
        heard = []
        for sender, datagram in arrived:
            try:
                heard.append(ReceivedMessage(sender, datagram, self._decode(datagram)))
            except DataError:
                self.n_damaged += 1
        return heard

    def keep(self, merged: Sequence[bytes]) -> None:
        """Datagrams that were heard are part of the map now: into the logbook, before it is announced."""
        if self.logbook is not None:
            self.logbook.heard(merged)

    def twin(self, conflicts: int) -> str | None:
        """What is said of another robot of this number, if there is one: if the transport has met it, or so
        many records that came contradict this robot's own."""
        met: str | None = getattr(self.transport, "namesakes", {}).get(self.robot)
        if met is None and not conflicts:
            return None
        whence = "" if met is None else f" ({met})"
        return (
            f"Another robot says that it is robot {self.robot}{whence}: give each a number (id=…) and a "
            "folder of its own."
        )

    def remarks(self, conflicts: int) -> str:
        """What the end of a status line says of the network, if something is wrong; see `twin`."""
        alone = getattr(self.transport, "n_neighbours", None) == 0
        twin = self.twin(conflicts) is not None
        return (", connected to nobody" if alone else "") + (
            f", another robot {self.robot} is there" if twin else ""
        )

    def state(self) -> dict[str, Any]:
        """Everything that changes, but the transport and the logbook."""
        return {
            "n_heard": self.n_heard,
            "n_damaged": self.n_damaged,
            "heartbeat": self._heartbeat.state(),
            "budget": None if self._budget is None else self._budget.state(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a `state`."""
        self.n_heard, self.n_damaged = int(state["n_heard"]), int(state["n_damaged"])
        self._heartbeat.restore(state["heartbeat"])
        if self._budget is not None:
            self._budget.restore(state["budget"])

"""Radio: one robot's end of a network. It bounds what the robot sends, and decodes what it receives."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from gmmtorch.errors import DataError, GmmTorchError, InvalidArgumentError
from gmmtorch.team.sharing.messages.message_registry import Message, decode, kind_of
from gmmtorch.team.sharing.transport.simulated_network import Transport

if TYPE_CHECKING:
    from gmmtorch.team.sharing.store import Store

_BURST, _LEAST_BURST = 1.0, 1200.0
"""Seconds of the rate that may be sent in one burst; and bytes, at least: one datagram."""


class TokenBucket:
    """In any t seconds at most `rate` (bytes per second) · t bytes are taken, and one burst: a second of the
    rate, or a datagram. The times may come from any clock; if it is set back, that step adds nothing."""

    def __init__(self, rate: float) -> None:
        if not 0 < rate < math.inf:
            raise InvalidArgumentError(f"budget={rate} must be above zero bytes per second, and finite.")
        self.rate = float(rate)
        self._most = max(_BURST * self.rate, _LEAST_BURST)
        self._tokens = self._most
        self._last: float | None = None

    def available(self, now: float) -> int:
        """Whole bytes that may be sent at the time `now` (s)."""
        if self._last is not None and now > self._last:
            self._tokens = min(self._most, self._tokens + self.rate * (now - self._last))
        self._last = now
        return max(0, int(self._tokens))

    def take(self, n_bytes: int) -> None:
        """Subtract bytes that were sent. More than were available delay later ones."""
        self._tokens -= n_bytes


_LONGEST_PAUSE = 16  # announcement periods between two announcements of the same content, at most
_COMPLETE_PAUSE = 4
"""Announcement periods between those of a robot that knows of no record that it lacks, after its first. They
only show others its last records: that earlier ones were lost, later records show."""


class ReceivedMessage(NamedTuple):
    """A datagram as it arrived, and the decoded message."""

    sender: int
    datagram: bytes
    message: Message


class AnnouncementSchedule:
    """When a robot announces which records it holds: every `period` (s) while some are missing, and every
    fourth period while they only change. A lost announcement must be repeated, but a team at rest would send
    little else. So the pause doubles after each announcement without news, up to 16 periods."""

    def __init__(self, period: float) -> None:
        if not 0 < period < math.inf:
            raise InvalidArgumentError(f"announce_every={period} must be above zero seconds, and finite.")
        self._period = self._pause = float(period)
        self._last: float | None = None
        self._announced: tuple[int, ...] | None = None
        self._has_announced = False

    def due(self, now: float, content: tuple[int, ...], urgent: bool = False, complete: bool = False) -> bool:
        """Whether to announce at the time `now` (s). If so, the caller must announce.

        The first call starts the first period, and so does a clock that was set back.

        content: changes whenever what is announced changes. urgent: whether others announced records that are
        missing. complete: whether no record is missing before those that are held.
        """
        if self._last is None or now < self._last:
            self._last, self._announced, self._pause = now, content, self._period
            return False
        is_old = content == self._announced and not urgent
        is_calm = complete and not urgent and self._has_announced
        fresh = self._period * (_COMPLETE_PAUSE if is_calm else 1)
        pause = max(self._pause, fresh) if is_old else fresh
        if now - self._last < pause - 1e-9:
            return False
        self._pause = min(2 * pause, _LONGEST_PAUSE * self._period) if is_old else self._period
        self._last, self._announced, self._has_announced = now, content, True
        return True


class Radio:
    """A robot's end of a network.

    Args:
        robot: its id. transport: the network.
        announce_every: seconds between announcements while records are missing.
        budget: bytes per second for records and views; None: no limit.
        decode: turns a datagram into a message, or raises `DataError`.

    Attributes:
        store: keeps records before they are sent, and after they were merged; None: nothing is kept.
        announcements: when to announce.
        n_received: datagrams that arrived. n_damaged: those of them that could not be decoded.
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
        self.store: Store | None = None
        self.announcements = AnnouncementSchedule(announce_every)
        self.n_received = self.n_damaged = 0
        self._budget = None if budget is None else TokenBucket(budget)
        self._decode = decode

    @staticmethod
    def check(announce_every: float, budget: float | None) -> None:
        """Raises `InvalidArgumentError` unless these are arguments of a radio."""
        AnnouncementSchedule(announce_every)
        if budget is not None:
            TokenBucket(budget)

    def within_budget(
        self, make: Callable[[int | None], list[bytes]], now: float, spare: int = 0
    ) -> list[bytes]:
        """Datagrams to be sent now, which `make` makes from the bytes available at the time `now` (s); None
        means no limit.

        spare: bytes that must be available, or nothing is made. Views need room for a whole datagram, so that
        they never delay a record.
        """
        if self._budget is None:
            return make(None)
        available = self._budget.available(now)
        if available < spare:
            return []
        datagrams = make(available)
        self._budget.take(sum(map(len, datagrams)))
        return datagrams

    def send(self, datagrams: Sequence[bytes], now: float) -> None:
        """Stores the records of datagrams, then broadcasts the datagrams."""
        self.keep(datagrams)
        by_kind: dict[str, list[bytes]] = {}
        for datagram in datagrams:
            by_kind.setdefault(kind_of(datagram), []).append(datagram)
        for kind, some in by_kind.items():
            self.transport.send(self.robot, some, now, kind)

    def receive(self, now: float) -> list[ReceivedMessage]:
        """The sound messages that arrived by the time `now` (s), sorted by sender. So the result does not
        depend on which sender was faster."""
        arrived = sorted(self.transport.deliver(self.robot, now), key=lambda pair: pair[0])
        self.n_received += len(arrived)
        received = []
        for sender, datagram in arrived:
            try:
                received.append(ReceivedMessage(sender, datagram, self._decode(datagram)))
            except DataError:
                self.n_damaged += 1
        return received

    def keep(self, datagrams: Sequence[bytes]) -> None:
        """Stores the records of datagrams. Merged datagrams must be stored before they are announced."""
        if self.store is not None:
            self.store.keep(datagrams)

    def row(self) -> dict[str, Any]:
        """What was sent, received, and not stored, as a part of a row of results.json."""
        received = {"heard": self.n_received, "damaged": self.n_damaged}
        unkept = {"unkept": 0 if self.store is None else self.store.n_failed}  # batches of records
        return {**self.transport.books(self.robot), **received, **unkept}

    def duplicate_id(self, n_conflicts: int) -> str | None:
        """An error message if another robot uses this robot's id, else None.

        n_conflicts: records that arrived under this robot's id, and contradict what it sent.
        """
        source: str | None = getattr(self.transport, "duplicates", {}).get(self.robot)
        if source is None and not n_conflicts:
            return None
        address = "" if source is None else f" ({source})"
        return (
            f"Another robot uses the id of robot {self.robot}{address}: give each robot its own id (id=…) "
            "and its own folder."
        )

    def check_id(self, n_conflicts: int) -> None:
        """Raises `GmmTorchError` if another robot uses this robot's id; see `duplicate_id`."""
        if (message := self.duplicate_id(n_conflicts)) is not None:
            raise GmmTorchError(message)

    def warnings(self, n_conflicts: int) -> str:
        """The end of a status line: what is wrong with the network, or nothing."""
        is_alone = getattr(self.transport, "n_neighbours", None) == 0
        is_duplicate = self.duplicate_id(n_conflicts) is not None
        return (", no robot connected" if is_alone else "") + (
            f", another robot has id {self.robot}" if is_duplicate else ""
        )

"""FramedTransport: what UDP and Zenoh have in common: frames, a queue of received datagrams, and
statistics."""

from __future__ import annotations

import logging
import random
import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterable, Sequence
from typing import Any, Self

from gmmtorch.errors import GmmTorchError, InvalidArgumentError, check_whole
from gmmtorch.team.sharing.transport.security import Opener, Sealer, TeamKey
from gmmtorch.team.sharing.transport.simulated_network import Traffic, sum_of

MAX_WAITING = 4096
"""Datagrams in the queue; of more, the oldest are dropped."""
_log = logging.getLogger(__name__)


class FramedTransport(ABC):
    """One robot's end of a real network; see `Transport`. Close it, or use it as a context manager.

    A subclass sends frames (`_carry`), passes received ones to `_take` from one thread, and ends that thread
    (`_shut`). A network that is down is no error: `_count_failure` counts it. The times `now` are not used:
    `deliver` returns what has arrived.

    Attributes:
        sent, received: frames that were given to the network and that came from it, refused ones included.
        failures: number of network errors, by the name of the error. n_dropped, n_lost: datagrams that were
            dropped because the queue was full, and as `lose` demands.
    """

    def __init__(self, robot: int, key: TeamKey | None, max_waiting: int) -> None:
        self._sealer = Sealer(robot, key)
        self._opener = Opener(key, self._sealer)
        self.robot = self._sealer.sender
        self._waiting: deque[tuple[int, bytes]] = deque()
        self._max_waiting = check_whole("max_waiting", max_waiting, 1)
        self.sent, self.received = Traffic(), Traffic()
        self.failures: dict[str, int] = {}
        self.n_dropped = self.n_lost = 0
        self._loss, self._random = 0.0, random.Random(0)
        self._broadcast: dict[str, Traffic] = {}
        self._lock = threading.Lock()
        self._closing = threading.Event()

    @abstractmethod
    def _carry(self, frame: bytes, kind: str) -> Traffic:
        """Send a frame without waiting; returns what was sent, nothing after an error."""

    @abstractmethod
    def _shut(self) -> None:
        """Stop listening, and release resources. Called once."""

    def send(self, sender: int, datagrams: Sequence[bytes], now: float, kind: str) -> None:
        """Broadcast datagrams of at most 1200 bytes; `sender` must be this robot. See `Transport`. Does not
        wait: datagrams that the network does not take at once are lost."""
        self._check("sender", sender)
        frames = [self._sealer.seal(datagram) for datagram in datagrams]
        carried = sum_of(*(self._carry(frame, kind) for frame in frames))
        said = Traffic(len(frames), sum(map(len, datagrams)))
        with self._lock:
            self.sent = sum_of(self.sent, carried)
            self._broadcast[kind] = sum_of(self._broadcast.get(kind, Traffic()), said)

    def deliver(self, robot: int, now: float) -> list[tuple[int, bytes]]:
        """(sender, datagram) in the order of arrival, at most `max_waiting`; see `Transport`. Does not
        wait."""
        self._check("robot", robot)
        with self._lock:
            delivered = list(self._waiting)
            self._waiting.clear()
        return delivered

    def lose(self, share: float, seed: int = 0) -> None:
        """From now on drop a share, in [0, 1), of the received datagrams, to simulate a bad network."""
        if not 0 <= share < 1:
            raise InvalidArgumentError(f"share={share} must be a share of the datagrams in [0, 1).")
        self._loss, self._random = float(share), random.Random(seed)

    @property
    def session(self) -> bytes:
        """The session of this start, 8 random bytes."""
        return self._sealer.session

    def disown(self, former: Iterable[bytes]) -> None:
        """Set the sessions of this robot's former starts. Their frames are no sign of a duplicate robot id.
        Without them, `security.OwnIdWatch` decides by the frames' numbers and times."""
        self._opener.former = frozenset(former)

    @property
    def n_neighbours(self) -> int | None:
        """Connections to others now; None if the network has no connections."""
        return None

    def traffic(self, sender: int | None = None, kind: str | None = None) -> Traffic:
        """What this robot has broadcast, as `Network` counts: each datagram once, without its frame."""
        if sender not in (None, self.robot):
            return Traffic()
        with self._lock:
            return sum_of(*(traffic for what, traffic in self._broadcast.items() if kind in (None, what)))

    @property
    def wire_bytes(self) -> int:
        """Bytes of all broadcasts, each once, with the headers of frame, UDP and IPv4."""
        said = self.traffic()
        return said.wire_bytes + self.overhead * said.datagrams

    def books(self, robot: int) -> dict[str, Any]:
        """Traffic and errors, as fields of a results row. `robot` must be this one. A robot's own frames that
        multicast brings back are not counted as refused."""
        self._check_robot("robot", robot)
        said = self.traffic()
        with self._lock:
            by_kind = {kind: traffic.bytes for kind, traffic in sorted(self._broadcast.items())}
        return {
            "session": self.session.hex(),
            "neighbours": self.n_neighbours,
            "bytes_sent": said.bytes,
            "datagrams": said.datagrams,
            "bytes_by_kind": by_kind,
            "wire_bytes": self.wire_bytes,
            "wire_bytes_received": self.received.wire_bytes,
            "socket_bytes": self.sent.bytes,
            "socket_datagrams": self.sent.datagrams,
            "refused": {reason: n for reason, n in self.refused.items() if n and reason != "echo"},
            "failures": dict(self.failures),
            "dropped": self.n_dropped,
            "namesakes": {str(robot): sources for robot, sources in sorted(self.duplicates.items())},
        }

    @property
    def overhead(self) -> int:
        """Bytes that a frame adds to a datagram."""
        return self._sealer.overhead

    @property
    def refused(self) -> dict[str, int]:
        """Number of received frames that were refused, by reason: `security.REFUSALS`."""
        return dict(self._opener.refused)

    @property
    def duplicates(self) -> dict[int, str]:
        """Robot ids that two robots use, with the addresses and sessions of both."""
        return self._opener.duplicates

    def close(self) -> None:
        """Stop listening, and drop the queue. May be called again."""
        if not self._closing.is_set():
            self._closing.set()
            self._shut()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _check_robot(self, name: str, robot: int) -> None:
        if robot != self.robot:
            raise InvalidArgumentError(f"{name}={robot} must be {self.robot}, the robot of this transport.")

    def _check(self, name: str, robot: int) -> None:
        self._check_robot(name, robot)
        if self._closing.is_set():
            raise GmmTorchError(f"The transport of robot {self.robot} is closed; open another.")

    def _take(self, frame: bytes, source: str) -> None:
        """Open a received frame of any bytes, and append its datagram to the queue. For one thread."""
        opened = self._opener.open(frame, source)
        with self._lock:
            self.received = sum_of(self.received, Traffic(1, len(frame)))
            if opened is not None and self._random.random() < self._loss:
                self.n_lost += 1
            elif opened is not None:
                if len(self._waiting) == self._max_waiting:
                    self._waiting.popleft()
                    self.n_dropped += 1
                self._waiting.append(opened)

    def _count_failure(self, name: str, message: str, direction: str) -> None:
        """Count a network error, and log the first one of each name."""
        with self._lock:
            self.failures[name] = n = self.failures.get(name, 0) + 1
        if n == 1:
            _log.warning("Robot %d lost a datagram %s: %s (%s).", self.robot, direction, message, name)

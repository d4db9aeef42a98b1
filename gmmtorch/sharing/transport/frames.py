"""What all transports of real networks have in common: frames, datagrams that wait, and the books."""

from __future__ import annotations

import logging
import random
import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterable, Sequence
from types import TracebackType
from typing import Any, Self

from gmmtorch.errors import GmmTorchError, InvalidArgumentError, check_whole
from gmmtorch.sharing.transport.security import Opener, Sealer, TeamKey
from gmmtorch.sharing.transport.simulated_network import Traffic

MAX_WAITING = 4096
"""Datagrams that wait to be delivered; of more, the oldest are dropped."""
_log = logging.getLogger(__name__)


class FramedTransport(ABC):
    """One robot's end of a network; see `Transport`. To be closed, or used as a context manager.

    A subclass carries frames: `_carry` sends one, `_take` is given what comes in, by one thread of the
    subclass, and `_shut` ends that thread. A network that is down is no error: `_fails` counts.
    Times `now` are not used: what is there is delivered, whatever the clocks of the team say.
    """

    def __init__(self, robot: int, key: TeamKey | None, max_waiting: int) -> None:
        self._sealer = Sealer(robot, key)
        self._opener = Opener(key, self._sealer)
        self.robot = self._sealer.sender
        self._waiting: deque[tuple[int, bytes]] = deque()
        self._max_waiting = check_whole("max_waiting", max_waiting, 1)
        self.sent, self.received = Traffic(), Traffic()
        """What has been given to the network and come from it: frames, refused ones too."""
        self.failures: dict[str, int] = {}
        """How often the network failed, by the name of the error."""
        self.n_dropped = 0
        """Datagrams that were opened, waited, and had to give way to newer ones."""
        self.n_lost = 0
        """Datagrams that were thrown away, as `lose` asked for."""
        self._loss, self._drawn = 0.0, random.Random(0)
        self._broadcast: dict[str, Traffic] = {}
        self._lock = threading.Lock()
        self._closing = threading.Event()

    @abstractmethod
    def _carry(self, frame: bytes, kind: str) -> Traffic:
        """Send a frame, without waiting; what has left, or nothing after `_fails`."""

    @abstractmethod
    def _shut(self) -> None:
        """Stop listening, and give back what is held. Called once."""

    # -- the transport -------------------------------------------------------------------------------------

    def send(self, sender: int, datagrams: Sequence[bytes], now: float, kind: str) -> None:
        """Broadcast datagrams of at most 1200 bytes; the only `sender` is this robot. See `Transport`.

        Does not wait: what the network does not take at once is lost.
        """
        self._check("sender", sender)
        frames = [self._sealer.seal(datagram) for datagram in datagrams]
        carried = _sum(*(self._carry(frame, kind) for frame in frames))
        said = Traffic(len(frames), sum(map(len, datagrams)))
        with self._lock:
            self.sent = _sum(self.sent, carried)
            self._broadcast[kind] = _sum(self._broadcast.get(kind, Traffic()), said)

    def deliver(self, robot: int, now: float) -> list[tuple[int, bytes]]:
        """(sender, datagram) in the order of arrival, at most `max_waiting`; see `Transport`. Never waits."""
        self._check("robot", robot)
        with self._lock:
            delivered = list(self._waiting)
            self._waiting.clear()
        return delivered

    def lose(self, share: float, seed: int = 0) -> None:
        """From now on throw away a share, [0, 1), of what comes: to try what a team makes of it."""
        if not 0 <= share < 1:
            raise InvalidArgumentError(f"share={share} must be a share of the datagrams in [0, 1).")
        self._loss, self._drawn = float(share), random.Random(seed)

    @property
    def session(self) -> bytes:
        """The session of this start, drawn at random."""
        return self._sealer.session

    def disown(self, former: Iterable[bytes]) -> None:
        """Sessions of this robot's former starts: frames of them, late or played back, are no other robot's.

        Without them it is told by how they come: see `sessions.TwinWatch`.
        """
        self._opener.former = frozenset(former)

    @property
    def n_neighbours(self) -> int | None:
        """To how many others it is connected now; None where there are no connections."""
        return None

    # -- the books -----------------------------------------------------------------------------------------

    def traffic(self, sender: int | None = None, kind: str | None = None) -> Traffic:
        """What this robot has broadcast, counted as `Network` does: each datagram once, without its frame."""
        if sender not in (None, self.robot):
            return Traffic()
        with self._lock:
            return _sum(*(traffic for what, traffic in self._broadcast.items() if kind in (None, what)))

    @property
    def wire_bytes(self) -> int:
        """Of all that was broadcast, each once, with the headers of its frame, of UDP and of IPv4."""
        said = self.traffic()
        return said.wire_bytes + self.overhead * said.datagrams

    def books(self, robot: int) -> dict[str, Any]:
        """What has passed, and what went wrong, for results; `robot`: this one. Its own frames, which
        multicast brings back, are nothing wrong."""
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
            "namesakes": {str(number): whence for number, whence in sorted(self.namesakes.items())},
        }

    @property
    def overhead(self) -> int:
        """Bytes that a frame adds to a datagram."""
        return self._sealer.overhead

    @property
    def refused(self) -> dict[str, int]:
        """How many frames that came in were refused, by reason: `security.REFUSALS`."""
        return dict(self._opener.refused)

    @property
    def namesakes(self) -> dict[int, str]:
        """Numbers that two robots have, and whence they were heard."""
        return self._opener.namesakes

    # -- closing -------------------------------------------------------------------------------------------

    def close(self) -> None:
        """Stop listening, and give back what is held. What waits is forgotten. May be called again."""
        if not self._closing.is_set():
            self._closing.set()
            self._shut()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # -- inside --------------------------------------------------------------------------------------------

    def _check_robot(self, name: str, robot: int) -> None:
        if robot != self.robot:
            raise InvalidArgumentError(f"{name}={robot} must be {self.robot}, the robot of this transport.")

    def _check(self, name: str, robot: int) -> None:
        self._check_robot(name, robot)
        if self._closing.is_set():
            raise GmmTorchError(f"The transport of robot {self.robot} is closed; open another.")

    def _take(self, frame: bytes, source: str) -> None:
        """Open what has come in, and let it wait; any bytes may be given. Not by two threads at once."""
        opened = self._opener.open(frame, source)
        with self._lock:
            self.received = _sum(self.received, Traffic(1, len(frame)))
            if opened is not None and self._drawn.random() < self._loss:
                self.n_lost += 1
            elif opened is not None:
                if len(self._waiting) == self._max_waiting:
                    self._waiting.popleft()
                    self.n_dropped += 1
                self._waiting.append(opened)

    def _fails(self, name: str, what: str, whither: str) -> None:
        """Count it, and say so the first time."""
        with self._lock:
            self.failures[name] = n = self.failures.get(name, 0) + 1
        if n == 1:
            _log.warning(
                "Robot %d goes on without what did not get %s: %s (%s).", self.robot, whither, what, name
            )


def _sum(*traffic: Traffic) -> Traffic:
    return Traffic(sum(t.datagrams for t in traffic), sum(t.bytes for t in traffic))

"""Transport, which carries datagrams between robots; and Network, a simulated one, with its conditions."""

from __future__ import annotations

import heapq
import math
from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import torch

from gmmtorch.errors import InvalidArgumentError, check_whole
from gmmtorch.team.sharing.messages.datagrams import check_datagram
from gmmtorch.team.sharing.transport.link_conditions import LinkConditions

HEADER_BYTES = 28
"""Headers of a datagram on the wire: 20 of IPv4, 8 of UDP."""

_OTHER_SEED = 0x5851F42D4C957F2D  # a second, different stream of the same seed


class Transport(Protocol):
    """What a mission needs of a network. Datagrams may be lost, but are never changed."""

    def send(self, sender: int, datagrams: Sequence[bytes], now: float, kind: str) -> None:
        """Broadcast datagrams at the time `now` (s); `kind` names their contents for the statistics."""

    def deliver(self, robot: int, now: float) -> list[tuple[int, bytes]]:
        """(sender, datagram) of all that arrived at a robot by `now` and was not delivered before."""
        ...

    def books(self, robot: int) -> dict[str, Any]:
        """What a robot sent and received, as fields of a results row."""
        ...


class Traffic(NamedTuple):
    """Datagrams and bytes that were sent. Each broadcast counts once, however many robots receive it."""

    datagrams: int = 0
    bytes: int = 0

    @property
    def wire_bytes(self) -> int:
        """With the headers of UDP and IPv4."""
        return self.bytes + HEADER_BYTES * self.datagrams


def sum_of(*traffic: Traffic) -> Traffic:
    return Traffic(sum(t.datagrams for t in traffic), sum(t.bytes for t in traffic))


class Reception(NamedTuple):
    """What happened to the datagrams of other robots on the way to a receiver.

    datagrams, bytes: delivered, copies included. duplicated: second copies that the network made. lost,
    cut_off (by a partition), out_of_reach: never delivered. With those still in flight,

        sent by others + duplicated = datagrams + lost + cut_off + out_of_reach + in flight.
    """

    datagrams: int = 0
    bytes: int = 0
    duplicated: int = 0
    lost: int = 0
    cut_off: int = 0
    out_of_reach: int = 0


_Arrival = tuple[float, int, int, bytes]
"""A datagram in flight to one robot: time, order of sending, sender, datagram; sorted by the first two."""


class Network:
    """A simulated broadcast network of `n_robots`. All links have the same `conditions`.

    A sender transmits its datagrams one after another, each for its bytes on the wire divided by `bandwidth`;
    the queue is unlimited. A datagram arrives at each other robot after `latency` and an exponential delay of
    mean `jitter`, and with probability `duplication` a second time with another delay. It never arrives if

    1. the robot is out of `reach` of the sender when `send` is called;
    2. a partition divides the two at any time from the begin of transmission to arrival. Of two copies the
       second alone may be cut off; a datagram whose first copy is cut off has no second;
    3. the robot loses it, with probability `loss`.

    Losses have a random generator of their own: the same `seed` loses the same datagrams under all other
    conditions.
    """

    def __init__(self, n_robots: int, conditions: LinkConditions | None = None, seed: int = 0) -> None:
        """conditions: None: the defaults. seed: of all random draws."""
        self.n_robots = check_whole("n_robots", n_robots, 1)
        self.conditions = LinkConditions() if conditions is None else conditions
        self.conditions.check_team(self.n_robots)
        seed = check_whole("seed", seed, 0)
        self._losses = torch.Generator().manual_seed(seed)
        self._delays = torch.Generator().manual_seed(seed ^ _OTHER_SEED)
        self._busy_until = [-math.inf] * self.n_robots
        self._queues: list[list[_Arrival]] = [[] for _ in range(self.n_robots)]
        self._positions: list[list[float]] | None = None
        self._n_sent = 0
        self._traffic: dict[tuple[int, str], Traffic] = {}
        self._received: list[Counter[str]] = [Counter() for _ in range(self.n_robots)]

    def place(self, positions: torch.Tensor) -> None:
        """Set the positions (n_robots, D), metres, of the robots. Only `reach` needs them."""
        if positions.ndim != 2 or len(positions) != self.n_robots or not positions.isfinite().all():
            raise InvalidArgumentError(
                f"positions of shape {tuple(positions.shape)} must be finite metres, one row for each of "
                f"{self.n_robots} robots."
            )
        self._positions = positions.double().tolist()

    def send(self, sender: int, datagrams: Sequence[bytes], now: float, kind: str) -> None:
        """Broadcast datagrams of at most 1200 bytes at the time `now` (s); see `Transport`."""
        self._check("sender", sender, now)
        for data in datagrams:
            check_datagram(data)
        others = [robot for robot in range(self.n_robots) if robot != sender]
        near = self._near(sender, others)
        for data in datagrams:
            begin, end = self._transmission(sender, len(data), now)
            lost = self.conditions.draw_losses(len(others), self._losses)
            delays = self.conditions.draw_delays(len(others), self._delays)
            for robot, is_near, is_lost, times in zip(others, near, lost, delays, strict=True):
                copies = [(end + time, self._n_sent, sender, data) for time in times]
                self._carry(copies, robot, begin, is_near, is_lost)
            self._n_sent += 1
        sent = Traffic(len(datagrams), sum(map(len, datagrams)))
        self._traffic[sender, kind] = sum_of(self._traffic.get((sender, kind), Traffic()), sent)

    def deliver(self, robot: int, now: float) -> list[tuple[int, bytes]]:
        """(sender, datagram) in the order of arrival, at equal times in that of sending; see `Transport`."""
        self._check("robot", robot, now)
        queue, delivered = self._queues[robot], []
        while queue and queue[0][0] <= now:
            _, _, sender, datagram = heapq.heappop(queue)
            delivered.append((sender, datagram))
        self._received[robot]["datagrams"] += len(delivered)
        self._received[robot]["bytes"] += sum(len(data) for _, data in delivered)
        return delivered

    def traffic(self, sender: int | None = None, kind: str | None = None) -> Traffic:
        """What was sent, by one sender or all, of one kind or all."""
        chosen = [
            traffic
            for (who, what), traffic in self._traffic.items()
            if sender in (None, who) and kind in (None, what)
        ]
        return sum_of(*chosen)

    def reception(self, robot: int | None = None) -> Reception:
        """Of the datagrams sent to one robot; or to all, where each broadcast counts for every receiver."""
        if robot is not None:
            self._check("robot", robot)
        chosen = self._received if robot is None else [self._received[robot]]
        return Reception(*(sum(counts[field] for counts in chosen) for field in Reception._fields))

    @property
    def bytes_by_kind(self) -> dict[str, int]:
        """Bytes without headers, by the kinds that the senders gave, sorted."""
        return {kind: self.traffic(kind=kind).bytes for kind in sorted({k for _, k in self._traffic})}

    def books(self, robot: int) -> dict[str, Any]:
        """What one robot sent and received, as fields of a results row; see `FramedTransport.books`."""
        sent, got = self.traffic(robot), self.reception(robot)
        kinds = sorted(kind for who, kind in self._traffic if who == robot)
        return {
            "bytes_sent": sent.bytes,
            "datagrams": sent.datagrams,
            "bytes_by_kind": {kind: self.traffic(robot, kind).bytes for kind in kinds},
            "wire_bytes": sent.wire_bytes,
            "wire_bytes_received": Traffic(got.datagrams, got.bytes).wire_bytes,
            "refused": {},
            "failures": {},
            "dropped": 0,
            "namesakes": {},
        }

    def _near(self, sender: int, others: Sequence[int]) -> list[bool]:
        """Whether each of the others is in reach."""
        reach, positions = self.conditions.reach, self._positions
        if reach is None:
            return [True] * len(others)
        if positions is None:
            raise InvalidArgumentError(f"reach={reach} m needs positions; call place() before send().")
        return [math.dist(positions[sender], positions[robot]) <= reach for robot in others]

    def _transmission(self, sender: int, n_bytes: int, now: float) -> tuple[float, float]:
        """Begin and end (s) of a datagram's transmission."""
        if self.conditions.bandwidth is None:
            return now, now
        begin = max(now, self._busy_until[sender])
        self._busy_until[sender] = begin + (n_bytes + HEADER_BYTES) / self.conditions.bandwidth
        return begin, self._busy_until[sender]

    def _carry(
        self, copies: list[_Arrival], receiver: int, begin: float, is_near: bool, is_lost: bool
    ) -> None:
        """Queue the copies that arrive of a datagram sent at `begin`; count the others."""
        counts, (first, *second) = self._received[receiver], copies

        def is_cut(copy: _Arrival) -> bool:
            return self.conditions.cut(copy[2], receiver, begin, copy[0])

        if not is_near:
            counts["out_of_reach"] += 1
        elif is_cut(first):
            counts["cut_off"] += 1
        elif is_lost:
            counts["lost"] += 1
        else:
            heapq.heappush(self._queues[receiver], first)
            for copy in second:
                counts["duplicated"] += 1
                if is_cut(copy):
                    counts["cut_off"] += 1
                else:
                    heapq.heappush(self._queues[receiver], copy)

    def _check(self, name: str, robot: int, now: float = 0.0) -> None:
        if check_whole(name, robot, 0) >= self.n_robots:
            raise InvalidArgumentError(f"{name}={robot} must be below n_robots={self.n_robots}.")
        if not math.isfinite(now):
            raise InvalidArgumentError(f"now={now} must be a finite time in seconds.")

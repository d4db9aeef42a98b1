"""Networks that carry datagrams between robots: what any transport offers, and a simulated one."""

from __future__ import annotations

import heapq
import math
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import torch

from gmmtorch.errors import InvalidArgumentError, check_whole
from gmmtorch.sharing.envelope import MAX_BYTES

HEADER_BYTES = 28
"""Of a datagram on the wire: 20 of IPv4, 8 of UDP."""


class Transport(Protocol):
    """What a mission needs of a network. Datagrams may be lost, but are never changed."""

    def send(self, sender: int, datagrams: Sequence[bytes], now: float, kind: str) -> None:
        """Broadcast datagrams at the time `now` (s); `kind` says what they are, for the books."""

    def deliver(self, robot: int, now: float) -> list[tuple[int, bytes]]:
        """(sender, datagram) of all that has come to a robot up to `now` and was not delivered before."""
        ...


class Traffic(NamedTuple):
    """What has been sent, each broadcast counted once, however many hear it."""

    datagrams: int = 0
    bytes: int = 0

    @property
    def wire_bytes(self) -> int:
        """With the headers of UDP and IPv4."""
        return self.bytes + HEADER_BYTES * self.datagrams


class _Arrival(NamedTuple):
    """A datagram on its way to one robot; sorted by time, then in the order of sending."""

    time: float
    order: int
    sender: int
    datagram: bytes


class Network:
    """A simulated broadcast network of `n_robots`.

    A sender's datagrams leave one after another, each taking its bytes on the wire over `bandwidth`; each
    comes to every other robot `latency` seconds after it has left, or, with probability `loss`, never.
    What is delivered is forgotten. What is sent faster than `bandwidth` takes it waits its turn, without
    limit.
    """

    def __init__(
        self,
        n_robots: int,
        latency: float = 0.05,
        bandwidth: float | None = None,
        loss: float = 0.0,
        seed: int = 0,
    ) -> None:
        """Args:
        latency: seconds. bandwidth: bytes a second of each sender; as many as it likes if None.
        loss: share of the datagrams lost on the way to each robot, [0, 1).
        seed: of the generator that draws what is lost.
        """
        if not (math.isfinite(latency) and latency >= 0):
            raise InvalidArgumentError(f"latency={latency} must be a time of zero seconds or more.")
        if bandwidth is not None and not (math.isfinite(bandwidth) and bandwidth > 0):
            raise InvalidArgumentError(f"bandwidth={bandwidth} must be above zero bytes a second, or None.")
        if not 0 <= loss < 1:
            raise InvalidArgumentError(f"loss={loss} must be a share of the datagrams in [0, 1).")
        self.n_robots = check_whole("n_robots", n_robots, 1)
        self.latency, self.bandwidth, self.loss = float(latency), bandwidth, float(loss)
        self._generator = torch.Generator().manual_seed(check_whole("seed", seed, 0))
        self._busy_until = [-math.inf] * self.n_robots
        self._queues: list[list[_Arrival]] = [[] for _ in range(self.n_robots)]
        self._n_sent = 0
        self._traffic: dict[tuple[int, str], Traffic] = {}

    def send(self, sender: int, datagrams: Sequence[bytes], now: float, kind: str) -> None:
        """Broadcast datagrams of at most 1200 bytes at the time `now` (s); see `Transport`."""
        self._check("sender", sender, now)
        for data in datagrams:
            if not isinstance(data, bytes) or len(data) > MAX_BYTES:
                size = f"{len(data)} bytes" if isinstance(data, bytes) else type(data).__name__
                raise InvalidArgumentError(f"A datagram is {size}; it must be bytes, {MAX_BYTES} at most.")
        others = [robot for robot in range(self.n_robots) if robot != sender]
        for data in datagrams:
            left = self._left(sender, len(data), now)
            lost = self._lost(len(others))
            for robot, is_lost in zip(others, lost, strict=True):
                if not is_lost:
                    arrival = _Arrival(left + self.latency, self._n_sent, sender, data)
                    heapq.heappush(self._queues[robot], arrival)
            self._n_sent += 1
        before = self._traffic.get((sender, kind), Traffic())
        n_bytes = sum(map(len, datagrams))
        self._traffic[sender, kind] = Traffic(before.datagrams + len(datagrams), before.bytes + n_bytes)

    def deliver(self, robot: int, now: float) -> list[tuple[int, bytes]]:
        """(sender, datagram) in the order of arrival, at equal times in that of sending; see `Transport`."""
        self._check("robot", robot, now)
        queue, delivered = self._queues[robot], []
        while queue and queue[0].time <= now:
            arrival = heapq.heappop(queue)
            delivered.append((arrival.sender, arrival.datagram))
        return delivered

    def traffic(self, sender: int | None = None, kind: str | None = None) -> Traffic:
        """What has been sent, of one sender or all, of one kind or all."""
        chosen = [
            traffic
            for (who, what), traffic in self._traffic.items()
            if sender in (None, who) and kind in (None, what)
        ]
        return Traffic(sum(t.datagrams for t in chosen), sum(t.bytes for t in chosen))

    @property
    def n_datagrams(self) -> int:
        return self.traffic().datagrams

    @property
    def n_bytes(self) -> int:
        """Of all datagrams, without headers."""
        return self.traffic().bytes

    @property
    def n_wire_bytes(self) -> int:
        """Of all datagrams, with the headers of UDP and IPv4."""
        return self.traffic().wire_bytes

    @property
    def bytes_by_kind(self) -> dict[str, int]:
        """Bytes without headers, by the kind that the senders gave, sorted."""
        return {kind: self.traffic(kind=kind).bytes for kind in sorted({k for _, k in self._traffic})}

    @property
    def n_in_flight(self) -> int:
        """Datagrams on their way, one for each robot that will hear it."""
        return sum(map(len, self._queues))

    def state(self) -> dict[str, Any]:
        """All that `restore` needs: what is on its way, the books, and the generator."""
        arrivals = [(robot, arrival) for robot, queue in enumerate(self._queues) for arrival in sorted(queue)]
        datagrams = {arrival.order: arrival.datagram for _, arrival in arrivals}
        return {
            "generator": self._generator.get_state(),
            "busy_until": torch.tensor(self._busy_until, dtype=torch.float64),
            "n_sent": self._n_sent,
            "traffic": [[sender, kind, *traffic] for (sender, kind), traffic in self._traffic.items()],
            "payload": torch.frombuffer(bytearray(b"".join(datagrams.values()) + b"\0"), dtype=torch.uint8),
            "datagrams": [[order, len(data)] for order, data in datagrams.items()],
            "arrivals": [[robot, a.time, a.order, a.sender] for robot, a in arrivals],
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a `state` of a network with as many robots."""
        busy_until = state["busy_until"].tolist()
        if len(busy_until) != self.n_robots:
            raise InvalidArgumentError(
                f"state is of {len(busy_until)} robots; this network has n_robots={self.n_robots}."
            )
        payload, datagrams, begin = bytes(state["payload"].numpy()), {}, 0
        for order, size in state["datagrams"]:
            datagrams[order] = payload[begin : begin + size]
            begin += size
        queues: list[list[_Arrival]] = [[] for _ in range(self.n_robots)]
        for robot, time, order, sender in state["arrivals"]:
            queues[robot].append(_Arrival(time, order, sender, datagrams[order]))
        self._queues = queues  # each was sorted, so it is a heap
        self._busy_until, self._n_sent = busy_until, state["n_sent"]
        self._traffic = {(sender, kind): Traffic(n, size) for sender, kind, n, size in state["traffic"]}
        self._generator.set_state(state["generator"])

    def _left(self, sender: int, n_bytes: int, now: float) -> float:
        """When a datagram has left its sender."""
        if self.bandwidth is None:
            return now
        start = max(now, self._busy_until[sender])
        self._busy_until[sender] = start + (n_bytes + HEADER_BYTES) / self.bandwidth
        return self._busy_until[sender]

    def _lost(self, n: int) -> list[bool]:
        """Of so many receivers, to whom a datagram gets lost."""
        if self.loss == 0:
            return [False] * n
        drawn = torch.rand(n, generator=self._generator, dtype=torch.float64) < self.loss
        return [bool(lost) for lost in drawn]

    def _check(self, name: str, robot: int, now: float) -> None:
        if check_whole(name, robot, 0) >= self.n_robots:
            raise InvalidArgumentError(f"{name}={robot} must be below n_robots={self.n_robots}.")
        if not math.isfinite(now):
            raise InvalidArgumentError(f"now={now} must be a finite time in seconds.")

"""Transport, which carries datagrams between robots; and Network, a simulated one, with its conditions."""

from __future__ import annotations

import heapq
import math
import numbers
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import torch

from gmmtorch.errors import InvalidArgumentError, check_whole
from gmmtorch.team.sharing.messages.datagrams import check_datagram


class Partition(NamedTuple):
    """From `begin` until before `end` (s), robots of different groups do not receive each other's datagrams.

    groups: robot numbers. Robots that no group contains form one more group.
    """

    begin: float
    end: float
    groups: tuple[tuple[int, ...], ...]

    def divides(self, robot: int, other: int) -> bool:
        """Whether two robots are in different groups."""
        return self._group(robot) != self._group(other)

    def _group(self, robot: int) -> int:
        return next((number for number, group in enumerate(self.groups) if robot in group), -1)


@dataclass(frozen=True)
class LinkConditions:
    """Conditions of all links of a network.

    latency: seconds from the end of transmission to arrival, at least. jitter: mean (s) of an exponential
    delay that is added for each receiver and each copy. bandwidth: bytes per second of each sender; None: no
    limit. loss: share of the datagrams that each receiver loses, [0, 1). duplication: share of those not lost
    that arrive twice, [0, 1]. reach: largest distance (m) between two robots that communicate; None: any.
    partitions: each a `Partition`, or a mapping or triple of its fields; they may overlap in time.

    Raises `InvalidArgumentError` for values out of range.
    """

    latency: float = 0.05
    jitter: float = 0.0
    bandwidth: float | None = None
    loss: float = 0.0
    duplication: float = 0.0
    reach: float | None = None
    partitions: tuple[Partition, ...] = ()

    def __post_init__(self) -> None:
        for field, (is_valid, requirement) in _REQUIREMENTS.items():
            value = getattr(self, field)
            if value is None and field in _OPTIONAL:
                continue
            if not (_is_number(value) and is_valid(value)):
                raise InvalidArgumentError(f"{field}={value!r} must be {requirement}.")
            object.__setattr__(self, field, float(value))
        if not isinstance(self.partitions, Sequence):
            raise InvalidArgumentError(f"partitions={self.partitions!r} must be a list of partitions.")
        partitions = tuple(_partition(i, value) for i, value in enumerate(self.partitions))
        object.__setattr__(self, "partitions", partitions)

    def check_team(self, n_robots: int) -> None:
        """Raise `InvalidArgumentError` unless the partitions fit a team of `n_robots`."""
        for i, partition in enumerate(self.partitions):
            named = [robot for group in partition.groups for robot in group]
            given = f"partitions[{i}].groups={partition.groups}"
            if max(named) >= n_robots:
                raise InvalidArgumentError(
                    f"{given} names robot {max(named)}; there are {n_robots}, numbered from 0."
                )
            if len(partition.groups) + (len(named) < n_robots) < 2:
                raise InvalidArgumentError(
                    f"{given} puts all {n_robots} robots into one group, and "
                    "so divides nothing; leave it out, or give two groups."
                )

    def cut(self, sender: int, receiver: int, begin: float, end: float) -> bool:
        """Whether a partition divides sender and receiver at any time from `begin` to `end` (s) inclusive."""
        return any(
            partition.begin <= end and begin < partition.end and partition.divides(sender, receiver)
            for partition in self.partitions
        )

    def draw_losses(self, n: int, generator: torch.Generator) -> list[bool]:
        """Which of n receivers lose a datagram."""
        if self.loss == 0:
            return [False] * n
        return (torch.rand(n, generator=generator, dtype=torch.float64) < self.loss).tolist()

    def draw_delays(self, n: int, generator: torch.Generator) -> list[list[float]]:
        """For each of n receivers, the delays (s) of the one or two copies of a datagram."""
        if self.jitter == self.duplication == 0:
            return [[self.latency]] * n
        first, second, chance = torch.rand(3, n, generator=generator, dtype=torch.float64).tolist()
        return [
            [self.latency - self.jitter * math.log1p(-u) for u in ((a, b) if c < self.duplication else (a,))]
            for a, b, c in zip(first, second, chance, strict=True)
        ]


_OPTIONAL = ("bandwidth", "reach")  # None: no limit
_REQUIREMENTS: dict[str, tuple[Callable[[float], bool], str]] = {
    "latency": (lambda s: 0 <= s < math.inf, "a time of zero seconds or more, and finite"),
    "jitter": (lambda s: 0 <= s < math.inf, "a mean time of zero seconds or more, and finite"),
    "bandwidth": (lambda rate: 0 < rate < math.inf, "above zero bytes per second, and finite, or None"),
    "loss": (lambda share: 0 <= share < 1, "a share of the datagrams in [0, 1)"),
    "duplication": (lambda share: 0 <= share <= 1, "a share of the datagrams in [0, 1]"),
    "reach": (lambda metres: 0 < metres < math.inf, "above zero metres, and finite, or None"),
}


def _partition(i: int, value: Any) -> Partition:
    """The checked partition of a user's mapping or triple, the i-th one."""
    if isinstance(value, Mapping) and set(value) == set(Partition._fields):
        fields = [value[field] for field in Partition._fields]
    else:
        fields = list(value) if _is_list(value) else []
    if (
        len(fields) != 3
        or not (_is_number(fields[0]) and _is_number(fields[1]))
        or not -math.inf < fields[0] < fields[1] < math.inf
        or not _are_groups(fields[2])
    ):
        raise InvalidArgumentError(
            f"partitions[{i}]={value!r} must have begin and end, finite seconds, the first before the "
            "second, and groups, lists of robots that are each in one: "
            "{begin: 60, end: 120, groups: [[0], [1, 2]]}."
        )
    begin, end, groups = fields
    return Partition(
        float(begin), float(end), tuple(tuple(int(robot) for robot in group) for group in groups)
    )


def _are_groups(value: Any) -> bool:
    if not (_is_list(value) and value and all(_is_list(group) and group for group in value)):
        return False
    robots: list[Any] = [robot for group in value for robot in group]
    are_whole = all(_is_number(robot) and isinstance(robot, numbers.Integral) for robot in robots)
    return are_whole and min(robots) >= 0 and len(set(robots)) == len(robots)


def _is_list(value: Any) -> bool:
    return isinstance(value, Sequence) and not isinstance(value, str | bytes)


def _is_number(value: Any) -> bool:
    return isinstance(value, numbers.Real) and not isinstance(value, bool)


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
        before = self._traffic.get((sender, kind), Traffic())
        n_bytes = sum(map(len, datagrams))
        self._traffic[sender, kind] = Traffic(before.datagrams + len(datagrams), before.bytes + n_bytes)

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
        return Traffic(sum(t.datagrams for t in chosen), sum(t.bytes for t in chosen))

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

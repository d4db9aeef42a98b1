"""Replicas that exchange some of their datagrams, and a model of one with plain dictionaries."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from typing import Any

import pytest
import torch
from sharing.schedules import act

from gmmtorch.mapping.components import Components
from gmmtorch.team.sharing import Broadcast, Replica, decode
from gmmtorch.team.sharing.messages.component_messages import ComponentsMessage, counts_of
from gmmtorch.team.sharing.messages.record_messages import (
    CorrectionMessage,
    CountersMessage,
    SupersessionMessage,
)


def exchange(replicas: list[Replica], rounds: int = 6) -> None:
    """Each replica receives all datagrams of the others."""
    for _ in range(rounds):
        for sender in replicas:
            for datagram in [*sender.announcements(), *sender.datagrams()]:
                for receiver in replicas:
                    if receiver is not sender:
                        receiver.receive(datagram)


def history(seed: int, n_acts: int = 14) -> list[bytes]:
    """All datagrams of three robots that receive some of each other's."""
    rng = random.Random(seed)
    robots = [Replica(robot, incarnation=rng.getrandbits(24)) for robot in range(3)]
    return told(rng, robots, n_acts, act)


def told(
    rng: random.Random, robots: Sequence[Any], n_acts: int, act: Callable[[random.Random, Any], None]
) -> list[bytes]:
    """All datagrams of robots that act in turn, at random, and receive some of each other's."""
    sent: list[bytes] = []
    for _ in range(n_acts):
        robot = rng.choice(robots)
        act(rng, robot)
        sent += gossip(rng, robot, robots)
    return sent


def gossip(rng: random.Random, sender: Replica, robots: Sequence[Replica]) -> list[bytes]:
    """The new datagrams of a robot; most of the others receive them."""
    new = sender.datagrams()
    for other in robots:
        if other is not sender and rng.random() < 0.7:
            for datagram in new:
                other.receive(datagram)
    return new


def replica_of(datagrams: list[bytes], robot: int = 1000) -> Replica:
    """A robot that received these datagrams, and accepted each."""
    replica = Replica(robot)
    for datagram in datagrams:
        assert replica.receive(datagram)
    return replica


def told_twice(sent: list[bytes], order: random.Random) -> tuple[Replica, Replica]:
    """Equal replicas: one received the datagrams in order, the other in any order, and half of them twice."""
    again = [*sent, *order.sample(sent, len(sent) // 2)]
    order.shuffle(again)
    one, other = replica_of(sent), replica_of(again)
    assert one.digest() == other.digest()
    return one, other


def everything(replica: Replica) -> list[bytes]:
    """All records, as a replica sends them to a robot that has none."""
    newcomer, copy = Replica(1000), Replica(replica.robot)
    assert copy.load(*replica.stored()) == 0
    for _ in range(2):  # other robots' records are sent after the second announcement
        for datagram in newcomer.announcements():
            copy.receive(datagram)
    return copy.datagrams()


def motion(x: float = 0.0, yaw: float = 0.0) -> torch.Tensor:
    """Metres along x after a turn about z (rad)."""
    made = torch.eye(4, dtype=torch.float64)
    made[0, 3] = x
    cos, sin = math.cos(yaw), math.sin(yaw)
    made[:2, :2] = torch.tensor([[cos, -sin], [sin, cos]], dtype=torch.float64)
    return made


def same_attributes(one: Components, other: Components) -> bool:
    a, b = (c.attributes.present().tensors() for c in (one, other))
    return a.keys() == b.keys() and all(torch.allclose(a[name], b[name], atol=1e-12) for name in a)


def rows(components: Components) -> dict[int, tuple]:
    """Mean, covariance, support, flag and (origin, count) pairs of each component by its key."""
    found = {}
    for row, (robot, sequence) in enumerate(components.ids.tolist()):
        seen = [
            (tuple(components.origins[components.seen_from[e]].tolist()), float(components.seen_count[e]))
            for e in range(len(components.seen_by))
            if int(components.seen_by[e]) == row
        ]
        found[robot << 52 | sequence] = (
            tuple(components.means[row].tolist()),
            tuple(components.covariances[row].flatten().tolist()),
            float(components.support[row]),
            bool(components.max_range[row]),
            tuple(seen),
        )
    return found


class Follower:
    """A map made of changes: mean, support and counts by origin of each component."""

    def __init__(self) -> None:
        self.shapes: dict[int, tuple] = {}
        self.support: dict[int, float] = {}
        self.counts: dict[tuple, float] = {}
        self.rebuilt = 0
        self.batches: list[Components] = []

    def follow(self, replica: Replica | Broadcast) -> None:
        new = replica.changes()
        if new.rebuilt:
            assert not new.added
            assert not len(new.gained)
            self.shapes, self.support, self.counts = {}, {}, {}
            self.rebuilt += 1
            self._enter(replica.components())
            return
        for batch in new.added:
            assert len(batch)
            assert not rows(batch).keys() & self.shapes.keys()  # no component is added twice
            self._enter(batch)
        self.batches += new.added
        assert (new.gained.support > 0).all()
        for key, (mean, _, gain, _, seen) in rows(new.gained).items():
            assert self.shapes[key][0] == mean
            self.support[key] += gain
            for origin, count in seen:
                self.counts[key, origin] += count

    def _enter(self, batch: Components) -> None:
        for key, (mean, covariance, support, flag, seen) in rows(batch).items():
            self.shapes[key], self.support[key] = (mean, covariance, flag), support
            self.counts |= {(key, origin): count for origin, count in seen}

    def agrees(self, replica: Replica | Broadcast) -> bool:
        expected = rows(replica.components())
        counts = {(key, origin): n for key, row in expected.items() for origin, n in row[4]}
        return (
            self.shapes
            == {key: (mean, covariance, flag) for key, (mean, covariance, _, flag, _) in expected.items()}
            and self.support == pytest.approx({key: row[2] for key, row in expected.items()}, rel=1e-9)
            and self.counts == pytest.approx(counts, rel=1e-9, abs=1e-12)
        )


class Model:
    """The union of all received records, and the components that follow from it."""

    def __init__(self) -> None:
        self.records: dict[int, object] = {}

    def receive(self, datagram: bytes) -> None:
        message = decode(datagram)
        if isinstance(message, ComponentsMessage):
            self.records.update(rows(message.components))
        elif isinstance(message, SupersessionMessage | CountersMessage | CorrectionMessage):
            self.records[message.key] = message

    def dead(self) -> set[int]:
        dead: set[int] = set()
        while True:
            more = set(dead)
            for message in self.records.values():
                if isinstance(message, SupersessionMessage) and _numbers(message.new) <= dead | set(
                    self.records
                ):
                    more |= _numbers(message.old)
            if more == dead:
                return dead
            dead = more

    def counting(self) -> dict[int, object]:
        dead = self.dead()
        return {key: record for key, record in self.records.items() if key not in dead}

    def components(self) -> dict[int, tuple]:
        return {key: row for key, row in self.counting().items() if isinstance(row, tuple)}

    def support(self, key: int) -> float:
        largest: dict[int, float] = {}
        for record in self.counting().values():
            if isinstance(record, CountersMessage):
                for component, total in zip(
                    record.components.tolist(), counts_of(record.steps).tolist(), strict=True
                ):
                    if component == key:
                        life = record.key >> 28
                        largest[life] = max(largest.get(life, 0.0), total)
        return self.components()[key][2] + sum(largest[life] for life in sorted(largest))

    def shift(self, key: int) -> tuple[float, ...]:
        """The shift of a component by corrections without rotation."""
        latest: dict[tuple[int, int], CorrectionMessage] = {}
        for record in self.counting().values():
            if isinstance(record, CorrectionMessage):
                scan = (record.key >> 52, record.scan)
                other = latest.get(scan)
                if other is None or (record.version, record.key) > (other.version, other.key):
                    latest[scan] = record
        last = [latest[scan] for scan in sorted(latest) if key in latest[scan].moved]
        return tuple(last[-1].pose[:3].tolist()) if last else (0.0, 0.0, 0.0)


def _numbers(intervals) -> set[int]:
    return {number for begin, end in intervals.pairs() for number in range(begin, end)}

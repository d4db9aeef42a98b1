"""Replicas that exchange some of their datagrams."""

from __future__ import annotations

import random
from collections.abc import Sequence

from sharing.schedules import act

from gmmtorch.sharing.replica.replica import Replica


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

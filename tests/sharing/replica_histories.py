"""Replicas that exchange some of their datagrams, and motions of their scans."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from typing import Any

import torch
from sharing.schedules import act

from gmmtorch.team.sharing.replica.replica import Replica


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

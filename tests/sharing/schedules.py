"""Random schedules of loss, duplication, reordering, partitions, crashes and restarts of a team.

`run_schedule(seed)` runs one and returns its outcome:

    for seed in range(1000):
        assert run_schedule(seed).converged
"""

from __future__ import annotations

import random
from dataclasses import dataclass, field
from typing import Any
from unittest import mock

import torch
from mapping.random_components import painted, random_components
from torch import Tensor

from gmmtorch.mapping import Components, has_channels
from gmmtorch.team.sharing import Message, Replica, decode
from gmmtorch.team.sharing.messages.record_messages import AnnouncementMessage
from gmmtorch.team.sharing.replica import authorship
from gmmtorch.team.sharing.replica.record_keys import Intervals

MOST_ROUNDS = 8
"""Rounds of announcements and answers without loss after which all replicas agree."""
_LONGEST_DELAY = 6  # steps; so datagrams overtake one another
_SNAPSHOT_EVERY = 5


class Older(Replica):
    """A robot of a version that knows no channels: it refuses what it does not know."""

    def __init__(self, robot: int, **options: Any) -> None:
        super().__init__(robot, channels=(), **options)

    def receive(self, datagram: bytes, message: Message | None = None) -> bool:
        if datagram[:1] == b"\x11" and has_channels(datagram[1:]):
            return False
        found = decode(datagram)
        is_foreign = isinstance(found, AnnouncementMessage) and found.begin < 0
        return not is_foreign and super().receive(datagram, message)


@dataclass(frozen=True)
class Outcome:
    """converged: all digests are equal, those of older robots among themselves; complete: all robots hold
    every record that any robot held before the network healed; rounds: exchanges without loss until then;
    refused: datagrams by reason, of all robots."""

    converged: bool
    complete: bool
    rounds: int
    replicas: list[Replica]
    refused: dict[str, int]
    crashes: int


@dataclass
class _Team:
    rng: random.Random
    replicas: list[Replica]
    loss: float
    repeats: float
    now: int = 0
    flying: list[tuple[int, int, bytes]] = field(default_factory=list)  # arrival, receiver, datagram
    cut: set[int] = field(default_factory=set)  # robots on one side of a partition
    snapshots: dict[int, tuple[list[bytes], list[bytes]]] = field(default_factory=dict)
    refused: dict[str, int] = field(default_factory=dict)
    crashes: int = 0

    def broadcast(self, sender: int, datagrams: list[bytes]) -> None:
        for datagram in datagrams:
            for receiver in range(len(self.replicas)):
                if receiver == sender or (receiver in self.cut) != (sender in self.cut):
                    continue
                for _ in range(1 + (self.rng.random() < self.repeats)):
                    if self.rng.random() >= self.loss:
                        arrival = self.now + self.rng.randint(0, _LONGEST_DELAY)
                        self.flying.append((arrival, receiver, datagram))

    def deliver(self) -> None:
        due = [item for item in self.flying if item[0] <= self.now]
        self.flying = [item for item in self.flying if item[0] > self.now]
        self.rng.shuffle(due)
        for _, receiver, datagram in due:
            self.replicas[receiver].receive(datagram)

    def restart(self, robot: int, keeps_disk: bool) -> None:
        """A new process with an old snapshot of its disk or without records."""
        self.crashes += 1
        self.note_refused(robot)
        self.replicas[robot] = type(self.replicas[robot])(robot, incarnation=self.rng.getrandbits(24))
        if keeps_disk and robot in self.snapshots:
            assert self.replicas[robot].load(*self.snapshots[robot]) == 0

    def note_refused(self, robot: int) -> None:
        for reason, n in self.replicas[robot].refused.items():
            self.refused[reason] = self.refused.get(reason, 0) + n


def components(rng: random.Random, n: int) -> Components:
    return random_components(3, k=n, seed=rng.getrandbits(31), extent=8.0)


def act(rng: random.Random, replica: Replica, paints: bool = False) -> None:
    """A random change of the map of a robot: add, supersede, count or correct. paints: with attributes."""

    def new(n: int) -> Components:
        made = components(rng, n)
        return painted(made, rng.getrandbits(31)) if paints and rng.random() < 0.8 else made

    known = replica.components().ids
    own = known[known[:, 0] == replica.robot]
    kind = rng.choice(["add", "add", "supersede", "supersede", "count", "count", "correct"])
    if kind == "add":
        replica.add(new(rng.randint(1, 5)))
    elif kind == "supersede" and len(own):
        replica.add(new(rng.randint(0, 2)), supersedes=_some(rng, own))
    elif kind == "count" and len(known):
        replica.count({tuple(row): rng.uniform(0.5, 500.0) for row in _some(rng, known).tolist()})
    elif kind == "correct" and len(own):
        motion = torch.eye(4, dtype=torch.float64)
        motion[:3, 3] = torch.tensor([rng.uniform(-1, 1) for _ in range(3)])
        replica.correct(rng.randrange(3), motion, _some(rng, own))


def _some(rng: random.Random, rows: Tensor) -> Tensor:
    return rows[sorted(rng.sample(range(len(rows)), rng.randint(1, min(4, len(rows)))))]


def run_schedule(
    seed: int, n_robots: int = 3, n_steps: int = 40, painters: int = 0, older: int = 0
) -> Outcome:
    """A team with network trouble for `n_steps`, then without. The first robots, `painters`, have components
    with attributes; the last ones, `older`, know no channels.

    With odd seeds robots compact their records as soon as possible, which otherwise takes long missions.
    """
    tidy = {"_MOST_SUPERSESSIONS": 1, "_MOST_OUTDATED": 1} if seed % 2 else {"_MOST_SUPERSESSIONS": 32}
    with mock.patch.multiple(authorship, **tidy):
        return _run(random.Random(seed), n_robots, n_steps, painters, older)


def _run(rng: random.Random, n_robots: int, n_steps: int, painters: int, older: int) -> Outcome:
    kinds = [Replica] * (n_robots - older) + [Older] * older
    replicas = [kind(robot, incarnation=rng.getrandbits(24)) for robot, kind in enumerate(kinds)]
    team = _Team(rng, replicas, loss=rng.choice([0.0, 0.1, 0.3, 0.5]), repeats=rng.choice([0.0, 0.3]))
    for team.now in range(n_steps):
        _trouble(team)
        for robot, replica in enumerate(team.replicas):
            if rng.random() < 0.3:
                act(rng, replica, robot < painters)
            if rng.random() < 0.3:
                team.broadcast(robot, replica.announcements())
            if rng.random() < 0.7:
                team.broadcast(robot, replica.datagrams(budget=rng.choice([None, 1500])))
            if rng.randrange(_SNAPSHOT_EVERY) == 0:
                team.snapshots[robot] = replica.stored()
        team.deliver()
    held = Intervals.union(replica.held for replica in team.replicas)
    rounds = _heal(team)
    for robot in range(n_robots):
        team.note_refused(robot)
    return Outcome(
        converged=_agree(team.replicas),
        complete=all(replica.held.covers(held) for replica in team.replicas),
        rounds=rounds,
        replicas=team.replicas,
        refused=team.refused,
        crashes=team.crashes,
    )


def _trouble(team: _Team) -> None:
    rng = team.rng
    if rng.random() < 0.1:
        team.cut = set() if team.cut else {rng.randrange(len(team.replicas))}
    if rng.random() < 0.05:
        team.restart(rng.randrange(len(team.replicas)), keeps_disk=rng.random() < 0.5)


def _heal(team: _Team) -> int:
    """The number of rounds until all replicas agree."""
    team.loss, team.cut = 0.0, set()
    for done in range(MOST_ROUNDS + 1):
        if not team.flying and _agree(team.replicas):
            return done
        for robot, replica in enumerate(team.replicas):
            team.broadcast(robot, [*replica.announcements(), *replica.datagrams()])
        team.now += _LONGEST_DELAY
        team.deliver()
    return MOST_ROUNDS + 1


def _agree(replicas: list[Replica]) -> bool:
    return all(
        len({replica.digest() for replica in replicas if type(replica) is kind}) < 2
        for kind in (Replica, Older)
    ) and all(replica.held == replicas[0].held for replica in replicas)

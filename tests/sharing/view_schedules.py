"""Random schedules of what can happen to a team's views: as `schedules`, with a plain set beside it."""

from __future__ import annotations

import random
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import torch

from gmmtorch.sharing.messages.message_registry import decode
from gmmtorch.sharing.view_set import View, ViewSet

MOST_ROUNDS = 16
"""Of announcing and answering without loss, until all should hold the same."""
_LONGEST_DELAY = 6  # steps; so datagrams overtake one another
_SNAPSHOT_EVERY = 5


@dataclass
class PlainViews:
    """The greatest view of each key, and the keys that are dead: nothing but a dictionary and a set."""

    alive: dict[int, View] = field(default_factory=dict)
    dead: set[int] = field(default_factory=set)

    @classmethod
    def of(cls, views: ViewSet) -> PlainViews:
        return cls(dict(views.views), {key for pair in views.dead.pairs() for key in range(*pair)})

    def put(self, key: int, view: View) -> None:
        if key not in self.dead:
            self.alive[key] = max(view, self.alive.get(key, view))

    def remove(self, keys: Iterable[int]) -> None:
        for key in keys:
            self.dead.add(key)
            self.alive.pop(key, None)

    def join(self, other: PlainViews) -> None:
        self.remove(other.dead)
        for key, view in other.alive.items():
            self.put(key, view)


@dataclass
class Outcome:
    """done: all that any robot did. held: what robots held together when the trouble ended. n_bytes: sent."""

    sets: list[ViewSet]
    done: PlainViews
    held: PlainViews
    rounds: int
    crashes: int
    refused: dict[str, int]
    n_bytes: dict[str, int]

    @property
    def converged(self) -> bool:
        return self.rounds <= MOST_ROUNDS


class Team:
    """Robots and the datagrams that are on their way."""

    def __init__(self, rng: random.Random, n_robots: int, loss: float = 0.0, repeats: float = 0.0) -> None:
        self.rng, self.loss, self.repeats = rng, loss, repeats
        self.sets = [ViewSet(robot, incarnation=rng.getrandbits(24)) for robot in range(n_robots)]
        self.now = 0
        self.cut: set[int] = set()  # robots on one side of a partition
        self.done = PlainViews()
        self.crashes = 0
        self.n_bytes = {"datagrams": 0, "announcements": 0}
        self.refused: dict[str, int] = {}
        self._flying: list[tuple[int, int, bytes]] = []  # arrival, receiver, datagram
        self._snapshots: dict[int, dict[str, Any]] = {}

    @property
    def agrees(self) -> bool:
        return not self._flying and len({views.digest() for views in self.sets}) == 1

    def act(self, robot: int) -> None:
        """Something that a robot may do to views: its clock may be wrong."""
        rng, views = self.rng, self.sets[robot]
        now, known = self.now + 7.5 * (robot % 3), sorted(views.views)
        kind = rng.choice(["add", "add", "revalue", "remove", "remove"])
        if kind == "add":
            for _ in range(rng.randint(1, 3)):
                pose = torch.tensor([rng.uniform(-9, 9) for _ in range(4)])
                key = views.add(pose, rng.uniform(0, 50), now)
                self.done.put(key, views.views[key])
        elif known and kind == "revalue":
            key = rng.choice(known)
            views.revalue(key, rng.uniform(0, 50), now)
            self.done.put(key, views.views[key])
        elif known:
            gone = rng.sample(known, rng.randint(1, min(3, len(known))))
            views.remove(gone)
            self.done.remove(gone)

    def say(self, robot: int, what: str, **options: Any) -> None:
        for datagram in getattr(self.sets[robot], what)(**options):
            self.n_bytes[what] += len(datagram)
            for receiver in range(len(self.sets)):
                if receiver == robot or (receiver in self.cut) != (robot in self.cut):
                    continue
                for _ in range(1 + (self.rng.random() < self.repeats)):
                    if self.rng.random() >= self.loss:
                        arrival = self.now + self.rng.randint(0, _LONGEST_DELAY)
                        self._flying.append((arrival, receiver, datagram))

    def deliver(self) -> None:
        due = [item for item in self._flying if item[0] <= self.now]
        self._flying = [item for item in self._flying if item[0] > self.now]
        self.rng.shuffle(due)
        for _, receiver, datagram in due:
            self.sets[receiver].receive(decode(datagram))

    def save(self, robot: int) -> None:
        self._snapshots[robot] = self.sets[robot].state()

    def restart(self, robot: int) -> None:
        """A new process: with an old snapshot of its disk, or with nothing."""
        self.crashes += 1
        self.note_refused(robot)
        self.sets[robot] = ViewSet(robot, incarnation=self.rng.getrandbits(24))
        if robot in self._snapshots and self.rng.random() < 0.5:
            self.sets[robot].restore(self._snapshots[robot])

    def note_refused(self, robot: int) -> None:
        for reason, n in self.sets[robot].refused.items():
            self.refused[reason] = self.refused.get(reason, 0) + n

    def trouble(self, crash: float) -> None:
        if self.rng.random() < 0.1:
            self.cut = set() if self.cut else {self.rng.randrange(len(self.sets))}
        if self.rng.random() < crash:
            self.restart(self.rng.randrange(len(self.sets)))

    def heal(self) -> tuple[PlainViews, int]:
        """What all hold together when the trouble ends, and how many rounds it takes until each does."""
        self.loss, self.repeats, self.cut = 0.0, 0.0, set()
        self._arrive()
        held = PlainViews()
        for views in self.sets:
            held.join(PlainViews.of(views))
        for done in range(MOST_ROUNDS + 1):
            if self.agrees:
                return held, done
            for robot in range(len(self.sets)):
                self.say(robot, "announcements")
                self.say(robot, "datagrams")
            self._arrive()
        return held, MOST_ROUNDS + 1

    def _arrive(self) -> None:
        self.now += _LONGEST_DELAY
        self.deliver()


def run_schedule(seed: int, n_robots: int = 4, n_steps: int = 60, crash: float = 0.04) -> Outcome:
    """A team in trouble for so many steps, then a network that works."""
    rng = random.Random(seed)
    team = Team(rng, n_robots, rng.choice([0.0, 0.1, 0.3, 0.5]), rng.choice([0.0, 0.3]))
    for team.now in range(n_steps):
        team.trouble(crash)
        for robot in range(n_robots):
            if rng.random() < 0.3:
                team.act(robot)
            if rng.random() < 0.2:
                team.say(robot, "announcements")
            if rng.random() < 0.7:
                team.say(robot, "datagrams", budget=rng.choice([None, 200]))
            if rng.randrange(_SNAPSHOT_EVERY) == 0:
                team.save(robot)
        team.deliver()
    held, rounds = team.heal()
    for robot in range(n_robots):
        team.note_refused(robot)
    return Outcome(team.sets, team.done, held, rounds, team.crashes, team.refused, team.n_bytes)

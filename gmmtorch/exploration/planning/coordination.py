"""Coordination: who plans when, and which of the others' plans each robot respects (thesis 4.3)."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Protocol, TypeVar

import torch

from gmmtorch.errors import InvalidArgumentError, check_whole

COORDINATIONS = ("myopic", "greedy", "distributed_greedy", "random_partition")


class Valued(Protocol):
    """What is planned: all that counts here is what it is expected to bring."""

    @property
    def value(self) -> float: ...


P = TypeVar("P", bound=Valued)


class Coordination:
    """A rule by which robots agree on their plans.

    "myopic": each plans as if it were alone. "greedy": one after the other, each given all plans before;
    where what plans bring together is monotone and submodular, at least half of the optimum. The others
    take `n_rounds` rounds, in each of which robots plan at the same time, given the plans of the rounds
    before: in "random_partition" each robot plans in a round drawn for it; in "distributed_greedy" all who
    are left plan in every round, and those with the best plans are settled, an equal share in each.
    """

    def __init__(self, name: str = "greedy", n_rounds: int = 3) -> None:
        if name not in COORDINATIONS:
            raise InvalidArgumentError(f"coordination={name!r} is not one of {', '.join(COORDINATIONS)}.")
        self.name = name
        self.n_rounds = check_whole("n_rounds", n_rounds, 1)

    def rounds(self, n_robots: int, generator: torch.Generator) -> list[list[int]]:
        """Who plans in each round, of robots 0 … n_robots − 1; rounds of nobody are left out.

        In "distributed_greedy" who plans again depends on the plans: everyone, in the first round, is all
        that is known before.
        """
        everyone = list(range(n_robots))
        if self.name == "greedy":
            rounds = [[robot] for robot in everyone]
        elif self.name == "random_partition":
            drawn = torch.randint(self.n_rounds, (n_robots,), generator=generator).tolist()
            rounds = [[robot for robot in everyone if drawn[robot] == k] for k in range(self.n_rounds)]
        else:
            rounds = [everyone]
        return [robots for robots in rounds if robots]

    def coordinate(
        self, robots: Iterable[int], plan: Callable[[int, dict[int, P]], P], generator: torch.Generator
    ) -> dict[int, P]:
        """The plan of each robot, in the order in which they were settled.

        Args:
            plan: the plan of a robot given the plans that it shall respect, of robots by number.
        """
        team = list(robots)
        if self.name == "distributed_greedy":
            return self._distributed(team, plan)
        settled: dict[int, P] = {}
        for numbers in self.rounds(len(team), generator):
            together = {team[number]: plan(team[number], dict(settled)) for number in numbers}
            settled.update(together)
        return settled

    def _distributed(self, team: list[int], plan: Callable[[int, dict[int, P]], P]) -> dict[int, P]:
        settled: dict[int, P] = {}
        left = team
        for k in range(self.n_rounds):
            found = {robot: plan(robot, dict(settled)) for robot in left}
            best = sorted(left, key=lambda robot: -found[robot].value)  # the first of equals first
            best = best[: -(-len(left) // (self.n_rounds - k))]
            settled.update((robot, found[robot]) for robot in best)
            left = [robot for robot in left if robot not in best]
        return settled

"""Coordination: the order in which robots plan, and the plans that each robot considers (thesis 4.3)."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Protocol, TypeVar

import torch

from gmmtorch.errors import InvalidArgumentError, check_whole

COORDINATIONS = ("myopic", "greedy", "distributed_greedy", "random_partition")


class Valued(Protocol):
    """A plan with an expected value."""

    @property
    def value(self) -> float: ...


P = TypeVar("P", bound=Valued)


class Coordination:
    """The rule by which the robots of a team plan together.

    "myopic": each robot plans as if it were alone. "greedy": robots plan one after the other, and each
    considers all earlier plans; if the joint value is monotone and submodular, the result is at least
    half of the optimum. The other rules take `n_rounds` rounds. In a round robots plan at the same time
    and consider the plans of the
    rounds before. "random_partition": each robot plans in one random round. "distributed_greedy": all
    remaining robots plan in every round, and an equal share of them, those with the best plans, keep
    their plans.
    """

    def __init__(self, name: str = "greedy", n_rounds: int = 3) -> None:
        if name not in COORDINATIONS:
            raise InvalidArgumentError(f"coordination={name!r} is not one of {', '.join(COORDINATIONS)}.")
        self.name = name
        self.n_rounds = check_whole("n_rounds", n_rounds, 1)

    def rounds(self, n_robots: int, generator: torch.Generator) -> list[list[int]]:
        """Return the robots, of 0 … n_robots − 1, that plan in each round, without empty rounds.

        In "distributed_greedy" the later rounds depend on the plans, so only the first round is returned.
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
        """Return the plan of each robot, in the order in which the plans were fixed.

        Args:
            plan: called with a robot and the plans of other robots that it must consider; returns its plan.
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
            best = sorted(
                left, key=lambda robot: -found[robot].value
            )  # stable: the first of equals comes first
            best = best[: -(-len(left) // (self.n_rounds - k))]
            settled.update((robot, found[robot]) for robot in best)
            left = [robot for robot in left if robot not in best]
        return settled

"""Coordination: the order in which robots plan (thesis 4.3), and the committed paths that they avoid."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, check_choice, check_number, check_whole
from gmmtorch.team.sharing import PlanMessage

if TYPE_CHECKING:
    from gmmtorch.team.exploration.planning.planner_interface import Plan

COORDINATIONS = ("myopic", "greedy", "distributed_greedy", "random_partition")


class Coordination:
    """The rule by which the robots of a team plan together.

    "myopic": each robot plans as if it were alone. "greedy": robots plan one after the other, and each
    considers all earlier plans; if the joint value is monotone and submodular, the result is at least half
    of the optimum. The other rules take `n_rounds` rounds. In a round robots plan at the same time and
    consider the plans of the rounds before. "random_partition": each robot plans in one random round.
    "distributed_greedy": all remaining robots plan in every round, and an equal share of them, those with
    the best plans, keep their plans.
    """

    def __init__(self, name: str = "greedy", n_rounds: int = 3) -> None:
        check_choice("coordination", name, COORDINATIONS)
        self.name = name
        self.n_rounds = check_whole("n_rounds", n_rounds, 1)

    def rounds(self, n_robots: int, generator: torch.Generator) -> list[list[int]]:
        """Return the robots, of 0 … n_robots − 1, that plan in each round, without empty rounds. In
        "distributed_greedy" the later rounds depend on the plans, so only the first round is returned."""
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
        self,
        robots: Iterable[int],
        plan: Callable[[int, dict[int, Plan]], Plan],
        generator: torch.Generator,
    ) -> dict[int, Plan]:
        """Return the plan of each robot, in the order in which the plans were fixed.

        plan: called with a robot and the plans of other robots that it must consider; returns its plan.
        """
        team = list(robots)
        if self.name == "distributed_greedy":
            return self._distributed(team, plan)
        settled: dict[int, Plan] = {}
        for numbers in self.rounds(len(team), generator):
            together = {team[number]: plan(team[number], dict(settled)) for number in numbers}
            settled.update(together)
        return settled

    def _distributed(self, team: list[int], plan: Callable[[int, dict[int, Plan]], Plan]) -> dict[int, Plan]:
        settled: dict[int, Plan] = {}
        left = team
        for k in range(self.n_rounds):
            found = {robot: plan(robot, dict(settled)) for robot in left}
            best = sorted(left, key=lambda robot: -found[robot].value)  # the first of equals comes first
            best = best[: -(-len(left) // (self.n_rounds - k))]
            settled.update((robot, found[robot]) for robot in best)
            left = [robot for robot in left if robot not in best]
        return settled


_MOST_STEPS = 1000  # largest number of steps of a received plan that are used


@dataclass(frozen=True, eq=False)
class PeerTrajectories:
    """Committed paths of other robots.

    paths: (M, T, 3) float64, metres, world frame: each robot's position after 1, 2, …, T ≥ 1 planner
    steps. Each robot rests at its last position afterwards.
    separation: least distance (m) between the centres of two robots: two radii and a margin.
    """

    paths: Tensor
    separation: float = 0.7

    def __post_init__(self) -> None:
        shape = tuple(self.paths.shape)
        if len(shape) != 3 or shape[1] < 1 or shape[2] != 3 or not bool(torch.isfinite(self.paths).all()):
            raise InvalidArgumentError(
                f"paths has shape {shape}; expected finite metres (M, T, 3), T of 1 or more."
            )
        check_number("separation", self.separation, above=True)

    @classmethod
    def of(cls, paths: Sequence[Tensor], separation: float = 0.7) -> PeerTrajectories:
        """Build from paths (T_i, 3) of any lengths, at least one position each."""
        longest = max((len(path) for path in paths), default=1)
        padded = [path[torch.arange(longest).clamp_max(len(path) - 1)] for path in paths]
        return cls(torch.stack(padded) if padded else torch.zeros(0, 1, 3, dtype=torch.float64), separation)

    def __len__(self) -> int:
        return len(self.paths)

    def later(self, steps: int) -> PeerTrajectories:
        """Return the peers as seen by a path that begins that many steps from now."""
        return PeerTrajectories(self.paths[:, min(steps, self.paths.shape[1] - 1) :], self.separation)


def clear_of(path: Tensor, peers: PeerTrajectories, start: Tensor | None = None) -> Tensor:
    """Flag (...,) the paths (..., L, 3), positions after 1, 2, …, L steps, that keep clear of the peers.

    After step L the robot stays. At step k its distance from another robot must be at least the
    separation, plus the longer step of that robot before or after step k, plus half of its own longer
    step. The robots are then also clear between steps, and if the other robot is up to half a step early
    or late. With `start` (..., 3), the position before the first step, a robot that is already too close
    may move if it is never closer than it would be by staying.
    """
    if len(peers) == 0:
        return torch.ones(path.shape[:-2], dtype=torch.bool, device=path.device)
    n_path, n_traffic = path.shape[-2], peers.paths.shape[1]
    # One robot rests after the shorter path ends.
    n = max(n_path, n_traffic)
    there = peers.paths[:, torch.arange(n).clamp_max(n_traffic - 1)]
    least = peers.separation + _longer_step(there)
    own = path if start is None else torch.cat([start[..., None, :], path], -2)
    sway = _longer_step(own)[..., own.shape[-2] - n_path :] / 2
    clear = torch.ones(path.shape[:-2], dtype=torch.bool, device=path.device)
    for other, needed in zip(there, least, strict=True):
        ahead, after = other[:n_path], other[n_path:]
        required = needed[:n_path] + sway
        if start is not None:
            required = torch.minimum(required, _distance(start[..., None, :], ahead))
        clear &= (_distance(path, ahead) >= required).all(-1)
        if len(after):
            required = needed[n_path:]
            if start is not None:
                required = torch.minimum(required, _distance(start[..., None, :], after))
            clear &= (_distance(path[..., -1:, :], after) >= required).all(-1)
    return clear


def predicted_path(plan: PlanMessage, age: float, step: float) -> Tensor:
    """Positions (S, 3), metres, of a teammate after 1, 2, …, S steps of `step` seconds from now, by a plan
    that was heard `age` seconds ago: on straight lines between the plan's poses, and on the first of these
    before its first pose."""
    n = len(plan.path)
    left = n * plan.step - age
    ahead = step * torch.arange(1, min(max(math.ceil(left / step - 1e-9), 1), _MOST_STEPS) + 1)
    at = ((age + ahead.double()) / plan.step - 1).clamp(-1, n - 1)
    before = at.floor().clamp(0, max(n - 2, 0)).long()
    path = plan.path[:, :3].double()
    return torch.lerp(path[before], path[(before + 1).clamp_max(n - 1)], (at - before)[:, None])


def _longer_step(path: Tensor) -> Tensor:
    """Return the longer step, metres (..., L), before or after each position of paths (..., L, 3)."""
    step = (path[..., 1:, :] - path[..., :-1, :]).norm(dim=-1)
    pad = torch.nn.functional.pad
    return torch.maximum(pad(step, (0, 1)), pad(step, (1, 0)))


def _distance(a: Tensor, b: Tensor) -> Tensor:
    return (a - b).norm(dim=-1)

"""Planners with the same primitives and collision checks: tree search over views, and random motion."""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.team.exploration.information.view_cache import InformationDiscount, ViewCache
from gmmtorch.team.exploration.information.view_evaluator import ViewEvaluator
from gmmtorch.team.exploration.information.view_library import SPACING
from gmmtorch.team.exploration.planning.frontier import FrontierPlanner
from gmmtorch.team.exploration.planning.global_planner import Journey
from gmmtorch.team.exploration.planning.planner_interface import Plan, Planner, PlanningTask, options
from gmmtorch.team.exploration.planning.primitives import Primitives
from gmmtorch.team.exploration.planning.recovery import Waiting
from gmmtorch.team.exploration.planning.tree_search import Found, SearchRule, search_tree

# The first five are shares of the largest value seen.
_NOTHING = 1e-3  # information that counts as zero
_LITTLE = 0.1  # information per primitive below which a robot looks for a better place
_PLENTY = 0.25  # information per primitive from which on a travelling robot stays
_WORTHWHILE = 0.15  # smallest value of a view in the library
_METRE = 0.2  # value of a metre of progress, compared with information
_STUCK = 0.3  # metres of progress that a branch must make
_ADDED, _REVALUED = 3, 6  # views of the library added and evaluated again in one plan
_REMEMBERED = 32  # abandoned views that are stored

_EXPLORE, _TRAVEL = SearchRule(), SearchRule(n_rounds=2, n_leaves=24)
_SQUEEZE = SearchRule(depth=6, n_rounds=6, n_leaves=48)  # by distance only, if travelling makes no progress


class TreePlanner:
    """Explores by tree search; travels to the best view of the library when little information is near.

    The largest value seen so far is the scale of all values. Information that earlier views failed to gain is
    discounted, see `InformationDiscount`. A travelling robot removes its goal from the library, so that
    no other robot goes there, and puts it back when it finds enough information on the way.
    """

    def __init__(self, primitives: Primitives, evaluator: ViewEvaluator) -> None:
        self._primitives, self._evaluator = primitives, evaluator
        self._waiting = Waiting(primitives)
        self._journey: Journey | None = None
        self._given_up = torch.zeros(0, 4, dtype=torch.float64)
        self._discount, self._weights = InformationDiscount(), torch.zeros(0)
        self._largest = 0.0
        self._branch: list[int] = []
        self._when = -math.inf

    def plan(self, task: PlanningTask) -> Plan:
        memory = ViewCache(task, self._evaluator)
        here = int(memory.rows(task.state[None, :4].double())[0])
        self._discount.note(task.local_map, memory.measured(here), task.now)
        self._weights = self._discount.weights(task.local_map)
        task = replace(task, residual=task.residual * self._weights)
        task.library.visit(task.state[None, :4], task.now)
        self._revalue(task, memory)
        found = self._on_the_way(task, memory) if self._journey is not None else None
        if found is None:
            found = self._around(task, memory)
        self._note(task, memory, found)
        if found is None:
            return self._waiting.plan(task)
        self._waiting.over()
        if self._journey is None and found.information <= _NOTHING * self._largest:
            return self._waiting.rest(task.state)
        kind = "explore" if self._journey is None else "travel"
        return Plan(found.path, found.braking, found.views, found.value, kind)

    def _around(self, task: PlanningTask, memory: ViewCache) -> Found | None:
        """Explore here, or start a journey if it promises more."""
        first = self._rest_of_branch(task)
        found = search_tree(self._primitives, _EXPLORE, task, memory, first=first)
        self._measure(memory)
        rate = _rate(found)
        if rate > _LITTLE * self._largest:
            return found
        journey = Journey.chosen(task, _WORTHWHILE * self._largest, self._given_up)
        if journey is None:
            return found
        dynamics = self._primitives.dynamics
        legs = 1 + journey.metres / (dynamics.speed * dynamics.duration)
        if journey.value / legs <= rate:
            journey.put_back(task)
            return found
        self._journey, self._largest = journey, max(self._largest, journey.value)
        return self._on_the_way(task, memory) or found

    def _on_the_way(self, task: PlanningTask, memory: ViewCache) -> Found | None:
        """Continue the journey; None if it is over or there is enough to explore here."""
        journey = self._journey
        if journey is None:
            return None
        value = None
        if bool(task.local_map.is_passable(journey.pose[:3])):
            row = memory.rows(journey.pose[None])
            value = float(memory.marginal(row, self._weights[None])[0])
        if value is not None and value < _WORTHWHILE * self._largest:
            self._journey = None
            return None
        goal = journey.goal(task, _METRE * self._largest)
        if goal is None:
            self._give_up(journey)
            return None
        found = search_tree(self._primitives, _TRAVEL, task, memory, goal, self._rest_of_branch(task))
        if found is None or found.progress < _STUCK:
            found = search_tree(self._primitives, _SQUEEZE, task, goal=goal)
        if found is None or found.progress < _STUCK:
            self._give_up(journey)
            return None
        if _rate(found) >= _PLENTY * self._largest:
            journey.put_back(task)
            self._journey = None
            return None
        return found

    def _measure(self, memory: ViewCache) -> None:
        """Update the largest value."""
        _, values = memory.views(self._weights)
        self._largest = max(self._largest, float(values.max()))

    def _give_up(self, journey: Journey) -> None:
        """End the journey and exclude its view: it was taken or cannot be reached."""
        self._given_up = torch.cat([self._given_up, journey.pose[None]])[-_REMEMBERED:]
        self._journey = None

    def _rest_of_branch(self, task: PlanningTask) -> list[int]:
        return self._branch[1:] if task.now > self._when else self._branch

    def _revalue(self, task: PlanningTask, memory: ViewCache) -> None:
        keys = task.library.covered(task.local_map, task.now, _REVALUED)
        if keys:
            known = task.library.candidates()
            at = {key: row for row, key in enumerate(known.keys)}
            rows = memory.rows(known.poses[[at[key] for key in keys]])
            values, _ = memory.marginal(rows, self._weights[None])
            task.library.revalue(keys, values, task.now, _WORTHWHILE * self._largest)

    def _note(self, task: PlanningTask, memory: ViewCache, found: Found | None) -> None:
        """Store the branch, and add the best views that it leaves out to the library."""
        self._branch, self._when = ([] if found is None else found.actions), task.now
        poses, values = memory.views(self._weights)
        self._measure(memory)
        known = [self._given_up] if found is None else [self._given_up, found.views]
        if self._journey is not None:
            known.append(self._journey.pose[None])
        apart = torch.cdist(poses[:, :3], torch.cat(known)[:, :3])
        values = values.masked_fill((apart < SPACING).any(1), 0.0)
        task.library.add(poses, values, task.now, _WORTHWHILE * self._largest, _ADDED)


_TURNING = 0.1  # metres that a turn in place counts as in a random choice
_PERSISTENCE = 0.7  # probability of repeating the last primitive if it is feasible


class RandomPlanner:
    """Repeats a primitive for a while, then draws another one, a long one more often than a short one."""

    def __init__(self, primitives: Primitives) -> None:
        self._primitives = primitives
        self._waiting = Waiting(primitives)
        self._last = -1

    def plan(self, task: PlanningTask) -> Plan:
        here = options(self._primitives, task.state[None].double(), task, may_escape=True)
        moved = (here.paths[0, :, -1, :3] - task.state[:3]).norm(dim=1)
        moved[self._primitives.stop] = 0
        possible = (moved + _TURNING * (self._primitives.commands[:, 2] != 0)) * here.feasible[0]
        if not bool(possible.any()):
            self._last = -1
            return self._waiting.plan(task)
        self._waiting.over()
        goes_on = float(torch.rand((), generator=task.generator)) < _PERSISTENCE
        if not (goes_on and self._last >= 0 and possible[self._last] > 0):
            self._last = int(torch.multinomial(possible, 1, generator=task.generator))
        path = here.paths[0, self._last]
        return Plan(path, here.braking[0, self._last], path[-1:, :4], 0.0, "explore")


PLANNERS = ("mcts", "frontier", "random")


def make_planner(name: str, primitives: Primitives, evaluator: ViewEvaluator) -> Planner:
    """Make the planner `name`, one of `PLANNERS`."""
    if name == "mcts":
        return TreePlanner(primitives, evaluator)
    if name == "frontier":
        return FrontierPlanner(primitives)
    if name == "random":
        return RandomPlanner(primitives)
    raise InvalidArgumentError(f"planner={name!r} is not one of {', '.join(PLANNERS)}.")


def _rate(found: Found | None) -> float:
    """Mean information of a branch's primitives."""
    return 0.0 if found is None else found.information / len(found.actions)

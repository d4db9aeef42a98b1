"""Planners with the same primitives and collision checks: tree search, frontiers, and random motion."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from gmmtorch.team.exploration.planning.collision_checking import LocalMap, widened
from gmmtorch.team.exploration.planning.journeys import COARSE, DistanceField, Journey, angle, looks
from gmmtorch.team.exploration.planning.planner_interface import Plan, Planner, PlanningTask, Waiting, options
from gmmtorch.team.exploration.planning.primitives import Primitives
from gmmtorch.team.exploration.planning.tree_search import Found, SearchRule, search_tree
from gmmtorch.team.exploration.planning.view_evaluator import (
    BLOCK,
    InformationDiscount,
    ViewCache,
    ViewEvaluator,
)
from gmmtorch.team.sharing import ViewLibrary

_SEARCH = SearchRule(depth=3, n_rounds=2, n_leaves=24)
_LEAST = 20  # cells of the smallest frontier
_LARGEST = 400  # cells; larger frontiers count as this large
_LOYALTY = 1.5  # factor by which another frontier must be better than the present one
_ELEVATION = 0.4  # largest angle (rad) above or below the camera at which it can see a frontier
_SAMPLES = 24  # of a line of sight
_TURN_COST = 0.3  # metres that a radian of turning costs
_TRIES = 3  # unreachable goals that one plan may try
_GLANCE = 9  # coarse cells along the side of a frontier that one view covers
_MOST = 20  # clusters considered in a plan
_CLOSEST, _FARTHEST = 1.5, 3.0  # horizontal distances (m) from which a robot looks at a frontier
_SAME = 1.0  # metres between targets that belong to the same frontier
_ABOUT = 2.0  # metres around a remembered frontier within which a frontier must still exist


class Frontiers(NamedTuple):
    """K clusters of frontier cells that a robot can look at.

    poses: (K, 4), the nearest pose that sees each cluster. targets: (K, 3), the middle cell of the cluster.
    sizes: (K,) cells. metres: (K,) distance from the robot to the pose.
    """

    poses: Tensor
    targets: Tensor
    sizes: Tensor
    metres: Tensor


def frontier_cells(local_map: LocalMap) -> Tensor:
    """Return free cells (nx, ny, nz), bool, that share a face with an unobserved cell that is not free."""
    unknown = ~(local_map.observed | local_map.free)
    beside = widened(unknown, 0, 1) | widened(unknown, 1, 1) | widened(unknown, 2, 1)
    return beside & local_map.free


def find_frontiers(local_map: LocalMap, start: Tensor, exhausted: Tensor, least: int = _LEAST) -> Frontiers:
    """Find clusters of at least `least` cells that a robot at `start` (3,) can look at, most promising first.

    exhausted: (E, 3), targets that remained after a look; cells within a metre of them are ignored.
    """
    distances = DistanceField.to(local_map, start[None])
    cells = frontier_cells(local_map).nonzero()
    if len(exhausted):
        cells = cells[torch.cdist(local_map.centers(cells), exhausted.double()).amin(1) > _SAME]
    shape = distances.metres.shape
    counts = torch.zeros(shape, dtype=torch.int64)
    counts.index_put_((cells // COARSE).unbind(1), torch.ones(len(cells), dtype=torch.int64), accumulate=True)
    label, middles = _parts(distances, counts)
    n = int(label.max()) + 1 if len(label) else 0
    sizes = torch.zeros(n, dtype=torch.int64).index_add_(0, label, counts[counts > 0])
    reached = torch.isfinite(distances.metres)
    places, metres = _middles(distances, reached.nonzero()), distances.metres[reached].double()
    apart = (middles - start).norm(dim=1)
    nearest = torch.full((n,), math.inf, dtype=torch.float64).scatter_reduce_(0, label, apart, "amin")
    promise = torch.where(sizes >= least, sizes / (1 + nearest), 0.0)
    found: list[tuple[Tensor, Tensor, float, float]] = []
    for k in promise.argsort(descending=True, stable=True)[:_MOST].tolist():
        if promise[k] == 0:
            break
        own = middles[label == k]
        target = own[(own - own.mean(0)).norm(dim=1).argmin()]
        way = target - places
        level = way[:, :2].norm(dim=1)
        can_look = (
            (level >= _CLOSEST) & (level <= _FARTHEST) & (way[:, 2].abs() <= math.tan(_ELEVATION) * level)
        )
        can_look[can_look.clone()] = _sees(local_map, places[can_look], target)
        if bool(can_look.any()):
            row = int(metres.masked_fill(~can_look, math.inf).argmin())
            pose = torch.cat([places[row], torch.atan2(way[row, 1], way[row, 0])[None]])
            found.append((pose, target, float(sizes[k]), float(metres[row])))
    if not found:
        nothing = torch.zeros(0, 4, dtype=torch.float64)
        return Frontiers(nothing, nothing[:, :3], nothing[:, 0], nothing[:, 0])
    poses, targets, counted, away = zip(*found, strict=True)
    return Frontiers(
        torch.stack(poses), torch.stack(targets), *torch.tensor([counted, away], dtype=torch.float64)
    )


def _parts(distances: DistanceField, counts: Tensor) -> tuple[Tensor, Tensor]:
    """Return the cluster (n,) and the middle (n, 3) of each coarse frontier cell with a positive count. A
    cluster is a connected set of cells, cut by a lattice of cubes that one view covers."""
    labels, _ = ndimage.label(counts.numpy() > 0, structure=np.ones((3, 3, 3)))
    cells = (counts > 0).nonzero()
    cube = cells // _GLANCE
    rows = torch.cat([torch.from_numpy(labels[labels > 0])[:, None].long(), cube], 1)
    if len(rows) == 0:
        return rows[:, 0], _middles(distances, cells)
    return torch.unique(rows, dim=0, return_inverse=True)[1], _middles(distances, cells)


def _sees(local_map: LocalMap, places: Tensor, target: Tensor) -> Tensor:
    """Flag (N,) the places (N, 3) with only free cells on the way to just before a target (3,)."""
    share = torch.linspace(0, 1, _SAMPLES + 1, dtype=torch.float64)[:-1, None]
    points = places[:, None] + share * (target - places)[:, None]
    flat, inside = local_map.flat_index(points)
    return (local_map.free.view(-1)[flat] & inside).all(1)


def _middles(distances: DistanceField, cells: Tensor) -> Tensor:
    return distances.origin + (cells + 0.5) * distances.spacing


class FrontierPlanner:
    """Flies to the frontier with the largest size/(1 + distance), and stays with it while it exists. The view
    library stores the other frontiers with their sizes as values. The robot uses them when its window
    contains no frontier."""

    def __init__(self, primitives: Primitives) -> None:
        self._primitives = primitives
        self._waiting = Waiting(primitives)
        self._journey: Journey | None = None
        self._target = torch.zeros(3, dtype=torch.float64)
        self._exhausted = torch.zeros(0, 3, dtype=torch.float64)

    def plan(self, task: PlanningTask) -> Plan:
        here = task.local_map
        found = find_frontiers(here, task.state[:3], self._exhausted)
        self._give_up(found.targets[looks(task.state, found.poses)])
        self._forget(task, found)
        for _ in range(_TRIES):
            kind = self._choose(task, found)
            if self._journey is None:
                break
            goal = self._journey.goal(task, weight=1.0)
            branch = None if goal is None else search_tree(self._primitives, _SEARCH, task, goal=goal)
            if branch is not None and branch.value > 0:
                self._waiting.over()
                return Plan(branch.path, branch.braking, branch.views, branch.value, kind)
            self._give_up(self._target[None])
        return self._waiting.plan(task)

    def _choose(self, task: PlanningTask, found: Frontiers) -> str:
        """Choose the goal; returns the kind of plan."""
        here = task.local_map
        if len(self._exhausted):
            left = torch.cdist(found.targets, self._exhausted).amin(1) >= _SAME
            found = Frontiers(*(values[left] for values in found))
        if len(found.sizes) == 0:
            if self._journey is None:
                self._journey = Journey.chosen(task, _LEAST)
                if self._journey is not None:
                    self._target = self._journey.pose[:3]
            return "travel"
        block = (here.cells_of(found.targets) // BLOCK).clamp_min(0)
        counts = [-(-n // BLOCK) for n in here.shape]
        flat = (block[:, 0] * counts[1] + block[:, 1]) * counts[2] + block[:, 2]
        turn = _TURN_COST * angle(found.poses[:, 3] - task.state[3])
        score = found.sizes.clamp_max(_LARGEST) * task.residual[flat] / (1 + found.metres + turn)
        same = (found.targets - self._target).norm(dim=1) < _SAME
        if self._journey is not None:
            score = torch.where(same, _LOYALTY * score, score)
        row = int(score.argmax())
        if self._journey is None or not bool(same[row]):
            size, metres = float(found.sizes[row]), float(found.metres[row])
            self._journey = Journey(found.poses[row], size, metres, task.now)
            self._target = found.targets[row]
        others = torch.arange(len(score)) != row
        task.library.add(found.poses[others], found.sizes[others], task.now, _LEAST, most=3)
        return "explore"

    def _give_up(self, targets: Tensor) -> None:
        """Exclude targets (N, 3) that were looked at or cannot be reached."""
        self._exhausted = torch.cat([self._exhausted, targets])
        if bool(((targets - self._target).norm(dim=1) < _SAME).any()):
            self._journey = None

    def _forget(self, task: PlanningTask, found: Frontiers) -> None:
        """Remove views inside the window from the library if no frontier is left near them."""
        known = task.library.candidates()
        inside = task.local_map.is_passable(known.poses[:, :3])
        if len(found.poses):
            apart = torch.cdist(known.poses[:, :3], found.poses[:, :3]).amin(1)
            inside &= apart > _ABOUT
        task.library.remove([known.keys[row] for row in inside.nonzero()[:, 0].tolist()], task.now)


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
        keys = task.library.covered(task.local_map.is_passable, task.now, _REVALUED)
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
        values = values.masked_fill((apart < ViewLibrary.spacing).any(1), 0.0)
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
        paths, braking, safe = options(self._primitives, task.state[None].double(), task, may_escape=True)
        moved = (paths[0, :, -1, :3] - task.state[:3]).norm(dim=1)
        moved[self._primitives.stop] = 0
        possible = (moved + _TURNING * (self._primitives.commands[:, 2] != 0)) * safe[0]
        if not bool(possible.any()):
            self._last = -1
            return self._waiting.plan(task)
        self._waiting.over()
        goes_on = float(torch.rand((), generator=task.generator)) < _PERSISTENCE
        if not (goes_on and self._last >= 0 and possible[self._last] > 0):
            self._last = int(torch.multinomial(possible, 1, generator=task.generator))
        path = paths[0, self._last]
        return Plan(path, braking[0, self._last], path[-1:, :4], 0.0, "explore")


PLANNERS: dict[str, Callable[[Primitives, ViewEvaluator], Planner]] = {
    "mcts": TreePlanner,
    "frontier": lambda primitives, _: FrontierPlanner(primitives),
    "random": lambda primitives, _: RandomPlanner(primitives),
}


def _rate(found: Found | None) -> float:
    """Mean information of a branch's primitives."""
    return 0.0 if found is None else found.information / len(found.actions)

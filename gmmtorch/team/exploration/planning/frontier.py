"""Frontiers, where known free space meets unknown space, and the planner that visits them (Yamauchi 1997)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from gmmtorch.team.exploration.information.view_evaluator import BLOCK
from gmmtorch.team.exploration.planning.geodesic import COARSE, DistanceField
from gmmtorch.team.exploration.planning.global_planner import Journey, angle, looks
from gmmtorch.team.exploration.planning.planner_interface import Plan, PlanningTask
from gmmtorch.team.exploration.planning.primitives import Primitives
from gmmtorch.team.exploration.planning.recovery import Waiting
from gmmtorch.team.exploration.planning.tree_search import SearchRule, search_tree
from gmmtorch.team.exploration.robot.mapper import LocalMap
from gmmtorch.team.exploration.world.navigable import widened

_SEARCH = SearchRule(depth=3, n_rounds=2, n_leaves=24)
_LEAST = 20  # cells of the smallest frontier
_LARGEST = 400  # cells; larger frontiers count as this large
_LOYALTY = 1.5  # factor by which another frontier must be better than the present one
_ELEVATION = 0.4  # largest angle (rad) above or below the camera at which it can see a frontier
_SAMPLES = 24  # of a line of sight
_TURNING = 0.3  # metres that a radian of turning costs
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

    Args:
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
    """Return the cluster (n,) and the middle (n, 3) of each coarse frontier cell with a positive count.

    A cluster is a connected set of cells, cut by a lattice of cubes that one view covers.
    """
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
    """Flies to the frontier with the largest size/(1 + distance), and stays with it while it exists.

    The view library stores the other frontiers with their sizes as values. The robot uses them when its
    window contains no frontier.
    """

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
        turn = _TURNING * angle(found.poses[:, 3] - task.state[3])
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

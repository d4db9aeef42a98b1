"""The way to a distant view: its cost from any state, and the journey through the local map and beyond it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gmmtorch.team.exploration.planning.geodesic import DistanceField
from gmmtorch.team.exploration.planning.planner_interface import PlanningTask
from gmmtorch.team.exploration.planning.roadmap import at_the_rim

_TURNING = 1.25  # metres that a radian off the direction of the way costs
_NEAR = 1.0  # horizontal metres from the goal within which a robot turns to the goal's heading
_AHEAD = 3  # cells of the distance field along which the direction of the way is measured


@dataclass(frozen=True, eq=False)
class Goal:
    """A goal and the value of a metre of progress towards it.

    distances: to the goal. weight: value of a metre of progress. yaw: heading at the goal.
    """

    distances: DistanceField
    weight: float
    yaw: float

    def cost(self, states: Tensor) -> Tensor:
        """Remaining cost (...,) in metres from states (..., 7): the way, the turn into it, and the last turn.

        Close to the goal, and directly above or below it, only the last turn counts.
        """
        points, yaw = states[..., :3], states[..., 3]
        metres, there = self.distances.way(points, _AHEAD)
        way = there - points
        bearing = torch.atan2(way[..., 1], way[..., 0])
        into, last = angle(bearing - yaw) + angle(self.yaw - bearing), angle(self.yaw - yaw)
        level = (way[..., :2].norm(dim=-1) / _NEAR).clamp_max(1)
        return metres + _TURNING * torch.lerp(last, into, level)


def angle(radians: Tensor) -> Tensor:
    """Absolute angles, wrapped to at most π."""
    return (torch.remainder(radians + math.pi, 2 * math.pi) - math.pi).abs()


_REFRESHED = 10.0  # seconds after which the way over the roadmap is computed again
_PATIENCE = 12.0  # seconds without progress after which a robot gives up
_CLOSER = 0.5  # metres that count as progress
_THERE = 1.2  # metres from the goal at which the robot has arrived
_FACING = 0.7  # radians off the goal's heading at which the robot has arrived


def looks(state: Tensor, poses: Tensor) -> Tensor:
    """Flag (...,) the poses (..., 4) that a robot in a state (7,) has reached, position and heading."""
    is_there = (state[:3] - poses[..., :3]).norm(dim=-1) < _THERE
    return is_there & (angle(state[3] - poses[..., 3]) < _FACING)


class Journey:
    """A journey to a view `pose` (4,) with a `value`, `metres` away at the start.

    `since` is the time (s) of the last progress. The roadmap gives the distance from its nodes to the
    goal. Inside the local map the distance is computed cell by cell, from the goal if it is inside, and
    from the nodes near the border, each with its remaining distance.
    """

    def __init__(self, pose: Tensor, value: float, metres: float, now: float) -> None:
        self.pose, self.value, self.metres = pose, value, metres
        self._nearest, self.since = math.inf, now
        self._nodes, self._rest = torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, dtype=torch.float64)
        self._refreshed = -math.inf

    @classmethod
    def chosen(cls, task: PlanningTask, least: float, given_up: Tensor | None = None) -> Journey | None:
        """Start a journey to the view with the largest value/(1 + metres), and take it from the library.

        Returns None if no view worth `least` can be reached. Views close to `given_up` (N, 4) are ignored.
        """
        known = task.library.candidates()
        if not known.keys:
            return None
        metres = task.roadmap.distances(task.state[:3], known.poses[:, :3])
        if given_up is not None and len(given_up):
            apart = torch.cdist(known.poses[:, :3], given_up[:, :3]).amin(1)
            metres = metres.masked_fill(apart < _THERE, math.inf)
        row = task.library.best(metres, least=least)
        if row is None:
            return None
        task.library.remove([known.keys[row]], task.now)
        return cls(known.poses[row], float(known.values[row]), float(metres[row]), task.now)

    def put_back(self, task: PlanningTask) -> None:
        """Return the view to the library."""
        task.library.add(self.pose[None], torch.tensor([self.value]), task.now, 0.0)

    def goal(self, task: PlanningTask, weight: float) -> Goal | None:
        """Return the goal of the next motion; None if the robot has arrived or makes no progress."""
        if bool(looks(task.state, self.pose)):
            return None
        goal = Goal(self._field(task), weight, float(self.pose[3]))
        cost = float(goal.cost(task.state))
        if cost < self._nearest - _CLOSER:
            self._nearest, self.since = cost, task.now
        return None if task.now - self.since > _PATIENCE else goal

    def _field(self, task: PlanningTask) -> DistanceField:
        if task.now - self._refreshed >= _REFRESHED:
            self._nodes, self._rest = task.roadmap.reaching(self.pose[:3])
            self._refreshed = task.now
        here = task.local_map
        rim = at_the_rim(self._nodes, here.box, here.resolution, 1.5 * task.roadmap.spacing)
        goals = torch.cat([self.pose[None, :3], self._nodes[rim]])
        offsets = torch.cat([self._rest.new_zeros(1), self._rest[rim]])
        return DistanceField.to(here, goals, offsets)

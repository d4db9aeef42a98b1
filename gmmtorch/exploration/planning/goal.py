"""Goal of a robot, and the cost that remains from any state."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gmmtorch.exploration.planning.geodesic import DistanceField

_NEAR = 1.0  # horizontal metres from the goal within which a robot turns to the goal's heading
_AHEAD = 3  # cells of the distance field along which the direction of the way is measured


@dataclass(frozen=True, eq=False)
class Goal:
    """A goal and the value of a metre of progress towards it.

    distances: to the goal. yaw: heading at the goal; None: any. weight: value of a metre of progress.
    turning: metres that a radian off the direction of the way costs.
    """

    distances: DistanceField
    weight: float
    yaw: float | None = None
    turning: float = 1.25

    def cost(self, states: Tensor) -> Tensor:
        """Remaining cost (...,) in metres from states (..., 7): the way, the turn into it, the turn to
        the goal's yaw.

        Close to the goal, and directly above or below it, only the last turn counts.
        """
        points, yaw = states[..., :3], states[..., 3]
        metres, there = self.distances.way(points, _AHEAD)
        way = there - points
        bearing = torch.atan2(way[..., 1], way[..., 0])
        into, last = _angle(bearing - yaw), torch.zeros_like(yaw)
        if self.yaw is not None:
            into, last = into + _angle(self.yaw - bearing), _angle(self.yaw - yaw)
        level = (way[..., :2].norm(dim=-1) / _NEAR).clamp_max(1)
        return metres + self.turning * torch.lerp(last, into, level)


def _angle(radians: Tensor) -> Tensor:
    """Absolute angles, wrapped to at most π."""
    return (torch.remainder(radians + math.pi, 2 * math.pi) - math.pi).abs()

"""Where a robot is to go, and what is left of the way from any state."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gmmtorch.exploration.planning.geodesic import DistanceField

_NEAR = 1.0  # metres of level way within which a robot turns to look as the goal asks
_AHEAD = 3  # cells of the distance field that a robot looks along its way


@dataclass(frozen=True, eq=False)
class Goal:
    """Where to go, and what a metre on the way there is worth.

    distances: to the goal. yaw: heading to look along once there; None: any. weight: return of a metre.
    turning: metres that a radian off the way counts for.
    """

    distances: DistanceField
    weight: float
    yaw: float | None = None
    turning: float = 1.25

    def cost(self, states: Tensor) -> Tensor:
        """Metres (...,) left from states (..., 7): the way, the turn into it, and that to the goal's yaw.

        Close to the goal, and straight above or below it, only the last turn counts.
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
    """The size of angles, at most half a turn."""
    return (torch.remainder(radians + math.pi, 2 * math.pi) - math.pi).abs()

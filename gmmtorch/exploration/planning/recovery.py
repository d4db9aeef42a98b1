"""Recovery: a robot that no longer fits at its position, according to its map, flies back along its trail."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gmmtorch.exploration.planning.coordination import clear_of
from gmmtorch.exploration.planning.planner_interface import LEAST, Plan, PlanningTask, is_boxed_in
from gmmtorch.exploration.planning.primitives import Primitives

_METRES = 0.8  # largest distance of one plan


def retreat(primitives: Primitives, task: PlanningTask) -> Plan | None:
    """Plan a flight back along the robot's trail; None if it fits, is not at rest, or can leave by a
    primitive.

    A cell nearby may become occupied in the map, so that no primitive is safe because all are longer than
    the gap. The trail is safe because the robot has flown it. The robot starts and ends at rest and
    covers s(t) = L (1 − cos πt/T)/2 of L metres.
    """
    if bool(task.state[4:].any()) or bool(task.local_map.is_passable(task.state[:3])):
        return None
    if not is_boxed_in(primitives, task):
        return None
    dynamics = primitives.dynamics
    longest = dynamics.acceleration * 2 * (dynamics.duration / math.pi) ** 2
    way = _back(task.trail, min(_METRES, longest))
    if way is None:
        return None
    n = dynamics.n_steps
    share = (1 - torch.cos(torch.arange(1, n + 1, dtype=torch.float64) * (math.pi / n))) / 2
    places = _along(way, share)
    if not bool(clear_of(places, task.peers, task.state[:3])):
        return None
    path = task.state.repeat(n, 1)
    path[:, :3] = places
    return Plan(path, path[-1:].clone(), path[-1:, :4], 0.0, "retreat")


def shortened(trail: Tensor, path: Tensor) -> Tensor:
    """Return the rest of a trail (N, 3), latest last, after the robot flew back along it to the end of a
    path (S, 3).
    """
    nearest = int((trail - path[-1]).norm(dim=1).argmin())
    return torch.cat([trail[:nearest], path[-1:]]) if nearest else path[-1:]


def _back(trail: Tensor, metres: float) -> Tensor | None:
    """Return the last `metres` of a trail (N, 3), from its end backwards; None if the trail is too short."""
    way = trail.flip(0)
    length = torch.cumsum((way[1:] - way[:-1]).norm(dim=1), 0)
    if len(length) == 0 or float(length[-1]) < LEAST:
        return None
    n = int((length < metres).sum())
    last = _along(way, torch.tensor([min(1.0, metres / float(length[-1]))], dtype=way.dtype))
    return torch.cat([way[: n + 1], last])


def _along(way: Tensor, share: Tensor) -> Tensor:
    """Return places (S, 3) at shares (S,) of the length of a way (N, 3)."""
    step = (way[1:] - way[:-1]).norm(dim=1)
    length = torch.cat([step.new_zeros(1), torch.cumsum(step, 0)])
    at = share * length[-1]
    leg = torch.searchsorted(length, at, right=True).clamp(1, len(way) - 1) - 1
    rest = (at - length[leg]) / step[leg].clamp_min(torch.finfo(step.dtype).tiny)
    return way[leg] + rest.clamp(0, 1)[:, None] * (way[leg + 1] - way[leg])

"""Retreat: back along the way it came, for a robot that no longer fits where it is, by what it knows now."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gmmtorch.exploration.planning.peer_trajectories import clear_of
from gmmtorch.exploration.planning.planner_interface import LEAST, Plan, PlanningTask, is_boxed_in
from gmmtorch.exploration.planning.primitives import Primitives

_METRES = 0.8  # of the way, in one plan


def retreat(primitives: Primitives, task: PlanningTask) -> Plan | None:
    """A plan back along the robot's trail; None where it fits, is not at rest, or can leave otherwise.

    A map that changes its mind about a cell nearby can leave a robot where no primitive is safe, as they are
    all longer than the gap. Where it has flown, it fits: it goes back slowly, easing in and out, so that it
    is at rest at the end, with s(t) = L (1 − cos πt/T)/2 metres flown of L.
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
    """What is left of a trail (N, 3), the latest last, of a robot that retreated along it to the end of a
    path (S, 3)."""
    nearest = int((trail - path[-1]).norm(dim=1).argmin())
    return torch.cat([trail[:nearest], path[-1:]]) if nearest else path[-1:]


def _back(trail: Tensor, metres: float) -> Tensor | None:
    """The last so many metres of a trail (N, 3), from its end backwards; None where it is no way at all."""
    way = trail.flip(0)
    length = torch.cumsum((way[1:] - way[:-1]).norm(dim=1), 0)
    if len(length) == 0 or float(length[-1]) < LEAST:
        return None
    n = int((length < metres).sum())
    last = _along(way, torch.tensor([min(1.0, metres / float(length[-1]))], dtype=way.dtype))
    return torch.cat([way[: n + 1], last])


def _along(way: Tensor, share: Tensor) -> Tensor:
    """Places (S, 3) at shares (S,) of the length of a way (N, 3)."""
    step = (way[1:] - way[:-1]).norm(dim=1)
    length = torch.cat([step.new_zeros(1), torch.cumsum(step, 0)])
    at = share * length[-1]
    leg = torch.searchsorted(length, at, right=True).clamp(1, len(way) - 1) - 1
    rest = (at - length[leg]) / step[leg].clamp_min(torch.finfo(step.dtype).tiny)
    return way[leg] + rest.clamp(0, 1)[:, None] * (way[leg + 1] - way[leg])

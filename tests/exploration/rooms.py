"""Rooms, small missions in them, and what of a row does not depend on a clock."""

from __future__ import annotations

import json
from typing import Any

import torch
from torch import Tensor

from gmmtorch.simulation import DepthCamera, box
from gmmtorch.team.exploration import TeamOptions, World
from gmmtorch.team.sharing import PlanMessage

SMALL = TeamOptions(
    size=2,
    duration=20.0,
    camera=DepthCamera(width=48, height=36, max_range=4.5),
    window=(64, 64, 32),
    sample_every=5.0,
    n_beams=60,
)
SHELF = box((4.5, 2.5, 0.1), (5.1, 8.1, 3.1))
HALL = torch.cat(
    [
        box((0.1, 0.1, 0.1), (9.9, 5.9, 2.9)),
        box((4.0, 0.1, 0.1), (4.3, 3.0, 2.9)),  # a wall with a way around it
        box((7.0, 4.0, 0.1), (8.6, 5.2, 1.6)),  # a solid, large enough for a robot inside
    ]
)


def room(*pieces: Tensor) -> Tensor:
    """A hall of 10 by 8 by 3 metres, its walls half a cell off the lattice, with pieces in it."""
    return torch.cat([box((0.1, 0.1, 0.1), (10.1, 8.1, 3.1)), *pieces])


def small_room() -> World:
    """A room of 7 by 6 by 3 metres, whose walls lie half a cell off the lattice."""
    walls = box((0.1, 0.1, 0.1), (7.1, 6.1, 3.1))
    return World.from_mesh(walls, start=(2.0, 2.0, 1.3), cache=False, name="room")


def without_seconds(row: dict[str, Any]) -> dict[str, Any]:
    kept = {k: v for k, v in row.items() if not k.endswith("seconds")}
    return json.loads(json.dumps(kept, allow_nan=False))


def plan_ahead(n: int, step: float = 0.2, sender: int = 1) -> PlanMessage:
    """A plan of n poses along x, one metre apart."""
    path = torch.zeros(n, 4, dtype=torch.float64)
    path[:, 0] = torch.arange(1, n + 1)
    return PlanMessage(sender, 0, 0.0, step, path, torch.zeros(0, 4))

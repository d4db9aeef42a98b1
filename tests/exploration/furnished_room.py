"""A furnished room, small missions in it, and what of a row does not depend on a clock."""

from __future__ import annotations

import json
from typing import Any

import torch
from torch import Tensor

from gmmtorch.exploration.mission.options import TeamOptions
from gmmtorch.simulation.sensors.depth_camera import DepthCamera
from gmmtorch.simulation.worlds.furniture import box

SMALL = TeamOptions(
    size=2,
    duration=20.0,
    camera=DepthCamera(width=48, height=36, max_range=4.5),
    window=(64, 64, 32),
    sample_every=5.0,
    n_beams=60,
)
SHELF = box((4.5, 2.5, 0.1), (5.1, 8.1, 3.1))


def room(*pieces: Tensor) -> Tensor:
    """A hall of 10 by 8 by 3 metres, its walls half a cell off the lattice, with pieces in it."""
    return torch.cat([box((0.1, 0.1, 0.1), (10.1, 8.1, 3.1)), *pieces])


def without_seconds(row: dict[str, Any]) -> dict[str, Any]:
    kept = {k: v for k, v in row.items() if not k.endswith("seconds")}
    return json.loads(json.dumps(kept, allow_nan=False))

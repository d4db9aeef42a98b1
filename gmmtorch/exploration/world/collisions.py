"""Collisions of robots with the true mesh and with each other. Missions count them as failures."""

from __future__ import annotations

import torch
from torch import Tensor

from gmmtorch.simulation.worlds.mesh_world import MeshWorld


def collides(world: MeshWorld, positions: Tensor, radius: float) -> Tensor:
    """Flag (S,) the positions (S, 3), metres, that are closer than `radius` to a surface.

    The test does not detect positions deep inside a solid. Positions along a path must therefore be no
    farther apart than the robot's width, so that no step passes through a surface undetected.
    """
    if len(positions) == 0:
        return torch.zeros(0, dtype=torch.bool)
    return world.clearance(positions, threads=torch.get_num_threads()) < radius


def finely(positions: Tensor, n: int = 4) -> Tensor:
    """Interpolate positions (1 + S, 3) to (1 + n S, 3), n steps for each: a robot may collide between
    states.
    """
    share = torch.arange(1, n + 1, dtype=positions.dtype)[:, None] / n
    between = positions[:-1, None] + share * (positions[1:, None] - positions[:-1, None])
    return torch.cat([positions[:1], between.reshape(-1, 3)])


def meets_others(positions: Tensor, radius: float) -> Tensor:
    """Flag (R, S) the robots that are closer than two radii to another, at positions (R, S, 3), metres."""
    apart = (positions[:, None] - positions[None]).norm(dim=-1)
    other = ~torch.eye(len(positions), dtype=torch.bool)[..., None]
    return ((apart < 2 * radius) & other).any(1)

"""Collisions: whether robots touched the true mesh, or one another. Missions count them as failures."""

from __future__ import annotations

import torch
from torch import Tensor

from gmmtorch.simulation.worlds.mesh_world import MeshWorld


def collides(world: MeshWorld, positions: Tensor, radius: float) -> Tensor:
    """Which (S,) of a robot's positions (S, 3), metres, are nearer than `radius` to a surface.

    Inside a solid deeper than that nothing is near: positions of a path should be no farther apart than
    the robot is wide, so that none passes through a surface unseen.
    """
    if len(positions) == 0:
        return torch.zeros(0, dtype=torch.bool)
    return world.clearance(positions, threads=torch.get_num_threads()) < radius


def finely(positions: Tensor, n: int = 4) -> Tensor:
    """Positions (1 + n S, 3) evenly on the way through positions (1 + S, 3): between two states a robot may
    touch what it touches at neither."""
    share = torch.arange(1, n + 1, dtype=positions.dtype)[:, None] / n
    between = positions[:-1, None] + share * (positions[1:, None] - positions[:-1, None])
    return torch.cat([positions[:1], between.reshape(-1, 3)])


def meets_others(positions: Tensor, radius: float) -> Tensor:
    """Whether each robot (R, S) is nearer than two radii to any other, at positions (R, S, 3), metres."""
    apart = (positions[:, None] - positions[None]).norm(dim=-1)
    other = ~torch.eye(len(positions), dtype=torch.bool)[..., None]
    return ((apart < 2 * radius) & other).any(1)

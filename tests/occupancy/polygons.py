"""Random convex polygons, and which points they contain."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def random_polygons(n: int, n_corners: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Starts and ends (n_corners, 2, n) of the edges of polygons inscribed in circles, counter-clockwise."""
    angle = torch.rand(n_corners, n, generator=generator).double().mul(2 * math.pi).sort(0).values
    center = torch.randn(2, n, generator=generator).double()
    radius = 3 * torch.rand(n, generator=generator).double()
    corners = center + radius * torch.stack([angle.cos(), angle.sin()], 1)
    return corners, corners.roll(-1, 0)


def contained(points: Tensor, starts: Tensor, ends: Tensor) -> Tensor:
    """Which points (N, 2) lie to the left of all edges (E, 2): (N,)."""
    step = ends - starts
    offset = points[:, None] - starts
    return (step[:, 0] * offset[..., 1] - step[:, 1] * offset[..., 0] > 0).all(1)

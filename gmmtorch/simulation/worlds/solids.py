"""Solids as triangles (T, 3, 3), metres, z up."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gmmtorch.simulation.worlds.floor_plan import circle


def prism(outline: Tensor, bottom: float, top: float) -> Tensor:
    """A prism (4C − 4, 3, 3) over a convex, counter-clockwise outline (C, 2), between two heights (m)."""
    low = torch.cat([outline, torch.full_like(outline[:, :1], bottom)], 1)
    high = torch.cat([outline, torch.full_like(outline[:, :1], top)], 1)
    next_low, next_high = low.roll(-1, dims=0), high.roll(-1, dims=0)
    sides = torch.cat([torch.stack([low, next_low, next_high], 1), torch.stack([low, next_high, high], 1)])
    return torch.cat([sides, _fan(high), _fan(low.flip(0))])


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> Tensor:
    """An axis-aligned box (12, 3, 3) between two opposite corners."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    return prism(torch.tensor([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], dtype=torch.float64), z0, z1)


def ball(centre: tuple[float, float, float], radius: float, n_sides: int = 12) -> Tensor:
    """A sphere (T, 3, 3) with `n_sides` meridians and half as many rows of latitude."""
    polar = torch.arange(n_sides // 2 + 1, dtype=torch.float64) * (math.pi / (n_sides // 2))
    ring = circle(1.0, n_sides)
    height = polar.cos()[:, None, None].expand(-1, n_sides, 1)
    rows = torch.cat([polar.sin()[:, None, None] * ring[None], height], 2)
    rows = rows * radius + torch.tensor(centre, dtype=torch.float64)
    a, b = rows[1:], rows[:-1]
    next_a, next_b = a.roll(-1, dims=1), b.roll(-1, dims=1)
    lower = torch.stack([a, next_a, next_b], 2)[:-1]  # the row at each pole has one triangle per side
    upper = torch.stack([a, next_b, b], 2)[1:]
    return torch.cat([lower.flatten(0, 1), upper.flatten(0, 1)])


def copies(template: Tensor, center: Tensor, size: Tensor, heading: Tensor | None = None) -> Tensor:
    """Copies (N·T, 3, 3) of a solid (T, 3, 3) that fills the cube of side 1 around the origin.

    Args:
        center: (N, 3), metres.
        size: (N, 3) or (3,), metres along the copy's own axes.
        heading: (N,) angles about the vertical axis (rad); default 0.
    """
    shapes = template * size.expand_as(center)[:, None, None]
    if heading is not None:
        cos, sin = heading.cos()[:, None, None], heading.sin()[:, None, None]
        x, y, z = shapes.unbind(-1)
        shapes = torch.stack([cos * x - sin * y, sin * x + cos * y, z], -1)
    return (shapes + center[:, None, None]).flatten(0, 1)


def _fan(corners: Tensor) -> Tensor:
    """Triangles (C − 2, 3, 3) that fill a convex polygon (C, 3)."""
    first = corners[:1].expand(corners.shape[0] - 2, 3)
    return torch.stack([first, corners[1:-1], corners[2:]], 1)


UNIT_CUBE = box((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))

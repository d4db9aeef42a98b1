"""A room with a round pillar and a range sensor that circles it, in closed form; and rows without times."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

from gmmtorch.scan import Scan

SIDE = 6.0
"""Metres; the room is [0, SIDE]^D, and the pillar (a ball in 3D) is at its centre."""

RADIUS = 0.8
NO_RETURN_RANGE = 1.0


def directions(n_beams: int, dim: int, generator: torch.Generator) -> Tensor:
    """Unit vectors (n_beams, dim), uniform on the circle or sphere."""
    raw = torch.randn(n_beams, dim, generator=generator, dtype=torch.float64)
    return raw / raw.norm(dim=1, keepdim=True)


def ranges(origin: Tensor, direction: Tensor) -> Tensor:
    """Distance (N,) from the origin (D,) to the first surface along each beam (N, D)."""
    wall = torch.where(direction > 0, (SIDE - origin) / direction, -origin / direction)
    nearest = wall.nan_to_num(nan=math.inf).amin(1)
    offset = origin - SIDE / 2
    half = direction @ offset
    root = half**2 - (offset @ offset - RADIUS**2)
    pillar = -half - root.clamp_min(0).sqrt()
    return torch.where((root > 0) & (pillar > 0), pillar.minimum(nearest), nearest)


def room_scan(number: int, n_beams: int = 90, dim: int = 2, noise: float = 0.01, seed: int = 0) -> Scan:
    """One scan from a position on the circle around the pillar; every tenth beam has no return."""
    generator = torch.Generator().manual_seed(1000 * seed + number)
    angle = 0.37 * number
    origin = torch.full((dim,), SIDE / 2, dtype=torch.float64)
    origin[:2] += 2 * torch.tensor([math.cos(angle), math.sin(angle)], dtype=torch.float64)
    direction = directions(n_beams, dim, generator)
    length = ranges(origin, direction)
    length += noise * torch.randn(n_beams, generator=generator, dtype=torch.float64)
    empty = torch.arange(n_beams) % 10 == 9
    return Scan(
        (origin + direction * length[:, None])[~empty], origin, (origin + direction * NO_RETURN_RANGE)[empty]
    )


def room_scans(n_scans: int, n_beams: int = 90, dim: int = 2, seed: int = 0) -> list[Scan]:
    """Scans from positions along the circle."""
    return [room_scan(number, n_beams, dim, seed=seed) for number in range(n_scans)]


def timeless(rows: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows of a result without times."""
    return [{k: v for k, v in row.items() if not k.endswith("seconds")} for row in rows]

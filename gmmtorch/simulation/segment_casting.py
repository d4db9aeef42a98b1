"""Distance along rays to the nearest line segment in 2D. Worlds have few segments: each ray is tested against
all of them."""

from __future__ import annotations

import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike, as_tensor
from gmmtorch.errors import InvalidArgumentError

_CHUNK_PAIRS = 1 << 15
"""Ray and segment pairs processed at a time."""

_SLACK = 64 * torch.finfo(torch.float64).eps
"""Relative distance outside an end at which a ray still counts as a hit, so that no ray passes between two
adjacent segments. A ray whose angle to a segment is below four times this counts as parallel to it."""


def ray_segments(origins: ArrayLike, directions: ArrayLike, segments: ArrayLike) -> Tensor:
    """Distances (N,), float64, to the nearest segment, in multiples of the direction's length; inf if none.

    Solves o + t d = a + s (b − a) for t > 0 and 0 ≤ s ≤ 1. A ray parallel to a segment does not hit it.

    Args:
        origins: (N, 2), or (2,) if all rays start at one point.
        directions: (N, 2).
        segments: (S, 2, 2), the two end points of each segment.
    """
    origins, directions, segments = _checked(origins, directions, segments)
    best = torch.full_like(directions[:, 0], torch.inf)
    if segments.shape[0] == 0:
        return best
    a, edge = segments[:, 0], segments[:, 1] - segments[:, 0]
    flat = 4 * _SLACK * edge.norm(dim=1)
    step = max(1, _CHUNK_PAIRS // segments.shape[0])
    for start in range(0, directions.shape[0], step):
        rows = slice(start, start + step)
        d = directions[rows, None]
        to_start = a - origins[rows, None]
        turn = _cross_2d(d, edge)
        t = _cross_2d(to_start, edge) / turn
        s = _cross_2d(to_start, d) / turn
        hit = (t > 0) & (s >= -_SLACK) & (s <= 1 + _SLACK) & (turn.abs() > flat * d.norm(dim=2))
        best[rows] = torch.where(hit, t, torch.inf).amin(1)
    return best


def _cross_2d(u: Tensor, v: Tensor) -> Tensor:
    return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]


def _checked(origins: ArrayLike, directions: ArrayLike, segments: ArrayLike) -> tuple[Tensor, Tensor, Tensor]:
    """Origins (N, 2), directions (N, 2) and segments as float64, because the products above cancel."""
    origins = as_tensor(origins, "origins", torch.float64)
    directions = as_tensor(directions, "directions", torch.float64)
    segments = as_tensor(segments, "segments", torch.float64)
    if directions.ndim != 2 or directions.shape[1] != 2:
        raise InvalidArgumentError(f"directions has shape {tuple(directions.shape)}; expected (N, 2).")
    if origins.shape not in ((2,), directions.shape):
        raise InvalidArgumentError(
            f"origins has shape {tuple(origins.shape)}; expected (2,) or {tuple(directions.shape)}, "
            "one for each direction."
        )
    if segments.ndim != 3 or segments.shape[1:] != (2, 2):
        raise InvalidArgumentError(f"segments have shape {tuple(segments.shape)}; expected (S, 2, 2).")
    return origins.expand(directions.shape), directions, segments

"""Regions of the world to show: bounds without stray points, and the squares with the most surface."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.report.style import as_array
from gmmtorch.scan import ArrayLike

Corners = tuple[tuple[float, ...], tuple[float, ...]]
"""The lowest and the highest corner (D,) of a box, world metres."""


def busiest_regions(points: ArrayLike, n: int, side: float | None = None) -> list[Corners]:
    """Returns the corners of the `n` squares of the plane that contain the most surface, no two adjacent.

    Surface is counted in cells of a hundredth of the side, so points on top of each other count once. Returns
    fewer squares if there are not enough.

    Args:
        points: (N, 2), world metres.
        n: number of squares.
        side: side of a square (m); if None, a tenth of the longer side of the cloud.
    """
    cloud = _finite(points)
    if n < 1 or len(cloud) == 0:
        return []
    if side is None:
        side = max(float((cloud.amax(0) - cloud.amin(0)).max()) / 10, 1e-3)
    fine = torch.unique((cloud / (side / 100)).floor(), dim=0)
    tiles, count = torch.unique((fine / 100).floor(), dim=0, return_counts=True)
    chosen: list[Tensor] = []
    for tile in tiles[count.argsort(descending=True, stable=True)]:
        if len(chosen) < n and all(float((tile - other).abs().max()) > 1 for other in chosen):
            chosen.append(tile)
    return [(corner_of(tile * side), corner_of((tile + 1) * side)) for tile in chosen]


def robust_bounds(
    points: ArrayLike, trajectory: ArrayLike | None = None, share: float = 0.99, margin: float = 1.0
) -> Corners:
    """Returns the corners (D,) of a box around `share` of the points (N, D) along each axis and the whole
    trajectory (S, D), plus `margin` metres; a unit box if both are empty.

    A few stray points far away do not enlarge the box.
    """
    cloud = _finite(points)
    if not 0 < share <= 1:
        raise InvalidArgumentError(f"share={share} must lie in (0, 1].")
    corners = []
    if len(cloud):
        corners.append(np.quantile(cloud.numpy(), [(1 - share) / 2, (1 + share) / 2], axis=0))
    if trajectory is not None and len(trajectory):
        path = as_array(trajectory)
        corners.append(np.stack([path.min(0), path.max(0)]))
    if not corners:
        return (-1.0,) * cloud.shape[1], (1.0,) * cloud.shape[1]
    pad = max(margin, 1e-3)
    return corner_of(np.min(corners, (0, 1)) - pad), corner_of(np.max(corners, (0, 1)) + pad)


def inside(points: Tensor, box: tuple[Sequence[float], Sequence[float]]) -> Tensor:
    """Returns the mask (N,) of the points (N, D) in a box between two corners (D,)."""
    low, high = (points.new_tensor(corner) for corner in box)
    return ((points >= low) & (points <= high)).all(1)


def corner_of(value: ArrayLike) -> tuple[float, ...]:
    """Converts coordinates (D,) to a tuple of floats."""
    return tuple(torch.as_tensor(value, dtype=torch.float64).flatten().tolist())


def _finite(points: ArrayLike) -> Tensor:
    cloud = torch.as_tensor(points).detach().cpu().double()
    return cloud[torch.isfinite(cloud).all(1)]

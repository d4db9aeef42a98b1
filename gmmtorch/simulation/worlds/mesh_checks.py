"""What a triangle mesh must be before robots fly in it."""

from __future__ import annotations

import logging

import torch
from torch import Tensor

from gmmtorch.errors import DataError, InvalidArgumentError

_log = logging.getLogger(__name__)

_SLENDER = 1e-12
"""Area over the square of the longest edge below which a triangle counts as a line."""


def checked_triangles(triangles: Tensor, name: str = "mesh") -> Tensor:
    """Triangles (T', 3, 3), float64, on the CPU, without those that have no area; logs how many those were.

    Holes and inverted triangles are no fault: rays meet both faces, and what can be seen through a hole ends
    at the bounds of the world. Raises `InvalidArgumentError` for another shape, and `DataError` for a
    corner that is not finite, or where no triangle is left.
    """
    if triangles.ndim != 3 or triangles.shape[1:] != (3, 3):
        raise InvalidArgumentError(
            f"{name}: triangles have shape {tuple(triangles.shape)}; expected (T, 3, 3)."
        )
    triangles = triangles.detach().cpu().double()
    if len(triangles) == 0:
        raise DataError(f"{name} has no triangles; give a mesh with faces.")
    broken = ~torch.isfinite(triangles).flatten(1).all(1)
    if bool(broken.any()):
        raise DataError(
            f"{name}: {int(broken.sum())} of {len(triangles)} triangles have a corner that is NaN or "
            f"infinite, the first is number {int(broken.nonzero()[0])}; repair the mesh, or drop them."
        )
    solid = have_area(triangles)
    n_flat = int((~solid).sum())
    if n_flat == len(triangles):
        raise DataError(f"{name}: all {n_flat} triangles have no area; are its coordinates rounded or flat?")
    if n_flat:
        _log.warning("%s: dropped %d of %d triangles, which have no area", name, n_flat, len(triangles))
    return triangles[solid]


def have_area(triangles: Tensor) -> Tensor:
    """Which (T,) of triangles (T, 3, 3) are more than a line or a point."""
    edges = triangles.roll(-1, 1) - triangles
    area = torch.linalg.cross(edges[:, 0], edges[:, 1]).norm(dim=1) / 2
    return area > _SLENDER * edges.square().sum(2).amax(1)

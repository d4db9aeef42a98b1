"""How far a ray flies until it meets a line segment (2D) or a triangle (3D), in plain torch.

Segments are few, so every ray is tested against each. Rays that start at one place, as those of a sensor
do, are tested only against the triangles that reach into the cone of their bundle: a few in a hundred.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.simulation.sensors.ray_bundles import apart, bundled, candidates

_CHUNK_PAIRS = 1 << 15
"""Pairs of ray and segment held at once."""

_SLACK = 64 * torch.finfo(torch.float64).eps
"""How far beside an edge, relatively, a ray may pass and still count as a hit, so that no ray slips through
where two primitives meet; rays closer than four times that to parallel do not meet a primitive."""


def ray_segments(origins: Tensor, directions: Tensor, segments: Tensor) -> Tensor:
    """Distances (N,), float64, in lengths of the direction, to the nearest segment; inf where none is met.

    Solves o + t d = a + s (b − a) for t > 0 and 0 ≤ s ≤ 1. Rays along a segment do not meet it.

    Args:
        origins: (N, 2), or (2,) for rays that all start at one place.
        directions: (N, 2).
        segments: (S, 2, 2), the two ends of each.
    """
    origins, directions, segments = _checked(origins, directions, segments, (2, 2))
    best = _nothing(directions)
    a, edge = segments[:, 0], segments[:, 1] - segments[:, 0]
    flat = 4 * _SLACK * edge.norm(dim=1)
    for rows in _chunks(directions.shape[0], segments.shape[0]):
        d = directions[rows, None]
        to_start = a - origins[rows, None]
        turn = _cross_2d(d, edge)
        t = _cross_2d(to_start, edge) / turn
        s = _cross_2d(to_start, d) / turn
        met = (t > 0) & (s >= -_SLACK) & (s <= 1 + _SLACK) & (turn.abs() > flat * d.norm(dim=2))
        best[rows] = torch.where(met, t, torch.inf).amin(1)
    return best


def ray_triangles(origins: Tensor, directions: Tensor, triangles: Tensor) -> Tensor:
    """Distances (N,), float64, in lengths of the direction, to the nearest triangle; inf where none is met.

    A ray passes inside a triangle if it passes all three edges on the same side. The side of the edge
    p → q is the triple product d · ((p − o) × (q − o)) = d · (p × q) + (o × d) · (q − p). Neighbours
    share an edge with opposite sign, so no ray slips through between them.
    Both faces count; rays in the plane of a triangle do not meet it.

    Args:
        origins: (N, 3), or (3,) for rays that all start at one place.
        directions: (N, 3).
        triangles: (T, 3, 3), the three corners of each.
    """
    one_origin = origins.ndim == 1
    origins, directions, triangles = _checked(origins, directions, triangles, (3, 3))
    best = _nothing(directions)
    if triangles.shape[0] == 0 or directions.shape[0] == 0:
        return best
    centre = origins[0]  # about which the products below cancel least
    origins, triangles = origins - centre, triangles - centre
    rays = torch.cat([directions, torch.linalg.cross(origins, directions)], 1)
    ahead = triangles.roll(-1, dims=1)
    edges = torch.cat([torch.linalg.cross(triangles, ahead), ahead - triangles], 2)  # (T, 3, 6)
    normals = edges[:, :, :3].sum(1)
    offsets = (normals * triangles[:, 0]).sum(1)
    slack = _SLACK * rays.norm(dim=1).max() * edges.norm(dim=2).amax(1)
    if one_origin:  # then all moments o × d are zero
        rays, edges = rays[:, :3], edges[..., :3]
    lines, sides = rays.T.contiguous(), edges.permute(1, 2, 0).contiguous()  # one row a coordinate
    bundles = bundled(directions) if one_origin else apart(directions.shape[0])
    for ray, triangle in candidates(bundles, triangles):
        line = [row.index_select(0, ray) for row in lines]
        side_a, side_b, side_c = (
            _dot(line, [row.index_select(0, triangle) for row in edge]) for edge in sides
        )
        lowest = torch.minimum(torch.minimum(side_a, side_b), side_c)
        highest = torch.maximum(torch.maximum(side_a, side_b), side_c)
        bound = slack.index_select(0, triangle)
        steepness = side_a + side_b + side_c  # d · normal
        height = offsets.index_select(0, triangle)
        if not one_origin:
            height = height - (normals[triangle] * origins[ray]).sum(1)
        t = height / steepness
        met = ((lowest >= -bound) | (highest <= bound)) & (t > 0) & (steepness.abs() > 4 * bound)
        best.scatter_reduce_(0, ray, torch.where(met, t, torch.inf), "amin")
    return best


def _dot(u: list[Tensor], v: list[Tensor]) -> Tensor:
    """Dot products (P,) of vectors given by coordinate."""
    total = u[0] * v[0]
    for a, b in zip(u[1:], v[1:], strict=True):
        total = torch.addcmul(total, a, b)
    return total


def _cross_2d(u: Tensor, v: Tensor) -> Tensor:
    return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]


def _nothing(directions: Tensor) -> Tensor:
    return torch.full_like(directions[:, 0], torch.inf)


def _chunks(n_rays: int, n_primitives: int) -> list[slice]:
    size = max(1, _CHUNK_PAIRS // max(1, n_primitives))
    return [slice(i, min(i + size, n_rays)) for i in range(0, n_rays, size) if n_primitives]


def _checked(
    origins: Tensor, directions: Tensor, primitives: Tensor, shape: tuple[int, int]
) -> tuple[Tensor, Tensor, Tensor]:
    """Origins (N, D), directions (N, D) and primitives, all float64: the products below cancel."""
    dim = shape[1]
    if directions.ndim != 2 or directions.shape[1] != dim:
        raise InvalidArgumentError(f"directions has shape {tuple(directions.shape)}; expected (N, {dim}).")
    if origins.shape not in ((dim,), directions.shape):
        raise InvalidArgumentError(
            f"origins has shape {tuple(origins.shape)}; expected ({dim},) or {tuple(directions.shape)}, "
            "one for each direction."
        )
    if primitives.ndim != 3 or primitives.shape[1:] != shape:
        raise InvalidArgumentError(
            f"segments or triangles have shape {tuple(primitives.shape)}; expected (N, {shape[0]}, {dim})."
        )
    return origins.double().expand(directions.shape), directions.double(), primitives.double()

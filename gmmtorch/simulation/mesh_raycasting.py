"""Distance along rays to the nearest line segment (2D) or triangle (3D), in plain torch.

Worlds have few segments, so each ray is tested against all of them. The rays of a sensor
start at one point and are grouped into bundles of similar direction. Each bundle is tested only against
the triangles whose bounding cone overlaps the cone of the bundle: a few per cent of all triangles.

Operations on bundles are kept small and gather with `index_select`. Above about 32 thousand elements
(fewer with `x[index]`) torch splits an operation over threads. On a busy machine, waiting for the threads at
each of many small operations takes longer than the work.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

from gmmtorch.arrays import ArrayLike, as_tensor
from gmmtorch.errors import InvalidArgumentError

_CHUNK_PAIRS = 1 << 15
"""Ray and segment pairs processed at a time."""

_CHUNK_CONES = 1 << 15
"""Bundle and triangle pairs processed at a time."""

_CHUNK_HITS = 1 << 13
"""Approximate number of ray and triangle pairs that `_candidates` yields at a time."""

_CELLS = 8
"""Bundles along each side of the cube onto which directions are projected: each is about 14° wide."""

_SLACK = 64 * torch.finfo(torch.float64).eps
"""Relative distance outside an edge at which a ray still counts as a hit, so that no ray passes between two
adjacent primitives. A ray whose angle to a primitive is below four times this counts as parallel to it."""


def ray_segments(origins: ArrayLike, directions: ArrayLike, segments: ArrayLike) -> Tensor:
    """Distances (N,), float64, to the nearest segment, in multiples of the direction's length; inf if none.

    Solves o + t d = a + s (b − a) for t > 0 and 0 ≤ s ≤ 1. A ray parallel to a segment does not hit it.

    Args:
        origins: (N, 2), or (2,) if all rays start at one point.
        directions: (N, 2).
        segments: (S, 2, 2), the two end points of each segment.
    """
    origins, directions, segments = _checked(origins, directions, segments, (2, 2))
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


def ray_triangles(origin: ArrayLike, directions: ArrayLike, triangles: ArrayLike) -> Tensor:
    """Distances (N,), float64, to the nearest triangle, in multiples of the direction's length; inf if none.

    A ray passes through a triangle if it passes all three edges on the same side. The side of the edge
    p → q is the triple product d · ((p − o) × (q − o)). Adjacent triangles share an edge with opposite sign,
    so no ray passes between them. Both faces count. A ray in the plane of a triangle does not hit it.

    Args:
        origin: (3,), where all rays start.
        directions: (N, 3).
        triangles: (T, 3, 3), the three corners of each triangle.
    """
    origin = as_tensor(origin, "origin", torch.float64)
    if origin.shape != (3,):
        raise InvalidArgumentError(f"origin has shape {tuple(origin.shape)}; expected (3,), metres.")
    _, directions, triangles = _checked(origin, directions, triangles, (3, 3))
    best = torch.full_like(directions[:, 0], torch.inf)
    if triangles.shape[0] == 0 or directions.shape[0] == 0:
        return best
    triangles = triangles - origin
    ahead = triangles.roll(-1, dims=1)
    edges = torch.linalg.cross(triangles, ahead)  # (T, 3, 3)
    normals = edges.sum(1)
    offsets = (normals * triangles[:, 0]).sum(1)
    largest = torch.cat([edges, ahead - triangles], 2).norm(dim=2).amax(1)
    slack = _SLACK * directions.norm(dim=1).max() * largest
    lines, sides = directions.T.contiguous(), edges.permute(1, 2, 0).contiguous()  # one row per coordinate
    for ray, triangle in _candidates(_direction_bundles(directions), triangles):
        line = [row.index_select(0, ray) for row in lines]
        side_a, side_b, side_c = (
            _dot(line, [row.index_select(0, triangle) for row in edge]) for edge in sides
        )
        lowest = torch.minimum(torch.minimum(side_a, side_b), side_c)
        highest = torch.maximum(torch.maximum(side_a, side_b), side_c)
        bound = slack.index_select(0, triangle)
        steepness = side_a + side_b + side_c  # d · normal
        t = offsets.index_select(0, triangle) / steepness
        hit = ((lowest >= -bound) | (highest <= bound)) & (t > 0) & (steepness.abs() > 4 * bound)
        best.scatter_reduce_(0, ray, torch.where(hit, t, torch.inf), "amin")
    return best


def _dot(u: list[Tensor], v: list[Tensor]) -> Tensor:
    """Dot products (P,) of vectors given as one tensor (P,) per coordinate."""
    total = u[0] * v[0]
    for a, b in zip(u[1:], v[1:], strict=True):
        total = torch.addcmul(total, a, b)
    return total


def _cross_2d(u: Tensor, v: Tensor) -> Tensor:
    return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]


def _checked(
    origins: ArrayLike, directions: ArrayLike, primitives: ArrayLike, shape: tuple[int, int]
) -> tuple[Tensor, Tensor, Tensor]:
    """Origins (N, D), directions (N, D) and primitives as float64, because the products above cancel."""
    dim = shape[1]
    origins = as_tensor(origins, "origins", torch.float64)
    directions = as_tensor(directions, "directions", torch.float64)
    primitives = as_tensor(primitives, "segments" if dim == 2 else "triangles", torch.float64)
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
    return origins.expand(directions.shape), directions, primitives


# -- bundles of rays --------------------------------------------------------------------------------


class _Cones(NamedTuple):
    """Cones with their apex at the origin: unit axes (3, C), cosine and sine (C,) of the half-angles.

    `is_open` (C,) marks sets of directions wider than a half-space. Such a set has no bounding cone and
    counts as overlapping every cone.
    """

    axis: Tensor
    cos: Tensor
    sin: Tensor
    is_open: Tensor


class _Bundles(NamedTuple):
    """Rays grouped into bundles, each with a cone around it.

    rays: (N,) indices, sorted by bundle. Bundle g has `sizes[g]` of them, from position `starts[g]` on.
    """

    rays: Tensor
    starts: Tensor
    sizes: Tensor
    cones: _Cones


def _direction_bundles(directions: Tensor) -> _Bundles:
    """Groups rays from one origin (N, 3) by the cell of a cube's surface that each passes through."""
    unit = normalize(directions, dim=1)
    face = unit.abs().argmax(1)
    cell = ((unit / unit.abs().amax(1, keepdim=True) + 1) * (_CELLS / 2)).floor().long()
    cell = cell.nan_to_num().clamp(0, _CELLS)
    key = ((cell[:, 0] * (_CELLS + 1) + cell[:, 1]) * (_CELLS + 1) + cell[:, 2]) * 3 + face
    _, bundle, sizes = torch.unique(key, return_inverse=True, return_counts=True)
    axis = unit.new_zeros(sizes.shape[0], 3).index_add_(0, bundle, unit)
    width = unit.new_zeros(sizes.shape[0]).scatter_reduce_(0, bundle, _angle(unit, axis[bundle]), "amax")
    return _Bundles(bundle.argsort(stable=True), sizes.cumsum(0) - sizes, sizes, _cones(axis, width))


def _candidates(bundles: _Bundles, triangles: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """Yields pairs of ray (P,) and triangle (P,) that may meet, in chunks.

    `triangles` (T, 3, 3) are relative to the origin of the rays.
    """
    n_bundles, n_triangles = bundles.sizes.shape[0], triangles.shape[0]
    step = max(1, _CHUNK_CONES // n_triangles)
    middle = triangles.mean(1)
    cones = _cones(middle, _angle(triangles, middle[:, None]).amax(1))
    for first in range(0, n_bundles, step):
        rows = slice(first, min(first + step, n_bundles))
        bundle, triangle = _overlap(bundles.cones, cones, rows).nonzero(as_tuple=True)
        bundle = bundle + first
        ends = bundles.sizes[bundle].cumsum(0)
        total = int(ends[-1]) if len(ends) else 0
        cuts = torch.arange(_CHUNK_HITS, max(total, _CHUNK_HITS), _CHUNK_HITS)
        for chunk in torch.arange(len(bundle)).tensor_split(torch.searchsorted(ends, cuts)):
            if len(chunk):
                yield _expanded(bundles, bundle[chunk], triangle[chunk])


def _expanded(bundles: _Bundles, bundle: Tensor, triangle: Tensor) -> tuple[Tensor, Tensor]:
    """Pairs of ray (P,) and triangle (P,): every ray of each bundle (Q,) with that bundle's triangle (Q,)."""
    sizes = bundles.sizes.index_select(0, bundle)
    ends = sizes.cumsum(0)
    is_next = torch.zeros(int(ends[-1]), dtype=torch.long)
    is_next[ends[:-1]] = 1  # no bundle is empty, so this counts up; repeat_interleave would start threads
    pair = is_next.cumsum(0)
    shift = bundles.starts.index_select(0, bundle) - (ends - sizes)
    position = torch.arange(pair.shape[0]) + shift.index_select(0, pair)
    return bundles.rays.index_select(0, position), triangle.index_select(0, pair)


def _cones(axis: Tensor, width: Tensor) -> _Cones:
    """Cones with axes (C, 3) of any length and half-angles (C,) in radians."""
    is_open = ~(width < 0.49 * torch.pi)
    return _Cones(normalize(axis, dim=1).T.contiguous(), width.cos(), width.sin(), is_open)


def _overlap(bundles: _Cones, cones: _Cones, rows: slice) -> Tensor:
    """Whether each bundle in `rows` overlaps each cone (C,): cos(angle of axes) ≥ cos(sum of half-angles)."""
    margin = bundles.sin[rows, None] * cones.sin - bundles.cos[rows, None] * cones.cos
    for own, other in zip(bundles.axis[:, rows], cones.axis, strict=True):
        margin = torch.addcmul(margin, own[:, None], other)
    return (margin > -1e-9) | cones.is_open | bundles.is_open[rows, None]


def _angle(u: Tensor, v: Tensor) -> Tensor:
    """Angles (…) between vectors (…, 3) in radians; a right angle if one of them is zero."""
    scale = (u.norm(dim=-1) * v.norm(dim=-1)).clamp_min(1e-300)
    return ((u * v).sum(-1) / scale).clamp(-1, 1).acos()

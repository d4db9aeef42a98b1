"""Flux form for arbitrary regions: any simple polygon in 2D, any closed triangle mesh in 3D.

The two surface integrals are those of `box_flux`, over the boundary of the region. Misses are the expected
number of times that rays leave the region: a ray that passes through twice counts twice, and a ray that
ends inside counts its earlier passes. For a convex region this equals the expected number of rays that pass
through and end beyond.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike, as_tensor, is_floating
from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.occupancy.cones import CUTOFF, Cones, WhitenedCones, cross, dot
from gmmtorch.occupancy.culling import candidate_pairs
from gmmtorch.occupancy.forms.flux.adaptive_quadrature import TOLERANCE, check_tolerance, integrate
from gmmtorch.occupancy.forms.flux.box_flux import FacePatches
from gmmtorch.occupancy.forms.flux.box_mass import MassPatches

_CHUNK_FACES = 1 << 16


class Boundary(NamedTuple):
    """The boundary of a region as F faces: segments in 2D, triangles in 3D.

    starts (F, D): first corner of each face, world metres.
    edges (F, D−1, D): vectors from it to the other corners. Segments run counter-clockwise around the region;
    edge 0 × edge 1 of a triangle points outwards.
    """

    starts: Tensor
    edges: Tensor

    @classmethod
    def of_polygon(cls, vertices: ArrayLike) -> Boundary:
        """Boundary of a simple polygon with vertices (V, 2) in order, clockwise or counter-clockwise.

        Raises `InvalidArgumentError` for fewer than three vertices or vertices that are not finite, and
        `DataError` for a polygon that crosses or touches itself, or has no area.
        """
        vertices = as_tensor(vertices, "vertices", torch.float64)
        _check_vertices(vertices, 2)
        edges = vertices.roll(-1, 0) - vertices
        if bool((edges == 0).all(1).any()):
            raise DataError("The polygon repeats a vertex; remove repeated vertices.")
        _check_simple(vertices.detach(), edges.detach())
        area = 0.5 * _cross_2d(vertices - vertices[0], edges).sum()
        if not bool(area != 0):
            raise DataError("The polygon has no area; give vertices that enclose a region.")
        if bool(area < 0):
            vertices = vertices.flip(0)
            edges = vertices.roll(-1, 0) - vertices
        return cls(vertices, edges[:, None])

    @classmethod
    def of_mesh(cls, vertices: ArrayLike, triangles: ArrayLike) -> Boundary:
        """Boundary of a closed mesh with vertices (V, 3) and triangles (F, 3) of vertex indices.

        The corners of a triangle run counter-clockwise as seen from outside. Raises `InvalidArgumentError`
        for other shapes, vertices that are not finite and indices out of range, and `DataError` for a mesh
        that is open, inconsistently oriented or inside out.
        """
        vertices = as_tensor(vertices, "vertices", torch.float64)
        _check_vertices(vertices, 3)
        corner = as_tensor(triangles, "triangles", torch.int64, vertices.device)
        if corner.ndim != 2 or corner.shape[1] != 3 or is_floating(triangles):
            raise InvalidArgumentError(
                f"triangles has shape {tuple(corner.shape)} and dtype {getattr(triangles, 'dtype', None)}; "
                "expected (F, 3) indices of the vertices, whole numbers."
            )
        if len(corner) == 0 or int(corner.min()) < 0 or int(corner.max()) >= len(vertices):
            raise InvalidArgumentError(
                f"triangles must have entries from 0 to {len(vertices) - 1}: indices of the vertices."
            )
        _check_closed(corner, len(vertices))
        corners = vertices[corner]
        edges = corners[:, 1:] - corners[:, :1]
        volume = torch.linalg.det(corners - vertices[0]).sum() / 6
        if not bool(volume > 0):
            raise DataError(
                f"The mesh encloses {float(volume):.3g} m³: it is flat or inside out; reverse the corners "
                "of its triangles."
            )
        return cls(corners[:, 0], edges)


def region_flux(
    cones: Cones,
    boundary: Boundary,
    cutoff: float = CUTOFF,
    *,
    tolerance: float = TOLERANCE,
    dtype: torch.dtype = torch.float64,
) -> tuple[Tensor, Tensor]:
    """Hits and misses of one region, scalars: expected rays that end in it, and times that rays leave it.

    Arguments as in `flux_evidence`. Differentiable in the boundary and the cones.
    """
    check_tolerance(tolerance)
    cones = cones.checked()
    if boundary.starts.shape[1] != cones.dim:
        raise InvalidArgumentError(
            f"boundary is {boundary.starts.shape[1]}-dimensional, but the cones are {cones.dim}-dimensional."
        )
    counts, white = cones.counts.double(), WhitenedCones.of(cones)
    corners = torch.cat([boundary.starts[:, None], boundary.starts[:, None] + boundary.edges], 1).detach()
    low, high = corners.flatten(0, 1).amin(0), corners.flatten(0, 1).amax(0)
    reached = [cone for _, cone in candidate_pairs(cones, low[None], high[None], cutoff)]
    hits, misses = torch.zeros_like(counts), torch.zeros_like(counts)
    for cone in torch.cat(reached or [counts.new_empty(0, dtype=torch.int64)]).split(_CHUNK_FACES):
        per_pass = max(1, _CHUNK_FACES // max(1, len(cone)))
        for face in torch.arange(len(corners), device=cone.device).split(per_pass):
            both = torch.cartesian_prod(face, cone).reshape(-1, 2).T
            out, mass = _face_integrals(white, boundary, both[0], both[1], cutoff, tolerance, dtype)
            misses = misses.index_add(0, both[1], out)
            hits = hits.index_add(0, both[1], mass)
    # The signed masses above the faces sum to the mass in the region, which rounding can make negative.
    return (counts * ~cones.max_range) @ hits.clamp_min(0), counts @ misses


def _face_integrals(
    white: WhitenedCones,
    boundary: Boundary,
    face: Tensor,
    cone: Tensor,
    cutoff: float,
    tolerance: float,
    dtype: torch.dtype,
) -> tuple[Tensor, Tensor]:
    """Flux out of each face (P,), and the signed mass above it (P,)."""
    part = white.take(cone)
    start, edge = boundary.starts[face].T, boundary.edges[face].permute(1, 2, 0)
    triangular = len(edge) == 2
    center = start if triangular else start + 0.5 * edge[0]
    ray = center - part.origin
    offset, edges = part.apply(center - part.mean), torch.stack([part.apply(e) for e in edge])

    height = dot(ray, cross(edge[0], edge[1])) if triangular else cross(ray, edge[0])[0]
    strength = height * torch.exp(-part.log_norm)
    out = (strength > 0).nonzero().squeeze(1)
    tensors = (offset, edges, part.apply(ray), strength)
    faces = FacePatches(cutoff, *(x[..., out].to(dtype) for x in tensors), triangular=triangular)
    flux = torch.zeros_like(strength).index_add(0, out, integrate(faces, tolerance))

    upward = torch.zeros_like(offset)
    upward[0] = 1.0
    area = -dot(cross(edges[0], edges[1]), upward) if triangular else cross(edges[0], upward)[0]
    span = torch.full_like(area, torch.inf)
    parts = (x.to(dtype) for x in (offset, edges, upward, span, area))
    sections = MassPatches(cutoff, *parts, triangular=triangular)
    return flux, integrate(sections, tolerance)


def _check_vertices(vertices: Tensor, dim: int) -> None:
    if vertices.ndim != 2 or vertices.shape[1] != dim or len(vertices) <= dim:
        raise InvalidArgumentError(
            f"vertices has shape {tuple(vertices.shape)}; expected (V, {dim}), V at least {dim + 1}."
        )
    if not bool(torch.isfinite(vertices).all()):
        raise InvalidArgumentError(
            "vertices must be finite metres; remove vertices that are NaN or infinite."
        )


def _cross_2d(a: Tensor, b: Tensor) -> Tensor:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _check_simple(vertices: Tensor, edges: Tensor) -> None:
    """Raise `DataError` if two edges that are not neighbours meet, or if neighbours fold back."""
    n = len(vertices)
    following = edges.roll(-1, 0)
    folded = (_cross_2d(edges, following) == 0) & ((edges * following).sum(1) < 0)
    index = torch.arange(n, device=vertices.device)
    for first in range(n):  # one row of the V × V table at a time
        apart = (index > first + 1) & ~((first == 0) & (index == n - 1))
        other = index[apart]
        to_ends = torch.stack([vertices[other], vertices[(other + 1) % n]]) - vertices[first]
        side = _cross_2d(edges[first], to_ends)
        from_other = torch.stack([vertices[first], vertices[(first + 1) % n]])[:, None] - vertices[other]
        back = _cross_2d(edges[other], from_other)
        parallel = (side == 0).all(0)
        along = (to_ends @ edges[first]) / (edges[first] @ edges[first])
        overlapping = (along.amin(0) <= 1) & (along.amax(0) >= 0)
        met = torch.where(parallel, overlapping, (side.prod(0) <= 0) & (back.prod(0) <= 0))
        if bool(met.any()):
            raise DataError(
                f"The polygon's edges {first} and {int(other[met][0])} meet; give a simple polygon."
            )
    if bool(folded.any()):
        raise DataError(f"The polygon folds back on itself after edge {int(folded.nonzero()[0])}.")


def _check_closed(triangles: Tensor, n_vertices: int) -> None:
    """Raise `DataError` unless every edge belongs to two triangles that run it in opposite directions."""
    tail, head = triangles.flatten(), triangles.roll(-1, 1).flatten()
    if bool((tail == head).any()):
        raise DataError("A triangle repeats a vertex; remove degenerate triangles.")
    forward, count = torch.unique(tail * n_vertices + head, return_counts=True)
    backward = torch.unique(head * n_vertices + tail)
    if bool((count > 1).any()):
        edge = int(forward[count > 1][0])
        raise DataError(
            f"Edge ({edge // n_vertices}, {edge % n_vertices}) runs the same way in more than one "
            "triangle: the mesh is not consistently oriented."
        )
    if not torch.equal(forward, backward):
        edge = int(forward[~torch.isin(forward, backward)][0])
        raise DataError(
            f"Edge ({edge // n_vertices}, {edge % n_vertices}) has a triangle on one side only: "
            "close the mesh, or merge vertices that coincide."
        )

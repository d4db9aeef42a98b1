"""Flux form: the exact evidence of cells, boxes and regions, from the rays that cross their faces.

A ray that leaves a convex cell through one of its faces ends beyond it. So the misses of a cell are the
flux out of its faces, and its hits are the mass of the Gaussian in it. No samples are drawn.

A region is any simple polygon in 2D, or any closed triangle mesh in 3D. The two surface integrals are those
of boxes, over its boundary. Misses are the expected number of times that rays leave the region: a ray that
passes through twice counts twice, and a ray that ends inside counts its earlier passes. For a convex region
this equals the expected number of rays that pass through and end beyond.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike, as_tensor, is_floating
from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.kernels import add_cell_mass, add_row_flux, is_fused, whitened_rows
from gmmtorch.occupancy.cones import (
    CUTOFF,
    Cones,
    FaceRows,
    Pairs,
    WhitenedCones,
    ball_rows,
    candidate_pairs,
    cross,
    dot,
    face_rows,
    in_chunks,
    length,
    outside_cone,
)
from gmmtorch.occupancy.evidence import Evidence
from gmmtorch.occupancy.forms.quadrature import (
    TOLERANCE,
    MassPatches,
    Patches,
    Rule,
    box_mass,
    check_tolerance,
    integrate,
    linear_on,
    product_on,
    square_on,
    variation_limits,
)
from gmmtorch.occupancy.grid import VoxelGrid
from gmmtorch.occupancy.voxels.cells import cells_in_chunks, row_major

CHUNK_FACES = 1 << 18
"""Faces, or pairs of a box and a cone, prepared in one pass."""

Rules = tuple[float, float, torch.dtype]
"""How faces and boxes are integrated: cutoff, tolerance, and type of the integrands."""

_ROOT_TWO_PI = math.sqrt(2 * math.pi)
_BEFORE = 6.0  # a face farther before the mean than this (Mahalanobis) has the whole component beyond it
_NEARNESS = 2.5  # variation, in deviations, of a panel as wide as its distance from the sensor origin


@dataclass(frozen=True, eq=False)
class FacePatches(Patches):
    """P faces, each with a cone. Whitened, coordinates first.

    The integrand is the flux density of N(μ, Σ) seen from s: the rays per unit area that pass the place q and
    end beyond it, (u·n) ∫_1^∞ t^{D−1} N(s + tu | μ, Σ) dt with u = q − s and face normal n.

    ray: W(q − s) of the place q of `offset`, (D, P).
    strength: (u·n) dA / √det 2πΣ of the whole parallelogram, (P,); constant over the face.
    """

    ray: Tensor
    strength: Tensor

    def cut(self, base: Tensor, scale: Tensor) -> FacePatches:
        shift = (base[:, None] * self.edges).sum(0)
        return replace(
            self,
            ray=self.ray + shift,
            offset=self.offset + shift,
            edges=scale[:, None] * self.edges,
            strength=scale.abs().prod(0) * self.strength,
        )

    def _middle(self) -> tuple[Tensor, Tensor]:
        shift = self.shift_to_middle()
        return self.ray + shift, self.offset + shift

    def outside(self) -> Tensor:
        return outside_cone(*self._middle(), self.edges, self.cutoff)

    def simple(self) -> Tensor:
        """Patches (P,) that have the whole component beyond them: no ray ends before them."""
        ray, offset = self._middle()
        distance = length(ray)
        along, across = dot(offset, ray) / distance, length(cross(offset, ray)) / distance
        reach = 0.5 * sum(length(edge) for edge in self.edges)
        return along + reach * (1 + across / distance) < -_BEFORE

    def variation(self, simple: Tensor) -> Tensor:
        ray, _ = self._middle()
        mean = self.ray - self.offset
        square = dot(ray, ray)
        rows = []
        for edge in self.edges:
            turned, stepped = cross(edge, mean), dot(edge, ray) * ~simple
            near = dot(edge, edge) * _NEARNESS**2
            rows.append(dot(turned, turned) + stepped * stepped + near)
        return (torch.stack(rows) / square).sqrt()

    def sums(self, rule: Rule, simple: bool) -> Tensor:
        # With w = W(q − s), d = W(q − μ), a = d·w/|w| and b = |w| − a the integral is
        # e^{−½|d − a w/|w||²} ∫_a^∞ (x + b)^{D−1} e^{−x²/2} dx / |w|^D, see `tail_moment` of
        # kernels/evidence/point_evidence.py. The vectors are affine in f, so each of their products is a
        # polynomial in f.
        (monomials, weights), mean = rule, self.ray - self.offset
        # d × w = d₀ × w₀ + Σ f_i edge_i × m, since w − d = m is the same everywhere.
        square = square_on(monomials, self.ray, self.edges).clamp_min(1e-30)
        turned = square_on(monomials, cross(self.offset, self.ray), cross(self.edges, mean[None]))
        across = (turned / square).clamp_min(0)  # a square's polynomial may round below zero
        inverse = square.rsqrt()
        if simple:
            nearest = linear_on(monomials, self.ray, self.edges, mean) / square  # t₀
            moment = nearest if len(self.ray) == 2 else nearest * nearest + 1 / square
            density = _ROOT_TWO_PI * moment
            seen = across < self.cutoff**2
        else:
            along = product_on(monomials, self.offset, self.ray, self.edges) * inverse
            nearest = 1 - along * inverse
            tail = 0.5 * _ROOT_TWO_PI * torch.special.erfc(along / math.sqrt(2))
            edge = torch.exp(-0.5 * along * along)
            density = nearest * tail + edge * inverse
            if len(self.ray) == 3:
                density = nearest * density + edge * inverse + tail / square
            seen = (across < self.cutoff**2) & (along < self.cutoff)
        density = torch.exp(-0.5 * across) * inverse * density.clamp_min(0)
        return self.strength * (weights @ torch.where(seen, density, 0.0))


def flux_evidence(
    cones: Cones,
    grid: VoxelGrid,
    cutoff: float = CUTOFF,
    *,
    tolerance: float = TOLERANCE,
    dtype: torch.dtype = torch.float64,
) -> Evidence:
    """Hits and misses of all cells of a grid.

    Each face between two cells is integrated once. Faces outside a cone are skipped, so cells outside get
    exactly 0. All rays that leave the cell of a sensor origin count as its misses.

    Args:
        cones: the components and their sensor origins.
        grid: the cells.
        cutoff: Mahalanobis distance beyond which a component gives no evidence.
        tolerance: of the quadrature, relative to the peak of the integrand on each panel. With the default,
            evidence per ray is exact to 10⁻⁴; this includes the effect of the cutoff.
        dtype: of the integrands; the whitening always uses float64.

    Raises:
        InvalidArgumentError: a grid of another dimension, or a tolerance outside (0, 1).
    """
    how = cutoff, check_tolerance(tolerance), dtype
    cones = cones.checked()
    if cones.dim != grid.dim:
        raise InvalidArgumentError(
            f"grid is {grid.dim}-dimensional, but the cones are {cones.dim}-dimensional."
        )
    white = WhitenedCones.of(cones)
    misses = white.log_norm.new_zeros(grid.n_cells)
    counts = cones.counts.double()
    balls = ball_rows(cones, grid, cutoff)
    if dtype == torch.float64 and is_fused(*white, counts):
        table = whitened_rows(white.matrix, white.origin, white.toward, white.log_norm)
        place = grid.origin, grid.resolution, grid.shape
        limits = variation_limits(tolerance)
        hits = torch.zeros_like(misses)
        add_cell_mass(hits, table, counts, balls, place, cutoff, limits)
        for axis, rows in enumerate(face_rows(cones, grid, cutoff)):
            add_row_flux(misses, table, counts, rows, axis, place, cutoff, limits)
        return Evidence(grid, hits.view(grid.shape), misses.view(grid.shape))
    for axis, rows in enumerate(face_rows(cones, grid, cutoff)):  # the twin of `add_row_flux`
        for row, cells in cells_in_chunks(rows.first, rows.number, CHUNK_FACES):
            cone, plane, forward = rows.cone[row], rows.plane[row], rows.forward[row]
            middle = cells.double() + 0.5
            center = _world(grid, [*middle[:axis], plane.double(), *middle[axis:]])
            side = center.new_full((grid.dim, 1), grid.resolution)
            flux = _face_flux(white.take(cone), center, side, axis, forward, how)
            left = [*cells[:axis], torch.where(forward, plane - 1, plane), *cells[axis:]]
            misses = misses.index_add(0, row_major(left, grid.shape), flux * counts[cone])
    hits = torch.zeros_like(misses)
    for row, cell in cells_in_chunks(*balls[1:], CHUNK_FACES):
        cone, low = balls[0][row], _world(grid, cell.double())
        mass = box_mass(white.take(cone), low, low + grid.resolution, *how)
        hits = hits.index_add(0, row_major(cell.unbind(), grid.shape), mass * counts[cone])
    return Evidence(grid, hits.view(grid.shape), misses.view(grid.shape))


def box_flux(
    cones: Cones,
    low: ArrayLike,
    high: ArrayLike,
    pairs: Iterable[Pairs] | None = None,
    cutoff: float = CUTOFF,
    *,
    tolerance: float = TOLERANCE,
    dtype: torch.dtype = torch.float64,
) -> tuple[Tensor, Tensor]:
    """Hits (M,) and misses (M,) of boxes [low, high], (M, D) each, world metres, of any size and place.

    Args:
        pairs: chunks of (box, cone) indices, (P,) each, of all pairs that can meet, each pair once. All
            boxes are tested with all cones if not given.
        cones, cutoff, tolerance, dtype: as in `flux_evidence`.

    Raises:
        InvalidArgumentError: corners of another shape, not finite, or not low < high.
    """
    how = cutoff, check_tolerance(tolerance), dtype
    cones = cones.checked()
    low, high = checked_boxes(low, high, cones)
    white = WhitenedCones.of(cones)
    counts = cones.counts.double()
    hits, misses = (low.new_zeros(len(low)) for _ in range(2))
    if pairs is None:
        pairs = candidate_pairs(cones, low.detach(), high.detach(), cutoff)
    for box, cone in in_chunks(pairs, CHUNK_FACES):
        part, corners = white.take(cone), (low[box].T, high[box].T)
        for axis in range(cones.dim):
            for forward in (False, True):
                flux = _box_face_flux(part, corners, axis, forward, how)
                misses = misses.index_add(0, box, flux * counts[cone])
        returned = ~cones.max_range[cone]
        box, cone = box[returned], cone[returned]
        mass = box_mass(white.take(cone), low[box].T, high[box].T, *how)
        hits = hits.index_add(0, box, mass * counts[cone])
    return hits, misses


def cell_flux(
    cones: Cones,
    cells: Tensor,
    resolution: float,
    pairs: Iterable[Pairs],
    cutoff: float = CUTOFF,
    *,
    tolerance: float = TOLERANCE,
) -> tuple[Tensor, Tensor]:
    """Hits (M,) and misses (M,) of cells of the world's lattice: `box_flux` with a fused form.

    Args:
        cells: (M, D) whole numbers: cell c is the cube [c, c + 1) times the resolution.
        pairs, cutoff, tolerance: as in `box_flux`.
    """
    cones, cells = cones.checked(), cells.double()
    white, counts = WhitenedCones.of(cones), cones.counts.double()
    if not is_fused(*white, counts, cells):
        low, high = cells * resolution, (cells + 1) * resolution
        return box_flux(cones, low, high, pairs, cutoff, tolerance=tolerance)
    table = whitened_rows(white.matrix, white.origin, white.toward, white.log_norm)
    place, limits = ((0.0,) * cones.dim, resolution, (1,) * cones.dim), variation_limits(tolerance)
    hits, misses = cells.new_zeros(2, len(cells))
    for cell, cone in pairs:
        first, sensor = cells[cell].long(), cones.origins.double()[cone] / resolution
        for axis, forward in itertools.product(range(cones.dim), (False, True)):
            plane = first[:, axis] + forward
            is_crossed = plane > sensor[:, axis] if forward else plane < sensor[:, axis]
            rows = is_crossed.nonzero().squeeze(1)
            others = torch.cat([first[rows, :axis], first[rows, axis + 1 :]], 1)
            direction = torch.full_like(rows, forward, dtype=torch.bool)
            faces = FaceRows(cone[rows], plane[rows], direction, others, torch.ones_like(others))
            add_row_flux(misses, table, counts, faces, axis, place, cutoff, limits, cell[rows])
        rows = (~cones.max_range[cone]).nonzero().squeeze(1)
        boxes = cone[rows], first[rows], torch.ones_like(first[rows])
        add_cell_mass(hits, table, counts, boxes, place, cutoff, limits, cell[rows])
    return hits, misses


def checked_boxes(low: ArrayLike, high: ArrayLike, cones: Cones) -> tuple[Tensor, Tensor]:
    """Corners (M, D) of boxes, float64, on the device of the cones.

    Raises `InvalidArgumentError` unless they are finite, and low is below high along each axis.
    """
    device = cones.means.device
    low, high = (as_tensor(v, n, torch.float64, device) for n, v in (("low", low), ("high", high)))
    if low.shape != high.shape or low.ndim != 2 or low.shape[1] != cones.dim:
        raise InvalidArgumentError(
            f"low has shape {tuple(low.shape)}, high {tuple(high.shape)}; expected (M, {cones.dim}) both."
        )
    bad = ~((low < high) & torch.isfinite(low) & torch.isfinite(high)).all(1)
    if bool(bad.any()):
        row = int(bad.nonzero()[0])
        raise InvalidArgumentError(
            f"low[{row}]={low[row].tolist()}, high[{row}]={high[row].tolist()} is no box: corners must be "
            "finite, and low below high along each axis."
        )
    return low, high


def _box_face_flux(
    white: WhitenedCones, corners: tuple[Tensor, Tensor], axis: int, forward: bool, how: Rules
) -> Tensor:
    """Flux (P,) out of one face of each box; 0 where the sensor origin is on the outer side of the face."""
    low, high = corners
    face = (high if forward else low)[axis]
    sign = 1 if forward else -1
    out = (sign * (face - white.origin[axis]) > 0).nonzero().squeeze(1)
    low, high, face = low[:, out], high[:, out], face[out]
    middle = 0.5 * (low + high)
    center = torch.cat([middle[:axis], face[None], middle[axis + 1 :]])
    flux = _face_flux(white.take(out), center, high - low, axis, forward, how)
    return flux.new_zeros(corners[0].shape[1]).index_add(0, out, flux)


def _face_flux(
    white: WhitenedCones, center: Tensor, side: Tensor, axis: int, forward: Tensor | bool, how: Rules
) -> Tensor:
    """Flux (P,) through faces across `axis`, along or against it, with centres and sides (D, P), metres."""
    others = [b for b in range(len(center)) if b != axis]
    ray = center - white.origin
    edges = torch.stack([white.matrix[:, b] * side[b] for b in others])
    height = torch.where(torch.as_tensor(forward, device=ray.device), ray[axis], -ray[axis])
    strength = height * side[others].prod(0) * torch.exp(-white.log_norm)
    cutoff, tolerance, dtype = how
    white_ray = white.apply(ray)
    tensors = (white_ray - white.toward, edges, white_ray, strength)
    return integrate(FacePatches(cutoff, *(part.to(dtype) for part in tensors)), tolerance)


def _world(grid: VoxelGrid, units: Iterable[Tensor]) -> Tensor:
    """Places (D, P), world metres, of grid units (P,) along each axis."""
    return torch.stack([o + i * grid.resolution for o, i in zip(grid.origin, units, strict=True)])


_PAIRS_AT_ONCE = 1 << 16


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
    how = cutoff, check_tolerance(tolerance), dtype
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
    for cone in torch.cat(reached or [counts.new_empty(0, dtype=torch.int64)]).split(_PAIRS_AT_ONCE):
        per_pass = max(1, _PAIRS_AT_ONCE // max(1, len(cone)))
        for face in torch.arange(len(corners), device=cone.device).split(per_pass):
            both = torch.cartesian_prod(face, cone).reshape(-1, 2).T
            out, mass = _face_integrals(white, boundary, both[0], both[1], how)
            misses = misses.index_add(0, both[1], out)
            hits = hits.index_add(0, both[1], mass)
    # The signed masses above the faces sum to the mass in the region, which rounding can make negative.
    return (counts * ~cones.max_range) @ hits.clamp_min(0), counts @ misses


def _face_integrals(
    white: WhitenedCones, boundary: Boundary, face: Tensor, cone: Tensor, how: Rules
) -> tuple[Tensor, Tensor]:
    """Flux out of each face (P,), and the signed mass above it (P,)."""
    cutoff, tolerance, dtype = how
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

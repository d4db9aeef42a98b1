"""Face flux: the exact evidence of cells, from the rays that cross their faces.

What leaves a convex cell through its faces ends beyond it: misses are the flux out, every face shared by
two cells is visited once, and hits are the Gaussian's mass in the cell. Nothing is sampled.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.occupancy.cones import CUTOFF, Cones
from gmmtorch.occupancy.evidence import Evidence
from gmmtorch.occupancy.forms.cone.box_mass import box_mass
from gmmtorch.occupancy.forms.flux.adaptive_quadrature import TOLERANCE, check_tolerance, integrate
from gmmtorch.occupancy.forms.flux.face_flux import FacePatches
from gmmtorch.occupancy.grid import VoxelGrid
from gmmtorch.occupancy.index.culling import (
    Pairs,
    Whitened,
    ball_rows,
    candidate_pairs,
    cells_in_chunks,
    face_rows,
    in_chunks,
)

CHUNK_FACES = 1 << 18
"""Faces, or pairs of a box and a cone, prepared at once."""


def flux_evidence(
    cones: Cones,
    grid: VoxelGrid,
    cutoff: float = CUTOFF,
    *,
    tolerance: float = TOLERANCE,
    dtype: torch.dtype = torch.float64,
) -> Evidence:
    """Hits and misses of every cell of a grid.

    Only faces inside a component's truncated cone are visited: cells outside get exactly 0. The cell
    that holds a sensor is all source.

    Args:
        cones: the components and whence they were seen.
        grid: the cells.
        cutoff: deviations beyond which a component ends.
        tolerance: of the quadrature, as a share of its peak on each piece of a face (see `panels`). At its
            default evidence per ray is exact to 10⁻⁴, what the cutoff takes included.
        dtype: of the integrands; geometry is whitened in float64 either way.

    Raises:
        InvalidArgumentError: a grid of another dimension, or a tolerance outside (0, 1).
    """
    check_tolerance(tolerance)
    if cones.dim != grid.dim:
        raise InvalidArgumentError(
            f"grid is {grid.dim}-dimensional, but the cones are {cones.dim}-dimensional."
        )
    white = Whitened.of(cones)
    misses = white.log_norm.new_zeros(grid.n_cells)
    for axis in range(grid.dim):
        rows = face_rows(cones, grid, axis, cutoff)
        for row, cells in cells_in_chunks(rows.first, rows.number, CHUNK_FACES):
            cone, plane, forward = rows.cone[row], rows.plane[row], rows.forward[row]
            patches = _grid_faces(white, grid, axis, cone, plane, forward, cells, cutoff, dtype)
            flux = integrate(patches, patches.ray, tolerance).double()
            indices = [*cells[:axis], torch.where(forward, plane - 1, plane), *cells[axis:]]
            misses = misses.index_add(0, _flat(grid, indices), flux * cones.counts.double()[cone])
    hits = torch.zeros_like(misses)
    balls = ball_rows(cones, grid, cutoff)
    for row, cell in cells_in_chunks(balls.first, balls.number, CHUNK_FACES):
        cone, low = balls.cone[row], _corner(grid, cell)
        mass = box_mass(white.take(cone), low, low + grid.resolution, cutoff, tolerance, dtype)
        hits = hits.index_add(0, _flat(grid, [*cell]), mass * cones.counts.double()[cone])
    return Evidence(grid, hits.view(grid.shape), misses.view(grid.shape))


def box_flux(
    cones: Cones,
    low: Tensor,
    high: Tensor,
    pairs: Iterable[Pairs] | None = None,
    cutoff: float = CUTOFF,
    *,
    tolerance: float = TOLERANCE,
    dtype: torch.dtype = torch.float64,
) -> tuple[Tensor, Tensor]:
    """hits (M,), misses (M,) of boxes [low, high] (m, world), (M, D) each, of any size and place.

    Args:
        pairs: chunks of (box, cone) indices, (P,) each, no pair twice: those that can meet. Every box is
            tried with every cone if not given.
        cones, cutoff, tolerance, dtype: as in `flux_evidence`.

    Raises:
        InvalidArgumentError: corners of another shape, not finite, or not low < high.
    """
    check_tolerance(tolerance)
    check_boxes(low, high, cones.dim)
    low, high = low.double(), high.double()
    white = Whitened.of(cones)
    counts = cones.counts.double()
    hits, misses = (low.new_zeros(len(low)) for _ in range(2))
    if pairs is None:
        pairs = candidate_pairs(cones, low.detach(), high.detach(), cutoff)
    for box, cone in in_chunks(pairs, CHUNK_FACES):
        part, corners = white.take(cone), (low[box].T, high[box].T)
        for axis in range(cones.dim):
            for forward in (False, True):
                flux = _box_face_flux(part, corners, axis, forward, cutoff, tolerance, dtype)
                misses = misses.index_add(0, box, flux * counts[cone])
        returned = ~cones.max_range[cone]
        box, cone = box[returned], cone[returned]
        mass = box_mass(white.take(cone), low[box].T, high[box].T, cutoff, tolerance, dtype)
        hits = hits.index_add(0, box, mass * counts[cone])
    return hits, misses


def check_boxes(low: Tensor, high: Tensor, dim: int) -> None:
    """Raises `InvalidArgumentError` unless these are corners (M, D) of boxes."""
    if low.shape != high.shape or low.ndim != 2 or low.shape[1] != dim:
        raise InvalidArgumentError(
            f"low has shape {tuple(low.shape)}, high {tuple(high.shape)}; expected (M, {dim}) both."
        )
    bad = ~((low < high) & torch.isfinite(low) & torch.isfinite(high)).all(1)
    if bool(bad.any()):
        row = int(bad.nonzero()[0])
        raise InvalidArgumentError(
            f"low[{row}]={low[row].tolist()}, high[{row}]={high[row].tolist()} is no box: corners must be "
            "finite, and low below high along each axis."
        )


def _grid_faces(
    white: Whitened,
    grid: VoxelGrid,
    axis: int,
    cone: Tensor,
    plane: Tensor,
    forward: Tensor,
    cells: Tensor,
    cutoff: float,
    dtype: torch.dtype,
) -> FacePatches:
    """Faces of a grid across `axis`."""
    middle = cells.double() + 0.5
    position = [*middle[:axis], plane.double(), *middle[axis:]]
    center = torch.stack([o + i * grid.resolution for o, i in zip(grid.origin, position, strict=True)])
    side = center.new_full((len(center), 1), grid.resolution)
    return face_patches(white.take(cone), center, side, axis, forward, cutoff, dtype)


def face_patches(
    white: Whitened,
    center: Tensor,
    side: Tensor,
    axis: int,
    forward: Tensor | bool,
    cutoff: float,
    dtype: torch.dtype,
) -> FacePatches:
    """Faces across `axis` about centres (D, P) with sides (D, P), crossed forward or backward."""
    others = [b for b in range(len(center)) if b != axis]
    ray = center - white.origin
    edges = torch.stack([white.matrix[:, b] * side[b] for b in others])
    area = side[others].prod(0)
    height = torch.where(torch.as_tensor(forward, device=ray.device), ray[axis], -ray[axis])
    strength = height * area * torch.exp(-white.log_norm)
    white_ray = white.apply(ray)
    tensors = (white_ray, white_ray - white.toward, edges, strength)
    return FacePatches(cutoff, *(part.to(dtype) for part in tensors))


def _box_face_flux(
    white: Whitened,
    corners: tuple[Tensor, Tensor],
    axis: int,
    forward: bool,
    cutoff: float,
    tolerance: float,
    dtype: torch.dtype,
) -> Tensor:
    """Flux (P,) out of one face of each box; 0 where the sensor is on the outer side of it."""
    low, high = corners
    face = (high if forward else low)[axis]
    sign = 1 if forward else -1
    out = (sign * (face - white.origin[axis]) > 0).nonzero().squeeze(1)
    low, high, face = low[:, out], high[:, out], face[out]
    middle = 0.5 * (low + high)
    center = torch.cat([middle[:axis], face[None], middle[axis + 1 :]])
    patches = face_patches(white.take(out), center, high - low, axis, forward, cutoff, dtype)
    flux = integrate(patches, patches.ray, tolerance).double()
    return flux.new_zeros(corners[0].shape[1]).index_add(0, out, flux)


def _corner(grid: VoxelGrid, cell: Tensor) -> Tensor:
    """Lowest corner (D, P) of cells (D, P), world metres."""
    return torch.stack([o + i * grid.resolution for o, i in zip(grid.origin, cell.double(), strict=True)])


def _flat(grid: VoxelGrid, cell: list[Tensor]) -> Tensor:
    """Row-major index (P,) of cells."""
    flat = cell[0]
    for axis in range(1, grid.dim):
        flat = flat * grid.shape[axis] + cell[axis]
    return flat

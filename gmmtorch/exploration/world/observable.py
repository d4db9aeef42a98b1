"""Observable cells: those that a camera can see from some navigable cell. Maps are scored on them.

Rays leave the centre of about one navigable cell per cubic metre in all directions within the camera's
vertical field of view. All viewpoints are cell centres, so rays of one direction cross the same cells
relative to their start. That order is computed once; one search for each ray then gives the number of
cells before the mesh.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gmmtorch.evaluation.events import Event, ignore
from gmmtorch.occupancy.voxels.boxes import Box
from gmmtorch.occupancy.voxels.ray_traversal import row_major_strides
from gmmtorch.simulation.worlds.mesh_world import MeshWorld

_GOLDEN = (math.sqrt(5) - 1) / 2
_AT_SURFACE = 1e-3
"""Tolerance (m) for float32 rays. A ray can only end in a cell that the mesh meets."""

_RAYS_AT_ONCE = 1 << 18


def viewpoints(navigable: Tensor, step: int) -> Tensor:
    """Return cells (V, 3): in each block of `step`³ cells, the navigable one nearest to the block's
    middle.
    """
    cells = navigable.nonzero()
    shape = torch.tensor(navigable.shape)
    block = (cells // step * torch.tensor(row_major_strides(tuple(-(-shape // step))))).sum(1)
    off_middle = (2 * (cells % step) - (step - 1)).square().sum(1)
    order = (block * (3 * step**2) + off_middle).argsort(stable=True)
    block = block[order]
    first = torch.ones_like(block, dtype=torch.bool)
    first[1:] = block[1:] != block[:-1]
    return cells[order[first]]


def view_directions(vertical_fov: float, angle: float) -> Tensor:
    """Return unit vectors (N, 3) about `angle` rad apart: all yaws, elevations within the field of view."""
    rows = max(1, math.ceil(vertical_fov / angle)) + 1
    rings = []
    elevations = torch.linspace(-vertical_fov / 2, vertical_fov / 2, rows, dtype=torch.float64)
    for row, elevation in enumerate(elevations.tolist()):
        n_yaws = max(4, math.ceil(2 * math.pi * math.cos(elevation) / angle))
        # Rotating each row samples the sphere more evenly, and no ray runs along a lattice plane.
        yaw = (torch.arange(n_yaws, dtype=torch.float64) + (row + 0.5) * _GOLDEN) * (2 * math.pi / n_yaws)
        up = torch.full_like(yaw, math.sin(elevation))
        rings.append(torch.stack([math.cos(elevation) * yaw.cos(), math.cos(elevation) * yaw.sin(), up], 1))
    return torch.cat(rings)


def observable_cells(
    world: MeshWorld,
    occupied: Tensor,
    box: Box,
    resolution: float,
    points_of_view: Tensor,
    directions: Tensor,
    max_range: float,
    on_event: Event = ignore,
) -> Tensor:
    """Return cells (nx, ny, nz), bool, that some ray crosses or ends in. Rays end at the mesh, range or box.

    Args:
        occupied: (nx, ny, nz) bool, the cells of the box that the mesh meets.
        points_of_view: (V, 3) int64, cells relative to the low corner of the box.
        directions: (N, 3) unit vectors.
        max_range: metres.
    """
    shape = box.shape
    strides = torch.tensor(row_major_strides(shape))
    seen = torch.zeros(math.prod(shape), dtype=torch.bool)
    seen_there = seen.numpy()  # indexed assignment is several times faster there
    surface = occupied.view(-1)
    start = (points_of_view * strides).sum(1)
    seen[start] = True
    centers = (points_of_view + box.low + 0.5).double() * resolution
    beyond = torch.tensor(shape) - 1 - points_of_view  # cells between the start and the end of the box
    reach, slack = max_range / resolution, _AT_SURFACE / resolution
    together = max(1, _RAYS_AT_ONCE // max(1, len(centers)))
    for begin in range(0, len(directions), together):
        some = directions[begin : begin + together]
        toward = some.repeat_interleave(len(centers), 0)
        free_path = world.distances(centers.repeat(len(some), 1), toward).view(len(some), -1) / resolution
        for direction, distance in zip(some, free_path, strict=True):
            entry, offset = _crossed(direction, reach, strides)
            room = torch.where(direction > 0, beyond, points_of_view) + 0.5
            limit = (room / direction.abs()).amin(1).clamp_max(reach)
            count = torch.searchsorted(entry, torch.minimum(distance - slack, limit))
            by_count = count.argsort(descending=True, stable=True)
            from_here = start[by_count].numpy()
            n_rays = (len(start) - torch.bincount(count).cumsum(0)).tolist()  # that cross more than k cells
            for step, n in zip(offset.tolist(), n_rays, strict=False):
                seen_there[from_here[:n] + step] = True
            ends = distance + slack < limit
            last = torch.searchsorted(entry, distance[ends] + slack) - 1
            struck = start[ends] + offset[last]
            seen[struck[surface[struck]]] = True
        on_event("observable cells", min(begin + together, len(directions)), len(directions))
    return seen.view(shape)


def _crossed(direction: Tensor, reach: float, strides: Tensor) -> tuple[Tensor, Tensor]:
    """Return the distances (K,), in cells, at which a ray from a cell's centre enters cells, and their
    offsets.

    Offsets are differences of flat indices, (K,). The first cell is the start, entered at distance 0.
    """
    plane = torch.arange(math.ceil(reach) + 1, dtype=torch.float64) + 0.5
    distance = (plane / direction.abs()[:, None]).flatten()  # infinite along planes
    step = (direction.sign().long() * strides)[:, None].expand(3, len(plane)).flatten()
    entry, order = distance.sort(stable=True)
    within = entry < reach
    zero = torch.zeros(1, dtype=torch.int64)
    return torch.cat([zero.double(), entry[within]]), torch.cat([zero, step[order[within]].cumsum(0)])

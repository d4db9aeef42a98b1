"""Cells of a world: navigable ones, observable ones, and the collisions of robots with the mesh."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.kernels import row_major_strides
from gmmtorch.occupancy import Box, occupied_cells
from gmmtorch.report import Event, ignore
from gmmtorch.simulation import MeshWorld

ON_PLANE = 1e-6
"""Tolerance, as a share of a cell, for a length to lie on a plane of the lattice; larger than rounding."""


def occupied_and_clear(
    mesh: MeshWorld,
    triangles: Tensor,
    resolution: float,
    box: Box,
    grounded: Tensor,
    radius: float,
    on_event: Event,
) -> tuple[Tensor, Tensor]:
    """Return cells (nx, ny, nz) that the mesh meets; and grounded ones with centres beyond `radius` of it."""
    # A cell m cells away on some axis is at least (m − ½) cells from a cell's centre. Distances are therefore
    # computed only for cells that close to the mesh. The mesh just outside the box counts too.
    reach = math.floor(radius / resolution + 0.5 + ON_PLANE)
    on_event("occupied cells", 0, None)
    wider = occupied_cells(triangles, resolution, Box(box.low - reach, box.high + reach))
    inner = tuple(slice(reach, reach + n) for n in box.shape)
    occupied = wider[inner].clone()
    near = wider
    for axis in range(3):
        near = widened(near, axis, reach)
    near = near[inner]
    clear = grounded & ~near
    cells = (grounded & near).nonzero()
    for begin in range(0, len(cells), 1 << 20):
        part = cells[begin : begin + (1 << 20)]
        on_event("navigable cells", begin, len(cells))
        room = mesh.clearance((part + box.low + 0.5).double() * resolution)
        clear[part.unbind(1)] = room > radius
    return occupied, clear


def above_floor(mesh: MeshWorld, resolution: float, box: Box) -> Tensor:
    """Return cells (nx, ny, nz), bool, that have a surface of the mesh below their centre."""
    centers = [
        (torch.arange(low, high) + 0.5).double() * resolution
        for low, high in zip(box.low.tolist(), box.high.tolist(), strict=True)
    ]
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    bottom = mesh.low[2:] - 1
    floor = []
    for x in centers[0].split(max(1, (1 << 20) // len(centers[1]))):  # a million columns at a time
        columns = torch.cartesian_prod(x, centers[1])
        starts = torch.cat([columns, bottom.expand(len(columns), 1)], 1)
        floor.append((bottom + mesh.distances(starts, up.expand_as(starts))).view(len(x), -1))
    return torch.cat(floor)[:, :, None] < centers[2]


def widened(blocked: Tensor, axis: int, cells: int) -> Tensor:
    """Return cells with a blocked cell within `cells` along an axis; invalid that close to the ends."""
    size, done = blocked.shape[axis], 0
    while done < cells:
        shift = min(2 * done + 1, cells - done)  # 2 · done + 1 cells are covered so far
        wider = blocked.clone()
        wider.narrow(axis, shift, size - shift).logical_or_(blocked.narrow(axis, 0, size - shift))
        wider.narrow(axis, 0, size - shift).logical_or_(blocked.narrow(axis, shift, size - shift))
        blocked, done = wider, done + shift
    return blocked


def connected(
    clear: Tensor,
    mesh: MeshWorld,
    resolution: float,
    box: Box,
    start: Tensor | None,
    radius: float,
    name: str,
) -> Tensor:
    """Return the connected part (nx, ny, nz), bool, of the clear cells that robots use. It is the part that
    contains the start. Without a start it is the part with the most standing room."""
    from scipy.ndimage import label

    parts, n_parts = label(clear.numpy())
    parts = torch.from_numpy(parts)
    if n_parts == 0:
        raise InvalidArgumentError(
            f"{name}: no cell of {resolution} m is above a floor and farther than ‹robot_radius›={radius} m "
            "from the mesh. Use a smaller radius or wider bounds; check that the mesh is in metres with z up."
        )
    if start is not None:
        cell = (start / resolution).floor().long() - box.low
        if bool((cell < 0).any()) or bool((cell >= torch.tensor(box.shape)).any()):
            raise InvalidArgumentError(f"{name}: start={start.tolist()} is outside the bounds.")
        part = int(parts[tuple(cell.tolist())])
        if part == 0:
            raise InvalidArgumentError(
                f"{name}: at start={start.tolist()} a robot of radius {radius} m touches the mesh or has no "
                "floor below it; move the start."
            )
        return parts == part
    places = (mesh.standing_places() / resolution).floor().long() - box.low
    places = places[((places >= 0) & (places < torch.tensor(box.shape))).all(1)]
    votes = torch.bincount(parts[places.unbind(1)], minlength=n_parts + 1)
    votes[0] = 0
    if not bool(votes.any()):
        votes = torch.bincount(parts.flatten())
        votes[0] = 0
    return parts == int(votes.argmax())


def collides(world: MeshWorld, positions: Tensor, radius: float) -> Tensor:
    """Flag (S,) the positions (S, 3), metres, that are closer than `radius` to a surface. The test does not
    detect positions deep inside a solid. Positions along a path must therefore be no farther apart than the
    robot's width, so that no step passes through a surface undetected."""
    if len(positions) == 0:
        return torch.zeros(0, dtype=torch.bool)
    return world.clearance(positions) < radius


def finely(positions: Tensor) -> Tensor:
    """Interpolate positions (1 + S, 3) to (1 + 4 S, 3): a robot may collide between states."""
    share = torch.arange(1, 5, dtype=positions.dtype)[:, None] / 4
    between = positions[:-1, None] + share * (positions[1:, None] - positions[:-1, None])
    return torch.cat([positions[:1], between.reshape(-1, 3)])


def meets_others(positions: Tensor, radius: float) -> Tensor:
    """Flag (R, S) the robots that are closer than two radii to another, at positions (R, S, 3), metres."""
    apart = (positions[:, None] - positions[None]).norm(dim=-1)
    other = ~torch.eye(len(positions), dtype=torch.bool)[..., None]
    return ((apart < 2 * radius) & other).any(1)


_GOLDEN = (math.sqrt(5) - 1) / 2
_AT_SURFACE = 1e-3  # tolerance (m) for float32 rays. A ray can only end in a cell that the mesh meets.

_RAYS_AT_ONCE = 1 << 18


def viewpoints(navigable: Tensor, step: int) -> Tensor:
    """Return the navigable cell nearest to the middle of each block of `step`³ cells, (V, 3)."""
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

    occupied: (nx, ny, nz) bool, the cells of the box that the mesh meets. points_of_view: (V, 3) int64, cells
    relative to the low corner of the box. directions: (N, 3) unit vectors. max_range: metres.
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
    """Return the distances (K,), in cells, at which a ray from a cell's centre enters cells, and the offsets
    (K,) of their flat indices. The first cell is the start, entered at distance 0."""
    plane = torch.arange(math.ceil(reach) + 1, dtype=torch.float64) + 0.5
    distance = (plane / direction.abs()[:, None]).flatten()  # infinite along planes
    step = (direction.sign().long() * strides)[:, None].expand(3, len(plane)).flatten()
    entry, order = distance.sort(stable=True)
    within = entry < reach
    zero = torch.zeros(1, dtype=torch.int64)
    return torch.cat([zero.double(), entry[within]]), torch.cat([zero, step[order[within]].cumsum(0)])

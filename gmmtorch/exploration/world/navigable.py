"""Where a robot can be: cells at whose centre it does not touch the mesh, above a floor, all connected."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.evaluation.events import Event
from gmmtorch.occupancy.voxels.boxes import Box
from gmmtorch.occupancy.voxels.voxelize import occupied_cells
from gmmtorch.simulation.worlds.mesh_world import MeshWorld

ON_PLANE = 1e-6
"""Of a cell, within which a length counts as lying on a plane of the lattice: more than rounding."""


def occupied_and_clear(
    mesh: MeshWorld,
    triangles: Tensor,
    resolution: float,
    box: Box,
    grounded: Tensor,
    radius: float,
    on_event: Event,
) -> tuple[Tensor, Tensor]:
    """Cells (nx, ny, nz) that the mesh meets, and grounded ones from whose centre it is beyond `radius`."""
    # The centre of a cell is at least (m − ½) cells from what lies m cells away on some axis. Only up to
    # there need distances be asked for; what lies just outside the box matters too.
    reach = math.floor(radius / resolution + 0.5 + ON_PLANE)
    on_event("occupied cells", 0, None)
    wider = occupied_cells(triangles, resolution, Box(box.low - reach, box.high + reach))
    inner = tuple(slice(reach, reach + n) for n in box.shape)
    occupied = wider[inner].clone()
    near = _dilated(wider, reach)[inner]
    clear = grounded & ~near
    cells = (grounded & near).nonzero()
    for begin in range(0, len(cells), 1 << 20):
        part = cells[begin : begin + (1 << 20)]
        on_event("navigable cells", begin, len(cells))
        room = mesh.clearance((part + box.low + 0.5).double() * resolution)
        clear[part.unbind(1)] = room > radius
    return occupied, clear


def above_floor(mesh: MeshWorld, resolution: float, box: Box) -> Tensor:
    """Cells (nx, ny, nz), bool, whose centre has a surface of the mesh somewhere below it."""
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


def _dilated(mask: Tensor, reach: int) -> Tensor:
    """Cells (nx, ny, nz) within `reach` cells of one that is set, on every axis."""
    for axis in range(3):
        n = mask.shape[axis]
        spread = mask.clone()
        for step in range(1, min(reach, n - 1) + 1):
            spread.narrow(axis, step, n - step).logical_or_(mask.narrow(axis, 0, n - step))
            spread.narrow(axis, 0, n - step).logical_or_(mask.narrow(axis, step, n - step))
        mask = spread
    return mask


def connected(
    clear: Tensor,
    mesh: MeshWorld,
    resolution: float,
    box: Box,
    start: Tensor | None,
    radius: float,
    name: str,
) -> Tensor:
    """The part (nx, ny, nz), bool, of the clear cells that holds the start, or that is to be flown in."""
    from scipy.ndimage import label

    parts, n_parts = label(clear.numpy())
    parts = torch.from_numpy(parts)
    if n_parts == 0:
        raise InvalidArgumentError(
            f"{name}: no cell of {resolution} m is above a floor and farther than robot_radius={radius} m "
            "from the mesh; take a smaller radius, or wider bounds; is the mesh in metres, and z up?"
        )
    if start is not None:
        cell = (start / resolution).floor().long() - box.low
        if bool((cell < 0).any()) or bool((cell >= torch.tensor(box.shape)).any()):
            raise InvalidArgumentError(f"{name}: start={start.tolist()} is outside the bounds.")
        part = int(parts[tuple(cell.tolist())])
        if part == 0:
            raise InvalidArgumentError(
                f"{name}: at start={start.tolist()} a robot of radius {radius} m touches the mesh, or "
                "has no floor below it; move it."
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

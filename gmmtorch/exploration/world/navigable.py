"""Navigable cells: connected cells above a floor at whose centre a robot does not touch the mesh."""

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
    """Return cells (nx, ny, nz) that the mesh meets, and grounded cells whose centre is beyond `radius`
    of it.
    """
    # A cell m cells away on some axis is at least (m − ½) cells from a cell's centre. Distances are therefore
    # computed only for cells that close to the mesh. The mesh just outside the box counts too.
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


def _dilated(mask: Tensor, reach: int) -> Tensor:
    """Return cells (nx, ny, nz) within `reach` cells, on every axis, of a cell that is set."""
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
    """Return the connected part (nx, ny, nz), bool, of the clear cells that robots use.

    It is the part that contains the start. Without a start it is the part with the most standing room.
    """
    from scipy.ndimage import label

    parts, n_parts = label(clear.numpy())
    parts = torch.from_numpy(parts)
    if n_parts == 0:
        raise InvalidArgumentError(
            f"{name}: no cell of {resolution} m is above a floor and farther than robot_radius={radius} m "
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

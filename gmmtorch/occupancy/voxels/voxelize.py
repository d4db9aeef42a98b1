"""Voxelization: the lattice cells that a triangle mesh meets, exact. It gives the true map of a simulated
world.

A triangle and a cell are disjoint if and only if one of thirteen axes separates them (Akenine-Möller, "Fast
3D triangle-box overlap testing", 2001): the three lattice axes, the triangle's normal, and the nine cross
products of its edges with the cell's edges. Candidates come from columns of cells along the axis closest to
the triangle's normal, where its plane passes through at most four cells of a column. So the cost of a
triangle is proportional to its area, not to the volume of its bounding box.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.kernels import row_major_strides
from gmmtorch.linalg import ragged_index
from gmmtorch.occupancy.culling import cells_in_chunks
from gmmtorch.occupancy.grid import check_resolution
from gmmtorch.occupancy.voxels.boxes import Box

_NUDGE = 1e-6
"""Cells by which the mesh is moved up along all axes. A face in a lattice plane then counts only for the
cell above it, like its points under `floor`."""

_HALF = 0.5 - _NUDGE / 2
"""Half a cell, reduced so that a face which only touches an edge or a corner of a cell does not count."""

_CHUNK = 1 << 16
"""Columns processed in one pass."""


def occupied_cells(triangles: Tensor, resolution: float, box: Box) -> Tensor:
    """Cells (nx, ny, nz), bool, of a box of the lattice that triangles (T, 3, 3), world metres, meet.

    A face or edge in the plane between two cells counts for the upper cell: a floor at height 0 counts for
    the cells above it. A triangle without area counts for the cells along its line.

    Raises `InvalidArgumentError` for another shape, and `DataError` for corners that are not finite.
    """
    check_resolution(resolution)
    if triangles.ndim != 3 or triangles.shape[1:] != (3, 3):
        raise InvalidArgumentError(f"triangles has shape {tuple(triangles.shape)}; expected (T, 3, 3).")
    if not bool(torch.isfinite(triangles).all()):
        raise DataError("triangles has a corner that is NaN or infinite; remove that triangle.")
    shape = box.shape
    strides = torch.tensor(row_major_strides(shape), device=triangles.device)
    size = torch.tensor(shape, device=triangles.device)
    occupied = torch.zeros(shape, dtype=torch.bool, device=triangles.device)
    corners = triangles.double() / resolution - box.low.to(triangles.device) + _NUDGE
    reach = ((corners.amax(1) >= 0) & (corners.amin(1) < size)).all(1)
    corners = corners[reach]
    facing = _normals(corners).abs().argmax(1)
    for axis in range(3):
        order = torch.tensor([(axis + 1) % 3, (axis + 2) % 3, axis], device=triangles.device)
        turned = corners[facing == axis][:, :, order]
        for cells in _cells_met(turned, size[order]):
            occupied.view(-1)[cells @ strides[order]] = True
    return occupied


def _normals(corners: Tensor) -> Tensor:
    return torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def _cells_met(corners: Tensor, size: Tensor) -> Iterator[Tensor]:
    """Cells (C, 3) in [0, size) that triangles (T, 3, 3), in cells, meet; their normals are along axis 2."""
    axes, low, high = _slabs(corners)
    # The height of the triangle's plane follows from its first corner and its slopes.
    normal = _normals(corners)
    flat = normal[:, 2] == 0  # no area
    slope = torch.where(flat[:, None], 0.0, -normal[:, :2] / normal[:, 2:].where(~flat[:, None], 1.0))
    above = corners[:, 0, 2] - (slope * corners[:, 0, :2]).sum(1)
    spread = slope.abs().sum(1) / 2 + _NUDGE
    floor, ceiling = corners[:, :, 2].amin(1), corners[:, :, 2].amax(1)
    first = corners[:, :, :2].amin(1).floor().clamp_min(0).long()
    last = torch.minimum(corners[:, :, :2].amax(1).floor(), size[:2] - 1).long()
    for triangle, columns in cells_in_chunks(first, (last - first + 1).clamp_min(0), _CHUNK):
        column = columns.T.double()
        center = column + 0.5
        height = above[triangle] + (slope[triangle] * center).sum(1)
        reach = torch.where(flat[triangle], torch.inf, spread[triangle])
        lowest = torch.maximum(height - reach, floor[triangle]).floor().clamp_min(0)
        highest = torch.minimum(height + reach, ceiling[triangle]).floor().clamp_max(size[2] - 1)
        pair, step = ragged_index((highest - lowest + 1).clamp_min(0).long())
        which = triangle[pair]
        cells = torch.cat([column[pair], (lowest[pair] + step)[:, None]], 1)
        along = torch.einsum("pad,pd->pa", axes[which], cells + 0.5)
        yield cells[((along >= low[which]) & (along <= high[which])).all(1)].long()


def _slabs(corners: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Axes (T, 13, 3), and along each the interval [low, high], (T, 13), of cell centres not separated."""
    edges = corners.roll(-1, 1) - corners
    unit = torch.eye(3, dtype=corners.dtype, device=corners.device)
    across = torch.linalg.cross(edges[:, :, None].expand(-1, 3, 3, 3), unit.expand(len(corners), 3, 3, 3))
    axes = torch.cat([unit.expand(len(corners), 3, 3), _normals(corners)[:, None], across.flatten(1, 2)], 1)
    along = torch.einsum("tad,tcd->tac", axes, corners)
    reach = _HALF * axes.abs().sum(2)
    return axes, along.amin(2) - reach, along.amax(2) + reach

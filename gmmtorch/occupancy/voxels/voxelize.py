"""Which cells of the lattice a triangle mesh meets, exactly: the true map of a simulated world.

A triangle and a cell are apart if and only if they are apart along one of thirteen axes (Akenine-Möller,
"Fast 3D triangle-box overlap testing", 2001): the three of the lattice, the triangle's normal, and the nine
cross products of its edges with those of the cell. Candidates are found column by column along the axis
that the triangle faces most, where its plane passes through at most four cells of each column: so a floor
of 50 × 40 m costs its area, not the volume about it.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.occupancy.grid import check_resolution
from gmmtorch.occupancy.voxels.boxes import Box
from gmmtorch.occupancy.voxels.ray_traversal import row_major_strides

_NUDGE = 1e-6
"""Of a cell, by which the mesh is moved up along all axes. A face in a plane of the lattice then counts for
the cell above it, as its points do under `floor`, and for that cell alone."""

_HALF = 0.5 - _NUDGE / 2
"""Half a cell, less what lets a face that only touches an edge or a corner of the cell pass."""

_CHUNK = 1 << 16
"""Columns worked on at once."""


def occupied_cells(triangles: Tensor, resolution: float, box: Box) -> Tensor:
    """Cells (nx, ny, nz), bool, of a box of the lattice that triangles (T, 3, 3), metres, meet.

    Cell c is the cube [c, c + 1) times the resolution: a face, or an edge of one, that lies in the plane
    between two cells counts for the upper one, so a floor at height 0 for the cells above it. Triangles
    without area count for the cells along their line. Raises `DataError` for corners that are not finite.
    """
    check_resolution(resolution)
    if triangles.ndim != 3 or triangles.shape[1:] != (3, 3):
        raise InvalidArgumentError(f"triangles has shape {tuple(triangles.shape)}; expected (T, 3, 3).")
    if not bool(torch.isfinite(triangles).all()):
        raise DataError("triangles has a corner that is NaN or infinite; drop that triangle.")
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
        for cells in _met(turned, size[order]):
            occupied.view(-1)[cells @ strides[order]] = True
    return occupied


def _normals(corners: Tensor) -> Tensor:
    return torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def _met(corners: Tensor, size: Tensor) -> Iterator[Tensor]:
    """Cells (C, 3) within [0, size) that triangles (T, 3, 3), in cells, meet; they face the last axis."""
    axes, low, high = _slabs(corners)
    # Height of the plane over a place: from the first corner, by the slopes of the plane.
    normal = _normals(corners)
    flat = normal[:, 2] == 0  # no area
    slope = torch.where(flat[:, None], 0.0, -normal[:, :2] / normal[:, 2:].where(~flat[:, None], 1.0))
    above = corners[:, 0, 2] - (slope * corners[:, 0, :2]).sum(1)
    spread = slope.abs().sum(1) / 2 + _NUDGE
    floor, ceiling = corners[:, :, 2].amin(1), corners[:, :, 2].amax(1)
    for triangle, column in _columns(corners, size):
        center = column + 0.5
        height = above[triangle] + (slope[triangle] * center).sum(1)
        reach = torch.where(flat[triangle], torch.inf, spread[triangle])
        lowest = torch.maximum(height - reach, floor[triangle]).floor().clamp_min(0)
        highest = torch.minimum(height + reach, ceiling[triangle]).floor().clamp_max(size[2] - 1)
        count = (highest - lowest + 1).clamp_min(0).long()
        pair = torch.repeat_interleave(count)
        step = torch.arange(len(pair), device=pair.device) - (count.cumsum(0) - count)[pair]
        which = triangle[pair]
        cells = torch.cat([column[pair], (lowest[pair] + step)[:, None]], 1)
        along = torch.einsum("pad,pd->pa", axes[which], cells + 0.5)
        yield cells[((along >= low[which]) & (along <= high[which])).all(1)].long()


def _slabs(corners: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Axes (T, 13, 3), and between what (T, 13) a cell's centre lies along each if nothing parts the two."""
    edges = corners.roll(-1, 1) - corners
    unit = torch.eye(3, dtype=corners.dtype, device=corners.device)
    across = torch.linalg.cross(edges[:, :, None].expand(-1, 3, 3, 3), unit.expand(len(corners), 3, 3, 3))
    axes = torch.cat([unit.expand(len(corners), 3, 3), _normals(corners)[:, None], across.flatten(1, 2)], 1)
    along = torch.einsum("tad,tcd->tac", axes, corners)
    reach = _HALF * axes.abs().sum(2)
    return axes, along.amin(2) - reach, along.amax(2) + reach


def _columns(corners: Tensor, size: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """Triangle (P,) and column (P, 2) of the cells under each triangle's rectangle, some at a time."""
    first = corners[:, :, :2].amin(1).floor().clamp_min(0)
    last = torch.minimum(corners[:, :, :2].amax(1).floor(), size[:2] - 1)
    span = (last - first + 1).clamp_min(0).long()
    stop = (span[:, 0] * span[:, 1]).cumsum(0)
    total = int(stop[-1]) if len(stop) else 0
    for begin in range(0, total, _CHUNK):
        place = torch.arange(begin, min(begin + _CHUNK, total), device=corners.device)
        triangle = torch.searchsorted(stop, place, right=True)
        index = place - (stop - span[:, 0] * span[:, 1])[triangle]
        width = span[triangle, 1]
        yield triangle, first[triangle] + torch.stack([index // width, index % width], 1)

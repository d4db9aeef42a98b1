"""Cells of the world's lattice: boxes of them, their evidence, and those that a mesh meets. Cell c is the
cube [c, c + 1) times the resolution, world frame.

A triangle and a cell are disjoint if and only if one of thirteen axes separates them (Akenine-Möller, "Fast
3D triangle-box overlap testing", 2001): the three lattice axes, the triangle's normal, and the nine cross
products of its edges with the cell's edges. Candidates come from columns of cells along the axis closest to
the triangle's normal, where its plane passes through at most four cells of a column. So the cost of a
triangle is proportional to its area, not to the volume of its bounding box.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike, as_tensor
from gmmtorch.errors import DataError, InvalidArgumentError, check_resolution
from gmmtorch.kernels import list_counted_cells, row_major_strides
from gmmtorch.linalg import ragged_index

_FARTHEST = 2.0**32  # cells from the world's origin; sums of the ray traversal are exact within


class Box(NamedTuple):
    """Cells c with low ≤ c < high along each axis; low and high are (D,) int64."""

    low: Tensor
    high: Tensor

    @property
    def shape(self) -> tuple[int, ...]:
        """Cells along each axis."""
        return tuple((self.high - self.low).tolist())


def intersection(one: Box, other: Box) -> Box | None:
    """The cells that are in both boxes; None if there are none."""
    found = Box(torch.maximum(one.low, other.low), torch.minimum(one.high, other.high))
    return found if bool((found.low < found.high).all()) else None


def difference(box: Box, other: Box) -> list[Box]:
    """The cells of `box` that are not in `other`, as disjoint boxes."""
    low, high, parts = box.low.tolist(), box.high.tolist(), []
    for axis, (first, last) in enumerate(zip(other.low.tolist(), other.high.tolist(), strict=True)):
        for begin, stop in ((low[axis], min(first, high[axis])), (max(last, low[axis]), high[axis])):
            if begin < stop:
                part = Box(box.low.new_tensor(low), box.low.new_tensor(high))
                part.low[axis], part.high[axis] = begin, stop
                parts.append(part)
        low[axis], high[axis] = max(low[axis], first), min(high[axis], last)
        if low[axis] >= high[axis]:
            break
    return parts


def contains(box: Box, cells: Tensor) -> Tensor:
    """Whether each cell (C, D) is in the box, (C,) bool."""
    inside = torch.ones_like(cells[:, 0], dtype=torch.bool)
    # One comparison for each axis: reductions over a dimension of three are slow.
    for axis, (low, high) in enumerate(zip(box.low.tolist(), box.high.tolist(), strict=True)):
        inside &= (cells[:, axis] >= low) & (cells[:, axis] < high)
    return inside


def to_lattice(points: ArrayLike, resolution: float, name: str = "points") -> Tensor:
    """Points (…, 3), world metres, in units of cells, float64.

    Raises `InvalidArgumentError` if a point is not finite, or 2³² cells or more from the world's origin.
    """
    units = as_tensor(points, name, torch.float64) / check_resolution(resolution)
    if units.numel() and not bool(units.abs().max() < _FARTHEST):  # not `>=`: NaN must fail, too
        raise InvalidArgumentError(
            f"{name} must be finite and less than 2**32 cells of resolution={resolution} m from the world's "
            "origin; remove such points, or use coarser cells."
        )
    return units


def row_major(columns: Sequence[Tensor], shape: tuple[int, ...]) -> Tensor:
    """Index (C,) of cells in an array of `shape`, from their coordinates (C,) along each axis."""
    index = columns[0]
    for column, n in zip(columns[1:], shape[1:], strict=True):
        index = index * n + column
    return index


def flat_index(cells: Tensor, shape: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    """`row_major` index (C,) of cells (C, D), 0 outside, and whether each is inside (C,).

    The cells can be of a floating type, with NaN and infinite coordinates, which are outside.
    """
    columns = cells.unbind(1)
    inside = torch.ones_like(columns[0], dtype=torch.bool)
    # One comparison for each axis: reductions over a dimension of three are slow.
    for column, n in zip(columns, shape, strict=True):
        inside &= (column >= 0) & (column < n)
    return torch.where(inside, row_major(columns, shape), 0).long(), inside


def cells_in_chunks(first: Tensor, count: Tensor, size: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Row (P,) and cell indices (K, P) of all cells of R boxes of cells, in chunks of `size`.

    Args:
        first, count: (R, K), lowest cell and number of cells of each box along each axis.
    """
    per_row = count.prod(1)
    ends = torch.cumsum(per_row, 0)
    total = int(ends[-1]) if len(ends) else 0
    for begin in range(0, total, size):
        flat = torch.arange(begin, min(begin + size, total), device=ends.device)
        row = torch.searchsorted(ends, flat, right=True)
        local = flat - (ends - per_row)[row]
        cells = []
        for axis in reversed(range(first.shape[1])):
            cells.append(first[row, axis] + local % count[row, axis])
            local = local // count[row, axis]
        yield row, torch.stack(cells[::-1])


class CellEvidence(NamedTuple):
    """Hits and misses of C distinct cells of the world's lattice.

    cells (C, 3) int64: cell c is the cube [c, c + 1) times the resolution, world frame. hits (C,) and
    misses (C,), float32: rays that end in the cell, and rays that pass through it.
    """

    cells: Tensor
    hits: Tensor
    misses: Tensor

    @classmethod
    def empty(cls, device: torch.device | str | None = None) -> CellEvidence:
        """Evidence of no cell, in 3D."""
        zero = torch.zeros(0, device=device)
        return cls(torch.zeros(0, 3, dtype=torch.int64, device=device), zero, zero)

    @classmethod
    def from_dense(cls, low: Tensor, hits: Tensor, misses: Tensor) -> CellEvidence:
        """The cells with any evidence of a dense array (nx, ny, nz) whose lowest cell is `low` (3,)."""
        return cls(*list_counted_cells(low, hits, misses))


def sum_evidence(parts: Iterable[CellEvidence]) -> CellEvidence:
    """The sum of several evidences; each cell occurs once.

    Raises `InvalidArgumentError` if the cells span too large a box for 64-bit indices.
    """
    given = list(parts)
    parts = [part for part in given if len(part.cells)] or given[:1]
    if not parts:
        return CellEvidence.empty()
    if len(parts) == 1:
        return parts[0]
    cells = torch.cat([part.cells for part in parts])
    low = cells.amin(0)
    shape = tuple((cells.amax(0) - low + 1).tolist())
    if math.prod(shape) >= 2**62:
        raise InvalidArgumentError(f"Evidence that spans {shape} cells cannot be summed; use coarser cells.")
    strides = torch.tensor(row_major_strides(shape), device=cells.device)
    key, row = torch.unique(((cells - low) * strides).sum(1), return_inverse=True)
    sums = [
        torch.zeros(len(key), device=cells.device).index_add_(0, row, torch.cat([part[i] for part in parts]))
        for i in (1, 2)
    ]
    size = torch.tensor(shape, device=cells.device)
    return CellEvidence(key[:, None] // strides % size + low, *sums)


_NUDGE = 1e-6
"""Cells by which the mesh is moved up along all axes. A face in a lattice plane then counts only for the
cell above it, like its points under `floor`."""

_HALF = 0.5 - _NUDGE / 2
"""Half a cell, reduced so that a face which only touches an edge or a corner of a cell does not count."""

_CHUNK = 1 << 16  # columns processed in one pass


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

"""Boxes of cells of the world's lattice: cell c is the cube [c, c + 1) times the resolution, world frame."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike, as_tensor
from gmmtorch.errors import InvalidArgumentError, check_resolution

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

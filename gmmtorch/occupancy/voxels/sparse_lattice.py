"""SparseLattice: the key index that the sparse stores share."""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, check_resolution

_LOCAL_BITS = {2: 4, 3: 3}  # bits of the position of a cell in its block, along each axis


class SparseLattice:
    """Base of the sparse stores: an unbounded lattice of cells, of which some are stored, under sorted keys.

    Cell i is the square or cube [i, i + 1) times the resolution, world frame. A block has 16² cells in 2D
    and 8³ cells in 3D. A key packs the coordinates of a block relative to `anchor`, so that maps far from
    the world's origin work, too. Stored keys are found by binary search.

    Args:
        resolution: side (m) of the cells.
        dim: 2 or 3.
        axis_bits: bits of one block coordinate in a key.
        memory_limit: bytes that the store can take.
    """

    def __init__(
        self,
        resolution: float,
        dim: int,
        axis_bits: int,
        device: torch.device | str | None,
        memory_limit: int,
    ) -> None:
        self.resolution = check_resolution(resolution)
        self.dim = dim
        self.memory_limit = memory_limit
        self.anchor: Tensor | None = None
        """Block (D,), int64, on the CPU, that keys are relative to; None until something is stored."""
        self.keys = torch.empty(0, dtype=torch.int64, device=device)
        """Stored keys (N,), ascending."""
        self._axis_bits = axis_bits
        self._half = 1 << (axis_bits - 1)
        self.local_bits = _LOCAL_BITS[dim]

    @property
    def block_side(self) -> int:
        """Cells of a block along one axis."""
        return 1 << self.local_bits

    @property
    def cells_per_block(self) -> int:
        return 1 << (self.local_bits * self.dim)

    @property
    def device(self) -> torch.device:
        return self.keys.device

    def cells_of(self, points: Tensor) -> Tensor:
        """Cell (M, D), float64, of each point (M, D), world metres."""
        return (points.double() / self.resolution).floor()

    def origin(self) -> Tensor:
        """The anchor, or zero if it is not set: (D,) int64."""
        return torch.zeros(self.dim, dtype=torch.int64) if self.anchor is None else self.anchor

    def columns(self, cells: Tensor) -> list[Tensor]:
        """Coordinates (M,) of cells (M, D) along each axis, relative to the lowest cell of the anchor."""
        low = (self.origin() * self.block_side).tolist()
        return [cells[:, axis] - low[axis] for axis in range(self.dim)]

    def reachable(self, columns: list[Tensor]) -> Tensor:
        """Whether each cell (M,), of `columns` of any dtype, has a key; False for NaN and infinity."""
        limit = (self._half - 1) * self.block_side
        return functools.reduce(torch.logical_and, [column.abs() < limit for column in columns])

    def check_reachable(self, cells: Tensor) -> None:
        """Raise `InvalidArgumentError` unless all cells (M, D) have keys. Sets a missing anchor."""
        if cells.shape[0] and self.anchor is None:
            self.anchor = (cells[0] / self.block_side).floor().long().cpu()
        if not bool(self.reachable(self.columns(cells)).all()):
            reach = (self._half - 1) * self.block_side * self.resolution
            raise InvalidArgumentError(
                f"resolution={self.resolution} m cannot index points more than {reach:.3g} m from the first; "
                "use a coarser one, or remove stray far points."
            )

    def block_keys(self, columns: list[Tensor]) -> Tensor:
        """Keys (M,) of the blocks that contain the cells of `columns`, int64; ordered like block
        coordinates.
        """
        key = (columns[0] >> self.local_bits) + self._half
        for column in columns[1:]:
            key = (key << self._axis_bits) | ((column >> self.local_bits) + self._half)
        return key

    def places(self, columns: list[Tensor]) -> Tensor:
        """Row-major index (M,) of the cells of `columns` within their blocks."""
        mask = self.block_side - 1
        place = columns[0] & mask
        for column in columns[1:]:
            place = (place << self.local_bits) | (column & mask)
        return place

    def cells_at(self, keys: Tensor, places: Tensor) -> Tensor:
        """Cells (M, D) in the blocks with these keys (M,), at these row-major indices (M,) within them."""
        origin, columns = self.origin().tolist(), []
        for axis, shift in enumerate(range(self.dim - 1, -1, -1)):
            block = (keys >> (self._axis_bits * shift)) & ((1 << self._axis_bits) - 1)
            place = (places >> (self.local_bits * shift)) & (self.block_side - 1)
            columns.append(((block - self._half + origin[axis]) << self.local_bits) + place)
        return torch.stack(columns, 1)

    def find_keys(self, keys: Tensor) -> tuple[Tensor, Tensor]:
        """Position (M,) of each key in `keys`, and whether it is stored (M,); any position if not."""
        if self.keys.shape[0] == 0:
            return torch.zeros_like(keys), torch.zeros_like(keys, dtype=torch.bool)
        rank = torch.searchsorted(self.keys, keys).clamp_max(self.keys.shape[0] - 1)
        return rank, self.keys[rank] == keys

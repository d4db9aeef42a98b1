"""SparseLattice: the key index that the sparse stores share. CellTable: numbers of single cells on it."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import DataError, InvalidArgumentError, MemoryLimitError, check_resolution
from gmmtorch.files import require
from gmmtorch.occupancy.grid import MEMORY_LIMIT

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


_AXIS_BITS = {2: 27, 3: 17}


class CellTable(SparseLattice):
    """Rows of `width` float32 numbers, one for each stored cell.

    The key of a cell is the key of its block followed by its place in the block. So a file can name each
    block once and use one bit for each of its cells.
    """

    def __init__(
        self,
        resolution: float,
        dim: int,
        width: int,
        device: torch.device | str | None = None,
        memory_limit: int = MEMORY_LIMIT,
    ) -> None:
        super().__init__(resolution, dim, _AXIS_BITS[dim], device, memory_limit)
        self.values = torch.zeros(0, width, device=device)
        """The numbers (N, width), float32, in the order of `keys`."""

    # -- geometry ---------------------------------------------------------------------------------

    def cells(self, points: Tensor) -> Tensor:
        """Cell (M, D), int64, of each finite point (M, D), world metres.

        Raises `InvalidArgumentError` for a cell too far from the first one.
        """
        cell = self.cells_of(points)
        self.check_reachable(cell)
        return cell.long()

    def centers(self, rows: Tensor | None = None) -> Tensor:
        """Centres (M, D) of the cells of these rows, or of all rows, world metres, float64."""
        keys = self.keys if rows is None else self.keys[rows]
        cells = self.cells_at(keys >> (self.local_bits * self.dim), keys)
        return (cells.double() + 0.5) * self.resolution

    def _cell_keys(self, columns: list[Tensor]) -> Tensor:
        return (self.block_keys(columns) << (self.local_bits * self.dim)) | self.places(columns)

    # -- rows -------------------------------------------------------------------------------------

    def open(self, cells: Tensor) -> Tensor:
        """Row (M,) of each cell (M, D), int64. New cells get a row of zeros, which can move earlier rows.

        Raises `MemoryLimitError` if the table exceeds its limit; the table does not change then.
        """
        keys, inverse = torch.unique(self._cell_keys(self.columns(cells)), return_inverse=True)
        rows, known = self.find_keys(keys)
        if not bool(known.all()):
            n_rows = self.keys.shape[0] + int((~known).sum())
            n_bytes = n_rows * (8 + 4 * self.values.shape[1])
            if n_bytes > self.memory_limit:
                raise MemoryLimitError(
                    f"resolution={self.resolution} m takes {n_rows:,} cells = {n_bytes:,} bytes, above the "
                    f"limit of {self.memory_limit:,}; use a coarser one."
                )
            merged, order = torch.sort(torch.cat([self.keys, keys[~known]]))
            new = self.values.new_zeros(n_rows - self.keys.shape[0], self.values.shape[1])
            self.values = torch.cat([self.values, new])[order]
            self.keys = merged
            rows, _ = self.find_keys(keys)
        return rows[inverse]

    def find(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Row (M,) of the cell of each point (M, D), and whether it has one; row 0 if not.

        Points can be infinite, or far from all cells.
        """
        return self.find_cells(self.cells_of(points))

    def find_cells(self, cells: Tensor) -> tuple[Tensor, Tensor]:
        """Row (M,) of each cell (M, D), and whether it has one; row 0 if not."""
        columns = self.columns(cells)
        reachable = self.reachable(columns)
        columns = [torch.where(reachable, column, 0).long() for column in columns]
        rows, known = self.find_keys(self._cell_keys(columns))
        known = known & reachable
        return torch.where(known, rows, 0), known

    # -- files ------------------------------------------------------------------------------------

    def packed(self, kept: Tensor | None = None, prefix: str = "") -> dict[str, Tensor]:
        """Anchor, blocks and one bit for each cell: they name the cells of the rows `kept` (N,) or of all."""
        keys = self.keys if kept is None else self.keys[kept]
        bits = self.local_bits * self.dim
        blocks, inverse = torch.unique(keys >> bits, return_inverse=True)
        marked = torch.zeros(blocks.shape[0], 1 << bits, dtype=torch.bool, device=keys.device)
        marked[inverse, keys & ((1 << bits) - 1)] = True
        return {
            f"{prefix}anchor": self.origin().clone(),
            f"{prefix}blocks": blocks,
            f"{prefix}cells": torch.from_numpy(np.packbits(marked.cpu().numpy(), axis=1)),
        }

    def fill(self, tensors: Mapping[str, Tensor], path: str | Path, prefix: str = "") -> None:
        """Replace the rows by zeros for the cells that `packed` named; `DataError` if they are damaged."""
        bits, key_bits = self.local_bits * self.dim, self._axis_bits * self.dim
        anchor = require(tensors, f"{prefix}anchor", (self.dim,), torch.int64, path)
        blocks = require(tensors, f"{prefix}blocks", (None,), torch.int64, path)
        shape = (blocks.shape[0], (1 << bits) // 8)
        packed = require(tensors, f"{prefix}cells", shape, torch.uint8, path)
        marked = torch.from_numpy(np.unpackbits(packed.numpy(), axis=1)).bool()
        ascending = bool((blocks[1:] > blocks[:-1]).all())
        if not ascending or (blocks.numel() and not 0 <= int(blocks[0]) <= int(blocks[-1]) < 1 << key_bits):
            raise DataError(f"{path}: its blocks are not sorted; the file is damaged.")
        if bool((anchor.abs() >= 1 << 48).any()):
            raise DataError(f"{path}: its anchor {anchor.tolist()} is too far away; the file is damaged.")
        block, cell = marked.nonzero(as_tuple=True)
        self.anchor = anchor if blocks.numel() else None
        self.keys = (blocks[block] << bits) | cell
        self.values = torch.zeros(self.keys.shape[0], self.values.shape[1])

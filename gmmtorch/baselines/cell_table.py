"""CellTable: numbers of the cells that have any, on an unbounded lattice."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import DataError, InvalidArgumentError, MemoryLimitError
from gmmtorch.files import require
from gmmtorch.occupancy.grid import MEMORY_LIMIT, check_resolution

_LOCAL_BITS = {2: 4, 3: 3}  # of a cell within its block, along each axis
_BLOCK_BITS = {2: 27, 3: 17}  # of a block within the key, along each axis


class CellTable:
    """Rows of `width` float32 numbers for cells [i·resolution, (i+1)·resolution) of the world frame.

    Cells are found by binary search over packed keys, relative to the block of the first cell, so that
    maps far from the origin work too. A key's high bits name a block of 16² or 8³ cells: a file then
    names each block once and spends one bit on each of its cells.
    """

    def __init__(
        self,
        resolution: float,
        dim: int,
        width: int,
        device: torch.device | str | None = None,
        memory_limit: int = MEMORY_LIMIT,
    ) -> None:
        self.resolution = check_resolution(resolution)
        self.dim = dim
        self.memory_limit = memory_limit
        self.anchor: Tensor | None = None
        """Block (D,), int64, that keys are relative to; None until there is a cell."""
        self.keys = torch.empty(0, dtype=torch.int64, device=device)
        """Packed cells (N,), ascending."""
        self.values = torch.zeros(0, width, device=device)
        """The numbers (N, width), float32, in the order of `keys`."""

    @property
    def side(self) -> int:
        """Cells of a block along one axis."""
        return 1 << _LOCAL_BITS[self.dim]

    # -- geometry ---------------------------------------------------------------------------------

    def cells(self, points: Tensor) -> Tensor:
        """Cell (M, D), int64, of each finite point (M, D).

        Raises `InvalidArgumentError` when cells are too many to be counted from the first one.
        """
        cell = (points.double() / self.resolution).floor()
        if cell.shape[0] and self.anchor is None:
            self.anchor = (cell[0] / self.side).floor().long()
        if cell.shape[0] and not bool(self._within(cell).all()):
            raise InvalidArgumentError(
                f"resolution={self.resolution} m cannot index points more than {self._reach:.3g} m from the "
                "first; take a coarser one, or drop stray far points."
            )
        return cell.long()

    def centers(self, rows: Tensor | None = None) -> Tensor:
        """Centres (M, D) of the cells of these rows, or of all, world metres, float64."""
        cells = self._unpack(self.keys if rows is None else self.keys[rows])
        return (cells.double() + 0.5) * self.resolution

    @property
    def _reach(self) -> float:
        """Metres from the first cell up to which cells certainly have a key."""
        return ((1 << (_BLOCK_BITS[self.dim] - 1)) - 2) * self.side * self.resolution

    def _within(self, cells: Tensor) -> Tensor:
        """Which cells (M, D), float64, have a key; infinite ones have none."""
        anchor = self._anchored().double() * self.side
        return ((cells - anchor).abs() * self.resolution < self._reach).all(1)

    def _anchored(self) -> Tensor:
        if self.anchor is None:
            return torch.zeros(self.dim, dtype=torch.int64, device=self.keys.device)
        return self.anchor

    def _pack(self, cells: Tensor) -> Tensor:
        """Key (M,) of each cell (M, D), int64."""
        local_bits, block_bits = _LOCAL_BITS[self.dim], _BLOCK_BITS[self.dim]
        blocks = (cells >> local_bits) - self._anchored() + (1 << (block_bits - 1))
        key = torch.zeros_like(cells[:, 0])
        for axis in range(self.dim):
            key = (key << block_bits) | blocks[:, axis]
        for axis in range(self.dim):
            key = (key << local_bits) | (cells[:, axis] & (self.side - 1))
        return key

    def _unpack(self, keys: Tensor) -> Tensor:
        """Cell (M, D) of each key (M,)."""
        local_bits, block_bits = _LOCAL_BITS[self.dim], _BLOCK_BITS[self.dim]
        columns = []
        for axis in range(self.dim):
            behind = self.dim - 1 - axis
            local = (keys >> (local_bits * behind)) & (self.side - 1)
            block = keys >> (local_bits * self.dim + block_bits * behind) & ((1 << block_bits) - 1)
            block = block - (1 << (block_bits - 1)) + self._anchored()[axis]
            columns.append((block << local_bits) + local)
        return torch.stack(columns, 1)

    # -- rows -------------------------------------------------------------------------------------

    def open(self, cells: Tensor) -> Tensor:
        """Row (M,) of each cell (M, D); cells that had none get one of zeros. Earlier rows may move.

        Raises `MemoryLimitError` when the table would outgrow its limit; it is then as it was.
        """
        keys, inverse = torch.unique(self._pack(cells), return_inverse=True)
        rows, known = self._find(keys)
        if not bool(known.all()):
            n_rows = self.keys.shape[0] + int((~known).sum())
            n_bytes = n_rows * (8 + 4 * self.values.shape[1])
            if n_bytes > self.memory_limit:
                raise MemoryLimitError(
                    f"resolution={self.resolution} m takes {n_rows:,} cells = {n_bytes:,} bytes, above the "
                    f"limit of {self.memory_limit:,}; take a coarser one."
                )
            merged, order = torch.sort(torch.cat([self.keys, keys[~known]]))
            fresh = self.values.new_zeros(n_rows - self.keys.shape[0], self.values.shape[1])
            self.values = torch.cat([self.values, fresh])[order]
            self.keys = merged
            rows, _ = self._find(keys)
        return rows[inverse]

    def find(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Row (M,) of the cell of each point (M, D), and whether it has one (row 0 if not).

        Points may be infinite, or anywhere else.
        """
        cell = (points.double() / self.resolution).floor()
        within = self._within(cell)
        rows, known = self._find(self._pack(torch.where(within[:, None], cell, 0.0).long()))
        known = known & within
        return torch.where(known, rows, 0), known

    def find_cells(self, cells: Tensor) -> tuple[Tensor, Tensor]:
        """Row (M,) of each cell (M, D), int64, and whether it has one (row 0 if not)."""
        within = self._within(cells.double())
        rows, known = self._find(self._pack(torch.where(within[:, None], cells, 0)))
        known = known & within
        return torch.where(known, rows, 0), known

    def _find(self, keys: Tensor) -> tuple[Tensor, Tensor]:
        if self.keys.shape[0] == 0:
            return torch.zeros_like(keys), torch.zeros_like(keys, dtype=torch.bool)
        rows = torch.searchsorted(self.keys, keys).clamp_max(self.keys.shape[0] - 1)
        return rows, self.keys[rows] == keys

    # -- keeping ----------------------------------------------------------------------------------

    def packed(self, kept: Tensor | None = None, prefix: str = "") -> dict[str, Tensor]:
        """Tensors that name the cells of the rows `kept` (N,), or of all: anchor, blocks, one bit a cell."""
        keys = self.keys if kept is None else self.keys[kept]
        bits = _LOCAL_BITS[self.dim] * self.dim
        blocks, inverse = torch.unique(keys >> bits, return_inverse=True)
        marked = torch.zeros(blocks.shape[0], 1 << bits, dtype=torch.bool, device=keys.device)
        marked[inverse, keys & ((1 << bits) - 1)] = True
        return {
            f"{prefix}anchor": self._anchored().clone(),
            f"{prefix}blocks": blocks,
            f"{prefix}cells": torch.from_numpy(np.packbits(marked.cpu().numpy(), axis=1)),
        }

    def fill(self, tensors: Mapping[str, Tensor], path: str | Path, prefix: str = "") -> None:
        """Give the cells that `packed` named rows of zeros. Raises `DataError` if they are damaged."""
        bits, block_bits = _LOCAL_BITS[self.dim] * self.dim, _BLOCK_BITS[self.dim] * self.dim
        anchor = require(tensors, f"{prefix}anchor", (self.dim,), torch.int64, path)
        blocks = require(tensors, f"{prefix}blocks", (None,), torch.int64, path)
        shape = (blocks.shape[0], (1 << bits) // 8)
        packed = require(tensors, f"{prefix}cells", shape, torch.uint8, path)
        marked = torch.from_numpy(np.unpackbits(packed.numpy(), axis=1)).bool()
        ascending = bool((blocks[1:] > blocks[:-1]).all())
        if not ascending or (blocks.numel() and not 0 <= int(blocks[0]) <= int(blocks[-1]) < 1 << block_bits):
            raise DataError(f"{path}: its blocks are not sorted; the file is damaged.")
        if bool((anchor.abs() >= 1 << 48).any()):
            raise DataError(f"{path}: its anchor {anchor.tolist()} is no place; the file is damaged.")
        block, cell = marked.nonzero(as_tuple=True)
        self.anchor = anchor if blocks.numel() else None
        self.keys = (blocks[block] << bits) | cell
        self.values = torch.zeros(self.keys.shape[0], self.values.shape[1])

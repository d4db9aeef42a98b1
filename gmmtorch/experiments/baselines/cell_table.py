"""CellTable: numbers of single cells, on an unbounded lattice; and the base of maps that have one."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import DataError, MemoryLimitError
from gmmtorch.files import require
from gmmtorch.occupancy import MEMORY_LIMIT, SparseLattice, TensorFileMap

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

    def at(self, points: Tensor) -> Tensor:
        """The numbers (M, width) of the cell of each point (M, D), float64; zeros if it has none."""
        if self.keys.shape[0] == 0:
            return points.new_zeros(points.shape[0], self.values.shape[1])
        rows, known = self.find(points)
        return torch.where(known[:, None], self.values[rows].double(), 0.0)

    def find_cells(self, cells: Tensor) -> tuple[Tensor, Tensor]:
        """Row (M,) of each cell (M, D), and whether it has one; row 0 if not."""
        columns = self.columns(cells)
        reachable = self.reachable(columns)
        columns = [torch.where(reachable, column, 0).long() for column in columns]
        rows, known = self.find_keys(self._cell_keys(columns))
        known = known & reachable
        return torch.where(known, rows, 0), known

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


class CellMap(TensorFileMap):
    """A map with two numbers in each cell, of which those from `_first_positive` on are not negative."""

    _content: ClassVar[str]
    """Name of the numbers in files."""
    _first_positive: ClassVar[int] = 0
    resolution: float
    memory_limit: int
    _table: CellTable

    @property
    def device(self) -> torch.device:
        return self._table.keys.device

    def _start(self, dim: int, device: torch.device) -> None:
        self._table = CellTable(self.resolution, dim, 2, device, self.memory_limit)

    def _tensors(self) -> dict[str, Tensor]:
        """The cells, and their numbers as float32."""
        return {**self._table.packed(), self._content: self._table.values}

    def _restore(self, tensors: dict[str, Tensor], path: str | Path) -> None:
        self._table.fill(tensors, path)
        values = require(tensors, self._content, (self._table.keys.shape[0], 2), torch.float32, path)
        if bool((values[:, self._first_positive :] < 0).any()):
            raise DataError(f"{path}: {self._content} contains negative numbers; the file is damaged.")
        self._table.values = values

"""BlockGrid: hits and misses stored only where rays went, in a bounded part of the lattice."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from gmmtorch.errors import DataError, InvalidArgumentError, MemoryLimitError
from gmmtorch.occupancy.grid import MEMORY_LIMIT, check_resolution
from gmmtorch.occupancy.voxels.boxes import Box
from gmmtorch.occupancy.voxels.cell_evidence import CellEvidence

_BITS = 3
_SIDE = 1 << _BITS
_CELLS = _SIDE**3


class BlockGrid:
    """Hits and misses, float32, of the lattice cells in a box, in blocks of 8³ cells.

    A block is stored once evidence falls into it. A table of all the blocks in the box says where:
    a look-up is two gathers. `BlockEvidence` has no bounds, counts in float64 and finds its blocks by
    sorted keys; this one is for robots in bounded worlds. Counts stay exact up to 2²⁴ rays a cell.

    Args:
        resolution: side (m) of the cells.
        box: the cells that can be stored; evidence outside is ignored.

    Raises:
        InvalidArgumentError: a resolution that is not above zero, or a box without cells.
        MemoryLimitError: a box whose table alone is too large.
    """

    def __init__(self, resolution: float, box: Box) -> None:
        self.resolution = check_resolution(resolution)
        shape = box.shape
        if len(shape) != 3 or min(shape) < 1:
            raise InvalidArgumentError(
                f"box from {box.low.tolist()} up to {box.high.tolist()} has no cells; high must exceed low."
            )
        n_blocks = tuple((n - 1 >> _BITS) + 1 for n in shape)
        n_bytes = 4 * math.prod(n_blocks)
        if n_bytes > MEMORY_LIMIT:
            raise MemoryLimitError(
                f"box of {' × '.join(map(str, shape))} cells needs a table of {n_bytes:,} bytes, above the "
                f"limit of {MEMORY_LIMIT:,}; take coarser cells than resolution={resolution} m."
            )
        self.box = Box(box.low.clone(), box.high.clone())
        self._low: list[int] = box.low.tolist()
        self._shape = shape
        self._table = torch.zeros(n_blocks, dtype=torch.int32, device=box.low.device)
        # Block 0 is the empty one: what is not stored, or lies outside, is read from it.
        self._blocks = torch.zeros(0, dtype=torch.int64, device=box.low.device)  # in the table, as stored
        self._counts = torch.zeros(2, 1, _CELLS, device=box.low.device)

    @property
    def n_blocks(self) -> int:
        """Blocks that are stored."""
        return len(self._blocks)

    @property
    def nbytes(self) -> int:
        """Bytes of the table and of the blocks stored, two float32 a cell."""
        return self._table.nbytes + self._blocks.nbytes + 2 * 4 * _CELLS * self.n_blocks

    def inside(self, cells: Tensor) -> Tensor:
        """Which cells (C, 3) lie in the box, (C,) bool."""
        inside = torch.ones_like(cells[:, 0], dtype=torch.bool)
        for axis in range(3):
            local = cells[:, axis] - self._low[axis]
            inside &= (local >= 0) & (local < self._shape[axis])
        return inside

    def add(self, evidence: CellEvidence) -> tuple[Tensor, Tensor]:
        """Add evidence; returns what its cells had before: hits (C,) and misses (C,), float32.

        Cells outside the box are left out, and have 0: `inside` tells which.
        """
        block, local, inside = self._locate(evidence.cells)
        slot = self._table.view(-1).index_select(0, block)
        fresh = block[inside & (slot == 0)]
        if len(fresh):
            self._allocate(fresh)
            slot = self._table.view(-1).index_select(0, block)
        # Cells outside read from the empty block, and write what they read.
        index = torch.where(inside, (slot.long() << 3 * _BITS) | local, 0)
        before = [counts.view(-1).index_select(0, index) for counts in self._counts]
        for counts, old, more in zip(self._counts, before, evidence[1:], strict=True):
            counts.view(-1).index_copy_(0, index, old + torch.where(inside, more, 0.0))
        return before[0], before[1]

    def at(self, cells: Tensor) -> tuple[Tensor, Tensor]:
        """Hits (C,) and misses (C,) of cells (C, 3); 0 where nothing is stored, and outside."""
        block, local, inside = self._locate(cells)
        slot = self._table.view(-1).index_select(0, block)
        index = torch.where(inside, (slot.long() << 3 * _BITS) | local, 0)
        return self._counts[0].view(-1)[index], self._counts[1].view(-1)[index]

    def dense(self, box: Box) -> tuple[Tensor, Tensor]:
        """Hits and misses (nx, ny, nz) of a box; 0 where nothing is stored, and outside."""
        result = self._counts.new_zeros(2, *(max(0, n) for n in box.shape))
        common = Box(torch.maximum(box.low, self.box.low), torch.minimum(box.high, self.box.high))
        if min(common.shape) > 0:
            local = [x - low for x, low in zip(common.low.tolist(), self._low, strict=True)]
            blocks = [
                slice(x >> _BITS, (x + n - 1 >> _BITS) + 1) for x, n in zip(local, common.shape, strict=True)
            ]
            slots = self._table[tuple(blocks)]
            nx, ny, nz = slots.shape
            counts = self._counts.index_select(1, slots.flatten()).view(2, nx, ny, nz, _SIDE, _SIDE, _SIDE)
            counts = counts.permute(0, 1, 4, 2, 5, 3, 6).reshape(2, nx * _SIDE, ny * _SIDE, nz * _SIDE)
            source = [
                slice(x & _SIDE - 1, (x & _SIDE - 1) + n) for x, n in zip(local, common.shape, strict=True)
            ]
            offset = (common.low - box.low).tolist()
            target = [slice(x, x + n) for x, n in zip(offset, common.shape, strict=True)]
            result[(slice(None), *target)] = counts[(slice(None), *source)]
        return result[0], result[1]

    def cells(self) -> CellEvidence:
        """Everything that is stored, the blocks in the order in which they were first seen."""
        counts = self._counts[:, 1 : self.n_blocks + 1].reshape(2, -1)
        flat = (counts > 0).any(0).nonzero().squeeze(1)
        block, local = self._blocks[flat >> 3 * _BITS], flat & _CELLS - 1
        _, ny, nz = self._table.shape
        within = torch.stack([local >> 2 * _BITS, local >> _BITS & _SIDE - 1, local & _SIDE - 1], 1)
        corner = torch.stack([block // (ny * nz), block // nz % ny, block % nz], 1) << _BITS
        return CellEvidence(corner + within + self.box.low, counts[0, flat], counts[1, flat])

    def state(self) -> dict[str, Any]:
        """What `restore` needs to answer as now."""
        counts = self._counts[:, 1 : self.n_blocks + 1].clone()
        return {
            "resolution": self.resolution,
            "low": self.box.low.clone(),
            "high": self.box.high.clone(),
            "blocks": self._blocks.clone(),
            "hits": counts[0],
            "misses": counts[1],
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Take the place of the grid whose `state` is given; raises `DataError` if that is another box."""
        same_box = torch.equal(state["low"], self.box.low) and torch.equal(state["high"], self.box.high)
        if not same_box or state["resolution"] != self.resolution:
            raise DataError(
                f"The state is of cells {state['low'].tolist()} to {state['high'].tolist()} of "
                f"{state['resolution']} m; this grid has {self.box.low.tolist()} to "
                f"{self.box.high.tolist()} of {self.resolution} m. Restore it into a grid made alike."
            )
        blocks = state["blocks"]
        if len(blocks) and not 0 <= int(blocks.min()) <= int(blocks.max()) < self._table.numel():
            raise DataError("The state's blocks lie outside its box: it is damaged.")
        self._blocks = blocks.to(self._table.device).clone()
        self._table.zero_()
        self._table.view(-1)[self._blocks] = torch.arange(
            1, len(blocks) + 1, dtype=torch.int32, device=self._table.device
        )
        self._counts = self._counts.new_zeros(2, len(blocks) + 1, _CELLS)
        self._counts[0, 1:], self._counts[1, 1:] = state["hits"], state["misses"]

    def _locate(self, cells: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Block in the table (C,) and cell in the block (C,), and which (C,) lie in the box; 0 outside."""
        x, y, z = (cells[:, axis] - self._low[axis] for axis in range(3))
        (nx, ny, nz), (_, by, bz) = self._shape, self._table.shape
        inside = (x >= 0) & (x < nx) & (y >= 0) & (y < ny) & (z >= 0) & (z < nz)
        block = ((x >> _BITS) * by + (y >> _BITS)) * bz + (z >> _BITS)
        mask = _SIDE - 1
        local = (x & mask) << 2 * _BITS | (y & mask) << _BITS | z & mask
        return torch.where(inside, block, 0), torch.where(inside, local, 0), inside

    def _allocate(self, blocks: Tensor) -> None:
        """Store blocks (M,) of the table, none of which is yet; they may repeat."""
        blocks = blocks.unique()
        used = self.n_blocks + 1
        needed = used + len(blocks)
        if needed > self._counts.shape[1]:
            grown = self._counts.new_zeros(2, max(needed, self._counts.shape[1] * 3 // 2), _CELLS)
            grown[:, :used] = self._counts[:, :used]
            self._counts = grown
        self._table.view(-1)[blocks] = torch.arange(used, needed, dtype=torch.int32, device=blocks.device)
        self._blocks = torch.cat([self._blocks, blocks])

"""BlockEvidence: hits and misses stored only where rays went, on an unbounded voxel lattice.

The lattice is cut into blocks of 8³ cells (16² in 2D). A block is allocated when a ray first
touches it: memory follows observed space, not the bounding box. (While rays are cast there is also a
table of the blocks in the box around those rays, 8 bytes each.)
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, MemoryLimitError
from gmmtorch.occupancy.evidence import Evidence, occupancy_probability
from gmmtorch.occupancy.grid import BYTES_PER_CELL, MEMORY_LIMIT, VoxelGrid, check_resolution
from gmmtorch.occupancy.voxels.ray_traversal import CHUNK_VISITS, traverse

_BLOCK_BITS = {2: 4, 3: 3}
_KEY_BITS = {2: 31, 3: 21}  # of one block coordinate within a packed int64 key


class _Window(NamedTuple):
    """The box of blocks that a bundle of rays can touch, and its table of slots."""

    low: Tensor  # (D,) lowest block coordinate
    bits: tuple[int, ...]  # bits of the block coordinate along each axis, within the window
    offsets: Tensor  # flat table, block in window → storage index of its first cell


class _Full(Exception):  # noqa: N818  # never leaves this file
    """The blocks do not fit the memory limit."""


class BlockEvidence:
    """Hits and misses on the lattice of cells [i·resolution, (i+1)·resolution) of the world frame.

    Raises `InvalidArgumentError` for a resolution that is not above zero, and `MemoryLimitError`
    when the observed cells would take more than `memory_limit` bytes; the rays at hand are then
    counted in part, and more cannot be.
    """

    def __init__(
        self,
        resolution: float,
        dim: int,
        device: torch.device | str | None = None,
        memory_limit: int = MEMORY_LIMIT,
        compiled: bool = False,
    ) -> None:
        self.resolution = check_resolution(resolution)
        self.dim = dim
        self.block_side = 1 << _BLOCK_BITS[dim]
        self.cells_per_block = self.block_side**dim
        self.memory_limit = memory_limit
        self.compiled = compiled  # see `traverse`
        self.anchor: Tensor | None = None
        """Block coordinates (D,) that keys are relative to, near the first ray: maps far out work too."""
        self.keys = torch.empty(0, dtype=torch.int64, device=device)
        """Packed coordinates of the blocks, sorted: (B,)."""
        self._slots = torch.empty(0, dtype=torch.int64, device=device)  # where each is stored
        self._storage = torch.zeros(2, 0, self.cells_per_block, dtype=torch.float64, device=device)

    @property
    def n_blocks(self) -> int:
        return self.keys.shape[0]

    @property
    def hits(self) -> Tensor:
        """Hits (B, cells) of each block, in the order they were allocated."""
        return self._storage[0, : self.n_blocks]

    @property
    def misses(self) -> Tensor:
        """Misses (B, cells) of each block, in the order they were allocated."""
        return self._storage[1, : self.n_blocks]

    # -- geometry ---------------------------------------------------------------------------------

    def _anchored(self) -> Tensor:
        return torch.zeros(self.dim, dtype=torch.int64) if self.anchor is None else self.anchor

    def _cells(self, points: Tensor) -> Tensor:
        """Lattice cell (M, D) of each point, float64."""
        return (points.double() / self.resolution).floor()

    def pack(self, blocks: Tensor) -> Tensor:
        """Keys (M,) of anchored block coordinates (M, D), int64; ordered as the coordinates are."""
        half = 1 << (_KEY_BITS[self.dim] - 1)
        if blocks.numel() and int(blocks.abs().max()) >= half:
            raise InvalidArgumentError(
                f"resolution={self.resolution} m cannot index points "
                f"{half * self.block_side * self.resolution:.3g} m from the first scan; take a coarser one."
            )
        key = blocks[:, 0] + half
        for axis in range(1, self.dim):
            key = (key << _KEY_BITS[self.dim]) | (blocks[:, axis] + half)
        return key

    def unpack(self, keys: Tensor) -> Tensor:
        """Anchored block coordinates (M, D) of keys (M,)."""
        bits, half = _KEY_BITS[self.dim], 1 << (_KEY_BITS[self.dim] - 1)
        columns = [
            ((keys >> (bits * (self.dim - 1 - a))) & ((1 << bits) - 1)) - half for a in range(self.dim)
        ]
        return torch.stack(columns, 1)

    def _find(self, keys: Tensor) -> Tensor:
        """Slot (M,) of each key, −1 where the block is not allocated."""
        if self.keys.numel() == 0:
            return torch.full_like(keys, -1)
        rank = torch.searchsorted(self.keys, keys).clamp_max(self.keys.numel() - 1)
        return torch.where(self.keys[rank] == keys, self._slots[rank], -1)

    def _locate(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Flat storage index (M,) of the cell of each point, and whether it is stored (index 0 if not).

        Points that are not finite, or too far out to have a key, are not stored.
        """
        bits = _BLOCK_BITS[self.dim]
        cells = self._cells(points) - self._anchored() * self.block_side
        limit = float(1 << (_KEY_BITS[self.dim] - 1 + bits))
        valid = (cells.abs() < limit - self.block_side).all(1)  # NaN compares false
        cells = torch.where(valid[:, None], cells, 0.0).long()
        slot = self._find(self.pack(cells >> bits))
        local = torch.zeros_like(slot)
        for axis in range(self.dim):
            local = (local << bits) | (cells[:, axis] & (self.block_side - 1))
        stored = valid & (slot >= 0)
        return torch.where(stored, slot * self.cells_per_block + local, 0), stored

    # -- counting ---------------------------------------------------------------------------------

    def add_rays(
        self,
        origins: Tensor,
        ends: Tensor,
        weights: Tensor | None = None,
        is_hit: Tensor | None = None,
        chunk_visits: int = CHUNK_VISITS,
    ) -> None:
        """Count rays: a hit in the cell of each end, a miss in every cell passed on the way to it.

        Args and meaning as in `Evidence.add_rays`.
        """
        if ends.shape[0] == 0:
            return
        earlier = self.n_blocks
        try:
            window = self._open_window(origins, ends)
            self._add_misses(window, origins, ends, weights, chunk_visits)
        except _Full:
            needed = self._bytes_needed(origins, ends, self.resolution, earlier)
            raise MemoryLimitError(
                f"resolution={self.resolution} m takes {needed:,} bytes for the cells that rays touch, above "
                f"the limit of {self.memory_limit:,}; a resolution of "
                f"{self._fitting_resolution(origins, ends, earlier):.3g} m fits."
            ) from None
        index, stored = self._locate(ends)
        counted = stored if is_hit is None else stored & is_hit
        source = torch.ones_like(index, dtype=torch.float64) if weights is None else weights.double()
        self.hits.view(-1).scatter_add_(0, index[counted], source[counted])

    def _fitting_resolution(self, origins: Tensor, ends: Tensor, earlier: int) -> float:
        """A coarser resolution, of three digits, at which the blocks that these rays touch fit."""
        resolution = self.resolution
        while self._bytes_needed(origins, ends, resolution, earlier) > self.memory_limit:
            resolution = float(f"{resolution * 1.3:.3g}")
        return resolution

    def _bytes_needed(self, origins: Tensor, ends: Tensor, resolution: float, earlier: int) -> int:
        """Bytes, at most, of the blocks that these rays touch at a resolution, and of `earlier` ones."""
        side = resolution * self.block_side
        starts, stops = origins.double() / side, ends.double() / side
        both = torch.cat([starts, stops]).floor()
        low = both.amin(0)
        shape = tuple((both.amax(0) - low + 1).long().tolist())
        touched = torch.zeros(math.prod(shape), dtype=torch.bool, device=low.device)
        for visit in traverse(starts, stops, shape, low=low):
            touched[visit.voxel] = True
        # The end blocks come on top; earlier blocks shrink at least in proportion.
        n_ends = torch.unique(stops.floor(), dim=0).shape[0]
        n_earlier = math.ceil(earlier * self.resolution / resolution)
        return (int(touched.sum()) + n_ends + n_earlier) * self.cells_per_block * BYTES_PER_CELL

    def _open_window(self, origins: Tensor, ends: Tensor) -> _Window:
        """The box of blocks around the rays, with the blocks that they end in allocated."""
        side = self.block_side
        starts, stops = self._cells(origins), self._cells(ends)
        low = torch.minimum(starts.amin(0), stops.amin(0)).div(side).floor()
        high = torch.maximum(starts.amax(0), stops.amax(0)).div(side).floor()
        shape = (high - low + 1).long().tolist()
        bits = tuple((n - 1).bit_length() for n in shape)
        n_bytes = 8 << sum(bits)
        if n_bytes > self.memory_limit:
            raise MemoryLimitError(
                f"resolution={self.resolution} m over rays that span {[n * side for n in shape]} cells needs "
                f"a table of {n_bytes:,} bytes, above the limit of {self.memory_limit:,}; a resolution of "
                f"{self.resolution * (n_bytes / self.memory_limit) ** (1 / self.dim) * 1.02:.3g} m or more "
                "fits, or set dataset.max_range to drop stray far returns."
            )
        if self.anchor is None:
            self.anchor = low.long()
        window = _Window(low, bits, torch.full((1 << sum(bits),), -1, device=low.device))
        block = (stops.div(side).floor() - low).long()
        index = (block * torch.tensor(_power_of_two_strides(bits), device=low.device)).sum(1)
        touched = torch.zeros(1 << sum(bits), dtype=torch.bool, device=low.device)
        touched[index] = True
        self._open_blocks(window, touched.nonzero().squeeze(1))
        return window

    def _open_blocks(self, window: _Window, index: Tensor) -> None:
        """Allocate blocks (M,) of the window's table, distinct, and enter where they are stored."""
        fields = _fields(window.bits)
        blocks = torch.stack([(index >> shift) & ((1 << width) - 1) for shift, width in fields], 1)
        keys = self.pack(blocks + window.low.long() - self._anchored())
        self._allocate(keys)
        window.offsets[index] = self._find(keys) * self.cells_per_block

    def _allocate(self, keys: Tensor) -> None:
        """Make room for the blocks `keys` that are not there yet."""
        fresh = keys[self._find(keys) < 0]
        if fresh.numel() == 0:
            return
        fresh = fresh.unique()
        n_blocks = self.n_blocks + fresh.numel()
        n_bytes = n_blocks * self.cells_per_block * BYTES_PER_CELL
        if n_bytes > self.memory_limit:
            raise _Full
        if n_blocks > self._storage.shape[1]:
            # Grow by half again, so that many small insertions stay cheap.
            largest = self.memory_limit // (self.cells_per_block * BYTES_PER_CELL)
            capacity = max(n_blocks, min(self._storage.shape[1] * 3 // 2, largest))
            grown = self._storage.new_zeros(2, capacity, self.cells_per_block)
            grown[:, : self.n_blocks] = self._storage[:, : self.n_blocks]
            self._storage = grown
        new_slots = torch.arange(self.n_blocks, n_blocks, device=keys.device)
        self.keys, order = torch.sort(torch.cat([self.keys, fresh]))
        self._slots = torch.cat([self._slots, new_slots])[order]

    def _add_misses(
        self, window: _Window, origins: Tensor, ends: Tensor, weights: Tensor | None, chunk_visits: int
    ) -> None:
        local_bits, side = _BLOCK_BITS[self.dim], self.block_side
        # Cell indices are packed into powers of two, so that bit fields give block and cell.
        bits = tuple(b + local_bits for b in window.bits)
        shape = tuple(1 << b for b in bits)
        # In lattice units, not relative to the window: every cell is the one that a query would name.
        starts, stops = origins.double() / self.resolution, ends.double() / self.resolution
        low = window.low * side
        ones = torch.ones((), dtype=torch.float64, device=starts.device)
        weight = None if weights is None else weights.double()
        split = _compiled_split() if self.compiled else _split
        strides = _power_of_two_strides(bits)
        for visit in traverse(starts, stops, shape, chunk_visits, strides, self.compiled, low):
            block, local = split(visit.voxel, window.bits, local_bits)
            offset = window.offsets.index_select(0, block)
            if int(offset.min()) < 0:
                self._open_blocks(window, block[offset < 0].long().unique())
                offset = window.offsets.index_select(0, block)
            source = ones.expand(offset.shape) if weight is None else weight[visit.ray]
            self._storage[1].view(-1).scatter_add_(0, offset.add_(local), source)

    def fill(self, anchor: Tensor, keys: Tensor, observed: Tensor, hits: Tensor, misses: Tensor) -> None:
        """Set the cells marked in `observed` (B, cells), blocks in order of `keys`, of an empty lattice."""
        self.anchor = anchor
        self._allocate(keys)
        self.hits[observed] = hits
        self.misses[observed] = misses

    def in_key_order(self) -> tuple[Tensor, Tensor]:
        """Hits and misses (B, cells) with the blocks in the order of `keys`."""
        return self.hits[self._slots], self.misses[self._slots]

    # -- reading ----------------------------------------------------------------------------------

    def evidence_at(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Hits (M,) and misses (M,) of the cells that hold the points (M, D); 0 where no ray went."""
        if self.keys.numel() == 0:
            zero = torch.zeros(points.shape[0], dtype=torch.float64, device=points.device)
            return zero, zero.clone()
        index, stored = self._locate(points)
        return self.hits.view(-1)[index] * stored, self.misses.view(-1)[index] * stored

    def lookup(self, points: Tensor, prior: float = 1.0) -> Tensor:
        """Occupancy (M,) of the cells that hold the points (M, D); exactly ½ where no ray went."""
        return occupancy_probability(*self.evidence_at(points), prior)

    def dense(self, grid: VoxelGrid) -> Evidence:
        """The evidence of a grid of lattice cells, as `VoxelGrid.covering` makes them."""
        offset = [x / self.resolution for x in grid.origin]
        aligned = all(abs(x - round(x)) < 1e-6 for x in offset)
        if grid.dim != self.dim or not aligned or not math.isclose(grid.resolution, self.resolution):
            raise InvalidArgumentError(
                f"grid has cells of {grid.resolution} m from {grid.origin}, which are not the lattice's of "
                f"{self.resolution} m; make it with VoxelGrid.covering."
            )
        hits, misses = self.evidence_at(grid.centers(self.keys.device))
        return Evidence(grid, hits.reshape(grid.shape), misses.reshape(grid.shape))

    def bounds(self) -> tuple[Tensor, Tensor]:
        """Lowest and highest corner (D,) of the allocated blocks, world metres."""
        blocks = self.unpack(self.keys) + self._anchored()
        size = self.block_side * self.resolution
        return blocks.amin(0) * size, (blocks.amax(0) + 1) * size


def _split(voxel: Tensor, block_bits: tuple[int, ...], local_bits: int) -> tuple[Tensor, Tensor]:
    """Block in the window's table, and cell in the block, (V,) each, of packed cell indices: each
    axis's field is cut into block bits and cell bits, and either sort is gathered."""
    bits = tuple(b + local_bits for b in block_bits)
    packed = voxel.int() if sum(bits) < 31 else voxel
    side_mask = (1 << local_bits) - 1
    block, local = packed >> local_bits & ((1 << block_bits[-1]) - 1), packed & side_mask
    for axis in range(len(bits) - 2, -1, -1):
        shift, width = _fields(bits)[axis][0], block_bits[axis]
        above = sum(block_bits[axis + 1 :])
        block = block | ((packed >> (shift + local_bits - above)) & (((1 << width) - 1) << above))
        place = local_bits * (len(bits) - 1 - axis)
        local = local | ((packed >> (shift - place)) & (side_mask << place))
    return block, local


@functools.cache
def _compiled_split() -> Callable[..., tuple[Tensor, Tensor]]:
    compiled: Callable[..., tuple[Tensor, Tensor]] = torch.compile(_split, dynamic=True)
    return compiled


def _power_of_two_strides(bits: tuple[int, ...]) -> list[int]:
    return [1 << shift for shift, _ in _fields(bits)]


def _fields(bits: tuple[int, ...]) -> list[tuple[int, int]]:
    """(shift, width) of each axis in a packed index, the last axis lowest."""
    return [(sum(bits[axis + 1 :]), bits[axis]) for axis in range(len(bits))]

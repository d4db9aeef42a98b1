"""Counting of rays into a `SparseEvidence`, which finds the visited cells by a table of the rays' blocks."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from gmmtorch.errors import MemoryLimitError
from gmmtorch.occupancy.grid import BYTES_PER_CELL
from gmmtorch.occupancy.voxels.ray_traversal import traverse

if TYPE_CHECKING:
    from gmmtorch.occupancy.voxels.sparse_evidence import SparseEvidence


def count_misses(
    store: SparseEvidence, origins: Tensor, ends: Tensor, weights: Tensor | None, chunk_visits: int
) -> None:
    """Add one miss to each cell that a ray passes through and leaves, and store the blocks of all ends.

    Arguments as in `Evidence.add_rays`. Raises `MemoryLimitError` if the blocks that the rays touch exceed
    the memory limit of the store; the message names a resolution that fits.
    """
    earlier = store.n_blocks
    table = _BlockTable(store, origins, ends)
    try:
        table.open_ends(ends)
        table.count(origins, ends, weights, chunk_visits)
    except MemoryLimitError:
        needed = _bytes_needed(store, origins, ends, store.resolution, earlier)
        raise MemoryLimitError(
            f"resolution={store.resolution} m takes {needed:,} bytes for the cells that rays touch, above "
            f"the limit of {store.memory_limit:,}; a resolution of "
            f"{_fitting_resolution(store, origins, ends, earlier):.3g} m fits."
        ) from None


class _BlockTable:
    """The box of blocks that rays can touch, and the storage index of the first cell of each.

    Sides of the box are padded to powers of two: then bit fields of a packed cell index give its block and
    its place in the block.
    """

    def __init__(self, store: SparseEvidence, origins: Tensor, ends: Tensor) -> None:
        self.store, side = store, store.block_side
        starts, stops = store.cells_of(origins), store.cells_of(ends)
        self.low = torch.minimum(starts.amin(0), stops.amin(0)).div(side).floor()  # (D,) lowest block
        high = torch.maximum(starts.amax(0), stops.amax(0)).div(side).floor()
        shape = (high - self.low + 1).long().tolist()
        self.bits = tuple((n - 1).bit_length() for n in shape)  # of the block coordinate along each axis
        n_bytes = 8 << sum(self.bits)
        if n_bytes > store.memory_limit:
            cells = [n * side for n in shape]
            fits = store.resolution * (n_bytes / store.memory_limit) ** (1 / store.dim) * 1.02
            raise MemoryLimitError(
                f"resolution={store.resolution} m over rays that span {cells} cells needs a table of "
                f"{n_bytes:,} bytes, above the limit of {store.memory_limit:,}; a resolution of {fits:.3g} m "
                "or more fits, or set dataset.max_range to drop stray far returns."
            )
        store.check_reachable(torch.stack([self.low, high]) * side)
        self.first = torch.full((1 << sum(self.bits),), -1, device=self.low.device)

    def open_ends(self, ends: Tensor) -> None:
        """Store the blocks of the ends of rays."""
        block = (self.store.cells_of(ends).div(self.store.block_side).floor() - self.low).long()
        index = (block * torch.tensor(_strides(self.bits), device=block.device)).sum(1)
        touched = torch.zeros_like(self.first, dtype=torch.bool)
        touched[index] = True
        self._open(touched.nonzero().squeeze(1))

    def _open(self, index: Tensor) -> None:
        """Store blocks (M,) of the table, distinct, and enter the storage index of their first cells."""
        fields = _fields(self.bits)
        blocks = torch.stack([(index >> shift) & ((1 << width) - 1) for shift, width in fields], 1)
        cells = (blocks + self.low.long()) * self.store.block_side
        self.first[index] = self.store.open_blocks(self.store.block_keys(self.store.columns(cells)))

    def count(self, origins: Tensor, ends: Tensor, weights: Tensor | None, chunk_visits: int) -> None:
        """Add the misses."""
        store, local_bits = self.store, self.store.local_bits
        bits = tuple(b + local_bits for b in self.bits)
        # In cells of the lattice, not relative to the table: the traversal finds the same cells as a query.
        starts, stops = origins.double() / store.resolution, ends.double() / store.resolution
        ones = torch.ones((), dtype=store.counts.dtype, device=starts.device)
        weight = None if weights is None else weights.to(ones)
        split = _compiled_split() if store.compiled else _split
        visits = traverse(
            starts,
            stops,
            tuple(1 << b for b in bits),
            chunk_visits,
            _strides(bits),
            store.compiled,
            self.low * store.block_side,
        )
        for visit in visits:
            block, place = split(visit.voxel, self.bits, local_bits)
            first = self.first.index_select(0, block)
            if int(first.min()) < 0:
                self._open(block[first < 0].long().unique())
                first = self.first.index_select(0, block)
            source = ones.expand(first.shape) if weight is None else weight[visit.ray]
            store.counts[1].view(-1).scatter_add_(0, first.add_(place), source)


def _bytes_needed(
    store: SparseEvidence, origins: Tensor, ends: Tensor, resolution: float, earlier: int
) -> int:
    """Upper bound of the bytes of the blocks that rays touch at a resolution, and of `earlier` blocks."""
    side = resolution * store.block_side
    starts, stops = origins.double() / side, ends.double() / side
    blocks = torch.cat([starts, stops]).floor()
    low = blocks.amin(0)
    shape = tuple((blocks.amax(0) - low + 1).long().tolist())
    touched = torch.zeros(math.prod(shape), dtype=torch.bool, device=low.device)
    for visit in traverse(starts, stops, shape, low=low):
        touched[visit.voxel] = True
    # The traversal leaves out the blocks of the ends. Earlier blocks shrink at least in proportion.
    n_ends = torch.unique(stops.floor(), dim=0).shape[0]
    n_earlier = math.ceil(earlier * store.resolution / resolution)
    return (int(touched.sum()) + n_ends + n_earlier) * store.cells_per_block * BYTES_PER_CELL


def _fitting_resolution(store: SparseEvidence, origins: Tensor, ends: Tensor, earlier: int) -> float:
    """A coarser resolution, rounded to three digits, at which the blocks that these rays touch fit."""
    resolution = store.resolution
    while _bytes_needed(store, origins, ends, resolution, earlier) > store.memory_limit:
        resolution = float(f"{resolution * 1.3:.3g}")
    return resolution


def _split(voxel: Tensor, block_bits: tuple[int, ...], local_bits: int) -> tuple[Tensor, Tensor]:
    """Block in the table, and place in the block, (V,) each, of packed cell indices (V,).

    The field of each axis is cut into block bits and local bits; each kind is packed anew.
    """
    bits = tuple(b + local_bits for b in block_bits)
    packed = voxel.int() if sum(bits) < 31 else voxel
    side_mask = (1 << local_bits) - 1
    block, place = packed >> local_bits & ((1 << block_bits[-1]) - 1), packed & side_mask
    for axis in range(len(bits) - 2, -1, -1):
        shift, width = _fields(bits)[axis][0], block_bits[axis]
        above = sum(block_bits[axis + 1 :])
        block = block | ((packed >> (shift + local_bits - above)) & (((1 << width) - 1) << above))
        low = local_bits * (len(bits) - 1 - axis)
        place = place | ((packed >> (shift - low)) & (side_mask << low))
    return block, place


@functools.cache
def _compiled_split() -> Callable[..., tuple[Tensor, Tensor]]:
    compiled: Callable[..., tuple[Tensor, Tensor]] = torch.compile(_split, dynamic=True)
    return compiled


def _strides(bits: tuple[int, ...]) -> list[int]:
    return [1 << shift for shift, _ in _fields(bits)]


def _fields(bits: tuple[int, ...]) -> list[tuple[int, int]]:
    """(shift, width) of each axis in a packed index; the last axis is lowest."""
    return [(sum(bits[axis + 1 :]), bits[axis]) for axis in range(len(bits))]

"""Counting of rays into a `SparseEvidence`, which finds the visited cells by a table of the rays' blocks."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from gmmtorch.errors import MemoryLimitError
from gmmtorch.kernels.rays.ray_counting import BlockTable, count_in_blocks, packed_strides
from gmmtorch.kernels.rays.ray_traversal import traverse
from gmmtorch.occupancy.grid import BYTES_PER_CELL

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
    table = _Blocks(store, origins, ends)
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


class _Blocks:
    """The box of blocks that rays can touch, and the storage index of the first cell of each."""

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
        index = (block * torch.tensor(packed_strides(self.bits), device=block.device)).sum(1)
        touched = torch.zeros_like(self.first, dtype=torch.bool)
        touched[index] = True
        self._open(touched.nonzero().squeeze(1))

    def _open(self, index: Tensor) -> None:
        """Store blocks (M,) of the table, distinct, and enter the storage index of their first cells."""
        size = torch.tensor([1 << width for width in self.bits], device=index.device)
        blocks = index[:, None] // torch.tensor(packed_strides(self.bits), device=index.device) % size
        cells = (blocks + self.low.long()) * self.store.block_side
        self.first[index] = self.store.open_blocks(self.store.block_keys(self.store.columns(cells)))

    def count(self, origins: Tensor, ends: Tensor, weights: Tensor | None, chunk_visits: int) -> None:
        """Add the misses."""
        store = self.store
        # In cells of the lattice, not relative to the table: the traversal finds the same cells as a query.
        starts, stops = origins.double() / store.resolution, ends.double() / store.resolution
        table = BlockTable(self.first, self.low, self.bits, store.local_bits, self._open)
        count_in_blocks(
            lambda: store.counts[1].view(-1),
            table,
            starts,
            stops,
            weights,
            chunk_visits=chunk_visits,
            compiled=store.compiled,
        )


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

"""Counting of rays into a `SparseEvidence`, which finds the visited cells by a table of the rays' blocks."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from gmmtorch.errors import MemoryLimitError
from gmmtorch.kernels import BlockTable, count_in_blocks, packed_strides, traverse
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
    table = _empty_table(store, origins, ends)
    try:
        block = (store.cells_of(ends).div(store.block_side).floor() - table.low).long()
        index = (block * torch.tensor(packed_strides(table.bits), device=block.device)).sum(1)
        touched = torch.zeros_like(table.first, dtype=torch.bool)
        touched[index] = True
        table.open(touched.nonzero().squeeze(1))
        # In cells of the lattice, not relative to the table: the traversal finds the same cells as a query.
        count_in_blocks(
            lambda: store.counts[1].view(-1),
            table,
            origins.double() / store.resolution,
            ends.double() / store.resolution,
            weights,
            chunk_visits=chunk_visits,
            compiled=store.compiled,
        )
    except MemoryLimitError:
        needed = _bytes_needed(store, origins, ends, store.resolution, earlier)
        raise MemoryLimitError(
            f"resolution={store.resolution} m takes {needed:,} bytes for the cells that rays touch, above "
            f"the limit of {store.memory_limit:,}; a resolution of "
            f"{_fitting_resolution(store, origins, ends, earlier):.3g} m fits."
        ) from None


def _empty_table(store: SparseEvidence, origins: Tensor, ends: Tensor) -> BlockTable:
    """The table of the box of blocks that rays can touch. It opens blocks in the store."""
    side = store.block_side
    cells = torch.cat([store.cells_of(origins), store.cells_of(ends)])
    low, high = (corner.div(side).floor() for corner in (cells.amin(0), cells.amax(0)))
    shape = (high - low + 1).long().tolist()
    bits = tuple((n - 1).bit_length() for n in shape)
    n_bytes = 8 << sum(bits)
    if n_bytes > store.memory_limit:
        fits = store.resolution * (n_bytes / store.memory_limit) ** (1 / store.dim) * 1.02
        raise MemoryLimitError(
            f"resolution={store.resolution} m over rays that span {[n * side for n in shape]} cells needs a "
            f"table of {n_bytes:,} bytes, above the limit of {store.memory_limit:,}; a resolution of "
            f"{fits:.3g} m or more fits, or set ‹max_range› to drop stray far returns."
        )
    store.check_reachable(torch.stack([low, high]) * side)
    first = torch.full((1 << sum(bits),), -1, device=low.device)

    def open_blocks(index: Tensor) -> None:
        size = torch.tensor([1 << width for width in bits], device=index.device)
        blocks = index[:, None] // torch.tensor(packed_strides(bits), device=index.device) % size
        cells = (blocks + low.long()) * side
        first[index] = store.open_blocks(store.block_keys(store.columns(cells)))

    return BlockTable(first, low, bits, store.local_bits, open_blocks)


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

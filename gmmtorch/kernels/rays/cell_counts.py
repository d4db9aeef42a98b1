"""Cells of dense blocks and of sparse stores: listed with their counts, found, and added to."""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.kernels.choice import is_fused
from gmmtorch.kernels.compiler import FusedKernel

_RUN = 256  # cells of an item on a CPU
_INDEX_RUN = 1 << 10  # of one that searches again only where the block changes

_BLOCK_BITS = 3
"""Cells are listed by blocks of 8³ cells, as sparse stores keep them: neighbours stay together in memory."""

_SOURCE = "rays/cell_counts.h"
_LIST = FusedKernel(_SOURCE, "list_counted_cells")
_ADD = FusedKernel(_SOURCE, "add_counts")
_FLAGS = FusedKernel(_SOURCE, "flags_of_cells")
_INDEX = FusedKernel(_SOURCE, "cell_index")


def list_counted_cells(low: Tensor, hits: Tensor, misses: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The C cells with hits or misses of a dense array (nx, ny, nz), by blocks; row-major in each.

    Args:
        low: (3,) int64, the lowest cell. hits, misses: float64.

    Returns cells (C, 3) int64, hits (C,) and misses (C,), float32.
    """
    device = hits.device
    n_blocks = [(n - 1 >> _BLOCK_BITS) + 2 for n in hits.shape]  # one more, because `low` may cut a block
    if not (is_fused(low, hits, misses) and hits.dtype == misses.dtype == torch.float64):
        cells = ((hits > 0) | (misses > 0)).nonzero()
        x, y, z = ((cells + low >> _BLOCK_BITS) - (low >> _BLOCK_BITS)).unbind(1)
        cells = cells[((x * n_blocks[1] + y) * n_blocks[2] + z).argsort(stable=True)]
        some = [counts[cells.unbind(1)].float() for counts in (hits, misses)]
        return cells + low, some[0], some[1]
    given = *hits.shape, *n_blocks[1:], _BLOCK_BITS, hits.contiguous(), misses.contiguous(), low.contiguous()
    n_items = math.prod(n_blocks)
    in_block = torch.empty(n_items, dtype=torch.int64, device=device)
    _LIST(n_items, *given, in_block, None, None, None, device=device)
    until = torch.cumsum(in_block, 0)
    n = int(until[-1])
    cells = torch.empty(n, 3, dtype=torch.int64, device=device)
    listed = torch.empty(2, n, device=device)
    _LIST(n_items, *given, until - in_block, cells, listed[0], listed[1], device=device)
    return cells, listed[0], listed[1]


def add_counts(counts: Tensor, index: Tensor, hits: Tensor, misses: Tensor) -> tuple[Tensor, Tensor]:
    """Adds hits (C,) and misses (C,) to counts (2, …) at distinct places; returns those before, (C,) each.

    Args:
        counts: contiguous, changed in place. index: (C,) int64, flat in counts[0]; nothing is added at 0.

    The fused kernel, for float32, and its twin give equal counts.
    """
    n = len(index)
    if is_fused(counts, index, hits, misses) and counts.dtype == hits.dtype == misses.dtype == torch.float32:
        before = torch.empty(2, n, device=counts.device)
        run = _RUN if counts.device.type == "cpu" else 1
        more = index.contiguous(), hits.contiguous(), misses.contiguous()
        _ADD(-(-n // run), n, run, *more, counts[0].numel(), counts, before, device=counts.device)
        return before[0], before[1]
    inside = index > 0
    olds = [part.view(-1).index_select(0, index) for part in counts]
    for part, old, added in zip(counts, olds, (hits, misses), strict=True):
        part.view(-1).index_copy_(0, index, old + torch.where(inside, added, 0.0).to(old.dtype))
    return olds[0], olds[1]


def flags_of_cells(cells: Tensor, low: Tensor, flags: Tensor) -> Tensor:
    """The flags (C,) bool of cells (C, 3) int64 in a block (nx, ny, nz), bool; False outside.

    Args:
        low: (3,) int64, the lowest cell of the block.
    """
    nx, ny, nz = flags.shape
    if is_fused(cells, low, flags):
        n, found = len(cells), torch.empty_like(cells[:, 0], dtype=torch.bool)
        run = _RUN if cells.device.type == "cpu" else 1
        given = cells.contiguous(), low.contiguous(), nx, ny, nz, flags.contiguous()
        _FLAGS(-(-n // run), n, run, *given, found, device=cells.device)
        return found
    x, y, z = (cells - low).unbind(1)
    inside = (x >= 0) & (x < nx) & (y >= 0) & (y < ny) & (z >= 0) & (z < nz)
    return inside & flags.reshape(-1)[torch.where(inside, (x * ny + y) * nz + z, 0)]


class BlockKeys(NamedTuple):
    """The index of a sparse store.

    keys: (B,) int64, ascending. slots: (B,) int64, places of the blocks. bounds: (3, D) int64: lowest cell
    of the block that keys are relative to, then low and high of the cells that can be stored. local_bits: of
    a cell in its block along an axis. axis_bits: of a block in a key along an axis.
    """

    keys: Tensor
    slots: Tensor
    bounds: Tensor
    local_bits: int
    axis_bits: int


def cell_index(cells: Tensor, blocks: BlockKeys) -> Tensor:
    """Flat index (C,) int64 of cells (C, D) in the slots; −1 in blocks that are not stored, 0 out of bounds.

    The fused kernel and its twin give equal indices.
    """
    if is_fused(cells, blocks.keys, blocks.bounds):
        run = _INDEX_RUN if cells.device.type == "cpu" else 1
        index, (n, dim) = torch.empty_like(cells[:, 0]), cells.shape
        table = (
            blocks.keys.contiguous(),
            blocks.slots.contiguous(),
            len(blocks.keys),
            blocks.bounds.contiguous(),
        )
        bits = blocks.local_bits, blocks.axis_bits
        _INDEX(-(-n // run), cells.contiguous(), n, dim, run, *table, *bits, index, device=cells.device)
        return index
    return _batched(cells, blocks)


def _batched(cells: Tensor, blocks: BlockKeys) -> Tensor:
    origin, low, high = blocks.bounds.tolist()
    columns = [cells[:, axis] - origin[axis] for axis in range(len(origin))]
    inside = functools.reduce(
        torch.logical_and,
        [(cells[:, axis] >= low[axis]) & (cells[:, axis] < high[axis]) for axis in range(len(origin))],
    )
    half, in_block = 1 << (blocks.axis_bits - 1), (1 << blocks.local_bits) - 1
    key, place = (columns[0] >> blocks.local_bits) + half, columns[0] & in_block
    for column in columns[1:]:
        key = (key << blocks.axis_bits) | ((column >> blocks.local_bits) + half)
        place = (place << blocks.local_bits) | (column & in_block)
    if len(blocks.keys) == 0:
        return torch.where(inside, -1, 0)
    # Neighbouring cells often share a block: each run of equal keys is searched once.
    runs, run = torch.unique_consecutive(torch.where(inside, key, -1), return_inverse=True)
    rank = torch.searchsorted(blocks.keys, runs).clamp_max(len(blocks.keys) - 1)
    first = torch.where(
        blocks.keys[rank] == runs, blocks.slots[rank] << (blocks.local_bits * len(origin)), -1
    )
    first = first[run]
    return torch.where(inside, torch.where(first < 0, -1, first + place), 0)

"""Places of cells in a sparse store of blocks: a binary search for each run of cells of one block."""

from __future__ import annotations

import functools
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.kernels.choice import is_fused
from gmmtorch.kernels.compiler import FusedKernel

_RUN = 1 << 10  # cells of an item on a CPU, which searches again only where the block changes


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


_KERNEL = FusedKernel(
    "cell_index",
    "const int64* cells, int64 n_cells, int64 dim, int64 run, const int64* keys, const int64* slots,"
    " int64 n_keys, const int64* bounds, int64 local_bits, int64 axis_bits, int64* index",
    """
    const int64_t in_block = ((int64_t)1 << local_bits) - 1, half = (int64_t)1 << (axis_bits - 1);
    const int64_t stop = GMM_MIN(n_cells, (item + 1) * run);
    int64_t last = -1, first = -1;
    for (int64_t c = item * run; c < stop; ++c) {
        int64_t key = 0, place = 0;
        bool inside = true;
        for (int64_t a = 0; a < dim; ++a) {
            const int64_t cell = cells[c * dim + a], column = cell - bounds[a];
            inside = inside && cell >= bounds[dim + a] && cell < bounds[2 * dim + a];
            key = (key << axis_bits) | ((column >> local_bits) + half);
            place = (place << local_bits) | (column & in_block);
        }
        if (!inside) {
            index[c] = 0;
            continue;
        }
        if (key != last) {
            int64_t low = 0, high = n_keys;
            while (low < high) {
                const int64_t middle = (low + high) / 2;
                if (keys[middle] < key) low = middle + 1; else high = middle;
            }
            last = key;
            first = low < n_keys && keys[low] == key ? slots[low] << (local_bits * dim) : -1;
        }
        index[c] = first < 0 ? -1 : first + place;
    }
    """,
)


def cell_index(cells: Tensor, blocks: BlockKeys) -> Tensor:
    """Flat index (C,) int64 of cells (C, D) in the slots; −1 in blocks that are not stored, 0 out of bounds.

    The fused kernel and its twin give equal indices.
    """
    if is_fused(cells, blocks.keys, blocks.bounds):
        run = _RUN if cells.device.type == "cpu" else 1
        index, cells = torch.empty_like(cells[:, 0]), cells.contiguous()
        n_items = -(-len(cells) // run)
        keys, slots = blocks.keys.contiguous(), blocks.slots.contiguous()
        sizes = blocks.local_bits, blocks.axis_bits
        n_cells, dim = cells.shape
        bounds = blocks.bounds.contiguous()
        _KERNEL(
            n_items,
            cells,
            n_cells,
            dim,
            run,
            keys,
            slots,
            len(keys),
            bounds,
            *sizes,
            index,
            device=keys.device,
        )
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

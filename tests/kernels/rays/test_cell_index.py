"""The fused search of cells in a sparse store gives the indices of its twin, and of a dictionary."""

from __future__ import annotations

import pytest
import torch

from gmmtorch.kernels import kernels
from gmmtorch.kernels.rays.cell_counts import BlockKeys, cell_index


def store(dim: int, n_blocks: int, seed: int = 0) -> tuple[BlockKeys, dict[tuple[int, ...], int]]:
    """Random blocks near zero in shuffled slots, and the slot of each block."""
    generator = torch.Generator().manual_seed(seed)
    local_bits, axis_bits = (4, 31) if dim == 2 else (3, 21)
    every = torch.cartesian_prod(*[torch.arange(-3, 3)] * dim)
    blocks = every[torch.randperm(len(every), generator=generator)[:n_blocks]]
    key = torch.zeros(n_blocks, dtype=torch.int64)
    for axis in range(dim):
        key = (key << axis_bits) | (blocks[:, axis] + (1 << (axis_bits - 1)))
    keys, order = key.sort()
    slots = torch.randperm(n_blocks, generator=generator) + 1
    side = 1 << local_bits
    bounds = torch.tensor([[0] * dim, [-2 * side - 3] * dim, [2 * side + 5] * dim])
    table = {tuple(blocks[row].tolist()): int(slot) for row, slot in zip(order, slots, strict=True)}
    return BlockKeys(keys, slots, bounds, local_bits, axis_bits), table


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("n_blocks", [0, 1, 20])
@pytest.mark.parametrize("n_cells", [0, 1, 64, 1000])
def test_indices_are_those_of_a_dictionary(dim, n_blocks, n_cells):
    blocks, table = store(dim, n_blocks)
    generator = torch.Generator().manual_seed(1)
    cells = torch.randint(-60, 60, (n_cells, dim), generator=generator)
    cells = cells[cells[:, 0].argsort()] if n_cells > 64 else cells
    side, expected = 1 << blocks.local_bits, []
    for cell in cells.tolist():
        place = 0
        for c in cell:
            place = place * side + c % side
        slot = table.get(tuple(c // side for c in cell), -1)
        inside = all(blocks.bounds[1, 0] <= c < blocks.bounds[2, 0] for c in cell)
        expected.append(0 if not inside else -1 if slot < 0 else slot * side**dim + place)
    for choice in ("torch", "fused"):
        with kernels(choice):
            assert cell_index(cells, blocks).tolist() == expected

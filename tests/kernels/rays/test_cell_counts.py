"""Cells that are listed, found and added to, and their entropy: the fused kernels against their twins."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kernels.twins import by_both
from scipy.stats import entropy

from gmmtorch.kernels import kernels
from gmmtorch.kernels.compiler import compiler_failure
from gmmtorch.kernels.rays.cell_counts import (
    BlockKeys,
    add_counts,
    cell_entropy,
    cell_index,
    entropy_removed,
    flags_of_cells,
    list_counted_cells,
    reduction_along_rays,
)

pytestmark = pytest.mark.skipif(compiler_failure() is not None, reason="the kernel compiler does not work")

SIDES = st.tuples(*[st.integers(0, 9)] * 3)


def sparse(shape: tuple[int, ...], generator: torch.Generator) -> torch.Tensor:
    values = torch.randn(*shape, generator=generator, dtype=torch.float64)
    return values.where(torch.rand(*shape, generator=generator) < 0.3, 0.0)  # a few are negative


@given(shape=SIDES, seed=st.integers(0, 2**32 - 1))
def test_counted_cells_of_a_block_are_listed(shape, seed):
    generator = torch.Generator().manual_seed(seed)
    hits, misses = sparse(shape, generator), sparse(shape, generator)
    low = torch.randint(-(2**40), 2**40, (3,), generator=generator)
    expected, found = by_both(lambda: list_counted_cells(low, hits, misses))
    for a, b in zip(found, expected, strict=True):
        assert a.dtype == b.dtype
        assert torch.equal(a, b)


@given(n=st.integers(0, 600), seed=st.integers(0, 2**32 - 1))
def test_counts_are_added_except_at_zero(n, seed):
    generator = torch.Generator().manual_seed(seed)
    stored = torch.rand(2, 5, 200, generator=generator)
    index = 1 + torch.randperm(999, generator=generator)[:n]
    index[::7] = 0
    hits, misses = torch.rand(2, n, generator=generator)
    results = []
    for choice in ("torch", "fused"):
        counts = stored.clone()
        with kernels(choice):
            before = add_counts(counts, index, hits, misses)
        assert torch.equal(counts[:, 0, 0], stored[:, 0, 0])
        results.append((counts, *before))
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


@given(shape=st.tuples(*[st.integers(1, 9)] * 3), n=st.integers(0, 600), seed=st.integers(0, 2**32 - 1))
def test_flags_outside_a_block_are_false(shape, n, seed):
    generator = torch.Generator().manual_seed(seed)
    flags = torch.rand(*shape, generator=generator) < 0.5
    low = torch.randint(-5, 5, (3,), generator=generator)
    cells = torch.randint(-8, 15, (n, 3), generator=generator)
    expected, found = by_both(lambda: flags_of_cells(cells, low, flags))
    assert torch.equal(found, expected)


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


def counts(n: int, seed: int) -> torch.Tensor:
    """Counts of cells: none, few, many, and far more misses than hits."""
    generator = torch.Generator().manual_seed(seed)
    kind = torch.randint(0, 4, (n,), generator=generator)
    scale = torch.tensor([0.0, 1.0, 50.0, 1e6])[kind]
    return torch.rand(n, generator=generator) * scale


def test_entropy_is_that_of_a_coin():
    hits, misses = torch.tensor([0.0, 3.0, 1e9]).double(), torch.tensor([0.0, 1.0, 0.0]).double()
    p = (hits + 1) / (hits + misses + 2)
    expected = [entropy([x, 1 - x], base=2) for x in p.tolist()]
    assert cell_entropy(hits, misses, 1.0).tolist() == pytest.approx(expected, abs=1e-15)


@pytest.mark.parametrize(("prior", "clamp"), [(1.0, 0.05), (1.0, 0.0), (0.0, 0.0), (0.125, 0.4)])
@pytest.mark.parametrize("n", [0, 1, 256, 10_000])
def test_fused_sums_of_removed_entropy_are_those_of_the_twin(n, prior, clamp):
    before, added = (counts(n, 0), counts(n, 1)), (counts(n, 2), counts(n, 3))
    chosen = counts(n, 4) > 0.5
    one, other = by_both(lambda: entropy_removed(before, added, chosen, prior, clamp))
    assert other[2] == one[2]
    assert other[:2] == pytest.approx(one[:2], abs=1e-6 * n)


@pytest.mark.parametrize("margin", [0, 1])
def test_fused_reduction_along_rays_is_that_of_the_twin(margin, generator):
    shape = (9, 14, 7)
    hits, misses = (counts(9 * 14 * 7, seed).view(shape) for seed in (0, 1))
    size = torch.tensor(shape, dtype=torch.float64)
    starts, stops = torch.rand(2, 400, 3, generator=generator, dtype=torch.float64) * size
    starts[:50], stops[50:100] = starts[:50].round(), stops[50:100].round()  # on planes, edges and corners
    stops[100:110] = starts[100:110]  # of length zero
    stops[110:200] = 3 * stops[110:200] - size  # out of the grid
    starts[190:260] = 3 * starts[190:260] - size
    if margin == 0:
        starts, stops = (x.minimum(size - 1e-6).clamp_min(0) for x in (starts, stops))
    options = {"prior": 1.0, "observed": 1.0, "mark": 100.0, "margin": margin}
    found = []
    for choice in ("torch", "fused"):
        with kernels(choice):
            low = torch.zeros(3, dtype=torch.int64)
            found.append(reduction_along_rays(starts, stops, low, hits, misses, **options))
    assert found[0].max() > 100
    torch.testing.assert_close(found[1], found[0], rtol=1e-12, atol=1e-12)

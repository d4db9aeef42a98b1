"""Lists, additions and flags of cells: the fused kernels against their twins."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gmmtorch.kernels import kernels
from gmmtorch.kernels.compiler import compiler_failure
from gmmtorch.kernels.rays.cell_counts import add_counts, flags_of_cells, list_counted_cells

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
    with kernels("torch"):
        expected = list_counted_cells(low, hits, misses)
    with kernels("fused"):
        found = list_counted_cells(low, hits, misses)
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
    with kernels("torch"):
        expected = flags_of_cells(cells, low, flags)
    with kernels("fused"):
        found = flags_of_cells(cells, low, flags)
    assert torch.equal(found, expected)

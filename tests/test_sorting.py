"""Sorting, against NumPy and plain Python."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gmmtorch.sorting import argsort, count_distinct, largest, number_distinct

INTEGERS = st.one_of(
    st.lists(st.integers(0, 5), max_size=40),  # many equal
    st.lists(st.integers(0, (1 << 16) + 1), max_size=40),  # around where keys are made shorter
    st.lists(st.integers(-(1 << 62), 1 << 62), max_size=40),
)


@given(keys=INTEGERS)
def test_the_order_is_sorted_and_equal_keys_keep_theirs(keys):
    order = argsort(torch.tensor(keys, dtype=torch.int64))
    assert order.dtype == torch.int64
    assert order.tolist() == sorted(range(len(keys)), key=keys.__getitem__)


@pytest.mark.parametrize("top", [10, (1 << 16) - 1, 1 << 16, 1 << 40])
def test_many_keys_are_sorted_as_numpy_sorts_them(top):
    keys = torch.randint(0, top + 1, (50_000,), generator=torch.Generator().manual_seed(0))
    keys[7] = top
    before = keys.clone()
    assert (argsort(keys).numpy() == np.argsort(keys.numpy(), kind="stable")).all()
    assert torch.equal(keys, before)


def test_numbers_and_strided_keys_are_sorted():
    keys = torch.tensor([[3.5, 0.0], [-1.0, 0.0], [3.5, 0.0], [-torch.inf, 0.0]], dtype=torch.float64)
    assert argsort(keys[:, 0]).tolist() == [3, 1, 0, 2]


@given(
    seed=st.integers(0, 10**6),
    n=st.integers(1, 8),
    m=st.integers(1, 30),
    share=st.floats(0, 1),
    dtype=st.sampled_from([torch.float32, torch.float64]),
)
def test_the_largest_are_those_that_sorting_puts_last(seed, n, m, share, dtype):
    generator = torch.Generator().manual_seed(seed)
    scores = torch.randn(n, m, generator=generator, dtype=dtype).round(decimals=1)  # some are equal
    scores[torch.rand(n, m, generator=generator) < share / 2] = -torch.inf
    k = 1 + int(share * (m - 1))
    index = largest(scores, k)
    assert index.dtype == torch.int64
    assert index.shape == (n, k)
    for row, chosen in zip(scores, index, strict=True):
        assert len(set(chosen.tolist())) == k
        assert sorted(row[chosen].tolist()) == sorted(row.tolist())[m - k :]


@given(keys=INTEGERS)
def test_distinct_keys_are_counted_and_numbered_in_order(keys):
    tensor = torch.tensor(keys, dtype=torch.int64)
    rank = {key: i for i, key in enumerate(sorted(Counter(keys)))}
    assert count_distinct(tensor) == len(rank)
    number, n = number_distinct(tensor)
    assert n == len(rank)
    assert number.dtype == torch.int64
    assert number.tolist() == [rank[key] for key in keys]

"""Small symmetric matrices: packing, and a Cholesky that mends only what needs mending."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from gmmtorch.errors import GmmTorchError, NumericalError
from gmmtorch.linalg import (
    argsort,
    count_distinct,
    dense_ranks,
    inverse_factor,
    largest_indices,
    pack_symmetric,
    safe_cholesky,
    unpack_symmetric,
)


def random_spd(k: int, dim: int, generator: torch.Generator) -> Tensor:
    root = torch.randn(k, dim, dim, dtype=torch.float64, generator=generator)
    return root @ root.mT + 0.1 * torch.eye(dim, dtype=torch.float64)


@pytest.mark.parametrize("dim", [2, 3])
def test_packed_entries_are_the_upper_triangle_by_rows(dim, generator):
    matrices = random_spd(5, dim, generator)
    packed = pack_symmetric(matrices)
    assert packed.shape == (5, dim * (dim + 1) // 2)
    for matrix, row in zip(matrices, packed, strict=True):
        expected = [float(matrix[i, j]) for i in range(dim) for j in range(i, dim)]
        assert row.tolist() == expected


@given(dim=st.integers(1, 4), k=st.integers(0, 4), seed=st.integers(0, 1000))
def test_unpacking_undoes_packing(dim, k, seed):
    matrices = random_spd(k, dim, torch.Generator().manual_seed(seed))
    matrices = (matrices + matrices.mT) / 2
    assert torch.equal(unpack_symmetric(pack_symmetric(matrices), dim), matrices)


def test_packing_takes_any_leading_shape(generator):
    matrices = random_spd(6, 3, generator).reshape(2, 3, 3, 3)
    assert torch.equal(unpack_symmetric(pack_symmetric(matrices), 3).tril(), matrices.mT.tril())


@pytest.mark.parametrize("dim", [2, 3])
def test_factors_of_sound_matrices_are_lapacks(dim, generator):
    matrices = random_spd(20, dim, generator)
    expected = np.linalg.cholesky(matrices.numpy())
    np.testing.assert_allclose(safe_cholesky(matrices).numpy(), expected, rtol=1e-12, atol=1e-14)


def test_jitter_goes_only_where_it_is_needed(generator):
    sound = random_spd(3, 3, generator)
    flat = torch.diag(torch.tensor([1.0, 1.0, -1e-13], dtype=torch.float64))  # rounding below zero
    factors = safe_cholesky(torch.cat([sound[:2], flat[None], sound[2:]]))
    assert torch.equal(factors[[0, 1, 3]], torch.linalg.cholesky(sound))
    change = factors[2] @ factors[2].T - flat
    assert float(change.diagonal().min()) > 0
    assert float(change.abs().max()) < 2e-12  # the first jitter suffices; no larger one was added


def test_jitter_grows_no_further_than_needed():
    slightly = torch.diag(torch.tensor([1.0, 1.0, -1e-9], dtype=torch.float64))
    factor = safe_cholesky(slightly[None])[0]
    added = float((factor @ factor.T - slightly).diagonal().max())
    assert added == pytest.approx(1e-8 * (2 - 1e-9) / 3, rel=1e-6)


def test_jitter_follows_the_scale_of_the_matrix():
    small = 1e-6 * torch.diag(torch.tensor([1.0, -1e-13], dtype=torch.float64))
    factor = safe_cholesky(small[None])[0]
    assert float((factor @ factor.T - small).abs().max()) < 1e-17


@pytest.mark.parametrize(
    "bad", [[[1.0, 0.0], [0.0, -0.5]], [[1.0, 2.0], [2.0, 1.0]], [[0.0, 0.0], [0.0, 0.0]]]
)
def test_an_indefinite_matrix_is_named_with_a_remedy(bad):
    matrices = torch.stack([torch.eye(2), torch.tensor(bad)]).double()
    with pytest.raises(NumericalError, match=r"precisions_init\[1\].*reg_covar") as caught:
        safe_cholesky(matrices, "precisions_init")
    assert isinstance(caught.value, GmmTorchError)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("place", [(0, 0), (1, 0)])
def test_entries_that_are_not_finite_are_named(value, place):
    matrices = torch.eye(2, dtype=torch.float64).repeat(3, 1, 1)
    matrices[(2, *place)] = value
    with pytest.raises(NumericalError, match=r"covariances\[2\] holds NaN or infinite"):
        safe_cholesky(matrices)


def test_no_matrices_have_no_factors():
    assert safe_cholesky(torch.empty(0, 3, 3, dtype=torch.float64)).shape == (0, 3, 3)


def test_the_input_is_left_as_it_was():
    matrices = torch.diag(torch.tensor([1.0, -1e-13], dtype=torch.float64))[None]
    before = matrices.clone()
    safe_cholesky(matrices)
    assert torch.equal(matrices, before)


def test_inverse_factors_whiten(generator):
    matrices = random_spd(4, 3, generator)
    x = torch.randn(4, 3, dtype=torch.float64, generator=generator)
    whiten = inverse_factor(safe_cholesky(matrices))
    squared = (x[:, None, :] @ whiten).square().sum((1, 2))
    expected = [float(v @ np.linalg.inv(m) @ v) for v, m in zip(x.numpy(), matrices.numpy(), strict=True)]
    np.testing.assert_allclose(squared.numpy(), expected, rtol=1e-10)


# -- sorting ----------------------------------------------------------------------------------------

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
    index = largest_indices(scores, k)
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
    number, n = dense_ranks(tensor)
    assert n == len(rank)
    assert number.dtype == torch.int64
    assert number.tolist() == [rank[key] for key in keys]

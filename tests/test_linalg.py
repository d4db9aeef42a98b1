"""Packing, Cholesky with jitter, whitening and sorting, against NumPy, LAPACK and plain Python."""

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
    dense_ranks,
    inverse_factor,
    largest_indices,
    order_along_curve,
    pack_symmetric,
    ragged_index,
    safe_cholesky,
    unpack_symmetric,
)


def random_spd(k: int, dim: int, generator: torch.Generator) -> Tensor:
    root = torch.randn(k, dim, dim, dtype=torch.float64, generator=generator)
    return root @ root.mT + 0.1 * torch.eye(dim, dtype=torch.float64)


@pytest.mark.parametrize("dim", [2, 3])
def test_pack_symmetric_lists_the_upper_triangle_by_rows(dim, generator):
    matrices = random_spd(5, dim, generator)
    packed = pack_symmetric(matrices)
    assert packed.shape == (5, dim * (dim + 1) // 2)
    for matrix, row in zip(matrices, packed, strict=True):
        expected = [float(matrix[i, j]) for i in range(dim) for j in range(i, dim)]
        assert row.tolist() == expected


@given(dim=st.integers(1, 4), k=st.integers(0, 4), seed=st.integers(0, 1000))
def test_unpack_symmetric_inverts_pack_symmetric(dim, k, seed):
    matrices = random_spd(k, dim, torch.Generator().manual_seed(seed))
    matrices = (matrices + matrices.mT) / 2
    for shaped in (matrices, matrices.reshape(k, 1, dim, dim).expand(k, 2, dim, dim)):
        assert torch.equal(unpack_symmetric(pack_symmetric(shaped), dim), shaped)


@pytest.mark.parametrize("dim", [2, 3])
def test_safe_cholesky_of_definite_matrices_equals_lapack(dim, generator):
    matrices = random_spd(20, dim, generator)
    expected = np.linalg.cholesky(matrices.numpy())
    np.testing.assert_allclose(safe_cholesky(matrices).numpy(), expected, rtol=1e-12, atol=1e-14)
    assert safe_cholesky(matrices[:0]).shape == (0, dim, dim)


@pytest.mark.parametrize(
    ("diagonal", "jitter"),
    [([1.0, 1.0, -1e-13], 1e-12), ([1.0, 1.0, -1e-9], 1e-8), ([1e-6, 1.0, 0.0], 1e-12)],
)
@pytest.mark.parametrize("scale", [1.0, 1e-6])
def test_safe_cholesky_adds_the_smallest_jitter_and_only_to_matrices_that_fail(
    diagonal, jitter, scale, generator
):
    definite, flat = random_spd(3, 3, generator), scale * torch.diag(torch.tensor(diagonal).double())
    given_matrices = torch.cat([definite[:2], flat[None], definite[2:]])
    before = given_matrices.clone()
    factors = safe_cholesky(given_matrices)
    assert torch.equal(given_matrices, before)
    assert torch.equal(factors[[0, 1, 3]], torch.linalg.cholesky(definite))
    change = factors[2] @ factors[2].T - flat
    added = jitter * scale * sum(diagonal) / 3  # relative to the mean of the diagonal
    torch.testing.assert_close(change, added * torch.eye(3).double(), rtol=1e-2, atol=1e-16 * scale)


@pytest.mark.parametrize(
    "bad", [[[1.0, 0.0], [0.0, -0.5]], [[1.0, 2.0], [2.0, 1.0]], [[0.0, 0.0], [0.0, 0.0]]]
)
def test_safe_cholesky_names_an_indefinite_matrix_and_the_remedy(bad):
    matrices = torch.stack([torch.eye(2), torch.tensor(bad)]).double()
    with pytest.raises(NumericalError, match=r"precisions_init\[1\].*reg_covar") as caught:
        safe_cholesky(matrices, "precisions_init")
    assert isinstance(caught.value, GmmTorchError)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("place", [(0, 0), (1, 0)])
def test_safe_cholesky_names_a_matrix_with_nan_or_infinite_entries(value, place):
    matrices = torch.eye(2, dtype=torch.float64).repeat(3, 1, 1)
    matrices[(2, *place)] = value
    with pytest.raises(NumericalError, match=r"covariances\[2\] has NaN or infinite"):
        safe_cholesky(matrices)


def test_inverse_factor_gives_the_mahalanobis_distance(generator):
    matrices = random_spd(4, 3, generator)
    x = torch.randn(4, 3, dtype=torch.float64, generator=generator)
    whiten = inverse_factor(safe_cholesky(matrices))
    squared = (x[:, None, :] @ whiten).square().sum((1, 2))
    expected = [float(v @ np.linalg.inv(m) @ v) for v, m in zip(x.numpy(), matrices.numpy(), strict=True)]
    np.testing.assert_allclose(squared.numpy(), expected, rtol=1e-10)


# -- sorting ----------------------------------------------------------------------------------------

INTEGERS = st.one_of(
    st.lists(st.integers(0, 5), max_size=40),  # many ties
    st.lists(st.integers(0, (1 << 16) + 1), max_size=40),  # around the limit of the radix sort
    st.lists(st.integers(-(1 << 62), 1 << 62), max_size=40),
)


@given(keys=INTEGERS)
def test_argsort_is_a_stable_sort(keys):
    order = argsort(torch.tensor(keys, dtype=torch.int64))
    assert order.dtype == torch.int64
    assert order.tolist() == sorted(range(len(keys)), key=keys.__getitem__)


@pytest.mark.parametrize("top", [10, (1 << 16) - 1, 1 << 16, 1 << 40])
def test_argsort_equals_numpy_on_many_keys(top):
    keys = torch.randint(0, top + 1, (50_000,), generator=torch.Generator().manual_seed(0))
    keys[7] = top
    before = keys.clone()
    assert (argsort(keys).numpy() == np.argsort(keys.numpy(), kind="stable")).all()
    assert torch.equal(keys, before)
    floats = torch.stack([keys.double(), keys.double()], 1)[:, 0].masked_fill(keys == top, -torch.inf)
    assert (argsort(floats).numpy() == np.argsort(floats.numpy(), kind="stable")).all()


@given(
    seed=st.integers(0, 10**6),
    n=st.integers(1, 8),
    m=st.integers(1, 30),
    share=st.floats(0, 1),
    dtype=st.sampled_from([torch.float32, torch.float64]),
)
def test_largest_indices_equals_a_full_sort(seed, n, m, share, dtype):
    generator = torch.Generator().manual_seed(seed)
    scores = torch.randn(n, m, generator=generator, dtype=dtype).round(decimals=1)  # with ties
    scores[torch.rand(n, m, generator=generator) < share / 2] = -torch.inf
    k = 1 + int(share * (m - 1))
    index = largest_indices(scores, k)
    assert index.dtype == torch.int64
    assert index.shape == (n, k)
    for row, chosen in zip(scores, index, strict=True):
        assert len(set(chosen.tolist())) == k
        assert sorted(row[chosen].tolist()) == sorted(row.tolist())[m - k :]


@given(keys=INTEGERS)
def test_dense_ranks_equal_a_python_dict(keys):
    tensor = torch.tensor(keys, dtype=torch.int64)
    rank = {key: i for i, key in enumerate(sorted(Counter(keys)))}
    number, n = dense_ranks(tensor)
    assert n == len(rank)
    assert number.dtype == torch.int64
    assert number.tolist() == [rank[key] for key in keys]


@given(lengths=st.lists(st.integers(0, 4), max_size=8))
def test_ragged_index_lists_rows_and_places(lengths):
    row, place = ragged_index(torch.tensor(lengths, dtype=torch.int64))
    expected = [(row, place) for row, length in enumerate(lengths) for place in range(length)]
    assert list(zip(row.tolist(), place.tolist(), strict=True)) == expected


@pytest.mark.parametrize("dim", [2, 3])
def test_neighbours_follow_each_other_along_the_curve(dim, generator):
    places = torch.rand(2000, dim, generator=generator, dtype=torch.float64) * torch.tensor(
        [7.0, 1.0, 3.0][:dim]
    )
    order = order_along_curve(places)
    assert sorted(order.tolist()) == list(range(2000))

    def length(sorted_places: Tensor) -> float:
        return float(sorted_places.diff(dim=0).norm(dim=1).sum())

    assert length(places[order]) < 0.2 * length(places)
    assert order_along_curve(places[:1]).tolist() == [0]
    assert order_along_curve(places[:1].repeat(3, 1)).tolist() == [0, 1, 2]

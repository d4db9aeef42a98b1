"""Distinct keys by a hash table against their sorting twins."""

from __future__ import annotations

import pytest
import torch

from gmmtorch.kernels import kernels
from gmmtorch.kernels.mixtures.cell_sums import distinct_keys
from gmmtorch.linalg import dense_ranks

pytestmark = pytest.mark.cpu_only


@pytest.mark.parametrize("kind", ["few", "many", "equal", "extreme", "strided"])
def test_hashed_ranks_equal_the_sorted_ones(kind):
    generator = torch.Generator().manual_seed(0)
    keys = torch.randint(0, 300 if kind == "few" else 1 << 40, (20_000,), generator=generator)
    if kind == "equal":
        keys = torch.full_like(keys, 7)
    if kind == "extreme":
        keys[::3], keys[1::3], keys[2::7] = -(2**63), 2**63 - 1, -1
    if kind == "strided":
        keys = (torch.arange(20_000) % 5000) << 40  # equal low bits
    found = []
    for choice in ("torch", "fused"):
        with kernels(choice):
            found.append(dense_ranks(keys))
    assert torch.equal(found[0][0], found[1][0])
    assert found[0][1] == found[1][1] == keys.unique().numel()


def test_keys_are_numbered_by_their_first_occurrence():
    with kernels("fused"):
        distinct, number = distinct_keys(torch.tensor([5, -3, 5, 8, -3]))
        assert distinct_keys(torch.tensor([], dtype=torch.int64))[0].numel() == 0
    assert distinct.tolist() == [5, -3, 8]
    assert number.tolist() == [0, 1, 0, 2, 1]

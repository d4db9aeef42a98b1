"""Mixtures reduced in one launch against the twin, which searches with a k-d tree and sorts."""

from __future__ import annotations

import math

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kernels.twins import by_both

from gmmtorch.mixture import Parameters, merge_in_rounds


def mixture(k: int, dim: int, seed: int, far: float, thin: float, device: str) -> Parameters:
    """Random components, `far` metres from the origin, one axis `thin` times as long as the others."""
    random = torch.Generator().manual_seed(seed)
    root = torch.randn(k, dim, dim, generator=random, dtype=torch.float64)
    root[:, :, 0] *= thin
    means = torch.randn(k, dim, generator=random, dtype=torch.float64) * torch.tensor(
        [9.0, *[2.0] * (dim - 1)]
    )
    weights = torch.rand(k, generator=random, dtype=torch.float64) * 50
    parts = weights, means + far, root @ root.mT + 1e-9 * torch.eye(dim, dtype=torch.float64)
    return Parameters(*(part.to(device) for part in parts))


@settings(max_examples=40, deadline=None)
@given(
    k=st.integers(1, 300),
    dim=st.sampled_from([2, 3, 4]),
    seed=st.integers(0, 10**6),
    share=st.floats(0.01, 1.1),
    far=st.sampled_from([0.0, 1e5]),
    thin=st.sampled_from([1.0, 1e-4]),
    neighbors=st.integers(1, 12),
    limit=st.sampled_from([None, 0.3, 0.9]),
)
def test_one_launch_merges_what_the_twin_merges(device, k, dim, seed, share, far, thin, neighbors, limit):
    parameters = mixture(k, dim, seed, far, thin, device)
    rule = max(1, int(share * k)), math.inf, "kullback_leibler", neighbors
    if limit is not None:
        rule = 1, limit, "hellinger", neighbors
    twin, fused = by_both(lambda: merge_in_rounds(parameters, *rule))
    assert torch.equal(fused.labels, twin.labels)
    assert torch.equal(fused.first, twin.first)
    assert torch.equal(fused.members, twin.members)
    for mine, theirs in zip(fused.parameters, twin.parameters, strict=True):
        assert torch.equal(mine, theirs) or device == "cuda"
        torch.testing.assert_close(mine, theirs, rtol=1e-12, atol=0)


def test_many_equal_components_at_one_place_become_few(device):
    one = mixture(1, 3, 0, 5.0, 1.0, device)
    parameters = Parameters(*(part.repeat_interleave(500, 0) for part in one))
    found = merge_in_rounds(parameters, 7)
    assert len(found.first) == 7
    assert int(found.members.sum()) == 500
    torch.testing.assert_close(found.parameters.weights.sum(), parameters.weights.sum())
    torch.testing.assert_close(found.parameters.covariances, parameters.covariances[:7])


def test_an_indefinite_covariance_is_repaired_as_by_the_twin(device):
    parameters = mixture(20, 3, 1, 0.0, 1.0, device)
    parameters.covariances[4] = torch.ones(3, 3)
    twin, fused = by_both(lambda: merge_in_rounds(parameters, 5))
    assert torch.equal(fused.labels, twin.labels)

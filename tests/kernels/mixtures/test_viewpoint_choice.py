"""Viewpoints chosen in one launch against the twin."""

from __future__ import annotations

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kernels.twins import by_both

from gmmtorch.mapping.components import Components
from gmmtorch.mapping.learning.merging import limit_origins


@settings(max_examples=40, deadline=None)
@given(
    k=st.integers(0, 60),
    n_origins=st.integers(1, 20),
    dim=st.sampled_from([2, 3]),
    seed=st.integers(0, 10**6),
    most=st.integers(1, 9),
    mean=st.sampled_from([None, 1.0, 1.5, 2.0, 8.0]),
    step=st.sampled_from([0.0, 0.5]),
    is_sorted=st.booleans(),
)
def test_one_launch_chooses_what_the_twin_chooses(k, n_origins, dim, seed, most, mean, step, is_sorted):
    random = torch.Generator().manual_seed(seed)
    counts = torch.rand(k, n_origins, generator=random, dtype=torch.float64) * 30
    counts = torch.where(torch.rand(k, n_origins, generator=random) < 0.6, counts, 0.0)
    if step:  # equal counts, and places that coincide
        counts = (counts * step).round()
    by, seen_from = torch.where(torch.rand(k, n_origins, generator=random) < 0.8)
    if not is_sorted:
        shuffled = torch.randperm(len(by), generator=random)
        by, seen_from = by[shuffled], seen_from[shuffled]
    origins = torch.randn(n_origins, dim, generator=random, dtype=torch.float64)
    components = Components(
        means=torch.zeros(k, dim),
        covariances=torch.eye(dim).repeat(k, 1, 1),
        support=counts.sum(1) + 1,
        max_range=torch.zeros(k, dtype=torch.bool),
        ids=torch.zeros(k, 2, dtype=torch.int64),
        origins=origins.round() if step else origins,
        seen_by=by,
        seen_from=seen_from,
        seen_count=counts[by, seen_from],
    )
    twin, fused = by_both(lambda: limit_origins(components, most, mean))
    for name in ("origins", "seen_by", "seen_from"):
        assert torch.equal(getattr(fused, name), getattr(twin, name)), name
    torch.testing.assert_close(fused.seen_count, twin.seen_count, rtol=1e-12, atol=0)

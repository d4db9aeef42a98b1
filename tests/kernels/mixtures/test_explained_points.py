"""Points that components explain: the fused kernel against the twin."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gmmtorch.kernels import kernels
from gmmtorch.kernels.compiler import compiler_failure
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.learning.novelty import count_explained

pytestmark = pytest.mark.skipif(compiler_failure() is not None, reason="the kernel compiler does not work")


def scattered(k: int, dim: int, spread: float, generator: torch.Generator) -> Components:
    """k components, each seen from two of three origins."""
    draw = torch.randn(k, dim, dim, generator=generator, dtype=torch.float64)
    support = torch.rand(k, generator=generator, dtype=torch.float64) * 100 + 1
    return Components(
        means=spread * torch.randn(k, dim, generator=generator, dtype=torch.float64),
        covariances=0.1 * (draw @ draw.mT) + 1e-3 * torch.eye(dim, dtype=torch.float64),
        support=support,
        max_range=torch.rand(k, generator=generator) < 0.3,
        ids=torch.stack([torch.zeros(k, dtype=torch.int64), torch.arange(k)], 1),
        origins=torch.randn(3, dim, generator=generator, dtype=torch.float64),
        seen_by=torch.arange(k).repeat_interleave(2),
        seen_from=torch.randint(3, (2 * k,), generator=generator),
        seen_count=support.repeat_interleave(2) / 2,
    )


@given(
    seed=st.integers(0, 2**32 - 1),
    dim=st.sampled_from([2, 3]),
    k=st.sampled_from([1, 5, 64, 200]),
    n=st.sampled_from([0, 1, 70]),
    spread=st.sampled_from([0.0, 0.3, 3.0]),  # 0: every component explains many points
    asks=st.sampled_from(["all", "some", "none"]),
)
def test_shares_are_those_of_the_twin(seed, dim, k, n, spread, asks):
    generator = torch.Generator().manual_seed(seed)
    components = scattered(k, dim, spread, generator)
    points = (spread + 0.3) * torch.randn(n, dim, generator=generator, dtype=torch.float64)
    points[: n // 7] = components.means[0]  # at a mean the distance is zero
    frees = {"all": None, "some": torch.rand(n, generator=generator) < 0.5, "none": torch.zeros(n) > 0}[asks]
    given_ = (components, points, torch.zeros(dim, dtype=torch.float64), 1.0, None, False, 11.0, frees)
    with kernels("torch"):
        expected = count_explained(*given_)
    with kernels("fused"):
        found = count_explained(*given_)
    assert torch.equal(found.explained, expected.explained)
    torch.testing.assert_close(found.components.support, expected.components.support, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(
        found.components.seen_count, expected.components.seen_count, rtol=1e-9, atol=1e-9
    )

"""Fused counts and marks of rays against twins; test_sparse_evidence compares counts with exact walks."""

from __future__ import annotations

import math

import pytest
import torch
from kernels.twins import by_both
from torch import Tensor

from gmmtorch.kernels import count_in_grid, kernels, mark_cells_of_rays
from gmmtorch.occupancy import Box, Evidence, SparseEvidence, VoxelGrid, cast_evidence


def rays(dim: int, kind: str, n: int = 3000) -> tuple[Tensor, Tensor]:
    """Origins and ends (n, dim) in a box of 10 m, on cell planes or along axes for some kinds."""
    generator = torch.Generator().manual_seed(1)
    origins, ends = 12 * torch.rand(2, n, dim, generator=generator, dtype=torch.float64) - 1
    if kind == "planes":  # ties of crossings at edges and corners
        return (origins * 4).round() / 4, (ends * 4).round() / 4
    if kind == "flat":
        ends[:, 0] = origins[:, 0]
        ends[::2] = origins[::2]  # zero length
    if kind == "far":
        return origins, origins + (ends - origins) * torch.tensor([1e-14, 1.0, 1e5])[
            torch.arange(n) % 3, None
        ]
    return origins, ends


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("kind", ["any", "planes", "flat", "far"])
@pytest.mark.parametrize("weighted", [False, True])
def test_fused_counts_in_a_grid_equal_the_twin(dim, kind, weighted):
    origins, ends = rays(dim, kind)
    weights = (torch.arange(len(ends)) % 7).double() if weighted else None  # whole, so that sums are exact

    def counted() -> Evidence:
        made = Evidence.empty(VoxelGrid((0.0,) * dim, 0.25, (40,) * dim))
        made.add_rays(origins, ends, weights)
        return made

    found = by_both(counted)
    assert found[0].misses.sum() > 1000
    torch.testing.assert_close(found[1].misses, found[0].misses, rtol=0, atol=0)
    torch.testing.assert_close(found[1].hits, found[0].hits, rtol=0, atol=0)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -1e300])
def test_rays_that_are_not_finite_leave_the_counts_of_the_others_as_they_are(bad):
    origins, ends = rays(3, "any")
    good = torch.arange(3000) % 5 != 2
    spoilt = torch.where(good[:, None], origins, bad)
    counts = torch.zeros(2, 40**3).double()
    with kernels("fused"):
        count_in_grid(counts[0], spoilt / 0.25, ends / 0.25, (40,) * 3)
        count_in_grid(counts[1], origins[good] / 0.25, ends[good] / 0.25, (40,) * 3)
    assert counts[0].sum() > 1000
    assert torch.equal(counts[0], counts[1])


@pytest.mark.parametrize("choice", ["torch", "fused"])
def test_evidence_of_many_rays_is_that_of_their_parts(choice):
    origins, ends = rays(2, "any", 150_000)
    weights, is_hit = torch.arange(150_000) % 3, torch.arange(150_000) % 4 > 0
    grid = VoxelGrid((0.0,) * 2, 1.0, (10,) * 2)
    whole, parts = Evidence.empty(grid), Evidence.empty(grid)
    with kernels(choice):
        whole.add_rays(origins, ends, weights, is_hit)
        for part in torch.arange(150_000).split(7_001):
            parts.add_rays(origins[part], ends[part], weights[part], is_hit[part])
    assert torch.equal(whole.misses, parts.misses)
    assert torch.equal(whole.hits, parts.hits)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("kind", ["any", "planes", "flat"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_fused_counts_in_blocks_equal_the_twin(dim, kind, dtype):
    origins, ends = rays(dim, kind)
    found = []
    for choice in ("torch", "fused"):
        with kernels(choice):
            store = SparseEvidence(0.25, dim, dtype=dtype)
            for part in range(0, 3000, 1000):  # later rays meet blocks of earlier ones
                store.add_rays(origins[part : part + 1000], ends[part : part + 1000])
            found.append((store.keys, *store.in_key_order()))
    for one, other in zip(*found, strict=True):
        assert torch.equal(one, other)


def test_fused_evidence_of_rays_cut_at_a_box_equals_the_twin():
    origins, ends = rays(3, "planes")
    box = Box(torch.tensor([8, 4, 0]), torch.tensor([30, 36, 22]))
    found = by_both(lambda: cast_evidence(origins, ends, torch.arange(3000) % 2 == 0, 0.25, box))
    for one, other in zip(*found, strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize("choice", ["torch", "auto"])
@pytest.mark.parametrize("n", [0, 1, 200])
def test_the_cells_with_evidence_are_marked(choice, n):
    generator = torch.Generator().manual_seed(n)
    low = torch.tensor([-7, 3, -20])
    shape = (15, 20, 30)
    origin = torch.tensor([0.3, 11.7, -4.2], dtype=torch.float64)
    stops = origin + 12 * torch.randn(n, 3, generator=generator, dtype=torch.float64)
    stops[: n // 5] = stops[: n // 5].round()  # on grid planes
    is_hit = torch.rand(n, generator=generator) < 0.5
    marks = torch.randint(2, shape, generator=generator, dtype=torch.int32)
    before = marks.clone()
    with kernels(choice):
        mark_cells_of_rays(marks, origin.expand_as(stops), stops, is_hit, low, 4)
    expected = torch.zeros(shape, dtype=torch.int32)
    seen = cast_evidence(origin, stops, is_hit, 1.0, Box(low, low + torch.tensor(shape)))
    expected[(seen.cells - low).unbind(1)] = 4
    assert torch.equal(marks, before | expected)

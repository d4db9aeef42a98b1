"""Cells that rays cross: the fused kernel, its twin, and the cells with evidence of the same rays."""

from __future__ import annotations

import pytest
import torch

from gmmtorch.kernels import kernels
from gmmtorch.kernels.rays.ray_marks import mark_cells_of_rays
from gmmtorch.occupancy.voxels.cells import Box
from gmmtorch.occupancy.voxels.ray_casting import cast_evidence


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

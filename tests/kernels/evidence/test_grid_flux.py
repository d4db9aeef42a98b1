"""The fused flux and mass of a grid against their twins, which test_flux compares with quadrature."""

from __future__ import annotations

import pytest
import torch
from kernels.cones_for_kernels import cones_of
from kernels.twins import by_both

from gmmtorch.kernels import kernels
from gmmtorch.occupancy import Cones, VoxelGrid, cell_flux, flux_evidence
from gmmtorch.occupancy.cones import candidate_pairs


def cones_around_the_grid(dim: int, kind: str) -> Cones:
    """Some sensor origins lie in the grid, some outside, and some on a corner of its cells."""
    cones = cones_of(dim, kind, 12, thin=0.03)
    cones.origins[:2] = torch.tensor([0.5, 1.0, -1.5][:dim])
    return Cones(*cones[:3], torch.ones(12), cones.max_range)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("kind", ["any", "flat", "around"])
def test_fused_flux_equals_the_twin(dim, kind):
    cones = cones_around_the_grid(dim, kind)
    grid = VoxelGrid((-3.0,) * dim, 0.5, (12, 13, 14)[:dim])
    found = by_both(lambda: flux_evidence(cones, grid, 7.0, tolerance=1e-6))  # no jump at the cutoff
    assert found[0].misses.count_nonzero() > 50
    torch.testing.assert_close(found[1].misses, found[0].misses, rtol=1e-5, atol=1e-5)
    assert found[0].hits.count_nonzero() > 50
    torch.testing.assert_close(found[1].hits, found[0].hits, rtol=1e-5, atol=1e-5)


def test_a_looser_tolerance_stays_within_itself():
    cones = cones_of(3, "any", 12)
    cones = Cones(*cones[:3], torch.ones(12), cones.max_range)
    grid = VoxelGrid((-3.0,) * 3, 0.5, (12, 12, 12))
    with kernels("fused"):
        loose, exact = (flux_evidence(cones, grid, 4.0, tolerance=t) for t in (1e-3, 1e-6))
    assert 0 < float((loose.misses - exact.misses).abs().max()) < 1e-3
    assert 0 < float((loose.hits - exact.hits).abs().max()) < 1e-3


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("kind", ["any", "flat", "around"])
def test_fused_flux_of_listed_cells_equals_that_of_boxes(dim, kind):
    cones = cones_around_the_grid(dim, kind)
    cells = torch.cartesian_prod(*[torch.arange(-6, 7)] * dim)[::5].flip(0).double()

    def flux() -> tuple[torch.Tensor, ...]:
        pairs = candidate_pairs(cones, cells * 0.5, (cells + 1) * 0.5, 7.0)
        return cell_flux(cones, cells, 0.5, pairs, 7.0, tolerance=1e-6)

    found = by_both(flux)
    for one, other in zip(*found, strict=True):
        assert one.count_nonzero() > 10
        torch.testing.assert_close(other, one, rtol=1e-5, atol=1e-5)

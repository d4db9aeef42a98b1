"""Properties that all forms of evidence share, on cells of a grid around random cones."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from occupancy.cone_cases import random_cones

from gmmtorch import Evidence, VoxelGrid
from gmmtorch.occupancy import Cones, PointForm, box_flux, cone_evidence, flux_evidence, sample_rays

SIZE = 0.5
Hits = Misses = torch.Tensor
Form = Callable[[Cones, VoxelGrid], tuple[Hits, Misses]]


def by_points(cones: Cones, grid: VoxelGrid) -> tuple[Hits, Misses]:
    return PointForm(cones, grid.resolution)(grid.centers())


def by_boxes(form: Callable[..., tuple[Hits, Misses]], **options: bool) -> Form:
    def evidence(cones: Cones, grid: VoxelGrid) -> tuple[Hits, Misses]:
        low = grid.centers() - 0.5 * grid.resolution
        return form(cones, low, low + grid.resolution, **options)

    return evidence


def by_grid(cones: Cones, grid: VoxelGrid) -> tuple[Hits, Misses]:
    found = flux_evidence(cones, grid)
    return found.hits.flatten(), found.misses.flatten()


def by_rays(sampling: str) -> Form:
    def evidence(cones: Cones, grid: VoxelGrid) -> tuple[Hits, Misses]:
        found = Evidence.empty(grid)
        found.add_rays(*sample_rays(cones, 2000, torch.Generator().manual_seed(0), sampling))
        return found.hits.flatten(), found.misses.flatten()

    return evidence


FORMS: dict[str, Form] = {
    "point": by_points,
    "flux": by_boxes(box_flux),
    "flux, grid": by_grid,
    "cone": by_boxes(cone_evidence),
    "cone, exact": by_boxes(cone_evidence, exact=True),
    **{f"{sampling} rays": by_rays(sampling) for sampling in ("sobol", "stratified", "plain")},
}
forms = pytest.mark.parametrize("form", FORMS.values(), ids=FORMS)
dims = pytest.mark.parametrize("dim", [2, 3])


def grid_of(dim: int, n: int = 8) -> VoxelGrid:
    return VoxelGrid((1.0,) * dim, SIZE, (n,) * dim)


@forms
@dims
def test_no_return_components_give_only_misses(form, dim):
    cones = random_cones(dim, 4, 0)
    solid = form(cones._replace(max_range=torch.zeros(4, dtype=torch.bool)), grid_of(dim))
    free = form(cones._replace(max_range=torch.ones(4, dtype=torch.bool)), grid_of(dim))
    assert float(solid[0].max()) > 0
    assert float(free[0].abs().max()) == 0
    torch.testing.assert_close(free[1], solid[1])


@forms
@dims
def test_evidence_scales_with_the_counts(form, dim):
    cones = random_cones(dim, 1, 3)  # one cone, so that equal rays are sampled
    once, often = (form(cones._replace(counts=n * cones.counts), grid_of(dim)) for n in (1, 40))
    for few, many in zip(once, often, strict=True):
        torch.testing.assert_close(many, 40 * few)
    assert float(once[1].max()) > 0


@forms
@dims
def test_no_cones_and_cones_without_rays_give_no_evidence(form, dim):
    cones = random_cones(dim, 4, 0)
    none = Cones(*(part[:0] for part in cones))
    without_rays = cones._replace(counts=torch.zeros(4, dtype=torch.float64))
    for nothing in (none, without_rays):
        for part in form(nothing, grid_of(dim)):
            assert part.unique().tolist() == [0.0]


@dims
def test_no_points_have_no_evidence(dim):
    found = PointForm(random_cones(dim, 3, 0), 0.1)(torch.zeros(0, dim))
    assert found.hits.shape == found.misses.shape == (0,)


@dims
@pytest.mark.parametrize("form", [box_flux, cone_evidence])
def test_no_boxes_have_no_evidence(form, dim):
    none = torch.empty(0, dim, dtype=torch.float64)
    assert [part.shape for part in form(random_cones(dim, 3, 0), none, none)] == [(0,), (0,)]

"""Flux form against brute-force integration of the angular form, against counted rays, and at edge cases."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from occupancy.cone_cases import count_rays, normal, one_each, only, random_covariances, uniform
from occupancy.exact_angular import exact_evidence

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.occupancy.cones import Cones, cone_bounds
from gmmtorch.occupancy.forms.flux import box_flux, flux_evidence
from gmmtorch.occupancy.forms.quadrature import TOLERANCE
from gmmtorch.occupancy.grid import VoxelGrid


def cases(dim: int, n: int, seed: int, deviations=(1e-3, 2.0), distances=(0.1, 10.0), sizes=(1e-2, 1.0)):
    """Cones, and for each the corners of a cell that some of its rays meet 0.1 m or farther away."""
    generator = torch.Generator().manual_seed(seed)

    def log_uniform(bounds, *shape):
        return uniform(generator, *shape, low=math.log(bounds[0]), high=math.log(bounds[1])).exp()

    covariances = random_covariances(generator, log_uniform(deviations, n, dim))
    directions = torch.nn.functional.normalize(normal(generator, n, dim))
    toward = directions * log_uniform(distances, n)[:, None]
    factors = torch.linalg.cholesky(covariances)
    end = toward + (factors @ normal(generator, n, dim, 1)).squeeze(-1)
    size = log_uniform(sizes, n)
    share = torch.where(torch.arange(n) % 2 == 0, 1.0, uniform(generator, n, high=1.05))
    share = torch.maximum(share, (0.1 + size) / end.norm(dim=1))
    origins = normal(generator, n, dim)
    center = origins + end * share[:, None] + (uniform(generator, n, dim) - 0.5) * size[:, None]
    half = 0.5 * size[:, None]
    return one_each(origins + toward, covariances, origins), center - half, center + half


def evaluated(cones, low, high, **options):
    """hits, misses (n, 2) of every box with its own cone."""
    own = torch.arange(len(low))
    return torch.stack(box_flux(cones, low, high, [(own, own)], **options), 1)


# -- accuracy ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [2, 3])
def test_flux_evidence_equals_the_angular_form(dim):
    n = 40 if dim == 2 else 16
    cones, low, high = cases(dim, n, seed=5, deviations=(0.01, 0.3), distances=(3.2, 10.0))
    parts = zip(cones.means, cones.covariances, cones.origins, low, high, strict=True)
    exact = torch.tensor([exact_evidence(*part, panels=60) for part in parts], dtype=torch.float64)
    assert float((exact > 0.02).double().mean()) > 0.4  # most cells have evidence
    for dtype in (torch.float64, torch.float32):
        error = (evaluated(cones, low, high, dtype=dtype) - exact).abs()
        assert float(error.max()) < 2e-4
        assert float(error.median()) < 1e-5
    finer = (evaluated(cones, low, high, tolerance=1e-8) - exact).abs()
    assert float(finer.max()) < 5e-6  # the cutoff removes exp(−12.5)


@pytest.mark.parametrize("dim", [2, 3])
def test_flux_evidence_equals_sampled_rays_from_1_mm_to_2_m(dim):
    cones, low, high = cases(dim, 50, seed=7)
    counted = torch.tensor([count_rays(only(cones, i), low[i], high[i]) for i in range(len(low))])
    for dtype in (torch.float64, torch.float32):
        error = (evaluated(cones, low, high, dtype=dtype) - counted.double()).abs()
        assert float(error.max()) < 1e-3
        assert float(error.median()) < 1e-4


@pytest.mark.parametrize("incidence", [0.0, 0.6, 1.5])
def test_a_thin_sheet_that_cuts_the_faces_is_integrated_exactly(incidence):
    """1 cm and 1 mm sheets in a 0.2 m voxel, which a fixed number of nodes misses."""
    turn = torch.tensor(
        [
            [math.cos(incidence), -math.sin(incidence), 0],
            [math.sin(incidence), math.cos(incidence), 0],
            [0, 0, 1],
        ]
    )
    for thickness in (1e-2, 1e-3):
        deviations = torch.tensor([thickness, 0.5, 0.35])
        covariance = (turn @ torch.diag(deviations**2) @ turn.T).double()[None]
        mean = torch.tensor([[9.7, 0.03, 0.02]], dtype=torch.float64)
        cone = one_each(mean, covariance, torch.zeros(1, 3, dtype=torch.float64))
        low = torch.tensor([9.6, -0.1, -0.1], dtype=torch.float64)
        hits, misses = box_flux(cone, low[None], low[None] + 0.2)
        counted = count_rays(cone, low, low + 0.2, 1 << 20)
        assert float(hits) == pytest.approx(counted[0], abs=1e-4)
        assert float(misses) == pytest.approx(counted[1], abs=1e-4)


# -- grids ---------------------------------------------------------------------------------------------


def grid_case(dim: int, seed: int = 0) -> tuple[Cones, VoxelGrid]:
    generator = torch.Generator().manual_seed(seed)
    deviations = torch.tensor([0.01, 0.15, 0.3], dtype=torch.float64)[:dim].expand(5, dim)
    means, origins = normal(generator, 5, dim), normal(generator, 5, dim)
    origins[4] = means[4] + 0.05  # a sensor inside its component
    counts = torch.tensor([1.0, 2.0, 0.0, 0.5, 1.0], dtype=torch.float64)
    max_range = torch.tensor([False, True, False, False, False])
    cones = Cones(means, random_covariances(generator, deviations), origins, counts, max_range)
    return cones, VoxelGrid((-1.5, -1.4, -1.6)[:dim], 0.2, (15, 14, 16)[:dim])


@pytest.mark.parametrize("dim", [2, 3])
def test_grid_evidence_equals_box_evidence_of_its_cells(dim):
    cones, grid = grid_case(dim, seed=1)
    evidence = flux_evidence(cones, grid)
    low = grid.centers() - 0.5 * grid.resolution
    hits, misses = box_flux(cones, low, low + grid.resolution)
    torch.testing.assert_close(evidence.hits.flatten(), hits, atol=5e-5, rtol=1e-9)
    torch.testing.assert_close(evidence.misses.flatten(), misses, atol=5e-5, rtol=1e-9)


@pytest.mark.parametrize("dim", [2, 3])
def test_cells_outside_all_cones_have_zero_evidence(dim):
    cones, grid = grid_case(dim)
    cones = only(cones, 0)
    evidence = flux_evidence(cones, grid)
    low, high = cone_bounds(cones)
    outside = ((grid.centers() + 0.1 < low) | (grid.centers() - 0.1 > high)).any(1)
    assert 0 < int(outside.sum()) < grid.n_cells
    assert evidence.probability().flatten()[outside].unique().tolist() == [0.5]
    # and of the cells inside this box most lie beside the cone
    assert float((evidence.misses.flatten()[~outside] == 0).double().mean()) > 0.3


# -- conservation and edge cases -----------------------------------------------------------------------


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize(("size", "spread"), [(1e-4, 0.1), (0.1, 1e-3), (0.1, 2.0), (100.0, 0.1)])
def test_cells_at_the_sensor_origin_have_finite_evidence(dim, size, spread):
    """The sensor at all positions −½ … 1½ cells in half steps: corners, edges, faces, inside."""
    steps = torch.tensor(list(itertools.product((-0.5, 0.0, 0.5, 1.0, 1.5), repeat=dim)), dtype=torch.float64)
    low = -steps * size
    mean = torch.tensor([[0.5, 0.2, -0.3][:dim]], dtype=torch.float64)
    covariance = spread**2 * torch.diag(torch.tensor([1e-3, 1.0, 0.25][:dim])).double()[None]
    cone = one_each(mean, covariance, torch.zeros(1, dim, dtype=torch.float64))
    hits, misses = box_flux(cone, low, low + size)
    assert bool(torch.isfinite(hits + misses).all())
    assert float(hits.min()) >= 0 <= float(misses.min())
    assert float((hits + misses).max()) <= 1 + 1e-3
    holds = ((steps > 0) & (steps < 1)).all(1)
    torch.testing.assert_close(
        (hits + misses)[holds], torch.ones(int(holds.sum())).double(), atol=1e-3, rtol=0
    )


@given(
    dim=st.sampled_from([2, 3]),
    seed=st.integers(0, 10**6),
    scale=st.sampled_from([1e-3, 1.0, 1e3]),
    inside=st.booleans(),
)
def test_evidence_is_at_most_the_number_of_rays(dim, seed, scale, inside):
    """Cells a thousand times larger and smaller than the component, sensors at any position."""
    generator = torch.Generator().manual_seed(seed)
    deviations = 10 ** uniform(generator, 1, dim, low=-2, high=0)
    mean = normal(generator, 1, dim)
    origin = mean + 0.5 * deviations if inside else 3 * normal(generator, 1, dim)
    cone = one_each(mean, random_covariances(generator, deviations), origin)
    low = mean + normal(generator, 6, dim) * (1 if scale < 1 else 0.3) * scale - 0.5 * scale
    hits, misses = box_flux(cone, low, low + scale)
    assert bool(torch.isfinite(hits + misses).all())
    assert float(hits.min()) >= 0 <= float(misses.min())
    assert float((hits + misses).max()) <= 1 + 1e-3


def test_one_cell_around_everything_has_all_hits():
    cones, _ = grid_case(3)
    low = torch.full((1, 3), -1e3, dtype=torch.float64)
    hits, misses = box_flux(cones, low, -low)
    assert float(hits) == pytest.approx(float((cones.counts * ~cones.max_range).sum()), abs=1e-3)
    assert float(misses) == pytest.approx(0, abs=1e-3)


@pytest.mark.parametrize(
    ("low", "high"),
    [
        ([[0.0, 0.0, 0.0]], [[1.0, 0.0, 1.0]]),
        ([[0.0, 0.0, 0.0]], [[1.0, math.nan, 1.0]]),
        ([[0.0, 0.0, -math.inf]], [[1.0, 1.0, 1.0]]),
        ([[0.0, 0.0]], [[1.0, 1.0]]),
    ],
)
def test_invalid_boxes_are_refused(low, high):
    cones, _ = grid_case(3)
    with pytest.raises(InvalidArgumentError, match="low"):
        box_flux(cones, torch.tensor(low), torch.tensor(high))


def test_invalid_tolerances_and_dimensions_are_refused():
    cones, _ = grid_case(3)
    with pytest.raises(InvalidArgumentError, match="2-dimensional"):
        flux_evidence(cones, VoxelGrid((0, 0), 0.1, (3, 3)))
    with pytest.raises(InvalidArgumentError, match=f"tolerance=0 .*{TOLERANCE}"):
        flux_evidence(cones, VoxelGrid((0, 0, 0), 0.1, (3, 3, 3)), tolerance=0)


# -- gradients -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [2, 3])
def test_gradients_of_box_flux_equal_finite_differences(dim):
    cones, low, high = cases(dim, 2, seed=11, deviations=(0.1, 0.3), distances=(2.0, 3.0), sizes=(0.2, 0.4))
    pairs = [(torch.arange(2), torch.arange(2))]

    def evidence(low, high, origins, means, factors, counts):
        moved = Cones(means, factors @ factors.mT, origins, counts, cones.max_range)
        return box_flux(moved, low, high, pairs, tolerance=1e-3)

    factors = torch.linalg.cholesky(cones.covariances)
    arguments = (low, high, cones.origins, cones.means, factors, 3 * cones.counts)
    inputs = [x.clone().requires_grad_() for x in arguments]
    assert min(float(x.detach().max()) for x in evidence(*inputs)) > 0.05
    assert torch.autograd.gradcheck(evidence, inputs, eps=1e-6, atol=1e-5)


def test_gradients_flow_from_a_grid_to_the_mixture():
    cones, grid = grid_case(2)
    means = cones.means.clone().requires_grad_()
    flux_evidence(cones._replace(means=means), grid).probability().sum().backward()
    assert bool(torch.isfinite(means.grad).all())
    assert float(means.grad[0].abs().max()) > 0

"""Flux form against brute-force integration of the angular form, against counted rays, and at edge cases."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from occupancy.cone_cases import (
    count_rays,
    draw_ends,
    joined,
    normal,
    one_each,
    only,
    random_covariances,
    uniform,
)
from scipy.spatial import ConvexHull
from scipy.stats import multivariate_normal, norm
from torch import Tensor

from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.experiments.studies.angular_reference import angular_evidence
from gmmtorch.linalg import safe_cholesky
from gmmtorch.occupancy.cones import Cones, WhitenedCones, cone_bounds
from gmmtorch.occupancy.forms.cone import cone_evidence
from gmmtorch.occupancy.forms.flux import Boundary, box_flux, flux_evidence, region_flux
from gmmtorch.occupancy.forms.quadrature import TOLERANCE, box_mass, normal_mass
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
    exact = torch.stack(angular_evidence(cones, low, high), 1)
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


@pytest.mark.parametrize(
    ("low", "high"),
    [
        ([[0.0, 0.0, 0.0]], [[1.0, 0.0, 1.0]]),
        ([[0.0, 0.0, 0.0]], [[1.0, math.nan, 1.0]]),
        ([[0.0, 0.0, -math.inf]], [[1.0, 1.0, 1.0]]),
        ([[0.0, 0.0]], [[1.0, 1.0]]),
    ],
)
@pytest.mark.parametrize("form", [box_flux, cone_evidence])
def test_invalid_boxes_are_refused(form, low, high):
    cones, _ = grid_case(3)
    with pytest.raises(InvalidArgumentError, match="low"):
        form(cones, torch.tensor(low), torch.tensor(high))


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
    assert torch.autograd.gradcheck(evidence, inputs, eps=1e-6, atol=1e-5, fast_mode=True)


def test_gradients_flow_from_a_grid_to_the_mixture():
    cones, grid = grid_case(2)
    means = cones.means.clone().requires_grad_()
    flux_evidence(cones._replace(means=means), grid).probability().sum().backward()
    assert bool(torch.isfinite(means.grad).all())
    assert float(means.grad[0].abs().max()) > 0


# -- regions -------------------------------------------------------------------------------------------


SQUARE = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]).double()
HORSESHOE = torch.tensor(
    [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.7, 1.0], [0.7, 0.3], [0.3, 0.3], [0.3, 1.0], [0.0, 1.0]]
).double()


def cone_of(dim: int, seed: int, at: float = 0.5) -> Cones:
    generator = torch.Generator().manual_seed(seed)
    deviations = torch.tensor([[0.03, 0.2, 0.4][:dim]], dtype=torch.float64)
    mean = at + 0.2 * normal(generator, 1, dim)
    origin = at + 2 * torch.nn.functional.normalize(normal(generator, 1, dim))
    return one_each(mean, random_covariances(generator, deviations), origin)


def box_mesh(low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    corners = torch.cartesian_prod(*torch.stack([low, high], 1))
    hull = ConvexHull(corners.numpy())
    triangles = torch.as_tensor(hull.simplices).long()
    outward = torch.as_tensor(hull.equations[:, :3])
    a, b, c = corners[triangles].unbind(1)
    turned = (torch.linalg.cross(b - a, c - a) * outward).sum(1) < 0
    triangles[turned] = triangles[turned].flip(1)
    return corners, triangles


def prism_mesh(polygon: Tensor, height: float) -> tuple[Tensor, Tensor]:
    """The mesh of a horseshoe polygon extruded along z."""
    n = len(polygon)
    vertices = torch.cat([torch.cat([polygon, torch.full((n, 1), z).double()], 1) for z in (0.0, height)])
    fans = [[0, 1, 5], [1, 2, 4], [2, 3, 4], [0, 5, 6], [1, 4, 5], [0, 6, 7]]
    top = [[a + n, b + n, c + n] for a, b, c in fans]
    sides = [t for i in range(n) for j in [(i + 1) % n] for t in ([i, j, j + n], [i, j + n, i + n])]
    return vertices, torch.tensor([[c, b, a] for a, b, c in fans] + top + sides)


def count_exits(cones: Cones, polygon: Tensor, height: float | None = None, n: int = 1 << 18):
    """Mean hits and exits of sampled rays, one boundary edge at a time.

    Rays leave where they cross an edge of a counter-clockwise polygon from left to right. A prism's
    ends are crossed where the ray is inside the polygon at that height.
    """
    origin, ends = cones.origins[0], draw_ends(cones, n)
    delta = ends - origin

    def inside(points):
        odd = torch.zeros(len(points), dtype=torch.bool)
        for a, b in zip(polygon, polygon.roll(-1, 0), strict=True):
            spans = (a[1] > points[:, 1]) != (b[1] > points[:, 1])
            x = a[0] + (points[:, 1] - a[1]) / (b[1] - a[1]) * (b[0] - a[0])
            odd ^= spans & (points[:, 0] < x)
        return odd

    exits = torch.zeros(n)
    for a, b in zip(polygon, polygon.roll(-1, 0), strict=True):
        edge = b - a
        along = delta[:, 0] * edge[1] - delta[:, 1] * edge[0]  # > 0: crosses from left to right
        start = (a - origin[:2])[None]
        t = (start[:, 0] * edge[1] - start[:, 1] * edge[0]) / along
        s = (start[:, 0] * delta[:, 1] - start[:, 1] * delta[:, 0]) / along
        crossed = (along > 0) & (t > 0) & (t < 1) & (s > 0) & (s < 1)
        if height is not None:
            z = origin[2] + t * delta[:, 2]
            crossed &= (z > 0) & (z < height)
        exits += crossed
    held = inside(ends)
    if height is not None:
        for z, up in ((0.0, False), (height, True)):
            t = (z - origin[2]) / delta[:, 2]
            leaving = (delta[:, 2] > 0) == up
            exits += leaving & (t > 0) & (t < 1) & inside(origin[:2] + t[:, None] * delta[:, :2])
        held &= (ends[:, 2] > 0) & (ends[:, 2] < height)
    return float(held.double().mean()), float(exits.double().mean())


@pytest.mark.parametrize("seed", range(3))
def test_regions_that_are_boxes_equal_box_flux(seed):
    for dim in (2, 3):
        cone = cone_of(dim, seed)
        low, high = torch.zeros(1, dim).double(), torch.tensor([[1.0, 0.8, 0.6][:dim]]).double()
        if dim == 2:
            boundary = Boundary.of_polygon(SQUARE * high)
        else:
            boundary = Boundary.of_mesh(*box_mesh(low[0], high[0]))
        box = torch.stack(box_flux(cone, low, high, tolerance=1e-6))[:, 0]
        region = torch.stack(region_flux(cone, boundary))
        assert float(box.sum()) > 0.05
        torch.testing.assert_close(region, box, atol=1e-4, rtol=0)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("height", [None, 0.7])
def test_a_nonconvex_region_counts_each_exit_of_a_ray(seed, height):
    if height is None:
        cone, boundary = cone_of(2, seed), Boundary.of_polygon(HORSESHOE)
    else:
        cone, boundary = cone_of(3, seed), Boundary.of_mesh(*prism_mesh(HORSESHOE, height))
    counted = count_exits(cone, HORSESHOE, height)
    for dtype in (torch.float64, torch.float32):
        found = region_flux(cone, boundary, dtype=dtype)
        assert torch.stack(found).tolist() == pytest.approx(counted, abs=5e-4)


def test_some_rays_leave_the_nonconvex_polygon_twice():
    mean, origin = torch.tensor([[3.0, 0.7]]).double(), torch.tensor([[-3.0, 0.7]]).double()
    cone = one_each(mean, 1e-4 * torch.eye(2).double()[None], origin)
    assert float(region_flux(cone, Boundary.of_polygon(HORSESHOE))[1]) == pytest.approx(2, abs=1e-3)


def test_evidence_of_cones_sums_and_far_cones_add_zero():
    boundary = Boundary.of_polygon(HORSESHOE)
    cones = [cone_of(2, seed) for seed in range(3)] + [cone_of(2, 0, at=100.0)]
    several = joined(*cones)._replace(
        counts=torch.tensor([1.0, 2.0, 0.5, 7.0]).double(),
        max_range=torch.tensor([False, True, False, False]),
    )
    alone = torch.stack([torch.stack(region_flux(cone, boundary)) for cone in cones])
    assert alone[3].tolist() == [0, 0]
    hits, misses = region_flux(several, boundary)
    assert float(hits) == pytest.approx(float(alone[0, 0] + 0.5 * alone[2, 0]), rel=1e-9)
    assert float(misses) == pytest.approx(float(several.counts @ alone[:, 1]), rel=1e-9)


def test_polygon_orientation_does_not_change_evidence():
    cone = cone_of(2, 1)
    one, other = (region_flux(cone, Boundary.of_polygon(p)) for p in (HORSESHOE, HORSESHOE.flip(0)))
    torch.testing.assert_close(one, other)


@pytest.mark.parametrize("dim", [2, 3])
def test_gradients_of_region_flux_equal_finite_differences(dim):
    cone = cone_of(dim, 2)

    def evidence(vertices, origins):
        boundary = Boundary.of_polygon(vertices) if dim == 2 else Boundary.of_mesh(vertices, triangles)
        return region_flux(cone._replace(origins=origins), boundary, tolerance=1e-3)

    if dim == 2:
        vertices = HORSESHOE
    else:
        vertices, triangles = box_mesh(torch.zeros(3).double(), torch.full((3,), 0.7).double())
    inputs = [vertices.clone().requires_grad_(), cone.origins.clone().requires_grad_()]
    assert torch.autograd.gradcheck(evidence, inputs, atol=1e-5, fast_mode=True)


# -- bad input -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("vertices", "message"),
    [
        ([[0, 0], [1, 1], [1, 0], [0, 1]], "meet"),
        ([[0, 0], [1, 0], [1, 1], [0.5, 0], [0, 1]], "meet"),  # touches itself
        ([[0, 0], [2, 0], [2, 2], [1, 2], [1, 0.5], [1, 2], [0, 2]], "meet"),
        ([[0, 0], [1, 0], [2, 0]], "folds back"),
        ([[0, 0], [1, 0], [1, 0], [0, 1]], "repeats"),
    ],
)
def test_a_polygon_that_is_not_simple_is_refused(vertices, message):
    with pytest.raises(DataError, match=message):
        Boundary.of_polygon(torch.tensor(vertices).double())


@pytest.mark.parametrize(
    "vertices", [[[0, 0], [1, 0]], [[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 0], [1, 0], [math.nan, 1]]]
)
def test_invalid_vertices_are_refused(vertices):
    with pytest.raises(InvalidArgumentError, match="vertices"):
        Boundary.of_polygon(torch.tensor(vertices).double())


def test_meshes_that_are_open_inverted_or_inconsistent_are_refused():
    vertices, triangles = box_mesh(torch.zeros(3).double(), torch.ones(3).double())
    with pytest.raises(DataError, match="one side only"):
        Boundary.of_mesh(vertices, triangles[1:])
    with pytest.raises(DataError, match="inside out"):
        Boundary.of_mesh(vertices, triangles.flip(1))
    turned = triangles.clone()
    turned[3] = turned[3].flip(0)
    with pytest.raises(DataError, match="same way"):
        Boundary.of_mesh(vertices, turned)
    with pytest.raises(DataError, match="repeats a vertex"):
        Boundary.of_mesh(vertices, torch.cat([triangles, torch.tensor([[0, 0, 1]])]))
    for wrong in (triangles + 1, triangles[:, :2], triangles.double(), triangles[:0]):
        with pytest.raises(InvalidArgumentError, match="triangles"):
            Boundary.of_mesh(vertices, wrong)


def test_a_region_of_another_dimension_is_refused():
    with pytest.raises(InvalidArgumentError, match="2-dimensional"):
        region_flux(cone_of(3, 0), Boundary.of_polygon(SQUARE))


# -- mass in boxes -------------------------------------------------------------------------------------


def mass(mean, covariance, low, high, **options):
    """Mass (P,) of Gaussians in boxes, all (P, D)."""
    nowhere, ones = torch.zeros_like(mean), torch.ones(len(mean))
    white = WhitenedCones.of(Cones(mean, covariance, nowhere, ones, ones < 0))
    return box_mass(white, low.T, high.T, **options)


@given(start=st.floats(-9, 9), span=st.floats(1e-12, 20), single=st.booleans())
def test_normal_mass_is_accurate_in_the_tails(start, span, single):
    dtype = torch.float32 if single else torch.float64
    a, s = torch.tensor([start], dtype=dtype), torch.tensor([span], dtype=dtype)
    # relative to the rounding of the end points
    middle = abs(float(a)) + float(s)
    lower, upper = (
        (float(a), float(a) + float(s)) if start + span / 2 < 0 else (-float(a) - float(s), -float(a))
    )
    expected = norm.cdf(upper) - norm.cdf(lower)
    if span < 1e-3:
        expected = span * norm.pdf(0.5 * (lower + upper))
    tolerance = (1e-4 if single else 1e-6) * (1 + middle)
    assert float(normal_mass(a, s)) == pytest.approx(expected, rel=tolerance, abs=1e-30)


def test_normal_mass_of_an_infinite_span_is_the_tail():
    start = torch.tensor([-40.0, -3.0, 0.0, 2.0, 40.0], dtype=torch.float64, requires_grad=True)
    tail = normal_mass(start, torch.full_like(start, math.inf))
    np.testing.assert_allclose(tail.detach(), norm.sf(start.detach()), rtol=1e-12)
    (slope,) = torch.autograd.grad(tail.sum(), start)
    np.testing.assert_allclose(slope, -norm.pdf(start.detach()), rtol=1e-12, atol=1e-300)


@pytest.mark.parametrize("dim", [2, 3])
def test_box_mass_equals_scipy(dim):
    generator = torch.Generator().manual_seed(dim)
    deviations = 10 ** uniform(generator, 20, dim, low=-2, high=0)
    covariance, mean = random_covariances(generator, deviations), normal(generator, 20, dim)
    center = mean + (safe_cholesky(covariance) @ normal(generator, 20, dim, 1)).squeeze(-1)
    low, high = center - uniform(generator, 20, dim, high=0.5), center + uniform(generator, 20, dim, high=0.5)
    parts = zip(mean, covariance, low, high, strict=True)
    exact = torch.tensor(
        [multivariate_normal(m, c, abseps=1e-6).cdf(b, lower_limit=a) for m, c, a, b in parts]
    )
    assert float(exact.median()) > 0.01
    for dtype in (torch.float64, torch.float32):
        error = (mass(mean, covariance, low, high, dtype=dtype) - exact).abs()
        assert float(error.max()) < 1e-4
        assert float(error.median()) < 1e-5
    assert (
        float((mass(mean, covariance, low, high, tolerance=1e-8) - exact).abs().max()) < 3e-5
    )  # scipy's own error


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("ratio", [1e-6, 1.0, 1e6])
def test_box_mass_is_exact_from_1e_6_to_1e6_component_sizes(dim, ratio):
    """Along the axes of a component its mass is a product."""
    deviations = torch.tensor([[0.001, 0.2, 2.0][:dim]], dtype=torch.float64)
    mean = torch.full((1, dim), 0.3, dtype=torch.float64)
    low = mean - 0.4 * ratio * deviations
    high = mean + 0.9 * ratio * deviations
    expected = (norm.cdf(0.9 * ratio) - norm.cdf(-0.4 * ratio)) ** dim
    got = float(mass(mean, torch.diag_embed(deviations**2), low, high))
    assert got == pytest.approx(expected, rel=1e-3, abs=1e-30)


def test_masses_of_a_partition_sum_to_one_and_are_not_negative(generator):
    covariance = random_covariances(generator, torch.tensor([[0.002, 0.3, 0.4]], dtype=torch.float64))
    steps = torch.arange(-12, 12).double() * 0.2
    low = torch.cartesian_prod(steps, steps, steps)
    n = len(low)
    parts = mass(torch.zeros(n, 3).double(), covariance.expand(n, 3, 3), low, low + 0.2)
    assert float(parts.min()) == 0  # beyond five deviations exactly
    assert float(parts.sum()) == pytest.approx(1, abs=5e-4)
    assert float((parts > 0).double().mean()) < 0.3

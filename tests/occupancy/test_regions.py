"""Flux of regions of any shape against box flux and against counted rays; bad input."""

from __future__ import annotations

import math

import pytest
import torch
from occupancy.cone_cases import draw_ends, normal, one_each, random_covariances
from scipy.spatial import ConvexHull
from torch import Tensor

from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.occupancy.cones import Cones
from gmmtorch.occupancy.forms.flux import Boundary, box_flux, region_flux

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
    several = Cones(*(torch.cat(parts) for parts in zip(*cones, strict=True)))
    several = several._replace(
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
    assert torch.autograd.gradcheck(evidence, inputs, atol=1e-5)


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

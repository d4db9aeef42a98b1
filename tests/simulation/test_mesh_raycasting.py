"""Rays against segments and triangles: analytic cases, a linear solver, and shared edges."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.simulation import mesh_raycasting
from gmmtorch.simulation.furniture import ball, box, circle, prism
from gmmtorch.simulation.mesh_raycasting import ray_segments, ray_triangles

DTYPE = torch.float64


def tensor(values) -> Tensor:
    return torch.tensor(values, dtype=DTYPE)


def random(shape: tuple[int, ...], seed: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=DTYPE)


def solve_all_pairs(origins: Tensor, directions: Tensor, primitives: Tensor) -> Tensor:
    """Distances (N,) from a linear system per pair: o + t d = a + Σ s_k e_k, s_k ≥ 0, Σ s_k ≤ 1, t > 0."""
    edges = primitives[:, 1:] - primitives[:, :1]
    n, s, dim = directions.shape[0], primitives.shape[0], primitives.shape[2]
    columns = torch.cat(
        [-directions[:, None, None].expand(n, s, 1, dim), edges[None].expand(n, s, dim - 1, dim)], 2
    )
    right = origins.expand(n, dim)[:, None] - primitives[:, 0]
    solution = torch.linalg.solve(columns.mT, right[..., None])[..., 0]
    t, weights = solution[..., 0], solution[..., 1:]
    inside = (weights >= 0).all(-1) & (weights.sum(-1) <= 1) & (t > 0)
    return torch.where(inside, t, torch.inf).amin(1)


@pytest.mark.parametrize(
    ("cast", "dim", "one_origin"),
    [(ray_segments, 2, True), (ray_segments, 2, False), (ray_triangles, 3, True)],
)
def test_distances_agree_with_a_linear_solver(cast, dim, one_origin):
    primitives = random((4 if dim == 2 else 60, dim, dim), 0)
    origins = random((dim,), 1) if one_origin else random((500, dim), 1)
    directions = random((500, dim), 2)
    found, expected = cast(origins, directions, primitives), solve_all_pairs(origins, directions, primitives)
    assert 0.2 < float(torch.isfinite(expected).double().mean()) < 0.999
    torch.testing.assert_close(found, expected)


@pytest.mark.parametrize(("cast", "dim"), [(ray_segments, 2), (ray_triangles, 3)])
def test_chunk_sizes_do_not_change_the_distances(cast, dim, monkeypatch):
    primitives, directions = random((30, dim, dim), 0), random((200, dim), 1)
    whole = cast(torch.zeros(dim), directions, primitives)
    monkeypatch.setattr(mesh_raycasting, "_CHUNK_PAIRS", 64)
    monkeypatch.setattr(mesh_raycasting, "_CHUNK_CONES", 64)
    monkeypatch.setattr(mesh_raycasting, "_CHUNK_HITS", 16)
    torch.testing.assert_close(cast(torch.zeros(dim), directions, primitives), whole)


def test_bundles_give_the_same_distances_as_all_pairs():
    """Small and large triangles, some around the origin; directions of any length, along axes, and single."""
    small, large = 0.1 * random((300, 3, 3), 6) + 3 * random((300, 1, 3), 7), 5 * random((40, 3, 3), 8)
    around = torch.cat(
        [random((5, 3, 3), 9) - random((5, 3, 3), 9).mean(1, keepdim=True), torch.eye(3).double()[None]]
    )
    directions = torch.cat([7 * random((4000, 3), 10), torch.eye(3).double(), -torch.eye(3).double()])
    origin = tensor([0.2, -0.1, 0.3])
    triangles = torch.cat([small, large, around + origin + 1e-3])
    for some in (directions, directions[:1], directions[-3:]):
        expected = torch.cat([solve_all_pairs(origin, part, triangles) for part in some.split(500)])
        torch.testing.assert_close(ray_triangles(origin, some, triangles), expected)


def test_distances_to_a_segment_are_multiples_of_the_direction():
    wall = tensor([[[2.0, -1.0], [2.0, 1.0]]])
    directions = tensor([[1, 0], [-1, 0], [2, 0], [1, 0.5], [1, 0.6], [0, 1]])
    found = ray_segments(tensor([0.0, 0.0]), directions, wall)
    assert found.tolist() == [2.0, math.inf, 1.0, 2.0, math.inf, math.inf]


def test_a_ray_parallel_to_a_primitive_does_not_hit_it():
    assert ray_segments(tensor([0.0, 0.0]), tensor([[1.0, 0.0]]), tensor([[[1.0, 0], [2, 0]]])).tolist() == [
        math.inf
    ]
    slanted = tensor([[1.0, 0.1, 0.2], [2.0, 0.3, -0.7], [2.5, -1.0, 0.4]])
    inside = slanted.mean(0)
    along = torch.nn.functional.normalize(random((200, 2), 3) @ (slanted[1:] - slanted[0]), dim=1)
    assert bool(torch.isinf(ray_triangles(inside, along, slanted[None])).all())


def test_both_faces_of_a_triangle_are_hit_and_nothing_behind_the_origin():
    triangle = tensor([[[-1.0, -1, 3], [1, -1, 3], [0, 1, 3]]])
    up, down = tensor([[0.0, 0, 1]]), tensor([[0.0, 0, -1]])
    assert ray_triangles(tensor([0.0, 0, 0]), up, triangle).tolist() == [3.0]
    assert ray_triangles(tensor([0.0, 0, 5]), down, triangle).tolist() == [2.0]
    assert ray_triangles(tensor([0.0, 0, 5]), up, triangle).tolist() == [math.inf]


def test_rays_at_edges_and_corners_hit():
    cube = box((-1, -1, -1), (1, 1, 1))
    corners = cube.reshape(-1, 3)
    weights = torch.linspace(0, 1, 33, dtype=DTYPE)[:, None, None]
    along_edges = (cube * weights[:, :, None] + cube.roll(1, 1) * (1 - weights[:, :, None])).reshape(-1, 3)
    for origin in (tensor([0.0, 0, 0]), tensor([0.1, 0.2, 0.3]), tensor([1 / 3, -0.7, 1e-9])):
        for target in (corners, along_edges):
            distance = ray_triangles(origin, target - origin, cube)
            torch.testing.assert_close(distance, torch.ones_like(distance))
    ring = circle(1.0, 360)
    segments = torch.stack([ring, ring.roll(-1, 0)], 1)
    distance = ray_segments(tensor([0.1, 0.2]), ring - tensor([0.1, 0.2]), segments)
    torch.testing.assert_close(distance, torch.ones_like(distance))


def test_ball_has_its_radius_within_the_facet_error():
    directions = torch.nn.functional.normalize(random((2000, 3), 5), dim=1)
    distance = ray_triangles(tensor([1.0, 2, 3]), directions, ball((1.0, 2.0, 3.0), 2.0, 32))
    assert bool((distance <= 2 + 1e-12).all())
    assert bool((distance > 2 * math.cos(math.pi / 32) ** 2 - 1e-9).all())


def test_prism_has_the_exact_volume():
    drum = prism(circle(0.5, 24), 1.0, 3.0)
    volume = float((drum[:, 0] * torch.linalg.cross(drum[:, 1], drum[:, 2])).sum() / 6)
    assert volume == pytest.approx(2.0 * 12 * 0.25 * math.sin(2 * math.pi / 24))


@pytest.mark.parametrize(("cast", "dim"), [(ray_segments, 2), (ray_triangles, 3)])
def test_no_primitives_give_infinity_and_no_rays_give_nothing(cast, dim):
    assert (
        torch.isinf(cast(torch.zeros(dim), torch.ones(3, dim), torch.empty(0, dim, dim))).tolist()
        == [True] * 3
    )
    assert cast(torch.zeros(dim), torch.empty(0, dim), torch.ones(4, dim, dim)).shape == (0,)


@pytest.mark.parametrize(
    ("origins", "directions", "triangles", "message"),
    [
        ((2,), (5, 3), (1, 3, 3), "origin has"),
        ((4, 3), (5, 3), (1, 3, 3), "origin has"),
        ((3,), (5, 2), (1, 3, 3), "directions"),
        ((3,), (3,), (1, 3, 3), "directions"),
        ((3,), (5, 3), (1, 2, 3), "triangles"),
    ],
)
def test_ray_triangles_rejects_shapes_that_do_not_match(origins, directions, triangles, message):
    with pytest.raises(InvalidArgumentError, match=message):
        ray_triangles(torch.zeros(origins), torch.ones(directions), torch.zeros(triangles))

"""Rays against triangles, and distances to them: a linear solver, Open3D, shared edges, hostile meshes."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from kernels.twins import by_both
from torch import Tensor

from gmmtorch.kernels import first_hits, nearest_triangles, triangle_tree
from gmmtorch.simulation.furniture import ball, box

DTYPE = torch.float64


def tensor(values) -> Tensor:
    return torch.tensor(values, dtype=DTYPE)


def random(shape: tuple[int, ...], seed: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=DTYPE)


def solve_all_pairs(origins: Tensor, directions: Tensor, triangles: Tensor) -> Tensor:
    """Distances (N,) from a linear system per pair: o + t d = a + Σ s_k e_k, s_k ≥ 0, Σ s_k ≤ 1, t > 0."""
    edges = triangles[:, 1:] - triangles[:, :1]
    n, s = len(directions), len(triangles)
    columns = torch.cat([-directions[:, None, None].expand(n, s, 1, 3), edges[None].expand(n, s, 2, 3)], 2)
    right = origins.expand(n, 3)[:, None] - triangles[:, 0]
    solution = torch.linalg.solve(columns.mT, right[..., None])[..., 0]
    t, weights = solution[..., 0], solution[..., 1:]
    inside = (weights >= 0).all(-1) & (weights.sum(-1) <= 1) & (t > 0)
    return torch.where(inside, t, torch.inf).amin(1)


def nearest_of_all_faces(points: Tensor, triangles: Tensor) -> Tensor:
    """Distances (N,): the nearest point is the projection to a corner, an edge or the plane of a triangle, of
    those that lie in it."""
    best = torch.full_like(points[:, 0], torch.inf)
    for size in (1, 2, 3):
        for corners in itertools.combinations(range(3), size):
            a, *others = triangles[:, list(corners)].unbind(1)
            away = points[:, None] - a
            weights = away.new_zeros(*away.shape[:2], 0)
            if others:
                edges = torch.stack(others, 2) - a[:, :, None]  # (T, 3, size − 1)
                weights = (torch.linalg.pinv(edges)[None] @ away[..., None])[..., 0]
                away = away - (edges[None] @ weights[..., None])[..., 0]
            inside = (weights >= 0).all(2) & (weights.sum(2) <= 1)
            best = torch.minimum(best, torch.where(inside, away.norm(dim=2), torch.inf).amin(1))
    return best


def mixed(seed: int) -> Tensor:
    """Small and large triangles, needles, and some around the origin."""
    small, large = (
        0.1 * random((300, 3, 3), seed) + 3 * random((300, 1, 3), seed + 1),
        5 * random((40, 3, 3), 8),
    )
    needles = random((50, 1, 3), seed + 2) + random((50, 3, 3), seed + 3) * tensor([3.0, 1e-3, 1e-4])
    return torch.cat([small, large, needles, random((5, 3, 3), seed + 4)])


@pytest.mark.parametrize("n", [1, 2, 3, 7, 60, 395])
def test_first_hits_agree_with_a_linear_solver(n):
    triangles = mixed(0)[-n:]
    tree = triangle_tree(triangles)
    directions = torch.cat([7 * random((4000, 3), 10), torch.eye(3, dtype=DTYPE), -torch.eye(3, dtype=DTYPE)])
    one, each = tensor([0.2, -0.1, 0.3]), random((4006, 3), 11)
    for origins in (one, each):
        places = origins.expand(4006, 3)
        expected = [
            solve_all_pairs(places[i : i + 500], directions[i : i + 500], triangles)
            for i in range(0, 4006, 500)
        ]
        for found in by_both(lambda origins=origins: first_hits(tree, origins, directions)):
            torch.testing.assert_close(found, torch.cat(expected))


@pytest.mark.parametrize("n", [1, 2, 60, 395])
def test_nearest_triangles_agree_with_the_projections_to_all_faces(n):
    triangles = mixed(0)[-n:]
    tree = triangle_tree(triangles)
    points = torch.cat([5 * random((800, 3), 20), triangles[:3].flatten(0, 1), triangles[:3].mean(1)])
    for found in by_both(lambda: nearest_triangles(tree, points)):
        torch.testing.assert_close(found, nearest_of_all_faces(points, triangles), rtol=1e-9, atol=1e-9)


@pytest.mark.cpu_only
def test_results_are_those_of_open3d():
    open3d = pytest.importorskip("open3d")
    triangles = torch.cat([box((-4, -3, -1), (5, 3, 2)), ball((1.0, 1.0, 0.0), 0.8, 24), mixed(3) / 4])
    scene = open3d.t.geometry.RaycastingScene()
    faces = torch.arange(3 * len(triangles), dtype=torch.int32).view(-1, 3).numpy().astype("uint32")
    scene.add_triangles(open3d.core.Tensor(triangles.view(-1, 3).float().numpy()), open3d.core.Tensor(faces))
    origins, directions = random((3000, 3), 30), torch.nn.functional.normalize(random((3000, 3), 31), dim=1)
    rays = torch.cat([origins, directions], 1).float().numpy()
    theirs = torch.from_numpy(scene.cast_rays(open3d.core.Tensor(rays))["t_hit"].numpy()).double()
    ours = first_hits(triangle_tree(triangles), origins, directions)
    assert (
        float(torch.isclose(ours, theirs, rtol=0, atol=1e-4).double().mean()) > 0.995
    )  # theirs miss needles
    near = torch.from_numpy(scene.compute_distance(open3d.core.Tensor(rays[:, :3].copy())).numpy()).double()
    gap = near - nearest_triangles(triangle_tree(triangles), origins)
    assert float(gap.min()) > -1e-5
    assert float((gap < 1e-4).double().mean()) > 0.99


def test_a_ray_in_the_plane_of_a_triangle_does_not_hit_it():
    slanted = tensor([[1.0, 0.1, 0.2], [2.0, 0.3, -0.7], [2.5, -1.0, 0.4]])
    along = torch.nn.functional.normalize(random((200, 2), 3) @ (slanted[1:] - slanted[0]), dim=1)
    for found in by_both(lambda: first_hits(triangle_tree(slanted[None]), slanted.mean(0), along)):
        assert bool(torch.isinf(found).all())


def test_both_faces_of_a_triangle_are_hit_and_nothing_behind_the_origin():
    tree = triangle_tree(tensor([[[-1.0, -1, 3], [1, -1, 3], [0, 1, 3]]]))
    origins, directions = (
        tensor([[0.0, 0, 0], [0, 0, 5], [0, 0, 5]]),
        tensor([[0.0, 0, 1], [0, 0, -1], [0, 0, 1]]),
    )
    for found in by_both(lambda: first_hits(tree, origins, directions)):
        assert found.tolist() == [3.0, 2.0, math.inf]


@pytest.mark.parametrize("place", [0.0, 5e5])
def test_rays_at_edges_and_corners_hit(place, device):
    cube = box((-1, -1, -1), (1, 1, 1)).to(device) + place
    corners = cube.reshape(-1, 3)
    weights = torch.linspace(0, 1, 33, dtype=DTYPE)[:, None, None]
    along_edges = (cube * weights[:, :, None] + cube.roll(1, 1) * (1 - weights[:, :, None])).reshape(-1, 3)
    tree = triangle_tree(cube)
    for start in ([0.0, 0, 0], [0.1, 0.2, 0.3], [1 / 3, -0.7, 1e-9]):
        origin = tensor(start) + place
        for target in (corners, along_edges):
            for distance in by_both(lambda o=origin, t=target: first_hits(tree, o, t - o)):
                assert float((distance - 1).abs().max()) < 1e-9


def test_rays_from_500_km_away_hit():
    triangles = mixed(5)
    directions = random((2000, 3), 40)
    away = torch.nn.functional.normalize(random((2000, 3), 41), dim=1)
    target = (triangles[torch.arange(2000) % len(triangles)] * tensor([0.2, 0.3, 0.5])[:, None]).sum(1)
    origins = target + 5e5 * away
    tree = triangle_tree(triangles)
    for found in by_both(lambda: first_hits(tree, origins, -away)):
        assert bool((found <= 5e5 + 1e-6).all())
    for found in by_both(lambda: nearest_triangles(tree, origins)):
        assert bool((found <= 5e5 + 1e-6).all())
        assert bool((found > 5e5 - 50).all())
    assert bool(torch.isinf(first_hits(tree, origins, away + 1e-3 * directions)).all())


def test_triangles_without_area_are_lines_and_points_and_are_not_hit():
    line, point = tensor([[0.0, 0, 1], [2, 0, 1], [1, 0, 1]]), tensor([[0.0, 5, 0]] * 3)
    tree = triangle_tree(torch.stack([line, point]))
    down = tensor([[0.0, 0, -1]])
    for found in by_both(lambda: first_hits(tree, tensor([[1.0, 0, 3]]), down)):
        assert found.tolist() == [math.inf]
    points = tensor([[1.0, 0, 3], [3.0, 0, 1], [0, 5, 4], [0, 5, 0]])
    for found in by_both(lambda: nearest_triangles(tree, points)):
        assert found.tolist() == [2.0, 1.0, 4.0, 0.0]


def test_rays_that_are_not_finite_hit_nothing_and_change_no_other():
    tree = triangle_tree(tensor([[[-1.0, -1, 3], [1, -1, 3], [0, 1, 3]]]))
    directions = tensor(
        [[0, 0, 1.0], [math.nan, 0, 1], [0, 0, math.inf], [0, 0, 0], [0, 0, 1], [-0.0, 0.0, 2]]
    )
    origins = torch.zeros(6, 3, dtype=DTYPE)
    origins[4, 1] = math.inf
    for found in by_both(lambda: first_hits(tree, origins, directions)):
        assert found.tolist() == [3.0, *[math.inf] * 4, 1.5]
    for found in by_both(lambda: first_hits(tree, origins[:0], directions[:0])):
        assert found.shape == (0,)
    for found in by_both(lambda: nearest_triangles(tree, origins[:0])):
        assert found.shape == (0,)


def depth_of(tree) -> int:
    """Nodes on the longest way from the root."""
    nodes, depth = tree.children[-1:].cpu(), 1
    while True:
        inner = nodes[nodes >= 0].long()
        if len(inner) == 0:
            return depth
        nodes, depth = tree.children.cpu()[inner], depth + 1


def test_hostile_meshes_make_no_deep_tree(device):
    one = box((0, 0, 0), (1, 1, 1))[:1].to(device)
    nested = one * 2.0 ** torch.arange(-300, 300).double()[:, None, None]
    equal = one.expand(5000, 3, 3)
    row = one + torch.arange(4096).double()[:, None, None]
    for triangles in (nested, equal, row):
        tree = triangle_tree(triangles)
        assert len(tree.boxes) == len(triangles) - 1
        assert sorted((~tree.children[tree.children < 0]).tolist()) == list(range(len(triangles)))
        assert depth_of(tree) < 100


def test_a_million_triangles(generator):
    side = torch.arange(708, dtype=DTYPE) / 707
    height = 0.02 * torch.rand(708, 708, generator=generator, dtype=DTYPE)
    grid = torch.stack([*torch.meshgrid(side, side, indexing="ij"), height], -1)
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    triangles = torch.cat([torch.stack([a, b, c], 2), torch.stack([a, c, d], 2)]).reshape(-1, 3, 3)
    tree = triangle_tree(triangles)
    at = torch.rand(20_000, 2, generator=generator, dtype=DTYPE) * 0.999
    origins = torch.cat([at, torch.ones_like(at[:, :1])], 1)
    fall = first_hits(tree, origins, tensor([[0.0, 0, -1]]).expand(20_000, 3))
    cell = (at * 707).floor()
    u, v = (at * 707 - cell).unbind(1)
    i, j = cell.long().unbind(1)
    h00, h10, h11, h01 = height[i, j], height[i + 1, j], height[i + 1, j + 1], height[i, j + 1]
    lower = h00 + u * (h10 - h00) + v * (h11 - h10)
    upper = h00 + v * (h01 - h00) + u * (h11 - h01)
    torch.testing.assert_close(fall, 1 - torch.where(u >= v, lower, upper))

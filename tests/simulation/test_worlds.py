"""The buildings: closed where they should be, walkable along their path, furnished by the seed."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from gmmtorch.simulation import building_2d, building_3d, poses_3d, spinning_lidar
from gmmtorch.simulation.worlds.floor_plan import Footprint, Room, circle, place

SEEDS = range(6)
CLEARANCE = 0.4


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def to_segments(points: Tensor, segments: Tensor) -> Tensor:
    """Distance (N,) from points (N, 2) to the nearest of segments (S, 2, 2)."""
    a, edge = segments[:, 0], segments[:, 1] - segments[:, 0]
    offset = points[:, None] - a
    share = ((offset * edge).sum(-1) / (edge * edge).sum(-1)).clamp(0, 1)
    return (offset - share[..., None] * edge).norm(dim=-1).amin(1)


def crossings(path: Tensor, segments: Tensor) -> int:
    """How often a path (P, 2) crosses segments (S, 2, 2), by the orientation of four triangles."""

    def side(p: Tensor, q: Tensor, r: Tensor) -> Tensor:
        u, v = q - p, r - p
        return torch.sign(u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0])

    p, q = path[:-1, None], path[1:, None]
    a, b = segments[:, 0], segments[:, 1]
    return int(((side(p, q, a) * side(p, q, b) < 0) & (side(a, b, p) * side(a, b, q) < 0)).sum())


@pytest.mark.parametrize("seed", SEEDS)
def test_the_path_of_the_plane_building_stays_clear(seed):
    world = building_2d(generator(seed))
    assert float(to_segments(world.path, world.segments).min()) > CLEARANCE
    assert crossings(world.path, world.segments) == 0


@pytest.mark.parametrize("seed", SEEDS[:3])
def test_the_path_of_the_hall_stays_clear(seed):
    """Rays all around at many heights, from all along the path, meet nothing near but floor and ceiling."""
    world = building_3d(generator(seed))
    ring = torch.cat([circle(1.0, 32), torch.zeros(32, 1, dtype=torch.float64)], 1)
    stations = world.path[::12]
    for height in (0.1, 0.73, 1.2, 1.4):
        origins = torch.cat([stations, torch.full_like(stations[:, :1], height)], 1)
        distance = world.distances(origins.repeat_interleave(32, 0), ring.repeat(len(stations), 1))
        assert float(distance.min()) > CLEARANCE
    steps = stations[1:] - stations[:-1]
    low = torch.full_like(stations[:-1, :1], 1.0)
    ahead = world.distances(torch.cat([stations[:-1], low], 1), torch.cat([steps, torch.zeros_like(low)], 1))
    assert bool((ahead > 1).all())


def test_the_plane_building_is_closed_and_its_corridor_is_long():
    world = building_2d(generator())
    ring = circle(1.0, 720)
    for origin in world.path[::60]:
        distance = world.distances(origin, ring)
        assert bool(torch.isfinite(distance).all())
        ends = origin + distance[:, None] * ring
        assert bool(((ends > 0) & (ends < torch.tensor([30.0, 20.0]))).all())
    down_the_corridor = world.distances(world.path[0], torch.tensor([[1.0, 0.0]]).double())
    assert float(down_the_corridor) > 20


def test_the_hall_is_open_at_its_windows_only():
    world = building_3d(generator())
    sensor = spinning_lidar(24, 120, (-1.2, 1.2))
    for pose in poses_3d(world.path, 12, 1.2):
        origin, directions = pose[:3, 3], sensor.directions @ pose[:3, :3].T
        distance = world.distances(origin, directions)
        outside = torch.isinf(distance)
        wall = (
            origin + directions * ((0.1 - origin[1]) / directions[:, 1])[:, None]
        )  # where the south wall is
        x, z = wall[outside, 0], wall[outside, 2]
        assert bool((directions[outside, 1] < 0).all())
        assert bool(((z > 0.9) & (z < 2.6)).all())
        assert bool((((x > 1.5) & (x < 4.0)) | ((x > 5.5) & (x < 8.0)) | ((x > 10.5) & (x < 12.5))).all())


@pytest.mark.parametrize("build", [building_2d, building_3d])
def test_the_seed_decides_and_nothing_else(build):
    first, again, other = (build(generator(seed)) for seed in (3, 3, 4))
    surfaces = [
        getattr(w, "segments", None) if build is building_2d else w.triangles for w in (first, again, other)
    ]
    assert torch.equal(surfaces[0], surfaces[1])
    assert surfaces[0].shape != surfaces[2].shape or not torch.equal(surfaces[0], surfaces[2])
    assert torch.equal(first.path, other.path)
    assert bool(torch.isfinite(surfaces[0]).all())


def test_no_triangle_of_the_hall_is_degenerate():
    triangles = building_3d(generator()).triangles
    edges = triangles[:, 1:] - triangles[:, :1]
    assert float(torch.linalg.cross(edges[:, 0], edges[:, 1]).norm(dim=1).min()) > 1e-5


def test_a_footprint_knows_what_it_contains():
    spot = Footprint(1.0, 2.0, math.pi / 2, 2.0, 1.0)
    points = torch.tensor([[1.0, 2.9], [1.9, 2.0], [1.4, 2.0], [1.0, 3.1]], dtype=torch.float64)
    assert spot.contains(points).tolist() == [True, False, True, False]
    assert spot.contains(points, 0.5).tolist() == [True, True, True, True]
    assert spot.outline().shape == (40, 2)


def test_a_place_keeps_off_the_path_and_what_stands_there():
    room, path = (
        Room(0.0, 0.0, 5.0, 5.0),
        torch.tensor([[0.0, 2.5], [2.5, 2.5], [5.0, 2.5]], dtype=torch.float64),
    )
    taken: list[Footprint] = []
    g = generator()
    for _ in range(12):
        spot = place(room, (0.8, 0.5), path, taken, g, clearance=0.6)
        if spot is not None:
            assert not bool(spot.contains(path, 0.6).any())
            assert not any(bool(other.contains(spot.outline()).any()) for other in taken)
            taken.append(spot)
    assert len(taken) >= 4
    assert place(room, (9.0, 9.0), path, [], g) is None

"""The office and the hall: closed walls, free paths, and furniture drawn by the seed."""

from __future__ import annotations

import functools
import itertools
import math

import pytest
import torch
from torch import Tensor

from gmmtorch.simulation import World2D, World3D, building_2d, building_3d, poses_3d, spinning_lidar
from gmmtorch.simulation.furniture import Footprint, Room, circle, place

CLEARANCE = 0.4


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@functools.cache
def office(seed: int) -> World2D:
    return building_2d(generator(seed))


@functools.cache
def hall(seed: int) -> World3D:
    return building_3d(generator(seed))


def distance_to_segments(points: Tensor, segments: Tensor) -> Tensor:
    """Distance (N,) from points (N, 2) to the nearest of segments (S, 2, 2)."""
    a, edge = segments[:, 0], segments[:, 1] - segments[:, 0]
    offset = points[:, None] - a
    share = ((offset * edge).sum(-1) / (edge * edge).sum(-1)).clamp(0, 1)
    return (offset - share[..., None] * edge).norm(dim=-1).amin(1)


def count_crossings(path: Tensor, segments: Tensor) -> int:
    """Number of crossings of a path (P, 2) with segments (S, 2, 2), by the orientation of four triangles."""

    def side(p: Tensor, q: Tensor, r: Tensor) -> Tensor:
        u, v = q - p, r - p
        return torch.sign(u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0])

    p, q = path[:-1, None], path[1:, None]
    a, b = segments[:, 0], segments[:, 1]
    return int(((side(p, q, a) * side(p, q, b) < 0) & (side(a, b, p) * side(a, b, q) < 0)).sum())


def test_office_path_is_clear_of_walls_and_furniture():
    world = office(0)
    path = world.path[::2]
    assert float(distance_to_segments(path, world.segments).min()) > CLEARANCE
    assert count_crossings(path, world.segments) == 0


@pytest.mark.parametrize("seed", range(2))
def test_hall_path_is_clear_of_walls_and_furniture(seed):
    """Horizontal rays from the path, at several heights, hit nothing within the clearance."""
    world = hall(seed)
    ring = torch.cat([circle(1.0, 24), torch.zeros(24, 1, dtype=torch.float64)], 1)
    stations = world.path[::20]
    for here, ahead in itertools.pairwise(stations):
        for height in (0.1, 0.73, 1.4):
            origin = torch.cat([here, torch.tensor([height])])
            assert float(world.distances(origin, ring).min()) > CLEARANCE
        step = torch.cat([ahead - here, torch.zeros(1)])[None]
        assert float(world.distances(origin, step)) > 1


def test_office_is_closed_and_its_corridor_is_long():
    world, ring = office(0), circle(1.0, 720)
    for origin in world.path[::200]:
        distance = world.distances(origin, ring)
        assert bool(torch.isfinite(distance).all())
        ends = origin + distance[:, None] * ring
        assert bool(((ends > 0) & (ends < torch.tensor([30.0, 20.0]))).all())
    assert float(world.distances(world.path[0], torch.tensor([[1.0, 0.0]]).double())) > 20


def test_hall_is_open_only_at_its_windows():
    world = hall(0)
    sensor = spinning_lidar(24, 120, (-1.2, 1.2))
    for pose in poses_3d(world.path, 8, 1.2):
        origin, directions = pose[:3, 3], sensor.directions @ pose[:3, :3].T
        distance = world.distances(origin, directions)
        outside = torch.isinf(distance)
        at_south_wall = origin + directions * ((0.1 - origin[1]) / directions[:, 1])[:, None]
        x, z = at_south_wall[outside, 0], at_south_wall[outside, 2]
        assert bool((directions[outside, 1] < 0).all())
        assert bool(((z > 0.9) & (z < 2.6)).all())
        assert bool((((x > 1.5) & (x < 4.0)) | ((x > 5.5) & (x < 8.0)) | ((x > 10.5) & (x < 12.5))).all())


def test_buildings_depend_only_on_the_seed():
    again = building_2d(generator(0)).segments, building_3d(generator(0)).triangles
    first, other = (office(0).segments, hall(0).triangles), (office(1).segments, hall(1).triangles)
    for a, b, c in zip(first, again, other, strict=True):
        assert torch.equal(a, b)
        assert a.shape != c.shape or not torch.equal(a, c)
        assert bool(torch.isfinite(a).all())
    assert torch.equal(office(0).path, office(1).path)
    assert torch.equal(hall(0).path, hall(1).path)


def test_footprint_contains_points_within_the_margin():
    spot = Footprint(1.0, 2.0, math.pi / 2, 2.0, 1.0)
    points = torch.tensor([[1.0, 2.9], [1.9, 2.0], [1.4, 2.0], [1.0, 3.1]], dtype=torch.float64)
    assert spot.contains(points).tolist() == [True, False, True, False]
    assert spot.contains(points, 0.5).tolist() == [True, True, True, True]
    assert spot.outline().shape == (40, 2)


def test_place_avoids_the_path_and_other_furniture():
    room = Room(0.0, 0.0, 5.0, 5.0)
    path = torch.tensor([[0.0, 2.5], [2.5, 2.5], [5.0, 2.5]], dtype=torch.float64)
    taken: list[Footprint] = []
    g = generator()
    for _ in range(12):
        spot = place(room, (0.8, 0.5), path, taken, g)
        if spot is not None:
            assert not bool(spot.contains(path, 0.6).any())
            assert not any(bool(other.contains(spot.outline()).any()) for other in taken)
            taken.append(spot)
    assert len(taken) >= 4
    assert place(room, (9.0, 9.0), path, [], g) is None

"""Worlds of triangles: distances against arithmetic, and walks that stay inside and in sight."""

from __future__ import annotations

import itertools

import pytest
import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.simulation import ray_triangles
from gmmtorch.simulation.worlds.mesh_world import MeshWorld


def box(low: tuple[float, ...], high: tuple[float, ...]) -> Tensor:
    """Twelve triangles (12, 3, 3): the faces of a box."""
    faces = []
    for axis, side in itertools.product(range(3), (0, 1)):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        corner = torch.empty(4, 3, dtype=torch.float64)
        corner[:, axis] = (low, high)[side][axis]
        corner[:, u] = torch.tensor([low[u], high[u], high[u], low[u]])
        corner[:, v] = torch.tensor([low[v], low[v], high[v], high[v]])
        faces += [corner[[0, 1, 2]], corner[[0, 2, 3]]]
    return torch.stack(faces)


HALL = box((0, 0, 0), (20, 6, 3))
SMALL = box((40, 0, 0), (44, 4, 3))


def test_distances_are_those_of_a_ray_caster_in_plain_torch(generator):
    world = MeshWorld(torch.cat([HALL, box((8, 2, 0), (9, 3, 2))]))
    directions = torch.nn.functional.normalize(
        torch.randn(500, 3, generator=generator, dtype=torch.float64), dim=1
    )
    origin = torch.tensor([4.0, 3.0, 1.2], dtype=torch.float64)
    exact = ray_triangles(origin, directions, torch.cat([HALL, box((8, 2, 0), (9, 3, 2))]))
    assert (world.distances(origin, directions) - exact).abs().max() < 1e-4


def test_far_from_the_origin_nothing_is_lost():
    shift = torch.tensor([5e5, -4e6, 100.0], dtype=torch.float64)
    there = MeshWorld(HALL + shift)
    ahead = torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0, -1]], dtype=torch.float64)
    origin = torch.tensor([3.0, 2.0, 1.25], dtype=torch.float64)
    found = there.distances(origin + shift, ahead)
    assert torch.allclose(found, torch.tensor([17.0, 4.0, 1.25], dtype=torch.float64), atol=1e-5)
    assert torch.allclose(there.clearance((origin + shift)[None]), torch.tensor([1.25], dtype=torch.float64))


def test_places_stand_above_the_floor_away_from_walls_and_inside():
    places = MeshWorld(torch.cat([HALL, SMALL])).standing_places(height=1.2, clearance=0.5)
    assert torch.allclose(places[:, 2], torch.full((len(places),), 1.2, dtype=torch.float64), atol=1e-4)
    in_hall = (places[:, 0] < 20) & (places[:, :2].amin(1) >= 0.5 - 1e-5) & (places[:, 1] <= 5.5 + 1e-5)
    in_small = (places[:, 0] > 40.4) & (places[:, 0] < 43.6) & (places[:, 1] < 3.6)
    assert bool((in_hall | in_small).all())
    assert bool(in_hall.any())
    assert bool(in_small.any())
    # On the roofs there is a floor to stand on, but nothing around.
    assert float(places[:, 2].max()) < 2


def test_a_walk_stays_in_the_largest_part_and_in_sight_of_where_it_was():
    world = MeshWorld(torch.cat([HALL, SMALL]))
    stops = world.tour(15, stride=1)
    assert stops.shape == (15, 3)
    assert float(stops[:, 0].max()) < 20
    step = stops[1:] - stops[:-1]
    length = step.norm(dim=1)
    assert float(length.max()) <= 1.5 + 1e-6
    assert float(length.min()) > 0
    assert bool((world.distances(stops[:-1], step / length[:, None]) > length).all())
    assert float(stops[:, 0].max() - stops[:, 0].min()) > 10  # it goes along the hall, not to and fro


def test_a_walk_that_has_seen_everything_spreads_its_stops():
    stops = MeshWorld(SMALL).tour(50, stride=3)
    assert stops.shape == (50, 3)
    assert bool(torch.isfinite(stops).all())
    assert torch.equal(stops, MeshWorld(SMALL).tour(50, stride=3))


def test_a_world_without_room_is_refused():
    with pytest.raises(InvalidArgumentError, match="no place where a sensor can be carried"):
        MeshWorld(box((0, 0, 0), (0.3, 0.3, 0.3))).tour(3)
    with pytest.raises(InvalidArgumentError, match="spacing=0"):
        MeshWorld(HALL).tour(3, spacing=0)

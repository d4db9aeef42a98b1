"""Mesh worlds: distances against arithmetic, standing places, tours, and checks of a mesh."""

from __future__ import annotations

import logging

import pytest
import torch

from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.simulation import ray_triangles
from gmmtorch.simulation.furniture import box
from gmmtorch.simulation.mesh_world import MeshWorld, checked_triangles

HALL = box((0, 0, 0), (20, 6, 3))
SMALL = box((40, 0, 0), (44, 4, 3))


def test_mesh_world_distances_equal_those_of_ray_triangles(generator):
    world = MeshWorld(torch.cat([HALL, box((8, 2, 0), (9, 3, 2))]))
    directions = torch.nn.functional.normalize(
        torch.randn(500, 3, generator=generator, dtype=torch.float64), dim=1
    )
    origin = torch.tensor([4.0, 3.0, 1.2], dtype=torch.float64)
    exact = ray_triangles(origin, directions, torch.cat([HALL, box((8, 2, 0), (9, 3, 2))]))
    assert (world.distances(origin, directions) - exact).abs().max() < 1e-4


def test_mesh_world_is_exact_far_from_the_origin():
    shift = torch.tensor([5e5, -4e6, 100.0], dtype=torch.float64)
    there = MeshWorld(HALL + shift)
    ahead = torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0, -1]], dtype=torch.float64)
    origin = torch.tensor([3.0, 2.0, 1.25], dtype=torch.float64)
    found = there.distances(origin + shift, ahead)
    assert torch.allclose(found, torch.tensor([17.0, 4.0, 1.25], dtype=torch.float64), atol=1e-5)
    assert torch.allclose(there.clearance((origin + shift)[None]), torch.tensor([1.25], dtype=torch.float64))


def test_standing_places_are_indoors_above_the_floor_and_clear_of_walls():
    places = MeshWorld(torch.cat([HALL, SMALL])).standing_places(height=1.2, clearance=0.5)
    assert torch.allclose(places[:, 2], torch.full((len(places),), 1.2, dtype=torch.float64), atol=1e-4)
    in_hall = (places[:, 0] < 20) & (places[:, :2].amin(1) >= 0.5 - 1e-5) & (places[:, 1] <= 5.5 + 1e-5)
    in_small = (places[:, 0] > 40.4) & (places[:, 0] < 43.6) & (places[:, 1] < 3.6)
    assert bool((in_hall | in_small).all())
    assert bool(in_hall.any())
    assert bool(in_small.any())
    # A roof is a floor without walls around it.
    assert float(places[:, 2].max()) < 2


def test_a_tour_stays_in_the_largest_part_and_steps_along_free_lines():
    world = MeshWorld(torch.cat([HALL, SMALL]))
    stops = world.tour(15, stride=1)
    assert stops.shape == (15, 3)
    assert float(stops[:, 0].max()) < 20
    step = stops[1:] - stops[:-1]
    length = step.norm(dim=1)
    assert float(length.max()) <= 1.5 + 1e-6
    assert float(length.min()) > 0
    assert bool((world.distances(stops[:-1], step / length[:, None]) > length).all())
    assert float(stops[:, 0].max() - stops[:, 0].min()) > 10  # it covers the length of the hall


def test_a_tour_of_a_small_part_returns_the_requested_number_of_stops():
    stops = MeshWorld(SMALL).tour(50, stride=3)
    assert stops.shape == (50, 3)
    assert bool(torch.isfinite(stops).all())
    assert torch.equal(stops, MeshWorld(SMALL).tour(50, stride=3))


def test_a_tour_rejects_a_world_without_standing_places():
    with pytest.raises(InvalidArgumentError, match="no place where a sensor can be carried"):
        MeshWorld(box((0, 0, 0), (0.3, 0.3, 0.3))).tour(3)
    with pytest.raises(InvalidArgumentError, match="spacing=0"):
        MeshWorld(HALL).tour(3, spacing=0)


# -- checks of a mesh -----------------------------------------------------------------------------

CUBE = box((0, 0, 0), (1, 1, 1))


def test_checked_triangles_drops_and_logs_triangles_without_area(caplog):
    line = torch.tensor([[0.0, 0, 0], [1, 1, 1], [3, 3, 3]], dtype=torch.float64)
    point = torch.full((3, 3), 0.3, dtype=torch.float64)
    with caplog.at_level(logging.WARNING):
        kept = checked_triangles(torch.cat([CUBE[:5], line[None], CUBE[5:], point[None]]), "cube")
    assert torch.equal(kept, CUBE)
    assert "cube: dropped 2 of 14 triangles" in caplog.text


def test_checked_triangles_keeps_thin_small_and_far_triangles(caplog):
    needle = torch.tensor([[0.0, 0, 0], [10, 0, 0], [10, 1e-4, 0]], dtype=torch.float64)[None]
    triangles = torch.cat([needle, 1e-6 * CUBE, CUBE + 5e5])
    assert torch.equal(checked_triangles(triangles), triangles)
    assert caplog.text == ""


@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_checked_triangles_rejects_corners_that_are_not_finite(bad):
    triangles = CUBE.clone()
    triangles[7, 1, 2] = bad
    with pytest.raises(DataError, match=r"mine: 1 of 12 .*first is number 7"):
        checked_triangles(triangles, "mine")


def test_checked_triangles_rejects_meshes_without_surface():
    with pytest.raises(DataError, match="no triangles"):
        checked_triangles(torch.zeros(0, 3, 3))
    with pytest.raises(DataError, match="all 4 triangles have no area"):
        checked_triangles(torch.ones(4, 3, 3))
    with pytest.raises(InvalidArgumentError, match=r"\(12, 9\)"):
        checked_triangles(CUBE.view(12, 9))

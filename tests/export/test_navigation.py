"""map_server files read independently, the heights between which they reach, and distance fields."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import yaml
from export.map_examples import example_grid, random_probabilities, read_map_image
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from gmmtorch import Components, OccupancyGrid, Scan, VoxelGrid
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.export.navigation import (
    Levels,
    distance_field,
    highest_in_band,
    of_components,
    of_grid,
    write_distance_field,
    write_map_server,
)
from gmmtorch.occupancy.evidence import Thresholds


@given(st.integers(1, 9), st.integers(1, 9), st.integers(0, 99), st.sampled_from([1e-5, 0.05, 12.0]))
def test_map_server_round_trip_keeps_classes_and_probabilities_to_a_255th(
    tmp_path, width, height, seed, resolution
):
    grid, theta = example_grid((width, height), resolution), random_probabilities((width, height), seed)
    path, image = write_map_server(tmp_path / "floor", grid, theta)
    assert (path.name, image.name) == ("floor.yaml", "floor.pgm")
    found = read_map_image(path)
    assert found.grid == grid
    assert float((found.probability - theta).abs().max()) <= 1 / 255
    assert torch.equal(found.thresholds.classify(found.probability), Thresholds().classify(theta))


def test_map_server_rounding_never_changes_a_class(tmp_path):
    theta = torch.linspace(0, 1, 20_001, dtype=torch.float64)[:, None]
    rule = Thresholds(0.25, 0.6501)
    path, _ = write_map_server(tmp_path / "fine.yaml", VoxelGrid((0, 0), 1, (20_001, 1)), theta, rule)
    found = read_map_image(path)
    assert found.thresholds == rule
    assert torch.equal(rule.classify(found.probability), rule.classify(theta))
    assert float((found.probability - theta).abs().max()) <= 1 / 255


def test_map_server_yaml_has_the_expected_keys(tmp_path):
    path, _ = write_map_server(tmp_path / 'a "b".pgm', example_grid((3, 2), 1e-5), torch.zeros(3, 2))
    assert yaml.safe_load(path.read_text()) == {
        "image": 'a "b".pgm',
        "mode": "trinary",
        "resolution": 1e-5,
        "origin": [pytest.approx(-3e-5), pytest.approx(7e-5), 0.0],
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,
    }


@pytest.mark.parametrize("theta", [torch.zeros(2, 3), torch.full((3, 2), 1.5), torch.full((3, 2), math.nan)])
def test_map_server_writer_rejects_other_shapes_and_values(theta, tmp_path):
    with pytest.raises(InvalidArgumentError, match="probability"):
        write_map_server(tmp_path / "no", example_grid((3, 2)), theta)
    assert not list(tmp_path.iterdir())


def test_highest_in_band_is_the_maximum_of_each_column():
    grid = VoxelGrid((0, 0, -1.0), 0.5, (4, 3, 6))  # z from −1 to 2
    theta = random_probabilities((4, 3, 6))
    flat, found = highest_in_band(grid, theta)
    assert flat == VoxelGrid((0, 0), 0.5, (4, 3))
    assert found.tolist() == [[max(theta[i, j].tolist()) for j in range(3)] for i in range(4)]
    with pytest.raises(InvalidArgumentError, match="needs a 3D map"):
        highest_in_band(example_grid((4, 3)), theta[..., 0])


def patches(*areas: tuple[float, float, int, int]) -> Components:
    """Flat pieces: height (m), side (m), the axis of the normal, and their number."""
    means, covariances = [], []
    for height, side, normal, n in areas:
        spread = torch.full((3,), side**2).index_fill(0, torch.tensor(normal), 1e-4)
        means += [torch.tensor([float(k), 0.0, height]) for k in range(n)]
        covariances += [torch.diag(spread)] * n
    n = len(means)
    return replace(
        Components.empty(3),
        means=torch.stack(means).double(),
        covariances=torch.stack(covariances).double(),
        support=torch.ones(n),
        max_range=torch.zeros(n, dtype=torch.bool),
        ids=torch.zeros(n, 2, dtype=torch.int64),
        origins=torch.tensor([[0.0, 0.0, 1.2]], dtype=torch.float64),
        seen_by=torch.arange(n),
        seen_from=torch.zeros(n, dtype=torch.int64),
        seen_count=torch.ones(n, dtype=torch.int64),
    )


FLOOR, CEILING = (-0.5, 0.6, 2, 20), (2.5, 0.6, 2, 15)
TABLES, WALLS = (0.3, 0.5, 2, 8), (1.0, 2.0, 0, 100)


def test_floor_and_ceiling_are_the_largest_horizontal_surfaces_around_the_sensor():
    found = of_components(patches(FLOOR, TABLES, WALLS, CEILING), 0.1)
    assert (found.floor, found.ceiling) == (pytest.approx(-0.5), pytest.approx(2.5))
    assert found.band(0.1) == pytest.approx((-0.3, 2.3))


def test_outdoors_the_band_has_no_ceiling():
    found = of_components(patches(FLOOR, WALLS, (4.0, 0.2, 2, 2)), 0.1)
    assert found.ceiling is None
    assert found.band(0.1) == pytest.approx((-0.3, 4.0))


@pytest.mark.parametrize("parts", [(WALLS,), (CEILING,)])
def test_a_map_without_a_floor_needs_heights(parts):
    with pytest.raises(InvalidArgumentError, match="give z_min and z_max"):
        of_components(patches(*parts), 0.1)


def test_a_band_without_cells_needs_heights():
    with pytest.raises(InvalidArgumentError, match=r"0\.00 m and the ceiling at 2\.00 m are no cells"):
        Levels(0.0, 2.0, 2.0).band(0.5)


def room() -> Tensor:
    """Points on floor (0.05 m), ceiling (2.45 m) and walls of a room of 4 m by 3 m."""
    x, y, z = (torch.arange(0.05, end, 0.1, dtype=torch.float64) for end in (4.0, 3.0, 2.5))
    floor = torch.cartesian_prod(x, y, z[:1])
    walls = torch.cartesian_prod(x[[0, -1]], y, z)
    return torch.cat([floor, floor + torch.tensor([0.0, 0.0, float(z[-1] - z[0])]), walls])


def test_floor_and_ceiling_of_a_grid_are_where_most_columns_end():
    grid = OccupancyGrid(0.1)
    for _ in range(3):
        grid.insert(Scan(room(), torch.tensor([2.0, 1.5, 1.0], dtype=torch.float64)))
    found = of_grid(grid, 0.65)
    assert found.floor == pytest.approx(0.05, abs=0.03)
    assert found.ceiling == pytest.approx(2.45, abs=0.03)


@pytest.mark.parametrize("shape", [(23, 17), (9, 7, 5)])
def test_field_is_the_distance_to_the_nearest_occupied_cell(shape, tmp_path):
    grid = VoxelGrid((1.0, -2.0, 3.0)[: len(shape)], 0.2, shape)
    theta = torch.rand(shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64) * 0.7
    found = distance_field(grid, theta)
    centers = grid.centers()
    occupied = centers[theta.flatten() > 0.65]
    assert 0 < len(occupied) < 0.2 * len(centers)
    expected = torch.cdist(centers, occupied).amin(1).view(shape)
    np.testing.assert_allclose(found.distance, expected.numpy(), atol=1e-6)
    assert np.array_equal(found.classes == 1, (theta > 0.65).numpy())
    assert np.array_equal(found.classes == 0, (theta < 0.196).numpy())
    assert set(np.unique(found.classes)) == {-1, 0, 1}
    with np.load(write_distance_field(tmp_path / "f.npz", grid, found)) as file:
        assert np.array_equal(file["distance"], found.distance)
        first = file["origin"] + 0.5 * file["resolution"]
    np.testing.assert_allclose(first, centers[0].numpy())


def test_no_obstacle_is_infinitely_far_and_shapes_are_checked(tmp_path):
    grid = VoxelGrid((0.0, 0.0), 1.0, (3, 2))
    assert np.isinf(distance_field(grid, torch.zeros(3, 2)).distance).all()
    with pytest.raises(InvalidArgumentError, match=r"shape \(2, 3\)"):
        distance_field(grid, torch.zeros(2, 3))
    with pytest.raises(InvalidArgumentError, match=r"\.npz"):
        write_distance_field(tmp_path / "f.txt", grid, distance_field(grid, torch.zeros(3, 2)))

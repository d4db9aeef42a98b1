"""Distance fields compared with the distance to every occupied cell."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.export.distance_fields import distance_field, write_distance_field
from gmmtorch.occupancy.grid import VoxelGrid


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

"""The heights between which a 2D map is made of a 3D map."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.export.floor_and_ceiling import Levels, of_components, of_grid
from gmmtorch.mapping.components import Components
from gmmtorch.occupancy.occupancy_grid import OccupancyGrid
from gmmtorch.scan import Scan


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

"""VoxelGrid: indices, centres, covering a box, and bad input."""

from __future__ import annotations

import math
import re
from fractions import Fraction

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gmmtorch.errors import InvalidArgumentError, MemoryLimitError
from gmmtorch.occupancy.grid import BYTES_PER_CELL, VoxelGrid, rasterize

GRIDS = [VoxelGrid((-1.0, 2.0), 0.25, (4, 6)), VoxelGrid((0.1, -7.3, 500_000.0), 0.1, (3, 4, 5))]


@pytest.mark.parametrize("grid", GRIDS)
def test_cell_centres_have_their_own_flat_index(grid):
    cell, inside = grid.flat_index(grid.centers())
    assert bool(inside.all())
    assert cell.tolist() == list(range(grid.n_cells))
    assert grid.n_cells == math.prod(grid.shape)


@pytest.mark.parametrize("grid", GRIDS)
def test_flat_indices_are_row_major(grid):
    index = torch.cartesian_prod(*(torch.arange(n) for n in grid.shape))
    points = torch.tensor(grid.origin, dtype=torch.float64) + (index + 0.25) * grid.resolution
    reshaped = torch.arange(grid.n_cells).reshape(grid.shape)
    assert grid.flat_index(points)[0].tolist() == [int(reshaped[tuple(i)]) for i in index]


def test_cells_are_half_open():
    grid = VoxelGrid((0.0, 0.0), 0.5, (2, 3))
    points = torch.tensor(
        [[0, 0], [0.5, 0], [0, 0.5], [0.999, 1.499], [1.0, 0], [0, 1.5], [-1e-9, 0]]
    ).double()
    cell, inside = grid.flat_index(points)
    assert cell.tolist() == [0, 3, 1, 5, 0, 0, 0]
    assert inside.tolist() == [True] * 4 + [False] * 3


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 1e300])
def test_points_that_are_not_finite_are_outside(value):
    cell, inside = GRIDS[0].flat_index(torch.tensor([[value, 2.1], [-0.9, value]], dtype=torch.float64))
    assert not inside.any()
    assert cell.tolist() == [0, 0]


box = st.tuples(st.integers(-2000, 2000), st.integers(0, 300)).map(lambda t: (t[0] / 16, (t[0] + t[1]) / 16))


@given(st.lists(box, min_size=2, max_size=3), st.sampled_from([0.125, 0.25, 0.5, 1.0]))
def test_covering_is_the_smallest_aligned_grid(sides, resolution):
    low, high = [a for a, _ in sides], [b for _, b in sides]
    grid = VoxelGrid.covering(low, high, resolution)
    for origin, n, a, b in zip(grid.origin, grid.shape, low, high, strict=True):
        assert Fraction(origin) % Fraction(resolution) == 0
        assert origin <= a < origin + resolution
        assert origin + (n - 1) * resolution <= b < origin + n * resolution
    assert bool(grid.flat_index(torch.tensor([low, high], dtype=torch.float64))[1].all())


@pytest.mark.parametrize(
    ("low", "high"),
    [
        ([0, 0], [300, 500]),
        ([0, 0, 0], [80, 70, 90]),
        ([0, 0, 0], [2000, 2000, 0.01]),
        ([0, 0, 0], [90000, 0, 0]),
    ],
    ids=["square", "cube", "thin slab", "line"],
)
def test_a_grid_too_large_names_its_bytes_and_a_resolution_that_fits(low, high):
    limit = 1 << 20
    resolution = 0.05
    cells = math.prod(math.floor(b / resolution) + 1 for b in high)
    with pytest.raises(MemoryLimitError, match=re.escape(f"{cells * BYTES_PER_CELL:,} bytes")) as caught:
        VoxelGrid.covering(low, high, resolution, memory_limit=limit)
    assert f"{limit:,}" in str(caught.value)
    suggestion = float(re.search(r"a resolution of ([0-9.e+-]+) m", str(caught.value))[1])
    assert VoxelGrid.covering(low, high, suggestion, memory_limit=limit).n_cells * BYTES_PER_CELL <= limit


@pytest.mark.parametrize("resolution", [0, -0.1, float("nan"), float("inf")])
def test_invalid_resolutions_are_refused(resolution):
    with pytest.raises(InvalidArgumentError, match="resolution"):
        VoxelGrid((0.0, 0.0), resolution, (2, 2))
    with pytest.raises(InvalidArgumentError, match="resolution"):
        VoxelGrid.covering([0, 0], [1, 1], resolution)


@pytest.mark.parametrize(
    ("origin", "shape"),
    [
        ((0.0, 0.0), (0, 3)),
        ((0.0, 0.0), (-1, 3)),
        ((0.0,), (3,)),
        ((0.0,) * 4, (2,) * 4),
        ((0.0, 0.0), (2, 2, 2)),
        ((float("nan"), 0.0), (2, 2)),
        ((0.0, float("inf")), (2, 2)),
    ],
)
def test_invalid_shapes_and_origins_are_refused(origin, shape):
    with pytest.raises(InvalidArgumentError, match=r"origin|shape"):
        VoxelGrid(origin, 0.1, shape)


@pytest.mark.parametrize(
    ("low", "high"), [([0, 0], [-1, 1]), ([0, float("nan")], [1, 1]), ([0, 0], [1, float("inf")])]
)
def test_invalid_boxes_are_refused(low, high):
    with pytest.raises(InvalidArgumentError, match=r"low|high"):
        VoxelGrid.covering(low, high, 0.1)


@pytest.mark.parametrize("shape", [(500, 300), (70, 40, 50)])
def test_rasterize_evaluates_each_cell_centre_and_reports_progress(shape):
    grid = VoxelGrid((0.3,) * len(shape), 0.1, shape)
    progress: list[int] = []
    found = rasterize(lambda x: (x * 0.1).sum(1), grid, lambda stage, done, total: progress.append(done))
    torch.testing.assert_close(found.flatten(), (grid.centers() * 0.1).sum(1), rtol=0, atol=0)
    assert progress == sorted(progress)
    assert progress[-1] == grid.n_cells

"""The warehouse: size, closed hull, reproducibility, and free space for robots."""

from __future__ import annotations

import pytest
import torch
from scipy.ndimage import label

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.occupancy.voxels.boxes import Box
from gmmtorch.occupancy.voxels.voxelize import occupied_cells
from gmmtorch.simulation.worlds.furniture import UNIT_CUBE, copies
from gmmtorch.simulation.worlds.mesh_world import MeshWorld
from gmmtorch.simulation.worlds.warehouse import warehouse, warehouse_start

SIZES = ((50.0, 40.0, 8.0), (15.0, 12.0, 4.0), (90.0, 85.0, 6.0))


def volume(triangles: torch.Tensor) -> float:
    """Volume of closed solids, by the divergence theorem."""
    a, b, c = triangles.unbind(1)
    return float((a * torch.linalg.cross(b, c)).sum() / 6)


def test_copies_are_scaled_and_rotated():
    center = torch.tensor([[1.0, 2, 3], [4, 5, 6]], dtype=torch.float64)
    size = torch.tensor([[2.0, 1, 0.5], [0.3, 3, 1]], dtype=torch.float64)
    rotated = copies(UNIT_CUBE, center, size, torch.tensor([0.0, torch.pi / 2], dtype=torch.float64))
    assert volume(rotated) == pytest.approx(1.0 + 0.9)
    first, second = rotated[:12].reshape(-1, 3), rotated[12:].reshape(-1, 3)
    assert torch.allclose(first.amax(0), center[0] + size[0] / 2)
    assert torch.allclose(second.amax(0), center[1] + size[1, [1, 0, 2]] / 2)
    assert torch.allclose(second.amin(0), center[1] - size[1, [1, 0, 2]] / 2)


@pytest.mark.parametrize("size", SIZES[:2])
def test_warehouse_hull_fills_its_size_and_the_outermost_layer_of_cells(size):
    triangles = warehouse(3, size)
    low, high = triangles.reshape(-1, 3).amin(0), triangles.reshape(-1, 3).amax(0)
    end = torch.tensor(size, dtype=torch.float64)
    assert bool(((low > 0) & (low < 0.2)).all())
    assert bool(((high < end) & (high > end - 0.2)).all())
    shape = (end / 0.2).round().long()
    found = occupied_cells(triangles, 0.2, Box(0 * shape, shape))
    for axis in range(3):
        assert bool(found.select(axis, 0).all())
        assert bool(found.select(axis, -1).all())


def test_warehouse_depends_only_on_the_seed():
    assert torch.equal(warehouse(5), warehouse(5))
    a, b = warehouse(5), warehouse(6)
    assert a.shape != b.shape or not torch.equal(a, b)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("size", SIZES)
def test_warehouse_free_space_is_connected_to_the_start(size, seed):
    """At a height of 1.3 m the space with 0.8 m of clearance (half of a door) is connected."""
    mesh = MeshWorld(warehouse(seed, size))
    start = warehouse_start(size)
    assert float(mesh.clearance(start[None])) > 1.0
    x, y = (torch.arange(0.5, s, 0.5, dtype=torch.float64) for s in size[:2])
    points = torch.cartesian_prod(x, y, torch.tensor([1.3], dtype=torch.float64))
    clear = (mesh.clearance(points) > 0.8).view(len(x), len(y))
    parts, _ = label(clear.numpy())
    part = parts[int(start[0] / 0.5 - 0.5), int(start[1] / 0.5 - 0.5)]
    assert part > 0
    assert int((parts == part).sum()) > 0.9 * int(clear.sum())


def test_warehouse_is_furnished():
    mesh = MeshWorld(warehouse(0))
    free = torch.rand(20_000, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    free = free * torch.tensor([48.0, 38.0, 6.0]) + 1.0
    near = mesh.clearance(free) < 1.0
    assert 0.3 < float(near.double().mean()) < 0.9


@pytest.mark.parametrize(
    "size", [(10.0, 40.0, 8.0), (50.0, 40.0, float("nan")), (50.0, 40.0), (1e5, 40.0, 8.0)]
)
def test_warehouse_rejects_invalid_sizes(size):
    with pytest.raises(InvalidArgumentError, match="size="):
        warehouse(0, size)
    with pytest.raises(InvalidArgumentError, match="size="):
        warehouse_start(size)


def test_warehouse_rejects_a_negative_seed():
    with pytest.raises(InvalidArgumentError, match="seed"):
        warehouse(-1)

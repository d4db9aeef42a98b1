"""The warehouse: of its size, solid, seeded, and wide enough to fly through."""

from __future__ import annotations

import pytest
import torch

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.occupancy.voxels.boxes import Box
from gmmtorch.occupancy.voxels.voxelize import occupied_cells
from gmmtorch.simulation.worlds.mesh_world import MeshWorld
from gmmtorch.simulation.worlds.solids import box, copies
from gmmtorch.simulation.worlds.warehouse import warehouse, warehouse_start

SIZES = ((50.0, 40.0, 8.0), (15.0, 12.0, 4.0), (90.0, 85.0, 6.0))


def volume(triangles: torch.Tensor) -> float:
    """Of closed solids, by the divergence theorem."""
    a, b, c = triangles.unbind(1)
    return float((a * torch.linalg.cross(b, c)).sum() / 6)


def test_copies_are_turned_and_scaled_solids():
    cube = box((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
    center = torch.tensor([[1.0, 2, 3], [4, 5, 6]], dtype=torch.float64)
    size = torch.tensor([[2.0, 1, 0.5], [0.3, 3, 1]], dtype=torch.float64)
    turned = copies(cube, center, size, torch.tensor([0.0, torch.pi / 2], dtype=torch.float64))
    assert volume(turned) == pytest.approx(1.0 + 0.9)
    first, second = turned[:12].reshape(-1, 3), turned[12:].reshape(-1, 3)
    assert torch.allclose(first.amax(0), center[0] + size[0] / 2)
    assert torch.allclose(second.amax(0), center[1] + size[1, [1, 0, 2]] / 2)
    assert torch.allclose(second.amin(0), center[1] - size[1, [1, 0, 2]] / 2)


@pytest.mark.parametrize("size", SIZES)
def test_it_fills_its_size_and_no_more_and_no_surface_is_on_a_lattice_plane(size):
    triangles = warehouse(3, size)
    low, high = triangles.reshape(-1, 3).amin(0), triangles.reshape(-1, 3).amax(0)
    assert bool((low > 0).all())
    assert bool((low < 0.2).all())
    end = torch.tensor(size, dtype=torch.float64)
    assert bool((high < end).all())
    assert bool((high > end - 0.2).all())
    # The hull falls in the outermost layer of cells on every side, and closes it.
    shape = (end / 0.2).round().long()
    found = occupied_cells(triangles, 0.2, Box(0 * shape, shape))
    for axis in range(3):
        assert bool(found.select(axis, 0).all())
        assert bool(found.select(axis, -1).all())


def test_a_seed_makes_one_warehouse():
    assert torch.equal(warehouse(5), warehouse(5))
    a, b = warehouse(5), warehouse(6)
    assert a.shape != b.shape or not torch.equal(a, b)


def test_a_larger_one_has_more_of_everything():
    small, large = warehouse(0), warehouse(0, (200.0, 160.0, 8.0))
    assert 10 < len(large) / len(small) < 30


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("size", SIZES)
def test_robots_fly_through_all_of_it(size, seed):
    """At the middle of the aisles' height, what is free to a robot is connected, and starts have room."""
    from scipy.ndimage import label

    mesh = MeshWorld(warehouse(seed, size))
    assert float(mesh.clearance(warehouse_start(size)[None])) > 1.0
    x, y = (torch.arange(0.5, s, 0.5, dtype=torch.float64) for s in size[:2])
    level = torch.tensor([1.3], dtype=torch.float64)
    places = torch.cartesian_prod(x, y, level)
    clear = (mesh.clearance(places) > 0.8).view(len(x), len(y))  # half of a door of 1.6 m
    parts, n = label(clear.numpy())
    parts = torch.from_numpy(parts).long()
    sizes = torch.bincount(parts.flatten())[1:]
    start = parts[int(warehouse_start(size)[0] / 0.5 - 0.5), int(warehouse_start(size)[1] / 0.5 - 0.5)]
    assert n >= 1
    assert int(sizes[int(start) - 1]) > 0.9 * int(clear.sum())


def test_it_is_furnished():
    mesh = MeshWorld(warehouse(0))
    free = torch.rand(20_000, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    free = free * torch.tensor([48.0, 38.0, 6.0]) + 1.0
    near = mesh.clearance(free) < 1.0
    assert 0.3 < float(near.double().mean()) < 0.9


@pytest.mark.parametrize(
    "size", [(10.0, 40.0, 8.0), (50.0, 40.0, float("nan")), (50.0, 40.0), (1e5, 40.0, 8.0)]
)
def test_sizes_that_are_none_are_refused(size):
    with pytest.raises(InvalidArgumentError, match="size="):
        warehouse(0, size)
    with pytest.raises(InvalidArgumentError, match="size="):
        warehouse_start(size)


def test_seeds_that_are_none_are_refused():
    with pytest.raises(InvalidArgumentError, match="seed"):
        warehouse(-1)

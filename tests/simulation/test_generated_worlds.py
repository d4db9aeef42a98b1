"""The warehouse and the mine: size, closed surface, free space for robots; only the seed changes them."""

from __future__ import annotations

import functools
from collections.abc import Callable

import pytest
import torch
from scipy.ndimage import label

from gmmtorch.errors import GmmTorchError, InvalidArgumentError
from gmmtorch.occupancy.voxels.cells import Box, occupied_cells
from gmmtorch.simulation.worlds.furniture import UNIT_CUBE, copies
from gmmtorch.simulation.worlds.mesh_world import MeshWorld
from gmmtorch.simulation.worlds.tunnels import tunnels
from gmmtorch.simulation.worlds.warehouse import warehouse, warehouse_start

Generate = Callable[..., torch.Tensor]


@pytest.mark.parametrize("generate", [warehouse, tunnels])
def test_a_generated_world_depends_only_on_the_seed(generate: Generate) -> None:
    first, again, other = generate(5), generate(5), generate(6)
    assert torch.equal(first, again)
    assert first.shape != other.shape or not torch.equal(first, other)


@pytest.mark.parametrize("generate", [warehouse, tunnels, lambda seed, size: warehouse_start(size)])
@pytest.mark.parametrize(
    "size", [(10.0, 60.0, 10.0), (60.0, 60.0, 3.0), (60.0, 60.0), (60.0, torch.nan, 10.0), (1e5, 60.0, 10.0)]
)
def test_a_generated_world_rejects_invalid_sizes(generate: Generate, size: tuple[float, ...]) -> None:
    with pytest.raises(InvalidArgumentError, match="size="):
        generate(0, size)


@pytest.mark.parametrize("generate", [warehouse, tunnels])
def test_a_generated_world_rejects_a_negative_seed(generate: Generate) -> None:
    with pytest.raises(InvalidArgumentError, match="seed"):
        generate(-1)


# -- the warehouse ----------------------------------------------------------------------------------

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


# -- the mine ---------------------------------------------------------------------------------------

MINE = (60.0, 60.0, 10.0)
SEEDS = (0, 1)


@functools.cache
def mine(seed: int) -> torch.Tensor:
    return tunnels(seed, MINE)


@functools.cache
def interior(seed: int, spacing: float = 0.5) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Whether each point of a grid is dug out (odd numbers of faces above and below); these points (N, 3);
    and their clearance (N,)."""
    mesh = MeshWorld(mine(seed))
    axes = [torch.arange(spacing / 2, s, spacing, dtype=torch.float64) + 0.013 for s in MINE]
    points = torch.cartesian_prod(*axes)
    odd = torch.ones(len(points), dtype=torch.bool)
    for side in (1.0, -1.0):
        direction = torch.tensor([0.0, 0.0, side], dtype=torch.float64).expand_as(points)
        crossings = torch.zeros(len(points), dtype=torch.int64)
        position = points.clone()
        for _ in range(12):
            distance = mesh.distances(position, direction)
            hit = torch.isfinite(distance)
            crossings += hit
            position[:, 2] += side * torch.where(hit, distance + 1e-3, 1e3)
        odd &= crossings % 2 == 1
    return odd.view([len(axis) for axis in axes]), points[odd], mesh.clearance(points[odd])


def test_a_mine_names_the_version_of_open3d_that_it_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = pytest.importorskip("open3d").t.geometry.TriangleMesh
    monkeypatch.delattr(mesh, "create_isosurfaces")
    with pytest.raises(GmmTorchError, match=r"needs Open3D 0\.19"):
        tunnels(0, (40.0, 40.0, 7.0))


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_mine_surface_is_closed_and_inside_its_size(seed):
    corners = mine(seed).reshape(-1, 3)
    assert bool((corners > 0).all())
    assert bool((corners < torch.tensor(MINE)).all())
    # Each edge of a closed surface belongs to two triangles, or to four where the surface touches itself.
    _, name = (corners * 1e5).round().long().unique(dim=0, return_inverse=True)
    edges = name.view(-1, 3)[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2).sort(1).values
    _, count = edges.unique(dim=0, return_counts=True)
    assert bool((count % 2 == 0).all())
    mesh = MeshWorld(mine(seed))
    _, points, clearance = interior(seed)
    deep = points[clearance > 0.5]
    for side in torch.cat([torch.eye(3), -torch.eye(3)]).double():
        assert bool(torch.isfinite(mesh.distances(deep, side.expand_as(deep))).all())


@pytest.mark.parametrize("seed", SEEDS)
def test_mine_galleries_are_connected(seed):
    dug, _, clearance = interior(seed)
    clear = dug.clone()
    clear[dug] = clearance > 0.4
    parts, _ = label(clear.numpy())
    sizes = torch.bincount(torch.from_numpy(parts).long().flatten())[1:]
    assert int(sizes.max()) > 0.98 * int(clear.sum())


def test_mine_galleries_have_the_documented_width_and_height():
    dug, _, clearance = interior(0)
    assert 1.0 < float(clearance.max()) < 4.5  # half the width of a gallery, up to the largest chamber
    columns = dug.sum(2)
    height = columns[columns > 0].double() * 0.5
    assert 2.4 < float(height.median()) < 3.6
    assert 0.08 < float((columns > 0).double().mean()) < 0.5  # share of the plan that is dug out

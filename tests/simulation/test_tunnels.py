"""The mine: a closed surface of the given size with connected galleries of the given width."""

from __future__ import annotations

import functools

import pytest
import torch
from scipy.ndimage import label

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.simulation.worlds.mesh_world import MeshWorld
from gmmtorch.simulation.worlds.tunnels import tunnels

SIZE = (60.0, 60.0, 10.0)
SEEDS = (0, 1)


@functools.cache
def mine(seed: int) -> torch.Tensor:
    return tunnels(seed, SIZE)


@functools.cache
def interior(seed: int, spacing: float = 0.5) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Whether each point of a grid is dug out (odd numbers of faces above and below); these points (N, 3);
    and their clearance (N,)."""
    mesh = MeshWorld(mine(seed))
    axes = [torch.arange(spacing / 2, s, spacing, dtype=torch.float64) + 0.013 for s in SIZE]
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


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_mine_surface_is_closed_and_inside_its_size(seed):
    corners = mine(seed).reshape(-1, 3)
    assert bool((corners > 0).all())
    assert bool((corners < torch.tensor(SIZE)).all())
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


def test_mine_depends_only_on_the_seed():
    assert torch.equal(mine(1), tunnels(1, SIZE))
    assert mine(0).shape != mine(1).shape


@pytest.mark.parametrize(
    "size", [(20.0, 60.0, 10.0), (60.0, 60.0, 3.0), (60.0, 60.0), (60.0, float("inf"), 10.0)]
)
def test_mine_rejects_invalid_sizes(size):
    with pytest.raises(InvalidArgumentError, match="size="):
        tunnels(0, size)

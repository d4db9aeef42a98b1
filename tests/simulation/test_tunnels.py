"""The mine: closed rock, within its size, galleries of their width, all connected."""

from __future__ import annotations

import pytest
import torch

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.simulation.worlds.mesh_world import MeshWorld
from gmmtorch.simulation.worlds.tunnels import tunnels

SIZE = (60.0, 60.0, 10.0)


def inside(mesh: MeshWorld, spacing: float = 0.5) -> tuple[torch.Tensor, torch.Tensor]:
    """Points of a lattice (N, 3), and which are dug out, by counting the faces above and below each."""
    axes = [torch.arange(spacing / 2, s, spacing, dtype=torch.float64) + 0.013 for s in SIZE]
    points = torch.cartesian_prod(*axes)
    odd = torch.ones(len(points), dtype=torch.bool)
    for side in (1.0, -1.0):
        toward = torch.tensor([0.0, 0.0, side], dtype=torch.float64).expand_as(points)
        crossings = torch.zeros(len(points), dtype=torch.int64)
        at = points.clone()
        for _ in range(12):
            distance = mesh.distances(at, toward)
            met = torch.isfinite(distance)
            crossings += met
            at[:, 2] += side * torch.where(met, distance + 1e-3, 1e3)
        odd &= crossings % 2 == 1
    return points, odd.view([len(axis) for axis in axes])


@pytest.mark.parametrize("seed", range(3))
def test_galleries_are_closed_all_around(seed):
    triangles = tunnels(seed, SIZE)
    corners = triangles.reshape(-1, 3)
    assert bool((corners > 0).all())
    assert bool((corners < torch.tensor(SIZE)).all())
    # Every edge of a closed surface belongs to two triangles, or four where it touches itself.
    _, name = (corners * 1e5).round().long().unique(dim=0, return_inverse=True)
    edges = name.view(-1, 3)[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2).sort(1).values
    _, count = edges.unique(dim=0, return_counts=True)
    assert bool((count % 2 == 0).all())
    mesh = MeshWorld(triangles)
    sides = torch.cat([torch.eye(3), -torch.eye(3)]).double()
    points, dug = inside(mesh)
    deep = points[dug.flatten()]
    deep = deep[mesh.clearance(deep) > 0.5]
    for side in sides:
        assert bool(torch.isfinite(mesh.distances(deep, side.expand_as(deep))).all())


@pytest.mark.parametrize("seed", range(3))
def test_robots_fly_through_all_of_it(seed):
    from scipy.ndimage import label

    mesh = MeshWorld(tunnels(seed, SIZE))
    points, dug = inside(mesh)
    clear = dug & (mesh.clearance(points) > 0.4).view(dug.shape)
    parts, _ = label(clear.numpy())
    sizes = torch.bincount(torch.from_numpy(parts).long().flatten())[1:]
    assert int(sizes.max()) > 0.98 * int(clear.sum())


def test_galleries_have_their_width_and_height():
    mesh = MeshWorld(tunnels(0, SIZE))
    points, dug = inside(mesh)
    room = mesh.clearance(points)[dug.flatten()]
    assert 1.0 < float(room.max()) < 4.5  # of the largest chamber
    columns = dug.sum(2)
    height = columns[columns > 0].double() * 0.5
    assert 2.4 < float(height.median()) < 3.6
    # Length times width of the plan: half the breadth is what the middle of a gallery has to its walls.
    assert 0.08 < float((columns > 0).double().mean()) < 0.5


def test_a_seed_makes_one_mine():
    assert torch.equal(tunnels(1), tunnels(1))
    assert tunnels(1).shape != tunnels(2).shape


@pytest.mark.parametrize(
    "size", [(20.0, 60.0, 10.0), (60.0, 60.0, 3.0), (60.0, 60.0), (60.0, float("inf"), 10.0)]
)
def test_sizes_that_are_none_are_refused(size):
    with pytest.raises(InvalidArgumentError, match="size="):
        tunnels(0, size)

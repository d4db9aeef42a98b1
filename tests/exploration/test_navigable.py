"""Cells that can be seen, against rays followed one by one and lines of sight; and collisions of robots."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gmmtorch.occupancy.voxels.boxes import Box
from gmmtorch.occupancy.voxels.ray_casting import cast_evidence
from gmmtorch.occupancy.voxels.voxelize import occupied_cells
from gmmtorch.simulation.sensors.mesh_raycasting import ray_triangles
from gmmtorch.simulation.worlds.furniture import box
from gmmtorch.simulation.worlds.mesh_world import MeshWorld
from gmmtorch.team.exploration.world.navigable import (
    collides,
    meets_others,
    observable_cells,
    view_directions,
    viewpoints,
)

RESOLUTION = 0.25
ROOM = torch.cat(
    [
        box((0.1, 0.1, 0.1), (5.9, 3.9, 2.9)),
        box((2.6, 1.1, 0.1), (3.4, 2.7, 1.6)),
        box((4.3, 3.0, 1.2), (5.0, 3.9, 1.3)),
    ]
)
LATTICE = Box(torch.tensor([0, 0, 0]), torch.tensor([24, 16, 12]))


def seen_from(cells: Tensor, directions: Tensor, max_range: float, lattice: Box = LATTICE) -> Tensor:
    occupied = occupied_cells(ROOM, RESOLUTION, lattice)
    return observable_cells(MeshWorld(ROOM), occupied, lattice, RESOLUTION, cells, directions, max_range)


def test_observable_cells_equal_dda_cells():
    cells = torch.tensor([[3, 3, 4], [18, 9, 7], [10, 13, 2]])
    directions = view_directions(1.0, 0.15)
    origins = (cells + 0.5).double() * RESOLUTION
    found = seen_from(cells, directions, 3.0)
    for beyond, compare in ((-2e-3, torch.Tensor.__ge__), (2e-3, torch.Tensor.__le__)):
        crossed = torch.zeros(LATTICE.shape, dtype=torch.bool)
        for origin in origins:
            length = ray_triangles(origin, directions, ROOM).clamp_max(3.0) + beyond
            ends = origin + directions * length[:, None]
            evidence = cast_evidence(
                origin, ends, torch.ones(len(ends), dtype=torch.bool), RESOLUTION, LATTICE
            )
            crossed[evidence.cells.unbind(1)] = True
        assert bool(compare(found, crossed).all())  # but for 2 mm at their ends
        assert float((found == crossed).double().mean()) > 0.99


def test_observable_cells_of_a_smaller_box_are_a_crop():
    cells = torch.tensor([[3, 3, 4], [6, 9, 7]])
    directions = view_directions(1.0, 0.15)
    whole = seen_from(cells, directions, 4.0)
    window = Box(torch.tensor([1, 2, 3]), torch.tensor([9, 14, 9]))
    part = seen_from(cells - window.low, directions, 4.0, window)
    # A ray that leaves a convex window does not come back.
    assert torch.equal(part, whole[1:9, 2:14, 3:9])


def test_observable_cells_have_a_line_of_sight():
    start = viewpoints(~_solid(), 3)
    found = seen_from(start, view_directions(1.2, 0.06), 6.0)
    inside = torch.zeros(LATTICE.shape, dtype=torch.bool)
    inside[11:13, 5:10, 1:6] = True  # the block, without the cells that its faces meet
    assert not bool((found & inside).any())
    occupied = occupied_cells(ROOM, RESOLUTION, LATTICE)
    free = ~occupied & ~inside
    assert float(found[free].double().mean()) > 0.98
    mesh = MeshWorld(ROOM)
    eyes = (start + 0.5).double() * RESOLUTION
    for cell in (found & free).nonzero()[::149]:
        corners = (cell + torch.rand(60, 3, generator=torch.Generator().manual_seed(1))).double() * RESOLUTION
        way = corners[:, None] - eyes
        length = way.norm(dim=2)
        sight = mesh.distances(eyes.repeat(60, 1), (way / length[..., None]).flatten(0, 1)).view(60, -1)
        assert bool((sight > length).any())


def _solid() -> Tensor:
    solid = occupied_cells(ROOM, RESOLUTION, LATTICE)
    solid[10:14, 4:11, :7] = True
    return solid


def test_view_directions_cover_the_view_evenly(generator):
    fov, angle = 1.0123, 0.08
    directions = view_directions(fov, angle)
    assert torch.allclose(directions.norm(dim=1), torch.ones(len(directions), dtype=torch.float64))
    elevation = directions[:, 2].asin()
    assert math.isclose(float(elevation.max()), fov / 2)
    assert math.isclose(float(elevation.min()), -fov / 2)
    up = (torch.rand(3000, generator=generator, dtype=torch.float64) - 0.5) * fov
    yaw = torch.rand(3000, generator=generator, dtype=torch.float64) * 2 * math.pi
    drawn = torch.stack([up.cos() * yaw.cos(), up.cos() * yaw.sin(), up.sin()], 1)
    nearest = (drawn @ directions.T).amax(1).clamp_max(1).acos()
    assert float(nearest.max()) < angle
    area = 2 * math.pi * 2 * math.sin(fov / 2)
    assert 0.7 < len(directions) * angle**2 / area < 1.5


def test_viewpoints_are_nearest_to_block_middles(generator):
    navigable = torch.rand(17, 11, 9, generator=generator) < 0.05
    found = viewpoints(navigable, 4)
    best: dict[tuple[int, ...], int] = {}
    for cell in navigable.nonzero().tolist():
        off = sum((2 * (c % 4) - 3) ** 2 for c in cell)
        block = tuple(c // 4 for c in cell)
        best[block] = min(off, best.get(block, off))
    assert len(found) == len(best)
    for cell in found.tolist():
        assert bool(navigable[tuple(cell)])
        assert sum((2 * (c % 4) - 3) ** 2 for c in cell) == best.pop(tuple(c // 4 for c in cell))
    assert len(viewpoints(torch.zeros(3, 3, 3, dtype=torch.bool), 4)) == 0


def test_observable_cells_without_viewpoints_are_empty():
    nowhere = torch.zeros(0, 3, dtype=torch.int64)
    assert not bool(seen_from(nowhere, view_directions(1.0, 0.3), 3.0).any())


# -- collisions --------------------------------------------------------------------------------------


def test_collides_flags_surfaces_within_the_radius():
    room = MeshWorld(torch.cat([box((0, 0, 0), (8, 6, 3)), box((4, 2, 0), (5, 3, 3))]))
    generator = torch.Generator().manual_seed(4)
    size = torch.tensor([8.0, 6, 3], dtype=torch.float64)
    points = torch.rand(2000, 3, generator=generator, dtype=torch.float64) * size
    to_walls = torch.minimum(points, size - points).amin(1)
    pillar = points[:, :2].clamp(torch.tensor([4.0, 2.0]), torch.tensor([5.0, 3.0]))
    to_pillar = (points[:, :2] - pillar).norm(dim=1)
    outside = to_pillar > 0
    expected = torch.minimum(to_walls, to_pillar) < 0.3
    found = collides(room, points, 0.3)
    sure = outside & ((torch.minimum(to_walls, to_pillar) - 0.3).abs() > 1e-4)
    assert torch.equal(found[sure], expected[sure])
    assert bool(found[sure].any())
    assert collides(room, points[:0], 0.3).shape == (0,)


def test_meets_others_flags_overlapping_bodies():
    generator = torch.Generator().manual_seed(5)
    positions = torch.rand(4, 50, 3, generator=generator, dtype=torch.float64) * 1.5
    found = meets_others(positions, 0.3)
    for i in range(4):
        for s in range(50):
            near = [math.dist(positions[i, s].tolist(), positions[j, s].tolist()) for j in range(4) if j != i]
            assert bool(found[i, s]) == (min(near) < 0.6)
    assert 0 < int(found.sum()) < 200
    assert not bool(meets_others(positions[:1], 0.3).any())

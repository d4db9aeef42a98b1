"""Simulated worlds: buildings with clear paths, worlds of any mesh, warehouses and mines."""

from __future__ import annotations

import functools
import itertools
import logging
import math
from collections.abc import Callable

import pytest
import torch
from scipy.ndimage import label
from torch import Tensor

from gmmtorch.errors import DataError, GmmTorchError, InvalidArgumentError
from gmmtorch.occupancy.voxels.cells import Box, occupied_cells
from gmmtorch.simulation import World2D, World3D, building_2d, building_3d, poses_3d, spinning_lidar
from gmmtorch.simulation.furniture import UNIT_CUBE, Footprint, Room, box, circle, copies, place
from gmmtorch.simulation.mesh_world import MeshWorld, checked_triangles
from gmmtorch.simulation.mine import tunnels
from gmmtorch.simulation.warehouses import warehouse, warehouse_start

CLEARANCE = 0.4


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@functools.cache
def office(seed: int) -> World2D:
    return building_2d(generator(seed))


@functools.cache
def hall(seed: int) -> World3D:
    return building_3d(generator(seed))


def distance_to_segments(points: Tensor, segments: Tensor) -> Tensor:
    """Distance (N,) from points (N, 2) to the nearest of segments (S, 2, 2)."""
    a, edge = segments[:, 0], segments[:, 1] - segments[:, 0]
    offset = points[:, None] - a
    share = ((offset * edge).sum(-1) / (edge * edge).sum(-1)).clamp(0, 1)
    return (offset - share[..., None] * edge).norm(dim=-1).amin(1)


def count_crossings(path: Tensor, segments: Tensor) -> int:
    """Number of crossings of a path (P, 2) with segments (S, 2, 2), by the orientation of four triangles."""

    def side(p: Tensor, q: Tensor, r: Tensor) -> Tensor:
        u, v = q - p, r - p
        return torch.sign(u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0])

    p, q = path[:-1, None], path[1:, None]
    a, b = segments[:, 0], segments[:, 1]
    return int(((side(p, q, a) * side(p, q, b) < 0) & (side(a, b, p) * side(a, b, q) < 0)).sum())


def test_office_path_is_clear_of_walls_and_furniture():
    world = office(0)
    path = world.path[::2]
    assert float(distance_to_segments(path, world.segments).min()) > CLEARANCE
    assert count_crossings(path, world.segments) == 0


@pytest.mark.parametrize("seed", range(2))
def test_hall_path_is_clear_of_walls_and_furniture(seed):
    """Horizontal rays from the path, at several heights, hit nothing within the clearance."""
    world = hall(seed)
    ring = torch.cat([circle(1.0, 24), torch.zeros(24, 1, dtype=torch.float64)], 1)
    stations = world.path[::20]
    for here, ahead in itertools.pairwise(stations):
        for height in (0.1, 0.73, 1.4):
            origin = torch.cat([here, torch.tensor([height])])
            assert float(world.distances(origin, ring).min()) > CLEARANCE
        step = torch.cat([ahead - here, torch.zeros(1)])[None]
        assert float(world.distances(origin, step)) > 1


def test_office_is_closed_and_its_corridor_is_long():
    world, ring = office(0), circle(1.0, 720)
    for origin in world.path[::200]:
        distance = world.distances(origin, ring)
        assert bool(torch.isfinite(distance).all())
        ends = origin + distance[:, None] * ring
        assert bool(((ends > 0) & (ends < torch.tensor([30.0, 20.0]))).all())
    assert float(world.distances(world.path[0], torch.tensor([[1.0, 0.0]]).double())) > 20


def test_hall_is_open_only_at_its_windows():
    world = hall(0)
    sensor = spinning_lidar(24, 120, (-1.2, 1.2))
    for pose in poses_3d(world.path, 8, 1.2):
        origin, directions = pose[:3, 3], sensor.directions @ pose[:3, :3].T
        distance = world.distances(origin, directions)
        outside = torch.isinf(distance)
        at_south_wall = origin + directions * ((0.1 - origin[1]) / directions[:, 1])[:, None]
        x, z = at_south_wall[outside, 0], at_south_wall[outside, 2]
        assert bool((directions[outside, 1] < 0).all())
        assert bool(((z > 0.9) & (z < 2.6)).all())
        assert bool((((x > 1.5) & (x < 4.0)) | ((x > 5.5) & (x < 8.0)) | ((x > 10.5) & (x < 12.5))).all())


def test_buildings_depend_only_on_the_seed():
    again = building_2d(generator(0)).segments, building_3d(generator(0)).triangles
    first, other = (office(0).segments, hall(0).triangles), (office(1).segments, hall(1).triangles)
    for a, b, c in zip(first, again, other, strict=True):
        assert torch.equal(a, b)
        assert a.shape != c.shape or not torch.equal(a, c)
        assert bool(torch.isfinite(a).all())
    assert torch.equal(office(0).path, office(1).path)
    assert torch.equal(hall(0).path, hall(1).path)


def test_footprint_contains_points_within_the_margin():
    spot = Footprint(1.0, 2.0, math.pi / 2, 2.0, 1.0)
    points = torch.tensor([[1.0, 2.9], [1.9, 2.0], [1.4, 2.0], [1.0, 3.1]], dtype=torch.float64)
    assert spot.contains(points).tolist() == [True, False, True, False]
    assert spot.contains(points, 0.5).tolist() == [True, True, True, True]
    assert spot.outline().shape == (40, 2)


def test_place_avoids_the_path_and_other_furniture():
    room = Room(0.0, 0.0, 5.0, 5.0)
    path = torch.tensor([[0.0, 2.5], [2.5, 2.5], [5.0, 2.5]], dtype=torch.float64)
    taken: list[Footprint] = []
    g = generator()
    for _ in range(12):
        spot = place(room, (0.8, 0.5), path, taken, g)
        if spot is not None:
            assert not bool(spot.contains(path, 0.6).any())
            assert not any(bool(other.contains(spot.outline()).any()) for other in taken)
            taken.append(spot)
    assert len(taken) >= 4
    assert place(room, (9.0, 9.0), path, [], g) is None


# -- mesh world --------------------------------------------------------------------------------------


HALL = box((0, 0, 0), (20, 6, 3))
SMALL = box((40, 0, 0), (44, 4, 3))


def test_mesh_world_is_exact_far_from_the_origin():
    shift = torch.tensor([5e5, -4e6, 100.0], dtype=torch.float64)
    there = MeshWorld(HALL + shift)
    ahead = torch.tensor([[1.0, 0, 0], [0, 2, 0], [0, 0, -1]], dtype=torch.float64)
    origin = torch.tensor([3.0, 2.0, 1.25], dtype=torch.float64)
    found = there.distances(origin + shift, ahead)
    assert torch.allclose(found, torch.tensor([17.0, 2.0, 1.25], dtype=torch.float64), rtol=0, atol=1e-9)
    assert torch.allclose(there.clearance((origin + shift)[None]), torch.tensor([1.25], dtype=torch.float64))


@pytest.mark.parametrize(
    ("origin", "directions", "message"),
    [
        ((2,), (5, 3), "origin has"),
        ((4, 3), (5, 3), "origin has"),
        ((3,), (5, 2), "directions"),
        ((3,), (3,), "directions"),
    ],
)
def test_mesh_world_rejects_rays_of_another_shape(origin, directions, message):
    with pytest.raises(InvalidArgumentError, match=message):
        MeshWorld(HALL).distances(torch.zeros(origin), torch.ones(directions))


def test_mesh_world_rejects_triangles_and_points_that_are_not_finite():
    broken = HALL.clone()
    broken[3, 1, 2] = math.nan
    with pytest.raises(
        DataError, match="1 of 12 triangles have a corner that is NaN or infinite, the first is number 3"
    ):
        MeshWorld(broken)
    with pytest.raises(DataError, match="no triangles"):
        MeshWorld(HALL[:0])
    with pytest.raises(InvalidArgumentError, match=r"shape \(4, 3\)"):
        MeshWorld(torch.zeros(4, 3))
    with pytest.raises(InvalidArgumentError, match="finite metres"):
        MeshWorld(HALL).clearance(torch.full((2, 3), math.nan))


def test_standing_places_are_indoors_above_the_floor_and_clear_of_walls():
    places = MeshWorld(torch.cat([HALL, SMALL])).standing_places(height=1.2, clearance=0.5)
    assert torch.allclose(places[:, 2], torch.full((len(places),), 1.2, dtype=torch.float64), atol=1e-4)
    in_hall = (places[:, 0] < 20) & (places[:, :2].amin(1) >= 0.5 - 1e-5) & (places[:, 1] <= 5.5 + 1e-5)
    in_small = (places[:, 0] > 40.4) & (places[:, 0] < 43.6) & (places[:, 1] < 3.6)
    assert bool((in_hall | in_small).all())
    assert bool(in_hall.any())
    assert bool(in_small.any())
    # A roof is a floor without walls around it.
    assert float(places[:, 2].max()) < 2


def test_a_tour_stays_in_the_largest_part_and_steps_along_free_lines():
    world = MeshWorld(torch.cat([HALL, SMALL]))
    stops = world.tour(15, stride=1)
    assert stops.shape == (15, 3)
    assert float(stops[:, 0].max()) < 20
    step = stops[1:] - stops[:-1]
    length = step.norm(dim=1)
    assert float(length.max()) <= 1.5 + 1e-6
    assert float(length.min()) > 0
    assert bool((world.distances(stops[:-1], step / length[:, None]) > length).all())
    assert float(stops[:, 0].max() - stops[:, 0].min()) > 10  # it covers the length of the hall


def test_a_tour_of_a_small_part_returns_the_requested_number_of_stops():
    stops = MeshWorld(SMALL).tour(50, stride=3)
    assert stops.shape == (50, 3)
    assert bool(torch.isfinite(stops).all())
    assert torch.equal(stops, MeshWorld(SMALL).tour(50, stride=3))


def test_a_tour_rejects_a_world_without_standing_places():
    with pytest.raises(InvalidArgumentError, match="no place where a sensor can be carried"):
        MeshWorld(box((0, 0, 0), (0.3, 0.3, 0.3))).tour(3)
    with pytest.raises(InvalidArgumentError, match="spacing=0"):
        MeshWorld(HALL).tour(3, spacing=0)


# -- checks of a mesh -----------------------------------------------------------------------------

CUBE = box((0, 0, 0), (1, 1, 1))


def test_checked_triangles_drops_and_logs_triangles_without_area(caplog):
    line = torch.tensor([[0.0, 0, 0], [1, 1, 1], [3, 3, 3]], dtype=torch.float64)
    point = torch.full((3, 3), 0.3, dtype=torch.float64)
    with caplog.at_level(logging.WARNING):
        kept = checked_triangles(torch.cat([CUBE[:5], line[None], CUBE[5:], point[None]]), "cube")
    assert torch.equal(kept, CUBE)
    assert "cube: dropped 2 of 14 triangles" in caplog.text


def test_checked_triangles_keeps_thin_small_and_far_triangles(caplog):
    needle = torch.tensor([[0.0, 0, 0], [10, 0, 0], [10, 1e-4, 0]], dtype=torch.float64)[None]
    triangles = torch.cat([needle, 1e-6 * CUBE, CUBE + 5e5])
    assert torch.equal(checked_triangles(triangles), triangles)
    assert caplog.text == ""


@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_checked_triangles_rejects_corners_that_are_not_finite(bad):
    triangles = CUBE.clone()
    triangles[7, 1, 2] = bad
    with pytest.raises(DataError, match=r"mine: 1 of 12 .*first is number 7"):
        checked_triangles(triangles, "mine")


def test_checked_triangles_rejects_meshes_without_surface():
    with pytest.raises(DataError, match="no triangles"):
        checked_triangles(torch.zeros(0, 3, 3))
    with pytest.raises(DataError, match="all 4 triangles have no area"):
        checked_triangles(torch.ones(4, 3, 3))
    with pytest.raises(InvalidArgumentError, match=r"\(12, 9\)"):
        checked_triangles(CUBE.view(12, 9))


# -- generated worlds --------------------------------------------------------------------------------


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

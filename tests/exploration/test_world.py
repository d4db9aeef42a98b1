"""Worlds: where robots can be, what they can see and touch, what is kept, and what is refused."""

from __future__ import annotations

import logging
import math

import pytest
import torch
from exploration.rooms import HALL
from torch import Tensor

from gmmtorch.errors import DataError, InvalidArgumentError, MemoryLimitError, MissingDataError
from gmmtorch.occupancy import Box, cast_evidence, occupied_cells
from gmmtorch.simulation import MeshWorld, box
from gmmtorch.team.exploration.planning.primitives import Dynamics, Primitives
from gmmtorch.team.exploration.world.starts import check_start, start_poses
from gmmtorch.team.exploration.world.world import (
    World,
    collides,
    meets_others,
    observable_cells,
    open_world,
    view_directions,
    viewpoints,
)


@pytest.fixture(autouse=True)
def _own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("GMMTORCH_CACHE", str(tmp_path / "cache"))


@pytest.fixture(scope="module")
def hall() -> World:
    return World.from_mesh(HALL, cache=False, name="hall")


def test_world_box_covers_the_mesh_and_marks_met_cells_occupied(hall):
    assert hall.box.low.tolist() == [0, 0, 0]
    assert hall.box.shape == (50, 30, 15)
    assert bool(hall.occupied[0].all())
    assert bool(hall.occupied[20, :15].all())
    assert not bool(hall.occupied[5:15, 5:20, 5:10].any())


def test_navigable_cells_keep_the_robot_radius_from_the_mesh(hall):
    cells = torch.ones(hall.box.shape).nonzero()
    room = MeshWorld(HALL).clearance(hall.centers(cells)).view(hall.box.shape)
    inside = torch.zeros(hall.box.shape, dtype=torch.bool)
    inside[35:43, 20:26, :8] = True  # the solid: clear within, yet cut off
    assert torch.equal(hall.navigable, (room > 0.3) & ~inside)
    assert bool(((room > 0.3) & inside).any())


def test_observable_cells_include_free_space_and_exclude_solids(hall):
    inside = torch.zeros(hall.box.shape, dtype=torch.bool)
    inside[36:42, 21:25, 1:7] = True
    assert not bool((hall.observable & inside).any())
    free = ~hall.occupied & ~inside
    free[20:22, :15] = False
    free[35:43, 20:26, :8] = False
    assert float(hall.observable[free].double().mean()) > 0.98
    assert float(hall.observable[0, 2:-2, 2:-2].double().mean()) > 0.98  # a wall


def test_bounds_crop_the_world(hall):
    part = World.from_mesh(HALL, bounds=(0.5, 0.5, 0.0, 3.5, 5.1, 2.3), cache=False)
    assert part.box.low.tolist() == [2, 2, 0]
    assert part.box.high.tolist() == [18, 26, 12]
    window = tuple(slice(a, b) for a, b in zip(part.box.low.tolist(), part.box.high.tolist(), strict=True))
    assert torch.equal(part.occupied, hall.occupied[window])
    assert torch.equal(part.navigable, hall.navigable[window])  # surfaces beyond the bounds are there as well
    assert not bool((part.observable & ~hall.observable[window]).any())


def test_open_hall_ends_at_its_bounds():
    # The faces of a prism are its sides (8), its top (2) and its bottom (2).
    roofless = torch.cat([HALL[:8], HALL[10:]])
    world = World.from_mesh(roofless, bounds=(0, 0, 0, 10, 6, 2.7), cache=False)
    assert bool(world.navigable[10, 10, -1])
    holed = torch.cat([HALL[:3], HALL[4:12]])  # half a wall is missing
    world = World.from_mesh(holed, bounds=(-4, -4, 0, 14, 10, 3), cache=False)
    outside = world.centers(torch.ones(world.box.shape).nonzero())[:, :2]
    outside = ((outside < 0) | (outside > torch.tensor([10.0, 6.0]))).any(1).view(world.box.shape)
    assert not bool((world.navigable & outside).any())  # no floor there
    assert not bool((world.observable & outside).any())


def test_world_ignores_inverted_and_degenerate_triangles(hall):
    odd = torch.cat([HALL.flip(1)[::2], HALL[1::2], torch.ones(1, 3, 3, dtype=torch.float64)])
    world = World.from_mesh(odd, cache=False)
    assert torch.equal(world.navigable, hall.navigable)
    assert torch.equal(world.occupied, hall.occupied)


def test_start_selects_the_navigable_part():
    two = torch.cat([box((0.1, 0.1, 0.1), (5.9, 3.9, 2.9)), box((7.1, 0.1, 0.1), (9.9, 2.9, 2.9))])
    left = World.from_mesh(two, cache=False)
    right = World.from_mesh(two, cache=False, start=(8.5, 1.5, 1.5))
    assert not bool((left.navigable & right.navigable).any())
    assert bool(right.navigable[42, 7, 7])
    assert bool(left.navigable[10, 7, 7])
    assert not bool(right.observable[:30].any())
    with pytest.raises(InvalidArgumentError, match=r"start=.*touches the mesh"):
        World.from_mesh(two, cache=False, start=(0.2, 1.5, 1.5))
    with pytest.raises(InvalidArgumentError, match=r"start=.*outside the bounds"):
        World.from_mesh(two, cache=False, start=(20.0, 1.5, 1.5))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"bounds": (20, 20, 0, 30, 30, 3)}, r"do not meet mesh, which extends from \(0.1"),
        ({"bounds": (5, 0, 0, 1, 6, 3)}, "are empty"),
        ({"bounds": (0, 0, 0, 5, 6, math.nan)}, "six finite numbers"),
        ({"bounds": (0, 0, 0, 5)}, "six finite numbers"),
        ({"bounds": (0, 0, 0, 5)}, r"bounds=\[0.0, 0.0, 0.0, 5.0\]"),
        ({"bounds": (1, 1, 1, 2, 2, 2)}, r"bounds=\[1.0, .* 2.0\] contain no surface of mesh"),
        ({"max_range": 0.7}, r"max_range=0.7 .*robot_radius=0.3 .*resolution=0.2"),
        ({"resolution": 3.0}, r"max_range=6.0 .*resolution=3.0"),
        ({"robot_radius": 3.0}, "robot_radius=3.0"),
        ({"robot_radius": 0.0}, "robot_radius=0.0"),
        ({"vertical_fov": 0.0}, "vertical_fov=0.0"),
        ({"max_range": -1.0}, "max_range=-1.0"),
        ({"max_range": math.inf}, "max_range=inf"),
        ({"resolution": 0.0}, "resolution"),
        ({"start": (1.0, 2.0)}, "three finite numbers"),
    ],
)
def test_world_rejects_settings_without_navigable_space(options, message):
    with pytest.raises(InvalidArgumentError, match=message):
        World.from_mesh(HALL, cache=False, **options)


def test_world_rejects_bad_meshes_and_too_many_cells():
    with pytest.raises(DataError, match="no triangles"):
        World.from_mesh(HALL[:0], cache=False)
    with pytest.raises(MemoryLimitError, match="coarser resolution"):
        World.from_mesh(HALL, 0.001, cache=False)
    with pytest.raises(MemoryLimitError, match=r"bounds.*not millimetres"):
        World.from_mesh(1000 * HALL, cache=False)


def same(a: World, b: World) -> bool:
    return all(
        torch.equal(getattr(a, name), getattr(b, name)) for name in ("occupied", "observable", "navigable")
    )


def test_world_cache_returns_equal_cells_without_computing(hall, tmp_path):
    def stages(**options) -> tuple[World, set[str]]:
        heard: set[str] = set()
        world = World.from_mesh(HALL, on_event=lambda stage, done, total: heard.add(stage), **options)
        return world, heard

    first, work = stages()
    assert work
    again, work = stages()
    assert not work
    assert same(first, hall)
    assert same(again, hall)
    assert len(list((tmp_path / "cache").rglob("*.safetensors"))) == 1
    for other in ({"max_range": 5.0}, {"robot_radius": 0.35}):
        assert stages(**other)[1], other
    assert stages(cache=False)[1]


@pytest.mark.parametrize("harm", ["cut", "flip", "foreign", "swap"])
def test_world_cache_rejects_damaged_and_foreign_files(hall, tmp_path, caplog, harm):
    World.from_mesh(HALL)
    (file,) = (tmp_path / "cache").rglob("*.safetensors")
    data = file.read_bytes()
    if harm == "cut":
        file.write_bytes(data[: len(data) // 2])
    elif harm == "flip":
        file.write_bytes(data[:-1] + bytes([data[-1] ^ 4]))
    elif harm == "foreign":
        file.write_bytes(b"not a world at all")
    else:
        World.from_mesh(HALL, max_range=2.0)
        (other,) = set((tmp_path / "cache").rglob("*.safetensors")) - {file}
        file.write_bytes(other.read_bytes())
    with caplog.at_level(logging.WARNING):
        world = World.from_mesh(HALL)
    assert same(world, hall)
    assert "cannot be used and is computed again" in caplog.text
    assert same(World.from_mesh(HALL), hall)  # it was mended


def test_world_cache_warns_if_it_cannot_write(hall, tmp_path, monkeypatch, caplog):
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("GMMTORCH_CACHE", str(tmp_path / "file"))
    with caplog.at_level(logging.WARNING):
        assert same(World.from_mesh(HALL), hall)
    assert "not cached" in caplog.text


def poses_of(world: World) -> torch.Tensor:
    """Start poses of three robots, which are checked."""
    primitives = Primitives(Dynamics())
    return check_start(world, start_poses(world, 3, primitives), primitives)


def test_open_world_opens_each_name():
    store = open_world("warehouse", size=(18.0, 14.0, 5.0), resolution=0.4, cache=False)
    assert store.box.shape == (45, 35, 13)
    assert len(poses_of(store)) == 3
    assert float(poses_of(store)[0, :3].sub(store.start).norm()) < 1.0
    mine = open_world("tunnels", seed=2, size=(40.0, 40.0, 8.0), resolution=0.4, cache=False)
    assert 0.02 < float(mine.navigable.double().mean()) < 0.5
    assert len(poses_of(mine)) == 3
    part = open_world(
        "warehouse", size=(18.0, 14.0, 5.0), bounds=(8, 2, 0, 18, 12, 5), resolution=0.4, cache=False
    )
    assert bool(part.navigable.any())


def test_open_world_rejects_unknown_names_and_options(tmp_path):
    with pytest.raises(InvalidArgumentError, match="world='moon'"):
        open_world("moon")
    with pytest.raises(MissingDataError, match=r"path=.*nowhere\.ply"):
        open_world("mesh", path=tmp_path / "nowhere.ply")
    with pytest.raises(MissingDataError, match=r"path=None"):
        open_world("mesh")
    with pytest.raises(InvalidArgumentError, match="path"):
        open_world("warehouse", path="x.ply")
    with pytest.raises(InvalidArgumentError, match="size"):
        open_world("mesh", path="x.ply", size=(1, 1, 1))


@pytest.mark.real_data
@pytest.mark.parametrize(
    ("file", "bounds", "volume"),
    [
        ("warehouse.ply", (-7, -10.4, 0, 7, 10.4, 3), (300.0, 900.0)),
        ("edgar_mine.ply", (60, -200, -1, 100, -160, 3), (100.0, 3000.0)),
    ],
)
def test_open_world_reads_real_meshes(real_data, file, bounds, volume):
    world = open_world("mesh", path=real_data / "meshes" / file, bounds=bounds, cache=False)
    assert volume[0] < float(world.navigable.sum()) * 0.2**3 < volume[1]
    assert bool((world.observable & world.occupied).any())
    assert bool(world.observable[world.navigable].all())
    assert float(world.mesh.clearance(world.centers(world.navigable.nonzero())).min()) > 0.3
    assert len(poses_of(world)) == 3


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
            length = MeshWorld(ROOM).distances(origin, directions).clamp_max(3.0) + beyond
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

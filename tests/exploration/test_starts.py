"""Starts: robots near walls, near the floor and in corridors take off or are rejected; poses of teams."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from exploration.rooms import HALL, SMALL, room
from hypothesis import given, settings
from hypothesis import strategies as st

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.simulation.furniture import box
from gmmtorch.team.exploration import Mission, World, drive, start_poses
from gmmtorch.team.exploration.mission.driver import SimulatedClock
from gmmtorch.team.exploration.mission.trials import assemble
from gmmtorch.team.exploration.planning.collision_checking import cells_in_sphere
from gmmtorch.team.exploration.planning.primitives import Dynamics, Primitives
from gmmtorch.team.exploration.world import starts
from gmmtorch.team.exploration.world.starts import initial_free_space

PRIMITIVES = Primitives(Dynamics())
ALONE = replace(SMALL, framework="grid_isolated", size=1)


@pytest.fixture(scope="module")
def hall() -> World:
    return World.from_mesh(room(), cache=False, name="hall")


@pytest.fixture(scope="module")
def divided() -> World:
    return World.from_mesh(HALL, cache=False, name="hall")


def corridor(width: float, height: float) -> World:
    walls = box((0.1, 0.1, 0.1), (12.1, 0.1 + width, 0.1 + height))
    return World.from_mesh(walls, cache=False, name="corridor")


def flown(world: World, *start: tuple[float, ...], size: int = 1, duration: float = 8.0) -> Mission:
    options = replace(ALONE, size=len(start) or size, start=start or None, duration=duration)
    mission = assemble(world, options)
    drive(mission, SimulatedClock())
    assert not any(robot.collisions for robot in mission.robots)
    return mission


def place(*coordinates: float) -> torch.Tensor:
    return torch.tensor(coordinates, dtype=torch.float64)


# -- initial knowledge -------------------------------------------------------------------------------------


def test_open_start_knows_only_the_clear_sphere(hall: World) -> None:
    here = place(5.1, 4.3, 1.7)
    launch = initial_free_space(hall, here, PRIMITIVES)
    assert launch is not None
    assert torch.equal(launch.trail, here[None])
    clear = min(float(hall.mesh.clearance(here[None])), 3**0.5 * (0.3 + 2.5 * 0.2))
    assert torch.equal(launch.known_free, cells_in_sphere(here, clear, 0.2))


@settings(max_examples=15)
@given(x=st.floats(0.45, 9.7), y=st.floats(0.45, 7.7), z=st.floats(0.45, 2.7), seed=st.integers(0, 2))
def test_initial_free_cells_are_free_and_the_trail_is_clear(
    hall: World, x: float, y: float, z: float, seed: int
) -> None:
    against = [place(0.42, y, z), place(x, 7.78, z), place(x, y, 0.42)][seed]
    launch = initial_free_space(hall, against, PRIMITIVES)
    assert launch is not None
    cells = launch.known_free - hall.box.low
    assert bool((cells >= 0).all())
    assert not bool(hall.occupied[cells.unbind(1)].any())
    assert torch.equal(launch.trail[-1], against)
    assert float((launch.trail[0] - against).norm()) < 2
    assert float(hall.mesh.clearance(launch.trail).min()) > 0.3
    if len(launch.trail) > 1:
        assert float((launch.trail[1:] - launch.trail[:-1]).norm(dim=1).max()) < 0.051


# -- missions ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "start",
    [
        (0.46, 4.0, 1.5, 3.1),  # facing a wall
        (3.0, 4.0, 0.42, 0.0),  # on the floor
        (0.45, 0.45, 0.45, 0.8),  # in a corner
    ],
)
def test_robot_near_a_surface_flies_off(hall: World, start: tuple[float, ...]) -> None:
    (robot,) = flown(hall, start).robots
    assert robot.path_length > 1


def test_teams_start_at_the_widest_part_of_a_corridor() -> None:
    world = corridor(1.8, 2.5)
    mission = flown(world, size=2, duration=16.0)
    starts = torch.stack([path[0][:3] for path in mission.trajectories])
    assert float(world.mesh.clearance(starts).min()) > 0.75
    assert min(robot.path_length for robot in mission.robots) > 0.3
    assert max(robot.path_length for robot in mission.robots) > 2


def test_low_room_is_flown_at_half_height() -> None:
    world = World.from_mesh(box((0.1, 0.1, 0.1), (8.1, 6.1, 1.5)), cache=False, name="low")
    mission = flown(world)
    assert abs(float(mission.trajectories[0][0][2]) - 0.8) < 0.11
    assert mission.robots[0].path_length > 2


def test_start_without_safe_motion_is_rejected_with_a_better_place() -> None:
    closet = box((3.1, 3.1, 0.1), (4.7, 4.7, 2.0))
    hall = World.from_mesh(room(closet), cache=False, name="hall")
    inside = World.from_mesh(room(closet), start=(3.9, 3.9, 1.1), cache=False, name="hall")
    with pytest.raises(
        InvalidArgumentError, match=r"start\[0\]=\[3.9, 3.9, 1.1, 0\] is not in the part .*for instance"
    ) as error:
        flown(hall, (3.9, 3.9, 1.1, 0.0))
    moved = tuple(float(x) for x in str(error.value).split("for instance to [")[1].split("]")[0].split(","))
    assert len(start_poses(hall, replace(ALONE, start=(moved,)))) == 1
    with pytest.raises(InvalidArgumentError, match=r"start\[0\].* no safe motion leads away .*radius=0.3 m"):
        flown(inside, (3.9, 3.9, 1.1, 0.0))
    with pytest.raises(InvalidArgumentError, match=r"found no start poses .*radius=0.3 .*start"):
        flown(inside)


def test_start_without_a_floor_is_rejected() -> None:
    floorless = torch.cat([room()[:10], box((1.1, 1.1, 0.1), (3.1, 3.1, 0.3))])
    world = World.from_mesh(floorless, cache=False, name="hall")
    with pytest.raises(InvalidArgumentError, match=r"room for \d robots? that starts? .*size=9.*a floor"):
        flown(world, size=9)
    with pytest.raises(InvalidArgumentError, match=r"start\[0\].* has no surface of hall below it"):
        flown(world, (6.0, 5.0, 1.5, 0.0))


# -- start poses of a team --------------------------------------------------------------------------


def test_start_poses_are_separated_visible_roomy_and_level(divided: World) -> None:
    near = replace(divided, start=place(3.0, 3.0, 1.5))
    poses = starts.start_poses(near, 4, PRIMITIVES)
    assert poses.shape == (4, 4)
    assert torch.equal(poses, starts.check_start(divided, poses, PRIMITIVES))
    assert torch.equal(poses, starts.start_poses(near, 4, PRIMITIVES))
    places = poses[:, :3]
    gaps = torch.pdist(places)
    assert float(gaps.min()) >= 1.5 - 1e-9
    assert float((places - places[0]).norm(dim=1).max()) < 4
    assert float(divided.mesh.clearance(places).min()) >= 0.99
    way = places[1:] - places[0]
    sight = divided.mesh.distances(places[0], way / way.norm(dim=1, keepdim=True))
    assert bool((sight > way.norm(dim=1)).all())
    turn = torch.remainder(poses[1:, 3] - poses[:-1, 3], 2 * math.pi)
    assert torch.allclose(turn, torch.full((3,), math.pi / 2, dtype=torch.float64))


def test_default_start_poses_lie_at_an_end_and_fit_large_teams(divided: World) -> None:
    one = starts.start_poses(divided, 1, PRIMITIVES)
    assert float((one[0, :2] - torch.tensor([5.0, 3.0])).abs()[0]) > 3
    assert len(starts.check_start(divided, starts.start_poses(divided, 16, PRIMITIVES), PRIMITIVES)) == 16
    tube = World.from_mesh(box((0.1, 0.1, 0.1), (30.1, 1.7, 1.7)), cache=False, name="tube")
    assert len(starts.start_poses(tube, 12, PRIMITIVES)) == 12  # one behind another
    with pytest.raises(InvalidArgumentError, match=r"hall has room for \d+ robots .* size=500.*a floor"):
        starts.start_poses(divided, 500, PRIMITIVES)


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        (
            (0.25, 3.0, 1.5, 0.0),
            r"start\[1\]=\[0.25, 3, 1.5, 0\] is 0.15 m from .*move it, for instance to \[",
        ),
        ((4.1, 2.0, 1.5, 0.0), "from a surface"),
        ((7.8, 4.6, 0.85, 0.0), "is in a solid, or in another part, which bounds="),
        ((-3.0, 2.0, 1.5, 0.0), r"outside the bounds of hall, \[0, 0, 0\] to \[10, 6, 3\] m"),
        ((2.0, 2.0, 1.5, math.nan), "not finite"),
        ((math.inf, 2.0, 1.5, 0.0), "not finite"),
        ((1.3, 1.0, 1.5, 0.0), r"touches the robot of start\[0\]"),
    ],
)
def test_check_start_names_impossible_poses(divided: World, pose: tuple[float, ...], message: str) -> None:
    poses = torch.tensor([(1.1, 1.1, 1.5, 0.0), pose], dtype=torch.float64)
    with pytest.raises(InvalidArgumentError, match=message):
        starts.check_start(divided, poses, PRIMITIVES)

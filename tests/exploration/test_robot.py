"""Robot: its path, its trail, and its local map."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from gmmtorch.exploration.information.view_library import ViewLibrary
from gmmtorch.exploration.planning.collision_checking import cells_in_sphere
from gmmtorch.exploration.planning.planner_interface import Plan
from gmmtorch.exploration.planning.roadmap import Roadmap
from gmmtorch.exploration.robot.grid_mapper import GridMapper
from gmmtorch.exploration.robot.initial_free_space import InitialFreeSpace
from gmmtorch.exploration.robot.mapper import Memo
from gmmtorch.exploration.robot.robot_state import Robot, StoppingRule
from gmmtorch.exploration.world.scoring import BeliefMap, BeliefRule
from gmmtorch.mapping.learning.rules import NoveltyRule
from gmmtorch.occupancy.voxels.boxes import Box
from gmmtorch.occupancy.voxels.cell_evidence import CellEvidence
from gmmtorch.occupancy.voxels.rolling_window import RollingWindow
from gmmtorch.simulation.sensors.depth_camera import DepthFrame

BOX = Box(torch.tensor([0, 0, 0]), torch.tensor([32, 32, 16]))
WINDOW = (32, 32, 16)
START = torch.tensor([3.1, 3.1, 1.5, 0.3], dtype=torch.float64)


class Idle:
    """A planner that must not be called."""

    def plan(self, task: Any) -> Plan:
        raise AssertionError("A robot does not call its planner; its agent does.")


def robot(start_radius: float = 0.0) -> Robot:
    belief = BeliefMap(0.2, BOX, torch.ones(BOX.shape, dtype=torch.bool), BeliefRule())
    mapper = GridMapper(
        0, RollingWindow(0.2, WINDOW, 4), belief, 8, NoveltyRule(resolution=0.2), Memo(8), True, 3
    )
    mapper.center_on(START[:3])
    launch = InitialFreeSpace(cells_in_sphere(START[:3], start_radius, 0.2), START[None, :3])
    return Robot(0, START, mapper, Idle(), ViewLibrary(0), Roadmap(), launch, StoppingRule())


def plan(path: Tensor) -> Plan:
    return Plan(path, path[-1:].clone(), path[-1:, :4], 1.0, "test")


def zigzag(n: int = 10) -> Tensor:
    """States (n, 7) of a path whose steps are 3, 4, 3, 4 … decimetres, along x and y."""
    path = torch.zeros(n, 7, dtype=torch.float64)
    step = torch.arange(1, n + 1)
    path[:, 0] = START[0] + 0.3 * ((step + 1) // 2)
    path[:, 1] = START[1] + 0.4 * (step // 2)
    path[:, 2] = START[2]
    path[:, 4] = step.double() / n
    return path


def test_a_robot_begins_at_rest_at_its_start() -> None:
    one = robot()
    assert one.state.tolist() == [*START.tolist(), 0, 0, 0]
    assert one.position.tolist() == START[:3].tolist()
    assert one.path_length == 0
    assert one.collisions == 0


def test_path_length_is_the_sum_of_the_steps() -> None:
    one, path = robot(), zigzag()
    one.follow(plan(path))
    assert torch.equal(one.advance(0, 3), path[:3, :3])
    assert one.path_length == pytest.approx(0.3 + 0.4 + 0.3)
    assert torch.equal(one.state, path[2])
    assert torch.equal(one.advance(3, 6), path[3:6, :3])
    assert one.path_length == pytest.approx(3 * 0.3 + 3 * 0.4)
    assert torch.equal(one.state, path[5])


def test_a_robot_stays_at_the_end_of_its_path() -> None:
    one, path = robot(), zigzag()
    one.follow(plan(path))
    one.advance(0, 8)
    assert one.advance(8, 13).shape == (2, 3)
    flown = one.path_length
    assert flown == pytest.approx(5 * 0.3 + 5 * 0.4)
    for _ in range(3):
        assert one.advance(13, 18).shape == (0, 3)
        assert one.path_length == flown
        assert torch.equal(one.state, path[-1])
    # The next plan starts there.
    back = path.flip(0)[1:]
    one.follow(plan(back))
    one.advance(0, 9)
    assert one.path_length == pytest.approx(2 * flown - 0.3)


def test_a_robot_without_a_plan_stays() -> None:
    one = robot()
    one.advance(0, 5)
    assert one.path_length == 0
    assert one.position.tolist() == START[:3].tolist()


# -- where it fits --------------------------------------------------------------------------------------


def everywhere(one: Robot, hits: float, misses: float) -> None:
    local = one.mapper.local
    local.add(
        CellEvidence.from_dense(local.box.low, torch.full(local.shape, hits), torch.full(local.shape, misses))
    )


def test_the_trail_contains_flown_positions_only() -> None:
    one, path = robot(), zigzag()
    one.follow(plan(torch.cat([path, path[-1:].expand(30, 7)])))
    one.advance(0, 40)
    assert torch.equal(one.trail, torch.cat([START[None, :3], path[:, :3]]))


def test_a_long_trail_loses_its_oldest_positions() -> None:
    one = robot()
    path = torch.zeros(500, 7, dtype=torch.float64)
    path[:, 0] = torch.arange(500) * 0.1
    one.follow(plan(path))
    one.advance(0, 500)
    assert torch.equal(one.trail, path[-len(one.trail) :, :3])
    assert len(one.trail) < 500


def test_a_retreat_shortens_the_trail() -> None:
    one, path = robot(), zigzag()
    one.follow(plan(path))
    one.advance(0, 10)
    back = path.flip(0)[1:5]
    one.follow(Plan(back, back[-1:], back[-1:, :4], 0.0, "retreat"))
    one.advance(0, 2)
    one.advance(2, 4)
    assert torch.equal(one.trail, torch.cat([START[None, :3], path[:6, :3]]))
    one.follow(plan(path[6:7]))
    one.advance(0, 1)
    assert torch.equal(one.trail, torch.cat([START[None, :3], path[:7, :3]]))


def test_recent_returns_are_obstacles() -> None:
    one = robot()
    everywhere(one, 0.0, 50.0)
    free = one.local_map(0.125, 0.3, WINDOW)
    wall = torch.tensor([[4.5, 3.1, 1.5], [4.5, 3.3, 1.5]], dtype=torch.float64)
    thin = torch.tensor([[2.1, 3.1, 1.5]], dtype=torch.float64)  # the end of an empty beam
    ends, is_hit = torch.cat([wall, thin]), torch.tensor([True, True, False])
    one._remember_returns(DepthFrame(START[:3], ends, is_hit, torch.arange(3)))
    found = one.local_map(0.125, 0.3, WINDOW)
    taken = free.free & ~found.free
    cells = (wall / 0.2).floor().long()
    assert (taken.nonzero() + found.low).tolist() == cells.tolist()
    # Every cell that is no longer passable is near a return, and those at it are not.
    lost = found.centers((free.passable & ~found.passable).nonzero())
    assert float(torch.cdist(lost, wall).amin(1).max()) < 0.3 + 2.5 * 0.2 * 3**0.5
    assert not bool(found.is_passable(wall).any())
    assert bool(found.is_passable(thin).all())
    # After twelve frames more it is forgotten; frames without returns do not count.
    nothing = DepthFrame(START[:3], ends[2:], is_hit[2:], torch.arange(1))
    for _ in range(20):
        one._remember_returns(nothing)
    assert not bool(one.local_map(0.125, 0.3, WINDOW).is_passable(wall).any())
    elsewhere = DepthFrame(START[:3], wall[:1] + 1.0, is_hit[:1], torch.arange(1))
    for _ in range(12):
        one._remember_returns(elsewhere)
    assert bool(one.local_map(0.125, 0.3, WINDOW).is_passable(wall).all())


def test_the_known_sphere_around_the_start_is_free() -> None:
    found = robot(start_radius=1.4).local_map(0.125, 0.3, WINDOW)
    centers = found.centers(found.free.nonzero())
    assert len(centers) > 100
    assert float((centers - START[:3]).norm(dim=1).max()) <= 1.4
    assert int(found.passable.sum()) > 1
    assert not bool(found.observed.any())

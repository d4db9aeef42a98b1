"""Planners explore small worlds without collisions; frontiers, against a loop over cells."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from exploration.voxel_worlds import (
    EVALUATOR,
    PRIMITIVES,
    RESOLUTION,
    Explorer,
    corridor,
    explore,
    hollow,
    two_rooms,
)

from gmmtorch.team.exploration.planning.collision_checking import LocalMap, PeerTrajectories, feasible
from gmmtorch.team.exploration.planning.journeys import Journey
from gmmtorch.team.exploration.planning.planner_interface import Plan
from gmmtorch.team.exploration.planning.planners import PLANNERS, find_frontiers, frontier_cells


def planner_named(name: str):
    return PLANNERS[name](PRIMITIVES, EVALUATOR)


def same(one: Plan, other: Plan) -> bool:
    names = ("path", "braking", "views")
    return all(torch.equal(getattr(one, name), getattr(other, name)) for name in names) and (
        (one.kind, one.value) == (other.kind, other.value)
    )


@pytest.mark.parametrize("name", PLANNERS)
@pytest.mark.parametrize("world", [two_rooms, corridor])
def test_planned_paths_are_feasible_and_touch_nothing(name, world):
    explorer = Explorer.at(world(), (1.2, 1.2, 1.2, math.pi))
    planner, generator = planner_named(name), torch.Generator().manual_seed(3)
    for _ in range(5):
        task = explorer.task(generator)
        plan = planner.plan(task)
        assert plan.path.shape == (PRIMITIVES.dynamics.n_steps, 7)
        assert plan.views.shape[1] == 4
        assert math.isfinite(plan.value)
        assert plan.kind in ("explore", "travel", "wait")
        assert not bool(plan.braking[-1, 4:].any())
        start, radius = task.state, PRIMITIVES.dynamics.radius
        assert bool(feasible(plan.path, plan.braking, task.local_map, start=start, radius=radius))
        assert explorer.clearance(torch.cat([plan.path, plan.braking])[:, :3]) > 0.3
        explorer.follow(plan)


def test_tree_planner_explores_more_than_random():
    seen = {}
    for name in ("mcts", "random"):
        explorer = Explorer.at(two_rooms(), (1.5, 1.5, 1.3, 0.0))
        explore(planner_named(name), explorer, 14)
        seen[name] = explorer.seen
    assert seen["mcts"][-1] > 0.85
    half = len(seen["mcts"]) // 2
    assert seen["mcts"][half] > seen["random"][half] + 0.05
    assert sum(seen["mcts"]) > sum(seen["random"])


def test_tree_planner_flies_around_a_corner():
    explorer = Explorer.at(corridor(), (1.2, 1.2, 1.2, math.pi))
    explore(planner_named("mcts"), explorer, 18)
    seen = (explorer.hits + explorer.misses) > 0
    assert float(seen[~explorer.solid].float().mean()) > 0.8
    assert float(seen[51:61, 30:41, 1:12].float().mean()) > 0.5


def test_tree_planner_gives_up_a_view_that_shows_nothing():
    """The end of the corridor stays unknown, however often the robot looks at it."""
    explorer = Explorer.at(corridor(), (10.0, 1.2, 1.2, 0.0)).know_all()
    planner, generator = planner_named("mcts"), torch.Generator().manual_seed(0)
    pose = torch.tensor([[11.2, 5.2, 1.2, math.pi / 2]], dtype=torch.float64)
    kinds = []
    for turn in range(14):
        explorer.misses[51:61, 33:41, 1:12] = 0.0
        if turn in (0, 9):
            explorer.library.add(pose, torch.tensor([50.0]), explorer.now, 0.0)
        plan = planner.plan(explorer.task(generator))
        kinds.append(plan.kind)
        explorer.follow(plan)
    assert "travel" in kinds[:9]
    assert "travel" not in kinds[9:]  # although another robot values the view again


def test_tree_planner_travels_to_a_distant_view():
    """A robot that has seen its room knows of a view beyond the corner, and of the way there."""
    explorer = Explorer.at(corridor(), (1.2, 1.2, 1.2, 0.0))
    explorer.know_all()
    explorer.misses[51:61, 33:41, 1:12] = 0.0  # all but the far end
    pose = torch.tensor([[11.2, 5.2, 1.2, math.pi / 2]], dtype=torch.float64)
    planner, generator = planner_named("mcts"), torch.Generator().manual_seed(0)
    explorer.library.add(pose, torch.tensor([50.0]), 0.0, 0.0)
    kinds, library_sizes = [], []
    for _ in range(14):
        plan = planner.plan(explorer.task(generator))
        library_sizes.append(len(explorer.library))
        kinds.append(plan.kind)
        explorer.follow(plan)
        if float(((explorer.hits + explorer.misses) > 0)[53:59, 35:39, 3:9].float().mean()) > 0.9:
            break
    assert kinds[:3] == ["travel"] * 3
    assert library_sizes[0] == 0  # it is taken: nobody else goes there
    assert len(kinds) < 14


def test_journey_ends_without_progress(generator):
    explorer = Explorer.at(hollow(30, 20, 13), (1.2, 1.2, 1.2, 0.0))
    explorer.know_all()
    pose = torch.tensor([50.0, 50.0, 1.2, 0.0], dtype=torch.float64)
    journey = Journey(pose, 9.0, 60.0, 0.0)
    assert journey.goal(explorer.task(generator), 1.0) is not None
    explorer.now = 30.0
    assert journey.goal(explorer.task(generator), 1.0) is None
    here = Journey(explorer.state[:4].clone(), 9.0, 0.0, 30.0)
    assert here.goal(explorer.task(generator), 1.0) is None


def test_teammates_plans_send_the_robot_elsewhere():
    explorer = Explorer.at(hollow(60, 20, 13), (6.0, 2.0, 1.2, math.pi / 2))
    looks = []
    for side in (slice(0, 30), slice(30, 60)):
        task = explorer.task(torch.Generator().manual_seed(0))
        blocks = torch.ones(15, 5, 4)
        blocks[side.start // 4 : side.stop // 4] = 0
        task = type(task)(**{**task.__dict__, "residual": blocks.flatten()})
        looks.append(planner_named("mcts").plan(task).views)
    east = [float(views[:, 3].cos().mean()) for views in looks]
    assert east[0] > east[1]


@pytest.mark.parametrize("name", PLANNERS)
def test_moving_robot_brakes_if_its_way_closes(name):
    explorer = Explorer.at(hollow(60, 20, 13), (3.0, 2.0, 1.2, 0.0))
    explorer.state[4] = 1.5
    around = torch.tensor([[x, 2.0, 1.2] for x in (1.6, 4.6)], dtype=torch.float64)
    task = explorer.task(
        torch.Generator().manual_seed(0), PeerTrajectories.of([p[None] for p in around], 3.0)
    )
    plan = planner_named(name).plan(task)
    assert plan.kind == "wait"
    n = len(plan.braking)
    torch.testing.assert_close(plan.path[:n], PRIMITIVES.braking(task.state)[: len(plan.path)])
    assert not bool(plan.path[-1, 4:].any())


def test_random_planner_persists_and_changes():
    explorer = Explorer.at(hollow(80, 60, 13), (6.0, 6.0, 1.2, 0.0))
    explorer.know_all()
    plans = explore(planner_named("random"), explorer, 30)
    speeds = torch.stack([plan.path[-1, 4:] for plan in plans])
    kept = (speeds[1:] == speeds[:-1]).all(1).float().mean()
    assert 0.2 < float(kept) < 0.9
    assert explorer.flown > 15


NONE = torch.zeros(0, 3, dtype=torch.float64)


def half_known() -> LocalMap:
    """An open hall of 8 × 4 × 2 m, of which the half at low x has been seen."""
    observed = torch.zeros(40, 20, 10, dtype=torch.bool)
    observed[:20] = True
    inner = torch.zeros_like(observed)
    inner[1:-1, 1:-1, 1:-1] = True
    free = observed & inner
    passable = free.clone()
    passable[18:], passable[:3], passable[:, :3], passable[:, -3:] = False, False, False, False
    passable[..., :3], passable[..., -3:] = False, False
    return LocalMap(torch.zeros(3).long(), RESOLUTION, free.float(), observed, free, passable)


def test_frontier_cells_are_free_cells_next_to_unknown_ones(generator):
    observed = torch.rand(7, 6, 5, generator=generator) < 0.6
    free = (torch.rand(7, 6, 5, generator=generator) < 0.5) & observed
    free[0, 0, 0], observed[0, 0, 0] = True, False  # known to be free without having been seen
    here = LocalMap(torch.zeros(3).long(), RESOLUTION, free.float(), observed, free, free)
    found = frontier_cells(here)
    for cell in itertools.product(*(range(n) for n in free.shape)):
        beside = []
        for axis, step in itertools.product(range(3), (-1, 1)):
            other = list(cell)
            other[axis] += step
            if all(0 <= c < n for c, n in zip(other, free.shape, strict=True)):
                beside.append(bool(observed[tuple(other)] or free[tuple(other)]))
        assert bool(found[cell]) == (bool(free[cell]) and not all(beside))


def test_frontier_poses_are_reachable_and_see_the_target():
    here = half_known()
    start = torch.tensor([1.0, 2.0, 1.0], dtype=torch.float64)
    found = find_frontiers(here, start, NONE, least=1)
    assert 1 <= len(found.sizes) <= 3  # one wall of unknown, in glances
    assert float(found.sizes.sum()) == float(frontier_cells(here).sum()) == 18 * 8
    for pose, target, metres in zip(found.poses, found.targets, found.metres, strict=True):
        place, way = pose[:3], target - pose[:3]
        assert bool(here.is_passable(place))
        assert abs(float(target[0]) - 3.9) < 0.3
        assert abs(math.atan2(way[1], way[0]) - float(pose[3])) < 1e-9
        assert abs(math.atan2(way[2], way[:2].norm())) < 0.4
        assert abs(float(metres) - float((place - start).norm())) < 0.8
    assert len(find_frontiers(here, start, NONE, least=145).sizes) == 0


def test_exhausted_targets_are_not_frontiers():
    here = half_known()
    start = torch.tensor([1.0, 2.0, 1.0], dtype=torch.float64)
    first = find_frontiers(here, start, NONE)
    given_up = first.targets
    for _ in range(8):
        found = find_frontiers(here, start, given_up)
        if len(found.sizes) == 0:
            break
        assert float(torch.cdist(found.targets, given_up).min()) > 0.8
        given_up = torch.cat([given_up, found.targets])
    else:
        raise AssertionError("frontiers never end")


def test_known_space_has_no_frontiers():
    here = half_known()
    known = torch.ones_like(here.observed)
    here = LocalMap(here.low, RESOLUTION, here.occupancy, known, here.free, here.passable)
    found = find_frontiers(here, torch.tensor([1.0, 2.0, 1.0], dtype=torch.float64), NONE)
    assert [len(values) for values in found] == [0, 0, 0, 0]


def test_frontier_planner_flies_through_the_door():
    explorer = Explorer.at(two_rooms(), (1.5, 1.5, 1.3, 0.0))
    explore(planner_named("frontier"), explorer, 30)
    beyond = ((explorer.hits + explorer.misses) > 0)[30:53, 1:-1, 1:-1].float().mean()
    assert float(beyond) > 0.6
    assert explorer.flown > 5

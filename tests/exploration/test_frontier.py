"""Frontiers, against a loop over cells; and that its planner explores."""

from __future__ import annotations

import itertools
import math

import torch
from exploration.voxel_worlds import EVALUATOR, PRIMITIVES, RESOLUTION, Explorer, explore, two_rooms

from gmmtorch.team.exploration.planning.frontier import find_frontiers, frontier_cells
from gmmtorch.team.exploration.planning.planners import make_planner
from gmmtorch.team.exploration.robot.mapper import LocalMap

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


def test_frontier_cells_are_free_cells_next_to_unknown_ones():
    generator = torch.Generator().manual_seed(0)
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
    explore(make_planner("frontier", PRIMITIVES, EVALUATOR), explorer, 30)
    beyond = ((explorer.hits + explorer.misses) > 0)[30:53, 1:-1, 1:-1].float().mean()
    assert float(beyond) > 0.6
    assert explorer.flown > 5

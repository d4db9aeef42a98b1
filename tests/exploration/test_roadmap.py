"""The roadmap, against a plain search over the cells of the whole world."""

from __future__ import annotations

import itertools
import math

import torch
from exploration.voxel_worlds import RESOLUTION, surroundings_from
from hypothesis import given
from hypothesis import strategies as st

from gmmtorch.team.exploration.planning.geodesic import geodesic
from gmmtorch.team.exploration.planning.roadmap import Roadmap, at_the_rim
from gmmtorch.team.exploration.robot.mapper import LocalMap

WINDOW = (24, 24, 12)


def seen_through_windows(
    passable: torch.Tensor, low: tuple[int, int, int] = (0, 0, 0), step: int = 5
) -> Roadmap:
    """A roadmap of a world seen through windows that slide over it, whatever their alignment."""
    roadmap = Roadmap()
    ranges = [range(0, max(n - w, 0) + step, step) for n, w in zip(passable.shape, WINDOW, strict=True)]
    for corner in itertools.product(*ranges):
        cut = passable[tuple(slice(c, c + w) for c, w in zip(corner, WINDOW, strict=True))]
        padded = torch.zeros(WINDOW, dtype=torch.bool)
        padded[tuple(slice(0, n) for n in cut.shape)] = cut
        roadmap.update(surroundings_from(padded, tuple(a + b for a, b in zip(corner, low, strict=True))))
    return roadmap


def maze() -> torch.Tensor:
    """Passable cells of three lanes, joined at alternate ends."""
    passable = torch.zeros(64, 44, 16, dtype=torch.bool)
    passable[2:62, 2:12, 2:14] = True
    passable[2:62, 17:27, 2:14] = True
    passable[2:62, 32:42, 2:14] = True
    passable[52:62, 2:27, 2:14] = True
    passable[2:12, 17:42, 2:14] = True
    return passable


def test_route_lengths_agree_with_cell_distances():
    passable = maze()
    roadmap = seen_through_windows(passable, low=(-13, 6, 3))
    shift = torch.tensor([-13, 6, 3], dtype=torch.float64) * RESOLUTION
    cells = torch.tensor([[5, 6, 8], [55, 6, 8], [8, 22, 5], [50, 36, 10]])
    points = (cells + 0.5) * RESOLUTION + shift
    found = roadmap.distances(points[0], points)
    exact = geodesic(passable, cells[:1], RESOLUTION, torch.zeros(1), coarse=1)[cells.unbind(1)].double()
    for metres, true in zip(found.tolist(), exact.tolist(), strict=True):
        assert true - 2.5 <= metres <= 1.3 * true + 2.0
    assert float(found[3]) > 20  # around both bends, 9 m as the crow flies


def test_wall_of_three_cells_separates_nodes():
    for begin in range(20, 26):
        passable = torch.ones(48, 24, 12, dtype=torch.bool)
        passable[begin : begin + 3] = False
        roadmap = seen_through_windows(passable)
        ends = torch.tensor([[1.0, 2.0, 1.0], [9.0, 2.0, 1.0]], dtype=torch.float64)
        assert math.isinf(float(roadmap.distances(ends[0], ends[1:])[0]))
        passable[begin : begin + 3, 10, 5] = True
        roadmap = seen_through_windows(passable)
        assert math.isfinite(float(roadmap.distances(ends[0], ends[1:])[0]))


def test_update_removes_closed_edges():
    passable = torch.ones(48, 24, 12, dtype=torch.bool)
    roadmap = seen_through_windows(passable)
    ends = torch.tensor([[1.0, 2.0, 1.0], [9.0, 2.0, 1.0]], dtype=torch.float64)
    assert math.isfinite(float(roadmap.distances(ends[0], ends[1:])[0]))
    before = len(roadmap)
    shut = torch.ones(WINDOW, dtype=torch.bool)
    shut[8:16] = False
    roadmap.update(surroundings_from(shut, (12, 0, 0)))
    assert math.isinf(float(roadmap.distances(ends[0], ends[1:])[0]))
    assert len(roadmap) == before - 2 * 6 * 3


@given(seed=st.integers(0, 50))
def test_reaching_agrees_with_route(seed):
    generator = torch.Generator().manual_seed(seed)
    roadmap = seen_through_windows(maze(), step=12)
    lane = torch.rand(1, generator=generator, dtype=torch.float64) * 11 + 0.6
    goal = torch.tensor([float(lane), 1.3, 1.5], dtype=torch.float64)
    nodes, metres = roadmap.reaching(goal)
    some = torch.randint(len(nodes), (5,), generator=generator)
    for row in some.tolist():
        torch.testing.assert_close(roadmap.distances(nodes[row], goal[None])[0], metres[row])


def test_empty_roadmap_has_no_route():
    roadmap = Roadmap()
    point = torch.zeros(1, 3, dtype=torch.float64)
    assert len(roadmap) == 0
    assert math.isinf(float(roadmap.distances(point[0], point)[0]))
    assert len(roadmap.reaching(point[0])[0]) == 0
    tiny = torch.ones(3, 3, 3, dtype=torch.bool)  # holds no node
    roadmap.update(surroundings_from(tiny, (1, 1, 1)))
    assert len(roadmap) == 0


def test_roadmap_works_far_from_the_origin():
    passable = torch.ones(WINDOW, dtype=torch.bool)
    roadmap = Roadmap()
    roadmap.update(surroundings_from(passable, (2_500_000, -2_500_001, 3)))
    corner = torch.tensor([5e5, -5e5, 0.6], dtype=torch.float64)
    ends = corner + torch.tensor([[1.0, 1.0, 1.0], [4.0, 1.0, 1.0]], dtype=torch.float64)
    assert 2 < float(roadmap.distances(ends[0], ends[1:])[0]) < 5


def test_at_the_rim_selects_points_near_the_border():
    here: LocalMap = surroundings_from(torch.ones(10, 10, 10, dtype=torch.bool), (5, 5, 5))
    points = torch.tensor(
        [[1.1, 2.0, 2.0], [2.0, 2.0, 2.0], [0.9, 2.0, 2.0], [2.0, 2.9, 2.0]], dtype=torch.float64
    )
    assert at_the_rim(points, here.box, RESOLUTION, 0.3).tolist() == [True, False, False, True]

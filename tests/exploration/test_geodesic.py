"""Geodesic distance against Dijkstra's algorithm, and the roadmap against a search over all cells."""

from __future__ import annotations

import heapq
import itertools
import math

import pytest
import torch
from exploration.voxel_worlds import RESOLUTION, surroundings_from
from hypothesis import given
from hypothesis import strategies as st

from gmmtorch.team.exploration.planning.collision_checking import LocalMap
from gmmtorch.team.exploration.planning.journeys import (
    DistanceField,
    Roadmap,
    at_the_rim,
    coarsened,
    geodesic,
)

STEPS = [step for step in itertools.product((-1, 0, 1), repeat=3) if any(step)]


def by_dijkstra(open_cells: torch.Tensor, starts: dict[tuple[int, ...], float]) -> torch.Tensor:
    """Cell widths to the nearest start, one cell at a time."""
    found = torch.full(open_cells.shape, math.inf)
    heap = [(width, cell) for cell, width in starts.items()]
    heapq.heapify(heap)
    while heap:
        width, cell = heapq.heappop(heap)
        if found[cell] <= width:
            continue
        found[cell] = width
        for step in STEPS:
            other = tuple(c + d for c, d in zip(cell, step, strict=True))
            inside = all(0 <= c < n for c, n in zip(other, open_cells.shape, strict=True))
            if inside and open_cells[other]:
                heapq.heappush(heap, (width + math.hypot(*step), other))
    return found


@given(
    seed=st.integers(0, 1000),
    share=st.sampled_from([0.3, 0.5, 0.8, 1.0]),
    shape=st.tuples(*[st.integers(1, 7)] * 3),
    n=st.integers(0, 3),
)
def test_geodesic_equals_dijkstra(seed, share, shape, n):
    generator = torch.Generator().manual_seed(seed)
    passable = torch.rand(shape, generator=generator) < share
    sources = (torch.rand(n, 3, generator=generator) * torch.tensor(shape)).long()
    offsets = torch.rand(n, generator=generator)
    starts: dict[tuple[int, ...], float] = {}
    opened = passable.clone()
    for cell, offset in zip(sources.tolist(), offsets.tolist(), strict=True):
        opened[tuple(cell)] = True
        starts[tuple(cell)] = min(offset / 0.5, starts.get(tuple(cell), math.inf))
    found = geodesic(passable, sources, 0.5, offsets, coarse=1)
    torch.testing.assert_close(found, 0.5 * by_dijkstra(opened, starts), rtol=1e-5, atol=1e-5)


def test_coarsened_cells_are_passable_if_half_is():
    generator = torch.Generator().manual_seed(0)
    passable = torch.rand(7, 6, 5, generator=generator) < 0.5
    found = coarsened(passable, 2)
    assert found.shape == (4, 3, 3)
    for cell in itertools.product(range(4), range(3), range(3)):
        part = passable[tuple(slice(2 * c, 2 * c + 2) for c in cell)]
        assert bool(found[cell]) == (int(part.sum()) >= 4)


def test_coarsened_keeps_narrow_passages_and_thick_walls():
    passable = torch.zeros(12, 12, 12, dtype=torch.bool)
    passable[:, 5] = True  # wherever it lies, and however the coarse cells do
    along = geodesic(passable, torch.tensor([[0, 5, 6]]), 0.2, torch.zeros(1))
    assert bool(torch.isfinite(along[:, 2]).all())
    for begin in range(4, 7):
        wall = torch.ones(12, 12, 12, dtype=torch.bool)
        wall[begin : begin + 3] = False
        beyond = geodesic(wall, torch.tensor([[0, 5, 6]]), 0.2, torch.zeros(1))
        assert bool(torch.isinf(beyond[5]).all())


@given(seed=st.integers(0, 200))
def test_geodesic_is_close_to_euclidean_in_open_space(seed):
    generator = torch.Generator().manual_seed(seed)
    here = surroundings_from(torch.ones(20, 16, 10, dtype=torch.bool), low=(7, -3, 2))
    corner = here.low.double() * 0.2
    size = torch.tensor([4.0, 3.2, 2.0], dtype=torch.float64)
    goal, point = corner + torch.rand(2, 3, generator=generator, dtype=torch.float64) * size
    straight = float((goal - point).norm())
    found = float(DistanceField.to(here, goal[None]).way(point, 1)[0])
    assert straight - 0.4 < found < 1.13 * straight + 0.8  # to the goal's cell, by steps of 45°


def test_way_approaches_the_goal_cell_by_cell():
    passable = torch.ones(40, 40, 6, dtype=torch.bool)
    passable[18:22, :30] = False
    field = DistanceField.to(
        surroundings_from(passable), torch.tensor([[1.0, 1.0, 0.6]], dtype=torch.float64)
    )
    point = torch.tensor([[7.0, 1.0, 0.6]], dtype=torch.float64)
    before = float(field.way(point, 1)[0])
    for _ in range(60):
        metres, ahead = field.way(point, 3)
        assert float(metres) <= before + 1e-6
        assert float((ahead - point).norm()) < 3.5 * math.sqrt(3) * 0.4
        if float(metres) < 0.7:
            break
        assert float(field.way(ahead, 1)[0]) < float(metres) - 0.4
        before, point = float(metres), ahead
    else:
        pytest.fail("never arrived")
    assert float((field.way(point, 50)[1] - torch.tensor([1.0, 1.0, 0.6])).norm()) < 0.4


def test_geodesic_without_a_way_is_infinite():
    passable = torch.ones(20, 8, 8, dtype=torch.bool)
    passable[8:12] = False
    here = surroundings_from(passable)
    field = DistanceField.to(here, torch.tensor([[0.5, 0.5, 0.5]], dtype=torch.float64))
    points = torch.tensor([[3.5, 0.5, 0.5], [1e9, 0.0, 0.0], [0.7, 0.5, 0.5]], dtype=torch.float64)
    metres, ahead = field.way(points, 3)
    assert torch.isinf(metres).tolist() == [True, True, False]
    torch.testing.assert_close(ahead[:2], points[:2])
    nowhere = DistanceField.to(here, torch.tensor([[50.0, 0.5, 0.5]], dtype=torch.float64))
    assert bool(torch.isinf(nowhere.way(points, 1)[0]).all())
    assert bool(torch.isinf(geodesic(passable, torch.zeros(0, 3).long(), 0.2, torch.zeros(0))).all())


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

"""The search of poses against enumeration, and in a room whose shape is known."""

import math

import pytest
import torch
from torch import Tensor

import gmmtorch as gt
from gmmtorch.kernels import kernels, raster_sums
from gmmtorch.localization.pose_search import CORRELATED, FREE, UNKNOWN, Expectation, PoseSearch
from gmmtorch.pose import Pose


def room(n: int, seed: int) -> Tensor:
    """Points (N, 2) on the walls of an L-shaped room with a pillar."""
    corners = torch.tensor([[0, 0], [9, 0], [9, 4], [5, 4], [5, 7], [0, 7], [0, 0]]).double()
    pillar = torch.tensor([[2, 2], [2.6, 2], [2.6, 3], [2, 2]]).double()
    sides = torch.cat([torch.stack([c[:-1], c[1:]], 1) for c in (corners, pillar)])
    draw = torch.Generator().manual_seed(seed)
    lengths = (sides[:, 1] - sides[:, 0]).norm(dim=1)
    which = torch.multinomial(lengths, n, replacement=True, generator=draw)
    part = torch.rand(n, 1, generator=draw).double()
    return sides[which, 0] + part * (sides[which, 1] - sides[which, 0])


@pytest.mark.parametrize("seed", range(4))
def test_the_best_pose_is_that_of_all_placements(seed):
    search = PoseSearch(room(600, 0), cell=0.25)
    draw = torch.Generator().manual_seed(seed)
    pose = Pose.from_yaw(6 * torch.rand((), generator=draw), 2 + 2 * torch.rand(2, generator=draw).double())
    points = pose.inverse().apply(room(120, seed + 1))
    expected = Expectation(
        Pose.stack([pose.moved(torch.tensor([0.7, -0.4, 0.5]).double())]), 0.5, 0.3, 0.9, 1.0, 0.7
    )
    _, best = search.best(points, expected, 5)
    # The same raster, at every shift of a cell and every heading that the search tries.
    rows = search._spread_out(points)[:128]
    step = 0.25 / float(rows.norm(dim=1).quantile(0.8))
    center, scores = expected.poses[-1], []
    for turn in range(-math.ceil(0.7 / step), math.ceil(0.7 / step) + 1):
        turned = Pose.from_yaw(turn * step, torch.zeros(2)).rotation @ center.rotation
        placed = ((rows @ turned.T + center.translation) / 0.25).floor() - search._low
        for x in range(-5, 6):
            for y in range(-5, 6):
                at = (placed + torch.tensor([x, y])).long()
                sums = float(search._levels[0][0, 0, at[:, 0], at[:, 1]].double().sum())
                there = Pose(turned, center.translation + 0.25 * torch.tensor([x, y]).double())
                score = sums * len(points) / len(rows) / CORRELATED
                scores.append(score - float(expected.unlikely(there[None])))
    assert float(best[0]) == pytest.approx(max(scores), abs=1e-3)


@pytest.mark.parametrize("seed", range(4))
def test_the_squares_that_are_divided_first_are_not_lost(seed):
    search, draw = PoseSearch(room(600, 0)), torch.Generator().manual_seed(seed)
    pose = Pose.from_yaw(6 * torch.rand((), generator=draw), 1 + 2 * torch.rand(2, generator=draw).double())
    points = pose.inverse().apply(room(120, seed + 1))
    unknown = Expectation(Pose.from_yaw([0.0], [4.5, 3.5]), math.inf, math.inf, 1.0, 8.0)
    (_, found), (_, few) = search.anywhere(points, 5), search.best(points, unknown, 5, kept=1)
    assert len(few)
    assert float(few[0]) >= float(found[0]) - 20


def test_the_raster_of_a_map_knows_walls_free_space_and_what_is_behind():
    wall = torch.stack([torch.full((200,), 3.0), torch.linspace(-2, 2, 200)], 1).double()
    made = gt.GaussianMap()
    made.insert(gt.Scan(wall, torch.zeros(2)))
    made.finish()
    center = torch.tensor([1.0, 0.5]).double()
    search = PoseSearch.of_map(made.components(), center)
    asked = torch.tensor([[1.5, 0.0], [3.0, 0.4], [3.0, -1.2], [3.8, 0.0]]).double() - center
    cells = ((asked / search.cell).floor() - search._low).long()
    free, *walls, behind = search._levels[0][0, 0, cells[:, 0], cells[:, 1]].tolist()
    assert free == FREE
    assert min(walls) > UNKNOWN
    assert behind == UNKNOWN


@pytest.mark.parametrize("seed", range(6))
def test_a_scan_is_found_anywhere_in_a_room(seed):
    draw = torch.Generator().manual_seed(seed)
    surfaces = room(2000, 0)
    origin = torch.tensor([3.5, 1.5]).double()
    free = torch.stack([origin.expand_as(surfaces), origin + 0.9 * (surfaces - origin)], 1)
    search = PoseSearch(surfaces, free)
    pose = Pose.from_yaw(6 * torch.rand((), generator=draw), 1 + 2 * torch.rand(2, generator=draw).double())
    expected = Expectation(Pose.from_yaw([0.0], [3.0, 2.0]), 3.0, 3.0, 0.9, 4.0)
    found, _ = search.best(pose.inverse().apply(room(180, seed + 1)), expected, 5)
    off = found[0].inverse() @ pose
    assert float(off.translation.norm()) < 0.3
    assert float(off.angle()) < math.radians(4)


def test_cells_that_beams_cross_are_free_and_others_are_unknown():
    points = torch.tensor([[2.0, 0.0], [2.0, 3.0]]).double()
    search = PoseSearch(points, torch.tensor([[[0.0, 0.0], [1.5, 0.0]]]).double(), cell=0.1)
    asked = torch.tensor([[1.0, 0.0], [1.0, 2.0], [2.0, 3.0]]).double()
    cells = ((asked / 0.1).floor() - search._low).long()
    value = search._levels[0][0, 0, cells[:, 0], cells[:, 1]].tolist()
    assert value[:2] == [FREE, UNKNOWN]
    assert value[2] > UNKNOWN


@pytest.mark.parametrize("width", [1, 4])
@pytest.mark.parametrize("reach", [1, 5])
def test_sums_over_a_raster_equal_those_of_a_loop_over_its_cells(width, reach):
    draw = torch.Generator().manual_seed(0)
    cells = torch.randint(-3, 8 * width, (3, 150, 2), generator=draw)
    heading = torch.tensor([0] * 20 + [2] * 30)  # nothing has the second heading
    shift = torch.randint(-reach, reach + 1, (50, 2), generator=draw)
    raster = torch.randn(7 * width, 9 * width, generator=draw)
    parts = raster.view(7, width, 9, width).permute(1, 3, 0, 2).contiguous()
    sums = []
    for turn, (right, up) in zip(heading.tolist(), shift.tolist(), strict=True):
        at = [(x + width * right, y + width * up) for x, y in cells[turn].tolist()]
        sums.append(
            sum(float(raster[x, y]) if 0 <= x < 7 * width and 0 <= y < 9 * width else 0.5 for x, y in at)
        )
    for choice in ("torch", "fused"):
        with kernels(choice):
            found = raster_sums(cells, heading, shift, parts, 0.5)
        torch.testing.assert_close(found, torch.tensor(sums).double())


@pytest.mark.parametrize("level", [0, 2])
def test_fused_bounds_with_a_prior_equal_the_twin(level):
    draw = torch.Generator().manual_seed(level)
    search = PoseSearch(4 * torch.rand(200, 2, generator=draw).double(), cell=0.1)
    poses = Pose.from_yaw([0.1, -0.4], 2 * torch.rand(2, 2, generator=draw).double())
    tried = search._tried(
        torch.rand(90, 2, generator=draw).double(), Expectation(poses, 0.3, 0.2, 0.9, 1.0, 2.0)
    )
    heading = torch.randint(len(tried.angles), (80,), generator=draw).sort().values
    shift = torch.randint(-30, 30, (80, 2), generator=draw)
    bounds = []
    for choice in ("torch", "fused"):
        with kernels(choice):
            bounds.append(search._scored(tried, heading, shift, level))
    torch.testing.assert_close(*bounds)
    assert bounds[0].min() < -1000 < 0 < bounds[0].max()


def test_the_prior_falls_slowly_and_ends_at_the_largest_motion():
    expected = Expectation(Pose.from_yaw([0.0], [0.0, 0.0]), 0.5, 0.3, 0.9, 4.0, 1.0)
    places = Pose.from_yaw(torch.tensor([0.0, 0.0, 0.0, 0.0, 0.9, 1.1]), torch.zeros(6, 2).double())
    places.translation[:, 0] = torch.tensor([0.0, 0.5, 3.9, 4.1, 0.0, 0.0])
    nats = expected.unlikely(places).tolist()
    assert nats[0] == 0
    assert nats[1] == pytest.approx(0.5, abs=0.1)  # as of a Gaussian
    assert nats[2] < 7  # which would be 30
    assert nats[3] > 1000
    assert nats[4] < 7
    assert nats[5] > 1000

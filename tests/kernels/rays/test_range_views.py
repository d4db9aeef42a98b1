"""Points compared with range images: the fused kernel, and enumeration in plain Python."""

import math

import pytest
import torch

from gmmtorch.kernels import range_views
from gmmtorch.localization.local_map import FreeSpace
from gmmtorch.pose import Pose
from tests.kernels.twins import by_both


def poses(n: int, dim: int, draw: torch.Generator) -> Pose:
    turn = torch.randn(n, 1 if dim == 2 else 3, generator=draw).double()
    return Pose.from_turn(turn, torch.randn(n, dim, generator=draw).double())


@pytest.mark.parametrize("n", [1, 7, 8, 203])
@pytest.mark.parametrize("dim", [2, 3])
def test_fused_views_equal_the_twin(dim, n):
    draw = torch.Generator().manual_seed(n)
    scans = [3 * torch.randn(400, dim, generator=draw).double() for _ in range(4)]
    space, points = FreeSpace(scans, poses(4, dim, draw)), 2 * torch.randn(n, dim, generator=draw).double()
    twin, fused = by_both(lambda: space.view(points, poses(30, dim, torch.Generator().manual_seed(0))))
    for one, other in zip(twin, fused, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-12)
    assert float(fused.in_free_space.std()) > 0  # the poses differ


def test_counts_equal_those_of_a_loop_over_points_and_images():
    draw = torch.Generator().manual_seed(0)
    across, points = 12, torch.randn(50, 2, generator=draw).double()
    nearest = 0.5 + torch.rand(3, across, generator=draw).double()
    farthest = nearest + 0.3
    nearest[:, ::3], farthest[:, ::3] = math.inf, 0.0
    motions, frames = poses(5, 2, draw), poses(3, 2, draw)
    limits = 2 * math.pi / across, 0.1, 0.05
    found = range_views(points, motions.parts, frames.parts, (nearest, farthest), (across, 1), limits)
    for row in range(5):
        free, unknown = 0, 0
        for point in motions[row].apply(points):
            sees = []
            for image in range(3):
                x, y = frames[image].apply(point[None])[0].tolist()
                cell = round(math.atan2(y, x) / limits[0]) % across
                near, far = float(nearest[image, cell]), float(farthest[image, cell])
                margin = 0.1 + 0.05 * math.hypot(x, y)
                is_on = near - margin <= math.hypot(x, y) <= far + margin
                sees.append("unseen" if math.isinf(near) else "free" if math.hypot(x, y) < near - margin
                            else "on" if is_on else "behind")  # fmt: skip
            free += "free" in sees
            unknown += not {"free", "on"} & set(sees)
        assert (float(found[0][row]), float(found[1][row])) == (free, unknown)


def test_points_without_a_number_or_beyond_all_numbers_are_unknown():
    points = torch.tensor([[math.nan, 0.0], [1e200, 1e200], [math.inf, -1.0]]).double()
    image = torch.ones(1, 8).double()
    still = Pose.identity(2, 1, device=points.device).parts
    free, unknown = range_views(points, still, still, (image, image), (8, 1), (math.pi / 4, 0.1, 0.0))
    assert (float(free), float(unknown)) == (0, 3)

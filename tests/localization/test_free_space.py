"""Free space around scans, against the geometry of a square room."""

import math

import pytest
import torch
from torch import Tensor

from gmmtorch.localization.local_map import FreeSpace, range_images
from gmmtorch.pose import Pose

HALF = 4.0  # metres from the centre of the room to a wall


def room(dim: int, origin: Tensor) -> Tensor:
    """Returns (N, D) of a sensor in a square room, along the axes of the room, in the frame of the sensor."""
    angles = torch.arange(720).double() * (2 * math.pi / 720)
    beams = torch.stack([angles.cos(), angles.sin()], 1)
    if dim == 3:
        rise = torch.arange(-20, 21).double().deg2rad()
        flat = beams[None] * rise.cos()[:, None, None]
        beams = torch.cat([flat, rise.sin()[:, None, None].expand(-1, 720, 1)], 2).flatten(0, 1)
    ranges = torch.where(beams[:, :2] > 0, HALF - origin[:2], HALF + origin[:2]) / beams[:, :2].abs()
    return beams * ranges.amin(1)[:, None]


def at(*place: float, turn: float = 0.0) -> Pose:
    return Pose.from_yaw([turn], place)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_true_pose_contradicts_nothing_and_a_shifted_one_does(dim):
    first, now = torch.zeros(dim).double(), torch.tensor([1.0, 0.5, 0.0][:dim]).double()
    space = FreeSpace([room(dim, first)], at(*first.tolist()))
    shifted = now + torch.tensor([1.0, 0.0, 0.0][:dim])
    poses = Pose.cat([at(*now.tolist()), at(*shifted.tolist())])
    view = space.view(room(dim, now), poses)
    assert float(view.in_free_space[0]) < 0.01
    assert float(view.looked_through[0]) < 0.01
    # Only the wall at -x moves into the room. In 2D, this is its share of the directions:
    behind = (math.atan2(HALF - 0.5, HALF + 1.0) + math.atan2(HALF + 0.5, HALF + 1.0)) / (2 * math.pi)
    if dim == 2:
        assert float(view.in_free_space[1]) == pytest.approx(behind, abs=0.05)
    assert float(view.in_free_space[1]) > behind / 2  # in 3D, its upper part was not in the field of view
    # The beams of the new scan end 1 m behind the wall at +x, which the earlier scan saw.
    assert 0.15 < float(view.looked_through[1]) < 0.35


def test_points_behind_a_surface_or_outside_the_field_of_view_are_unknown():
    ahead = room(2, torch.zeros(2).double())
    ahead = ahead[ahead[:, 0] > 0]
    space = FreeSpace([ahead], at(0.0, 0.0))
    points = torch.tensor([[3.0, 0.0], [4.0, 0.5], [6.0, 0.0], [-2.0, 0.0]]).double()
    view = space.view(points, at(0.0, 0.0))  # in front of the wall, on it, behind it, behind the sensor
    assert float(view.in_free_space[0]) == pytest.approx(1 / 4)
    assert float(view.unknown[0]) == pytest.approx(2 / 4)


def test_shares_do_not_depend_on_the_frame_of_the_world():
    draw = torch.Generator().manual_seed(0)
    scan = room(2, torch.tensor([0.5, -0.3]).double())
    poses = Pose.cat([at(*(torch.rand(2, generator=draw) - 0.5).tolist(), turn=0.3 * i) for i in range(5)])
    there = at(20.0, -7.0, turn=1.1)
    one = FreeSpace([room(2, torch.zeros(2).double())], at(0.0, 0.0)).view(scan, poses)
    other = FreeSpace([room(2, torch.zeros(2).double())], there).view(scan, there @ poses)
    for a, b in zip(one, other, strict=True):
        assert torch.allclose(a, b, atol=0.01)


@pytest.mark.parametrize("dim", [2, 3])
def test_an_image_is_that_of_its_scan_alone(dim):
    scans = [
        room(dim, torch.full((dim,), shift).double())[:n] for shift, n in ((0.0, 300), (0.2, 1), (-0.3, 90))
    ]
    for row, scan in enumerate(scans):
        (nearest,), (farthest,) = range_images([scan])
        assert torch.equal(range_images(scans)[0][row], nearest)
        assert torch.equal(range_images(scans)[1][row], farthest)
        assert float(farthest.max()) == float(scan.norm(dim=1).max())
        assert float(nearest.min()) == float(scan.norm(dim=1).min())

"""Odometry of a lidar on bad input: crowds, a sensor on its head, a corridor, repeated scans, large steps.

Rays meet the planes of a room in closed form, independently of the package's simulation.
"""

import math

import pytest
import torch
from torch import Tensor

from gmmtorch.localization import Odometry, absolute_trajectory_error
from gmmtorch.pose import Pose

ROOM = torch.tensor([7.0, 4.5, 1.8]).double()  # half of its sides, metres
NICHE = torch.tensor([1.0, 1.5]).double()  # a pillar of this size in a corner makes the room unlike itself
FAR = 30.0  # metres: longer beams have no return


def rays() -> Tensor:
    """Directions (N, 3) of 16 rings of 240 beams."""
    azimuth, up = torch.meshgrid(
        torch.arange(240).double() * (2 * math.pi / 240),
        torch.linspace(-0.4, 0.4, 16).double(),
        indexing="ij",
    )
    return torch.stack([azimuth.cos() * up.cos(), azimuth.sin() * up.cos(), up.sin()], -1).flatten(0, 1)


def seen(pose: Pose, half: Tensor = ROOM) -> Tensor:
    """Points (N, 3) of a scan in the frame of the sensor, with noise of 1 cm along the beams."""
    ahead = rays() @ pose.rotation.T
    ranges = ((half * ahead.sign() - pose.translation) / ahead).amin(1)
    corner = half[:2] - NICHE  # the pillar's edges nearest to the middle
    for axis in (0, 1):
        reach = (corner[axis] - pose.translation[axis]) / ahead[:, axis]
        other = pose.translation[1 - axis] + reach * ahead[:, 1 - axis]
        meets = (reach > 0) & (other > corner[1 - axis]) & (other < half[1 - axis])
        ranges = torch.where(meets, ranges.minimum(reach), ranges)
    noise = 0.01 * torch.randn(len(ranges), generator=torch.Generator().manual_seed(0)).double()
    points = rays() * (ranges + noise)[:, None]
    return points[ranges < FAR]


def path(n: int, step: float = 0.4, turn: float = 0.15) -> list[Pose]:
    """Poses of a robot that drives along a room and turns."""
    return [Pose.from_yaw([turn * k], [step * (k - n / 2), 0.3, 0.0])[0] for k in range(n)]


def error(odometry: Odometry, true: list[Pose]) -> float:
    return absolute_trajectory_error(odometry.poses, Pose.stack(true).matrix, "first").rmse


def test_a_crowd_that_moves_between_scans_hides_a_third_of_the_room():
    true, odometry = path(6), Odometry()
    draw = torch.Generator().manual_seed(1)
    for pose in true:
        points = seen(pose)
        azimuth = torch.atan2(points[:, 1], points[:, 0])
        people = 2 * math.pi * torch.rand(12, generator=draw).double() - math.pi
        gap, person = (azimuth[:, None] - people).abs().min(1)
        near, distance = gap < 0.1, (1 + 2 * torch.rand(12, generator=draw).double())[person]
        assert 0.25 < float(near.double().mean()) < 0.45
        away = points.norm(dim=1, keepdim=True)
        points = torch.where(near[:, None], points / away * distance[:, None], points)
        assert odometry.add(points).found
    assert error(odometry, true) < 0.05


def test_a_sensor_on_its_head_has_the_same_path():
    flip = Pose(torch.diag(torch.tensor([1.0, -1, -1]).double()), torch.zeros(3).double())
    true, odometry = [pose @ flip for pose in path(6)], Odometry()
    assert all(odometry.add(seen(pose)).found for pose in true)
    assert error(odometry, true) < 0.03


def test_the_covariance_says_that_a_corridor_is_open_along_its_axis():
    corridor = torch.tensor([1e4, 1.5, 1.8]).double()
    odometry = Odometry()
    for k in range(3):
        points = seen(Pose.from_yaw([0.0], [0.3 * k, 0.0, 0.0])[0], corridor)
        location = odometry.add(points[points[:, 0].abs() < 20])
    along, across, up = location.covariance.diagonal()[:3].sqrt().tolist()
    assert along > 5 * max(across, up)
    assert float(location.pose[1:3, 3].norm()) < 0.05


def test_repeated_scans_with_one_stamp_stay_at_their_place():
    odometry = Odometry()
    for _ in range(5):
        location = odometry.add(seen(path(6)[2]), stamp=3.0)
        assert location.found
        assert float(location.pose[:3, 3].norm()) < 0.01
    assert len(odometry.keyframes) == 1


@pytest.mark.parametrize("turn", [0.8, 1.2])
def test_a_large_step_with_a_large_turn_is_found(turn):
    first, last = Pose.from_yaw([0.0], [-2.0, 0.5, 0.0])[0], Pose.from_yaw([turn], [0.5, -1.0, 0.0])[0]
    odometry = Odometry()
    odometry.add(seen(first))
    assert odometry.add(seen(last)).found
    assert error(odometry, [first, last]) < 0.05

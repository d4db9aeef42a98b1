"""A spinning lidar that turns at 90°/s: odometry deskews its scans by the times of their points."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from gmmtorch.datasets import POINT_TIMES, deskewed, load
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.localization import Odometry, absolute_trajectory_error, with_odometry
from gmmtorch.pose import Pose
from tests.sensor_bags import BagWriter

HALF = torch.tensor([6.0, 4.5, 1.6]).double()  # of a room, metres
PERIOD, N, RATE = 0.1, 16, math.radians(90)
STILL = 4  # scans before the sensor begins to turn


def poses_at(times: Tensor) -> Pose:
    """True poses: the sensor stands still, then turns at 90°/s and drives at 1.5 m/s."""
    moving = (times - STILL * PERIOD).clamp_min(0)
    x = 1.5 * moving - 1.2
    return Pose.from_yaw(RATE * moving, torch.stack([x, torch.zeros_like(x) + 0.3, torch.zeros_like(x)], 1))


def sweep(number: int) -> tuple[Tensor, Tensor, Tensor]:
    """Points (N, 3), each in the frame of the sensor at its own time; these times after the stamp; and
    whether each is on the wall x = 6 m. Rays meet the room's planes in closed form.
    """
    columns = torch.arange(360).double()
    seconds = (columns * (PERIOD / 360))[:, None].expand(360, 10).flatten()
    azimuth = (columns * (2 * math.pi / 360))[:, None].expand(360, 10).flatten()
    up = torch.linspace(-0.35, 0.35, 10).double().expand(360, 10).flatten()
    rays = torch.stack([azimuth.cos() * up.cos(), azimuth.sin() * up.cos(), up.sin()], 1)
    there = poses_at(number * PERIOD + seconds)
    ahead = (there.rotation @ rays[:, :, None])[:, :, 0]
    ranges, axis = ((HALF * ahead.sign() - there.translation) / ahead).min(1)
    return rays * ranges[:, None], seconds, (axis == 0) & (ahead[:, 0] > 0)


def thickness(points: Tensor) -> float:
    """The deviation (m) of points (N, 3) from the plane that fits them best."""
    return float(torch.linalg.svdvals(points - points.mean(0))[-1] / math.sqrt(len(points)))


def stamps() -> Tensor:
    return torch.arange(N).double() * PERIOD


def test_odometry_of_a_turning_lidar_needs_the_times_of_points():
    with_times, without = Odometry(), Odometry()
    thick: list[tuple[float, float]] = []
    for number in range(N):
        points, seconds, on_wall = sweep(number)
        with_times.add(points, number * PERIOD, seconds=seconds)
        without.add(points, number * PERIOD)
        flat = with_times.deskewed(points, seconds)
        thick.append((thickness(points[on_wall]), thickness(flat[on_wall])))
    true = poses_at(stamps()).matrix
    errors = [absolute_trajectory_error(one.poses, true, "first").rmse for one in (with_times, without)]
    assert all(location.found for location in with_times._locations)
    assert errors[0] < 0.05
    assert errors[1] > 1.5 * errors[0]
    # The scan in which the turn begins is deskewed by a motion that had not begun.
    raw, flat = torch.tensor(thick[STILL + 2 :]).T
    assert float(raw.min()) > 0.018, raw
    assert float(flat.max()) < 0.005, flat


def test_a_bag_without_tf_is_deskewed_by_its_odometry(tmp_path):
    with BagWriter(tmp_path / "a.mcap") as bag:
        for number in range(N):
            points, seconds, _ = sweep(number)
            bag.cloud("/points", number * PERIOD + 1, "lidar", points, seconds)
    dataset, found = with_odometry(load("rosbag", tmp_path / "a.mcap", poses="standing"))
    assert found.found.all()
    true = poses_at(stamps()).matrix
    assert absolute_trajectory_error(found.poses, true, "first").rmse < 0.05
    first = Pose.from_matrix(true[0])
    for number in range(STILL + 2, N - 1):
        scan = dataset[number]
        assert POINT_TIMES not in scan.attributes
        points = first.apply(scan.points.double())
        inner = (points[:, 1].abs() < HALF[1] - 0.3) & (points[:, 2].abs() < HALF[2] - 0.2)
        on_wall = inner & (points[:, 0] > HALF[0] - 0.5)
        assert int(on_wall.sum()) > 0.5 * int(sweep(number)[2].sum())
        assert thickness(points[on_wall]) < 0.01
        assert float(points[on_wall, 0].mean()) == pytest.approx(float(HALF[0]), abs=0.06)


def test_points_of_a_linear_motion_and_a_turn_go_where_each_was_measured():
    motion = Pose.from_yaw([0.2], [0.5, -0.1, 0.05])[0]
    draw = np.random.default_rng(0)
    places, seconds = (
        torch.from_numpy(draw.normal(size=(50, 3))),
        torch.from_numpy(draw.uniform(-0.05, 0.1, 50)),
    )
    measured = []
    for place, second in zip(places, seconds.tolist(), strict=True):  # p = R(θ)ᵀ (place − t), one by one
        share = second / 0.1
        cos, sin = math.cos(0.2 * share), math.sin(0.2 * share)
        x, y, z = (place - share * torch.tensor([0.5, -0.1, 0.05])).tolist()
        measured.append([cos * x + sin * y, cos * y - sin * x, z])
    found = deskewed(torch.tensor(measured).double(), seconds, motion, 0.1)
    assert torch.allclose(found, places, atol=2e-3)  # 512 motions stand for all


def test_times_of_another_shape_are_named_and_those_that_are_not_finite_leave_their_points():
    points, seconds, _ = sweep(0)
    with pytest.raises(InvalidArgumentError, match="seconds has shape"):
        Odometry().add(points, 0.0, seconds=seconds[1:])
    seconds[:100] = torch.nan
    assert Odometry().add(points, 0.0, seconds=seconds).found

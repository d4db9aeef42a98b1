"""Odometry of scans, clocks and wheels that are wrong in usual ways."""

import math

import torch
from torch import Tensor

from gmmtorch.localization import Odometry, absolute_trajectory_error
from tests.localization.test_odometry import sensor_scans


def error(odometry: Odometry, true: Tensor) -> float:
    """The largest distance (m) of the poses from the true ones (N, 3, 3), with the first one there."""
    return float(absolute_trajectory_error(odometry.poses, true, align="first").distances.max())


def test_a_sensor_upside_down_sees_the_mirrored_world():
    scans, true = sensor_scans("synthetic_building_2d", 6)
    mirror = torch.diag(torch.tensor([1.0, -1.0])).double()
    odometry = Odometry()
    assert all(odometry.add(points.double() @ mirror).found for points in scans)
    flip = torch.block_diag(mirror, torch.ones(1, 1).double())
    assert error(odometry, flip @ (true[0].inverse() @ true) @ flip) < 0.05


def test_clocks_that_stand_still_or_jump_do_not_mislead():
    scans, true = sensor_scans("synthetic_building_2d", 6)
    odometry = Odometry()
    stamps = [0.0, 0.0, 1.0, 1e9, math.nan, -5.0]
    assert all(odometry.add(*pair).found for pair in zip(scans, stamps, strict=True))
    assert error(odometry, true) < 0.05


def test_repeated_scans_do_not_move():
    scans, _ = sensor_scans("synthetic_building_2d", 1)
    odometry = Odometry()
    assert all(odometry.add(scans[0]).found for _ in range(6))
    assert len(odometry.keyframes) == 1
    assert float(odometry.poses[:, :2, 2].norm(dim=1).max()) < 0.01


def test_wheels_that_slip_by_a_third_are_corrected():
    scans, true = sensor_scans("synthetic_building_2d", 6)
    odometry = Odometry()
    odometry.add(scans[0])
    for number in range(1, 6):
        motion = true[number - 1].inverse() @ true[number]
        motion[:2, 2] *= 0.7
        assert odometry.add(scans[number], motion=motion).found
    assert error(odometry, true) < 0.05

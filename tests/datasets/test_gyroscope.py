"""Rotations between scans from the IMU of a bag: known motions, mountings, and bad input."""

from __future__ import annotations

import itertools
import logging
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from gmmtorch.datasets import load
from gmmtorch.datasets.ros.rosbag import Gyroscope
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.localization import Odometry, with_odometry

pytest.importorskip("rosbags")

from imu_bags import rate, write_imu
from sensor_bags import BagWriter

FORMATS = pytest.mark.parametrize("suffix", ["mcap", "db3", "bag"])
POINTS = np.array([[1.0, 2.0, 3.0], [-4.0, 5.0, 0.5]])
MOUNT_IMU = Rotation.from_euler("xyz", [0.4, -0.3, 1.2])
MOUNT_LIDAR = Rotation.from_euler("xyz", [-0.2, 0.5, -2.0])
STAMPS = 1 + np.array([0.0, 0.13, 0.2, 0.7, 0.701, 1.4, 1.9])
STEADY = np.tile([0.0, 0.0, 1.0], (201, 1))
TIMES = np.linspace(0, 2, 201)


def tumble(time: float) -> Rotation:
    return Rotation.from_euler("zyx", [3 * time, math.sin(4 * time), 0.7 * math.cos(3 * time)])


def matrix(rotation: Rotation, x: float = 0.0) -> np.ndarray:
    found = np.eye(4)
    found[:3, :3], found[0, 3] = rotation.as_matrix(), x
    return found


def standing(path: Path, **options: Any) -> Any:
    return load("rosbag", path, poses="standing", **options)


def steady(path: Path, times: np.ndarray = TIMES, rates: np.ndarray = STEADY, **fields: Any) -> Path:
    """Clouds every 0.1 s, and an IMU in their frame."""
    with BagWriter(path) as bag:
        write_imu(bag, times, rates, "lidar", **fields)
        for time in range(21):
            bag.cloud("/points", time / 10, "lidar", POINTS)
    return path


def angles(turns: torch.Tensor) -> np.ndarray:
    """Angles (N - 1,) about z of the rotations after the first; NaN stays."""
    return torch.atan2(turns[1:, 1, 0], turns[1:, 0, 0]).numpy()


@FORMATS
@pytest.mark.parametrize("stride", [1, 3])
def test_turns_of_a_mounted_imu_are_those_of_the_motion(tmp_path, suffix, stride):
    path, times = tmp_path / f"a.{suffix}", np.linspace(0.99, 2.91, 1921)
    with BagWriter(path) as bag:
        static = {("base", "imu"): matrix(MOUNT_IMU, 0.3), ("base", "lidar"): matrix(MOUNT_LIDAR, -1.0)}
        bag.transforms(0.0, static, static=True)
        for parent in ("odom", "map"):  # what is above both does not matter
            bag.transforms(1.0, {(parent, "base"): np.eye(4)})
        write_imu(bag, times, np.array([rate(lambda t: tumble(t) * MOUNT_IMU, time) for time in times]))
        for time in STAMPS:
            bag.cloud("/points", float(time), "lidar", POINTS)
    turns = standing(path, stride=stride).turns()
    poses = [tumble(time) * MOUNT_LIDAR for time in STAMPS[::stride]]
    expected = [np.eye(3)] + [(a.inv() * b).as_matrix() for a, b in itertools.pairwise(poses)]
    assert turns.dtype == torch.float64
    np.testing.assert_allclose(turns.numpy(), expected, atol=2e-5)


@pytest.mark.parametrize("n", [2, 3, 4, 5, 8, 101])
def test_any_number_of_messages_is_joined(n):
    rng = np.random.default_rng(n)
    times, rates = np.arange(n) * 10_000_000, rng.normal(scale=5, size=(n, 3))
    expected = Rotation.identity()
    for mean in (rates[:-1] + rates[1:]) / 2:
        expected = expected * Rotation.from_rotvec(0.01 * mean)
    turns = Gyroscope("a", "imu", 0, times, rates).turns(times[[0, -1]])
    np.testing.assert_allclose(turns, [np.eye(3), expected.as_matrix()], atol=1e-12)


def test_a_sensor_that_turns_on_the_body_has_its_own_rotation(tmp_path):
    with BagWriter(tmp_path / "a.mcap") as bag:
        for time in np.arange(1, 3.1, 0.1):
            bag.transforms(time, {("imu", "lidar"): matrix(Rotation.from_euler("z", 0.5 * time))})
        write_imu(bag, TIMES + 1, 0.8 * STEADY)
        for time in STAMPS:
            bag.cloud("/points", float(time), "lidar", POINTS)
    np.testing.assert_allclose(
        angles(standing(tmp_path / "a.mcap").turns()), 1.3 * np.diff(STAMPS), atol=1e-9
    )


@pytest.mark.parametrize("roll", [0.0, math.radians(8), math.pi])
def test_turns_of_a_laser_are_those_of_its_heading(tmp_path, roll):
    mount = Rotation.from_euler("zx", [0.4, roll])
    headings = 2.5 * np.sin(2 * STAMPS)
    with BagWriter(tmp_path / "a.mcap") as bag:
        static = {("base", "imu"): matrix(MOUNT_IMU), ("base", "laser"): matrix(mount)}
        bag.transforms(0.0, static, static=True)
        for time, heading in zip(STAMPS, headings, strict=True):
            bag.transforms(time, {("odom", "base"): matrix(Rotation.from_euler("z", heading), time)})
            bag.laser("/scan", float(time), "laser", [1.0, 2.0], 0.0, 0.1, 8.0)
        yaw = 5 * np.cos(2 * (TIMES + 1))[:, None] * MOUNT_IMU.inv().apply([0, 0, 1])
        write_imu(bag, TIMES + 1, yaw)
    dataset: Any = load("rosbag", tmp_path / "a.mcap")
    turns = dataset.turns()
    assert turns.shape == (7, 2, 2)
    for before, now, turn in zip(range(6), range(1, 7), turns[1:], strict=True):
        moved = torch.linalg.solve(dataset.pose(before), dataset.pose(now))
        torch.testing.assert_close(turn, moved[:2, :2], rtol=0, atol=2e-4)


def test_stamps_out_of_order_and_repeated_are_left_out(tmp_path):
    times = np.concatenate([TIMES[:50], TIMES[48:], [0.3]])
    rates = np.tile([0.0, 0.0, 1.0], (len(times), 1))
    rates[-1] = 9.0
    received = np.linspace(0, 2, len(times))
    turns = standing(steady(tmp_path / "a.mcap", times, rates, received=received)).turns()
    np.testing.assert_allclose(angles(turns), 0.1, atol=1e-9)


def test_times_of_recording_replace_the_stamps_of_the_imu(tmp_path):
    with BagWriter(tmp_path / "a.mcap") as bag:
        write_imu(bag, TIMES + 500, STEADY, "lidar", received=TIMES)
        for time in range(21):
            bag.cloud("/points", time / 10, "lidar", POINTS)
    with pytest.raises(InvalidArgumentError, match=r"500\.000 to 502\.000 s.*clock=received"):
        standing(tmp_path / "a.mcap").turns()
    np.testing.assert_allclose(
        angles(standing(tmp_path / "a.mcap", clock="received").turns()), 0.1, atol=1e-9
    )


@pytest.mark.parametrize("bad", [math.nan, math.inf, 1e300, 573.0])
def test_steps_that_the_imu_does_not_cover_continue_the_motion(tmp_path, bad, caplog, monkeypatch):
    inside = (TIMES > 0.305) & (TIMES < 1.895)
    rates = np.where((np.abs(TIMES - 1) < 0.125)[:, None], [bad, 0.0, 0.0], STEADY)  # 0.26 s are missing
    path = steady(tmp_path / "a.mcap", TIMES[inside], rates[inside])
    given: list[Any] = []
    add = Odometry.add
    monkeypatch.setattr(Odometry, "add", lambda self, *a: (given.append(a[2]), add(self, *a))[1])
    with caplog.at_level(logging.WARNING):
        with_odometry(standing(path), motion="imu")
    known = [number for number, turn in enumerate(given) if turn is not None]
    assert known == [5, 6, 7, 8, 13, 14, 15, 16, 17, 18]
    np.testing.assert_allclose([math.asin(given[number][1, 0]) for number in known], 0.1, atol=1e-9)
    (record,) = caplog.records
    assert "10 of 20 motions between scans are predicted without the IMU" in record.getMessage()
    assert "25 of its messages" in record.getMessage()


def test_a_gap_within_the_bound_is_interpolated(tmp_path):
    rates = STEADY * TIMES[:, None]
    kept = (TIMES < 1) | (TIMES > 1.185)
    turns = standing(steady(tmp_path / "a.mcap", TIMES[kept], rates[kept])).turns()
    np.testing.assert_allclose(angles(turns), 0.1 * np.arange(0.05, 2, 0.1), atol=1e-9)


def test_the_imu_with_most_messages_is_read(tmp_path):
    path = tmp_path / "a.mcap"
    with BagWriter(path) as bag:
        bag.cloud("/points", 0.0, "lidar", POINTS)
    with pytest.raises(InvalidArgumentError, match=r"has no topic of type sensor_msgs/Imu"):
        standing(path).turns()
    with BagWriter(path) as bag:
        for time in range(21):
            bag.cloud("/points", time / 10, "lidar", POINTS)
        write_imu(bag, TIMES[::2], STEADY[::2], "lidar")
        write_imu(bag, TIMES, 2 * STEADY, "lidar", topic="/other/imu")
    np.testing.assert_allclose(angles(standing(path).turns()), 0.2, atol=1e-9)


@pytest.mark.parametrize(
    ("fields", "rates", "reason"),
    [
        ({"angular_velocity_covariance": -np.eye(9)[0]}, STEADY, "state that they have no angular velocity"),
        ({}, STEADY * math.nan, "201 have an angular velocity that is not finite or above 100 rad/s"),
        ({}, STEADY * 573, "201 have an angular velocity that is not finite"),
    ],
)
def test_an_imu_without_usable_rates_is_refused(tmp_path, fields, rates, reason):
    dataset = standing(steady(tmp_path / "a.mcap", TIMES, rates, **fields))
    with pytest.raises(InvalidArgumentError, match=rf"topic /imu has 0 usable.*{reason}"):
        dataset.turns()


@pytest.mark.parametrize("n", [1, 3])
def test_an_imu_with_one_stamp_is_refused(tmp_path, n):
    dataset = standing(steady(tmp_path / "a.mcap", np.zeros(n), STEADY[:n]))
    with pytest.raises(InvalidArgumentError, match="has 1 usable angular velocities in"):
        dataset.turns()


def test_messages_that_cannot_be_decoded_are_left_out_and_counted(tmp_path, caplog):
    path = tmp_path / "a.mcap"
    with BagWriter(path) as bag:
        write_imu(bag, TIMES, STEADY, "lidar")
        connection = next(iter(bag._connections.values()))
        bag.writer.write(connection, 10**9, b"\0\1\0\0" + b"\xff" * 8)  # a frame of 4 GB is announced
        for time in range(21):
            bag.cloud("/points", time / 10, "lidar", POINTS)
    np.testing.assert_allclose(angles(standing(path).turns()), 0.1, atol=1e-9)
    assert "0 of 20 motions" in caplog.text
    assert "1 of its messages" in caplog.text


def test_two_imus_in_one_topic_are_refused(tmp_path):
    with BagWriter(tmp_path / "a.mcap") as bag:
        write_imu(bag, TIMES, STEADY, "left")
        write_imu(bag, TIMES + 0.001, STEADY, "right")
        bag.cloud("/points", 0.0, "lidar", POINTS)
    with pytest.raises(InvalidArgumentError, match=r"frames left \(201 messages\), right \(201 messages\)"):
        standing(tmp_path / "a.mcap").turns()


@pytest.mark.parametrize("frame", ["imu", ""])
def test_a_missing_mounting_names_both_frames_and_the_remedy(tmp_path, frame):
    with BagWriter(tmp_path / "a.mcap") as bag:
        bag.transforms(0.0, {("base", "lidar"): np.eye(4)}, static=True)
        write_imu(bag, TIMES, STEADY, frame)
        bag.cloud("/points", 0.0, "lidar", POINTS)
    with pytest.raises(InvalidArgumentError, match=r"motion=imu.*Record /tf_static") as raised:
        standing(tmp_path / "a.mcap").turns()
    assert f"frame {frame or '(unnamed)'} and frame lidar; all frames: base, lidar." in str(raised.value)


def test_a_single_scan_has_no_turn(tmp_path):
    with BagWriter(tmp_path / "a.mcap") as bag:
        write_imu(bag, TIMES, STEADY, "lidar")
        bag.cloud("/points", 5.0, "lidar", POINTS)
    assert torch.equal(standing(tmp_path / "a.mcap").turns(), torch.eye(3).double()[None])


def test_data_sets_that_are_no_bag_are_refused():
    with pytest.raises(InvalidArgumentError, match=r"motion=imu.*ROS bag.*synthetic_building_2d"):
        with_odometry(load("synthetic_building_2d", n_scans=2), motion="imu")

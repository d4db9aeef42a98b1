"""The rotation of an IMU as a prediction: a velocity that continues, fast turns, and scans that are lost."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import looping_robot
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from sensor_bags import BagWriter
from torch import Tensor

from gmmtorch import GaussianMap, Scan
from gmmtorch.datasets import Dataset, Ranges, load
from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.localization import Odometry, Tracker, with_odometry
from gmmtorch.localization.location import continued
from gmmtorch.localization.odometry import Trajectory
from gmmtorch.localization.tracker import locate_scans
from gmmtorch.localization.trajectory_errors import absolute_trajectory_error
from gmmtorch.pose import Pose

TURN, STEP, SECONDS, RATE = math.radians(60), 0.3, 0.5, 100
"""Of each step of the robot in the room: rad, m, s; and messages of its IMU a second."""
N = 10


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("ratio", [1.0, 0.5])
def test_the_velocity_in_the_frame_of_the_sensor_continues(dim, ratio):
    free = 1 if dim == 2 else 3
    velocity = torch.tensor([0.8, -0.3, 0.2]).double()[:dim]
    spins = [torch.tensor(spin).double()[:free] for spin in ([0.5, 0.2, -0.4], [-1.7, 0.3, 0.6], [0.0] * 3)]

    def driven(spin: Tensor, seconds: float) -> Pose:
        """Small steps with a constant velocity and spin."""
        n = 20_000
        shift = Pose.from_turn(spin * seconds / n / 2).rotation @ velocity * seconds / n
        step = Pose.from_turn(spin * seconds / n, shift)
        return Pose.from_matrix(torch.linalg.matrix_power(step.matrix, n))

    for before in spins:
        for now in spins:
            expected = driven(now / ratio, ratio)
            found = continued(expected.rotation, driven(before, 1.0), ratio)
            torch.testing.assert_close(found.matrix, expected.matrix, rtol=0, atol=1e-8)
    still = continued(expected.rotation, None)
    assert torch.equal(still.rotation, expected.rotation)
    assert still.translation.tolist() == [0.0] * dim


def test_a_rotation_of_another_shape_or_with_nan_is_named():
    odometry = Odometry()
    odometry.add(torch.rand(50, 2))
    for bad in (torch.eye(4), 2 * torch.eye(2), torch.full((2, 2), torch.nan)):
        with pytest.raises(InvalidArgumentError, match="motion"):
            odometry.add(torch.rand(50, 2), motion=bad)


@pytest.fixture(scope="module")
def turning() -> Tensor:
    """Poses (N, 3, 3), world ← laser, in a room: each step turns left or right by 60° at random."""
    rng, pose, poses = np.random.default_rng(0), np.eye(3), []
    while len(poses) < N:
        poses.append(pose)
        heading = math.atan2(pose[1, 0], pose[0, 0])
        angle = rng.choice([-1, 1]) * TURN
        ahead = pose[:2, 2] + STEP * np.array([math.cos(heading + angle / 2), math.sin(heading + angle / 2)])
        at = ahead if np.abs(ahead).max() < 2.5 else pose[:2, 2]
        cos, sin = math.cos(heading + angle), math.sin(heading + angle)
        pose = np.array([[cos, -sin, at[0]], [sin, cos, at[1]], [0, 0, 1]])
    return torch.from_numpy(np.array(poses))


def write_room(path: Path, poses: Tensor) -> Path:
    """A bag of a laser in a room, and an IMU on its side, with noise and a bias."""
    rng, mount = np.random.default_rng(1), Rotation.from_euler("xyz", [90, 0, 30], degrees=True)
    fraction = np.arange(RATE * SECONDS) / (RATE * SECONDS)
    profile = (1 - np.cos(2 * np.pi * fraction)) / SECONDS  # of a turn that begins and ends at rest
    with BagWriter(path) as bag:
        on_base = np.eye(4)
        on_base[:3, :3] = mount.as_matrix()
        bag.transforms(0.0, {("base", "imu"): on_base, ("base", "laser"): np.eye(4)}, static=True)
        for number, pose in enumerate(poses.numpy()):
            measured = looping_robot.ranges(pose, rng.normal(scale=0.01, size=looping_robot.N_BEAMS))
            step = 2 * math.pi / looping_robot.N_BEAMS
            bag.laser("/scan", number * SECONDS, "laser", measured, -math.pi, step, 20.0)
            relative = np.linalg.solve(pose, poses[min(number + 1, N - 1)].numpy())
            rates = math.atan2(relative[1, 0], relative[0, 0]) * profile
            for share, rate in zip(fraction, rates, strict=True):
                spin = mount.inv().apply([0, 0, rate]) + rng.normal(math.radians(1), 0.01, 3)
                fields = {
                    "header": {"frame_id": "imu"},
                    "angular_velocity": dict(zip("xyz", spin, strict=True)),
                }
                bag.message("/imu", "sensor_msgs/msg/Imu", (number + share) * SECONDS, fields)
    return path


PILLAR = [*looping_robot._box(-4, -4, 4, 4), *looping_robot._box(3.6, 1, 4, 1.5)]
OBLONG = looping_robot._box(-4, -3.9, 4, 3.9)


@pytest.mark.slow
@pytest.mark.parametrize(("walls", "is_misled"), [(PILLAR, False), (OBLONG, True)], ids=["pillar", "oblong"])
def test_an_imu_tells_equal_sides_of_a_room_apart(walls, is_misled, turning, tmp_path, monkeypatch):
    pytest.importorskip("rosbags")
    monkeypatch.setattr(looping_robot, "WALLS", np.array(walls))
    bag = load("rosbag", write_room(tmp_path / "a.mcap", turning), poses="standing")

    def errors(trajectory: Trajectory) -> tuple[float, float]:
        found = absolute_trajectory_error(trajectory.poses, turning[0].inverse() @ turning, align="first")
        return found.rmse, math.degrees(float(found.angles.max()))

    guessed, turned = (errors(with_odometry(bag, motion=motion).trajectory) for motion in ("constant", "imu"))
    assert (guessed[0] > 0.5, guessed[1] > 80) == (is_misled, is_misled)
    for shift, turn in [turned] if is_misled else [guessed, turned]:
        assert shift < 0.02
        assert turn < 0.5


class Turning(Dataset):
    """Scans of the flat building, of which some cannot be read, with rotations of their own."""

    def __init__(self, unreadable: set[int], unknown: set[int]) -> None:
        super().__init__("turning", Ranges())
        self.scans = load("synthetic_building_2d", n_scans=240)
        self.unreadable, self.unknown = unreadable, unknown

    def _count(self) -> int:
        return 8

    def _read(self, index: int) -> Scan:
        if index in self.unreadable:
            raise DataError(f"scan {index} is damaged")
        return self.scans[index]

    def _known_pose(self, index: int) -> Tensor | None:
        return self.scans.pose(index)

    def turns(self) -> Tensor:
        poses = torch.stack([self.scans.pose(index) for index in range(len(self))])
        found = (poses[[0, *range(7)]].inverse() @ poses)[:, :2, :2].clone()
        found[sorted(self.unknown)] = torch.nan
        return found


@pytest.fixture
def given(monkeypatch) -> Iterator[list[Tensor | None]]:
    """The motions that odometry and tracker are given."""
    motions: list[Tensor | None] = []
    for kind, name, place in ((Odometry, "add", 2), (Tracker, "locate", -1)):
        method = getattr(kind, name)
        monkeypatch.setattr(
            kind,
            name,
            lambda self, *a, method=method, place=place: (motions.append(a[place]), method(self, *a))[1],
        )
    return motions


def test_rotations_over_scans_that_cannot_be_read_are_joined(given):
    source = Turning(unreadable={2, 3}, unknown={6})
    found = with_odometry(source, motion="imu")
    between = torch.linalg.solve(source.scans.pose(1), source.scans.pose(4))
    torch.testing.assert_close(given[2], between[:2, :2], rtol=0, atol=1e-9)
    assert [turn is None for turn in given] == [True, False, False, False, True, False]
    true = torch.stack([source.scans.pose(index) for index in (0, 1, 4, 5, 6, 7)])
    assert absolute_trajectory_error(found.trajectory.poses, true, align="first").rmse < 0.05


def test_a_tracker_predicts_with_the_rotations_of_a_recording(given):
    source = Turning(unreadable={2}, unknown={6})
    m = GaussianMap()
    for scan in source.scans[:20]:
        m.insert(scan)
    located = list(locate_scans(source, Tracker(m, source.pose(0)), turns=source.turns()))
    assert [turn is None for turn in given] == [True, False, False, False, False, False, True, False]
    for scan in located:
        off = scan.location.pose - source.pose(scan.number)
        assert scan.location.found is (scan.number != 2)
        assert scan.number == 2 or float(off[:2, 2].norm()) < 0.05


def test_a_tracker_turns_with_the_rotation_and_keeps_its_velocity():
    source, m = Turning(set(), set()), GaussianMap()
    for scan in source.scans[:20]:
        m.insert(scan)
    tracker = Tracker(m, source.pose(0))
    poses = []
    for number in (0, 1):
        points = source.scans[number].transformed(torch.linalg.inv(source.pose(number))).points
        poses.append(tracker.locate(points).pose)
    turn = Pose.from_turn(torch.tensor([0.7]).double()).rotation
    found = tracker.locate(torch.zeros(0, 2), turn)
    last = Pose.from_matrix(torch.linalg.solve(poses[0], poses[1]))
    expected = poses[1] @ continued(turn, last).matrix
    torch.testing.assert_close(found.pose, expected, rtol=0, atol=1e-9)

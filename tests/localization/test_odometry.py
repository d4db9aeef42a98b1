"""Odometry in simulated worlds whose poses are known, and on bad input."""

import math

import pytest
import torch
from torch import Tensor

from gmmtorch.datasets import load
from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.evaluation.trajectories import absolute_trajectory_error
from gmmtorch.localization import Odometry, with_odometry
from gmmtorch.localization.odometry import _scaled

N_2D, N_3D = 14, 6


def sensor_scans(name: str, n: int) -> tuple[list[Tensor], Tensor]:
    """Points of the first scans in the frame of the sensor, and the true poses."""
    scans = load(name)
    poses = torch.stack([scans.pose(i) for i in range(n)])
    return [scans[i].transformed(torch.linalg.inv(pose)).points for i, pose in enumerate(poses)], poses


@pytest.mark.parametrize(("name", "n"), [("synthetic_building_2d", N_2D), ("synthetic_building", N_3D)])
def test_poses_of_a_simulated_building_are_found_from_its_scans(name, n):
    scans, true = sensor_scans(name, n)
    odometry = Odometry()
    for points in scans:
        odometry.add(points)
    found = odometry.trajectory()
    assert found.found.all()
    errors = absolute_trajectory_error(found.poses, true, align="first")
    assert float(errors.distances.max()) < 0.05
    assert math.degrees(float(errors.angles.max())) < 0.5
    assert (torch.linalg.eigvalsh(found.covariances[1:]) > 0).all()


def test_covered_scans_and_nan_rows_leave_the_track():
    scans, true = sensor_scans("synthetic_building_2d", 8)
    odometry = Odometry()
    for number, points in enumerate(scans):
        if number == 4:
            location = odometry.add(points[:0])
            assert not location.found
            assert "too few points" in location.doubts[0]
        else:
            odometry.add(torch.cat([points, torch.full((3, 2), torch.nan)]))
    found = odometry.trajectory()
    assert found.found.tolist() == [number != 4 for number in range(8)]
    errors = absolute_trajectory_error(found.poses, true, align="first").distances
    assert float(errors[-1]) < 0.05
    assert float(found.covariances[4, 0, 0]) > 100 * float(found.covariances[5, 0, 0])


def test_a_corridor_leaves_the_direction_along_it_open():
    draw = torch.Generator().manual_seed(0)
    odometry = Odometry()
    for _ in range(3):
        along, noise = 16 * torch.rand(400, generator=draw) - 8, 0.01 * torch.randn(400, generator=draw)
        side = torch.ones(400)
        side[200:] = -1
        location = odometry.add(torch.stack([along, side + noise], 1))
    spread = odometry.trajectory().covariances[-1].diagonal().sqrt()
    assert float(location.covariance[0, 0]) > 100 * float(location.covariance[1, 1])
    assert float(spread[0]) > 5 * float(spread[1])


def test_one_scan_has_the_first_pose():
    odometry = Odometry()
    location = odometry.add(torch.rand(100, 3))
    assert location.found
    found = odometry.trajectory()
    assert torch.equal(found.poses, torch.eye(4).double()[None])
    assert found.covariances.abs().max() == 0


def test_a_clock_that_jumps_does_not_scale_the_motion():
    odometry = Odometry()
    ratios = [odometry._clock(stamp) for stamp in (0.0, 1.0, 3.0, 2.0, 3.0, math.nan, 5.0, 1e9, None)]
    assert ratios == [1.0, 1.0, 2.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0]


@pytest.mark.parametrize("dim", [2, 3])
def test_a_scaled_motion_taken_twice_is_the_motion(dim):
    turn = torch.zeros(dim, dim).double()
    turn[1, 0], turn[0, 1] = 0.6, -0.6
    motion = torch.eye(dim + 1).double()
    motion[:dim, :dim] = torch.linalg.matrix_exp(turn)
    half = _scaled(motion, 0.5)
    assert torch.allclose(half @ half, motion)
    assert _scaled(motion, 1.0) is motion


def test_bad_arguments_are_named():
    with pytest.raises(InvalidArgumentError, match="no scan was added"):
        Odometry().trajectory()
    odometry = Odometry()
    with pytest.raises(InvalidArgumentError, match="points has shape"):
        odometry.add(torch.zeros(5, 4))
    odometry.add(torch.rand(50, 2))
    with pytest.raises(InvalidArgumentError, match=r"expected \(N, 2\)"):
        odometry.add(torch.rand(50, 3))
    with pytest.raises(InvalidArgumentError, match="motion"):
        odometry.add(torch.rand(50, 2), motion=2 * torch.eye(3))
    with pytest.raises(InvalidArgumentError, match="odometry='icp'"):
        with_odometry(load("synthetic_building_2d", n_scans=2), "icp")


def test_a_recording_gets_the_estimated_poses_and_keeps_its_points():
    few = load("synthetic_building_2d", n_scans=3)
    posed, trajectory = with_odometry(few)
    assert len(posed) == len(trajectory.poses) == 3
    for index in range(3):
        moved = posed.pose(index) @ torch.linalg.inv(few.pose(index))
        assert torch.allclose(posed[index].points, few[index].transformed(moved).points, atol=1e-9)
        assert torch.equal(posed.own_pose(index), few.pose(index))


def test_kiss_icp_gives_poses_of_the_same_scans():
    pytest.importorskip("kiss_icp")
    few = load("synthetic_building", n_scans=2)
    posed, trajectory = with_odometry(few, "kiss_icp")
    assert trajectory.poses.shape == (2, 4, 4)
    assert torch.allclose(trajectory.poses[0], torch.eye(4).double(), atol=1e-6)
    assert trajectory.covariances.isnan().all()
    assert len(posed) == 2


def test_a_folder_without_poses_is_read_in_the_frame_of_the_sensor(tmp_path):
    (tmp_path / "scans").mkdir()
    header = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 2\nHEIGHT 1\n"
    header += "POINTS 2\nDATA ascii\n"
    (tmp_path / "scans" / "0.pcd").write_text(header + "1 2 3\n4 5 6\n")
    with pytest.raises(DataError, match=r"dataset\.odometry=auto"):
        load("scan_folder", tmp_path)
    scan = load("scan_folder", tmp_path, poses="standing")[0]
    assert scan.points.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert scan.origin.tolist() == [0, 0, 0]

"""Trajectories in TUM's form, compared with the quaternion of a known rotation, and in KITTI's form."""

from __future__ import annotations

import csv
import math

import numpy as np
import pytest
import torch

from gmmtorch.datasets.trajectory import read_trajectory
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.export.trajectory_files import write_kitti, write_pose_table, write_tum


def test_tum_lines_have_time_position_and_quaternion(tmp_path):
    angle = 0.7
    flat = torch.tensor(
        [[math.cos(angle), -math.sin(angle), 3.0], [math.sin(angle), math.cos(angle), -2.0], [0, 0, 1]]
    )
    write_tum(tmp_path / "a.tum", [12.5], flat.double()[None])
    row = np.loadtxt(tmp_path / "a.tum")
    expected = [12.5, 3, -2, 0, 0, 0, math.sin(angle / 2), math.cos(angle / 2)]
    np.testing.assert_allclose(row, expected, atol=1e-7)
    roll = torch.eye(4)
    roll[1:3, 1:3] = torch.tensor([[0.0, -1.0], [1.0, 0.0]])
    roll[:3, 3] = torch.tensor([1.0, 2.0, 3.0])
    write_tum(tmp_path / "b.tum", [0.0, 1.0], torch.stack([torch.eye(4), roll]))
    rows = np.loadtxt(tmp_path / "b.tum")
    half = math.sqrt(0.5)
    np.testing.assert_allclose(rows[1], [1, 1, 2, 3, half, 0, 0, half], atol=1e-7)


def test_tum_refuses_other_shapes_and_nan(tmp_path):
    with pytest.raises(InvalidArgumentError, match="expected"):
        write_tum(tmp_path / "a.tum", [0.0], torch.eye(4))
    with pytest.raises(InvalidArgumentError, match="NaN"):
        write_tum(tmp_path / "a.tum", [math.nan], torch.eye(4)[None])
    assert not (tmp_path / "a.tum").exists()


def test_kitti_rows_are_read_back_to_the_bit(tmp_path):
    from scipy.spatial.transform import Rotation

    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, :3, :3] = Rotation.random(5, random_state=0).as_matrix()
    poses[:, :3, 3] = np.random.default_rng(0).normal(size=(5, 3)) * 1e5
    path = write_kitti(tmp_path / "a.txt", poses)
    np.testing.assert_array_equal(np.loadtxt(path).reshape(5, 3, 4), poses[:, :3])
    np.testing.assert_array_equal(read_trajectory(path).poses.matrix, poses)


def test_kitti_rows_of_poses_in_the_plane_and_refused_input(tmp_path):
    write_kitti(tmp_path / "a.txt", [[[0.0, -1, 3], [1, 0, -2], [0, 0, 1]]])
    np.testing.assert_array_equal(np.loadtxt(tmp_path / "a.txt"), [0, -1, 0, 3, 1, 0, 0, -2, 0, 0, 1, 0])
    for poses, message in ((np.eye(4), "expected"), (np.full((1, 4, 4), np.nan), "NaN")):
        with pytest.raises(InvalidArgumentError, match=message):
            write_kitti(tmp_path / "b.txt", poses)
    assert not (tmp_path / "b.txt").exists()


@pytest.mark.parametrize("dim", [2, 3])
def test_a_pose_table_has_poses_columns_and_the_triangle_of_the_covariance(dim, tmp_path):
    free = dim + dim * (dim - 1) // 2
    root = torch.randn(2, free, free, generator=torch.Generator().manual_seed(0)).double()
    poses = torch.eye(dim + 1).double().repeat(2, 1, 1)
    poses[1, :dim, dim] = torch.arange(1, dim + 1)
    path = write_pose_table(tmp_path / "a.csv", [0.5, 1e9], poses, root @ root.mT, {"why": ["", "a, b"]})
    first, second = csv.DictReader(path.open())
    assert (first["time"], second["time"]) == ("0.500000000", "1000000000.000000000")
    assert [float(second[name]) for name in ("x", "y", "z", "qw")] == [1, 2, 3 if dim == 3 else 0, 1]
    assert (first["why"], second["why"]) == ("", "a, b")
    covariance = (root @ root.mT)[1]
    assert float(second["cov_x_y"]) == pytest.approx(float(covariance[0, 1]), rel=1e-5)
    assert float(second["cov_yaw_yaw"]) == pytest.approx(float(covariance[-1, -1]), rel=1e-5)
    assert sum(name.startswith("cov_") for name in second) == free * (free + 1) // 2
    with pytest.raises(InvalidArgumentError, match="covariances has shape"):
        write_pose_table(tmp_path / "a.csv", [0.5, 1e9], poses, root[:1])
    with pytest.raises(InvalidArgumentError, match="times has shape"):
        write_pose_table(tmp_path / "a.csv", [0.5, math.nan], poses, root @ root.mT)

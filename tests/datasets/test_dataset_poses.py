"""`Dataset.pose`, `.times` and `.skipped` of every reader."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scan_files import TURN_LEFT, depth_folder, flaser, kitti, needs_open3d, pcd, scan_folder

from gmmtorch.datasets import load


def stamped(stamp: object, x: float = 0.0) -> str:
    return flaser([1.0, 2.0], (x, 2.0, math.pi / 2)).replace(" 0.0 host", f" {stamp} host")


def test_carmen_poses_and_times_follow_the_stride(tmp_path):
    path = tmp_path / "a.log"
    path.write_text("".join(stamped(10.0 + i, float(i)) for i in range(5)))
    dataset = load("carmen", path, stride=2)
    assert dataset.times.tolist() == [10.0, 12.0, 14.0]
    pose = dataset.pose(-1)
    torch.testing.assert_close(pose[:2, :2], torch.tensor([[0.0, -1.0], [1.0, 0.0]], dtype=torch.float64))
    assert pose[:2, 2].tolist() == dataset[2].origin.tolist() == [4.0, 2.0]
    assert dataset.skipped == {}
    with pytest.raises(IndexError):
        dataset.pose(3)


@pytest.mark.parametrize("stamps", [(1.0, 1.0), (2.0, 1.0), (1.0, "nan"), (1.0, "host")])
def test_carmen_stamps_that_do_not_increase_are_not_used(tmp_path, stamps):
    path = tmp_path / "a.log"
    path.write_text("".join(stamped(stamp) for stamp in stamps))
    assert load("carmen", path).times is None


def test_poses_of_simulated_buildings_have_the_scans_origins():
    for name in ("synthetic_building", "synthetic_building_2d"):
        dataset = load(name, n_scans=2)
        assert torch.equal(dataset.pose(1)[:-1, -1], dataset[1].origin)
        assert dataset.times is None


def test_octomap_poses_have_the_scans_origins(tmp_path):
    path = tmp_path / "a.log"
    path.write_text("NODE 1 2 3 0 0 1.5707963267948966\n1 0 0\nNODE 4 5 6 0 0 0\n1 0 0\n")
    dataset = load("octomap_log", path)
    torch.testing.assert_close(dataset.pose(0)[:3, :3], torch.from_numpy(TURN_LEFT))
    assert [dataset.pose(i)[:3, 3].tolist() for i in range(2)] == [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]


@needs_open3d
def test_folders_return_the_poses_of_their_files(tmp_path):
    scan_folder(tmp_path, {"0.pcd": pcd([(1.0, 0.0, 0.0)])}, kitti(TURN_LEFT, [1.0, 2.0, 3.0]))
    pose = load("scan_folder", tmp_path).pose(0)
    assert pose.tolist() == [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    (tmp_path / "1.pcd").write_bytes(pcd([(1.0, 0.0, 0.0)], "4 5 6 1 0 0 0"))
    assert load("pcd_viewpoint", tmp_path).pose(0)[:3, 3].tolist() == [4.0, 5.0, 6.0]


def test_depth_frames_return_the_poses_of_their_files(tmp_path):
    pose = np.eye(4)
    pose[:3, 3] = 7, 8, 9
    folder = depth_folder(tmp_path, [(np.full((2, 3), 1000, np.uint16), pose)])
    assert torch.equal(load("depth_frames", folder).pose(0), torch.from_numpy(pose))

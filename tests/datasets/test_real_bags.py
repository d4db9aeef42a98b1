"""Bags of real robots: read without options, or refused with an error that names the option."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch

from gmmtorch.datasets import load
from gmmtorch.datasets.carmen import beam_angles
from gmmtorch.datasets.depth_frames import back_project
from gmmtorch.datasets.point_files.cloud_files import read_cloud
from gmmtorch.errors import DataError
from gmmtorch.export.trajectory_files import write_kitti
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.scan import Scan

pytest.importorskip("rosbags")

from sensor_bags import BagWriter

from gmmtorch.export.bag import write_bag

pytestmark = pytest.mark.real_data


def test_turtlebot4_needs_no_option(real_data):
    dataset = load("rosbag", real_data / "bags" / "turtlebot4" / "bag")
    assert (len(dataset), dataset.topic) == (356, "/scan")
    assert dataset.skipped == {"no pose at the time of the scan": 1}
    assert bool((dataset.times.diff() > 0).all())
    scan = dataset[100]
    assert scan.dim == 2
    assert scan.points.shape[0] > 400
    assert torch.equal(dataset.pose(100)[:2, 2], scan.origin)


def test_turtlebot4_has_the_same_poses_from_odometry(real_data):
    path = real_data / "bags" / "turtlebot4" / "bag"
    by_tf, by_topic = load("rosbag", path), load("rosbag", path, poses="/odom")
    poses = {float(time): by_tf.pose(i) for i, time in enumerate(by_tf.times)}
    for index in (3, 150, 300):
        torch.testing.assert_close(
            by_topic.pose(index), poses[float(by_topic.times[index])], rtol=0, atol=1e-3
        )


def test_a_ros_1_bag_of_merged_lasers_needs_no_option(real_data):
    dataset = load("rosbag", real_data / "bags" / "obstacle_detector")
    assert (len(dataset), dataset.topic) == (130, "/zed/scan_merged")
    assert dataset[0].points.shape == (812, 2)


def test_a_bag_without_tf_is_read_as_a_standing_sensor_by_one_option(real_data):
    path = real_data / "bags" / "truck_lidar"
    with pytest.raises(DataError, match=r"has no TF.*poses=standing.*/base_pose_ground_truth"):
        load("rosbag", path)
    dataset = load("rosbag", path, poses="standing")
    assert [scan.points.shape[0] for scan in dataset] == [35707, 36055, 36267, 36457, 36336]
    assert torch.equal(dataset.pose(4), torch.eye(4, dtype=torch.float64))
    with pytest.raises(DataError, match=r"stamps from 1583971570.*poses from 60\.200 to 60\.600 s"):
        load("rosbag", path, poses="/base_pose_ground_truth")


def test_a_bag_without_a_sensor_lists_its_topics(real_data):
    with pytest.raises(DataError, match=r"/amcl_pose .*135 messages.*/odom .*2639.*/tf_static"):
        load("rosbag", real_data / "bags" / "nav2_turtlebot")


# -- bags written from other formats ----------------------------------------------------------------


def assert_same_map(bag: Sequence[Scan], own: Sequence[Scan], n_scans: int, folder: Path) -> None:
    """Asserts that two sequences of scans give map files of the same bytes."""
    for name, scans in (("bag", bag), ("own", own)):
        assert len(scans) == n_scans
        built = GaussianMap()
        for scan in scans:
            built.insert(scan)
        built.save(folder / name)
    assert (folder / "bag").stat().st_size > 1000
    assert (folder / "bag").read_bytes() == (folder / "own").read_bytes()


@pytest.mark.slow
def test_a_bag_of_intel_gives_its_map_to_the_bit(real_data, tmp_path):
    """Beam ends as doubles; poses of the laser from TF. Scans differ by up to 1e-14 m, their maps do not."""
    log = load("carmen", real_data / "laser2d" / "intel.log.gz", stride=7, no_return_range=0)
    with BagWriter(tmp_path / "a.mcap") as bag:
        for i, record in enumerate(log._records[::7]):
            ranges, pose, matrix = record[:-3], log.pose(i), torch.eye(4, dtype=torch.float64)
            matrix[:2, :2], matrix[:2, 3] = pose[:2, :2], pose[:2, 2]
            bag.transforms(float(i), {("map", "laser"): matrix})
            ends = ranges[:, None] * torch.stack(
                [f(beam_angles(len(ranges))) for f in (torch.cos, torch.sin)], 1
            )
            table = np.zeros(len(ranges), np.dtype([("x", "<f8"), ("y", "<f8"), ("z", "<f8")]))
            table["x"], table["y"] = ends.numpy().T
            bag.cloud_table("/points", float(i), "laser", table)
    assert_same_map(load("rosbag", tmp_path / "a.mcap", max_range=50.0), log, 130, tmp_path)


@pytest.mark.slow
def test_a_bag_of_kinect_gives_its_map_to_the_bit(real_data, tmp_path):
    """Images of whole millimetres, and the poses of the frames in a trajectory file."""
    frames = load("depth_frames", real_data / "kinect", stride=10, pixel_stride=4)
    with BagWriter(tmp_path / "a.mcap") as bag:
        for i in range(len(frames)):
            depth = (frames.image(i)[0] * 1000).round().numpy()
            bag.depth("/depth/image", i / 10, "camera", depth, frames.intrinsics)
    poses = write_kitti(tmp_path / "poses.txt", torch.stack([frames.pose(i) for i in range(len(frames))]))
    assert_same_map(load("rosbag", tmp_path / "a.mcap", poses=poses, pixel_stride=4), frames, 14, tmp_path)


@pytest.mark.parametrize("suffix", ["mcap", "db3", "bag"])
def test_a_bag_of_hall_gives_the_scans_of_its_folder_to_the_bit(real_data, tmp_path, suffix):
    """Points of hall are float32 in the sensor frame, as in PointCloud2; poses are the rows of one file."""
    clouds = sorted((real_data / "hall" / "scans").glob("*.pcd"))[:6]
    rows = (real_data / "hall" / "poses.txt").read_text().splitlines()[:6]
    (tmp_path / "poses.txt").write_text("\n".join(rows) + "\n")
    (tmp_path / "scans").symlink_to(tmp_path / "clouds")
    (tmp_path / "clouds").mkdir()
    with BagWriter(tmp_path / f"a.{suffix}") as bag:
        for i, cloud in enumerate(clouds):
            (tmp_path / "clouds" / cloud.name).symlink_to(cloud)
            bag.cloud("/points", i / 10, "lidar", read_cloud(cloud).numpy())
    folder = load("scan_folder", tmp_path)
    dataset = load("rosbag", tmp_path / f"a.{suffix}", poses=tmp_path / "poses.txt")
    assert len(dataset) == len(folder) == 6
    for scan, expected in zip(dataset, folder, strict=True):
        assert torch.equal(scan.points, expected.points)
        assert torch.equal(scan.origin, expected.origin)


def test_a_bag_of_hall_with_tf_gives_its_scans_within_the_rounding_of_its_poses(real_data, tmp_path):
    folder = load("scan_folder", real_data / "hall", stride=15)
    poses = [folder.pose(i) for i in range(len(folder))]
    dataset = load("rosbag", write_bag(tmp_path / "a.mcap", folder, poses))
    for scan, expected in zip(dataset, folder, strict=True):
        torch.testing.assert_close(scan.points, expected.points, rtol=0, atol=1e-4)


def test_a_bag_of_intel_gives_the_scans_of_its_log(real_data, tmp_path):
    """LaserScan stores ranges and angles as float32, so that points differ by up to 10 µm at 50 m."""
    log = load("carmen", real_data / "laser2d" / "intel.log.gz", stride=100)
    with BagWriter(tmp_path / "a.mcap") as bag:
        for i, record in enumerate(log._records[::100]):
            ranges, matrix = record[:-3].numpy(), torch.eye(4, dtype=torch.float64)
            matrix[:2, :2], matrix[:2, 3] = log.pose(i)[:2, :2], log.pose(i)[:2, 2]
            bag.transforms(float(i), {("map", "laser"): matrix})
            bag.laser("/scan", float(i), "laser", ranges, -np.pi / 2, np.pi / 180, 50.0)
    dataset = load("rosbag", tmp_path / "a.mcap", no_return_range=8.0)
    assert len(dataset) == len(log) == 10
    for scan, expected in zip(dataset, log, strict=True):
        torch.testing.assert_close(scan.points, expected.points, rtol=0, atol=1e-5)
        torch.testing.assert_close(scan.no_return, expected.no_return, rtol=0, atol=1e-5)


def test_a_bag_of_kinect_gives_the_points_of_its_images(real_data, tmp_path):
    frames = load("depth_frames", real_data / "kinect", stride=60)
    with BagWriter(tmp_path / "a.mcap") as bag:
        for i in range(len(frames)):
            depth, pose = frames.image(i)
            bag.transforms(float(i), {("map", "camera"): pose})
            bag.depth("/depth/image", float(i), "camera", (depth * 1000).round().numpy(), frames.intrinsics)
    dataset = load("rosbag", tmp_path / "a.mcap")
    for i in range(len(frames)):
        depth, pose = frames.image(i)
        assert torch.equal(dataset.image(i)[0], depth)
        torch.testing.assert_close(dataset.pose(i), pose, rtol=0, atol=1e-12)
        expected = back_project(depth, frames.intrinsics) @ pose[:3, :3].T + pose[:3, 3]
        torch.testing.assert_close(dataset[i].points, expected, rtol=0, atol=1e-9)

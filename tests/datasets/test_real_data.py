"""The readers on real recordings from $GMMTORCH_DATA."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from sensor_bags import BagWriter

from gmmtorch import GaussianMap, Scan
from gmmtorch.datasets import Dataset, load
from gmmtorch.datasets.depth_images import back_project
from gmmtorch.datasets.point_files.point_chunks import read_cloud
from gmmtorch.datasets.scan_logs import beam_angles
from gmmtorch.errors import DataError
from gmmtorch.export import write_bag, write_kitti

pytestmark = pytest.mark.real_data


def real(name: str, relative: str, **options) -> Dataset:
    root = os.environ.get("GMMTORCH_DATA")
    if not root:
        pytest.skip("GMMTORCH_DATA is not set")
    path = Path(root) / relative
    if not path.exists():
        pytest.skip(f"{path} does not exist")
    return load(name, path, **options)


def span(scans: list, share: float = 1.0) -> list[float]:
    """Extent (m) along each axis of the middle `share` of the points."""
    points = torch.cat([scan.points for scan in scans]).numpy()
    tail = (1 - share) / 2
    return list(np.quantile(points, 1 - tail, axis=0) - np.quantile(points, tail, axis=0))


def disagreement(scans: list) -> float:
    """Median distance (m) from every 5th scan's points to the other scans; large if poses are wrong."""
    tested = torch.cat([scan.points for scan in scans[::5]])[::20]
    rest = torch.cat([scan.points for i, scan in enumerate(scans) if i % 5])
    return float(np.median(cKDTree(rest.numpy()).query(tested.numpy())[0]))


@pytest.mark.parametrize(
    ("log", "n_scans", "n_beams", "size"),
    [
        ("intel", 910, 180, (39, 36)),
        ("aces", 440, 180, (57, 57)),
        ("freiburg-101", 292, 360, None),
    ],
)
def test_carmen_reads_consistent_scans_from_real_logs(log, n_scans, n_beams, size):
    scans = list(real("carmen", f"laser2d/{log}.log.gz"))
    assert len(scans) == n_scans
    assert all(scan.n_beams <= n_beams for scan in scans)
    assert sum(scan.n_beams for scan in scans) > 0.98 * n_scans * n_beams
    assert all(bool(((scan.points - scan.origin).norm(dim=1) < 49.99).all()) for scan in scans)
    assert any(len(scan.no_return) for scan in scans)
    assert all(bool(((scan.no_return - scan.origin).norm(dim=1) < 8.001).all()) for scan in scans)
    assert disagreement(scans) < 0.05
    if size is not None:
        assert span(scans) == pytest.approx(size, abs=0.6)


@pytest.mark.parametrize(
    ("folder", "n_scans", "n_points"), [("hall", 45, 1.14e6), ("courtyard", 157, 0.80e6)]
)
def test_scan_folder_reads_consistent_scans_from_real_data(folder, n_scans, n_points):
    scans = list(real("scan_folder", folder))
    assert len(scans) == n_scans
    assert sum(scan.n_beams for scan in scans) == pytest.approx(n_points, rel=0.01)
    assert all(len(scan.no_return) == 0 for scan in scans)
    assert disagreement(scans) < 0.05
    if folder == "hall":  # some beams leave through its windows
        assert span(scans, 0.99) == pytest.approx([29, 35, 11], abs=0.5)


def test_depth_frames_reads_real_images():
    dataset = real("depth_frames", "kinect", pixel_stride=4)
    assert len(dataset) == 140
    scan = dataset[70]
    assert 5_000 < scan.points.shape[0] <= 640 * 480 / 16
    assert float((scan.points - scan.origin).norm(dim=1).max()) < 10


@pytest.mark.parametrize("folder", ["sim_structured", "sim_unstructured"])
def test_pcd_viewpoint_reads_real_scans(folder):
    dataset = real("pcd_viewpoint", f"la3dm/{folder}", max_range=8.0, no_return_range=8.0)
    assert len(dataset) == 12
    for scan in dataset:
        assert scan.n_beams == pytest.approx(3500, rel=0.15)
        assert float((scan.points - scan.origin).norm(dim=1).max()) < 8
    assert sum(len(scan.no_return) for scan in dataset) > 0


# -- bags of real robots: read without options, or refused with an error that names the option -------


pytest.importorskip("rosbags")


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

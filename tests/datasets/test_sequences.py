"""dataset=kitti, dataset=tum, and trajectories that replace the poses of any data set."""

from __future__ import annotations

import logging
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scan_files import depth_folder, flaser, kitti

from gmmtorch.datasets import load
from gmmtorch.errors import DataError, InvalidArgumentError, MissingDataError
from gmmtorch.export.trajectory_files import write_tum

# camera ← lidar: the camera looks along the lidar's x axis
MOUNT = np.array([[0.0, -1, 0, 0.1], [0, 0, -1, 0.2], [1, 0, 0, 0.3], [0, 0, 0, 1]])


def turned(x: float, yaw: float) -> np.ndarray:
    cos, sin = math.cos(yaw), math.sin(yaw)
    return np.array([[cos, -sin, 0, x], [sin, cos, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])


LIDAR = [turned(0.0, 0.0), turned(2.0, 0.3), turned(4.0, 0.6)]


@pytest.fixture
def sequence(tmp_path: Path) -> Path:
    """Three scans of a KITTI sequence, named 2, 10 and 11."""
    folder = tmp_path / "sequences" / "07"
    (folder / "velodyne").mkdir(parents=True)
    for i, name in enumerate((2, 10, 11)):
        points = np.array([[1.0, 0, 0, 9], [0, 1, i, 9], [0, 0, 0, 0], [np.nan, 0, 0, 0]], "<f4")
        points.tofile(folder / "velodyne" / f"{name}.bin")
    camera = [MOUNT @ pose @ np.linalg.inv(MOUNT) for pose in LIDAR]
    (folder / "poses.txt").write_text("".join(kitti(pose[:3, :3], pose[:3, 3].tolist()) for pose in camera))
    (folder / "calib.txt").write_text("P0: 1 2 3\nTr: " + kitti(MOUNT[:3, :3], MOUNT[:3, 3].tolist()))
    (folder / "times.txt").write_text("0.0\n1.0e-01\n2.0e-01\n")
    return folder


def test_kitti_scans_are_in_the_frame_of_the_first_lidar_pose(sequence):
    dataset = load("kitti", sequence)
    assert (dataset.name, len(dataset), dataset.times.tolist()) == ("07", 3, [0.0, 0.1, 0.2])
    for i, pose in enumerate(LIDAR):
        np.testing.assert_allclose(dataset.pose(i).numpy(), pose, atol=1e-12)
        expected = np.array([[1.0, 0, 0], [0, 1, i]]) @ pose[:3, :3].T + pose[:3, 3]
        np.testing.assert_allclose(dataset[i].points.numpy(), expected, atol=1e-6)
    assert load("kitti", sequence, stride=2).times.tolist() == [0.0, 0.2]


def test_kitti_finds_the_poses_of_the_benchmark(sequence):
    (sequence.parents[1] / "poses").mkdir()
    (sequence / "poses.txt").rename(sequence.parents[1] / "poses" / "07.txt")
    assert len(load("kitti", sequence)) == 3


def test_kitti_takes_a_tum_trajectory_of_the_lidar(sequence, tmp_path):
    path = write_tum(tmp_path / "t.txt", [0.0, 0.1], np.array([turned(5.0, 0.0), turned(6.0, 0.0)]))
    dataset = load("kitti", sequence, poses=path)
    assert [float(dataset.pose(i)[0, 3]) for i in range(2)] == pytest.approx([5, 6])
    assert dataset.skipped == {"no pose at the time of the scan": 1}
    late = write_tum(tmp_path / "late.txt", [50.0, 51.0], np.array([turned(5.0, 0.0)] * 2))
    with pytest.raises(DataError, match=r"Scans are from 0\.000 to 0\.200 s, poses from 50\.000 to 51\.000"):
        load("kitti", sequence, poses=late)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("calib.txt", None, "Tr: 1 0 0 0 0 1 0 0 0 0 1 0"),
        ("calib.txt", "P0: 1 2 3\n", "has no row Tr"),
        ("calib.txt", "Tr: 1 2 3\n", "row Tr is not 12 numbers"),
        ("calib.txt", "Tr: 2 0 0 0 0 1 0 0 0 0 1 0\n", "not a rigid pose"),
        ("poses.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n", "3 scans, but only 1 poses"),
        ("poses.txt", "1 2 3\n", "has 3 numbers per row"),
        ("poses.txt", "", "contains no row"),
        ("poses.txt", None, "does not exist"),
        ("times.txt", "0.1\n", "1 rows for 3 scans"),
        ("velodyne/2.bin", "123", "2.bin is not a whole number of points"),
    ],
)
def test_kitti_names_what_is_wrong(sequence, name, content, message):
    (sequence / name).unlink()
    if content is not None:
        (sequence / name).write_text(content)
    with pytest.raises((DataError, MissingDataError), match=message):
        load("kitti", sequence)[0]


@pytest.fixture
def rgbd(tmp_path: Path) -> Path:
    """Three depth images of a TUM sequence at 1.0, 1.5 and 2.5 s; poses from 1 to 2 s."""
    (tmp_path / "depth").mkdir()
    for i in range(3):
        Image.fromarray(np.array([[5000, 0], [10000, 2500]], np.uint16)).save(tmp_path / "depth" / f"{i}.png")
    (tmp_path / "depth.txt").write_text("# time file\n1.0 depth/0.png\n1.5 depth/1.png\n2.5 depth/2.png\n")
    times = np.linspace(1, 2, 11)
    write_tum(tmp_path / "groundtruth.txt", times, np.array([turned(10 * time, 0.0) for time in times]))
    return tmp_path


def test_tum_images_get_interpolated_poses(rgbd):
    dataset = load("tum", rgbd, intrinsics=[100, 100, 0, 0])
    assert dataset.times.tolist() == [1.0, 1.5]
    assert dataset.skipped == {"no pose at the time of the scan": 1}
    depth, pose = dataset.image(1)
    assert depth.tolist() == [[1.0, 0.0], [2.0, 0.5]]
    np.testing.assert_allclose(pose.numpy(), turned(15, 0), atol=1e-6)
    points = [[15, 0, 1], [15, 0.02, 2], [15.005, 0.005, 0.5]]
    np.testing.assert_allclose(dataset[1].points.numpy(), points, atol=1e-6)
    assert load("tum", rgbd).intrinsics.diagonal().tolist() == [525, 525, 1]


@pytest.mark.parametrize("name", ["depth.txt", "groundtruth.txt"])
def test_tum_rows_out_of_order_are_sorted_and_said(rgbd, caplog, name):
    expected = load("tum", rgbd)
    rows = (rgbd / name).read_text().splitlines()
    (rgbd / name).write_text("\n".join([*rows[2:], *rows[:2]]) + "\n")
    with caplog.at_level(logging.WARNING):
        dataset = load("tum", rgbd)
    assert f"{name}: {2 - rows[0].startswith('#')} of" in caplog.text
    assert "rows are out of order; they are sorted by time" in caplog.text
    assert torch.equal(dataset.times, expected.times)
    assert dataset.skipped == expected.skipped
    for index in range(len(expected)):
        assert torch.equal(dataset.pose(index), expected.pose(index))
        assert torch.equal(dataset[index].points, expected[index].points)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("depth.txt", None, "depth.txt is missing"),
        ("depth.txt", "# nothing\n", "lists no image"),
        ("depth.txt", "1.0\n", "line 1: expected a time and a file"),
        ("depth.txt", "x depth/0.png\n", "line 1: expected a time and a file"),
        ("depth.txt", "1.0 ../secret.png\n", "line 1: expected a time and a file"),
        ("depth.txt", "1.0 depth/9.png\n", "not a complete PNG"),
        ("depth.txt", "90.0 depth/0.png\n", r"Images are from 90\.000.*poses from 1\.000 to 2\.000"),
        ("groundtruth.txt", None, "groundtruth.txt does not exist"),
        ("groundtruth.txt", "1 2 3 4 0 0 0 0\n", "not a pose"),
        ("groundtruth.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n", "poses without times"),
    ],
)
def test_tum_names_what_is_wrong(rgbd, name, content, message):
    (rgbd / name).unlink()
    if content is not None:
        (rgbd / name).write_text(content)
    with pytest.raises((DataError, MissingDataError), match=message):
        load("tum", rgbd)[0]


def test_tum_checks_its_options(rgbd):
    for option, value in (("intrinsics", [1, 2, 3]), ("depth_scale", 0.0), ("pixel_stride", 0)):
        with pytest.raises(InvalidArgumentError, match=option):
            load("tum", rgbd, **{option: value})


def carmen(path: Path, stamped: bool = True) -> Path:
    lines = [flaser([1.0, 2.0], (float(i), 2.0, 0.1)).replace(" 0.0 host", f" {i}.5 host") for i in range(4)]
    path.write_text("".join(lines if stamped else [flaser([1.0, 2.0]) for _ in lines]))
    return path


def test_a_trajectory_replaces_the_poses_of_a_log(tmp_path):
    log = carmen(tmp_path / "a.log")
    path = write_tum(
        tmp_path / "t.txt", [1.0, 2.0, 3.0], np.array([turned(x, 0.5) for x in (10.0, 20.0, 30.0)])
    )
    dataset = load("carmen", log, poses=path)
    assert (dataset.times.tolist(), dataset.skipped) == ([1.5, 2.5], {"no pose at the time of the scan": 2})
    np.testing.assert_allclose(dataset.pose(1)[:2, 2].numpy(), [25, 0], atol=1e-6)
    scan = dataset[1]
    # beams at −90° and 90° of the heading 0.5
    side = np.array([math.sin(0.5), -math.cos(0.5)])
    np.testing.assert_allclose(scan.points.numpy(), side * [[1], [-2]] + np.array([25, 0]), atol=1e-6)
    np.testing.assert_allclose(scan.origin.numpy(), [25, 0], atol=1e-6)


def test_a_kitti_trajectory_has_one_row_for_each_scan(tmp_path):
    log = carmen(tmp_path / "a.log", stamped=False)
    path = tmp_path / "t.txt"
    path.write_text("".join(kitti(np.eye(3), [x, 0.0, 0.0]) for x in (5.0, 6.0, 7.0, 8.0)))
    assert [float(s.origin[0]) for s in load("carmen", log, poses=path, stride=2)] == [5.0, 7.0]
    path.write_text(kitti(np.eye(3), [0.0, 0.0, 0.0]))
    with pytest.raises(DataError, match="1 poses without times for 4 scans"):
        load("carmen", log, poses=path)
    path = write_tum(path, [0.0], np.eye(4)[None])
    with pytest.raises(InvalidArgumentError, match="the scans have no times"):
        load("carmen", log, poses=path)


def test_depth_frames_keep_their_images_with_another_trajectory(tmp_path):
    pose = turned(3.0, 0.2)
    folder = depth_folder(tmp_path, [(np.full((2, 3), 1000, np.uint16), pose)])
    plain = load("depth_frames", folder)
    path = tmp_path / "t.txt"
    path.write_text(kitti(np.eye(3), [1.0, 2.0, 3.0]))
    dataset = load("depth_frames", folder, poses=path)
    depth, moved = dataset.image(0)
    assert torch.equal(depth, plain.image(0)[0])
    assert torch.equal(dataset.intrinsics, plain.intrinsics)
    assert moved[:3, 3].tolist() == [1.0, 2.0, 3.0]
    back = (plain[0].points.numpy() - pose[:3, 3]) @ pose[:3, :3]
    np.testing.assert_allclose(dataset[0].points.numpy(), np.add(back, [1, 2, 3]), atol=1e-9)


def test_simulated_data_sets_refuse_a_trajectory(tmp_path):
    with pytest.raises(InvalidArgumentError, match="is simulated"):
        load("synthetic_building", poses=tmp_path / "t.txt")
    with pytest.raises(MissingDataError, match="does not exist"):
        load("carmen", carmen(tmp_path / "a.log"), poses=tmp_path / "none.txt")

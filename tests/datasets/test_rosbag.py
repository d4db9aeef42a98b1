"""dataset=rosbag: messages of every kind, poses from every source, and the choices between them."""

from __future__ import annotations

import math
import struct
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from gmmtorch.datasets import load
from gmmtorch.errors import DataError, GmmTorchError, InvalidArgumentError

pytest.importorskip("rosbags")

from sensor_bags import BagWriter, moved

POINTS = np.array([[1.0, 2.0, 3.0], [-4.0, 5.0, 0.5]])
LIVOX = """std_msgs/Header header
uint64 timebase
uint32 point_num
uint8 lidar_id
uint8[3] rsvd
CustomPoint[] points
================================================================================
MSG: livox_ros_driver/CustomPoint
uint32 offset_time
float32 x
float32 y
float32 z
uint8 reflectivity
uint8 tag
uint8 line
"""
FORMATS = pytest.mark.parametrize("suffix", ["mcap", "db3", "bag"])


def drive(bag: BagWriter, times: tuple[float, ...] = (0.0, 1.0, 2.0), speed: float = 1.0) -> None:
    """TF of a robot that moves along x, with a sensor 0.5 m above its base."""
    bag.transforms(times[0], {("base", "lidar"): moved(0, 0, 0.5)}, static=True)
    for time in times:
        bag.transforms(time, {("odom", "base"): moved(speed * time)})


def clouds(path: Path, times: tuple[float, ...] = (0.0, 0.5, 1.5), points: np.ndarray = POINTS) -> Path:
    with BagWriter(path) as bag:
        drive(bag)
        for time in times:
            bag.cloud("/points", time, "lidar", points)
    return path


@FORMATS
def test_clouds_are_moved_by_interpolated_transforms(tmp_path, suffix):
    dataset = load("rosbag", clouds(tmp_path / f"a.{suffix}"))
    assert (dataset.name, dataset.topic, len(dataset), dataset.skipped) == ("a", "/points", 3, {})
    assert dataset.times.tolist() == [0.0, 0.5, 1.5]
    for scan, x in zip(dataset, (0.0, 0.5, 1.5), strict=True):
        np.testing.assert_allclose(scan.points.numpy(), np.add(POINTS, [x, 0, 0.5]), atol=1e-12)
        np.testing.assert_allclose(scan.origin.numpy(), [x, 0, 0.5], atol=1e-12)
    np.testing.assert_allclose(dataset.pose(-1).numpy(), moved(1.5, 0, 0.5), atol=1e-12)


@FORMATS
def test_scans_are_read_in_any_order_and_with_a_stride(tmp_path, suffix):
    with BagWriter(tmp_path / f"a.{suffix}") as bag:
        drive(bag, (0.0, 10.0))
        for i in range(60):
            bag.cloud("/points", i / 10, "lidar", np.add(POINTS, [i, 0, 0]))
    dataset = load("rosbag", tmp_path / f"a.{suffix}", stride=7, max_gap=20)
    assert len(dataset) == 9
    for index in (0, 8, 3, 4, 4, 2, 8):
        assert float(dataset[index].points[0, 0]) == pytest.approx(1 + 7.7 * index)
        assert float(dataset.times[index]) == pytest.approx(0.7 * index)


def test_rotations_are_interpolated_along_the_shortest_arc(tmp_path):
    with BagWriter(tmp_path / "a.mcap") as bag:
        bag.transforms(0.0, {("odom", "lidar"): moved(0, yaw=math.radians(170))})
        bag.transforms(1.0, {("odom", "lidar"): moved(0, yaw=math.radians(-170))})
        bag.cloud("/points", 0.25, "lidar", np.array([[1.0, 0.0, 0.0]]))
    angle = math.radians(175)
    point = load("rosbag", tmp_path / "a.mcap")[0].points[0]
    np.testing.assert_allclose(point.numpy(), [math.cos(angle), math.sin(angle), 0], atol=1e-12)


@FORMATS
def test_laser_scans_are_2d_with_beams_without_return(tmp_path, suffix):
    ranges = [1.0, math.inf, math.nan, 0.0, 9.0, 2.0]  # range_max is 8
    with BagWriter(tmp_path / f"a.{suffix}") as bag:
        drive(bag)
        bag.laser("/scan", 1.0, "lidar", ranges, 0.0, math.pi / 2, 8.0)
    scan = load("rosbag", tmp_path / f"a.{suffix}", no_return_range=3)[0]
    np.testing.assert_allclose(scan.points.numpy(), [[2, 0], [1, 2]], atol=1e-6)
    np.testing.assert_allclose(scan.no_return.numpy(), [[1, 3], [4, 0]], atol=1e-6)
    assert scan.origin.tolist() == [1.0, 0.0]


def test_a_tilted_laser_gives_3d_scans(tmp_path):
    tilt = np.array([[0.0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]])
    with BagWriter(tmp_path / "a.mcap") as bag:
        for time in (0.0, 1.0):
            bag.transforms(time, {("odom", "lidar"): tilt})
        bag.laser("/scan", 0.0, "lidar", [1.0], 0.0, 0.1, 8.0)
    np.testing.assert_allclose(load("rosbag", tmp_path / "a.mcap")[0].points.numpy(), [[0, 0, -1]], atol=1e-7)


@pytest.mark.parametrize("increment", [0.1, -0.1])
@pytest.mark.parametrize("is_upside_down", [False, True])
def test_beams_follow_the_sign_of_the_increment_and_the_mount(tmp_path, increment, is_upside_down):
    """A robot at 10 m/s; the beams are taken one after the other in the order of their index."""
    ranges = np.array([1.0, 2.0, 3.0])
    over = np.diag([1.0, -1.0, -1.0, 1.0]) if is_upside_down else np.eye(4)  # half a turn about x
    with BagWriter(tmp_path / "a.mcap") as bag:
        for time in (0.0, 1.0, 2.0):
            bag.transforms(time, {("odom", "lidar"): moved(10 * time) @ over})
        bag.laser("/scan", 1.0, "lidar", ranges, 0.5, increment, 8.0, time_increment=0.02)
    scan = load("rosbag", tmp_path / "a.mcap")[0]
    angles = 0.5 + increment * np.arange(3)
    across = ranges * np.sin(angles) * (-1 if is_upside_down else 1)
    expected = np.stack([10 + ranges * np.cos(angles) + 10 * 0.02 * np.arange(3), across], 1)
    np.testing.assert_allclose(scan.points.numpy(), expected, atol=1e-6)


def test_points_with_times_are_deskewed(tmp_path):
    """A robot at 10 m/s sees a fixed point twice during a sweep of 0.1 s."""
    with BagWriter(tmp_path / "a.mcap") as bag:
        drive(bag, (0.0, 1.0, 2.0), speed=10.0)
        seen = np.array([[20.0, 1, 0], [19.5, 1, 0], [19.0, 1, 0]])
        bag.cloud("/points", 1.0, "lidar", seen, [0.0, 0.05, 0.1])
    points = load("rosbag", tmp_path / "a.mcap")[0].points.numpy()
    np.testing.assert_allclose(points, [[30, 1, 0.5]] * 3, atol=1e-3)
    raw = load("rosbag", tmp_path / "a.mcap", deskew=False)[0].points.numpy()
    np.testing.assert_allclose(raw, np.add(seen, [10, 0, 0.5]), atol=1e-12)


@pytest.mark.parametrize(("received", "at_end"), [(1.0, False), (1.001, True), (1.12, False)])
def test_a_message_received_before_its_sweep_could_end_has_the_stamp_of_the_end(tmp_path, received, at_end):
    """At 10 m/s and a sweep of 0.1 s, the first beam was measured 1 m before the last one."""
    with BagWriter(tmp_path / "a.mcap") as bag:
        drive(bag, speed=10.0)
        content = {"ranges": np.array([5, 5, 5], np.float32), "range_max": 9.0, "time_increment": 0.05}
        content["angle_increment"] = 1e-9
        header = {"header": {"frame_id": "lidar"}}
        bag.message("/scan", "sensor_msgs/msg/LaserScan", 1.0, {**header, **content}, received)
    along = load("rosbag", tmp_path / "a.mcap")[0].points[:, 0]
    start = 14.0 if at_end else 15.0
    np.testing.assert_allclose(along.numpy(), [start, start + 0.5, start + 1], atol=1e-5)


def test_a_sweep_that_outlasts_the_poses_is_kept_and_counted(tmp_path):
    with BagWriter(tmp_path / "a.mcap") as bag:
        drive(bag)
        bag.cloud("/points", 1.95, "lidar", POINTS, [0.0, 0.1])
    dataset = load("rosbag", tmp_path / "a.mcap")
    assert dataset[0].points.shape == (2, 3)
    assert dataset.skipped == {"points not deskewed: no poses during the sweep": 1}


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("suffix", ["mcap", "bag"])
def test_clouds_have_any_layout_of_fields(tmp_path, order, suffix):
    """Doubles z, y, x with padding; NaN, also in whole rows, as lidars fill missing rings; points at zero."""
    layout = {
        "names": ["ring", "z", "x", "y"],
        "formats": ["u2", f"{order}f8", f"{order}f8", f"{order}f4"],
        "offsets": [1, 8, 16, 27],
        "itemsize": 40,
    }
    table = np.zeros((3, 3), np.dtype(layout))
    table["x"], table["y"], table["z"] = [[1, np.nan, 0], [np.nan] * 3, [2, 3, np.inf]], 0.5, -1.5
    table["y"][0, 2] = table["z"][0, 2] = 0
    with BagWriter(tmp_path / f"a.{suffix}") as bag:
        drive(bag)
        bag.cloud_table("/points", 0.0, "lidar", table)
    dataset = load("rosbag", tmp_path / f"a.{suffix}")
    assert dataset[0].points.tolist() == [[1, 0.5, -1], [2, 0.5, -1], [3, 0.5, -1]]
    assert dataset.skipped == {}


def test_clouds_of_one_height_are_2d_scans(tmp_path):
    """Merged laser scans are such clouds. A cloud that leaves the plane is left out and counted."""
    rng = np.random.default_rng(0)
    merged = np.column_stack([rng.uniform(1, 9, (30, 2)), np.full(30, 0.25)])
    clouds = POINTS[:0], rng.normal(size=(30, 3)), merged, merged
    with BagWriter(tmp_path / "a.mcap") as bag:
        drive(bag)
        for index, points in enumerate(clouds):
            bag.cloud("/points", index / 2, "lidar", points)
    dataset = load("rosbag", tmp_path / "a.mcap")
    assert [tuple(scan.points.shape) for scan in dataset] == [(0, 2), (0, 2), (30, 2), (30, 2)]
    np.testing.assert_allclose(dataset[2].points.numpy(), merged[:, :2] + [1.0, 0], atol=1e-6)
    assert dataset.pose(1).shape == (3, 3)
    assert dataset.skipped == {
        "message without a valid point": 1,
        "points of several heights among planar scans": 1,
    }


def test_one_planar_cloud_does_not_make_a_recording_2d(tmp_path):
    """A lidar that starts may see one ring only."""
    rng = np.random.default_rng(0)
    ring = np.column_stack([rng.uniform(1, 9, (30, 2)), np.full(30, 0.25)])
    with BagWriter(tmp_path / "a.mcap") as bag:
        drive(bag)
        for index, points in enumerate([ring, *rng.normal(size=(2, 30, 3))]):
            bag.cloud("/points", index / 2, "lidar", points)
    dataset = load("rosbag", tmp_path / "a.mcap")
    assert [tuple(scan.points.shape) for scan in dataset] == [(30, 3)] * 3
    assert dataset.skipped == {}


@FORMATS
def test_depth_images_are_back_projected(tmp_path, suffix):
    depth = np.array([[1000, 0], [65535, 2000]], np.uint16)
    camera = np.array([[100.0, 0, 1], [0, 200, 1], [0, 0, 1]])
    with BagWriter(tmp_path / f"a.{suffix}") as bag:
        drive(bag)
        bag.depth("/camera/depth/image", 1.0, "lidar", depth, camera)
        bag.message("/camera/color/image", "sensor_msgs/msg/Image", 1.0, {"encoding": "rgb8"})
        bag.message("/camera/color/camera_info", "sensor_msgs/msg/CameraInfo", 1.0, {})
    dataset = load("rosbag", tmp_path / f"a.{suffix}")
    np.testing.assert_allclose(dataset[0].points.numpy(), [[0.99, -0.005, 1.5], [1, 0, 2.5]], atol=1e-12)
    image, pose = dataset.image(0)
    assert image.tolist() == [[1.0, 0.0], [0.0, 2.0]]
    assert torch.equal(pose, dataset.pose(0))
    assert dataset.intrinsics.tolist() == camera.tolist()


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
def test_compressed_depth_images_are_read(tmp_path, encoding):
    a, b = (1.0, 0.0) if encoding == "16UC1" else (2500.0, -10.0)
    stored = np.array([[1500, 0]], np.uint16) if encoding == "16UC1" else np.array([[2490, 0]], np.uint16)
    png = BytesIO()
    Image.fromarray(stored).save(png, "PNG")
    data = np.frombuffer(struct.pack("<iff", 0, a, b) + png.getvalue(), np.uint8)
    with BagWriter(tmp_path / "a.mcap") as bag:
        drive(bag)
        content = {
            "header": {"frame_id": "lidar"},
            "format": f"{encoding}; compressedDepth png",
            "data": data,
        }
        bag.message("/depth/image/compressedDepth", "sensor_msgs/msg/CompressedImage", 1.0, content)
        camera = {"k": np.array([1.0, 0, 0, 0, 1, 0, 0, 0, 1])}
        bag.message("/depth/camera_info", "sensor_msgs/msg/CameraInfo", 1.0, camera)
    image, _ = load("rosbag", tmp_path / "a.mcap").image(0)
    assert image.tolist() == [[pytest.approx(1.5 if encoding == "16UC1" else 1.0), 0.0]]


@pytest.mark.parametrize("suffix", ["mcap", "bag"])
def test_unknown_messages_with_a_list_of_points_are_read_by_their_definition(tmp_path, suffix):
    name = "livox_ros_driver/msg/CustomMsg"
    with BagWriter(tmp_path / f"a.{suffix}") as bag:
        drive(bag, speed=10.0)
        bag.define(name, LIVOX)
        entry = [
            {"offset_time": i * 10_000_000, "x": 1.0 + i, "y": 2.0, "z": 3.0, "tag": 9} for i in range(5)
        ]
        content = {"header": {"frame_id": "lidar"}, "timebase": 7, "point_num": 5, "points": entry}
        bag.message("/livox/lidar", name, 1.0, content)
    scan = load("rosbag", tmp_path / f"a.{suffix}")[0]
    expected = [[11.0 + i + 0.1 * i, 2.0, 3.5] for i in range(5)]  # deskewed: 10 m/s, 10 ms apart
    np.testing.assert_allclose(scan.points.numpy(), expected, atol=1e-3)


def test_poses_come_from_a_topic_and_the_static_mount(tmp_path):
    with BagWriter(tmp_path / "a.mcap") as bag:
        bag.transforms(0.0, {("base", "lidar"): moved(0, 0, 0.5)}, static=True)
        for time in (0.0, 1.0):
            bag.odometry("/odom", time, "odom", "base", moved(4 * time))
        bag.cloud("/points", 0.5, "lidar", POINTS)
    with pytest.raises(DataError, match=r"only static transforms.*poses=standing.*/odom"):
        load("rosbag", tmp_path / "a.mcap")
    dataset = load("rosbag", tmp_path / "a.mcap", poses="/odom")
    np.testing.assert_allclose(dataset.pose(0).numpy(), moved(2, 0, 0.5), atol=1e-12)
    given = load("rosbag", tmp_path / "a.mcap", poses="/odom", extrinsic=[0, 0, 7, 0, 0, 0, 1])
    np.testing.assert_allclose(given.pose(0).numpy(), moved(2, 0, 7), atol=1e-12)


def test_a_topic_of_poses_without_a_mount_asks_for_it(tmp_path):
    with BagWriter(tmp_path / "a.mcap") as bag:
        bag.odometry("/odom", 0.0, "odom", "base", moved(0))
        bag.cloud("/points", 0.0, "lidar", POINTS)
    with pytest.raises(DataError, match=r"frame base.*frame lidar.*extrinsic"):
        load("rosbag", tmp_path / "a.mcap", poses="/odom")
    with pytest.raises(InvalidArgumentError, match=r"extrinsic=\[1, 2\]"):
        load("rosbag", tmp_path / "a.mcap", poses="/odom", extrinsic=[1, 2])
    with pytest.raises(InvalidArgumentError, match=r"poses=/points has messages.*which are not poses"):
        load("rosbag", tmp_path / "a.mcap", poses="/points")
    with pytest.raises(InvalidArgumentError, match=r"poses=/pose is neither.*/odom"):
        load("rosbag", tmp_path / "a.mcap", poses="/pose")


def test_poses_come_from_trajectory_files(tmp_path):
    bag = clouds(tmp_path / "a.mcap")
    (tmp_path / "tum.txt").write_text("# t x y z qx qy qz qw\n0 0 0 0 0 0 0 1\n2 8 0 0 0 0 0 1\n")
    dataset = load("rosbag", bag, poses=str(tmp_path / "tum.txt"))
    assert [float(dataset.pose(i)[0, 3]) for i in range(3)] == pytest.approx([0, 2, 6])
    (tmp_path / "kitti.txt").write_text("".join(f"1 0 0 {i} 0 1 0 0 0 0 1 0\n" for i in (5, 6, 7)))
    dataset = load("rosbag", bag, poses=str(tmp_path / "kitti.txt"))
    assert [float(scan.origin[0]) for scan in dataset] == [5, 6, 7]
    (tmp_path / "short.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    with pytest.raises(DataError, match="1 poses without times for 3 scans"):
        load("rosbag", bag, poses=str(tmp_path / "short.txt"))


def test_the_fixed_frame_is_the_root_unless_it_is_chosen(tmp_path):
    with BagWriter(tmp_path / "a.mcap") as bag:
        drive(bag)
        for time in (0.0, 2.0):
            bag.transforms(time, {("map", "odom"): moved(100)})
        bag.cloud("/points", 1.0, "lidar", POINTS)
    assert float(load("rosbag", tmp_path / "a.mcap").pose(0)[0, 3]) == 101
    assert float(load("rosbag", tmp_path / "a.mcap", frame="/odom").pose(0)[0, 3]) == 1


def test_a_choice_of_sensors_is_listed_with_counts(tmp_path):
    with BagWriter(tmp_path / "a.mcap") as bag:
        drive(bag)
        for topic, n in (("/front", 2), ("/rear", 1)):
            for i in range(n):
                bag.cloud(topic, i / 10, "lidar", POINTS)
        bag.laser("/scan", 0.0, "lidar", [1.0], 0.0, 0.1, 8.0)
    with pytest.raises(InvalidArgumentError, match=r"/front.*2 messages.*/rear.*1 messages.*topic=/front"):
        load("rosbag", tmp_path / "a.mcap")
    assert len(load("rosbag", tmp_path / "a.mcap", topic="/rear")) == 1
    assert load("rosbag", tmp_path / "a.mcap", topic="/scan")[0].dim == 2
    with pytest.raises(InvalidArgumentError, match=r"topic=/top is not in.*/front"):
        load("rosbag", tmp_path / "a.mcap", topic="/top")
    with pytest.raises(DataError, match=r"topic=/tf is not a range sensor"):
        load("rosbag", tmp_path / "a.mcap", topic="/tf")


def test_without_rosbags_the_error_states_the_install_command(tmp_path, monkeypatch):
    import sys

    path = clouds(tmp_path / "a.mcap")
    monkeypatch.setitem(sys.modules, "rosbags.rosbag2", None)
    with pytest.raises(GmmTorchError, match=r"pip install 'gmmtorch\[bags\]'"):
        load("rosbag", path)

"""Several sensors of one robot as one data set, and the bags of RealSense cameras."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from gmmtorch import GaussianMap
from gmmtorch.datasets import load
from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.localization import Tracker, locate_scans, with_odometry
from gmmtorch.mapping import MapBuilder

pytest.importorskip("rosbags")

from sensor_bags import BagWriter, moved

FRONT_REAR = ["/front", "/rear"]


def ring(radius: float) -> np.ndarray:
    """Points (60, 3) around a lidar, at several heights."""
    angle = np.arange(60) * 0.1
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), angle / 6], 1)


def two_lidars(path: Path, root_of_rear: str = "base", laser: bool = False) -> Path:
    """A drive of 2 s with a lidar ahead, and another one, or a laser, at the back, that looks backwards."""
    with BagWriter(path) as bag:
        mounts = {("base", "front"): moved(1.0), (root_of_rear, "rear"): moved(-1.0, 0.2, yaw=np.pi)}
        bag.transforms(0.0, mounts, static=True)
        for i in range(21):
            bag.transforms(i * 0.1, {("odom", "base"): moved(i * 0.1, yaw=i * 0.05)})
            bag.odometry("/odom", i * 0.1, "odom", "base", moved(i * 0.1, yaw=i * 0.05))
            stamped = {"header": {"frame_id": "odom"}, "pose": {"orientation": {"w": 1.0}}}
            bag.message("/pose", "geometry_msgs/msg/PoseStamped", i * 0.1, stamped)
        for i in range(20):
            bag.cloud("/front", i * 0.1 + 0.02, "front", ring(4.0))
            if laser:
                bag.laser("/rear", i * 0.1 + 0.06, "rear", np.full(90, 2.0), -0.8, 0.018, 9.0)
            elif i % 2 == 0:
                bag.cloud("/rear", i * 0.1 + 0.06, "rear", ring(3.0))
    return path


@pytest.mark.parametrize("suffix", [".bag", ".mcap", ".db3"])
@pytest.mark.parametrize("options", [{}, {"stride": 3}, {"poses": "/odom"}])
def test_scans_of_two_lidars_come_in_the_order_of_their_times(tmp_path, suffix, options):
    path = two_lidars(tmp_path / f"a{suffix}")
    both = load("rosbag", path, topic=FRONT_REAR, **options)
    alone = [load("rosbag", path, topic=topic, **options) for topic in FRONT_REAR]
    assert both.times is not None
    assert len(both) == len(both.times) == sum(map(len, alone))
    assert bool((both.times.diff() >= 0).all())
    expected = sorted(
        ((float(one.times[i]), one[i], one.pose(i)) for one in alone for i in range(len(one))),
        key=lambda row: row[0],
    )
    for i, (time, scan, known) in enumerate(expected):
        assert float(both.times[i]) == both[i].time == time
        assert torch.equal(both[i].points, scan.points)
        assert torch.equal(both.pose(i), known)
    rear = int((both.times - both.times[0] - 0.04).abs().argmin())  # 0.06 s after the start of the drive
    turned = moved(0.06, yaw=0.03) @ moved(-1.0, 0.2, yaw=np.pi)
    np.testing.assert_allclose(both.pose(rear), turned, atol=1e-3)


def test_a_map_has_what_both_lidars_saw(tmp_path):
    scans = load("rosbag", two_lidars(tmp_path / "a.mcap"), topic=FRONT_REAR)
    built = GaussianMap()
    for scan in scans:
        built.insert(scan)
    built.finish()
    distance = (built.components().origins[:, None] - torch.stack([s.origin for s in scans])).norm(dim=2)
    assert {index % 3 == 1 for index in distance.argmin(1).tolist()} == {True, False}


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"poses": "standing"}, "at the same place"),
        ({"poses": "/pose"}, "at the same place"),
        ({"poses": "/odom", "extrinsic": [0, 0, 0, 0, 0, 0, 1]}, "at the same place"),
        ({"topic": []}, "names no topic"),
        ({"topic": ["/front", "/none"]}, "/none is not in"),
    ],
)
def test_sensors_whose_places_are_unknown_are_refused(tmp_path, options, text):
    path = two_lidars(tmp_path / "a.mcap")
    with pytest.raises(InvalidArgumentError, match=text):
        load("rosbag", path, **{"topic": FRONT_REAR, **options})


def test_a_trajectory_file_does_not_say_which_sensor_it_is_of(tmp_path):
    path, file = two_lidars(tmp_path / "a.mcap"), tmp_path / "poses.txt"
    file.write_text("0 0 0 0 0 0 0 1\n2 1 0 0 0 0 0 1\n")
    with pytest.raises(InvalidArgumentError, match="at the same place"):
        load("rosbag", path, topic=FRONT_REAR, poses=str(file))


def test_sensors_that_do_not_go_together_are_refused(tmp_path):
    apart = two_lidars(tmp_path / "a.mcap", root_of_rear="trailer")
    with pytest.raises(DataError, match="/rear"):
        load("rosbag", apart, topic=FRONT_REAR)
    with pytest.raises(InvalidArgumentError, match="different frames: /front in odom, /rear in trailer"):
        load("rosbag", apart, topic=FRONT_REAR, poses="tf")
    mixed = two_lidars(tmp_path / "b.mcap", laser=True)
    with pytest.raises(InvalidArgumentError, match="2D and in 3D"):
        load("rosbag", mixed, topic=FRONT_REAR)


def test_the_motion_of_several_sensors_is_not_estimated(tmp_path):
    scans = load("rosbag", two_lidars(tmp_path / "a.mcap"), topic=FRONT_REAR)
    with pytest.raises(InvalidArgumentError, match="has 2 topics, and odometry=mixture follows one sensor"):
        with_odometry(scans)
    built = GaussianMap()
    built.insert(scans[0])
    built.finish()
    with pytest.raises(InvalidArgumentError, match="localization follows one sensor"):
        next(locate_scans(scans, Tracker(built)))


def test_a_depth_camera_beside_a_lidar(tmp_path):
    """The camera looks along the robot's x axis at a wall 2 m ahead of itself."""
    path = tmp_path / "a.mcap"
    optical = np.array([[0, 0, 1, 0.5], [-1, 0, 0, 0], [0, -1, 0, 0.3], [0, 0, 0, 1.0]])
    with BagWriter(path) as bag:
        bag.transforms(0.0, {("base", "lidar"): moved(0.0), ("base", "camera"): optical}, static=True)
        for i in range(8):
            bag.transforms(i * 0.1, {("odom", "base"): moved(i * 0.1)})
        for i in range(6):
            bag.cloud("/lidar", i * 0.1, "lidar", ring(4.0))
            camera = np.array([[8.0, 0, 8], [0, 8.0, 6], [0, 0, 1]])
            bag.depth("/camera/image", i * 0.1 + 0.05, "camera", np.full((12, 16), 2000), camera)
    scans = load("rosbag", path, topic=["/lidar", "/camera/image"])
    assert len(scans) == 12
    image = scans[1]
    np.testing.assert_allclose(image.points[:, 0], 0.05 + 0.5 + 2.0, atol=1e-6)
    np.testing.assert_allclose(image.origin, [0.55, 0, 0.3], atol=1e-6)
    assert len(scans[0].points) == 60


@pytest.mark.parametrize("option", ["Depth_Units", "Depth Units", None])
def test_the_bag_of_a_realsense_camera_states_its_unit(tmp_path, option):
    """The topics that rs-record writes: camera_info once at the start, and the unit as an option."""
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    types = {name.rpartition("/")[2]: kind for name, kind in store.types.items()}
    types["Time"] = store.types["builtin_interfaces/msg/Time"]
    path, stream = tmp_path / "a.bag", "/device_0/sensor_0/Depth_0"
    none = types["RegionOfInterest"](0, 0, 0, 0, False)
    zero = types["Time"](0, 0)
    with Writer(path) as writer:

        def write(topic: str, time: int, kind: str, message: object) -> None:
            known = next((c for c in writer.connections if c.topic == topic), None)
            connection = known or writer.add_connection(topic, kind, typestore=store)
            writer.write(connection, time, bytes(store.serialize_ros1(message, kind)))

        matrix = np.array([8.0, 0, 8, 0, 8, 6, 0, 0, 1])
        header = types["Header"](0, zero, "0")
        info = types["CameraInfo"](
            *(header, 12, 16, "Brown Conrady", np.zeros(5), matrix, np.zeros(9), np.zeros(12), 0, 0, none)
        )
        write(f"{stream}/info/camera_info", 1, "sensor_msgs/msg/CameraInfo", info)
        other = types["CameraInfo"](
            *(header, 12, 16, "Brown Conrady", np.zeros(5), 2 * matrix, np.zeros(9), np.zeros(12), 0, 0, none)
        )
        write("/device_0/sensor_0/Infrared_1/info/camera_info", 1, "sensor_msgs/msg/CameraInfo", other)
        if option is not None:
            unit = types["Float32"](0.00025)
            write(f"/device_0/sensor_0/option/{option}/value", 1, "std_msgs/msg/Float32", unit)
            write(
                f"/device_0/sensor_1/option/{option}/value", 1, "std_msgs/msg/Float32", types["Float32"](7.0)
            )
        for i in range(3):
            header = types["Header"](i, types["Time"](100, i * 30_000_000), "0")
            data = np.frombuffer(np.full((12, 16), 8000, "<u2").tobytes(), np.uint8)
            image = types["Image"](header, 12, 16, "mono16", 0, 32, data)
            write(f"{stream}/image/data", 10 + i * 30_000_000, "sensor_msgs/msg/Image", image)
    depth = 2.0 if option else 8.0  # m; without the option a unit is a millimetre
    scans = load("rosbag", path, poses="standing")
    assert len(scans) == 3
    np.testing.assert_allclose(scans[0].points[:, 2], depth, rtol=1e-6)
    stated = load("rosbag", path, poses="standing", depth_scale=0.001)
    np.testing.assert_allclose(stated[0].points[:, 2], 8.0, rtol=1e-6)


def test_the_path_is_that_of_one_sensor(tmp_path):
    scans = load("rosbag", two_lidars(tmp_path / "a.mcap"), topic=FRONT_REAR)
    alone = load("rosbag", tmp_path / "a.mcap", topic="/front")
    metres = []
    for source in (scans, alone):
        builder = MapBuilder(source, GaussianMap())
        for _ in builder.insert_all():
            pass
        metres.append(builder.record.metres)
    assert metres[0] == pytest.approx(metres[1])
    assert metres[0] == pytest.approx(1.68, abs=0.02)  # a circle of 20 m, and the lidar 1 m ahead of it

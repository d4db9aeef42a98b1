"""Live scans without poses: odometry finds them, and continues in the map of an earlier run."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs the extra [ros]: rosbags")
pytest.importorskip("cyclonedds", reason="needs the extra [ros]: cyclonedds")

from test_live_localizer import laser, pose, room

from gmmtorch.datasets.base import Ranges
from gmmtorch.datasets.ros.bag_reader import LASER, Sensor, Topic
from gmmtorch.datasets.ros.transform_tree import TransformTree
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.export.message_fields import transform_fields
from gmmtorch.live.mapper import pose_publisher
from gmmtorch.live.mapper.live_mapper import LiveMapper
from gmmtorch.live.mapper.live_scans import LiveOptions, LiveScans
from gmmtorch.live.ros import Node, Quality
from gmmtorch.mapping.gaussian_map import GaussianMap

SENSOR = Sensor(Topic("/scan", "", 0), LASER)
PATH = [(1.5 + 0.1 * i, 1.5 + 0.03 * i, 0.05 * i) for i in range(12)]
FIRST = pose(*PATH[0])


def live(tree: TransformTree, **options: Any) -> LiveScans:
    return LiveScans(SENSOR, tree, Ranges(), LiveOptions(poses="mixture", max_latency=None, **options))


def is_near(found: np.ndarray, at: tuple[float, float, float]) -> bool:
    """Whether a pose in the frame of the first scan is that of the path, to 3 cm and 1.5°."""
    off = np.linalg.inv(FIRST @ found) @ pose(*at)
    return bool(np.linalg.norm(off[:2, 3]) < 0.03 and abs(np.arctan2(off[1, 0], off[0, 0])) < 0.026)


def test_a_mapper_without_transforms_finds_and_publishes_the_poses(ros_domain, monkeypatch):
    sent: list[tuple[str, Any]] = []

    def publisher(topic: str, message_type: str, offered: Quality | None = None) -> Any:
        return lambda message, stamp=None: sent.append((topic, message))

    monkeypatch.setattr(pose_publisher, "SETTLING", 0.0)
    with Node("test", domain=ros_domain) as node:
        monkeypatch.setattr(node, "publisher", publisher)
        mount = np.eye(4)
        mount[:3, 3] = 0.2, 0.0, 0.5  # base ← laser
        node.transforms.add(transform_fields({("base", "laser"): mount}), static=True)
        scans = live(node.transforms)
        mapper = LiveMapper(node, scans, GaussianMap())
        for index, at in enumerate(PATH):
            scans.receive(laser(index / 5, room(*at)), 0)
            assert mapper.step(0.0)
        mapper.finish()
    found = [np.eye(4) for _ in PATH]
    for matrix, stored in zip(found, mapper.builder.poses.numpy(), strict=True):
        matrix[:2, :2], matrix[:2, 3] = stored[:2, :2], stored[:2, 2]
    assert all(is_near(matrix, at) for matrix, at in zip(found, PATH, strict=True))
    last = [message for topic, message in sent if topic == "pose"][-1]
    assert (last["header"]["frame_id"], last["child_frame_id"]) == ("odom", "laser")
    assert last["pose"]["pose"]["position"]["x"] == pytest.approx(found[-1][0, 3])
    step = [message for topic, message in sent if topic == "/tf"][-1]["transforms"][0]
    assert (step["header"]["frame_id"], step["child_frame_id"]) == ("odom", "base")
    expected = found[-1] @ np.linalg.inv(mount)
    shift = [step["transform"]["translation"][axis] for axis in "xyz"]
    assert np.allclose(shift, expected[:3, 3])
    wall = 6.0 - PATH[0][0]  # ahead of the first pose
    near = mapper.builder.map.occupancy([[wall, 0.0], [wall - 1.0, 0.0]], 0.1)
    assert near[0] > 0.65
    assert near[1] < 0.35


def test_a_robot_that_another_node_moves_gets_no_second_transform(ros_domain, monkeypatch, caplog):
    topics: list[str] = []
    monkeypatch.setattr(pose_publisher, "SETTLING", 0.0)
    with Node("test", domain=ros_domain) as node:
        monkeypatch.setattr(
            node, "publisher", lambda topic, *_: lambda message, stamp=None: topics.append(topic)
        )
        node.transforms.add(transform_fields({("base", "laser"): np.eye(4)}), static=True)
        moving = transform_fields({("wheels", "base"): np.eye(4)})
        moving["transforms"][0]["header"]["stamp"] = {"sec": 0, "nanosec": 0}
        node.transforms.add(moving, static=False)
        scans = live(node.transforms)
        mapper = LiveMapper(node, scans, GaussianMap())
        scans.receive(laser(0.0, room(*PATH[0])), 0)
        assert mapper.step(0.0)
    assert "pose" in topics
    assert "/tf" not in topics
    assert "TF of another node moves base in wheels; only the topic pose is published" in caplog.text


def test_odometry_continues_in_the_map_of_an_earlier_run():
    earlier, built = live(TransformTree()), GaussianMap()
    for index, at in enumerate(PATH):
        earlier.receive(laser(index / 5, room(*at)), 0)
        assert earlier.advance()
        assert earlier.newest is not None
        built.insert(earlier.newest.scan)
    later = live(TransformTree())
    later.continue_in(built)
    rng = np.random.default_rng(0)
    later.receive(laser(0.0, rng.uniform(0.5, 15.0, 180)), 0)
    assert not later.advance()  # a scan of no place of the map
    assert later.skipped == {"no pose was found by odometry": 1}
    for index, at in enumerate(PATH[6:]):
        later.receive(laser(10 + index / 5, room(*at)), 0)
        assert later.advance()
        assert later.newest is not None
        assert is_near(later.newest.pose.matrix.numpy(), at)
        assert later.newest.location is not None
        assert (np.linalg.eigvalsh(later.newest.location.covariance) > 0).all()


def test_a_scan_that_odometry_does_not_find_is_left_out():
    scans = live(TransformTree(), frame="lidar_odom")
    assert scans.world_frame == "lidar_odom"
    rng = np.random.default_rng(1)
    for index, ranges in enumerate([room(*PATH[0]), rng.uniform(0.5, 15.0, 180), room(*PATH[1])]):
        scans.receive(laser(index / 5, ranges), 0)
        assert scans.advance() == (index != 1)
    assert len(scans) == 2
    assert scans.skipped == {"no pose was found by odometry": 1}
    assert "surfaces" in scans.trouble or "contradict" in scans.trouble


def test_an_unknown_way_to_find_poses_is_refused():
    with pytest.raises(InvalidArgumentError, match=r"poses='gps' .*tf, standing, kiss_icp, mixture"):
        LiveOptions(poses="gps")

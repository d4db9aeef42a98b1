"""Poses of a live sensor: in a known map, by odometry from its scans, and in the map of an earlier run."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from sensor_bags import moved

pytest.importorskip("rosbags", reason="needs the extra [ros]: rosbags")
pytest.importorskip("cyclonedds", reason="needs the extra [ros]: cyclonedds")

from gmmtorch import GaussianMap, Scan
from gmmtorch.datasets import LASER, Ranges, Sensor, Topic, TransformTree, load
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.export.bag import transform_fields
from gmmtorch.live import LiveLocalizer, LiveMapper, LiveScans, Node, live_scans, publishers
from gmmtorch.live.live_scans import LiveOptions
from gmmtorch.live.ros import Quality

N_BEAMS = 180
ANGLES = np.linspace(-np.pi, np.pi, N_BEAMS, endpoint=False)


def room(x: float, y: float, yaw: float) -> np.ndarray:
    """Ranges (N,) of a laser at a pose in a room of 6 m × 4 m with a corner of 1.5 m cut off."""
    directions = np.stack([np.cos(ANGLES + yaw), np.sin(ANGLES + yaw)], 1)
    walls = [((0, 0), (6, 0)), ((6, 0), (6, 2.5)), ((6, 2.5), (4.5, 2.5)), ((4.5, 2.5), (4.5, 4))]
    walls += [((4.5, 4), (0, 4)), ((0, 4), (0, 0))]
    nearest = np.full(N_BEAMS, np.inf)
    for first, second in walls:
        along, off = np.subtract(second, first), np.subtract(first, (x, y))
        cross = directions[:, 0] * along[1] - directions[:, 1] * along[0]
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (off[0] * along[1] - off[1] * along[0]) / cross
            share = (off[0] * directions[:, 1] - off[1] * directions[:, 0]) / cross
        hit = (distance > 0) & (share >= 0) & (share <= 1)
        nearest = np.where(hit, np.minimum(nearest, distance), nearest)
    return nearest


def laser(stamp: float, ranges: np.ndarray) -> dict[str, Any]:
    header = {"frame_id": "laser", "stamp": {"sec": int(stamp), "nanosec": round(stamp % 1 * 1e9)}}
    about = {"range_min": 0.0, "range_max": 20.0, "angle_min": -np.pi, "angle_increment": 2 * np.pi / N_BEAMS}
    return {"header": header, **about, "time_increment": 0.0, "ranges": ranges.astype(np.float32)}


DRIVE = [(1.5 + 0.1 * i, 1.5 + 0.03 * i, 0.05 * i) for i in range(12)]
PATH = DRIVE[:8]
FIRST = moved(*DRIVE[0][:2], yaw=DRIVE[0][2])


def live(tree: TransformTree, **options: Any) -> LiveScans:
    """Scans of a laser, whose poses odometry finds by default."""
    chosen = LiveOptions(**{"poses": "mixture", "max_latency": None, **options})
    return LiveScans(Sensor(Topic("/scan", "", 0), LASER), tree, Ranges(), chosen)


@pytest.fixture(scope="module")
def known() -> GaussianMap:
    made = GaussianMap()
    for x, y, yaw in [*PATH, (3.5, 2.5, 1.0)]:
        ranges = room(x, y, yaw)
        ends = np.stack([x + ranges * np.cos(ANGLES + yaw), y + ranges * np.sin(ANGLES + yaw)], 1)
        made.insert(Scan(torch.from_numpy(ends), torch.tensor([x, y], dtype=torch.float64)))
    return made


@pytest.fixture
def node(ros_options):
    with Node("test", **ros_options) as made:
        yield made


def test_poses_and_the_transform_to_odometry_are_published(node, known, monkeypatch):
    monkeypatch.setattr(live_scans, "SETTLING", 0.0)
    odom_in_map = moved(1.0, 0.5, yaw=0.3)
    scans = live(node.transforms, poses="tf", frame="odom")
    sent: dict[str, list[Any]] = {"pose": [], "/tf": [], "/diagnostics": []}
    monkeypatch.setattr(
        node, "publisher", lambda topic, _: lambda message, stamp=None: sent[topic].append(message)
    )
    localizer = LiveLocalizer(node, scans, known)
    for index, at in enumerate(PATH):
        in_odom = np.linalg.inv(odom_in_map) @ moved(*at[:2], yaw=at[2])
        message = transform_fields({("odom", "laser"): in_odom})
        message["transforms"][0]["header"]["stamp"] = {"sec": index, "nanosec": 0}
        node.transforms.add(message, static=False)
        scans.receive(laser(float(index), room(*at)), 0)
        assert localizer.step(0.0)
    assert (localizer.n_scans, localizer.n_lost) == (len(PATH), 0)
    for at, found in zip(PATH, localizer.poses, strict=True):
        assert np.allclose(found[:2, 2], at[:2], atol=0.05)
        assert float(torch.atan2(found[1, 0], found[0, 0])) == pytest.approx(at[2], abs=0.03)
    above = sent["/tf"][-1]["transforms"][0]
    assert (above["header"]["frame_id"], above["child_frame_id"]) == ("map", "odom")
    assert above["transform"]["translation"]["x"] == pytest.approx(1.0, abs=0.08)
    assert 2 * np.arctan2(*(above["transform"]["rotation"][a] for a in "zw")) == pytest.approx(0.3, abs=0.05)
    last = sent["pose"][-1]
    assert (last["header"]["frame_id"], last["child_frame_id"]) == ("map", "laser")
    covariance = np.array(last["pose"]["covariance"]).reshape(6, 6)
    assert (np.diag(covariance)[[0, 1, 5]] > 0).all()
    assert np.allclose(covariance[2:5], 0)
    assert node.types.encode("nav_msgs/msg/Odometry", last)


def test_scans_of_another_place_are_counted_as_lost(node, known, caplog):
    scans = live(node.transforms, poses="standing")
    localizer = LiveLocalizer(node, scans, known, has_motion=False)
    rng = np.random.default_rng(0)
    scans.receive(laser(0.0, rng.uniform(0.5, 15.0, N_BEAMS)), 0)
    assert localizer.step(0.0)
    assert (localizer.n_scans, localizer.n_lost, localizer.poses) == (1, 1, [])
    assert "1 of 1 scans were not found in the map" in caplog.text


def test_a_map_of_another_dimension_is_refused(node):
    built = GaussianMap()
    for scan in load("synthetic_building", n_scans=2):
        built.insert(scan)
    scans = live(node.transforms, poses="standing")
    localizer = LiveLocalizer(node, scans, built, has_motion=False)
    scans.receive(laser(0.0, room(*PATH[0])), 0)
    with pytest.raises(InvalidArgumentError, match="map in 3D, but topic /scan has scans in 2D"):
        localizer.step(0.0)


# -- odometry -------------------------------------------------------------------------------------


def is_near(found: np.ndarray, at: tuple[float, float, float]) -> bool:
    """Whether a pose in the frame of the first scan is that of the path, to 3 cm and 1.5°."""
    off = np.linalg.inv(FIRST @ found) @ moved(*at[:2], yaw=at[2])
    return bool(np.linalg.norm(off[:2, 3]) < 0.03 and abs(np.arctan2(off[1, 0], off[0, 0])) < 0.026)


def test_a_mapper_without_transforms_finds_and_publishes_the_poses(ros_domain, monkeypatch):
    sent: list[tuple[str, Any]] = []

    def publisher(topic: str, message_type: str, offered: Quality | None = None) -> Any:
        return lambda message, stamp=None: sent.append((topic, message))

    monkeypatch.setattr(publishers, "SETTLING", 0.0)
    with Node("test", domain=ros_domain) as node:
        monkeypatch.setattr(node, "publisher", publisher)
        mount = np.eye(4)
        mount[:3, 3] = 0.2, 0.0, 0.5  # base ← laser
        node.transforms.add(transform_fields({("base", "laser"): mount}), static=True)
        scans = live(node.transforms)
        mapper = LiveMapper(node, scans, GaussianMap())
        for index, at in enumerate(DRIVE):
            scans.receive(laser(index / 5, room(*at)), 0)
            assert mapper.step(0.0)
        mapper.finish()
    found = [np.eye(4) for _ in DRIVE]
    for matrix, stored in zip(found, mapper.builder.poses.numpy(), strict=True):
        matrix[:2, :2], matrix[:2, 3] = stored[:2, :2], stored[:2, 2]
    assert all(is_near(matrix, at) for matrix, at in zip(found, DRIVE, strict=True))
    last = [message for topic, message in sent if topic == "pose"][-1]
    assert (last["header"]["frame_id"], last["child_frame_id"]) == ("odom", "laser")
    assert last["pose"]["pose"]["position"]["x"] == pytest.approx(found[-1][0, 3])
    step = [message for topic, message in sent if topic == "/tf"][-1]["transforms"][0]
    assert (step["header"]["frame_id"], step["child_frame_id"]) == ("odom", "base")
    expected = found[-1] @ np.linalg.inv(mount)
    shift = [step["transform"]["translation"][axis] for axis in "xyz"]
    assert np.allclose(shift, expected[:3, 3])
    wall = 6.0 - DRIVE[0][0]  # ahead of the first pose
    near = mapper.builder.map.occupancy([[wall, 0.0], [wall - 1.0, 0.0]], 0.1)
    assert near[0] > 0.65
    assert near[1] < 0.35


def test_a_robot_that_another_node_moves_gets_no_second_transform(ros_domain, monkeypatch, caplog):
    topics: list[str] = []
    monkeypatch.setattr(publishers, "SETTLING", 0.0)
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
        scans.receive(laser(0.0, room(*DRIVE[0])), 0)
        assert mapper.step(0.0)
    assert "pose" in topics
    assert "/tf" not in topics
    assert "TF of another node moves base in wheels; only the topic pose is published" in caplog.text


def test_odometry_continues_in_the_map_of_an_earlier_run():
    earlier, built = live(TransformTree()), GaussianMap()
    for index, at in enumerate(DRIVE):
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
    for index, at in enumerate(DRIVE[6:]):
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
    for index, ranges in enumerate([room(*DRIVE[0]), rng.uniform(0.5, 15.0, 180), room(*DRIVE[1])]):
        scans.receive(laser(index / 5, ranges), 0)
        assert scans.advance() == (index != 1)
    assert len(scans) == 2
    assert scans.skipped == {"no pose was found by odometry": 1}
    assert "surfaces" in scans.trouble or "contradict" in scans.trouble


def test_an_unknown_way_to_find_poses_is_refused():
    with pytest.raises(InvalidArgumentError, match=r"poses='gps' .*tf, standing, kiss_icp, mixture"):
        LiveOptions(poses="gps")

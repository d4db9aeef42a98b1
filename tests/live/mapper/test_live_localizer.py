"""A sensor that is localised in a map: poses, transforms and lost scans."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("rosbags", reason="needs the extra [ros]: rosbags")

from gmmtorch.datasets import load
from gmmtorch.datasets.base import Ranges
from gmmtorch.datasets.ros.bag_reader import LASER, Topic
from gmmtorch.datasets.ros.bag_reader import Sensor as SensorTopic
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.live.mapper import live_scans
from gmmtorch.live.mapper.live_localizer import LiveLocalizer
from gmmtorch.live.mapper.live_scans import LiveOptions, LiveScans
from gmmtorch.live.ros import Node
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.scan import Scan

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


def pose(x: float, y: float, yaw: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    matrix[:2, 3] = x, y
    return matrix


PATH = [(1.5 + 0.1 * i, 1.5 + 0.03 * i, 0.05 * i) for i in range(8)]


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
    odom_in_map = pose(1.0, 0.5, 0.3)
    sensor = SensorTopic(Topic("/scan", "", 0), LASER)
    scans = LiveScans(sensor, node.transforms, Ranges(), LiveOptions(frame="odom", max_latency=None))
    sent: dict[str, list[Any]] = {"pose": [], "/tf": [], "/diagnostics": []}
    monkeypatch.setattr(
        node, "publisher", lambda topic, _: lambda message, stamp=None: sent[topic].append(message)
    )
    localizer = LiveLocalizer(node, scans, known)
    from gmmtorch.export.message_fields import transform_fields

    for index, at in enumerate(PATH):
        in_odom = np.linalg.inv(odom_in_map) @ pose(*at)
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
    sensor = SensorTopic(Topic("/scan", "", 0), LASER)
    scans = LiveScans(sensor, node.transforms, Ranges(), LiveOptions(poses="standing", max_latency=None))
    localizer = LiveLocalizer(node, scans, known, has_motion=False)
    rng = np.random.default_rng(0)
    scans.receive(laser(0.0, rng.uniform(0.5, 15.0, N_BEAMS)), 0)
    assert localizer.step(0.0)
    assert (localizer.n_scans, localizer.n_lost, localizer.poses) == (1, 1, [])
    assert "1 of 1 scans were not found in the map" in caplog.text


def test_a_map_of_another_dimension_is_refused(node):
    dataset = load("synthetic_building", n_scans=2)
    built = GaussianMap()
    for scan in dataset:
        built.insert(scan)
    sensor = SensorTopic(Topic("/scan", "", 0), LASER)
    scans = LiveScans(sensor, node.transforms, Ranges(), LiveOptions(poses="standing", max_latency=None))
    localizer = LiveLocalizer(node, scans, built, has_motion=False)
    scans.receive(laser(0.0, room(*PATH[0])), 0)
    with pytest.raises(InvalidArgumentError, match="map in 3D, but topic /scan has scans in 2D"):
        localizer.step(0.0)

"""A live mapper: the map of a recording that is played to it, what it publishes, and its continuation."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("rosbags", reason="needs the extra [ros]: rosbags")

from test_live_scans import laser, recorded

from gmmtorch.datasets import CLOUD, LASER, Ranges, Sensor, Topic, TransformTree, load
from gmmtorch.errors import GmmTorchError, InvalidArgumentError, told
from gmmtorch.live import BagPlayer, LiveMapper, LiveScans, MapPublisher, Node, find_sensor, open_scans
from gmmtorch.live.live_scans import LiveOptions
from gmmtorch.live.publishers import Diagnostics
from gmmtorch.live.ros import Quality
from gmmtorch.live.ros.topics import LATCHED
from gmmtorch.mapping import Attributes, GaussianMap, MapBuilder, Numbers
from gmmtorch.scan import Scan
from gmmtorch.team.sharing import Network, Replica, SharedMap

LASER_TYPE, GRID = "sensor_msgs/msg/LaserScan", "nav_msgs/msg/OccupancyGrid"


@pytest.fixture
def node(ros_options: dict[str, Any]) -> Callable[..., Node]:
    """Makes nodes that hear each other, and no other process."""
    return lambda name="test", **options: Node(name, **ros_options, **options)


def test_a_played_recording_gives_the_map_of_the_recording(node, tmp_path):
    path = recorded(tmp_path / "a.bag", LASER)
    expected = MapBuilder(load("rosbag", path), GaussianMap())
    for _ in expected.insert_all():
        pass
    expected.finish()
    with node("player") as talker, node("mapper", use_sim_time=True) as listener, node("user") as user:
        grids: list[dict[str, Any]] = []
        user.subscribe("/map", GRID, grids.append, LATCHED)
        player = BagPlayer(talker, path, rate=2.0)

        def play() -> None:
            player.wait_for_subscriber(30.0)
            for _ in player.play():
                pass

        played = threading.Thread(target=play)
        played.start()
        sensor = find_sensor(listener, None, 30.0)
        scans = open_scans(listener, sensor, Ranges(), LiveOptions(max_latency=None))
        mapper = LiveMapper(listener, scans, GaussianMap(), MapPublisher(listener, 0.2), period=0.1)
        while played.is_alive() or mapper.step():
            mapper.step()
        mapper.finish()
        while user.spin_once(2.0):
            pass
        numbers = mapper.diagnostics.numbers(len(scans), 0)
    assert player.n_played == player.n_messages
    assert torch.equal(mapper.builder.map.components().means, expected.map.components().means)
    assert torch.equal(mapper.builder.times, expected.times)
    assert (numbers["n_dropped"], numbers["n_malformed"], numbers["n_scans"]) == (0, 0, len(expected.poses))
    assert grids[-1]["header"]["frame_id"] == "odom"
    assert {0, 100} <= set(grids[-1]["data"].tolist()) <= {-1, 0, 100}


def pillar(x: float) -> GaussianMap:
    scan_points = torch.tensor([[x, y / 10] for y in range(-10, 10)], dtype=torch.float64)
    made = GaussianMap()
    made.insert(Scan(scan_points, torch.zeros(2, dtype=torch.float64)))
    return made


class Recorder:
    """A node that keeps what is published."""

    def __init__(self) -> None:
        self.sent: list[tuple[str, Any]] = []
        self.counts: dict[str, Any] = {}

    def publisher(self, topic: str, message_type: str, offered: Quality | None = None) -> Any:
        return lambda message, stamp=None: self.sent.append((topic, message))

    def warn(self, kind: str, text: str) -> None:
        self.sent.append(("warning", text))

    def take(self, topic: str) -> list[Any]:
        return [message for name, message in self.sent if name == topic]


@pytest.mark.parametrize("shown", ["cells", "means"])
def test_a_cloud_of_a_coloured_map_has_packed_colours(shown):
    user: Any = Recorder()
    found = pillar(3.0).components()
    shade = torch.tensor([1.0, 0.0, 0.21404114]).double()  # linear: sRGB 255, 0, 127.5
    none = torch.zeros(len(found), 3, 3).double()
    share = torch.ones(len(found)).double()
    known = Numbers(share, shade.expand(len(found), 3).contiguous(), none[:, :, : found.dim], none)
    made = GaussianMap.of(replace(found, attributes=Attributes({"colour": known})))
    MapPublisher(user, 0.2, cloud=shown).publish(made, "map", 5)
    (cloud,) = user.take("cloud")
    names = [field["name"] for field in cloud["fields"]]
    assert names == ["x", "y", "z", "rgb"]
    rows = np.frombuffer(np.asarray(cloud["data"], np.uint8).tobytes(), "<u4").reshape(-1, 4)
    assert len(rows) > 0
    assert set(rows[:, 3].tolist()) <= {0xFF007F, 0xFF0080}


def test_the_grid_has_the_layout_of_ros_and_updates_where_it_changed():
    user: Any = Recorder()
    publisher = MapPublisher(user, 0.2, cloud="means")
    first = pillar(3.0)
    publisher.publish(first, "map", 5)
    (grid,) = user.take("map")
    width, height = grid["info"]["width"], grid["info"]["height"]
    cells = np.array(grid["data"]).reshape(height, width)
    origin = grid["info"]["origin"]["position"]
    for (row, column), value in np.ndenumerate(cells):
        at = torch.tensor([[origin["x"] + 0.2 * (column + 0.5), origin["y"] + 0.2 * (row + 0.5)]]).double()
        theta = float(first.occupancy(at, 0.2)[0])
        assert value == (100 if theta > 0.65 else 0 if theta < 0.196 else -1)
    assert len(user.take("cloud")) == 1
    markers = user.take("ellipsoids")[0]["markers"]
    assert markers[0]["action"] == 3
    assert len(markers) == 1 + int((~first.components().max_range).sum())
    assert publisher._last is not None
    last, changed = publisher._last[0], publisher._last[1].copy()
    changed[1:3, 2] = 100 - changed[1:3, 2].clip(0)
    publisher._publish_grid(last, changed, {}, 6)
    (update,) = user.take("map_updates")
    assert (update["x"], update["y"], update["width"], update["height"]) == (2, 1, 1, 2)
    assert np.array_equal(update["data"], changed[1:3, 2])
    publisher._publish_grid(last, changed, {}, 7)
    assert len(user.take("map_updates")) == 1  # nothing has changed


@pytest.mark.parametrize("kind", [LASER, CLOUD])
def test_the_grid_of_a_growing_map_is_that_of_all_its_components(tmp_path, kind):
    user: Any = Recorder()
    publisher, target = MapPublisher(user, 0.1, cloud="none", ellipsoids=False), GaussianMap(window=2)
    for index, scan in enumerate(load("rosbag", recorded(tmp_path / "a.bag", kind))):
        target.insert(scan)
        if index % (4 if kind == LASER else 8):
            continue
        publisher.publish(GaussianMap.of(target.components()), "map", 0)
        alone = MapPublisher(Recorder(), 0.1, cloud="none", ellipsoids=False)  # type: ignore[arg-type]
        alone.publish(GaussianMap.of(target.components()), "map", 0)
        assert publisher._last is not None
        assert alone._last is not None
        assert publisher._last[0] == alone._last[0]
        assert np.array_equal(publisher._last[1], alone._last[1])
        band, theta = publisher._probabilities(target)
        assert band is not None
        expected = torch.as_tensor(target.occupancy(publisher._evidence.centers(band), 0.1))
        torch.testing.assert_close(theta.flatten(), expected, rtol=1e-12, atol=1e-12)


def test_a_killed_mapper_continues_after_its_checkpoint(node, tmp_path):
    file, run = tmp_path / "checkpoint", {"seed": 0}
    with node() as user:
        sensor_topic = user.publisher("/scan", LASER_TYPE)
        assert sensor_topic is not None
        sensor = find_sensor(user, "/scan", 10.0)

        def mapper() -> LiveMapper:
            scans = open_scans(user, sensor, Ranges(), LiveOptions(poses="standing", max_latency=None))
            return LiveMapper(user, scans, GaussianMap())

        first = mapper()
        for index in range(3):
            first._scans.receive(laser(float(index)), 0)
            assert first.step(0.0)
        first.builder.save(file, run)
        second = mapper()
        second.builder.load(file, run)
        second._scans.receive(laser(9.0), 0)
        assert second.step(0.0)
        second.finish()
        first._scans.receive(laser(9.0), 0)
        assert first.step(0.0)
        first.finish()
    assert second.builder.record.n_read == first.builder.record.n_read == 4
    found, expected = second.builder.map.components(), first.builder.map.components()
    assert torch.equal(found.means, expected.means)
    assert second.builder.times.tolist() == [0, 1, 2, 3]  # the stamps before are not in the checkpoint


def test_a_mapper_publishes_the_map_of_its_team(node):
    network = Network(2)
    teammate = SharedMap(Replica(1), network)
    user: Any = Recorder()
    with node() as listener:
        listener.publisher("/scan", LASER_TYPE)
        sensor = find_sensor(listener, "/scan", 10.0)
        scans = open_scans(listener, sensor, Ranges(), LiveOptions(poses="standing", max_latency=None))
        publisher, target = MapPublisher(user, 0.2), GaussianMap(window=1)
        shared = SharedMap(Replica(0), network)
        mapper = LiveMapper(listener, scans, target, publisher, 0.0, shared=shared)
        scans.receive(laser(0.0), 0)
        assert mapper.step(0.0)
        while not user.take("map"):
            mapper.step(0.01)
        alone = len(mapper.snapshot().components())
        assert alone == len(target.components()) > 0
        teammate.replica.publish(pillar(-30.0).components(), whole=True)
        n_published = len(user.take("map"))
        while len(user.take("map")) == n_published:  # no scan arrives
            teammate.exchange(time.monotonic())
            mapper.step(0.01)
        mapper.finish()
        shown, origin = mapper.snapshot(), user.take("map")[-1]["info"]["origin"]["position"]
    teammate.exchange(time.monotonic())
    assert set(shown.components().ids[:, 0].tolist()) == {0, 1}
    assert len(shown.components()) == alone + len(pillar(-30.0).components())
    assert origin["x"] < -30
    assert teammate.replica.digest() == shared.replica.digest()


def test_missing_wrong_and_several_topics_are_errors_that_list_the_topics(node):
    with node() as user:
        with pytest.raises(GmmTorchError, match=r"no topic /points after .* Published topics: none"):
            find_sensor(user, "/points", 0.1)
        user.publisher("/text", "std_msgs/msg/String")
        user.publisher("/camera/image", "sensor_msgs/msg/Image")
        with pytest.raises(
            GmmTorchError, match=r"no topic of a range sensor .*/text \(std_msgs/msg/String\)"
        ):
            find_sensor(user, None, 1.0)
        with pytest.raises(InvalidArgumentError, match="has messages of type std_msgs/msg/String"):
            find_sensor(user, "/text", 0.1)
        user.publisher("/a", LASER_TYPE)
        user.publisher("/b", LASER_TYPE)
        with pytest.raises(InvalidArgumentError, match=r"topic=/a"):
            find_sensor(user, None, 1.0)


def test_stamps_of_another_clock_are_said_and_do_not_count_as_latency():
    user: Any = Recorder()
    scans = LiveScans(Sensor(Topic("/scan", LASER_TYPE, 0), LASER), TransformTree(), Ranges(), LiveOptions())
    diagnostics = Diagnostics(user, scans)
    for seconds in (0.5, -1.7e9, 3600.0, 0.7):
        diagnostics.note_latency(seconds)
    options = {"use_sim_time": "node.use_sim_time", "clock": "sensor.clock"}
    warnings = [told(text, options) for text in user.take("warning")]
    assert len(warnings) == 2
    assert all("node.use_sim_time=true" in text and "sensor.clock=received" in text for text in warnings)
    assert "3600 s away" in warnings[1]
    assert diagnostics.numbers(4, 0)["latency_median"] == pytest.approx(0.6)


def test_scans_that_wait_are_said_before_any_is_dropped():
    user: Any = Recorder()
    sensor, options = Sensor(Topic("/scan", LASER_TYPE, 0), LASER), LiveOptions(max_latency=None)
    scans = LiveScans(sensor, TransformTree(), Ranges(), options)
    diagnostics = Diagnostics(user, scans)
    diagnostics.publish(0, 0, 0)
    assert user.take("warning") == []
    for number in range(30):
        scans.receive(laser(float(number)), 0)
    diagnostics.publish(0, 0, 0)
    assert user.take("warning") == ["30 scans wait: gmmtorch mapping is slower than the sensor."]


def test_a_rate_of_zero_is_refused(node, tmp_path):
    path: Path = recorded(tmp_path / "a.mcap", LASER)
    with node() as user, pytest.raises(InvalidArgumentError, match="rate"):
        BagPlayer(user, path, rate=0.0)

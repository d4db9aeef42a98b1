"""Scans of live topics: those of a recording to the bit, and what is dropped or left out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("rosbags", reason="needs the extra [ros]: rosbags")

from sensor_bags import BagWriter, moved

from gmmtorch.datasets import CLOUD, DEPTH, LASER, BagReader, Ranges, Sensor, Topic, TransformTree, load
from gmmtorch.errors import told
from gmmtorch.live import live_scans
from gmmtorch.live.live_scans import DROPPED, LiveOptions, LiveScans

KINDS = {LASER: "/scan", CLOUD: "/points", DEPTH: "/camera/depth"}


class Clock:
    """The clock of the machine, which a test sets."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def monotonic(self) -> float:
        return self.seconds


@pytest.fixture
def clock(monkeypatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(live_scans, "time", made)
    return made


def recorded(path: Path, kind: str) -> Path:
    """A drive of three seconds with a turn, TF at 20 Hz, and a sensor at 5 Hz with times of its points."""
    rng = np.random.default_rng(0)
    with BagWriter(path) as bag:
        bag.transforms(0.0, {("base", "sensor"): np.eye(4)}, static=True)
        for tick in range(61):
            time = tick / 20
            bag.transforms(time, {("odom", "base"): moved(time, yaw=time / 2)})
            if tick % 4 == 1:
                stamp = time - 0.013
                if kind == LASER:
                    bag.laser("/scan", stamp, "sensor", rng.uniform(1, 5, 90), -1, 0.02, 6.0, 0.0005)
                elif kind == CLOUD:
                    offsets = np.linspace(0, 0.09, 200)
                    bag.cloud("/points", stamp, "sensor", rng.normal(0, 3, (200, 3)), offsets)
                else:
                    image = rng.integers(500, 4000, (8, 10))
                    bag.depth("/camera/depth", stamp, "sensor", image, [[9, 0, 5], [0, 9, 4], [0, 0, 1]])
    return path


def live(kind: str = LASER, **options: Any) -> tuple[LiveScans, TransformTree]:
    tree = TransformTree(keep=30.0)
    sensor = Sensor(Topic(KINDS[kind], "", 0), kind)
    return LiveScans(sensor, tree, Ranges(), LiveOptions(**options)), tree


def feed(path: Path, scans: LiveScans, tree: TransformTree, clock: Clock) -> list[tuple[Any, torch.Tensor]]:
    """Gives the messages of a bag to live scans at their times; returns scans and poses."""
    reader, found = BagReader(path), []

    def take(is_last: bool = False) -> None:
        while scans.advance(is_last):
            found.append((scans[-1], scans.pose(-1)))

    for message in reader.messages({topic.name for topic in reader.topics}):
        clock.seconds = message.time / 1e9
        content = reader.decode(message)
        if "transforms" in content:
            tree.add(content, message.topic == "/tf_static")
        elif "ranges" in content or "data" in content:
            scans.receive(content, message.time)
        else:
            scans.note_camera(content)
        take()
    take(is_last=True)
    return found


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("suffix", ["mcap", "bag"])
def test_live_scans_equal_those_of_the_recording_to_the_bit(tmp_path, clock, kind, suffix):
    path = recorded(tmp_path / f"a.{suffix}", kind)
    whole = load("rosbag", path)
    scans, tree = live(kind)
    found = feed(path, scans, tree, clock)
    assert len(found) == len(whole) > 10
    assert scans.skipped == whole.skipped
    assert torch.equal(scans.times, whole.times)
    for index, (scan, placed) in enumerate(found):
        assert torch.equal(scan.points, whole[index].points)
        assert torch.equal(scan.origin, whole[index].origin)
        assert torch.equal(placed, whole.pose(index))
    assert scans.world_frame == "odom"


@pytest.mark.parametrize("form", ["s after the stamp", "s of another clock", "shares of the sweep"])
def test_points_with_wrong_times_are_dropped_and_counted_as_in_the_recording(tmp_path, clock, form):
    rng = np.random.default_rng(0)
    with BagWriter(tmp_path / "a.mcap") as bag:
        for tick in range(61):
            bag.transforms(tick / 20, {("odom", "sensor"): moved(tick / 20, yaw=tick / 40)})
            if 0 < tick < 58 and tick % 2:
                table = np.zeros(200, [*((axis, "<f4") for axis in "xyz"), ("time", "<f8")])
                table["x"], table["y"], table["z"] = rng.normal(0, 3, (3, 200))
                table["time"] = np.linspace(0, 1.0 if form == "shares of the sweep" else 0.1, 200)
                table["time"] += (form == "s of another clock") * tick / 20
                table["time"][rng.integers(1, 200)] += rng.choice([-1e9, 3, np.nan])
                bag.cloud_table("/points", tick / 20, "sensor", table)
    whole = load("rosbag", tmp_path / "a.mcap")
    scans, tree = live(CLOUD)
    found = feed(tmp_path / "a.mcap", scans, tree, clock)
    assert len(found) == len(whole) == 29
    for (scan, _), expected in zip(found, whole, strict=True):
        assert torch.equal(scan.points, expected.points)
        assert len(scan.points) == 199
    assert scans.skipped == whole.skipped == {"points dropped: their times do not fit into the sweep": 29}


def laser(stamp: float) -> dict[str, Any]:
    seconds = int(stamp)
    header = {"frame_id": "sensor", "stamp": {"sec": seconds, "nanosec": round((stamp - seconds) * 1e9)}}
    about = {
        "range_min": 0.0,
        "range_max": 9.0,
        "angle_min": 0.0,
        "angle_increment": 0.1,
        "angle_max": 0.4,
        "scan_time": 0.0,
    }
    return {"header": header, **about, "time_increment": 0.0, "ranges": np.full(5, 2.0, np.float32)}


def test_late_scans_are_dropped_oldest_first_and_counted(clock):
    scans, _ = live(poses="standing", max_latency=1.0)
    for index in range(5):
        clock.seconds = index / 10
        scans.receive(laser(index / 10), 0)
    clock.seconds = 1.25  # the first three wait for more than a second
    taken = []
    while scans.advance():
        assert scans.newest is not None
        taken.append(scans.newest.stamp)
    assert taken == [300_000_000, 400_000_000]
    assert scans.skipped == {DROPPED: 3}
    assert scans.n_dropped == 3


def test_without_a_limit_nothing_is_dropped(clock):
    scans, _ = live(poses="standing", max_latency=None)
    for index in range(5):
        scans.receive(laser(index / 10), 0)
    clock.seconds = 1e6
    assert sum(1 for _ in iter(scans.advance, False)) == 5


def test_transforms_that_never_come_are_explained(clock):
    scans, tree = live(max_latency=1.0)
    scans.receive(laser(5.0), 0)
    assert not scans.advance()
    assert "TF has no frame sensor" in scans.trouble
    static = {"header": {"frame_id": "base", "stamp": {"sec": 0, "nanosec": 0}}, "child_frame_id": "sensor"}
    origin = {"translation": dict.fromkeys("xyz", 0.0), "rotation": {"x": 0, "y": 0, "z": 0, "w": 1.0}}
    tree.add({"transforms": [{**static, "transform": origin}]}, static=True)
    assert not scans.advance()
    assert "only static transforms" in scans.trouble
    clock.seconds = 1.5
    assert not scans.advance()
    assert scans.skipped == {"no pose at the time of the scan": 1}


def test_a_clock_that_runs_backwards_is_left_out_and_one_that_is_set_back_starts_again(clock):
    scans, _ = live(poses="standing")
    for stamp in (100.0, 99.0, 101.0, 5.0, 6.0):
        scans.receive(laser(stamp), 0)
    assert sum(1 for _ in iter(scans.advance, False)) == 4
    assert scans.skipped == {"stamp out of order": 1}


def test_messages_that_cannot_be_used_are_counted(clock):
    scans, _ = live(CLOUD, poses="standing")
    header = laser(1.0)["header"]
    broken = {"header": header, "width": 9, "height": 1, "point_step": 12, "data": np.zeros(3, np.uint8)}
    scans.receive({**broken, "is_bigendian": False, "fields": []}, 0)
    scans.receive({**broken, "width": 0, "is_bigendian": False, "fields": []}, 0)
    assert not scans.advance()
    assert scans.skipped == {"message that cannot be decoded": 1, "message without a valid point": 1}


def test_memory_of_waiting_messages_is_bounded(clock, monkeypatch):
    monkeypatch.setattr(live_scans, "_WAITING_BYTES", 100)
    scans, _ = live(max_latency=None)
    for index in range(50):
        scans.receive(laser(float(index)), 0)
    assert (scans.n_waiting, scans.n_dropped) == (5, 45)


def test_a_camera_of_another_size_is_scaled_to_the_image_and_can_change(clock):
    """The same function reads the camera info of recordings."""
    scans, _ = live(DEPTH, poses="standing", depth_scale=0.01)
    header = {"stamp": {"sec": 1, "nanosec": 0}, "frame_id": ""}
    pixels = np.full((8, 10), 150, np.uint16).view(np.uint8).ravel()
    image = {"header": header, "height": 8, "width": 10, "encoding": "16UC1", "is_bigendian": 0, "step": 20}
    whole = {"d": np.zeros(5), "distortion_model": "", "p": np.zeros(12), "binning_x": 0, "binning_y": 0}
    whole |= {"roi": dict.fromkeys(("x_offset", "y_offset", "width", "height"), 0), "header": header}
    for factor, size in ((2, (20, 16)), (1, (10, 8)), (1, (11, 8))):
        k = np.array([9.0 * factor, 0, 5 * factor, 0, 9 * factor, 4 * factor, 0, 0, 1])
        scans.note_camera({**whole, "width": size[0], "height": size[1], "k": k})
        scans.receive({**image, "data": pixels}, 0)
        if scans.advance():
            assert scans[-1].points[0].tolist() == pytest.approx([-5 / 9 * 1.5, -4 / 9 * 1.5, 1.5])
    assert len(scans) == 2
    assert "the image has 10×8 pixels. State the images' own: intrinsics=" in told(scans.trouble)


def test_messages_without_a_frame_have_the_one_that_is_stated(clock):
    for options in ({}, {"sensor_frame": "base"}):
        scans, tree = live(LASER, **options)
        for time in (0, 2):
            stamp = {"sec": time, "nanosec": 0}
            entry = {"header": {"frame_id": "odom", "stamp": stamp}, "child_frame_id": "base"}
            entry["transform"] = {
                "translation": dict.fromkeys("xyz", float(time)),
                "rotation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
            }
            tree.add({"transforms": [entry]}, static=False)
        message = laser(1.0)
        scans.receive({**message, "header": {**message["header"], "frame_id": ""}}, 0)
        scans.advance()
        clock.seconds += 1.0
        assert scans.advance() == bool(options)
        if not options:
            assert "sensor_frame=NAME" in told(scans.trouble)

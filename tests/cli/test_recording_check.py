"""gmmtorch-map check=true: what it says of recordings, and that its advice is right."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from command_runs import QUIET, Finished, run_here

pytest.importorskip("rosbags")

from sensor_bags import BagWriter, moved

from gmmtorch.cli.reporting import recording_check
from gmmtorch.errors import DataError
from gmmtorch.export.bag import cloud_fields

Run = Callable[..., Finished]
RING = np.stack(
    [4 * np.cos(np.arange(0, 6.2, 0.1)), 3 * np.sin(np.arange(0, 6.2, 0.1)), np.arange(62) / 60], 1
)


@pytest.fixture
def check(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    def run(path: Path, *options: str) -> Finished:
        given = [f"dataset.path={path}", "check=true", *QUIET, *options]
        return run_here(monkeypatch, "map", tmp_path / "run", *given)

    return run


def words(done: Finished) -> str:
    return " ".join(done.stdout.split())


def bag(
    path: Path, sensor_delay: float = 0.0, scale: float = 1.0, odometry: str = "tf", gap: int = 0
) -> Path:
    """A drive of 20 clouds, whose stamps may be those of another clock, with poses every 0.05 s."""
    with BagWriter(path) as writer:
        for i in range(120):
            if odometry == "tf":
                writer.transforms(i * 0.05, {("odom", "lidar"): moved(i * 0.05)})
            elif odometry:
                writer.odometry(odometry, i * 0.05, "odom", "lidar", moved(i * 0.05))
        for i in range(20):
            time = i * 0.1 + (3.0 if 0 < gap <= i else 0.0)
            table = np.ascontiguousarray(RING * scale, "<f4").view([(axis, "<f4") for axis in "xyz"])[:, 0]
            fields = cloud_fields("lidar", table)
            writer.message("/points", "sensor_msgs/msg/PointCloud2", time - sensor_delay, fields, time)
    return path


def test_a_good_bag_has_a_table_and_no_advice(check, tmp_path):
    done = check(bag(tmp_path / "a.mcap"), "dataset=rosbag")
    assert done.status == 0
    assert re.search(r"/points +sensor_msgs/PointCloud2 +20 +10 +0.1 .* scans \(cloud\)", done.stdout)
    assert re.search(r"/tf +tf2_msgs/TFMessage +120 +20 +0.05 .* poses \(TF\)", done.stdout)
    assert "scans 20 would be read of /points, in 3D at 10.0 a second" in words(done)
    assert "62 points in a scan" in done.stdout
    assert "path of 1.9 m, at most 1.0 m/s" in done.stdout
    assert "1. nothing looks wrong" in done.stdout
    assert not list(done.folder.glob("*.safetensors"))


@pytest.mark.parametrize(
    ("options", "advice"),
    [
        ({"odometry": "/odom"}, "dataset.poses=/odom, which reads 20 scans"),
        ({"odometry": ""}, "dataset.odometry=auto, which reads 20 scans with poses estimated from the scans"),
        ({"sensor_delay": 5000.0}, "dataset.clock=received, which reads 20 scans"),
    ],
)
def test_its_advice_reads_the_recording(check, tmp_path, options, advice):
    path = bag(tmp_path / "a.mcap", **options)
    refused = check(path, "dataset=rosbag")
    assert refused.status == 1
    assert "problem" in refused.stdout
    assert advice in words(refused)
    helped = check(path, "dataset=rosbag", advice.split(",")[0])
    assert helped.status == 0
    assert "20 would be read" in helped.stdout


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"scale": 1000.0}, "is the unit metres?"),
        ({"gap": 10}, "no scan for 3.1 s from 0.9 s on"),
        ({"sensor_delay": 0.7}, "are 0.7 s apart: their clocks differ"),
    ],
)
def test_what_looks_wrong_is_said(check, tmp_path, options, text):
    assert text in words(check(bag(tmp_path / "a.bag", **options), "dataset=rosbag", "dataset.max_gap=9"))


def two_lidars(path: Path, n_late: int = 0) -> Path:
    """A drive of 20 clouds of each of two lidars, of which the last have no poses."""
    with BagWriter(path) as writer:
        mounts = {("base", "front"): moved(1.0), ("base", "rear"): moved(-1.0)}
        writer.transforms(0.0, mounts, static=True)
        for i in range(21 - n_late):
            writer.transforms(i * 0.1, {("odom", "base"): moved(i * 0.1)})
        for i in range(20):
            writer.cloud("/front", i * 0.1, "front", RING)
            writer.cloud("/rear", i * 0.1 + 0.05, "rear", RING)
    return path


def test_several_lidars_are_merged_on_advice(check, tmp_path):
    path = two_lidars(tmp_path / "a.mcap")
    refused = check(path, "dataset=rosbag")
    assert refused.status == 1
    assert "add 'dataset.topic=[/front,/rear]', which reads 40 scans" in words(refused)
    assert "no map can be built with these options" in words(refused)
    done = check(path, "dataset=rosbag", "dataset.topic=[/front,/rear]")
    assert done.status == 0
    assert "40 would be read of /front, /rear, merged in the order of their times" in words(done)
    assert "path of 1.9 m, at most 1.0 m/s" in words(done)
    one = check(path, "dataset=rosbag", "dataset.topic=/front")
    assert "/rear would not be read" in words(one)


def test_scans_without_a_pose_are_counted(check, tmp_path):
    done = check(two_lidars(tmp_path / "a.mcap", n_late=6), "dataset=rosbag", "dataset.topic=/front")
    assert "poses for 15 of 20 scans" in words(done)
    assert "5 scans: no pose at the time of the scan" in words(done)


def test_messages_that_cannot_be_read_are_said_before_anything_else(check, tmp_path, monkeypatch):
    def fail(reader: object) -> None:
        raise DataError("no message can be read")

    monkeypatch.setattr(recording_check, "bag_facts", fail)
    done = check(bag(tmp_path / "a.bag"), "dataset=rosbag", "dataset.topic=/none")
    assert done.stdout.index("the messages cannot be read: no message") < done.stdout.index("problem")


def test_damage_and_files_that_are_no_bags(check, tmp_path):
    path = bag(tmp_path / "a.db3")
    path.write_bytes(path.read_bytes()[:-12_288])
    done = check(path, "dataset=rosbag")
    assert re.search(r"damage +\d+ messages in .* s are intact", done.stdout)
    path.write_bytes(b"nothing" * 100)
    done = check(path, "dataset=rosbag")
    assert done.status == 1
    assert "cannot be read as a ROS bag" in words(done)
    assert "no option that was tried helps" in done.stdout


def test_folders_of_scans(check, tmp_path):
    (tmp_path / "scans").mkdir()
    done = check(tmp_path, "dataset=scan_folder")
    assert done.status == 1
    assert "contains no .pcd" in words(done)
    for i in range(3):
        rows = "\n".join(" ".join(map(str, point)) for point in RING)
        header = "ply\nformat ascii 1.0\nelement vertex 62\n"
        header += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
        (tmp_path / "scans" / f"{i}.ply").write_text(f"{header}{rows}\n")
    (tmp_path / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 3)
    done = check(tmp_path, "dataset=scan_folder")
    assert done.status == 0
    assert "the sensor stands still" in words(done)


def test_names_cannot_control_the_terminal(check, tmp_path):
    """Those of topics, frames and files, in the table, the error and the log."""
    evil = "\x1b]0;owned\x07\x1b[31m"
    path = tmp_path / f"a{evil}.mcap"
    with BagWriter(path) as writer:
        for i in range(9):
            writer.transforms(i * 0.1, {(f"odom{evil}", f"lidar{evil}"): moved(i * 0.1)})
            table = np.ascontiguousarray(RING, "<f4").view([(axis, "<f4") for axis in "xyz"])[:, 0]
            fields = cloud_fields(f"odom{evil}", table)
            writer.message(f"/points{evil}", "sensor_msgs/msg/PointCloud2", i * 0.1, fields)
    for options in (["dataset.topic=/none"], []):
        done = check(f"'{path}'", "dataset=rosbag", *options)
        assert "owned" in done.stdout
        assert "\x1b" not in done.stdout + done.stderr
    log = (done.folder / "map.log").read_text()
    assert "points are in the fixed frame" in log
    assert "\x1b" not in log


def test_options_that_read_only_empty_scans_are_no_advice(check, tmp_path):
    with BagWriter(tmp_path / "a.mcap") as writer:
        for i in range(3):
            writer.cloud("/points", i * 0.1, "lidar", np.zeros((0, 3)))
    done = check(tmp_path / "a.mcap", "dataset=rosbag")
    assert done.status == 1
    assert "no option that was tried helps" in words(done)
    done = check(tmp_path / "a.mcap", "dataset=rosbag", "dataset.poses=standing")
    assert done.status == 1
    assert "1. no points in 3 scans: the map would be empty" in words(done)
    assert "problem" not in words(done)


def test_a_problem_that_no_option_mends_is_said_once(check, tmp_path):
    with BagWriter(tmp_path / "a.mcap") as writer:
        writer.transforms(0.0, {("odom", "lidar"): moved(0.0)})
    said = words(check(tmp_path / "a.mcap", "dataset=rosbag"))
    assert said.count("no topic of a range sensor") == 1
    assert "no option that was tried helps" in said


def test_the_missing_metadata_of_a_lidar_are_named(check, tmp_path):
    pytest.importorskip("dpkt")
    from datasets.packet_files import ouster_metadata, ouster_packet, write_capture

    ranges = np.full((2, 16, 32), 5000)
    packets = [
        (frame / 10 + k / 80, ouster_packet("LEGACY", frame, 16 * k, ranges, 9, 10**8 * frame, 10**6))
        for frame in range(4)
        for k in range(8)
    ]
    path = write_capture(tmp_path / "a.pcap", packets, 7502)
    done = check(path, "dataset=rosbag")
    assert done.status == 1
    assert "/192.168.1.201/7502 lidar_packets/Datagram 32 10 0.1 0 scans (lidar packets)" in words(done)
    assert "give the file (.json) that was recorded with it, dataset.calibration=FILE" in words(done)
    (tmp_path / "a.json").write_text(ouster_metadata("LEGACY", 32, 128))
    assert "dataset.odometry=auto, which reads 4 scans" in words(check(path, "dataset=rosbag"))
    done = check(path, "dataset=rosbag", "dataset.poses=standing")
    assert done.status == 0
    assert "4 would be read of /192.168.1.201/7502" in words(done)

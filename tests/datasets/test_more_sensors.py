"""Older and rawer recordings: lasers with echoes, PointCloud, packets of Velodyne lidars, and E57."""

from __future__ import annotations

import math
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from test_rosbag import drive

from gmmtorch.datasets import load
from gmmtorch.errors import DataError

pytest.importorskip("rosbags")

from sensor_bags import BagWriter

BAGS = pytest.mark.parametrize("suffix", ["mcap", "db3", "bag"])


@BAGS
def test_the_nearest_echo_of_a_beam_is_read(tmp_path, suffix):
    echoes = [[2.0, 3.0], [], [5.0, 4.0], [0.0], [float("nan"), 6.0], [float("inf")]]
    with BagWriter(tmp_path / f"a.{suffix}") as bag:
        drive(bag)
        fields = {
            "header": {"frame_id": "lidar"},
            "angle_min": 0.0,
            "angle_max": 0.5,
            "angle_increment": 0.1,
            "range_max": 20.0,
            "ranges": [{"echoes": np.array(beam, np.float32)} for beam in echoes],
        }
        bag.message("/echoes", "sensor_msgs/msg/MultiEchoLaserScan", 1.0, fields)
    scan = load("rosbag", tmp_path / f"a.{suffix}", no_return_range=8.0)[0]
    expected = [(r * math.cos(a) + 1.0, r * math.sin(a)) for r, a in ((2, 0), (4, 0.2), (6, 0.4))]
    np.testing.assert_allclose(scan.points, expected, atol=1e-6)
    np.testing.assert_allclose(
        scan.no_return, [(8 * math.cos(a) + 1.0, 8 * math.sin(a)) for a in (0.1, 0.5)], atol=1e-6
    )


@BAGS
def test_the_old_point_cloud_is_read(tmp_path, suffix):
    points = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    with BagWriter(tmp_path / f"a.{suffix}") as bag:
        drive(bag)
        fields = {
            "header": {"frame_id": "lidar"},
            "points": [dict(zip("xyz", map(float, point), strict=True)) for point in points],
            "channels": [{"name": "intensity", "values": np.array([1.0, 2.0], np.float32)}],
        }
        bag.message("/cloud", "sensor_msgs/msg/PointCloud", 2.0, fields)
    scan = load("rosbag", tmp_path / f"a.{suffix}")[0]
    np.testing.assert_allclose(scan.points, points + np.array([2.0, 0.0, 0.5]))


# -- Velodyne (VLP-16 User Manual, 63-9243, chapter 9) -------------------------------------------------


ELEVATIONS = [-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15]  # degrees, by the laser's number
N_PACKETS = 75


def packet(azimuth: int, metres: float, microseconds: int) -> bytes:
    """Twelve blocks of two firings of 16 lasers at one range; distances have units of 2 mm."""
    returns = struct.pack("<HB", round(metres / 0.002), 100) * 32
    blocks = [struct.pack("<HH", 0xEEFF, (azimuth + 40 * k) % 36_000) + returns for k in range(12)]
    return b"".join(blocks) + struct.pack("<IBB", microseconds, 0x37, 0x22)


def packets(path: Path, change: bytes | None = None) -> Path:
    with BagWriter(path) as bag:
        drive(bag)
        bag.define("velodyne_msgs/msg/VelodynePacket", "builtin_interfaces/Time stamp\nuint8[1206] data")
        bag.define(
            "velodyne_msgs/msg/VelodyneScan",
            "std_msgs/Header header\nvelodyne_msgs/VelodynePacket[] packets",
        )
        for start in (0.5, 1.0):
            content = [
                {
                    "stamp": {"sec": int(start), "nanosec": int(start % 1 * 1e9) + k * 1_327_000},
                    "data": np.frombuffer(change or packet(480 * k, 5.0, k * 1327), np.uint8),
                }
                for k in range(N_PACKETS)
            ]
            fields = {"header": {"frame_id": "lidar"}, "packets": content}
            bag.message("/velodyne_packets", "velodyne_msgs/msg/VelodyneScan", start, fields)
    return path


@BAGS
def test_packets_of_a_vlp16_are_read(tmp_path, suffix):
    pytest.importorskip("velodyne_decoder")
    scan = load("rosbag", packets(tmp_path / f"a.{suffix}"), deskew=False)[1]
    local = (scan.points - scan.origin).numpy()
    torch.testing.assert_close(scan.origin, torch.tensor([1.0, 0.0, 0.5]).double())
    assert len(local) == N_PACKETS * 12 * 32
    np.testing.assert_allclose(np.linalg.norm(local, axis=1), 5.0, atol=0.02)
    found = np.degrees(np.arcsin(local[:, 2] / np.linalg.norm(local, axis=1)))
    assert sorted(set(found.round().astype(int).tolist())) == sorted(ELEVATIONS)
    np.testing.assert_allclose(local.mean(0), 0, atol=0.01)  # a whole turn


def test_damaged_packets_are_counted(tmp_path):
    pytest.importorskip("velodyne_decoder")
    with pytest.raises(DataError, match="packets cannot be decoded"):
        load("rosbag", packets(tmp_path / "a.mcap", bytes(1206)))


def test_a_message_without_packets_has_no_points():
    """The package alone would end the process."""
    pytest.importorskip("velodyne_decoder")
    from gmmtorch.datasets.packets.lidar_packets import LidarPackets

    assert len(LidarPackets().points({"packets": []}).points) == 0


# -- E57, written by libE57 ------------------------------------------------------------------------


def e57(path: Path) -> list[np.ndarray]:
    pye57 = pytest.importorskip("pye57")
    clouds = [np.random.default_rng(seed).normal(size=(50 + seed, 3)) for seed in range(2)]
    with pye57.E57(str(path), mode="w") as file:
        for seed, points in enumerate(clouds):
            data = {f"cartesian{axis}": points[:, k].copy() for k, axis in enumerate("XYZ")}
            data["cartesianInvalidState"] = np.zeros(len(points), np.int8)
            data["cartesianInvalidState"][0] = 1
            half = math.sqrt(0.5)
            file.write_scan_raw(
                data, rotation=np.array([half, 0, 0, half]), translation=np.array([10.0 * seed, 1.0, 2.0])
            )
    return clouds


def test_scans_of_an_e57_file_have_the_positions_of_the_scanner(tmp_path):
    clouds = e57(tmp_path / "a.e57")
    dataset = load("e57", tmp_path / "a.e57")
    assert len(dataset) == 2
    for k, (scan, points) in enumerate(zip(dataset, clouds, strict=True)):
        assert scan.origin.tolist() == [10.0 * k, 1.0, 2.0]
        turned = np.stack([-points[1:, 1], points[1:, 0], points[1:, 2]], 1)  # by 90° about z
        np.testing.assert_allclose(scan.points, turned + np.array([10.0 * k, 1.0, 2.0]), atol=1e-6)
        np.testing.assert_allclose(dataset.pose(k)[:3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
def test_damaged_e57_files_are_refused(tmp_path, share):
    path = tmp_path / "a.e57"
    e57(path)
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(DataError, match="cannot be read as E57"):
        load("e57", path)[0]
    path.write_bytes(data[:1500] + bytes(100) + data[1600:])
    with pytest.raises(DataError, match="cannot be read as E57"):
        list(load("e57", path))
    assert path.exists()

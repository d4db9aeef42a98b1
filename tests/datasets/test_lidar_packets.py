"""Raw packets of Hesai and Ouster lidars, in messages of drivers, and of all lidars in network captures."""

from __future__ import annotations

import math
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from packet_files import PIXELS, SHAPES, frames, hesai_packet, ouster_metadata, ouster_packet, write_capture
from test_more_sensors import packet as velodyne_packet
from test_rosbag import drive

from gmmtorch.datasets import BagReader, bag_facts, load
from gmmtorch.datasets.packets import hesai, ouster
from gmmtorch.datasets.packets.captures import Capture
from gmmtorch.errors import DataError, GmmTorchError, InvalidArgumentError

pytest.importorskip("rosbags")

from sensor_bags import BagWriter, moved

RNG = np.random.default_rng(5)
TABLED = ("Pandar40P", "Pandar64", "PandarQT64", "XT16", "XT32", "XT32M2X")


# -- Hesai -------------------------------------------------------------------------------------------


def ranges_of(model: str) -> np.ndarray:
    """Random ranges, of which some are missing."""
    n_blocks, n_channels, _ = SHAPES[model]
    found = np.round(RNG.uniform(0.5, 100, (n_blocks, n_channels)) / 0.004) * 0.004
    return np.where(RNG.random(found.shape) < 0.2, 0, found)


def correction_file(path: Path, n_channels: int, elevations: np.ndarray, azimuths: np.ndarray) -> Path:
    rows = [f"{k + 1},{elevations[k]:.3f},{azimuths[k]:.3f}" for k in range(n_channels)]
    path.write_text("\n".join(["Channel,Elevation,Azimuth", *rows]))
    return path


@pytest.mark.parametrize("model", SHAPES)
def test_points_of_a_hesai_are_those_of_its_manual(tmp_path, model):
    n_blocks, n_channels, _ = SHAPES[model]
    elevations, azimuths = RNG.uniform(-60, 60, n_channels), RNG.uniform(-9, 9, n_channels)
    path = correction_file(tmp_path / "a.csv", n_channels, elevations, azimuths)
    metres, turns = ranges_of(model), 350 + 0.2 * np.arange(n_blocks)
    packet = hesai_packet(model, turns, metres)
    assert hesai.model_of(packet).name == model
    found = hesai.returns_of([packet], hesai.model_of(packet), hesai.read_angles(path))
    expected, reflectivity = [], []
    for block in range(n_blocks):
        for channel in range(n_channels):
            length = metres[block, channel]
            if length > 0:
                turn = math.radians(turns[block] + round(azimuths[channel], 3))
                rise = math.radians(round(elevations[channel], 3))
                level = length * math.cos(rise)
                expected.append([level * math.sin(turn), level * math.cos(turn), length * math.sin(rise)])
                reflectivity.append(channel)
    np.testing.assert_allclose(found.points, expected, atol=1e-9)
    assert found.reflectivity.tolist() == reflectivity


@pytest.mark.parametrize("model", TABLED)
def test_nominal_angles_are_ordered_and_within_the_field_of_view(model):
    metres = np.full(SHAPES[model][:2], 10.0)
    packet = hesai_packet(model, 0.2 * np.arange(len(metres)), metres)
    points = hesai.returns_of([packet], hesai.model_of(packet), None).points[: SHAPES[model][1]]
    found = np.degrees(np.arcsin(points[:, 2] / 10))
    order = found if model == "PandarQT64" else -found
    assert (np.diff(order) > 0).all()
    fields = {"Pandar40P": (-25, 15), "Pandar64": (-25, 15), "PandarQT64": (-52.1, 52.1)}
    low, high = fields.get(model, {"XT16": (-15, 15), "XT32": (-16, 15)}.get(model, (-20.8, 19.5)))
    assert found.min() == pytest.approx(low, abs=0.15)
    assert found.max() == pytest.approx(high, abs=0.15)
    assert np.abs(np.degrees(np.arctan2(points[:, 0], points[:, 1]))).max() < 9


def test_equal_returns_of_a_laser_count_once_and_other_ones_twice():
    metres = np.full((8, 32), 10.0)
    metres[1, :5] = 20.0
    packet = hesai_packet("XT32", [0, 0, 1, 1, 2, 2, 3, 3], metres)
    found = hesai.returns_of([packet], hesai.model_of(packet), None)
    assert len(found.points) == 4 * 32 + 5
    assert sorted(set(found.times.tolist())) == [0, 50_000, 100_000, 150_000]


def test_times_continue_when_the_clock_of_a_packet_begins_a_new_second():
    packets = [
        hesai_packet("XT32", np.arange(8), np.full((8, 32), 9.0), microseconds)
        for microseconds in (999_600, 0, 400)
    ]
    found = hesai.returns_of(packets, hesai.model_of(packets[0]), None)
    np.testing.assert_array_equal(np.unique(found.times), np.arange(24) * 50_000)


def test_channels_of_another_lidar_and_missing_angles_are_refused(tmp_path):
    path = correction_file(tmp_path / "a.csv", 16, np.zeros(16), np.zeros(16))
    packet = hesai_packet("XT32", np.arange(8), np.full((8, 32), 9.0))
    with pytest.raises(DataError, match="has 16 channels, but a XT32 has 32"):
        hesai.returns_of([packet], hesai.model_of(packet), hesai.read_angles(path))
    packet = hesai_packet("QT128", [0, 1], np.full((2, 128), 9.0))
    with pytest.raises(DataError, match="a QT128 does not state its angles"):
        hesai.returns_of([packet], hesai.model_of(packet), None)
    for text in ("", "1,nan,0\n", "1,2\n", "1,4000,0\n", "PK\3\4"):
        path.write_text(text)
        with pytest.raises(DataError, match=r"a\.csv"):
            hesai.read_angles(path)


HESAI = {
    "pandar_msgs/msg/PandarScan": ("PandarPacket", "uint8[1500] data\nuint32 size"),
    "hesai_ros_driver/msg/UdpFrame": ("UdpPacket", "uint8[] data\nuint32 size"),
    "nebula_msgs/msg/NebulaPackets": ("NebulaPacket", "uint8[] data"),
}


def turn_of_hesai(start: float) -> list[tuple[float, bytes]]:
    """A turn of 100 ms in a room with a wall at x = 6 m, seen by a laser of an XT32 that points 5° up."""
    found = []
    for k in range(75):
        azimuths = (k * 8 + np.arange(8)) * 0.6
        metres = np.zeros((8, 32))
        sines = np.sin(np.radians(azimuths))
        level = np.where(sines > 0.1, 6 / np.maximum(sines, 0.1), 0)
        metres[:, 10] = level / math.cos(math.radians(5))
        found.append((start + k / 750, hesai_packet("XT32", azimuths, metres, round(k / 750 * 1e6))))
    return found


@pytest.mark.parametrize("kind", HESAI)
@pytest.mark.parametrize("suffix", ["mcap", "db3", "bag"])
def test_messages_of_hesai_drivers_are_read(tmp_path, kind, suffix):
    path, (name, fields) = tmp_path / f"a.{suffix}", HESAI[kind]
    with BagWriter(path) as bag:
        drive(bag)
        bag.define(f"{kind.rpartition('/')[0]}/{name}", f"builtin_interfaces/Time stamp\n{fields}")
        bag.define(kind, f"std_msgs/Header header\n{kind.split('/')[0]}/{name}[] packets")
        for start in (0.5, 1.0):
            content = []
            for time, data in turn_of_hesai(start):
                one = {"stamp": {"sec": int(time), "nanosec": int(time % 1 * 1e9)}}
                padding = bytes(1500 - len(data)) if "1500" in fields else b""
                one["data"] = np.frombuffer(data + padding, np.uint8)
                content.append({**one, "size": len(data)} if "size" in fields else one)
            bag.message("/packets", kind, start, {"header": {"frame_id": "lidar"}, "packets": content})
    found = load("rosbag", path, attributes=["intensity"])
    assert len(found) == 2
    scan = found[1]
    assert scan.origin.tolist() == pytest.approx([1.0, 0.0, 0.5])
    assert set(scan.attributes["intensity"].flatten().tolist()) == {10.0}
    # Each point is seen from where the robot is at its time, so the wall is as far as it drives.
    turn = torch.atan2(scan.points[:, 0] - scan.origin[0], scan.points[:, 1])
    np.testing.assert_allclose(scan.points[:, 0], 7.0 + turn.numpy() / (2 * math.pi) * 0.1, atol=6e-3)
    assert not found.skipped


def test_messages_without_a_definition_in_the_bag_are_read(tmp_path):
    import sqlite3

    test_messages_of_hesai_drivers_are_read(tmp_path, "pandar_msgs/msg/PandarScan", "db3")
    database = sqlite3.connect(tmp_path / "a.db3")
    database.execute("DELETE FROM message_definitions")
    database.commit()
    database.close()
    assert len(load("rosbag", tmp_path / "a.db3")[1].points) > 200


def test_packets_of_other_lidars_leave_the_choice_to_other_sensors(tmp_path):
    kind = "robosense_msgs/msg/RobosenseScan"
    with BagWriter(tmp_path / "a.mcap") as bag:
        drive(bag)
        bag.define("robosense_msgs/msg/RobosensePacket", "builtin_interfaces/Time stamp\nuint8[1248] data")
        bag.define(kind, "std_msgs/Header header\nrobosense_msgs/RobosensePacket[] packets")
        packet = {"stamp": {"sec": 1, "nanosec": 0}, "data": np.full(1248, 0x55, np.uint8)}
        bag.message("/packets", kind, 1.0, {"header": {"frame_id": "lidar"}, "packets": [packet]})
        bag.laser("/scan", 1.0, "lidar", np.ones(20), 0.0, 0.1, 9.0)
    assert load("rosbag", tmp_path / "a.mcap").topic == "/scan"
    with pytest.raises(DataError, match="is not a range sensor"):
        load("rosbag", tmp_path / "a.mcap", topic="/packets")


# -- Ouster ------------------------------------------------------------------------------------------


def turn_of_ouster(profile: str, frame: int, n_columns: int = 128) -> tuple[list[bytes], np.ndarray]:
    """The packets of a turn of a lidar with 32 channels, and its ranges (2, columns, 32) in mm."""
    ranges = RNG.integers(100, 20_000, (2, n_columns, 32)) * 8
    ranges[RNG.random(ranges.shape) < 0.2] = 0
    start, step = 5_000_000_000 + frame * 100_000_000, 100_000_000 // n_columns
    packets = [
        ouster_packet(*(profile, frame, first, ranges[:, first : first + 16], 40, start + first * step, step))
        for first in range(0, n_columns, 16)
    ]
    return packets, ranges


@pytest.mark.parametrize("profile", PIXELS)
@pytest.mark.parametrize("is_flat", [False, True])
def test_points_of_an_ouster_are_those_of_its_manual(profile, is_flat):
    packets, ranges = turn_of_ouster(profile, 7)
    metadata = ouster.read_metadata(ouster_metadata(profile, 32, 128, is_flat), "a.json")
    found = ouster.returns_of(packets, metadata)
    expected, n_returns = [], 2 if profile.endswith("DUAL") else 1
    for echo in range(n_returns):
        for column in range(128):
            for channel in range(32):
                r = ranges[echo, column, channel] / 1000
                if r > 0 and (echo == 0 or r != ranges[0, column, channel] / 1000):
                    encoder = 2 * math.pi * (1 - column / 128)
                    turn = encoder - math.radians((3.0, -1.0, 1.0, -3.0)[channel % 4])
                    rise = math.radians(20 - 40 / 31 * channel)
                    n = 0.0158
                    x = (r - n) * math.cos(turn) * math.cos(rise) + n * math.cos(encoder)
                    y = (r - n) * math.sin(turn) * math.cos(rise) + n * math.sin(encoder)
                    time = column * 781_250
                    expected.append([-x, -y, (r - n) * math.sin(rise) + 0.03618, time, 40 + echo])
    expected = np.array(expected)
    np.testing.assert_allclose(found.points, expected[:, :3], atol=1e-9)
    np.testing.assert_array_equal(found.times, expected[:, 3])
    np.testing.assert_array_equal(found.reflectivity, expected[:, 4])


@pytest.mark.parametrize("profile", PIXELS)
def test_points_of_an_ouster_are_those_of_the_manufacturers_program(profile):
    core = pytest.importorskip("ouster.sdk.core")
    packets, _ = turn_of_ouster(profile, 7, 512)
    text = ouster_metadata(profile, 32, 512)
    info = core.SensorInfo(text)
    form, frame = core.PacketFormat(info), core.LidarFrame(info)
    batch = core.FrameBatcher(info)
    for data in packets:
        one = core.LidarPacket(form)
        one.buf[:] = np.frombuffer(data, np.uint8)
        batch.batch(one, frame)
    lut = core.XYZLut(info, use_extrinsics=False)
    images = [frame.field(name) for name in ("RANGE", "RANGE2") if name in frame.fields]
    expected = np.concatenate([lut(image)[image > 0] for image in images])
    found = ouster.returns_of(packets, ouster.read_metadata(text, "a.json")).points
    np.testing.assert_allclose(
        np.unique(found.round(6), axis=0), np.unique(expected.round(6), axis=0), atol=2e-6
    )


def test_bad_metadata_are_refused():
    good = ouster_metadata("LEGACY", 32, 128)
    for text in (
        *("", "[]", "[" * 100_000, "{}", good.replace("altitude", "x"), good.replace("20.0", "NaN")),
        good.replace('"columns_per_frame": 128', '"columns_per_frame": 1e300'),
        good.replace('"columns_per_packet": 16', '"columns_per_packet": 100000'),
        good.replace('"beam_azimuth_angles": [3.0, ', '"beam_azimuth_angles": ['),
        good.replace("LEGACY", "UNKNOWN"),
        good + " " * (1 << 20),
    ):
        with pytest.raises(DataError, match=r"a\.json"):
            ouster.read_metadata(text, "a.json")


def ouster_bag(path: Path, metadata: str | None, profile: str = "RNG19_RFL8_SIG16_NIR16_DUAL") -> Path:
    kind = "ouster_ros/msg/PacketMsg"
    with BagWriter(path) as bag:
        drive(bag)
        bag.transforms(0.0, {("base", "os_sensor"): moved(0, 0, 0.5)}, static=True)
        bag.define(kind, "uint8[] buf")
        if metadata is not None:
            bag.message("/ouster/metadata", "std_msgs/msg/String", 0.0, {"data": metadata})
        for frame in range(3):
            for k, data in enumerate(turn_of_ouster(profile, frame)[0]):
                content = {"buf": np.frombuffer(data, np.uint8)}
                bag.message("/ouster/lidar_packets", kind, 0.5 + frame / 10 + k / 80, content)
                bag.message("/ouster/imu_packets", kind, 0.5, {"buf": np.zeros(48, np.uint8)})
    return path


@pytest.mark.parametrize("suffix", ["mcap", "db3", "bag"])
@pytest.mark.parametrize("profile", ["LEGACY", "RNG19_RFL8_SIG16_NIR16_DUAL", "FUSA_RNG15_RFL8_NIR8_DUAL"])
def test_packets_of_an_ouster_in_a_bag_are_read_as_sweeps(tmp_path, suffix, profile):
    path = ouster_bag(tmp_path / f"a.{suffix}", ouster_metadata(profile, 32, 128), profile)
    found = load("rosbag", path, attributes=["intensity"])
    assert len(found) == 3
    assert found.times.tolist() == pytest.approx([0.5, 0.6, 0.7])
    for index in (2, 0, 1):  # in any order
        assert found[index].origin.tolist() == pytest.approx([0.5 + index / 10, 0.0, 0.5])
        assert len(found[index].points) > 3000
        assert set(found[index].attributes["intensity"].flatten().tolist()) <= {40.0, 41.0}
    torch.testing.assert_close(found[2].points, load("rosbag", path, stride=2)[1].points)
    assert not found.skipped
    uses = {one.topic.name: one.use for one in bag_facts(BagReader(path)).topics}
    assert uses["/ouster/lidar_packets"] == "scans (lidar packets)"
    assert uses["/ouster/imu_packets"] == ""


def test_metadata_of_an_ouster_are_found_beside_the_recording_or_given(tmp_path):
    path = ouster_bag(tmp_path / "a.mcap", None)
    with pytest.raises(DataError, match="lacks the metadata"):
        load("rosbag", path)
    text = ouster_metadata("RNG19_RFL8_SIG16_NIR16_DUAL", 32, 128)
    (tmp_path / "other.json").write_text(ouster_metadata("LEGACY", 32, 128))
    (tmp_path / "broken.json").write_text('{"beam_altitude_angles": 3}')
    (tmp_path / "x.json").write_text(text)
    assert len(load("rosbag", path)[0].points) > 3000
    (tmp_path / "y.json").write_text(text)
    with pytest.raises(DataError, match="2 lidars fit"):
        load("rosbag", path)
    assert len(load("rosbag", path, calibration=str(tmp_path / "y.json"))[0].points) > 3000
    (tmp_path / "a_0.json").write_text(text)
    assert len(load("rosbag", path)[0].points) > 3000
    with pytest.raises(DataError, match="those of another lidar"):
        load("rosbag", path, calibration=str(tmp_path / "other.json"))
    with pytest.raises(InvalidArgumentError, match="calibration"):
        load("rosbag", path, calibration=str(tmp_path))


# -- captures ----------------------------------------------------------------------------------------


def write_ouster_capture(path: Path, profile: str = "LEGACY", mtu: int = 1480) -> Path:
    pytest.importorskip("dpkt")
    path.with_suffix(".json").write_text(ouster_metadata(profile, 32, 128))
    packets = [
        (100.5 + frame / 10 + k / 80, data)
        for frame in range(3)
        for k, data in enumerate(turn_of_ouster(profile, frame)[0])
    ]
    return write_capture(path, packets, 7502, mtu=mtu)


@pytest.mark.parametrize("suffix", ["pcap", "pcapng"])
@pytest.mark.parametrize("mtu", [1480, 65_000])
def test_captures_of_an_ouster_are_read(tmp_path, suffix, mtu):
    """Its datagrams are larger than an Ethernet frame, so they come in parts."""
    path = write_ouster_capture(tmp_path / f"a.{suffix}", mtu=mtu)
    found = load("rosbag", path, poses="standing")
    assert found.topic == "/192.168.1.201/7502"
    assert found.times.tolist() == pytest.approx([100.5, 100.6, 100.7])
    assert all(len(scan.points) > 3000 for scan in found)
    torch.testing.assert_close(load("rosbag", path, poses="standing", stride=2)[1].points, found[2].points)
    assert not found.skipped


@pytest.mark.parametrize("suffix", ["pcap", "pcapng"])
def test_captures_of_a_hesai_are_read_turn_by_turn_with_a_trajectory(tmp_path, suffix):
    pytest.importorskip("dpkt")
    packets = [one for start in range(3) for one in turn_of_hesai(start / 10)]
    path = write_capture(tmp_path / f"a.{suffix}", packets)
    rows = "".join(f"{k / 10} {k / 10} 0 0.5 0 0 0 1\n" for k in range(5))
    (tmp_path / "poses.txt").write_text(rows)
    found = load("rosbag", path, poses=str(tmp_path / "poses.txt"))
    assert len(found) == 3
    turn = torch.atan2(found[1].points[:, 0] - 0.1, found[1].points[:, 1])
    moved_on = turn.numpy() / (2 * math.pi) * 0.1
    np.testing.assert_allclose(found[1].points[:, 0], 6.1 + moved_on, atol=6e-3)


def test_captures_of_a_velodyne_are_read(tmp_path):
    pytest.importorskip("velodyne_decoder")
    packets = [
        (1.0 + k * 1.327e-3, velodyne_packet(480 * k % 36_000, 5.0, k * 1327 % 1_000_000)) for k in range(225)
    ]
    path = write_capture(tmp_path / "a.pcap", packets)
    found = load("rosbag", path, poses="standing", attributes=["intensity"])
    assert len(found) == 3
    assert len(found[1].points) == 75 * 12 * 32
    np.testing.assert_allclose(found[1].points.norm(dim=1), 5.0, atol=0.02)
    assert set(found[1].attributes["intensity"].flatten().tolist()) == {100.0}


def test_each_sender_is_a_topic_and_other_datagrams_give_nothing(tmp_path):
    pytest.importorskip("dpkt")
    path = write_capture(tmp_path / "a.pcap", turn_of_hesai(0.0))
    for source, data in ((202, turn_of_hesai(0.0)), (201, [(0.0, b"GPS" * 50)])):
        port = 2368 if source == 202 else 8308
        other = write_capture(tmp_path / "b.pcap", data, port, source)
        path.write_bytes(path.read_bytes() + other.read_bytes()[24:])
    with pytest.raises(InvalidArgumentError, match=r"2 topics of a range sensor.*/192\.168\.1\.202/2368"):
        load("rosbag", path, poses="standing")
    assert len(load("rosbag", path, poses="standing", topic="/192.168.1.202/2368")) == 1
    facts = {one.topic.name: (one.topic.type, one.use) for one in bag_facts(BagReader(path)).topics}
    assert facts["/192.168.1.201/8308"] == ("UDP datagrams", "")


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(("magic", "unit"), [(0xA1B2C3D4, 1_000_000), (0xA1B23C4D, 1_000_000_000)])
@pytest.mark.parametrize("link", [1, 101, 113, "vlan"])
def test_forms_of_pcap_are_read(tmp_path, order, magic, unit, link):
    """By the description of the format (draft-ietf-opsawg-pcap)."""
    data = bytearray(struct.pack(order + "IHHIIII", magic, 2, 4, 0, 0, 65535, 1 if link == "vlan" else link))
    ethernet = frames(b"content!", 2368)[0]
    frame = {
        1: ethernet,
        101: ethernet[14:],
        113: bytes(14) + b"\x08\x00" + ethernet[14:],
        "vlan": ethernet[:12] + b"\x81\x00\x00\x05" + ethernet[12:],
    }[link]
    data += struct.pack(order + "IIII", 7, unit // 4, len(frame), len(frame)) + frame
    (tmp_path / "a.pcap").write_bytes(data)
    ((connection, *found),) = messages_in(tmp_path / "a.pcap")
    assert connection.topic.endswith("/2368")
    assert found == [7_250_000_000, b"content!"]


def test_parts_of_datagrams_are_joined_in_any_order_and_lost_ones_are_left_out(tmp_path):
    parts = [frames(bytes([number]) * 5000, 7, number=number) for number in range(3)]
    sent = [parts[0][2], parts[1][0], parts[0][0], parts[0][3], parts[0][1], parts[0][1], *parts[2][1:]]
    found = captured(tmp_path, sent)
    assert [content for *_, content in found] == [bytes(5000)]


def messages_in(path: Path) -> list:
    capture = Capture(path)
    return list(capture.messages(capture.connections))


def captured(folder: Path, sent: list[bytes]) -> list:
    data = bytearray(struct.pack("<IHHIIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1))
    for frame in sent:
        data += struct.pack("<IIII", 1, 0, len(frame), len(frame)) + frame
    (folder / "a.pcap").write_bytes(data)
    return messages_in(folder / "a.pcap")


def test_parts_that_never_end_take_bounded_memory(tmp_path):
    import tracemalloc

    sent = [frames(bytes(60_000), 7, number=number, mtu=59_200)[0] for number in range(700)]
    tracemalloc.start()
    with pytest.raises(DataError, match="no UDP datagram"):
        captured(tmp_path, sent)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 110e6  # of which the test's own bytes are 84 MB


@pytest.mark.parametrize("suffix", ["pcap", "pcapng"])
def test_the_intact_part_of_a_capture_is_read(tmp_path, suffix, caplog):
    path = write_ouster_capture(tmp_path / f"a.{suffix}")
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * 0.9)])
    found = load("rosbag", path, poses="standing")
    assert len(found) == 3
    assert "frames are intact; the file is cut off" in caplog.text


def test_hostile_captures_are_refused(tmp_path):
    path = tmp_path / "a.pcap"
    head = struct.pack("<IHHIIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1)
    block = struct.pack("<III", 0x0A0D0D0A, 28, 0x1A2B3C4D) + bytes(12) + struct.pack("<I", 28)
    for data in (
        *(b"", b"\xd4\xc3\xb2\xa1", bytes(40), head, head + b"\xff" * 16, head + b"\xff" * 400),
        *(block, block + b"\xff" * 64, block + struct.pack("<II", 6, 32) + b"\xff" * 24),
        block[:4] + struct.pack("<I", 0) + block[8:] * 4,
    ):
        path.write_bytes(data)
        with pytest.raises(GmmTorchError):
            load("rosbag", path, poses="standing")


def test_changed_captures_are_read_or_refused(tmp_path):
    path = write_ouster_capture(tmp_path / "a.pcap")
    data = path.read_bytes()
    for _ in range(60):
        changed = bytearray(data[: 20_000 + 24])
        for at in RNG.integers(0, len(changed), 5):
            changed[at] = RNG.integers(256)
        path.write_bytes(changed)
        try:
            for scan in load("rosbag", path, poses="standing"):
                assert torch.isfinite(scan.points).all()
        except GmmTorchError:
            pass

"""Bad bags give errors that name topic, frame, time and remedy, or scans that are left out and counted."""

from __future__ import annotations

import contextlib
import sqlite3
import struct
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from test_rosbag import POINTS, clouds, drive

from gmmtorch.datasets import BagReader, load
from gmmtorch.errors import DataError, InvalidArgumentError, MissingDataError

pytest.importorskip("rosbags")

from sensor_bags import BagWriter, moved

FORMATS = pytest.mark.parametrize("suffix", ["mcap", "db3", "bag"])


@FORMATS
def test_empty_bags_are_refused(tmp_path, suffix):
    path = tmp_path / f"a.{suffix}"
    path.write_bytes(b"")
    with pytest.raises(DataError, match="is empty"):
        load("rosbag", path)
    path.unlink()
    with BagWriter(path):
        pass
    with pytest.raises(DataError, match=r"topics are none|no message can be read"):
        load("rosbag", path)


def test_paths_without_a_bag_are_refused(tmp_path):
    with pytest.raises(MissingDataError, match="does not exist"):
        load("rosbag", tmp_path / "none.mcap")
    with pytest.raises(DataError, match=r"no metadata\.yaml and 0 bag files"):
        load("rosbag", tmp_path)
    (tmp_path / "a.txt").write_text("hello")
    with pytest.raises(DataError, match="is not a recording"):
        load("rosbag", tmp_path / "a.txt")
    (tmp_path / "a.mcap").write_bytes(b"hello" * 100)
    with pytest.raises(DataError, match="cannot be read as a ROS bag"):
        load("rosbag", tmp_path / "a.mcap")


def compressed_bag(path: Path, ros1_codec: str, points: np.ndarray) -> Path:
    """A drive with one cloud in compressed chunks: by a codec of ROS 1, or by Zstandard."""
    from rosbags.rosbag1 import Writer
    from rosbags.rosbag2 import CompressionFormat, CompressionMode

    bag = BagWriter(path)
    if path.suffix == ".bag":
        bag.writer.set_compression(Writer.CompressionFormat[ros1_codec])
    else:
        bag.writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with bag:
        drive(bag)
        bag.cloud("/points", 0.0, "lidar", points)
    return path


@pytest.mark.parametrize(("suffix", "codec"), [("mcap", b"zstd"), ("bag", b"bz2")])
def test_an_unknown_compression_is_named(tmp_path, suffix, codec):
    path = compressed_bag(tmp_path / f"a.{suffix}", "BZ2", POINTS)
    assert len(load("rosbag", path)) == 1
    name = b"w" * len(codec)
    path.write_bytes(path.read_bytes().replace(codec, name))
    with pytest.raises(DataError, match=f"{name.decode()}.*unknown compression"):
        load("rosbag", path)


@pytest.mark.parametrize("suffix", ["mcap", "db3"])
def test_compressed_messages_are_read_without_metadata(tmp_path, suffix):
    """`ros2 bag record --compression-mode message` states the compression only in metadata.yaml."""
    from rosbags.rosbag2 import CompressionFormat, CompressionMode

    bag = BagWriter(tmp_path / f"a.{suffix}")
    bag.writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    with bag:
        drive(bag)
        bag.cloud("/points", 0.0, "lidar", np.ones((1000, 3)))
    assert (tmp_path / f"a.{suffix}").stat().st_size < 100_000
    assert load("rosbag", tmp_path / f"a.{suffix}")[0].points.shape == (1000, 2)


def test_a_topic_without_a_type_is_left_out(tmp_path):
    import sqlite3

    path = clouds(tmp_path / "a.db3")
    with sqlite3.connect(path) as database:
        database.executescript(
            "CREATE TABLE copied AS SELECT * FROM topics; DROP TABLE topics; "  # without its constraints
            "ALTER TABLE copied RENAME TO topics; UPDATE topics SET type = NULL WHERE name = '/tf_static'"
        )
    database.close()
    with pytest.raises(DataError, match=r"/points: TF has no frame lidar"):
        load("rosbag", path)


def test_transforms_whose_definition_is_damaged_are_left_out(tmp_path):
    path = clouds(tmp_path / "a.bag")
    path.write_bytes(
        path.read_bytes().replace(b"TransformStamped[] transforms", b"TransformStamped[] trans2orms")
    )
    with pytest.raises(DataError, match=r"/points: TF has no frame lidar"):
        load("rosbag", path)


@pytest.mark.parametrize("suffix", ["mcap", "bag"])
def test_a_chunk_that_unpacks_without_end_is_refused(tmp_path, suffix, monkeypatch):
    from gmmtorch.datasets.ros import bag_reader

    path = compressed_bag(tmp_path / f"a.{suffix}", "LZ4", np.ones((100_000, 3)))
    assert path.stat().st_size < 20_000
    monkeypatch.setattr(bag_reader, "MAX_CHUNK_BYTES", 1 << 20)
    with pytest.raises(DataError, match=r"a chunk is (too large|damaged)"):
        load("rosbag", path)


@pytest.mark.parametrize("is_announced", [False, True])
def test_a_bag_compressed_as_a_whole_is_unpacked_to_a_limit(tmp_path, monkeypatch, is_announced):
    """`ros2 bag record --compression-mode file`."""
    from rosbags import rosbag2

    from gmmtorch.datasets.ros import bag_reader

    bag, folder = BagWriter(tmp_path / "a.db3"), tmp_path / "bag"
    bag.writer = rosbag2.Writer(folder, version=9, storage_plugin=rosbag2.StoragePlugin.SQLITE3)
    bag.writer.set_compression(rosbag2.CompressionMode.FILE, rosbag2.CompressionFormat.ZSTD)
    bag.writer.open()
    drive(bag)
    bag.cloud("/points", 0.0, "lidar", np.ones((100_000, 3)))
    bag.writer.close()
    (file,) = folder.glob("*.db3.zstd")
    if is_announced:
        zstd = rosbag2.storage_mcap.zstd
        file.write_bytes(zstd.compress(zstd.decompress(file.read_bytes())))
    assert file.stat().st_size < 20_000
    assert load("rosbag", folder)[0].points.shape == (100_000, 2)
    monkeypatch.setattr(bag_reader, "MAX_BAG_BYTES", 1 << 20)
    with pytest.raises(DataError, match=r"bag unpacks to more than 1,048,576 bytes.*zstd -d"):
        load("rosbag", folder)
    file.write_bytes(b"no zstd")
    with pytest.raises(DataError, match=r"cannot be read as a ROS bag.*reindex"):
        load("rosbag", folder)


ENDLESS = "WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n) SELECT {} FROM n WHERE x < 0"
DEFINITION = "x AS id, 'a' AS topic_type, 'a' AS encoding, 'a' AS encoded_message_definition"
DEFINITION += ", 'a' AS type_description_hash"


def test_queries_of_a_database_end_whatever_its_views_are(tmp_path):
    path = clouds(tmp_path / "a.db3")
    with contextlib.closing(sqlite3.connect(path)) as database:
        database.execute("DROP TABLE IF EXISTS message_definitions")
        database.execute(f"CREATE VIEW message_definitions AS {ENDLESS.format(DEFINITION)}")
        database.commit()
    assert len(list(BagReader(path).messages({"/points"}))) == 3


def test_generated_columns_are_not_larger_than_messages(tmp_path):
    path = clouds(tmp_path / "a.db3")
    with contextlib.closing(sqlite3.connect(path)) as database:
        database.executescript(
            "CREATE TABLE new (id INTEGER PRIMARY KEY, topic_id, timestamp, data AS (zeroblob(900000000)));"
            "INSERT INTO new (id, topic_id, timestamp) SELECT id, topic_id, timestamp FROM messages;"
            "DROP TABLE messages; ALTER TABLE new RENAME TO messages;"
        )
        database.commit()
    assert not list(BagReader(path).messages({"/points"}))


def test_metadata_of_any_content_is_read_in_bounded_time(tmp_path):
    folder = tmp_path / "bag"
    folder.mkdir()
    clouds(folder / "a.db3")
    aliases = [f"a{n}: &a{n} [{','.join([f'*a{n - 1}'] * 9)}]\n" for n in range(1, 15)]
    for text in ("a0: &a0 {k: 1}\n" + "".join(aliases), "[" * 100_000, "a: " + "{a: " * 5000):
        (folder / "metadata.yaml").write_text(text)
        begin = time.process_time()
        assert len(load("rosbag", folder)) > 0
        assert time.process_time() - begin < 5


def test_texts_of_a_bag_are_neither_unpickled_nor_run(tmp_path, monkeypatch):
    import pickle

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("a bag was unpickled")

    for name in ("load", "loads", "Unpickler"):
        monkeypatch.setattr(pickle, name, refuse)
    pickled, code = "cos\nabort\n(tR.", "__import__('os').abort()"
    with BagWriter(tmp_path / "a.mcap") as bag:
        bag.transforms(0.0, {("odom", pickled): np.eye(4), (pickled, code): np.eye(4)})
        bag.cloud("/points", 0.0, code, POINTS)
    assert len(load("rosbag", tmp_path / "a.mcap")[0].points) == 2


def test_two_sensors_on_one_topic_are_told_apart_by_their_frame(tmp_path):
    with BagWriter(tmp_path / "a.mcap") as bag:
        drive(bag)
        bag.transforms(0.0, {("base", "rear"): moved(-9)}, static=True)
        for i, frame in enumerate(["lidar", "rear", "lidar"]):
            bag.cloud("/points", i / 2, frame, POINTS)
    by_tf = load("rosbag", tmp_path / "a.mcap")
    assert [float(by_tf.pose(i)[0, 3]) for i in range(3)] == [0.0, -8.5, 1.0]
    with pytest.raises(
        InvalidArgumentError, match=r"/points.*lidar \(2 scans\), rear \(1 scans\).*sensor_frame"
    ):
        load("rosbag", tmp_path / "a.mcap", poses="standing")
    one = load("rosbag", tmp_path / "a.mcap", poses="standing", sensor_frame="lidar")
    assert (len(one), one.skipped) == (2, {"message of another frame": 1})
    with pytest.raises(InvalidArgumentError, match=r"sensor_frame=front is not.*lidar \(2 scans\)"):
        load("rosbag", tmp_path / "a.mcap", sensor_frame="front")


def test_two_types_on_one_topic_are_refused(tmp_path):
    with BagWriter(tmp_path / "a.mcap") as bag:
        drive(bag)
        bag.cloud("/scan", 0.0, "lidar", POINTS)
        bag.laser("/scan", 0.0, "lidar", [1.0], 0.0, 0.1, 8.0)
    with pytest.raises(DataError, match=r"topic /scan has messages of 2 types.*LaserScan.*PointCloud2"):
        load("rosbag", tmp_path / "a.mcap", topic="/scan")


def test_clocks_that_jump_are_left_out_and_counted(tmp_path):
    stamps = [0.0, 0.25, 99.0, 0.5, 0.75, 0.1, 1.0]  # one far ahead, one back
    with BagWriter(tmp_path / "a.mcap") as bag:
        drive(bag)
        for i, stamp in enumerate(stamps):
            content = {"header": {"frame_id": "lidar"}, "ranges": np.ones(1, np.float32), "range_max": 9.0}
            bag.message("/scan", "sensor_msgs/msg/LaserScan", stamp, content, received=float(i))
    dataset = load("rosbag", tmp_path / "a.mcap")
    assert dataset.times.tolist() == [0.0, 0.25, 0.5, 0.75, 1.0]
    assert dataset.skipped == {"stamp out of order (the clock jumped)": 2}


def test_transforms_whose_clock_runs_backwards_keep_the_longest_run(tmp_path):
    with BagWriter(tmp_path / "a.mcap") as bag:
        for received, stamp, x in [(0, 0, 0), (1, 5, 50), (2, 1, 10), (3, 2, 20)]:
            matrix = {"translation": {"x": float(x)}, "rotation": {"w": 1.0}}
            entry = {"header": {"frame_id": "odom"}, "child_frame_id": "lidar", "transform": matrix}
            entry["header"]["stamp"] = {"sec": stamp, "nanosec": 0}
            bag.message("/tf", "tf2_msgs/msg/TFMessage", float(received), {"transforms": [entry]})
        bag.cloud("/points", 1.5, "lidar", POINTS)
    assert float(load("rosbag", tmp_path / "a.mcap").pose(0)[0, 3]) == 15


def test_a_sensor_with_a_clock_of_its_own_needs_the_times_of_recording(tmp_path):
    with BagWriter(tmp_path / "a.mcap") as bag:
        drive(bag)
        content = {"header": {"frame_id": "lidar"}, "ranges": np.ones(1, np.float32), "range_max": 9.0}
        bag.message("/scan", "sensor_msgs/msg/LaserScan", 5000.0, content, received=1.0)
    with pytest.raises(
        DataError,
        match=r"/scan: no scan.*Frame lidar, stamps from 5000\.000.*0\.000 to 2\.000 s.*clock=received",
    ):
        load("rosbag", tmp_path / "a.mcap")
    dataset = load("rosbag", tmp_path / "a.mcap", clock="received")
    assert dataset.times.tolist() == [1.0]


def test_poses_that_end_before_the_scans_leave_scans_out(tmp_path):
    path = clouds(tmp_path / "a.mcap", (0.5, 1.5, 2.5, 3.5))
    dataset = load("rosbag", path)
    assert (dataset.times.tolist(), dataset.skipped) == ([0.5, 1.5], {"no pose at the time of the scan": 2})
    (tmp_path / "t.txt").write_text("10 0 0 0 0 0 0 1\n20 0 0 0 0 0 0 1\n")
    with pytest.raises(DataError, match=r"stamps from 0\.500 to 3\.500 s; .*t\.txt has poses from 10\.000"):
        load("rosbag", path, poses=str(tmp_path / "t.txt"))


def test_a_gap_in_the_poses_is_not_bridged(tmp_path):
    with BagWriter(tmp_path / "a.mcap") as bag:
        for time in (0.0, 1.0, 31.0, 32.0):
            bag.transforms(time, {("odom", "lidar"): moved(time)})
        for time in (0.5, 16.0, 31.5):
            bag.cloud("/points", time, "lidar", POINTS)
    assert load("rosbag", tmp_path / "a.mcap").times.tolist() == [0.5, 31.5]
    assert len(load("rosbag", tmp_path / "a.mcap", max_gap=60)) == 3


@pytest.mark.parametrize(
    ("edges", "message"),
    [
        (
            [("odom", "base"), ("mast", "lidar")],
            r"frame odom and frame lidar, whose tree is lidar → mast; all",
        ),
        ([("odom", "base")], r"/points: TF has no frame lidar.*frames are base, odom"),
        ([("base", "lidar"), ("lidar", "base")], "TF loops: lidar → base → lidar"),
        ([("base", "lidar"), ("mast", "lidar")], r"several parents of frame lidar: base \(2 times\), mast"),
    ],
    ids=["split", "missing", "loop", "two parents"],
)
def test_broken_trees_of_transforms_are_described(tmp_path, edges, message):
    with BagWriter(tmp_path / "a.mcap") as bag:
        for time in (0.0, 1.0):
            for edge in edges:
                bag.transforms(time, {edge: moved(time)})
        bag.cloud("/points", 0.5, "lidar", POINTS)
    with pytest.raises(DataError, match=message):
        load("rosbag", tmp_path / "a.mcap", frame="odom")


def test_transforms_that_are_not_rigid_are_left_out(tmp_path):
    with BagWriter(tmp_path / "a.mcap") as bag:
        drive(bag)
        entry = {"header": {"frame_id": "odom"}, "child_frame_id": "base"}  # a quaternion of zeros
        bag.message("/tf", "tf2_msgs/msg/TFMessage", 0.5, {"transforms": [entry]})
        bag.cloud("/points", 0.5, "lidar", POINTS)
    assert float(load("rosbag", tmp_path / "a.mcap").pose(0)[0, 3]) == 0.5


def test_clouds_without_points_are_counted(tmp_path):
    with BagWriter(tmp_path / "a.mcap") as bag:
        drive(bag)
        for time, points in ((0.0, POINTS), (1.0, np.empty((0, 3))), (2.0, np.full((5, 3), np.nan))):
            bag.cloud("/points", time, "lidar", points)
    dataset = load("rosbag", tmp_path / "a.mcap")
    for _ in range(2):  # a second reading counts nothing twice
        assert [len(scan.points) for scan in dataset] == [2, 0, 0]
        assert dataset.skipped == {"message without a valid point": 2}


def test_a_damaged_message_gives_an_empty_scan_and_is_counted(tmp_path):
    with BagWriter(tmp_path / "a.mcap") as bag:
        drive(bag)
        bag.cloud("/points", 0.0, "lidar", POINTS)
        header = {"header": {"frame_id": "lidar"}}
        fields = [{"name": axis, "offset": 4 * i, "datatype": 7} for i, axis in enumerate("xyz")]
        size = {"height": 2**31, "width": 2**31, "point_step": 12, "row_step": 2**32 - 1, "fields": fields}
        bag.message("/points", "sensor_msgs/msg/PointCloud2", 1.0, {**header, **size})
    dataset = load("rosbag", tmp_path / "a.mcap")
    assert [len(scan.points) for scan in dataset] == [2, 0]
    assert dataset.skipped == {"message that cannot be decoded": 1}


def lasers(path: Path, n: int = 12, **fields: object) -> Path:
    """A robot that turns, with a laser of 90 beams over 270° and 10 scans a second of 0.075 s."""
    about = {"angle_min": -2.35, "angle_max": 2.35, "angle_increment": 4.7 / 89, "range_max": 9.0}
    about |= {"time_increment": 0.075 / 89, "scan_time": 0.1, "ranges": np.full(90, 2.0, np.float32)}
    with BagWriter(path) as bag:
        for tick in range(3 * n):
            bag.transforms(tick / 20, {("odom", "laser"): moved(0, yaw=tick / 20)})
        for index in range(n):
            content = {"header": {"frame_id": "laser"}, **about, **(fields if index != 5 or n > 12 else {})}
            bag.message("/scan", "sensor_msgs/msg/LaserScan", index / 10, content)
    return path


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"time_increment": 0.75 / 89}, "time_increment contradicts scan_time"),
        ({"time_increment": 0.75 / 89, "scan_time": 0.0}, "their times contradict the rate of the scans"),
        ({"time_increment": 1e-6}, "time_increment contradicts scan_time"),
        ({"time_increment": 0.5}, "time_increment gives no sweep of 0 to 2 s"),
        ({"time_increment": -0.001}, "time_increment gives no sweep of 0 to 2 s"),
        ({"time_increment": float("nan")}, "time_increment gives no sweep of 0 to 2 s"),
    ],
)
def test_lasers_whose_beams_have_wrong_times_are_counted(tmp_path, fields, reason):
    dataset = load("rosbag", lasers(tmp_path / "a.mcap", 13, **fields))
    assert load("rosbag", tmp_path / "a.mcap", deskew=False).skipped == {}
    still = load("rosbag", lasers(tmp_path / "b.mcap", 13, time_increment=0.0))
    for scan, expected in zip(dataset, still, strict=True):
        assert torch.equal(scan.points, expected.points)
    assert (dataset.skipped, still.skipped) == ({f"points not deskewed: {reason}": 13}, {})


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"angle_increment": 0.0}, "all 90 beams have one direction: angle_increment is 0"),
        ({"angle_increment": 0.1}, r"90 beams from angle_min=-2\.35.*end at 6\.55.*, not at angle_max=2\.35"),
        ({"angle_max": -2.35, "angle_increment": 0.05}, r"not at angle_max=-2\.35"),
        ({"ranges": np.full(45, 2.0, np.float32)}, r"45 beams.*not at angle_max"),
        ({"angle_min": float("nan")}, "the angles of the laser are not finite"),
    ],
)
def test_lasers_whose_directions_are_not_known_are_refused_or_counted(tmp_path, fields, message):
    with pytest.raises(DataError, match=rf"/scan, frame laser, stamp 0\.000 s: .*{message}"):
        load("rosbag", lasers(tmp_path / "a.mcap", 13, **fields))
    dataset = load("rosbag", lasers(tmp_path / "a.mcap", **fields))
    assert [len(scan.points) for scan in dataset] == [90 if i == 5 else 0 for i in range(12)]
    assert dataset.skipped == {"message that cannot be decoded": 11}


def test_random_bytes_as_coordinates_give_finite_points_and_no_warning(tmp_path):
    table = np.frombuffer(np.random.default_rng(0).bytes(12 * 4000), [(axis, "<f4") for axis in "xyz"]).copy()
    table["x"][:9] = np.array([0x7FA00000], np.uint32).view(np.float32)  # a signalling NaN
    with BagWriter(tmp_path / "a.mcap") as bag:
        drive(bag)
        bag.transforms(0.0, {("base", "far"): moved(0)}, static=True)
        entry = {"header": {"frame_id": "base"}, "child_frame_id": "far"}
        huge = {"rotation": dict.fromkeys("xyzw", 1e300)}
        bag.message(
            "/tf_static", "tf2_msgs/msg/TFMessage", 0.0, {"transforms": [{**entry, "transform": huge}]}
        )
        bag.cloud_table("/points", 1.0, "lidar", table)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        points = load("rosbag", tmp_path / "a.mcap")[0].points
    assert 0 < len(points) < 4000
    assert bool(points.isfinite().all())


def test_an_unusable_layout_is_refused_at_once(tmp_path):
    table = np.zeros(4, np.dtype([("x", "<f4"), ("intensity", "<f4")]))
    with BagWriter(tmp_path / "a.mcap") as bag:
        drive(bag)
        bag.cloud_table("/points", 1.0, "lidar", table)
    with pytest.raises(
        DataError, match=r"/points, frame lidar, stamp 1\.000 s.*no field y, only x, intensity"
    ):
        load("rosbag", tmp_path / "a.mcap")


@pytest.mark.parametrize("packed", [False, True])
def test_announced_lengths_are_checked_before_anything_is_allocated(packed):
    from gmmtorch.datasets.ros.message_decoder import BASE, NAME, SEQUENCE, MessageDecoder

    numbers, items = (BASE, ("float64", 0)), (NAME, "Item")
    definitions = {
        "Numbers": ([], [("values", (SEQUENCE, (numbers, 0)))]),
        "Items": ([], [("values", (SEQUENCE, (items, 0)))]),
        "Item": ([], [("a", (BASE, ("uint8", 0))), ("b", (BASE, ("string", 0)))]),
        "Loop": ([], [("again", (NAME, "Loop"))]),
        "Nest0": ([], []),
        **{f"Nest{i}": ([], [(f"f{j}", (NAME, f"Nest{i - 1}")) for j in range(10)]) for i in range(1, 12)},
    }
    decoder = MessageDecoder(definitions, packed)
    head = b"" if packed else b"\0\1\0\0"
    for name in ("Numbers", "Items"):
        with pytest.raises(DataError, match="4294967295 entries"):
            decoder.decode(head + struct.pack("<I", 2**32 - 1) + bytes(16), name)
    for name in ("Loop", "Nest11"):
        with pytest.raises(DataError, match=f"type {name}"):
            decoder.decode(head + bytes(16), name)


def test_options_are_checked(tmp_path):
    path: Path = clouds(tmp_path / "a.mcap")
    for option, value in (("clock", "local"), ("max_gap", 0.0), ("stride", 0)):
        with pytest.raises(InvalidArgumentError, match=option):
            load("rosbag", path, **{option: value})

"""The intact part of damaged bags: what is read is what was written, and what is missing is said."""

from __future__ import annotations

import sqlite3
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gmmtorch.datasets import BagReader, load
from gmmtorch.errors import DataError

pytest.importorskip("rosbags")

from sensor_bags import BagWriter, moved

FORMATS = pytest.mark.parametrize("kind", ["chunks", "mcap", "db3", "bag"])
PERIOD, N_CLOUDS = 0.02, 100
Message = tuple[str, int, bytes]


@pytest.fixture(scope="module")
def bags(tmp_path_factory) -> dict[str, Path]:
    """A drive with 100 clouds of random points, in several chunks, by format."""
    folder, noise = tmp_path_factory.mktemp("bags"), np.random.default_rng(0)
    for suffix in ("mcap", "db3", "bag"):
        with BagWriter(folder / f"a.{suffix}") as bag:
            bag.transforms(0.0, {("base", "lidar"): np.eye(4)}, static=True)
            for i in range(N_CLOUDS):
                bag.transforms(i * PERIOD, {("odom", "base"): moved(i * PERIOD)})
                bag.cloud("/points", i * PERIOD, "lidar", noise.normal(size=(4_000, 3)))
    found = {suffix: folder / f"a.{suffix}" for suffix in ("mcap", "db3", "bag")}
    return {**found, "chunks": chunked(found["mcap"], folder / "chunks.mcap")}


def chunked(path: Path, to: Path) -> Path:
    """An MCAP file with chunks of ten messages and their CRCs, by the specification; rosbags writes none."""
    from rosbags.rosbag2.storage_mcap import zstd

    def text(value: str) -> bytes:
        return struct.pack("<I", len(value.encode())) + value.encode()

    def record(kind: int, content: bytes) -> bytes:
        return struct.pack("<BQ", kind, len(content)) + content

    reader = BagReader(path)
    parts, ids = [b"\x89MCAP0\r\n", record(1, text("ros2") + text("a test"))], {}
    for number, topic in enumerate(reader.topics, 1):
        ids[topic.name] = number
        key = struct.pack("<H", number)
        parts.append(record(3, key + text(topic.type) + text("ros2msg") + text("")))
        parts.append(record(4, key + key + text(topic.name) + text("cdr") + text("")))
    found = list(reader.messages(ids))
    for begin in range(0, len(found), 10):
        group = found[begin : begin + 10]
        data = b"".join(
            record(5, struct.pack("<HIQQ", ids[m.topic], 0, m.time, m.time) + m.data) for m in group
        )
        packed = zstd.compress(data)
        head = struct.pack("<QQQI", group[0].time, group[-1].time, len(data), zlib.crc32(data))
        parts.append(record(6, head + text("zstd") + struct.pack("<Q", len(packed)) + packed))
    to.write_bytes(b"".join([*parts, record(15, bytes(4)), record(2, bytes(20)), parts[0]]))
    return to


def messages(path: Path) -> list[Message]:
    reader = BagReader(path)
    found = reader.messages({topic.name for topic in reader.topics})
    return [(message.topic, message.time, message.data) for message in found]


@FORMATS
def test_a_whole_bag_has_the_messages_that_rosbags_reads(bags, kind):
    from rosbags import rosbag1, rosbag2

    with (rosbag1 if kind == "bag" else rosbag2).Reader(bags[kind]) as reader:
        expected = [(one.topic, time, bytes(data)) for one, time, data in reader.messages()]
        counts = {one.topic: one.msgcount for one in reader.connections}
    found = messages(bags[kind])
    assert sorted(found) == sorted(expected)
    assert [time for _, time, _ in found] == [time for _, time, _ in expected]
    assert {topic.name: topic.n_messages for topic in BagReader(bags[kind]).topics} == counts
    assert BagReader(bags[kind]).damage == ""


@FORMATS
@given(share=st.floats(0.05, 0.999))
def test_a_bag_that_is_cut_off_is_read_up_to_there(bags, tmp_path, kind, share):
    data = bags[kind].read_bytes()
    path = tmp_path / f"cut{bags[kind].suffix}"
    path.write_bytes(data[: int(share * len(data))])
    whole = messages(bags[kind])
    try:
        found = messages(path)
    except DataError:
        assert share < 0.1
        return
    assert found == whole[: len(found)] or set(found) <= set(whole)
    assert len(found) > (share - 0.3) * len(whole)  # chunks and pages are lost as a whole
    if kind != "db3":  # whose last pages may be those of an index
        assert "cut off" in BagReader(path).damage


@FORMATS
@given(share=st.floats(0.1, 0.85), n_bytes=st.integers(1, 5_000), seed=st.integers(0, 100))
def test_a_bag_is_read_before_and_after_damage(bags, tmp_path, kind, share, n_bytes, seed):
    """Only formats with checksums show that the content of a message has changed."""
    data = bytearray(bags[kind].read_bytes())
    begin = int(share * len(data))
    data[begin : begin + n_bytes] = np.random.default_rng(seed).bytes(n_bytes)
    path = tmp_path / f"damaged{bags[kind].suffix}"
    path.write_bytes(data)
    whole = {(topic, time): content for topic, time, content in messages(bags[kind])}
    found = messages(path)
    assert len(found) > 0.5 * len(whole)
    changed = sum(whole.get((topic, time)) != content for topic, time, content in found)
    assert changed == 0 if kind == "chunks" else changed <= 2
    assert found[0][1] == 0


def test_damage_is_said_with_the_seconds_that_are_missing(bags, tmp_path, caplog):
    data = bytearray(bags["chunks"].read_bytes())
    data[len(data) // 2] ^= 1
    path = tmp_path / "a.mcap"
    path.write_bytes(data)
    dataset = load("rosbag", path)
    assert len(dataset) == N_CLOUDS - 5  # every second one of the ten messages of a chunk
    seconds = float(caplog.text.split(" s are missing, the longest gap")[0].split()[-1])
    assert seconds == pytest.approx(6 * PERIOD, abs=0.06)


def test_the_end_that_metadata_states_is_missing(bags, tmp_path):
    folder = tmp_path / "bag"
    folder.mkdir()
    data = bags["db3"].read_bytes()
    (folder / "a_0.db3").write_bytes(data[: int(0.6 * len(data))])
    text = "rosbag2_bagfile_information:\n  duration:\n    nanoseconds: 5000000000\n  starting_time:\n"
    text += "    nanoseconds_since_epoch: 0\n  message_count: 400\n"
    (folder / "metadata.yaml").write_text(text)
    found = BagReader(folder)
    last = messages(folder)[-1][1] / 1e9
    assert (
        f" of 400 messages in {last:.1f} s are intact; {5 - last:.1f} s at the end are missing"
        in found.damage
    )


def test_chunks_that_overlap_unpack_to_a_limit(tmp_path, monkeypatch):
    """Chunks in front of each other, each with all that follows as its content: 500 GB."""
    import lz4.frame

    from gmmtorch.datasets.ros import bag_files

    n_bytes = 1 << 26
    packed = lz4.frame.compress(bytes(n_bytes))
    unpacked, plain = [], lz4.frame.LZ4FrameDecompressor.decompress

    def count(self: object, data: bytes, limit: int) -> bytes:
        found = plain(self, data, limit)
        unpacked.append(len(found))
        return found

    monkeypatch.setattr(lz4.frame.LZ4FrameDecompressor, "decompress", count)
    monkeypatch.setattr(bag_files, "_MOST_RATIO", 10)
    head = b"\x89MCAP0\r\n" + b"\1" + struct.pack("<QI", 12, 4) + b"ros2" + bytes(4)
    chunk = b"".join(
        b"\6"
        + struct.pack("<Q", 40 + 3 + len(packed))
        + struct.pack("<QQQII", 0, 0, n_bytes, 0, 3)
        + b"lz4"
        + struct.pack("<Q", len(packed))
        + packed
        for _ in range(50)
    )
    (tmp_path / "a.mcap").write_bytes(head + chunk)
    with pytest.raises(DataError, match="no message can be read"):
        BagReader(tmp_path / "a.mcap")
    assert sum(unpacked) < 2 * (1 << 28)


def test_a_database_whose_messages_never_end_is_refused(tmp_path):
    database = sqlite3.connect(tmp_path / "a.db3")
    database.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT)")
    endless = "WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM n)"
    database.execute(f"CREATE VIEW messages AS {endless} SELECT id, id AS timestamp, 1 AS topic_id FROM n")
    database.commit()
    database.close()
    with pytest.raises(DataError, match="no readable tables"):
        BagReader(tmp_path / "a.db3")


@pytest.mark.parametrize("kind", ["mcap", "db3"])
def test_a_file_of_several_that_cannot_be_read_is_named(bags, tmp_path, kind):
    (tmp_path / f"a_0.{kind}").write_bytes(bags[kind].read_bytes())
    (tmp_path / f"a_1.{kind}").write_bytes(b"")  # of a recorder that was killed
    (tmp_path / "metadata.yaml").write_text("")
    found = BagReader(tmp_path)
    assert f"nothing can be read of a_1.{kind}" in found.damage
    assert messages(tmp_path) == messages(bags[kind])


def mcap_of_chunks(path: Path, n_chunks: int, data: bytes, crc: int = 0) -> Path:
    """An MCAP file with a topic and equal compressed chunks."""
    from rosbags.rosbag2.storage_mcap import zstd

    def text(value: bytes) -> bytes:
        return struct.pack("<I", len(value)) + value

    def record(kind: int, content: bytes) -> bytes:
        return struct.pack("<BQ", kind, len(content)) + content

    packed, key = zstd.compress(data), struct.pack("<H", 1)
    chunk = struct.pack("<QQQI", 0, 0, len(data), crc) + text(b"zstd") + struct.pack("<Q", len(packed))
    schema = record(3, key + text(b"std_msgs/msg/String") + text(b"ros2msg") + text(b""))
    channel = record(4, key + key + text(b"/a") + text(b"cdr") + text(b""))
    head = b"\x89MCAP0\r\n" + record(1, text(b"ros2") + text(b""))
    path.write_bytes(head + schema + channel + record(6, chunk + packed) * n_chunks)
    return path


def test_chunks_with_wrong_checksums_are_unpacked_up_to_a_limit(tmp_path, monkeypatch):
    from gmmtorch.datasets.ros import bag_reader

    unpacked, plain = [], bag_reader._unpacked

    def counted(*arguments: object) -> bytes:
        unpacked.append(len(plain(*arguments)))
        return bytes(unpacked[-1])

    monkeypatch.setattr(bag_reader, "_unpacked", counted)
    with pytest.raises(DataError):
        BagReader(mcap_of_chunks(tmp_path / "a.mcap", 60, bytes(1 << 24), crc=1))
    assert 0 < sum(unpacked) < 2 * (1 << 28)


def test_a_small_file_has_a_limited_number_of_messages(tmp_path, monkeypatch):
    from gmmtorch.datasets.ros import bag_files

    monkeypatch.setattr(bag_files, "_LEAST_MESSAGES", 1 << 14)
    message = struct.pack("<BQHIQQ", 5, 22, 1, 0, 5, 5)
    found = BagReader(mcap_of_chunks(tmp_path / "a.mcap", 2, message * 20_000))
    assert found.topics[0].n_messages < 1.1 * (1 << 14)


def test_headers_that_overlap_take_no_quadratic_time(tmp_path, monkeypatch):
    from gmmtorch.datasets.ros import bag_files

    sizes, plain = [], bag_files._ros1_fields

    def counted(header: bytes) -> dict[bytes, bytes]:
        sizes.append(len(header))
        return plain(header)

    monkeypatch.setattr(bag_files, "_ros1_fields", counted)
    path = tmp_path / "a.bag"
    path.write_bytes(b"#ROSBAG V2.0\n" + (struct.pack("<I", 10_000) + b"\4\0\0\0op=\5") * 4_000)
    with pytest.raises(DataError):
        BagReader(path)
    assert sum(sizes) < 100 * path.stat().st_size

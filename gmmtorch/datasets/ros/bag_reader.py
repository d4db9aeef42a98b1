"""Reads ROS bags: ROS 1 (.bag), ROS 2 SQLite (.db3) and MCAP (.mcap), and network captures of lidars.

Bags are hostile input. Files are read within their length, compressed chunks are unpacked up to a limit, and
messages are decoded by `MessageDecoder`; definitions in a bag are used only for types that ROS does not have.
The package rosbags knows the types of ROS and parses definitions.
"""

from __future__ import annotations

import bz2
import re
import shutil
import tempfile
from collections.abc import Collection, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from gmmtorch.datasets.packets.captures import SUFFIXES as CAPTURES
from gmmtorch.datasets.packets.captures import Capture
from gmmtorch.datasets.packets.sweeps import DEFINITION as SWEEP_DEFINITION
from gmmtorch.datasets.packets.sweeps import SINGLE_PACKETS, SWEEP, Sweeps, is_lidar, packed, packet_of
from gmmtorch.datasets.ros.bag_files import BagFiles
from gmmtorch.datasets.ros.message_decoder import MessageDecoder
from gmmtorch.datasets.trajectory import NANOSECONDS
from gmmtorch.errors import DataError
from gmmtorch.optional_packages import needs_extra

_SUFFIXES = (".bag", ".mcap", ".db3", *CAPTURES)
_ZSTD = b"\x28\xb5\x2f\xfd"
"""Start of a compressed message: the file alone, without metadata.yaml, does not state the compression."""
_PACKED = ".zstd"  # suffix of a file that is compressed as a whole
_BLOCK_BYTES = 1 << 20
_MOST_METADATA = 1 << 22  # characters
_LEAST_MISSING = 0.05  # s at the end of a bag, below which it is whole
_REPAIRS = {
    ".bag": "'rosbag reindex' repairs a recording that was interrupted",
    ".mcap": "'mcap recover' repairs a recording that was interrupted",
    ".db3": "'ros2 bag reindex' or sqlite3's '.recover' repairs a recording that was interrupted",
}

_PACKETS = {
    "velodyne_msgs/msg/VelodyneScan": ("VelodynePacket", "uint8[1206] data"),
    "pandar_msgs/msg/PandarScan": ("PandarPacket", "uint8[1500] data\nuint32 size"),
    "nebula_msgs/msg/NebulaPackets": ("NebulaPacket", "uint8[] data"),
    "hesai_ros_driver/msg/UdpFrame": ("UdpPacket", "uint8[] data\nuint32 size"),
}
"""Types of messages with packets of a lidar, and the names and fields of their packets: SQLite bags of older
ROS 2 contain no definitions."""


class Topic(NamedTuple):
    """A topic of a bag: name, message type (pkg/msg/Name) and number of messages."""

    name: str
    type: str
    n_messages: int


class RawMessage(NamedTuple):
    """A message as bytes. topic: its name. type: its type. time: of recording, in ns."""

    topic: str
    type: str
    time: int
    data: bytes


class BagReader:
    """The topics and messages of one bag.

    path: a .bag, .mcap or .db3 file, the folder of a ROS 2 bag, or a network capture. Of a damaged bag the
    intact part is read. is_ros1: whether messages have the packed form of ROS 1, not CDR.

    Raises `DataError`, which states a repair, if nothing can be read, and `GmmTorchError` without rosbags.
    """

    def __init__(self, path: Path) -> None:
        self.path = _bag_file(path)
        with needs_extra("ROS bags and network captures need", "rosbags", "bags"):
            import rosbags.rosbag2  # noqa: F401
        self.is_ros1 = self.path.suffix == ".bag"
        self._reader = Capture(self.path) if self.path.suffix in CAPTURES else self._opened()
        self._connections = self._reader.connections
        sweep = parsed_definitions("MSG", SWEEP_DEFINITION, SWEEP)
        self._decoder = MessageDecoder(
            {
                **self._own_definitions(),
                **dict.fromkeys(SINGLE_PACKETS, sweep[SWEEP]),
                **sweep,
                **standard_definitions(self.is_ros1),
            },
            packed=self.is_ros1,
        )

    @property
    def topics(self) -> list[Topic]:
        """All topics by name. A topic with messages of two types is listed twice."""
        counts: dict[tuple[str, str], int] = {}
        for c in self._connections:
            counts[c.topic, c.type] = counts.get((c.topic, c.type), 0) + c.n_messages
        return [Topic(*key, count) for key, count in sorted(counts.items())]

    def fields(self, message_type: str) -> list[tuple[str, Any]]:
        """Names and kinds of the fields of a message type; empty if its definition is not known."""
        return list(self._decoder.definitions.get(message_type, ((), ()))[1])

    def messages(self, topics: Collection[str], start: int | None = None) -> Iterator[RawMessage]:
        """The messages of some topics in the order of recording, from time `start` (ns) on.

        Messages with single packets of a lidar are put together to sweeps with the time of the first one.
        """
        singles = {c.topic for c in self._connections if c.type in SINGLE_PACKETS}
        return (self._messages if singles.isdisjoint(topics) else self._sweeps)(topics, start)

    def _sweeps(self, topics: Collection[str], start: int | None) -> Iterator[RawMessage]:
        """The messages, and sweeps in place of single packets."""
        turns: dict[tuple[str, str], Sweeps] = {}
        for message in self._messages(topics, start):
            if message.type not in SINGLE_PACKETS:
                yield message
                continue
            key, data = (message.topic, message.type), packet_of(message.data, message.type, self.is_ros1)
            if is_lidar(data):
                yield from self._sweep(*key, turns.setdefault(key, Sweeps()).add(message.time, data))
        for key, sweeps in turns.items():
            yield from self._sweep(*key, sweeps.rest())

    def _sweep(self, topic: str, kind: str, packets: list[tuple[int, bytes]]) -> Iterator[RawMessage]:
        if packets:
            data = packed(packets, SINGLE_PACKETS[kind], self.is_ros1)
            yield RawMessage(topic, kind, packets[0][0], data)

    def _messages(self, topics: Collection[str], start: int | None) -> Iterator[RawMessage]:
        """The messages as they are recorded."""
        chosen = [c for c in self._connections if c.topic in topics]
        for connection, time, data in self._reader.messages(chosen, start):
            if not self.is_ros1 and data.startswith(_ZSTD):  # CDR starts with a zero
                with suppress(DataError):  # it is counted as one that cannot be decoded
                    data = _unpacked(data, "zstd", MAX_CHUNK_BYTES - 1)
            yield RawMessage(connection.topic, connection.type, time, data)

    def decode(self, message: RawMessage) -> dict[str, Any]:
        """The fields of a message. Raises `DataError`, which names the topic and the time of recording."""
        try:
            return self._decoder.decode(message.data, message.type)
        except DataError as error:
            raise DataError(
                f"{self.path}, topic {message.topic}, recorded at {message.time / 1e9:.3f} s: {error}."
            ) from error

    @property
    def damage(self) -> str:
        """What is missing in a damaged bag; "" if nothing is."""
        if isinstance(self._reader, Capture):
            return self._reader.damage
        found, first = self._reader, self._reader.first
        n_stated, last = _stated(self.path)
        unread = [*found.unread, *(name for name in _named(self.path) if not (self.path / name).is_file())]
        if not found.is_damaged and not unread and found.n_messages >= n_stated:
            return ""
        of_all = f" of {n_stated:,}" if n_stated else ""
        text = f"{found.n_messages:,}{of_all} messages in {(found.last - first) / 1e9:.1f} s are intact"
        if found.gaps:
            missing = sum(end - begin for begin, end in found.gaps) / NANOSECONDS
            begin, end = max(found.gaps, key=lambda gap: gap[1] - gap[0])
            text += (
                f"; {missing:.1f} s are missing, the longest gap from "
                f"{(begin - first) / 1e9:.1f} to {(end - first) / 1e9:.1f} s"
            )
        if unread:
            text += f"; nothing can be read of {', '.join(unread)}"
        if last:
            missing = max(0, last - found.last) / NANOSECONDS
            return text + f"; {missing:.1f} s at the end are missing" * (missing >= _LEAST_MISSING)
        return text + "; the file is cut off there, and does not state how much is missing" * found.is_cut

    def _opened(self) -> BagFiles:
        try:
            files = _files(self.path)
            if any(file.suffix == _PACKED for file in files):
                self._unpacked_files = tempfile.TemporaryDirectory()
                files = [_unpacked_file(file, Path(self._unpacked_files.name)) for file in files]
            return BagFiles(files, _unpacked, MAX_CHUNK_BYTES)
        except Exception as error:  # damaged bags raise many kinds
            repair = _REPAIRS.get(self.path.suffix, "'ros2 bag reindex' writes metadata.yaml again")
            raise DataError(
                f"{self.path} cannot be read as a ROS bag: {str(error).removesuffix('.')}. It is truncated, "
                f"damaged, or uses an unknown compression; {repair}."
            ) from error

    def _own_definitions(self) -> dict[str, Any]:
        """Definitions in the bag. One that cannot be parsed is left out."""
        found: dict[str, Any] = {}
        for c in self._connections:
            stated = ("MSG", _known(c.type)) if c.type in _PACKETS and not c.definition else c[3:5]
            if c.type not in found and (parsed := parsed_definitions(*stated, c.type)):
                found.update(parsed)
        return found


def _known(message_type: str) -> str:
    """The definition of a message with packets of a lidar."""
    package, (name, fields) = message_type.split("/")[0], _PACKETS[message_type]
    packet = f"{package}/{name}"
    return (
        f"std_msgs/Header header\n{packet}[] packets\n{'=' * 80}\nMSG: {packet}\n"
        f"builtin_interfaces/Time stamp\n{fields}\n"
    )


def _bag_file(path: Path) -> Path:
    """The file of the bag, or the folder with its metadata.yaml."""
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        files = _files(path)
        if len(files) == 1:
            return files[0]
        raise DataError(
            f"{path} has no metadata.yaml and {len(files)} bag files; give one file: "
            f"{', '.join(file.name for file in files) or '.bag, .mcap, .db3 or .pcap'}."
        )
    if path.is_file() and path.suffix not in _SUFFIXES:
        raise DataError(f"{path} does not end in {', '.join(_SUFFIXES)}; it is not a recording.")
    if path.is_file() and path.stat().st_size == 0:
        raise DataError(f"{path} is empty; record or copy it again.")
    return path


def _files(path: Path) -> list[Path]:
    """The files of a bag: those of its folder that metadata.yaml names, or all, or the file itself."""
    if not path.is_dir():
        return [path]
    found = [f for f in sorted(path.iterdir()) if f.name.removesuffix(_PACKED).endswith(_SUFFIXES)]
    named = _named(path)
    return [f for f in found if f.name in named] or found


def _metadata(path: Path) -> str:
    """The text of metadata.yaml in a bag's folder; "" without one."""
    if not (path / "metadata.yaml").is_file():
        return ""
    with (path / "metadata.yaml").open(encoding="utf-8", errors="replace") as file:
        return file.read(_MOST_METADATA)


def _named(path: Path) -> list[str]:
    """The names of files in metadata.yaml."""
    parts = {part.split(": ")[-1].strip(" -") for part in re.split(r"[\n/,'\"\[\]{}]", _metadata(path))}
    return sorted(part for part in parts if part.removesuffix(_PACKED).endswith((".mcap", ".db3")))


def _stated(path: Path) -> tuple[int, int]:
    """The number of messages and the time (ns) of the last one by metadata.yaml, or 0."""
    text = _metadata(path)
    patterns = (r"message_count: (\d{1,12})\b", r"_since_epoch: (\d{1,19})\b", r"nanoseconds: (\d{1,19})\b")
    n_messages, begin, duration = (int(found[1]) if (found := re.search(p, text)) else 0 for p in patterns)
    return n_messages, begin + duration


MAX_CHUNK_BYTES = 1 << 28
"""Limit of an unpacked chunk or message; recorders write chunks of about a megabyte."""

MAX_BAG_BYTES = 1 << 35
"""Limit of a ROS 2 bag file that is compressed as a whole, unpacked. It also takes at most half of the free
space of the temporary folder."""


def standard_definitions(is_ros1: bool) -> dict[str, Any]:
    """The message types of ROS 1 Noetic or ROS 2 Jazzy."""
    from rosbags.typesys import Stores, get_typestore

    return dict(get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_JAZZY).fielddefs)


def parsed_definitions(form: str, text: str, message_type: str) -> dict[str, Any]:
    """The types of a definition in a bag; empty if it is missing or cannot be parsed."""
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    try:
        if form == "MSG":
            return dict(get_types_from_msg(text, message_type))
        return dict(get_types_from_idl(text)) if form == "IDL" else {}
    except Exception:  # the parser raises its own and many built-in errors
        return {}


def _unpacked(data: bytes, compression: str, size: int) -> bytes:
    """A chunk or message, unpacked to at most a byte more than it announces. Raises `DataError`."""
    if compression in ("", "none"):
        return data
    limit = min(size, MAX_CHUNK_BYTES) + 1
    try:
        if compression == "bz2":
            return bz2.BZ2Decompressor().decompress(data, limit)
        if compression == "lz4":
            import lz4.frame

            return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, limit))
        if compression == "zstd":
            from rosbags.rosbag2.storage_mcap import zstd

            return bytes(zstd.ZstdDecompressor().decompress(data, limit))
    except Exception as error:  # each codec has errors of its own
        raise DataError(f"a chunk cannot be unpacked: {error}") from error
    raise DataError(f"the compression {compression!r} is not known")


def _unpacked_file(path: Path, folder: Path) -> Path:
    """A file of a bag that is compressed as a whole, unpacked into a folder; another one as it is."""
    from rosbags.rosbag2.storage_mcap import zstd

    if path.suffix != _PACKED:
        return path
    left = min(MAX_BAG_BYTES, shutil.disk_usage(folder).free // 2)
    with zstd.open(path, "rb") as packed, (folder / path.stem).open("wb") as file:
        while block := packed.read(_BLOCK_BYTES):
            left -= file.write(block)
            if left < 0:
                raise DataError(
                    f"the compressed bag unpacks to more than {MAX_BAG_BYTES:,} bytes, or to more than half "
                    f"of the free space of {folder}. If you trust it, unpack its files with 'zstd -d', and "
                    "write its metadata.yaml again with 'ros2 bag reindex'"
                )
    return folder / path.stem

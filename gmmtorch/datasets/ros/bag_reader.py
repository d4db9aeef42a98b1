"""Reads ROS bags: ROS 1 (.bag), ROS 2 SQLite (.db3) and MCAP (.mcap), with the package rosbags; and network
captures of lidars.

Bags are hostile input. Files are read within their length, compressed chunks are unpacked up to a limit, and
messages are decoded by `MessageDecoder`; definitions in a bag are used only for types that ROS does not have.
"""

from __future__ import annotations

import bz2
import io
import itertools
import logging
import re
import shutil
import tempfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any, BinaryIO, NamedTuple

from gmmtorch.datasets.packets.captures import SUFFIXES as CAPTURES
from gmmtorch.datasets.packets.sweeps import DEFINITION as SWEEP_DEFINITION
from gmmtorch.datasets.packets.sweeps import (
    SINGLE_PACKETS,
    SWEEP,
    CaptureMessages,
    Sweeps,
    definition,
    is_lidar,
    packed,
    packet_of,
)
from gmmtorch.datasets.ros.message_decoder import MessageDecoder
from gmmtorch.datasets.ros.salvage import QuerySteps, Salvage
from gmmtorch.datasets.trajectory import NANOSECONDS
from gmmtorch.errors import DataError, GmmTorchError
from gmmtorch.optional_packages import needs_extra

_log = logging.getLogger(__name__)
_SUFFIXES = (".bag", ".mcap", ".db3", *CAPTURES)
_ZSTD = b"\x28\xb5\x2f\xfd"
"""Start of a compressed message: the file alone, without metadata.yaml, does not state the compression."""
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


class DamagedBagError(DataError):
    """A bag cannot be read as a whole."""


class BagReader:
    """The topics and messages of one bag.

    Args:
        path: a .bag, .mcap or .db3 file, or the folder of a ROS 2 bag.
        is_salvaged: whether the intact part of a damaged bag is read.

    Raises `DamagedBagError`, which states a repair, if the bag is damaged, and `GmmTorchError` without
    rosbags.
    """

    def __init__(self, path: Path, is_salvaged: bool = False) -> None:
        self.path = _bag_file(path)
        self._is_ros1 = self.path.suffix == ".bag"
        with self._errors():
            self._reader: Any = self._salvaged() if is_salvaged else self._opened()
            self._connections = [
                c for c in self._reader.connections if isinstance(c.topic, str) and isinstance(c.msgtype, str)
            ]  # columns of a damaged database can be empty
            sweep = parsed_definitions(definition(SWEEP_DEFINITION), SWEEP)
            self._decoder = MessageDecoder(
                {
                    **self._own_definitions(),
                    **dict.fromkeys(SINGLE_PACKETS, sweep[SWEEP]),
                    **sweep,
                    **standard_definitions(self._is_ros1),
                },
                packed=self._is_ros1,
            )

    @property
    def topics(self) -> list[Topic]:
        """All topics by name. A topic with messages of two types is listed twice."""
        counts: dict[tuple[str, str], int] = {}
        for c in self._connections:
            counts[c.topic, c.msgtype] = counts.get((c.topic, c.msgtype), 0) + c.msgcount
        return [Topic(*key, count) for key, count in sorted(counts.items())]

    @property
    def is_ros1(self) -> bool:
        """Whether messages have the packed form of ROS 1, not CDR."""
        return self._is_ros1

    def fields(self, message_type: str) -> list[tuple[str, Any]]:
        """Names and kinds of the fields of a message type; empty if its definition is not known."""
        return list(self._decoder.definitions.get(message_type, ((), ()))[1])

    def messages(self, topics: Collection[str], start: int | None = None) -> Iterator[RawMessage]:
        """The messages of some topics in the order of recording, from time `start` (ns) on.

        Messages with single packets of a lidar are put together to sweeps with the time of the first one.
        """
        singles = {c.topic for c in self._connections if c.msgtype in SINGLE_PACKETS}
        return (self._messages if singles.isdisjoint(topics) else self._sweeps)(topics, start)

    def _sweeps(self, topics: Collection[str], start: int | None) -> Iterator[RawMessage]:
        """The messages, and sweeps in place of single packets."""
        turns: dict[tuple[str, str], Sweeps] = {}
        for message in self._messages(topics, start):
            if message.type not in SINGLE_PACKETS:
                yield message
                continue
            key, data = (message.topic, message.type), packet_of(message.data, self._is_ros1)
            if is_lidar(data):
                yield from self._sweep(*key, turns.setdefault(key, Sweeps()).add(message.time, data))
        for key, sweeps in turns.items():
            yield from self._sweep(*key, sweeps.rest())

    def _sweep(self, topic: str, kind: str, packets: list[tuple[int, bytes]]) -> Iterator[RawMessage]:
        if packets:
            data = packed(packets, SINGLE_PACKETS[kind], self._is_ros1)
            yield RawMessage(topic, kind, packets[0][0], data)

    def _messages(self, topics: Collection[str], start: int | None) -> Iterator[RawMessage]:
        """The messages as they are recorded."""
        chosen = [c for c in self._connections if c.topic in topics]
        if not chosen:
            return
        with self._errors():
            for connection, time, data in self._reader.messages(connections=chosen, start=start):
                content = bytes(data)
                if not self._is_ros1 and content.startswith(_ZSTD):  # CDR starts with a zero
                    content = unpack_zstd(content)
                yield RawMessage(connection.topic, connection.msgtype, time, content)

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
        """What is missing in a damaged bag whose intact part is read; "" if nothing is."""
        if not isinstance(self._reader, Salvage):
            return getattr(self._reader, "damage", "")
        found, first = self._reader, self._reader.first
        n_stated, end = _stated(self.path)
        of_all = f" of {n_stated:,}" if n_stated else ""
        text = f"{found.n_messages:,}{of_all} messages in {(found.last - first) / 1e9:.1f} s are intact"
        if found.gaps:
            longest = max(found.gaps, key=lambda gap: gap[1] - gap[0])
            text += (
                f"; {found.missing_seconds:.1f} s are missing, the longest gap from "
                f"{(longest[0] - first) / 1e9:.1f} to {(longest[1] - first) / 1e9:.1f} s"
            )
        if found.unread:
            text += f"; nothing can be read of {', '.join(found.unread)}"
        if end:
            missing = max(0, end - found.last) / NANOSECONDS
            return text + f"; {missing:.1f} s at the end are missing" * (missing >= _LEAST_MISSING)
        return text + "; the file is cut off there, and does not state how much is missing" * found.is_cut

    def _salvaged(self) -> Salvage | CaptureMessages:
        reader_class(self._is_ros1)  # puts limits on rosbags
        if self.path.suffix in CAPTURES:
            return CaptureMessages(self.path)
        try:
            return Salvage(_files(self.path), _unpack_chunk, MAX_CHUNK_BYTES)
        except DataError as error:
            raise DamagedBagError(str(error)) from error

    def _opened(self) -> Any:
        """The opened reader of a capture, or that of rosbags: of the folder, or of its only file if
        metadata.yaml is unusable."""
        if self.path.suffix in CAPTURES:
            capture = CaptureMessages(self.path)
            if capture.damage:
                raise DamagedBagError(f"{self.path} is damaged: {capture.damage}.")
            return capture
        for file in _files(self.path):
            _check_length(file)
        *tried, last = self.path, *_only_file(self.path)
        for path in tried:
            reader = reader_class(self._is_ros1)(_bounded(path))
            with suppress(Exception):  # the parser of metadata.yaml raises many kinds
                reader.open()
                if reader.connections:
                    return reader
        reader = reader_class(self._is_ros1)(_bounded(last))
        reader.open()
        if tried:
            _log.warning("%s/metadata.yaml is unusable; %s is read without it.", self.path, last.name)
        return reader

    def _own_definitions(self) -> dict[str, Any]:
        """Definitions in the bag. One that cannot be parsed is left out."""
        found: dict[str, Any] = {}
        for c in self._connections:
            stated = c.msgdef if c.msgdef.data or c.msgtype not in _PACKETS else _known(c.msgtype)
            if c.msgtype not in found and (parsed := parsed_definitions(stated, c.msgtype)):
                found.update(parsed)
        return found

    @contextmanager
    def _errors(self) -> Iterator[None]:
        """Turns every error of rosbags into a `DataError`; damaged bags raise many kinds of them."""
        try:
            yield
        except GmmTorchError:
            raise
        except Exception as error:
            reason = str(error) or type(error).__name__
            if reason.endswith("interrupted"):
                reason = "a query takes more steps than a file of this size needs"
            if "index" in reason and self._is_ros1:
                reason = f"{reason} (it was not closed)"
            repair = _REPAIRS.get(self.path.suffix, "'ros2 bag reindex' writes metadata.yaml again")
            raise DamagedBagError(
                f"{self.path} cannot be read as a ROS bag: {reason}. It is truncated, damaged, or uses an "
                f"unknown compression; {repair}."
            ) from error


def _known(message_type: str) -> SimpleNamespace:
    """The definition of a message with packets of a lidar."""
    package, (name, fields) = message_type.split("/")[0], _PACKETS[message_type]
    packet = f"{package}/{name}"
    return definition(
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
    """The files of a bag: those of its folder, or the file itself."""
    return [f for f in sorted(path.iterdir()) if f.suffix in _SUFFIXES] if path.is_dir() else [path]


def _metadata(path: Path) -> str:
    """The text of metadata.yaml in a bag's folder; "" of a file."""
    return (path / "metadata.yaml").read_text("utf-8", errors="replace") if path.is_dir() else ""


def _only_file(path: Path) -> list[Path]:
    """The file of a bag's folder, if there is one and metadata.yaml names no other."""
    files, text = _files(path), _metadata(path)
    named = {name.split(": ")[-1].strip(" -") for name in re.findall(r"[^\n/,'\"[]+\.(?:mcap|db3)\b", text)}
    return files if path.is_dir() and len(files) == 1 and named <= {files[0].name} else []


def _stated(path: Path) -> tuple[int, int]:
    """The number of messages and the time (ns) of the last one by metadata.yaml, or 0."""
    text = _metadata(path)
    patterns = (r"message_count: (\d{1,12})\b", r"_since_epoch: (\d{1,19})\b", r"nanoseconds: (\d{1,19})\b")
    n_messages, begin, duration = (int(found[1]) if (found := re.search(p, text)) else 0 for p in patterns)
    return n_messages, begin + duration


def _check_length(path: Path) -> None:
    """Raise `EOFError` if a SQLite file is shorter than its header states.

    Some versions of SQLite notice that only when they read a page that is missing.
    """
    with path.open("rb") as file:
        header = file.read(100)
    if not header.startswith(b"SQLite format 3\0") or header[24:28] != header[92:96]:
        return  # another format, or a header without a valid number of pages
    page = int.from_bytes(header[16:18], "big")
    expected = (65536 if page == 1 else page) * int.from_bytes(header[28:32], "big")
    if path.stat().st_size < expected:
        raise EOFError(f"it has {path.stat().st_size:,} of {expected:,} bytes")


class _BoundedFile(io.BufferedReader):
    """A file that allocates no more for reading than it has left."""

    def __init__(self, path: str) -> None:
        raw = io.FileIO(path)
        super().__init__(raw)
        self._length = raw.seek(0, io.SEEK_END)
        raw.seek(0)

    def read(self, size: int | None = -1, /) -> bytes:
        if size is not None and size >= 0:
            size = min(size, max(0, self._length - self.tell()))
        return super().read(size)


def _bounded(path: Path) -> Path:
    """The path, whose files are opened as `_BoundedFile`."""

    class BoundedPath(type(path)):  # type: ignore[misc]
        def open(self, mode: str = "r", *args: Any, **options: Any) -> Any:
            return _BoundedFile(str(self)) if mode == "rb" else super().open(mode, *args, **options)

    return BoundedPath(path)


# -- the package rosbags, with limits on what a hostile bag can make it allocate ---------------------


MAX_CHUNK_BYTES = 1 << 28
"""Limit of an unpacked chunk or message; recorders write chunks of about a megabyte."""

MAX_BAG_BYTES = 1 << 35
"""Limit of a ROS 2 bag file that is compressed as a whole, unpacked. It also takes at most half of the free
space of the temporary folder."""

_ZSTD_HEADER_BYTES = 18
_MOST_BRACKETS = 50  # in one another, in YAML
_MAGIC = {b"\x89MCAP0\r\n": ".mcap", b"SQLite f": ".db3"}


def reader_class(is_ros1: bool) -> Any:
    """The reader of ROS 1 or of ROS 2 bags, with limits. Raises `GmmTorchError` if rosbags does not load."""
    with needs_extra("ROS bags and network captures need", "rosbags", "bags"):
        import rosbags.rosbag1
        import rosbags.rosbag2
    ros1, ros2 = rosbags.rosbag1, rosbags.rosbag2
    _limit_parsers(ros1.reader, ros2.reader, ros2.storage_mcap, ros2.metadata, ros2.storage_sqlite3)
    return _limited_ros1_reader(ros1) if is_ros1 else _reader_by_magic(ros2)


def standard_definitions(is_ros1: bool) -> dict[str, Any]:
    """The message types of ROS 1 Noetic or ROS 2 Jazzy."""
    from rosbags.typesys import Stores, get_typestore

    return dict(get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_JAZZY).fielddefs)


def parsed_definitions(definition: Any, message_type: str) -> dict[str, Any]:
    """The types of a definition in a bag; empty if it is missing or cannot be parsed."""
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    try:
        if definition.format.name == "MSG":
            return dict(get_types_from_msg(definition.data, message_type))
        return dict(get_types_from_idl(definition.data)) if definition.format.name == "IDL" else {}
    except Exception:  # the parser raises its own and many built-in errors
        return {}


def unpack_zstd(data: bytes, limit: int = MAX_CHUNK_BYTES) -> bytes:
    """Unpack a compressed message or chunk. Raises `DataError` beyond `MAX_CHUNK_BYTES`."""
    from rosbags.rosbag2 import storage_mcap

    return _within(storage_mcap.zstd.ZstdDecompressor().decompress(data, _more(limit)))


def _unpack_bz2(data: bytes, limit: int = MAX_CHUNK_BYTES) -> bytes:
    return _within(bz2.BZ2Decompressor().decompress(data, _more(limit)))


def _unpack_lz4(data: bytes, limit: int = MAX_CHUNK_BYTES) -> bytes:
    import lz4.frame

    return _within(lz4.frame.LZ4FrameDecompressor().decompress(data, _more(limit)))


def _unpack_chunk(data: bytes, compression: str, size: int) -> bytes:
    """A chunk of a damaged bag, unpacked to at most a byte more than it announces."""
    if compression in ("", "none"):
        return data
    codecs = {"bz2": _unpack_bz2, "lz4": _unpack_lz4, "zstd": unpack_zstd}
    if compression not in codecs:
        raise DataError(f"the compression {compression!r} is not known")
    try:
        return codecs[compression](data, size)
    except Exception as error:  # each codec has errors of its own
        raise DataError(f"a chunk cannot be unpacked: {error}") from error


def _more(limit: int) -> int:
    return min(limit, MAX_CHUNK_BYTES) + 1


def _within(unpacked: bytes) -> bytes:
    if len(unpacked) > MAX_CHUNK_BYTES:
        raise DataError(f"A compressed chunk unpacks to more than {MAX_CHUNK_BYTES:,} bytes; it is damaged.")
    return unpacked


def _limit_parsers(ros1: Any, ros2: Any, mcap: Any, metadata: Any, sqlite: Any) -> None:
    """Put codecs and parsers with limits in the places where modules of rosbags look for theirs."""
    if not isinstance(sqlite.apsw, SimpleNamespace):  # the package itself, not yet ours
        sqlite.apsw = SimpleNamespace(**{**vars(sqlite.apsw), "Connection": _limited_database(sqlite.apsw)})
    ros2.YAML = metadata.YAML = _plain_yaml
    ros1.decompressors.update(bz2=_unpack_bz2, lz4=_unpack_lz4)
    mcap.DECOMPRESSORS.update(lz4=_unpack_lz4, zstd=unpack_zstd)
    ros2.zstd = SimpleNamespace(open=_limited_zstd_file(mcap.zstd), decompress=unpack_zstd)


def _plain_yaml(**options: Any) -> Any:
    """A parser of YAML that refuses aliases, with which a few lines become billions of entries, and brackets
    in brackets in brackets, each of which takes longer than the one around it."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError
    from ruamel.yaml.events import AliasEvent

    class PlainYaml(YAML):
        def load(self, stream: Any) -> Any:
            if "*" in stream and any(isinstance(one, AliasEvent) for one in YAML(**options).parse(stream)):
                raise YAMLError("aliases are not read")
            brackets = ((1 if found in "[{" else -1) for found in re.findall(r"[\[\]{}]", stream))
            if max(itertools.accumulate(brackets), default=0) > _MOST_BRACKETS:
                raise YAMLError("its brackets are nested too deeply")
            return super().load(stream)

    return PlainYaml(**options)


def _limited_database(apsw: Any) -> Any:
    class LimitedDatabase(apsw.Connection):
        """A database whose queries end, whatever views and generated columns it has."""

        def __init__(self, filename: str, *args: Any, **options: Any) -> None:
            super().__init__(filename, *args, **options)
            path = Path(filename.removeprefix("file:").removesuffix("?immutable=1"))
            steps = QuerySteps(path.stat().st_size)
            self.limit(apsw.SQLITE_LIMIT_LENGTH, MAX_CHUNK_BYTES)
            self.set_exec_trace(lambda *_: steps.begin())
            self.set_progress_handler(steps.is_over, QuerySteps.EACH_CALL)

    return LimitedDatabase


def _limited_zstd_file(zstd: Any) -> Any:
    class LimitedZstdFile(zstd.ZstdFile):
        """A compressed file that is not read further than `_most_bag_bytes`."""

        def __init__(self, packed: BinaryIO, mode: str = "rb") -> None:
            announced = zstd.get_frame_info(packed.read(_ZSTD_HEADER_BYTES)).decompressed_size
            packed.seek(0)
            self._left = _most_bag_bytes()
            _check_bag(self._left - (announced or 0))
            super().__init__(packed, mode)

        def read(self, size: int | None = -1) -> bytes:
            found: bytes = super().read(size)
            self._left -= len(found)
            _check_bag(self._left)
            return found

    return LimitedZstdFile


def _most_bag_bytes() -> int:
    return min(MAX_BAG_BYTES, shutil.disk_usage(tempfile.gettempdir()).free // 2)


def _check_bag(bytes_left: int) -> None:
    if bytes_left < 0:
        raise DataError(
            f"The compressed bag unpacks to more than {MAX_BAG_BYTES:,} bytes, or to more than half of the "
            f"free space of {tempfile.gettempdir()}. If you trust it, unpack its files with 'zstd -d', "
            "and write its metadata.yaml again with 'ros2 bag reindex'."
        )


def _reader_by_magic(rosbag2: Any) -> Any:
    class ReaderByMagic(rosbag2.Reader):
        """Knows the storage of a file by its first bytes, whatever its name."""

        def __init__(self, path: Any) -> None:
            super().__init__(path)
            if not path.is_dir():
                with path.open("rb") as file:
                    suffix = _MAGIC.get(file.read(8), path.suffix)
                self.storage = self.STORAGE_PLUGINS[suffix](path)

    return ReaderByMagic


def _limited_ros1_reader(rosbag1: Any) -> Any:
    class LimitedRos1Reader(rosbag1.Reader):
        """Reads each byte of the index once: chunks that share an index would multiply it."""

        _index_bytes = 0

        def read_index_data(self, pos: int, indexes: Any) -> None:
            before = self.bio.tell()
            super().read_index_data(pos, indexes)
            self._index_bytes += self.bio.tell() - before
            if self._index_bytes > self.path.stat().st_size:
                raise rosbag1.ReaderError("Bag index looks damaged: its parts overlap.")

    return LimitedRos1Reader

"""The messages of a ROS bag, and of a damaged one the intact part: chunks that are whole, or rows of a
database, wherever they are.

A ROS 1 bag and an MCAP file are sequences of records, most of them chunks of messages. After a damaged record
the next chunk is searched by its header. The index of a file is not needed, so a recording may be cut off.
"""

from __future__ import annotations

import mmap
import re
import struct
import zlib
from abc import ABC, abstractmethod
from array import array
from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gmmtorch.datasets.trajectory import NANOSECONDS
from gmmtorch.errors import DataError

Unpack = Callable[[bytes, str, int], bytes]
"""Unpacks a chunk: its data, its compression, and the number of bytes that it announces."""

_MOST_FIELD_BYTES = 1 << 24  # of a record's header in a ROS 1 bag, or of its definition of a message
_MOST_RATIO = 1000  # bytes of all chunks, packed and unpacked, for each byte of the file
_LEAST_MESSAGES, _MESSAGE_BYTES = 1 << 20, 4  # of a file: messages, or fewer bytes of the file for each
_KEPT_CHUNKS = 4  # unpacked, while messages of several are read in turn
_MCAP_CHUNK = struct.Struct("<QQQII")  # first and last time, unpacked bytes, CRC-32, length of a name

_Found = tuple[int, int, int, int]
"""A message: its time (ns), its connection, and two numbers by which its source finds it."""


class _Place(NamedTuple):
    """Where messages are: bytes of the file, packed. CRC-32 of the unpacked bytes; 0: not known."""

    begin: int
    end: int
    compression: str = ""
    size: int = 0
    crc: int = 0


class Connection(NamedTuple):
    """A topic of a recording: the type of its messages, and their definition in the form MSG or IDL."""

    id: int
    topic: str
    type: str
    form: str = ""
    definition: str = ""
    n_messages: int = 0


class BagFiles:
    """The messages of a bag, or those that a damaged one still has, in the order of recording.

    Args:
        files: .bag, .mcap or .db3 files of one recording.
        unpack: unpacks a chunk within limits. limit: bytes of a chunk or message, at most.

    Attributes:
        connections: topics, once for each file and type.
        n_messages: that can be read.
        gaps: (first, last) time (ns) of each interval between intact messages whose messages are lost.
        first, last: times (ns) of the first and the last one.
        is_damaged: whether a part of a file is not intact.
        is_cut: whether a file ends before its end, so that later messages may be missing, too.
        unread: names of files, one of several, of which nothing can be read.

    Raises `DataError` if a damaged bag has no message that can be read.
    """

    def __init__(self, files: Collection[Path], unpack: Unpack, limit: int) -> None:
        self._unpack, self._limit = unpack, limit
        self._sources: list[_Chunked | _Database] = []
        self.connections: list[Connection] = []
        self.gaps: list[tuple[int, int]] = []
        self.is_damaged = self.is_cut = False
        self.unread: list[str] = []
        parts = [np.empty((0, 5), np.int64)]
        for file in files:
            try:
                parts.append(self._added(file))
            except _ERRORS:
                if len(files) == 1:
                    raise
                self.unread.append(file.name)
                self.is_damaged = True
        rows = np.concatenate(parts)
        self.n_messages = len(rows)
        if self.is_damaged and not self.n_messages:
            faults = dict.fromkeys(source.fault for source in self._sources if source.fault)
            raise DataError(": ".join(["no message can be read", *faults]))
        self._rows = rows[np.argsort(rows[:, 0], kind="stable")]
        self.first, self.last = (int(time) for time in self._rows[[0, -1], 0]) if len(rows) else (0, 0)

    def _added(self, file: Path) -> np.ndarray:
        """Times, sources, connections, and two numbers (N, 5) of the messages of a file."""
        kinds: dict[str | bytes, type[_Chunked | _Database]] = {
            ".bag": _Ros1Bag,
            ".mcap": _Mcap,
            ".db3": _Database,
            _MCAP_MAGIC: _Mcap,
            _SQLITE_MAGIC: _Database,
        }
        with file.open("rb") as opened:  # a file may have another name than its content
            kind = kinds.get(opened.read(len(_MCAP_MAGIC))) or kinds[file.suffix]
        source = kind(file, self._unpack, self._limit)
        self._sources.append(source)
        found, last, is_after_loss = array("q"), None, False
        for messages, is_whole in source.parts():
            if messages:
                begin, end = min(messages)[0], max(messages)[0]
                if is_after_loss and last is not None and begin > last:
                    self.gaps.append((last, begin))
                last, is_after_loss = max(last or 0, end), False
            is_after_loss |= not is_whole
            self.is_damaged |= not is_whole
            for message in messages:
                found.extend(message)
        self.is_cut |= is_after_loss
        rows = np.array(found, np.int64).reshape(-1, 4)
        keys, place, counts = np.unique(rows[:, 1], return_inverse=True, return_counts=True)
        n_messages = dict(zip(keys.tolist(), counts.tolist(), strict=True))
        numbers = dict[int, int]()
        for key, connection in source.connections().items():
            numbers[key] = len(self.connections)
            one = connection._replace(id=numbers[key], n_messages=n_messages.get(key, 0))
            self.connections.append(one)
        ids = np.array([numbers.get(key, -1) for key in keys.tolist()], np.int64)[place]
        of = np.full_like(ids, len(self._sources) - 1)
        return np.column_stack([rows[:, 0], of, ids, rows[:, 2:]])[ids >= 0]

    def messages(
        self, connections: Collection[Connection], start: int | None = None
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """(connection, time in ns, content) of messages of some connections, from a time on."""
        wanted = np.isin(self._rows[:, 2], [connection.id for connection in connections])
        if start is not None:
            wanted &= self._rows[:, 0] >= start
        for row in np.flatnonzero(wanted):
            time, source, connection, one, two = self._rows[row].tolist()
            data = self._sources[source].content(one, two)
            if data is not None:
                yield self.connections[connection], time, data


def _connection(topic: str, kind: str, form: str, definition: str) -> Connection:
    package, _, name = kind.rpartition("/")
    return Connection(0, topic, kind if "/msg/" in kind else f"{package}/msg/{name}", form, definition)


_ERRORS = (DataError, ValueError, KeyError, IndexError, struct.error, OverflowError, OSError, RuntimeError)
"""What damaged records and the codecs of their chunks raise."""


class _Chunked(ABC):
    """A file of records. fault: the first damage that is found in it."""

    def __init__(self, path: Path, unpack: Unpack, limit: int) -> None:
        self._unpack, self._limit = unpack, limit
        self._places = [_Place(0, 0)]  # the first one: of messages outside of chunks
        size = path.stat().st_size
        self._left = limit + _MOST_RATIO * size
        self._n_left = _LEAST_MESSAGES + size // _MESSAGE_BYTES
        with path.open("rb") as file:
            self._data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        self._kept: dict[int, bytes] = {}
        self._connections: dict[int, Connection] = {}
        self.fault = ""

    def connections(self) -> dict[int, Connection]:
        """The connections by the numbers that messages have."""
        return self._connections

    def parts(self) -> Iterator[tuple[list[_Found], bool]]:
        """The messages (time in ns, connection, chunk, byte) of each part, and whether it is intact."""
        at: int | None = self._first()
        following: int | None
        while at is not None and at < len(self._data):
            try:
                following, found, is_whole = self._record(at)
            except _ERRORS as error:
                self.fault = self.fault or str(error)
                following, found, is_whole = self._next(at + 1), self._cut_off(at), False
            yield found, is_whole
            at = following
        yield [], self._is_complete()

    def content(self, chunk: int, byte: int) -> bytes | None:
        """The content of a message."""
        if chunk == 0:
            return self._message(self._data, byte)
        if chunk not in self._kept:
            while len(self._kept) >= _KEPT_CHUNKS:
                del self._kept[next(iter(self._kept))]
            self._kept[chunk] = self._unpacked(self._places[chunk])
        return self._message(self._kept[chunk], byte)

    def _record(self, at: int) -> tuple[int, list[_Found], bool]:
        """The place after a record, its messages, and whether it is intact. Raises an error if it is not."""
        place = self._chunk_at(at)
        if place is not None:
            return place.end, *self._chunk(place)
        end, found = self._read(self._data, at)
        return end, [(time, key, 0, byte) for time, key, byte in found], True

    def _unpacked(self, place: _Place) -> bytes:
        if max(place.size, place.end - place.begin) > self._limit:
            raise DataError("a chunk is too large")
        data = self._data[place.begin : place.end]
        found = self._unpack(data, place.compression, place.size)
        if len(found) != place.size or (place.crc and zlib.crc32(found) != place.crc):
            raise DataError("a chunk is damaged")
        return found

    def _chunk(self, place: _Place) -> tuple[list[_Found], bool]:
        """The messages of a chunk up to a damaged one, and whether all are intact."""
        self._spend(place)
        data, number = self._unpacked(place), len(self._places)
        self._places.append(place)
        found, is_whole = list[_Found](), False
        with suppress(*_ERRORS):
            at = 0
            while at < len(data):
                at, read = self._read(data, at)
                if len(found) + len(read) > self._n_left:
                    raise DataError("a file of this size has fewer messages")
                found += [(time, key, number, byte) for time, key, byte in read]
            is_whole = True
        self._n_left -= len(found)
        return found, is_whole

    def _spend(self, place: _Place) -> None:
        """Counts the bytes of a chunk. Raises `DataError` if all chunks, which may overlap, have too many."""
        left = self._left - place.size - (place.end - place.begin)
        if left < 0:
            raise DataError("chunks that overlap have too many bytes")
        self._left = left

    def _cut_off(self, at: int) -> list[_Found]:
        """The messages of a chunk that the end of the file cuts off, up to there."""
        with suppress(*_ERRORS):
            place = self._chunk_at(at, is_cut=True)
            if place is not None:
                end = min(len(self._data), place.begin + self._limit)
                self._spend(_Place(place.begin, end, size=min(place.size, self._limit)))
                data = self._unpack(self._data[place.begin : end], place.compression, place.size)
                return self._chunk(_Place(place.begin, end, place.compression, len(data)))[0]
        return []

    @abstractmethod
    def _first(self) -> int:
        """The place of the first record. Raises `DataError` if the file is of another kind."""

    @abstractmethod
    def _next(self, at: int) -> int | None:
        """The place of the next chunk from a byte on."""

    @abstractmethod
    def _chunk_at(self, at: int, is_cut: bool = False) -> _Place | None:
        """The chunk of the record at a byte, which ends after the file if it `is_cut`; None if the record is
        another one. Raises an error if it is damaged."""

    @abstractmethod
    def _read(self, data: Any, at: int) -> tuple[int, list[tuple[int, int, int]]]:
        """The place after a record that is no chunk, and its message: time, connection, byte. Raises an error
        if it is damaged."""

    @abstractmethod
    def _message(self, data: Any, byte: int) -> bytes:
        """The content of the message in a record."""

    @abstractmethod
    def _is_complete(self) -> bool:
        """Whether the file has the end that a closed one has."""


_BAG_MAGIC = b"#ROSBAG V2.0\n"
_CONNECTION, _CHUNK, _MESSAGE, _CHUNK_INFO = 7, 5, 2, 6
_CHUNK_HEADER = 128  # bytes before the field op in the header of a chunk, at most


class _Ros1Bag(_Chunked):
    """A bag of ROS 1, format 2.0."""

    _has_index = False

    def _first(self) -> int:
        if self._data[: len(_BAG_MAGIC)] != _BAG_MAGIC:
            raise DataError("it does not begin as a ROS 1 bag of format 2.0")
        return len(_BAG_MAGIC)

    def _chunk_at(self, at: int, is_cut: bool = False) -> _Place | None:
        fields, begin, end = _ros1_record(self._data, at, is_cut)
        if fields[b"op"][0] != _CHUNK:
            return None
        (size,) = struct.unpack("<I", fields[b"size"])
        return _Place(begin, end, fields[b"compression"].decode(), size)

    def _read(self, data: Any, at: int) -> tuple[int, list[tuple[int, int, int]]]:
        fields, begin, end = _ros1_record(data, at)
        kind = fields[b"op"][0]
        if kind == _MESSAGE:
            seconds, nanoseconds = struct.unpack("<II", fields[b"time"])
            return end, [(seconds * NANOSECONDS + nanoseconds, *struct.unpack("<I", fields[b"conn"]), at)]
        if kind == _CONNECTION:
            self._note(fields, data[begin:end])
        self._has_index |= kind == _CHUNK_INFO
        return end, []

    def _next(self, at: int) -> int | None:
        while (found := self._data.find(b"\4\0\0\0op=\5", at)) >= 0:
            for start in range(max(at, found - _CHUNK_HEADER), found - 3):
                with suppress(DataError, struct.error):
                    fields, _, _ = _ros1_record(self._data, start, most=2 * _CHUNK_HEADER)
                    if fields.get(b"op") == b"\5" and {b"size", b"compression"} <= fields.keys():
                        return start
            at = found + 1
        return None

    def _message(self, data: Any, byte: int) -> bytes:
        _, begin, end = _ros1_record(data, byte)
        return data[begin:end]

    def _note(self, fields: dict[bytes, bytes], content: bytes) -> None:
        (key,) = struct.unpack("<I", fields[b"conn"])
        about = _ros1_fields(content)
        text = [about.get(name, b"").decode(errors="replace") for name in (b"type", b"message_definition")]
        topic = fields[b"topic"].decode(errors="replace")
        topic = ("/" if topic.startswith("/") else "") + "/".join(filter(None, topic.split("/")))
        self._connections[key] = _connection(topic, text[0], "MSG", text[1])

    def _is_complete(self) -> bool:
        return self._has_index


def _ros1_record(
    data: Any, at: int, is_cut: bool = False, most: int = _MOST_FIELD_BYTES
) -> tuple[dict[bytes, bytes], int, int]:
    """The fields of a record's header, of at most `most` bytes, and where its content begins and ends; only
    after the file if it `is_cut`."""
    (length,) = struct.unpack("<I", data[at : at + 4])
    begin = at + 8 + length
    if length > most or begin > len(data):
        raise DataError("a header is too long")
    (size,) = struct.unpack("<I", data[begin - 4 : begin])
    if (begin + size > len(data)) != is_cut:
        raise DataError("a record is cut off")
    return _ros1_fields(data[at + 4 : begin - 4]), begin, begin + size


def _ros1_fields(header: bytes) -> dict[bytes, bytes]:
    fields, at = {}, 0
    while at < len(header):
        (length,) = struct.unpack("<I", header[at : at + 4])
        name, sign, value = header[at + 4 : at + 4 + length].partition(b"=")
        at += 4 + length
        if not sign or at > len(header):
            raise DataError("a header is damaged")
        fields[name] = value
    return fields


_MCAP_MAGIC = b"\x89MCAP0\r\n"
_MCAP_SCHEMA, _MCAP_CHANNEL, _MCAP_MESSAGE, _MCAP_CHUNK_OP = 3, 4, 5, 6
_MCAP_FOOTER, _LAST_KIND = 2, 0x0F
_CHUNK_BEGIN = re.compile(b"\6(?=.{5}\0\0\0)", re.DOTALL)  # a chunk is smaller than 2⁴⁰ bytes
_MCAP_FORMS = {"ros2msg": "MSG", "ros2idl": "IDL", "omgidl": "IDL"}


class _Mcap(_Chunked):
    """An MCAP file of ROS 2."""

    def __init__(self, path: Path, unpack: Unpack, limit: int) -> None:
        super().__init__(path, unpack, limit)
        self._schemas: dict[int, tuple[str, str, str]] = {}
        self._channels: dict[int, tuple[int, str]] = {}

    def connections(self) -> dict[int, Connection]:
        return {
            key: _connection(topic, *self._schemas[schema])
            for key, (schema, topic) in self._channels.items()
            if schema in self._schemas
        }

    def _first(self) -> int:
        if self._data[: len(_MCAP_MAGIC)] != _MCAP_MAGIC:
            raise DataError("it does not begin as an MCAP file")
        begin, end = _mcap_record(self._data, len(_MCAP_MAGIC))
        profile, _ = _mcap_text(self._data[begin:end], 0)
        if profile != "ros2":
            raise DataError(f"its profile is {profile!r}, not ros2")
        return end

    def _chunk_at(self, at: int, is_cut: bool = False) -> _Place | None:
        if self._data[at] != _MCAP_CHUNK_OP:
            return None
        begin, end = _mcap_record(self._data, at, is_cut)
        _, _, size, crc, length = _MCAP_CHUNK.unpack_from(self._data, begin)
        at = begin + _MCAP_CHUNK.size
        (n_bytes,) = struct.unpack_from("<Q", self._data, at + length)
        if length > 16 or at + length + 8 + n_bytes != end:
            raise DataError("a chunk is damaged")
        return _Place(at + length + 8, end, self._data[at : at + length].decode(), size, crc)

    def _next(self, at: int) -> int | None:
        for found in _CHUNK_BEGIN.finditer(self._data, at):
            with suppress(DataError, struct.error, ValueError):
                place = self._chunk_at(found.start())
                if place is not None and place.compression in ("", "lz4", "zstd"):
                    return found.start()
        return None

    def _read(self, data: Any, at: int) -> tuple[int, list[tuple[int, int, int]]]:
        begin, end = _mcap_record(data, at)
        kind = data[at]
        if kind == _MCAP_MESSAGE:
            key, _, time = struct.unpack_from("<HIQ", data, begin)
            if time >= 1 << 63:
                raise DataError("a time is damaged")
            return end, [(time, key, at)]
        if not 0 < kind <= _LAST_KIND:
            raise DataError("a record of an unknown kind")
        if kind in (_MCAP_SCHEMA, _MCAP_CHANNEL):
            self._note(kind, data[begin:end])
        return (len(data) if kind == _MCAP_FOOTER else end), []  # the footer is the last record

    def _message(self, data: Any, byte: int) -> bytes:
        begin, end = _mcap_record(data, byte)
        return bytes(data[begin + 22 : end])

    def _note(self, kind: int, content: bytes) -> None:
        (key,) = struct.unpack_from("<H", content)
        if kind == _MCAP_SCHEMA:
            name, at = _mcap_text(content, 2)
            encoding, at = _mcap_text(content, at)
            self._schemas[key] = name, _MCAP_FORMS.get(encoding, ""), _mcap_text(content, at)[0]
        else:
            topic, at = _mcap_text(content, 4)
            if _mcap_text(content, at)[0] == "cdr":
                self._channels[key] = struct.unpack_from("<H", content, 2)[0], topic

    def _is_complete(self) -> bool:
        return self._data[-len(_MCAP_MAGIC) :] == _MCAP_MAGIC


def _mcap_record(data: Any, at: int, is_cut: bool = False) -> tuple[int, int]:
    """Where the content of a record begins and ends; only after the file if it `is_cut`."""
    (length,) = struct.unpack("<Q", data[at + 1 : at + 9])
    if (at + 9 + length > len(data)) != is_cut:
        raise DataError("a record is cut off")
    return at + 9, at + 9 + length


def _mcap_text(content: bytes, at: int) -> tuple[str, int]:
    (length,) = struct.unpack_from("<I", content, at)
    if at + 4 + length > len(content):
        raise DataError("a text is cut off")
    return content[at + 4 : at + 4 + length].decode(errors="replace"), at + 4 + length


_SQLITE_MAGIC = b"SQLite f"
_MOST_LOST_ROWS = 1 << 40
_STEPS_EACH_CALL = 10_000  # steps of SQLite's virtual machine between two calls that count them
_LEAST_CALLS, _BYTES_EACH_CALL = 2000, 10  # of a query, which takes a number of steps by the file's size
_NEXT_ROW = "SELECT rowid, timestamp, topic_id FROM messages WHERE rowid > ? ORDER BY rowid LIMIT 1"


class _Database:
    """A database of ROS 2, whose rows are read one after the other; rows in damaged pages are passed over."""

    fault = ""

    def __init__(self, path: Path, unpack: Unpack, limit: int) -> None:
        import sqlite3

        self._error = sqlite3.Error
        self._database = sqlite3.connect(f"{path.resolve().as_uri()}?immutable=1", uri=True)
        self._database.text_factory = lambda data: data.decode(errors="replace")
        self._database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, limit)
        self._n_calls, self._most_calls = 0, _LEAST_CALLS + path.stat().st_size // _BYTES_EACH_CALL
        self._database.set_trace_callback(self._begin)
        self._database.set_progress_handler(self._is_over, _STEPS_EACH_CALL)
        self._database.execute("PRAGMA trusted_schema=OFF")
        self._database.execute("PRAGMA writable_schema=ON")  # opens a file that is shorter than it states
        query = "SELECT count(*) FROM sqlite_master WHERE type='table' AND name IN ('messages', 'topics')"
        with suppress(self._error):
            if self._database.execute(query).fetchone() == (2,):
                return
        raise DataError("it has no readable tables of messages and topics")

    def _begin(self, query: str) -> None:
        self._n_calls = 0

    def _is_over(self) -> bool:
        """Whether a query has taken too many steps: a view of a hostile file could take them without end."""
        self._n_calls += 1
        return self._n_calls > self._most_calls

    def connections(self) -> dict[int, Connection]:
        """The topics by their numbers."""
        texts: dict[str, tuple[str, str]] = {}
        with suppress(self._error):  # older recordings have no definitions
            query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            for kind, form, text in self._database.execute(query):
                texts[kind] = _MCAP_FORMS.get(form, ""), text
        return {
            key: _connection(topic, kind, *texts.get(kind, ("", "")))
            for key, topic, kind in self._database.execute("SELECT id, name, type FROM topics")
            if isinstance(topic, str) and isinstance(kind, str)
        }

    def parts(self) -> Iterator[tuple[list[_Found], bool]]:
        """The message (time in ns, topic, row, 0) of each row, and True; none, and False, for lost rows."""
        row: int | None = -1
        while row is not None:
            try:
                found = self._row_after(row)
            except (self._error, OverflowError):
                row = self._next(row)
                yield [], False
                continue
            if found is None:
                break
            row, time, topic = found
            if isinstance(time, int) and isinstance(topic, int):
                yield [(time, topic, row, 0)], True

    def _next(self, row: int) -> int | None:
        """The row before the next one that is intact; None without one."""
        low, high = row, row + 1
        while not self._is_intact_after(high):
            low, high = high, high + 2 * (high - row)
            if high - row > _MOST_LOST_ROWS:
                return None
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (low, middle) if self._is_intact_after(middle) else (middle, high)
        return high

    def _is_intact_after(self, row: int) -> bool:
        """Whether the row after `row` is intact, or there is none."""
        try:
            self._row_after(row)
        except (self._error, OverflowError):
            return False
        return True

    def _row_after(self, row: int) -> Any:
        """(row, time, topic) of the next row; None at the end. Raises an error if its page is damaged."""
        found = self._database.execute(_NEXT_ROW, (row,)).fetchone()
        if found is not None and found[0] <= row:  # in a page that is another one
            raise self._error("rows are out of order")
        return found

    def content(self, row: int, _: int) -> bytes | None:
        """The content of a message; None if it is damaged."""
        try:
            found = self._database.execute("SELECT data FROM messages WHERE rowid = ?", (row,)).fetchone()
        except self._error:
            return None
        return found[0] if found and isinstance(found[0], bytes) else None

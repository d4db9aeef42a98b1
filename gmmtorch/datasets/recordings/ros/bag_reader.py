"""Reads ROS bags: ROS 1 (.bag), ROS 2 SQLite (.db3) and MCAP (.mcap), with the package rosbags.

Bags are hostile input. Files are read within their length, compressed chunks are unpacked up to a limit, and
messages are decoded by `MessageDecoder`; definitions in a bag are used only for types that ROS does not have.
"""

from __future__ import annotations

import io
import logging
import re
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

from gmmtorch.datasets.recordings.ros.message_decoder import MessageDecoder
from gmmtorch.datasets.recordings.ros.rosbags_access import (
    parsed_definitions,
    reader_class,
    standard_definitions,
    unpack_zstd,
)
from gmmtorch.errors import DataError, GmmTorchError

_log = logging.getLogger(__name__)
_SUFFIXES = (".bag", ".mcap", ".db3")
_ZSTD = b"\x28\xb5\x2f\xfd"
"""Start of a compressed message: the file alone, without metadata.yaml, does not state the compression."""
_REPAIRS = {
    ".bag": "'rosbag reindex' repairs a recording that was interrupted",
    ".mcap": "'mcap recover' repairs a recording that was interrupted",
    ".db3": "'ros2 bag reindex' or sqlite3's '.recover' repairs a recording that was interrupted",
}


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

    Args:
        path: a .bag, .mcap or .db3 file, or the folder of a ROS 2 bag.

    Raises `DataError`, which states a repair, if the bag is damaged, and `GmmTorchError` without rosbags.
    """

    def __init__(self, path: Path) -> None:
        self.path = _bag_file(path)
        self._is_ros1 = self.path.suffix == ".bag"
        with self._errors():
            for file in sorted(self.path.glob("*.db3")) if self.path.is_dir() else [self.path]:
                _check_length(file)
            self._reader: Any = self._opened()
            self._connections = [
                c for c in self._reader.connections if isinstance(c.topic, str) and isinstance(c.msgtype, str)
            ]  # columns of a damaged database can be empty
            self._decoder = MessageDecoder(
                {**self._own_definitions(), **standard_definitions(self._is_ros1)},
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
        """The messages of some topics in the order of recording, from time `start` (ns) on."""
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

    def _opened(self) -> Any:
        """The opened reader of rosbags: of the folder, or of its only file if metadata.yaml is unusable."""
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
            if c.msgtype not in found and (parsed := parsed_definitions(c.msgdef, c.msgtype)):
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
            if "index" in reason and self._is_ros1:
                reason = f"{reason} (it was not closed)"
            repair = _REPAIRS.get(self.path.suffix, "'ros2 bag reindex' writes metadata.yaml again")
            raise DataError(
                f"{self.path} cannot be read as a ROS bag: {reason}. It is truncated, damaged, or uses an "
                f"unknown compression; {repair}."
            ) from error


def _bag_file(path: Path) -> Path:
    """The file of the bag, or the folder with its metadata.yaml."""
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        files = [file for file in sorted(path.iterdir()) if file.suffix in _SUFFIXES]
        if len(files) == 1:
            return files[0]
        raise DataError(
            f"{path} has no metadata.yaml and {len(files)} bag files; give one file: "
            f"{', '.join(file.name for file in files) or '.bag, .mcap or .db3'}."
        )
    if path.is_file() and path.suffix not in _SUFFIXES:
        raise DataError(f"{path} does not end in {', '.join(_SUFFIXES)}; it is not a ROS bag.")
    if path.is_file() and path.stat().st_size == 0:
        raise DataError(f"{path} is empty; record or copy it again.")
    return path


def _only_file(path: Path) -> list[Path]:
    """The file of a bag's folder, if there is one and metadata.yaml names no other."""
    metadata = path / "metadata.yaml"
    if not metadata.is_file():
        return []
    files = [file for file in path.iterdir() if file.suffix in _SUFFIXES]
    text = metadata.read_text("utf-8", errors="replace")
    named = {name.split(": ")[-1].strip(" -") for name in re.findall(r"[^\n/,'\"[]+\.(?:mcap|db3)\b", text)}
    return files if len(files) == 1 and named <= {files[0].name} else []


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

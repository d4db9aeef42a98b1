"""A journal as bytes: a log of datagrams in frames, and snapshots of a replica. See docs/replica.md."""

from __future__ import annotations

import hashlib
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gmmtorch.errors import DataError
from gmmtorch.files import joined_tensors, pack_tensors, split_tensors, unpack_tensors
from gmmtorch.sharing.messages.envelope import MAX_BYTES

VERSION = 1
_MAGIC = b"gmmtlog"
_HEADER = struct.Struct("<7sBHII")  # magic, version, robot, incarnation, CRC-32 of what precedes it
_MARK = b"\xa7\x5c"
_FRAME = struct.Struct("<2sHI")  # mark, length, CRC-32 of the length and the datagram
_SNAPSHOT_KIND = "replica"
_DIGEST_BYTES = 16


@dataclass(frozen=True)
class Log:
    """What a log holds.

    robot, incarnation: who wrote it; None where that cannot be read any more.
    n_torn: bytes at the end of which the rest was never written, as when a process is killed while it writes.
    n_damaged: bytes that were whole once.
    """

    robot: int | None
    incarnation: int | None
    datagrams: list[bytes]
    n_torn: int
    n_damaged: int


def log_header(robot: int, incarnation: int) -> bytes:
    """What a log begins with."""
    fields = _HEADER.pack(_MAGIC, VERSION, robot, incarnation, 0)[:-4]
    return fields + zlib.crc32(fields).to_bytes(4, "little")


def framed(datagram: bytes) -> bytes:
    """A datagram as it stands in a log."""
    return _FRAME.pack(_MARK, len(datagram), _checksum(datagram)) + datagram


def read_log(data: bytes, path: Path) -> Log:
    """All datagrams that are whole, whatever lies between them.

    Raises `DataError` for the log of another version; `path` is where it was found.
    """
    robot = incarnation = None
    begin, n_torn, n_damaged = 0, 0, 0
    header = data[: _HEADER.size]
    if len(header) == _HEADER.size and zlib.crc32(header[:-4]) == int.from_bytes(header[-4:], "little"):
        magic, version, robot, incarnation, _ = _HEADER.unpack(header)
        if (magic, version) != (_MAGIC, VERSION):
            raise DataError(
                f"{path} is a log of version {version}; this gmmtorch reads version {VERSION}. Update it, or "
                "give the journal another folder."
            )
        begin = _HEADER.size
    elif len(data) < _HEADER.size and _could_be(data, _MAGIC + bytes([VERSION])):
        return Log(None, None, [], len(data), 0)
    datagrams: list[bytes] = []
    while begin < len(data):
        datagram = _datagram_at(data, begin)
        if datagram is not None:
            datagrams.append(datagram)
            begin += _FRAME.size + len(datagram)
            continue
        # Its length may be what is damaged: the next frame is wherever one is whole.
        next_begin = _next_frame(data, begin + 1)
        if next_begin == len(data) and _is_torn(data[begin:]):
            n_torn = len(data) - begin
        else:
            n_damaged += next_begin - begin
        begin = next_begin
    return Log(robot, incarnation, datagrams, n_torn, n_damaged)


def _checksum(datagram: bytes) -> int:
    return zlib.crc32(datagram, zlib.crc32(len(datagram).to_bytes(2, "little")))


def _datagram_at(data: bytes, begin: int) -> bytes | None:
    """The datagram of the frame that begins there, if it is whole."""
    if len(data) - begin < _FRAME.size:
        return None
    mark, length, checksum = _FRAME.unpack_from(data, begin)
    datagram = data[begin + _FRAME.size : begin + _FRAME.size + length]
    if mark != _MARK or not 0 < length <= MAX_BYTES or len(datagram) < length:
        return None
    return datagram if _checksum(datagram) == checksum else None


def _next_frame(data: bytes, begin: int) -> int:
    """Where the next whole frame begins; the end if there is none."""
    while (begin := data.find(_MARK, begin)) >= 0:
        if _datagram_at(data, begin) is not None:
            return begin
        begin += 1
    return len(data)


def _is_torn(tail: bytes) -> bool:
    """Whether it is the beginning of a frame, as far as it goes."""
    if len(tail) < _FRAME.size:
        return _could_be(tail, _MARK)
    mark, length, _ = _FRAME.unpack_from(tail)
    return bool(mark == _MARK and length <= MAX_BYTES and len(tail) < _FRAME.size + length)


def _could_be(data: bytes, known: bytes) -> bool:
    return data[: len(known)] == known[: len(data)]


def pack_snapshot(state: dict[str, Any], robot: int, incarnation: int) -> bytes:
    """A replica's state as a file: BLAKE2b of the rest (16 bytes), and a safetensors file."""
    tree, tensors = split_tensors(state)
    about = {"tree": tree, "robot": robot, "incarnation": incarnation}
    data = pack_tensors(tensors, _SNAPSHOT_KIND, VERSION, **about)
    return _digest(data) + data


def is_sound(data: bytes) -> bool:
    """Whether these are, to the bit, bytes that `pack_snapshot` made, or somebody who means to deceive."""
    return data[:_DIGEST_BYTES] == _digest(memoryview(data)[_DIGEST_BYTES:])


def unpack_snapshot(data: bytes, path: Path) -> tuple[dict[str, Any], int, int]:
    """State, robot and incarnation of sound bytes. Raises `DataError` for another version, or no snapshot."""
    tensors, about = unpack_tensors(data[_DIGEST_BYTES:], path, _SNAPSHOT_KIND, VERSION)
    try:
        state = joined_tensors(about["tree"], tensors)
        return state, int(about["robot"]), int(about["incarnation"])
    except (KeyError, TypeError, ValueError, ArithmeticError, RecursionError) as error:
        raise DataError(f"{path} is no snapshot of a replica ({error!r}).") from error


def _digest(data: bytes | memoryview) -> bytes:
    return hashlib.blake2b(data, digest_size=_DIGEST_BYTES).digest()

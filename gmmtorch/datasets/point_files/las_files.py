"""LAS and LAZ files. Headers are checked against the size of the file before anything is allocated.

Offsets are those of the LAS specification 1.4 (ASPRS) and of the LASzip specification of its chunk table.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from gmmtorch.datasets.point_files.point_rows import AXES, check_count
from gmmtorch.errors import DataError, GmmTorchError
from gmmtorch.optional_packages import needs_extra

_LAS_BLOCK_BYTES = 1 << 25
"""Limit of one read: a point may announce 64 kB of extra bytes."""
_HEADER = struct.Struct("<4s20x2B68xHIIBHI")  # to the number of points, 111 bytes
_HEADER_BYTES = {0: 227, 1: 227, 2: 227, 3: 235, 4: 375, 5: 393}
_RECORD_HEADER = struct.Struct("<2x16sHH32x")
_COMPRESSED = 0x80
_LASZIP = (b"laszip encoded", 22204)
_LASZIP_ITEMS = 34
_LASZIP_CHUNK = 12
_MAX_CHUNK_POINTS = 1 << 22
"""Writers use 50 000. The decompressor allocates about 32 bytes for each point of a chunk."""
_CHUNKS_VARY = 0xFFFFFFFF


def read_las_header(path: Path) -> tuple[int, int]:
    """The number of points of a LAS or LAZ file, and the bytes of an uncompressed point.

    Raises `DataError` if the file is shorter than its header, its variable-length records, its chunk table
    or its uncompressed points.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(_HEADER_BYTES[5])
        if len(head) < _HEADER_BYTES[0] or head[:4] != b"LASF":
            raise _damaged(path, "it does not begin with a LAS header")
        _, major, minor, header_size, data_start, n_records, form, point_bytes, n_points = (
            _HEADER.unpack_from(head)
        )
        if major != 1 or minor not in _HEADER_BYTES or len(head) < _HEADER_BYTES[minor]:
            raise _damaged(path, f"its version {major}.{minor} is not one of 1.0 to 1.5")
        if minor >= 4:
            (n_points,) = struct.unpack_from("<Q", head, 247)
        if not _HEADER_BYTES[minor] <= header_size <= data_start <= size:
            raise _damaged(
                path,
                f"its header of {header_size} bytes and points from byte {data_start} need more than {size}",
            )
        if n_records * _RECORD_HEADER.size > data_start - header_size:
            raise _damaged(path, f"{n_records} variable-length records do not fit before its points")
        if point_bytes < 20:
            raise _damaged(path, f"a point has {point_bytes} bytes; at least 20 are needed")
        if form & _COMPRESSED:
            file.seek(header_size)
            record = _laszip_record(path, file.read(data_start - header_size), n_records, point_bytes)
            _check_chunks(path, file, data_start, size, n_points, record)
        elif n_points * point_bytes > size - data_start:
            raise _damaged(
                path,
                f"it announces {n_points} points of {point_bytes} bytes, but has {size - data_start} bytes",
            )
    return n_points, point_bytes


def _laszip_record(path: Path, records: bytes, n_records: int, point_bytes: int) -> bytes:
    """The compressor's record, if it describes points of `point_bytes`."""
    start = 0
    for _ in range(n_records):
        if start + _RECORD_HEADER.size > len(records):
            break
        user, number, length = _RECORD_HEADER.unpack_from(records, start)
        start += _RECORD_HEADER.size
        content = records[start : start + length]
        start += length
        if (user.split(b"\0")[0], number) != _LASZIP:
            continue
        count = (
            struct.unpack_from("<H", content, _LASZIP_ITEMS - 2)[0] if len(content) >= _LASZIP_ITEMS else 0
        )
        items = content[_LASZIP_ITEMS : _LASZIP_ITEMS + 6 * count]
        widths = (
            [width for _, width, _ in struct.iter_unpack("<HHH", items)] if len(items) == 6 * count else []
        )
        if sum(widths) != point_bytes:
            raise _damaged(path, "its LASzip record does not describe its points")
        (chunk_points,) = struct.unpack_from("<I", content, _LASZIP_CHUNK)
        if chunk_points > _MAX_CHUNK_POINTS and chunk_points != _CHUNKS_VARY:
            raise _damaged(
                path, f"its chunks have {chunk_points:,} points; at most {_MAX_CHUNK_POINTS:,} are read"
            )
        return content
    raise _damaged(path, "its points are compressed, but the LASzip record is missing")


def _check_chunks(
    path: Path, file: BinaryIO, data_start: int, size: int, n_points: int, record: bytes
) -> None:
    """Checks the position, the length and the sums of the table of compressed chunks.

    A chunk has at least one byte; the decompressor allocates the whole table, and each chunk.
    """
    import lazrs

    file.seek(data_start)
    start = file.read(8)
    table = struct.unpack("<q", start)[0] if len(start) == 8 else -1
    if table == -1 and len(start) == 8:  # written to a stream: the position is at the end of the file
        file.seek(max(data_start, size - 8))
        table = struct.unpack("<q", file.read(8).rjust(8, b"\0"))[0]
    if n_points == 0:
        return
    if not data_start + 8 <= table <= size - 8:
        raise _damaged(path, f"its table of chunks at byte {table} is outside of its {size} bytes")
    file.seek(table + 4)
    (n_chunks,) = struct.unpack("<I", file.read(4))
    if n_chunks > table - data_start - 8:
        raise _damaged(path, f"{n_chunks} chunks do not fit into {table - data_start - 8} bytes")
    file.seek(data_start)
    chunks = lazrs.read_chunk_table(file, lazrs.LazVlr(record))
    if sum(n_bytes for _, n_bytes in chunks) > table - data_start - 8:
        raise _damaged(path, f"its chunks do not fit into {table - data_start - 8} bytes")
    if max(count for count, _ in chunks) > _MAX_CHUNK_POINTS:
        raise _damaged(path, f"a chunk has more than {_MAX_CHUNK_POINTS:,} points")


def _damaged(path: Path, reason: str) -> DataError:
    return DataError(
        f"{path} cannot be read as LAS or LAZ: {reason}; it is truncated or damaged. Write or fetch it again."
    )


class LasRows:
    """The points of a LAS or LAZ file, in the file's frame, float64, with scale and offset applied; or its
    dimensions of these names.

    Attributes:
        fields: the types of all dimensions.
    """

    def __init__(self, path: Path, names: Sequence[str] = AXES) -> None:
        with needs_extra(f"{path}: LAS and LAZ files need", "laspy", "formats"):
            import laspy
            import lazrs  # noqa: F401  used by laspy
        self._laspy: Any = laspy
        self._path, self._names, self.dim = path, names, len(names)
        self.name = path.stem
        with _las_errors(path):
            self.n_rows, self._point_bytes = read_las_header(path)
        with _las_errors(path), self._open() as reader:
            if int(reader.header.point_count) != self.n_rows:
                raise DataError(f"{path} announces two numbers of points; it is damaged. Write it again.")
            self.fields = {d.name: np.dtype(d.dtype or "<u1") for d in reader.header.point_format}
            scales, offsets = (
                np.asarray(of, np.float64) for of in (reader.header.scales, reader.header.offsets)
            )
            if not (np.isfinite(offsets).all() and np.isfinite(scales).all() and (scales > 0).all()):
                raise DataError(
                    f"{path} has scales {scales} and offsets {offsets}; it is damaged. Write it again."
                )

    def _open(self) -> Any:
        return self._laspy.open(self._path, read_evlrs=False)

    def blocks(self, begin: int, end: int, size: int) -> Iterator[np.ndarray]:
        if begin >= end:  # laspy cannot seek to the end of a file
            return
        size = min(size, max(1, _LAS_BLOCK_BYTES // self._point_bytes))
        with _las_errors(self._path), self._open() as reader:
            reader.seek(begin)
            for first in range(begin, end, size):
                wanted = min(size, end - first)
                points = reader.read_points(wanted)
                block = np.stack([np.asarray(getattr(points, name)) for name in self._names], 1)
                check_count(self._path, first, block.shape[0], wanted, self.n_rows)
                yield block


@contextmanager
def _las_errors(path: Path) -> Iterator[None]:
    """Turns every error of laspy and lazrs into a `DataError`; their errors share no base class."""
    try:
        yield
    except GmmTorchError:
        raise
    except BaseException as error:
        # lazrs is written in Rust, whose panics are no `Exception`.
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        raise DataError(
            f"{path} cannot be read as LAS or LAZ ({error}); it is truncated or damaged. "
            "Write or fetch it again."
        ) from error

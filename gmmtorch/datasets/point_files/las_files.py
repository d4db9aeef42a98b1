"""LAS and LAZ files. Headers are checked against the size of the file before anything is allocated."""

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

_LAS_BLOCK_BYTES = 1 << 25  # limit of one read: a point may announce 64 kB of extra bytes
_SIZES = struct.Struct("<4s20x2B68xHII")  # of the header, to the number of its records, 104 bytes
_RECORD_BYTES = 54  # of a variable-length record, at least
_MAX_CHUNK_POINTS = 1 << 22
"""Writers use 50 000. The decompressor allocates about 32 bytes for each point of a chunk."""


def _checked_header(path: Path) -> Any:
    """The header of a LAS or LAZ file by laspy, whose sizes fit the file."""
    import laspy

    size = path.stat().st_size
    with path.open("rb") as file:
        magic, major, minor, header_size, start, n_records = _SIZES.unpack(file.read(_SIZES.size))
        if major != 1 or minor > 5:
            raise ValueError(f"its version {major}.{minor} is not one of 1.0 to 1.5")
        if magic != b"LASF" or not header_size + n_records * _RECORD_BYTES <= start <= size:
            raise ValueError(f"its {n_records} variable-length records do not end at byte {start} of {size}")
        file.seek(0)
        header = laspy.LasHeader.read_from(file)
        n_points, point_bytes = int(header.point_count), int(header.point_format.size)
        if header.are_points_compressed:
            _check_chunks(file, start, size, n_points, header)
        elif n_points * point_bytes > size - start:
            raise ValueError(f"{n_points} points of {point_bytes} bytes do not fit into {size - start} bytes")
        if not (np.isfinite(header.offsets).all() and np.isfinite(header.scales).all()):
            raise ValueError(f"its scales are {header.scales}, its offsets {header.offsets}")
        if not (header.scales > 0).all():
            raise ValueError(f"its scales are {header.scales}")
    return header


def _check_chunks(file: BinaryIO, start: int, size: int, n_points: int, header: Any) -> None:
    """Checks the position, the length and the sums of the table of compressed chunks.

    A chunk has at least one byte; the decompressor allocates the whole table, and each chunk.
    """
    import lazrs

    record = lazrs.LazVlr(header.vlrs.get("LasZipVlr")[0].record_data)
    if record.item_size() != header.point_format.size:
        raise ValueError("its LASzip record does not describe its points")
    if not record.uses_variable_size_chunks() and record.chunk_size() > _MAX_CHUNK_POINTS:
        raise ValueError(f"its chunks have {record.chunk_size():,} points, more than {_MAX_CHUNK_POINTS:,}")
    if n_points == 0:
        return
    file.seek(start)
    (table,) = struct.unpack("<q", file.read(8))
    if table == -1:  # written to a stream: the position is at the end of the file
        file.seek(max(start, size - 8))
        (table,) = struct.unpack("<q", file.read(8))
    if not start + 8 <= table <= size - 8:
        raise ValueError(f"its table of chunks at byte {table} is outside of its {size} bytes")
    file.seek(table + 4)
    (n_chunks,) = struct.unpack("<I", file.read(4))
    left = table - start - 8
    if n_chunks > left:
        raise ValueError(f"{n_chunks} chunks do not fit into {left} bytes")
    file.seek(start)
    chunks = lazrs.read_chunk_table(file, record)
    if sum(n_bytes for _, n_bytes in chunks) > left or max(n for n, _ in chunks) > _MAX_CHUNK_POINTS:
        raise ValueError(f"its chunks do not fit into {left} bytes, or one is too large")


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
            header = _checked_header(path)
        self.n_rows, self._point_bytes = int(header.point_count), int(header.point_format.size)
        self.fields = {d.name: np.dtype(d.dtype or "<u1") for d in header.point_format}

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

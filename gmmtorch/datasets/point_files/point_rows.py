"""Readers of point files, block by block: rows of numbers in arrays, records and lines of text.

A reader checks the header when it is opened, and keeps at most one block of points in memory. If the file
contains less than its header announces, a `DataError` names the file.

Names, sizes and headers are checked before a file is read.
"""

from __future__ import annotations

import itertools
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

import numpy as np
from torch import Tensor

from gmmtorch.arrays import ArrayLike, as_tensor, check_dense
from gmmtorch.datasets.base import number_rows
from gmmtorch.errors import DataError


class Rows(Protocol):
    """Rows of D numbers in a fixed order, readable repeatedly and from any row."""

    name: str
    n_rows: int
    dim: int

    def blocks(self, begin: int, end: int, size: int) -> Iterator[np.ndarray]:
        """Yields rows begin, …, end − 1 in blocks (n, D), n ≤ size."""


class ArrayRows:
    """The rows of an array or tensor (N, D) in memory."""

    def __init__(self, points: ArrayLike, name: str = "points") -> None:
        check_dense(points, name)
        # Arrays stay as they are: a block of them is converted at a time, and a memory map is not loaded.
        is_tensor = isinstance(points, Tensor)
        self._array = as_tensor(points, name).detach().cpu().numpy() if is_tensor else np.asarray(points)
        self.name = name
        self.n_rows, self.dim = _table_shape(self._array, name)

    def blocks(self, begin: int, end: int, size: int) -> Iterator[np.ndarray]:
        for first in range(begin, end, size):
            yield self._array[first : min(first + size, end)]


class NpyRows:
    """The rows of a .npy file, mapped into memory."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.name = path.stem
        self.n_rows, self.dim = _table_shape(self._map(), str(path))

    def _map(self) -> np.ndarray:
        try:
            mapped = np.load(self._path, mmap_mode="r", allow_pickle=False)
        except Exception as error:  # a damaged header also raises SyntaxError, TokenError, OverflowError, …
            raise DataError(
                f"{self._path} cannot be read as a NumPy array ({error}); it is truncated, or not one of "
                "plain numbers. Write it again with numpy.save."
            ) from error
        if not isinstance(mapped, np.ndarray):
            raise DataError(f"{self._path} is a zip archive, not one array; write the array with numpy.save.")
        if isinstance(mapped, np.memmap):  # an empty array is none
            check_size(self._path, mapped.offset + mapped.nbytes, f"an array {mapped.shape}")
        return mapped

    def blocks(self, begin: int, end: int, size: int) -> Iterator[np.ndarray]:
        for first in range(begin, end, size):
            # A new map for each block, because the pages of one map would stay in memory.
            yield self._map()[first : min(first + size, end)]


class RecordRows:
    """The fields of a record in a binary file, mapped into memory, such as x, y and z, from a byte on."""

    def __init__(self, path: Path, n_points: int, start: int, record: np.dtype) -> None:
        self._path, self._start, self._record = path, start, record
        self.dim = len(record.names or ())
        self.name, self.n_rows = path.stem, n_points

    def blocks(self, begin: int, end: int, size: int) -> Iterator[np.ndarray]:
        for first in range(begin, end, size):
            n = min(size, end - first)
            offset = self._start + first * self._record.itemsize
            records = np.memmap(self._path, self._record, "r", offset, (n,))
            with np.errstate(invalid="ignore"):  # a signalling NaN of a damaged file
                block = np.stack([records[name].astype(np.float64) for name in self._record.names or ()], 1)
            yield block


class TextRows:
    """The points of a text file, one in each line that is not blank; earlier lines are read, too.

    Args:
        n_lines: lines of the header.
        width: numbers in the line of a point.
        columns: those that are read, such as x, y and z.
        n_before, n_after: lines that are not blank, before and after the points.
    """

    def __init__(
        self,
        path: Path,
        n_points: int,
        n_lines: int,
        width: int,
        columns: list[int],
        n_before: int = 0,
        n_after: int = 0,
    ) -> None:
        self._path, self._n_lines, self._width, self._columns = path, n_lines, width, columns
        self._n_before, self._n_after, self.dim = n_before, n_after, len(columns)
        self.name, self.n_rows = path.stem, n_points

    def blocks(self, begin: int, end: int, size: int) -> Iterator[np.ndarray]:
        with self._path.open(encoding="ascii", errors="replace") as file:
            data = filter(str.strip, itertools.islice(file, self._n_lines, None))
            lines = itertools.islice(data, self._n_before + begin, None)
            for first in range(begin, end, size):
                wanted = min(size, end - first)
                taken = list(itertools.islice(lines, wanted))
                check_count(self._path, first, len(taken), wanted, self.n_rows)
                # All columns are read, so that a truncated line is detected whichever column it lacks.
                table = number_rows(taken, self._width, f"{self._path}, row", first + 1)
                yield table[:, self._columns]
            if end == self.n_rows and (n_after := sum(1 for _ in lines)) != self._n_after:
                raise DataError(
                    f"{self._path} has {n_after:,} lines after its {self.n_rows:,} points instead of "
                    f"{self._n_after:,}; it is truncated or damaged. Write or fetch it again."
                )


def _table_shape(array: np.ndarray, name: str) -> tuple[int, int]:
    if array.ndim != 2 or array.shape[1] == 0 or array.dtype.kind not in "bfiu":
        raise DataError(
            f"{name} holds {array.dtype} {array.shape}; expected real numbers of shape (N, D), one point "
            "per row. Convert objects first: np.asarray(points, dtype=float)."
        )
    return array.shape[0], array.shape[1]


def check_count(path: Path, first: int, found: int, wanted: int, announced: int) -> None:
    if found < wanted:
        raise DataError(
            f"{path} announces {announced} points, but ends after {first + found}; it is truncated. "
            "Write or fetch it again."
        )


AXES = ("x", "y", "z")
PACKED = ("rgb", "rgba")
"""Fields of 32 bits, 0xAARRGGBB, which PCL also calls floating numbers."""
_HEADER_BYTES = 1 << 16
_MAX_PADDING = 1 << 16


@contextmanager
def damaged(path: Path, what: str) -> Iterator[None]:
    """Turns errors of missing and wrong content into a `DataError`: path, what is wrong, and the remedy."""
    try:
        yield
    except DataError:
        raise
    except (ValueError, KeyError, IndexError, TypeError, OverflowError, struct.error) as error:
        raise DataError(
            f"{path} {what} ({error!r}); it is truncated, damaged or another kind of file. Write or fetch it "
            "again."
        ) from error


def header_lines(path: Path, last: str) -> tuple[list[list[str]], int]:
    """The words of each line of a header, up to the line that begins with `last`, and the header's bytes."""
    with path.open("rb") as file:
        *whole, _ = file.read(_HEADER_BYTES).split(b"\n")
    lines, n_bytes = [], 0
    for line in whole:
        lines.append(line.decode("ascii", errors="replace").split())
        n_bytes += len(line) + 1
        if lines[-1][:1] == [last]:
            return lines, n_bytes
    raise DataError(f"{path} has no header that ends with a line {last}; it is another kind of file.")


def whole_number(word: str) -> int:
    """The number that digits alone spell: int() also accepts 1_0. Raises `ValueError`."""
    if not word.isdecimal():
        raise ValueError(f"{word!r} is not a whole number")
    return int(word)


def check_fields(path: Path, fields: Sequence[str]) -> None:
    """Raises `DataError` unless x, y and z are one field each."""
    for axis in AXES:
        if axis not in fields:
            raise DataError(f"{path} has no field {axis}, only {', '.join(fields)}; it holds no points.")
        if fields.count(axis) > 1:
            raise DataError(f"{path} has several fields {axis}; its header is damaged. Write it again.")


def check_size(path: Path, expected: int, what: str) -> None:
    """Raises `DataError` unless `what` fill the file, whose `expected` bytes may be followed by some zeros.

    PCL has allocated binary files by whole pages.
    """
    found = path.stat().st_size
    with path.open("rb") as file:
        file.seek(min(expected, found))
        rest = file.read(_MAX_PADDING + 1)
    if found < expected or len(rest) > _MAX_PADDING or rest.strip(b"\0"):
        state = "truncated" if found < expected else "damaged"
        raise DataError(
            f"{path} announces {what} in {expected:,} bytes, but has {found:,}; it is {state}. Write or "
            "fetch it again."
        )


def check_text(path: Path, n_rows: int) -> None:
    """Raises `DataError` unless a text file has space for its rows, and a line end after the last one.

    Without a line end, digits of the last number may be missing.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        file.seek(max(0, size - 1))
        last = file.read()
    if 2 * n_rows > size:
        raise DataError(
            f"{path} announces {n_rows:,} rows, but has {size:,} bytes; it is truncated or damaged."
        )
    if last not in (b"\n", b"\r"):
        raise DataError(
            f"{path} has no line end after its last row, so it may be truncated. Write or fetch it again; if "
            "it is complete, add a line end."
        )

"""Readers of point files, block by block: .npy, .las, .laz, .pcd, .ply.

A reader checks the header when it is opened, and keeps at most one block of points in memory. If the file
contains less than its header announces, a `DataError` names the file.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from torch import Tensor

from gmmtorch.arrays import ArrayLike, as_tensor, check_unmasked
from gmmtorch.datasets.number_rows import number_rows
from gmmtorch.datasets.point_files.headers import AXES, check_size
from gmmtorch.datasets.point_files.las_header import read_las_header
from gmmtorch.errors import DataError, GmmTorchError
from gmmtorch.optional_packages import needs_extra

_LAS_BLOCK_BYTES = 1 << 25
"""Limit of one read: a point may announce 64 kB of extra bytes."""


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
        check_unmasked(points, name)
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


class LasRows:
    """The points of a LAS or LAZ file, in the file's frame, float64, with scale and offset applied."""

    dim = 3

    def __init__(self, path: Path) -> None:
        with needs_extra(f"{path}: LAS and LAZ files need", "laspy", "formats"):
            import laspy
            import lazrs  # noqa: F401  used by laspy
        self._laspy: Any = laspy
        self._path = path
        self.name = path.stem
        with _las_errors(path):
            self.n_rows, self._point_bytes = read_las_header(path)
        with _las_errors(path), self._open() as reader:
            if int(reader.header.point_count) != self.n_rows:
                raise DataError(f"{path} announces two numbers of points; it is damaged. Write it again.")
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
                block = np.stack([points.x, points.y, points.z], 1)
                _check_count(self._path, first, block.shape[0], wanted, self.n_rows)
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


class RecordRows:
    """The points of a binary file, mapped into memory: records with the fields x, y and z from a byte on."""

    dim = 3

    def __init__(self, path: Path, n_points: int, start: int, record: np.dtype) -> None:
        self._path, self._start, self._record = path, start, record
        self.name, self.n_rows = path.stem, n_points

    def blocks(self, begin: int, end: int, size: int) -> Iterator[np.ndarray]:
        for first in range(begin, end, size):
            n = min(size, end - first)
            offset = self._start + first * self._record.itemsize
            records = np.memmap(self._path, self._record, "r", offset, (n,))
            with np.errstate(invalid="ignore"):  # a signalling NaN of a damaged file
                block = np.stack([records[axis].astype(np.float64) for axis in AXES], 1)
            yield block


class TextRows:
    """The points of a text file, one in each line that is not blank; earlier lines are read, too.

    Args:
        n_lines: lines of the header.
        width: numbers in the line of a point.
        columns: those of x, y and z.
        n_before, n_after: lines that are not blank, before and after the points.
    """

    dim = 3

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
        self._n_before, self._n_after = n_before, n_after
        self.name, self.n_rows = path.stem, n_points

    def blocks(self, begin: int, end: int, size: int) -> Iterator[np.ndarray]:
        with self._path.open(encoding="ascii", errors="replace") as file:
            data = filter(str.strip, itertools.islice(file, self._n_lines, None))
            lines = itertools.islice(data, self._n_before + begin, None)
            for first in range(begin, end, size):
                wanted = min(size, end - first)
                taken = list(itertools.islice(lines, wanted))
                _check_count(self._path, first, len(taken), wanted, self.n_rows)
                # All columns are read, so that a truncated line is detected whichever column it lacks.
                table = number_rows(taken, self._width, f"{self._path}, row", first + 1)
                yield table[:, self._columns]
            if end == self.n_rows and (n_after := sum(1 for _ in lines)) != self._n_after:
                raise DataError(
                    f"{self._path} has {n_after:,} lines after its {self.n_rows:,} points instead of "
                    f"{self._n_after:,}; it is truncated or damaged. Write or fetch it again."
                )


def _table_shape(array: np.ndarray, name: str) -> tuple[int, int]:
    if array.ndim != 2 or array.shape[1] == 0 or array.dtype.kind not in "fiu":
        raise DataError(
            f"{name} holds {array.dtype} {array.shape}; expected real numbers of shape (N, D), one point "
            "per row."
        )
    return array.shape[0], array.shape[1]


def _check_count(path: Path, first: int, found: int, wanted: int, announced: int) -> None:
    if found < wanted:
        raise DataError(
            f"{path} announces {announced} points, but ends after {first + found}; it is truncated. "
            "Write or fetch it again."
        )

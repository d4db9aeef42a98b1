"""What is checked before a point file is read: its name, its size, and headers of lines of words."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from gmmtorch.errors import DataError, InvalidArgumentError, MissingDataError

AXES = ("x", "y", "z")
SUFFIXES = (".npy", ".las", ".laz", ".pcd", ".ply")
_HEADER_BYTES = 1 << 16
_MAX_PADDING = 1 << 16


def point_path(path: str | Path) -> Path:
    """The path of a point file, with ~ expanded.

    Raises `InvalidArgumentError` for an unknown suffix, and `MissingDataError` if the file does not exist.
    """
    path = Path(path).expanduser()
    known = ", ".join(SUFFIXES)
    if path.suffix.lower() not in SUFFIXES:
        raise InvalidArgumentError(f"points={path} has an unknown suffix {path.suffix!r}; known are {known}.")
    if not path.is_file():
        what = "is not a file" if path.exists() else "does not exist"
        raise MissingDataError(f"points={path} {what}; give a file of points ({known}).")
    return path


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

"""The folder of a journal: its lock, numbered files, and writes that say whether they have happened."""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
from pathlib import Path

from gmmtorch.errors import InvalidArgumentError, OutputError
from gmmtorch.files import write_atomically

SNAPSHOT, LOG = ".snapshot", ".log"


def place(folder: Path, number: int, suffix: str) -> Path:
    """Where the file of that number is."""
    return folder / f"{number:08d}{suffix}"


def numbers(folder: Path, suffix: str) -> list[int]:
    """Of the files with that suffix, rising. Raises `OutputError` for a folder that cannot be listed."""
    try:
        names = os.listdir(folder)
    except OSError as error:
        raise OutputError(f"{folder} cannot be listed: {error.strerror or error}.") from error
    matches = (re.fullmatch(r"(\d{8,18})" + re.escape(suffix), name) for name in names)
    return sorted(int(match[1]) for match in matches if match)


def read(path: Path, most: int) -> bytes | None:
    """A file's bytes; None for what is longer than `most`, cannot be read, or is no file."""
    try:
        if not path.is_file() or path.stat().st_size > most:
            return None
        return path.read_bytes()
    except OSError:
        return None


def locked(folder: Path) -> int:
    """A file of the folder that is locked until it is closed, or this process ends, however it ends."""
    file = -1
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = os.open(folder / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(file)
        raise InvalidArgumentError(
            f"path={str(folder)!r} is the journal of a robot that runs already; `fuser {folder}/lock` shows "
            "its process. End that, or give another folder."
        ) from error
    except OSError as error:
        if file >= 0:
            os.close(file)
        raise unwritten(folder, error) from error
    return file


def new_log(path: Path, header: bytes) -> int:
    """A file that is appended to, and holds the header; nothing is left of it where that fails."""
    file = -1
    try:
        file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND | os.O_CLOEXEC, 0o644)
        _write_all(file, header)
        _sync_folder(path.parent)
    except OSError as error:
        if file >= 0:
            os.close(file)
            with contextlib.suppress(OSError):
                os.unlink(path)
        raise unwritten(path, error) from error
    return file


def append(file: int, data: bytes, sync: bool) -> None:
    """Write at the end of a file; where that fails, with `OSError`, it ends where it ended before."""
    size = os.fstat(file).st_size
    try:
        _write_all(file, data)
        if sync:
            os.fsync(file)
    except BaseException:
        with contextlib.suppress(OSError):  # what is left of it is skipped when the log is read
            os.ftruncate(file, size)
        raise


def write_durably(path: Path, data: bytes) -> None:
    """A file that is whole or not there, and once this returns is there after a loss of power, too."""
    write_atomically(path, lambda temporary: _write_through(temporary, data))
    try:
        _sync_folder(path.parent)
    except OSError as error:
        raise unwritten(path, error) from error


def remove_older(folder: Path, number: int) -> None:
    """Remove the files of lower numbers, and those that `write_durably` never finished, as far as they go."""
    old = [
        place(folder, n, suffix) for suffix in (LOG, SNAPSHOT) for n in numbers(folder, suffix) if n < number
    ]
    for path in [*old, *folder.glob(f".*{SNAPSHOT}")]:
        with contextlib.suppress(OSError):
            os.unlink(path)


def unwritten(path: Path, error: OSError) -> OutputError:
    return OutputError(
        f"{path} cannot be written: {error.strerror or error}. What was kept before is whole. Free space "
        "there, or give another folder; the robot may go on without."
    )


def _write_all(file: int, data: bytes) -> None:
    left = memoryview(data)
    while left:
        left = left[os.write(file, left) :]


def _write_through(path: Path, data: bytes) -> None:
    with path.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def _sync_folder(folder: Path) -> None:
    """What was made or renamed in it stays so after a loss of power."""
    file = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(file)
    finally:
        os.close(file)

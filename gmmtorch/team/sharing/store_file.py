"""The SQLite file of a store: its tables, and the checks when it is opened."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import shutil
import sqlite3
import stat
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from gmmtorch.errors import DataError, GmmTorchError, InvalidArgumentError, OutputError

APPLICATION_ID = 0x474D4D53
"""Of the file header: "GMMS"."""
VERSION = 1
_TABLES = (
    # Which robot, world or log it is. value: JSON.
    "CREATE TABLE fact (name TEXT PRIMARY KEY, value TEXT NOT NULL CHECK (length(value) <= 4096))",
    # Of the transport: one for each run of the robot's process.
    "CREATE TABLE session (number INTEGER PRIMARY KEY, id BLOB NOT NULL UNIQUE"
    " CHECK (typeof(id) = 'blob' AND length(id) = 8))",
    # Components, as the mapping codec writes them, with its checksum.
    "CREATE TABLE batch (number INTEGER PRIMARY KEY, data BLOB NOT NULL"
    " CHECK (typeof(data) = 'blob' AND length(data) <= 2097152))",
    # Datagrams since the last compaction, and those of records that are no components, with checksums.
    "CREATE TABLE record (number INTEGER PRIMARY KEY, datagram BLOB NOT NULL"
    " CHECK (typeof(datagram) = 'blob' AND length(datagram) BETWEEN 1 AND 1200))",
    # digest: BLAKE2b, 16 bytes, of the state, a safetensors file.
    "CREATE TABLE progress (scans INTEGER PRIMARY KEY, digest BLOB NOT NULL, state BLOB NOT NULL"
    " CHECK (typeof(digest) = 'blob' AND typeof(state) = 'blob'))",
)
_BUSY = {sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED}
_DISK = {
    sqlite3.SQLITE_CANTOPEN,
    sqlite3.SQLITE_FULL,
    sqlite3.SQLITE_IOERR,
    sqlite3.SQLITE_PERM,
    sqlite3.SQLITE_READONLY,
}
_LONGEST_SHOWN = 40
"""Characters of a fact in a message."""
_log = logging.getLogger(__name__)


def open_file(path: Path, facts: Mapping[str, Any], max_bytes: int) -> tuple[sqlite3.Connection, bool]:
    """The checked and locked file of a store, new if there is none; and whether it can be written.

    If it cannot be written, its content is returned in memory, or an empty store if it cannot be read either,
    and a warning is logged.

    Raises `InvalidArgumentError` if another connection has the file, or if its facts differ; `DataError` if
    it is damaged, is no store, or is of another version.
    """
    try:
        return _opened(path, path, facts, max_bytes), True
    except OutputError as error:
        _log.warning(
            "%s The robot uses what can be read there, and keeps nothing. "
            "Choose another folder, or run without a store.",
            error,
        )
    try:
        # SQLite cannot read a log without writing a file next to it.
        with tempfile.TemporaryDirectory(prefix="gmmtorch-") as folder:
            for suffix in ("", "-wal"):
                with contextlib.suppress(FileNotFoundError, NotADirectoryError):
                    shutil.copyfile(f"{path}{suffix}", f"{folder}/copy{suffix}")
            with contextlib.closing(_opened(Path(folder, "copy"), path, facts, max_bytes)) as copy:
                memory = connect(":memory:")
                copy.backup(memory)
                return memory, False
    except OSError as error:
        _log.warning("%s cannot be read (%s): the robot starts with nothing.", path, error)
        return _opened(None, path, facts, max_bytes), False


def connect(path: str) -> sqlite3.Connection:
    """A connection that does not wait for locks, and begins no transaction by itself."""
    return sqlite3.connect(path, timeout=0, isolation_level=None)


@contextlib.contextmanager
def transaction(db: sqlite3.Connection) -> Iterator[None]:
    """Commit what is done inside; nothing of it if an error is raised."""
    db.execute("BEGIN IMMEDIATE")
    try:
        yield
        db.execute("COMMIT")
    except BaseException:
        with contextlib.suppress(sqlite3.Error):  # SQLite itself rolls back after some errors
            db.execute("ROLLBACK")
        raise


def explained(error: Exception, path: Path) -> GmmTorchError:
    """The error that says what is wrong with the file, and what to do."""
    code = getattr(error, "sqlite_errorcode", 0) & 0xFF
    if code in _BUSY:
        return InvalidArgumentError(
            f"path={str(path)!r} belongs to a robot that runs already; `fuser {path}` shows its process. "
            "End that, or give another folder."
        )
    if isinstance(error, OSError) or code in _DISK:
        return OutputError(f"{path} cannot be written ({error}).")
    return DataError(
        f"{path} is damaged, or is no store of gmmtorch ({error}). Move it away; a new store is made: "
        "teammates have what was sent."
    )


def _opened(place: Path | None, path: Path, facts: Mapping[str, Any], max_bytes: int) -> sqlite3.Connection:
    """The file at `place`, or a new store in memory if None; messages name `path`."""
    db = None
    try:
        if place is not None:
            place.parent.mkdir(parents=True, exist_ok=True)
            _check_size(place, 2 * max_bytes)
        db = connect(":memory:" if place is None else str(place))
        _open_tables(db, path, max_bytes)
        _check_facts(db, path, facts)
    except BaseException as error:
        if db is not None:
            db.close()  # else the file stays locked
        if isinstance(error, GmmTorchError) or not isinstance(error, sqlite3.Error | OSError | ValueError):
            raise
        raise explained(error, path) from error
    return db


def _check_size(place: Path, max_bytes: int) -> None:
    """Raise `DataError` unless a file and its log are absent, or regular files of at most `max_bytes`."""
    total = 0
    for name in (place, f"{place}-wal"):
        if os.path.exists(name):
            about = os.stat(name)
            total += about.st_size
            if not stat.S_ISREG(about.st_mode) or total > max_bytes:
                raise DataError(
                    f"{name} is no regular file, or has with its log more than {max_bytes:,} bytes. Move it "
                    "away, or give another folder."
                )


def _open_tables(db: sqlite3.Connection, path: Path, max_bytes: int) -> None:
    """Lock the file for this process, check its tables, or create them in an empty file.

    Anything else in the file, such as a trigger, is refused.
    """
    db.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, max_bytes)
    _set(db, "locking_mode = EXCLUSIVE")  # before anything is read: then WAL needs no shared memory
    _set(db, "trusted_schema = OFF", "cell_size_check = ON", "mmap_size = 0")
    application, version = _value(db, "application_id"), _value(db, "user_version")
    found = {sql for (sql,) in db.execute("SELECT sql FROM sqlite_master WHERE sql IS NOT NULL")}
    is_new = application == 0 and not found
    if not is_new:
        if application != APPLICATION_ID or version != VERSION:
            raise DataError(
                f"{path} is no store of gmmtorch, or is of version {version}; this gmmtorch reads version "
                f"{VERSION}. Give another folder, or update gmmtorch."
            )
        if found != set(_TABLES):
            raise DataError(
                f"{path} has other tables than a store of gmmtorch. Move it away; a new store is made."
            )
        if (problem := _value(db, "quick_check(1)")) != "ok":
            raise DataError(
                f"{path} is damaged ({problem}). Move it away; a new store is made: "
                "teammates have what was sent."
            )
    pages = max_bytes // _value(db, "page_size")
    _set(db, "journal_mode = WAL", "synchronous = FULL", "wal_autocheckpoint = 256")
    _set(db, f"max_page_count = {pages}")
    if is_new:
        ids = f"PRAGMA application_id = {APPLICATION_ID}; PRAGMA user_version = {VERSION}"
        db.executescript(f"BEGIN IMMEDIATE; {'; '.join(_TABLES)}; {ids}; COMMIT")


def _check_facts(db: sqlite3.Connection, path: Path, facts: Mapping[str, Any]) -> None:
    """Write the facts to a new file; raise `InvalidArgumentError` if those of an old one differ."""
    try:
        kept = {name: json.loads(value) for name, value in db.execute("SELECT name, value FROM fact")}
    except (ValueError, RecursionError) as error:
        raise DataError(
            f"{path}: its facts are damaged ({error}). Move it away; a new store is made."
        ) from error
    own = json.loads(json.dumps(dict(facts)))
    if not kept:
        with transaction(db):
            rows = [(name, json.dumps(value)) for name, value in own.items()]
            db.executemany("INSERT INTO fact VALUES (?, ?)", rows)
    elif names := sorted(name for name in {*own, *kept} if own.get(name) != kept.get(name)):
        shown = ", ".join(
            f"{_shown(name)} was {_shown(kept.get(name))} and is {_shown(own.get(name))}" for name in names
        )
        raise InvalidArgumentError(
            f"path={str(path)!r} is of another robot, world or log: {shown}. Give another folder, or the "
            "options that it was begun with."
        )


def _shown(value: Any) -> str:
    """A value in at most `_LONGEST_SHOWN` characters."""
    text = value if isinstance(value, str) and value.isprintable() else json.dumps(value)
    return text if len(text) <= _LONGEST_SHOWN else text[:_LONGEST_SHOWN] + "…"


def _set(db: sqlite3.Connection, *pragmas: str) -> None:
    for pragma in pragmas:
        db.execute(f"PRAGMA {pragma}").fetchall()


def _value(db: sqlite3.Connection, pragma: str) -> Any:
    return db.execute(f"PRAGMA {pragma}").fetchone()[0]

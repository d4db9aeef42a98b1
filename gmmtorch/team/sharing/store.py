"""Store: the durable state of one robot, in one SQLite file."""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import os
import shutil
import sqlite3
import stat
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from gmmtorch.errors import (
    DAMAGED_CONTENT,
    DataError,
    GmmTorchError,
    InvalidArgumentError,
    OutputError,
    check_whole,
)
from gmmtorch.files import joined_tensors, pack_tensors, split_tensors, unpack_tensors
from gmmtorch.team.sharing.messages.datagrams import check_datagram
from gmmtorch.team.sharing.messages.record_messages import RECORD_KINDS, keys_in
from gmmtorch.team.sharing.replica.record_keys import WORLD, Intervals, keys_of_author
from gmmtorch.team.sharing.replica.replica import Replica

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
_LONGEST_SHOWN = 40  # characters of a fact in a message


def open_file(path: Path, facts: Mapping[str, Any], max_bytes: int) -> tuple[sqlite3.Connection, bool]:
    """The checked and locked file of a store, new if there is none; and whether it can be written.

    If not, a warning is logged, and its content is returned in memory, or an empty store if it cannot be read
    either. Raises as `Store` does.
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
    """Lock the file for this process, check its tables, or create them in an empty file. Anything else in the
    file, such as a trigger, is refused."""
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
        if not all(isinstance(name, str) for name in kept):
            raise ValueError("a name is not text")
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


MOST_SESSIONS = 1024
"""Sessions that are kept: the newest."""
_MOST_LOG_BYTES = 1 << 20  # datagrams in the log before it is compacted. To replay that many takes seconds.
_MOST_NAMES = 1 << 16
"""Intervals of names of records in the file, 1 MiB. Beyond that they are forgotten, and some records are
written twice."""
_MOST_PATIENCE = 1 << 10  # calls of `keep` between two attempts to write to a disk that failed
_log = logging.getLogger(__name__)


class Restored(NamedTuple):
    """What `Store.restore` found. n_rows: batches and datagrams that were loaded; n_refused: rows that are
    damaged or do not fit the replica."""

    n_rows: int
    n_refused: int


class Store:
    """Keeps the records, sessions and progress of one robot in a SQLite file.

    Usage::

        with Store(path, robot=0) as store:
            store.restore(replica)
            datagrams = replica.datagrams()
            store.keep(datagrams)                 # before they are sent
            if replica.receive(datagram):
                store.keep([datagram])            # before it is announced

    Each call commits one transaction (WAL, `synchronous=FULL`): what it returned True for survives `kill
    -9` at any instant and a loss of power. The file has a log of datagrams; when the log is long, a
    transaction replaces it by batches of all components and the datagrams of the other records.

    If the disk fails, a warning is logged once and the robot continues. `keep` then returns False, and tries
    again before the 1st, 2nd, 4th, 8th, … call that follows. If the file cannot be written when it is opened
    (`is_writable`), the store reads a copy of it and keeps nothing. `n_failed` counts the failed calls.

    For one thread. One process at a time has the file open; the lock ends with the process.
    """

    def __init__(
        self,
        path: str | Path,
        robot: int,
        facts: Mapping[str, Any] | None = None,
        *,
        max_bytes: int = 1 << 30,
    ) -> None:
        """Open or create the store of a robot.

        path: the file. SQLite writes `<path>-wal` next to it. robot: number of the robot. facts: plain values
        by name that identify the world or log. They are written to a new file; an existing file must have
        equal ones. max_bytes: largest size of the file.

        Raises `InvalidArgumentError` if another process has the file open, or if it belongs to another
        robot, world or log; `DataError` if it is damaged, is no store, or is of a later version.
        """
        check_whole("robot", robot, 0)
        check_whole("max_bytes", max_bytes, 1 << 16)
        self.path, self.n_failed = Path(path), 0
        self._replica: Replica | None = None
        self._kept = Intervals.empty()  # names of records in the file
        self._log_bytes = 0
        self._is_failing = False
        self._patience = self._waited = 0  # calls of `keep` to skip, and skipped; 0: the file has all records
        self._sound: int | None = None  # the newest progress that is known to be undamaged
        facts = {"robot": robot, **(facts or {})}
        self._db, self.is_writable = open_file(self.path, facts, max_bytes)

    def begin_session(self, session: bytes) -> frozenset[bytes]:
        """The robot's earlier sessions. Keeps `session` (8 bytes) with them: call it before anything is sent.
        See `FramedTransport.disown`."""
        former = {row for (row,) in self._rows("SELECT id FROM session")} - {session}

        def add() -> None:
            self._db.execute("INSERT OR IGNORE INTO session (id) VALUES (?)", (session,))
            self._db.execute(
                "DELETE FROM session WHERE number <= (SELECT max(number) FROM session) - ?", (MOST_SESSIONS,)
            )

        self._write(add)
        return frozenset(former)

    def restore(self, replica: Replica) -> Restored:
        """Load the stored records into a new replica; from now on the store keeps this replica. Damaged rows
        are skipped and logged: teammates have what was sent. Raises `InvalidArgumentError` if the replica has
        records, or an incarnation that was used before."""
        before = replica.held  # one record, if the replica has a frame of its own
        if before.size > (replica.placement.root != WORLD):
            raise InvalidArgumentError("replica has records already; restore its store first.")
        batches = [row for (row,) in self._rows("SELECT data FROM batch ORDER BY number")]
        datagrams = [row for (row,) in self._rows("SELECT datagram FROM record ORDER BY number")]
        n_refused = replica.load(batches, datagrams)
        if (replica.held - before) & keys_of_author(replica.robot, replica.incarnation):
            raise InvalidArgumentError(
                f"incarnation={replica.incarnation} of robot {replica.robot} has records in {self.path} "
                f"already. Make Replica({replica.robot}) without incarnation: it draws a new one."
            )
        if n_refused:
            _log.warning(
                "%s: %d of %d rows are damaged or do not fit the replica, and are skipped. "
                "Teammates have what was sent.",
                self.path,
                n_refused,
                len(batches) + len(datagrams),
            )
        self._replica, self._kept = replica, (replica.known - before).up_to(_MOST_NAMES)
        self._log_bytes = sum(map(len, datagrams))
        return Restored(len(batches) + len(datagrams) - n_refused, n_refused)

    def keep(self, datagrams: Sequence[bytes]) -> bool:
        """Commit the records in datagrams that the replica sends or has merged; returns whether all are on
        the disk. Datagrams without records are ignored. Records that the file has already are not written
        again."""
        rows, kept = [], self._kept
        for datagram in datagrams:
            check_datagram(datagram, least=1)
            if datagram[0] & 15 in RECORD_KINDS and not kept.covers(names := keys_in(datagram)):
                kept |= names
                rows.append((datagram,))
        if not rows or not self.is_writable:
            return self.is_writable
        if self._patience:  # records of earlier calls are missing, so that all are written again
            self._waited += 1
            is_kept = self._waited >= self._patience and self.compact()
        else:
            is_kept = self._write(
                lambda: self._db.executemany("INSERT INTO record (datagram) VALUES (?)", rows)
            )
            self._kept = kept.up_to(_MOST_NAMES) if is_kept else self._kept
            self._log_bytes += sum(len(datagram) for (datagram,) in rows)
        if not is_kept:
            self.n_failed += 1
            if self._waited >= self._patience:
                self._waited, self._patience = 0, min(2 * self._patience or 1, _MOST_PATIENCE)
        elif self._log_bytes > _MOST_LOG_BYTES:
            self.compact()
        return is_kept

    def compact(self) -> bool:
        """Replace the log by all that the replica holds, in one transaction; returns whether that
        succeeded."""
        if self._replica is None or not self.is_writable:
            return False
        batches, datagrams = self._replica.stored()
        self._log_bytes = 0  # if this fails, the next attempt is after another `_MOST_LOG_BYTES`

        def replace() -> None:
            for table, column, rows in (("batch", "data", batches), ("record", "datagram", datagrams)):
                self._db.execute(f"DELETE FROM {table}")
                self._db.executemany(f"INSERT INTO {table} ({column}) VALUES (?)", [(row,) for row in rows])

        if not self._write(replace):
            return False
        self._kept = self._replica.known.up_to(_MOST_NAMES)
        self._patience = self._waited = 0
        return True

    def save_progress(self, n_scans: int, state: dict[str, Any]) -> bool:
        """Keep the state of the robot's own map after so many scans; returns whether it is on the disk. The
        newest two states are kept, in case one is damaged later."""
        tree, tensors = split_tensors(state)
        data = pack_tensors(tensors, "progress", 1, tree=tree)

        def save() -> None:
            self._db.execute(
                "INSERT OR REPLACE INTO progress VALUES (?, ?, ?)", (n_scans, _digest(data), data)
            )
            # A damaged state stays until there is a newer one, because its number of scans is still valid.
            self._db.execute(
                "DELETE FROM progress WHERE scans < ? AND scans IS NOT ?", (n_scans, self._sound)
            )

        is_saved = self._write(save)
        self._sound = n_scans if is_saved else self._sound
        self.n_failed += self.is_writable and not is_saved
        return is_saved

    def progress(self) -> tuple[int, dict[str, Any]] | None:
        """Scans and state of the newest progress that is not damaged; None if there is none. Raises
        `DataError` for a state of a later version."""
        for n_scans, digest, data in self._rows("SELECT * FROM progress ORDER BY scans DESC"):
            if digest != _digest(data):
                _log.warning(
                    "%s: the progress after %d scans is damaged; an older one is used.", self.path, n_scans
                )
                continue
            tensors, about = unpack_tensors(data, self.path, "progress", 1)
            try:
                state: dict[str, Any] = joined_tensors(about["tree"], tensors)
            except DAMAGED_CONTENT as error:
                raise DataError(
                    f"{self.path}: the progress after {n_scans} scans is no state ({error!r})."
                ) from error
            self._sound = n_scans
            return n_scans, state
        return None

    @property
    def farthest(self) -> int | None:
        """Scans of the newest progress, damaged or not; None if there is none."""
        ((n_scans,),) = self._rows("SELECT max(scans) FROM progress")
        return None if n_scans is None else int(n_scans)

    def close(self) -> None:
        """Compact, and close the file. May be called again."""
        self.compact()
        self._replica = None
        self._db.close()

    def __enter__(self) -> Store:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _rows(self, query: str) -> list[tuple[Any, ...]]:
        try:
            return self._db.execute(query).fetchall()
        except sqlite3.Error as error:
            raise explained(error, self.path) from error

    def _write(self, change: Callable[[], object]) -> bool:
        """Run `change` in a transaction; returns whether it is on the disk. The first failure is logged."""
        if not self.is_writable:
            return False
        try:
            with transaction(self._db):
                change()
        except sqlite3.Error as error:
            if not self._is_failing:
                _log.warning("%s is no longer written, and the robot continues: %s.", self.path, error)
            self._is_failing = True
            return False
        if self._is_failing:
            _log.warning("%s is written again.", self.path)
        self._is_failing = False
        return True


def _digest(data: bytes) -> bytes:
    return hashlib.blake2b(data, digest_size=16).digest()

"""Store: the durable state of one robot, in one SQLite file."""

from __future__ import annotations

import hashlib
import logging
import sqlite3
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

from gmmtorch.errors import DataError, InvalidArgumentError, check_whole
from gmmtorch.files import joined_tensors, pack_tensors, split_tensors, unpack_tensors
from gmmtorch.team.sharing.messages.envelope import check_datagram
from gmmtorch.team.sharing.replica.record_keys import RECORD_KINDS, WORLD, Intervals, keys_in, keys_of_author
from gmmtorch.team.sharing.replica.replica import Replica
from gmmtorch.team.sharing.store_file import explained, open_file, transaction

MOST_SESSIONS = 1024
"""Sessions that are kept: the newest."""
_MOST_LOG_BYTES = 1 << 20
"""Datagrams in the log before it is compacted. To replay that many takes seconds."""
_MOST_NAMES = 1 << 16
"""Intervals of names of records in the file, 1 MiB. Beyond that they are forgotten, and some records are
written twice."""
_MOST_PATIENCE = 1 << 10
"""Calls of `keep` between two attempts to write to a disk that failed."""
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

    If the disk is full or fails, a warning is logged once and the robot continues. `keep` then returns False,
    and tries again before the 1st, 2nd, 4th, 8th, … call that follows. If the file cannot be written when
    it is opened, the store reads a copy of it and keeps nothing.

    For one thread. One process at a time has the file open; the lock ends with the process.

    Attributes:
        is_writable: False if the file could not be written when it was opened.
        n_failed: calls of `keep` and `save_progress` that could not write to a file that was writable at
            first.
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

        Args:
            path: the file. SQLite writes `<path>-wal` next to it.
            robot: number of the robot.
            facts: plain values by name that identify the world or log. They are written to a new file; an
                existing file must have equal ones.
            max_bytes: largest size of the file.

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

    # -- sessions -----------------------------------------------------------------------------------

    def begin_session(self, session: bytes) -> frozenset[bytes]:
        """The robot's earlier sessions. Keeps `session` (8 bytes) with them: call it before anything is sent.

        See `FramedTransport.disown`.
        """
        former = {row for (row,) in self._rows("SELECT id FROM session")} - {session}

        def add() -> None:
            self._db.execute("INSERT OR IGNORE INTO session (id) VALUES (?)", (session,))
            self._db.execute(
                "DELETE FROM session WHERE number <= (SELECT max(number) FROM session) - ?", (MOST_SESSIONS,)
            )

        self._write(add)
        return frozenset(former)

    # -- records ------------------------------------------------------------------------------------

    def restore(self, replica: Replica) -> Restored:
        """Load the stored records into a new replica; from now on the store keeps this replica.

        Damaged rows are skipped and logged: teammates have what was sent. Raises `InvalidArgumentError` if
        the replica has records, or an incarnation that was used before.
        """
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
        self._replica, self._kept = replica, (replica.held - before).up_to(_MOST_NAMES)
        self._log_bytes = sum(map(len, datagrams))
        return Restored(len(batches) + len(datagrams) - n_refused, n_refused)

    def keep(self, datagrams: Sequence[bytes]) -> bool:
        """Commit the records in datagrams that the replica sends or has merged; returns whether all are on
        the disk.

        Datagrams without records are ignored. Records that the file has already are not written again.
        """
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
        self._kept = self._replica.held.up_to(_MOST_NAMES)
        self._patience = self._waited = 0
        return True

    # -- progress in a log --------------------------------------------------------------------------

    def save_progress(self, n_scans: int, state: dict[str, Any]) -> bool:
        """Keep the state of the robot's own map after so many scans; returns whether it is on the disk.

        The newest two states are kept, in case one is damaged later.
        """
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
        """Scans and state of the newest progress that is not damaged; None if there is none.

        Raises `DataError` for a state of a later version.
        """
        for n_scans, digest, data in self._rows("SELECT * FROM progress ORDER BY scans DESC"):
            if digest != _digest(data):
                _log.warning(
                    "%s: the progress after %d scans is damaged; an older one is used.", self.path, n_scans
                )
                continue
            tensors, about = unpack_tensors(data, self.path, "progress", 1)
            try:
                state: dict[str, Any] = joined_tensors(about["tree"], tensors)
            except (KeyError, TypeError, AttributeError) as error:
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

    # -- closing ------------------------------------------------------------------------------------

    def close(self) -> None:
        """Compact, and close the file. May be called again."""
        self.compact()
        self._replica = None
        self._db.close()

    def __enter__(self) -> Store:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # -- inside -------------------------------------------------------------------------------------

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

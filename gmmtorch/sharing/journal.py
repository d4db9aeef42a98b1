"""Journal: what a robot knows of a shared map, on its disk, whole whenever the robot is killed."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType

from gmmtorch.errors import GmmTorchError, InvalidArgumentError, OutputError, check_whole
from gmmtorch.sharing.journal_files import (
    LOG,
    SNAPSHOT,
    append,
    locked,
    new_log,
    numbers,
    place,
    remove_older,
    unwritten,
    write_durably,
)
from gmmtorch.sharing.journal_format import framed, log_header, pack_snapshot
from gmmtorch.sharing.journal_restore import MOST_LOG_BYTES, MOST_SNAPSHOT_BYTES, restore
from gmmtorch.sharing.messages.envelope import MAX_BYTES
from gmmtorch.sharing.replica.intervals import Intervals
from gmmtorch.sharing.replica.record_keys import RECORD_KINDS, keys_in
from gmmtorch.sharing.replica.replica import Replica

SYNCS = ("snapshot", "always")
_MOST_NAMED = 1 << 16
"""Intervals of names of what is kept: 1 MiB. Where there are more they are forgotten, and some is written
again."""
_log = logging.getLogger(__name__)


class Journal:
    """Keeps a replica in a folder: snapshots, and a log of what it said and heard since the last.

        with Journal(folder, replica) as journal:  # restores what is there
            datagrams = replica.datagrams()
            journal.said(datagrams)                # before they are sent
            if replica.receive(datagram):
                journal.heard(datagram)            # before it is announced

    What `said` and `heard` have returned from is there after `kill -9` at any instant: the kernel has it.
    After a loss of power, too, with sync="always"; with "snapshot", what the last snapshot had is. What
    was added to the replica, and neither said nor in a snapshot, is lost.

    Where the disk is full, or fails, `OutputError` is raised: what was kept stays kept, and the robot may go
    on without, or try again; a `snapshot` that succeeds has it all. For one thread. Needs POSIX.

    Attributes:
        restored: what was found on opening, `journal_restore.Restored`.
    """

    def __init__(
        self,
        path: str | Path,
        replica: Replica,
        *,
        sync: str = "snapshot",
        most_log_bytes: int = 1 << 20,
    ) -> None:
        """Open or make the journal of a robot, and restore its replica.

        Args:
            path: a folder, of this robot alone; made if need be.
            replica: of this robot, with nothing in it yet, and with an incarnation that was drawn.
            sync: "always": `said` and `heard` return when the disk has it (fsync); "snapshot": when the
                kernel has it; snapshots go to the disk.
            most_log_bytes: a snapshot is written when the log has as many. 1 MiB takes seconds to replay.

        Raises `InvalidArgumentError` where another process has the folder; `DataError` where it is another
        robot's, or holds nothing that can be read; `OutputError` where it cannot be written to: the replica
        is restored then, from what can be read. Damage that leaves something to be used is logged, and in
        `restored`.
        """
        if sync not in SYNCS:
            raise InvalidArgumentError(f"sync={sync!r} must be one of {', '.join(SYNCS)}.")
        if check_whole("most_log_bytes", most_log_bytes, 1) > MOST_LOG_BYTES // 2:
            raise InvalidArgumentError(
                f"most_log_bytes={most_log_bytes} must be at most {MOST_LOG_BYTES // 2}."
            )
        if replica.held:
            raise InvalidArgumentError("replica holds records already; open its journal before.")
        self.path, self._replica = Path(path), replica
        self._sync, self._most = sync == "always", int(most_log_bytes)
        self._number = self._size = self._snapshot_at = 0
        self._file = -1
        self._in_snapshot = Intervals.empty()  # names of what the last one has
        try:
            self._lock = locked(self.path)
        except OutputError:
            if os.path.isdir(self.path):  # on a disk that is now for reading alone, say
                restore(self.path, replica)
            raise
        try:
            self._number = max([0, *numbers(self.path, SNAPSHOT), *numbers(self.path, LOG)])
            self.restored = restore(self.path, replica)
            self._last_sound = self.restored.snapshot or 0
            # Names of what is there also without the last snapshot, should that one rot.
            self._kept = replica.held
            self.snapshot()
        except BaseException:
            self.close()
            raise

    def said(self, datagrams: bytes | Iterable[bytes]) -> None:
        """Keep datagrams of the replica, before they are sent. All or, with `OutputError`, none; what is kept
        already is not written again, whatever the datagram in which it comes."""
        self._keep(datagrams)

    def heard(self, datagrams: bytes | Iterable[bytes]) -> None:
        """Keep datagrams that the replica has merged, before it announces them; else as `said`."""
        self._keep(datagrams)

    def snapshot(self) -> None:
        """Write the whole state, and start the log anew; also done by itself when the log is long.

        Raises `OutputError`; what is kept is what it was then, and the journal goes on.
        """
        self._check_open()
        # The log first: with or without its snapshot, all logs since the last one are here.
        self._start_log()
        data = pack_snapshot(self._replica.state(), self._replica.robot, self._replica.incarnation)
        path = place(self.path, self._number, SNAPSHOT)
        if len(data) > MOST_SNAPSHOT_BYTES:
            raise OutputError(
                f"{path} would have {len(data):,} bytes; {MOST_SNAPSHOT_BYTES:,} are the most. Make the map "
                "smaller: most_components."
            )
        write_durably(path, data)
        # The last one stays, with its log: should this one rot, nothing is lost.
        remove_older(self.path, self._last_sound)
        self._last_sound = self._number
        self._kept = (self._kept | self._in_snapshot).up_to(_MOST_NAMED)
        self._in_snapshot = self._replica.held

    def close(self) -> None:
        """Let go of the folder, without a last snapshot. May be called again."""
        for file in (self._file, self._lock):
            if file >= 0:
                os.close(file)
        self._file = self._lock = -1

    def __enter__(self) -> Journal:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close, with a last snapshot where nothing went wrong."""
        try:
            if kind is None and self._lock >= 0:
                self.snapshot()
        finally:
            self.close()

    # -- inside -----------------------------------------------------------------------------------

    def _keep(self, datagrams: bytes | Iterable[bytes]) -> None:
        """Write those that hold something that is not kept."""
        self._check_open()
        given = [datagrams] if isinstance(datagrams, bytes) else datagrams
        kept, frames = self._kept, []
        for datagram in given:
            if _is_record(datagram) and not kept.covers(names := keys_in(datagram)):
                kept |= names
                frames.append(framed(datagram))
        if frames:
            self._write(b"".join(frames))
            self._kept = kept.up_to(_MOST_NAMED)
            if self._size >= self._snapshot_at:
                self._try_snapshot()

    def _write(self, data: bytes) -> None:
        path = place(self.path, self._number, LOG)
        if self._size + len(data) > MOST_LOG_BYTES:
            raise OutputError(f"{path} is full, as snapshots have failed. Call snapshot() to see why.")
        try:
            append(self._file, data, self._sync)
        except OSError as error:
            raise unwritten(path, error) from error
        self._size += len(data)

    def _try_snapshot(self) -> None:
        """If it fails, what was to be kept is kept all the same."""
        self._snapshot_at = self._size + self._most  # not each time
        try:
            self.snapshot()
        except OutputError as error:
            _log.warning("The log of robot %d grows on: %s", self._replica.robot, error)

    def _start_log(self) -> None:
        header = log_header(self._replica.robot, self._replica.incarnation)
        file = new_log(place(self.path, self._number + 1, LOG), header)
        before, self._file = self._file, file
        self._number, self._size, self._snapshot_at = self._number + 1, len(header), self._most
        if before >= 0:
            os.close(before)

    def _check_open(self) -> None:
        if self._lock < 0:
            raise GmmTorchError(f"The journal {self.path} is closed; open another.")


def _is_record(datagram: bytes) -> bool:
    """Whether it is worth keeping; announcements, say, are not."""
    if not isinstance(datagram, bytes) or not 0 < len(datagram) <= MAX_BYTES:
        what = f"{len(datagram)} bytes" if isinstance(datagram, bytes) else type(datagram).__name__
        raise InvalidArgumentError(f"A datagram is {what}; it must be bytes, from 1 to {MAX_BYTES}.")
    return datagram[0] & 15 in RECORD_KINDS

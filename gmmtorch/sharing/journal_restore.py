"""What a journal holds, taken into a new replica: the newest sound snapshot, and the logs since."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.sharing.journal_files import LOG, SNAPSHOT, numbers, place, read
from gmmtorch.sharing.journal_format import Log, is_sound, read_log, unpack_snapshot
from gmmtorch.sharing.replica.record_keys import keys_of_author
from gmmtorch.sharing.replica.replica import Replica

MOST_LOG_BYTES = 64 << 20
MOST_SNAPSHOT_BYTES = 1 << 30
"""Of one file, written or read."""
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Restored:
    """What a journal held when it was opened.

    snapshot: number of the snapshot that was restored; None: none.
    n_datagrams: of the logs, merged on top of it; n_refused: those that the replica refused.
    n_torn: bytes that were being written when the robot died: nobody was told that they are kept.
    damage: a line for each file of which something is lost. Empty after any number of kills.
    """

    snapshot: int | None
    n_datagrams: int
    n_refused: int
    n_torn: int
    damage: tuple[str, ...]


def restore(folder: Path, replica: Replica) -> Restored:
    """Take what a journal holds into a replica without records; damage that leaves something is logged.

    Raises `DataError` for another robot's journal, for what is sound but does not fit the replica, and where
    nothing can be read; `InvalidArgumentError` where the replica would give names that were given.
    """
    damage: list[str] = []
    newest = _restore_snapshot(folder, replica, damage)
    n_merged = n_refused = n_torn = 0
    for number in numbers(folder, LOG):
        if newest is None or number >= newest:  # again, perhaps: merging is idempotent
            path = place(folder, number, LOG)
            log = _log_of(path, replica, damage)
            merged = sum(replica.receive(datagram) for datagram in log.datagrams)
            refused = len(log.datagrams) - merged
            if refused:
                damage.append(f"{path}: the replica refuses {refused} datagrams: {dict(replica.refused)}.")
            n_merged, n_refused, n_torn = n_merged + merged, n_refused + refused, n_torn + log.n_torn
    if damage and newest is None and not n_merged:
        raise DataError(
            f"{folder} holds nothing of a journal that can be read: {damage[0]} Move the folder away and "
            "start anew: teammates have what was sent."
        )
    if replica.held & keys_of_author(replica.robot, replica.incarnation):
        raise _lived_before(replica, folder)
    for line in damage:
        _log.warning("%s", line)
    return Restored(newest, n_merged, n_refused, n_torn, tuple(damage))


def _restore_snapshot(folder: Path, replica: Replica, damage: list[str]) -> int | None:
    """The number of the newest snapshot that is sound, which the replica holds now."""
    for number in reversed(numbers(folder, SNAPSHOT)):
        path = place(folder, number, SNAPSHOT)
        data = read(path, MOST_SNAPSHOT_BYTES)
        if data is None or not is_sound(data):
            damage.append(f"{path} is damaged, or no snapshot; what is older is used.")
            continue
        # What is sound is what was written: where it does not fit, that is for somebody to decide.
        state, robot, incarnation = unpack_snapshot(data, path)
        _check_writer(robot, incarnation, replica, path)
        try:
            replica.restore(state)
        except (DataError, ArithmeticError, LookupError) as error:
            raise DataError(
                f"{path} cannot be restored: {error} Make the replica with the most_components it had, or "
                "give the journal another folder."
            ) from error
        return number
    return None


def _log_of(path: Path, replica: Replica, damage: list[str]) -> Log:
    data = read(path, MOST_LOG_BYTES)
    if data is None:
        damage.append(f"{path} cannot be read, or has more than {MOST_LOG_BYTES:,} bytes.")
        return Log(None, None, [], 0, 0)
    log = read_log(data, path)
    if log.robot is not None and log.incarnation is not None:
        _check_writer(log.robot, log.incarnation, replica, path)
    if log.n_damaged:
        damage.append(
            f"{path} is damaged: {log.n_damaged:,} of {len(data):,} bytes; {len(log.datagrams)} datagrams "
            "are whole, and used. Teammates have what was sent."
        )
    return log


def _check_writer(robot: int, incarnation: int, replica: Replica, path: Path) -> None:
    if robot != replica.robot:
        raise DataError(
            f"{path} is of robot {robot}, the replica of robot {replica.robot}. Give each robot a "
            "folder of its own."
        )
    if incarnation == replica.incarnation:
        raise _lived_before(replica, path)


def _lived_before(replica: Replica, path: Path) -> InvalidArgumentError:
    return InvalidArgumentError(
        f"incarnation={replica.incarnation} of robot {replica.robot} has been before, says {path}. Make "
        f"Replica({replica.robot}) without: it draws one."
    )

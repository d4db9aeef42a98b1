"""ForgivingJournal: a journal without which a robot goes on, if its disk fails."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence

from gmmtorch.errors import OutputError
from gmmtorch.sharing.journal import Journal

_MOST_PATIENCE = 1 << 10  # batches between two tries
_log = logging.getLogger(__name__)


class ForgivingJournal:
    """Keeps what is said and heard as long as the disk takes it; teammates have what was said, anyway.

    After a failure a snapshot, which has it all, is tried again before the 1st, 2nd, 4th, 8th, … batch that
    follows. The log says once that it fails, and that it goes on.

    Attributes:
        n_failed: batches that were not kept when they should have been.
    """

    def __init__(self, journal: Journal) -> None:
        self._journal, self._is_open = journal, True
        self.n_failed = 0
        self._waited = self._patience = 0
        """Batches since the last try, and how many to let pass; 0: all is kept."""

    def said(self, datagrams: Sequence[bytes]) -> None:
        self._keep(self._journal.said, datagrams)

    def heard(self, datagrams: Sequence[bytes]) -> None:
        self._keep(self._journal.heard, datagrams)

    def close(self) -> None:
        """With a last snapshot, if the disk takes it. May be called again."""
        if not self._is_open:
            return
        self._is_open = False
        try:
            self._journal.snapshot()
        except OutputError as error:
            _log.warning("The map on disk is not the last one: %s", error)
        finally:
            self._journal.close()

    def _keep(self, keep: Callable[[Sequence[bytes]], None], datagrams: Sequence[bytes]) -> None:
        if not datagrams:
            return
        try:
            if self._patience and not self._caught_up():
                self.n_failed += 1
                return
            keep(datagrams)
        except OutputError as error:
            self.n_failed += 1
            if not self._patience:
                _log.warning("The map is no longer kept on disk, and the robot goes on: %s", error)
            self._waited, self._patience = 0, min(2 * self._patience or 1, _MOST_PATIENCE)

    def _caught_up(self) -> bool:
        """Whether a snapshot has been written; `OutputError` where it cannot be, False if it is not time."""
        self._waited += 1
        if self._waited < self._patience:
            return False
        self._journal.snapshot()
        self._patience = 0
        _log.warning("The map is kept on disk again.")
        return True

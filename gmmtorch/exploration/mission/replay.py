"""ReplayNode: a robot that maps a recorded log, and shares the map."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable, Iterable, Iterator, Sequence, Sized
from pathlib import Path
from typing import Any

from gmmtorch.errors import DataError, OutputError, check_whole
from gmmtorch.exploration.mission.forgiving_journal import ForgivingJournal
from gmmtorch.exploration.mission.map_publisher import MapPublisher
from gmmtorch.exploration.mission.mission_progress import Progress
from gmmtorch.exploration.mission.stopwatch import Stopwatch
from gmmtorch.exploration.robot.radio import Radio
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.scan import Scan
from gmmtorch.sharing.journal import Journal
from gmmtorch.sharing.replica.replica import Replica
from gmmtorch.sharing.transport.frames import FramedTransport
from gmmtorch.sharing.transport.simulated_network import Network

_log = logging.getLogger(__name__)


class ReplayNode:
    """Takes in a scan a tick, publishes its map, and hears of others'. A `Node`.

    A map is published whenever the components of a window are final, and at the end of the log. What is
    said and heard is written ahead to the journal, and the map to `folder` before it is published, every
    `keep_every` scans. Started again on the same journal, folder and log, whenever it was killed, it reads
    again the few scans since, publishes nothing before it is as far as it was, and then goes on: in the end
    the map is the one of a robot that was never killed. If its folder is lost, it begins anew, and what it
    said before counts beside that until the log is over.

    A disk that fails, and scans that cannot be read, are logged once and counted, and it goes on.

    Args:
        replica: of this robot; nothing but this adds to it.
        scans: the log, from its begin; an iterator is read as far as it had come when it goes on.
        transport: this robot's end of a network; a `FramedTransport` is closed with this.
        make_map: makes an empty map, always the same; what it learns is published as the robot's.
        journal: of the replica; closed with this.
        folder: of this robot alone, for its progress.
        facts: plain values that say what log this is: to go on with others, or another rule, is refused.
        announce_every: seconds between announcements while there is news.
        budget: bytes a second, of records; None: no limit.
    """

    def __init__(
        self,
        replica: Replica,
        scans: Iterable[Scan],
        transport: FramedTransport | Network,
        make_map: Callable[[], GaussianMap],
        *,
        journal: Journal | None = None,
        folder: str | Path | None = None,
        facts: dict[str, Any] | None = None,
        announce_every: float = 1.0,
        budget: float | None = None,
        keep_every: int = 10,
    ) -> None:
        self.replica, self.map = replica, make_map()
        self.n_scans = len(scans) if isinstance(scans, Sized) else None
        """Of the log; None while nobody knows."""
        self.radio = Radio(replica.robot, transport, announce_every, budget)
        self.n_unread = self.n_unsaved = 0
        self.watch = Stopwatch()
        self._scans, self._transport = scans, transport
        self._logbook = self.radio.logbook = None if journal is None else ForgivingJournal(journal)
        self._publication = MapPublisher(replica)
        self._keep_every = check_whole("keep_every", keep_every, 1)
        about = {"robot": replica.robot, "keep_every": keep_every, "n_scans": self.n_scans}
        about |= {"learning": self.map.get_extra_state()["learning"], **(facts or {})}
        self._progress = None if folder is None else Progress(folder, **about)
        self.position = self._saved_at = self._resume()
        """Scans of the log that have been read."""
        self.resumed_at = self.position
        self._rest: Iterator[Scan] | None = None  # of a log that is no sequence
        self._is_over = False

    # -- a node -----------------------------------------------------------------------------------

    @property
    def robot(self) -> int:
        return self.replica.robot

    @property
    def is_over(self) -> bool:
        """Whether the log is, and its last scans are published."""
        return self._is_over

    def tick(self, now: float) -> None:
        """Map the next scan, and talk."""
        if not self._is_over:
            with self.watch("mapping"):
                self._is_over = not self._take_scan()
            with self.watch("sharing"):
                self._publish()
        self.listen(now)

    def listen(self, now: float) -> None:
        with self.watch("sharing"):
            self._hear(now)
            self._speak(now)

    @property
    def twin(self) -> str | None:
        """What is said of another robot of this number, if there is one."""
        return self.radio.twin(self.replica.conflicts[self.robot])

    # -- the log ----------------------------------------------------------------------------------

    def _resume(self) -> int:
        """The position that was saved last, with the map as it was then."""
        if self._progress is None:
            self._covered_at = None
            return 0
        farthest, found = self._progress.farthest, self._progress.newest()
        # Up to where it may have published: beyond, the next state would have been saved before.
        self._covered_at = None if farthest is None else farthest + self._keep_every
        if found is None:
            self._save(0)
            return 0
        self.map.load_state_dict(found[1])
        return found[0]

    def _take_scan(self) -> bool:
        """Insert the next scan; whether there was one, and there may be more."""
        if self.n_scans is not None and self.position >= self.n_scans:
            return False
        try:
            scan = self._next()
        except DataError as error:
            self.n_unread += 1
            if self.n_unread == 1:
                _log.warning("Scan %d is left out, and so will be others like it: %s", self.position, error)
        else:
            if scan is None:
                self.n_scans = self.position
                return False
            self.map.insert(scan)
        self.position += 1
        return self.position != self.n_scans

    def _next(self) -> Scan | None:
        if isinstance(self._scans, Sequence):
            scan: Scan = self._scans[self.position]
            return scan
        if self._rest is None:
            self._rest = itertools.islice(iter(self._scans), self.position, None)
        return next(self._rest, None)

    def _publish(self) -> None:
        """Publish what is final; before, save it, if that is due."""
        if self.map.n_pending and not self._is_over:
            return
        if self._is_over or self.position >= self._saved_at + self._keep_every:
            self._save(self.position)
        # A map that lags behind what was published would take back what it does not have yet.
        whole = self._is_over or (self._covered_at is not None and self.position >= self._covered_at)
        if self.map.dim is not None and (whole or self._covered_at is None):
            self._publication.update(self.map.components(), whole)

    def _save(self, position: int) -> None:
        if self._progress is None:
            return
        try:
            self._progress.save(position, dict(self.map.state_dict()))
            self._saved_at = position
        except OutputError as error:
            self.n_unsaved += 1
            if self.n_unsaved == 1:
                _log.warning("Robot %d does not keep how far it is, and goes on: %s", self.robot, error)

    # -- the team ---------------------------------------------------------------------------------

    def _hear(self, now: float) -> None:
        heard = self.radio.hear(now)
        self.radio.keep(
            [item.datagram for item in heard if self.replica.receive(item.datagram, item.message)]
        )

    def _speak(self, now: float) -> None:
        datagrams = self.radio.within_budget(lambda budget: self.replica.datagrams(budget=budget), now)
        if self.radio.announces(now, (self.replica.version,), urgent=bool(self.replica.missing)):
            datagrams += self.replica.announcements()
        self.radio.tell(datagrams, now)

    # -- what there is to say ---------------------------------------------------------------------

    @property
    def n_missing(self) -> int:
        """Records that others have told they hold, and that have not come."""
        return self.replica.missing.size

    def status(self) -> str:
        total = "?" if self.n_scans is None else f"{self.n_scans:,}"
        return (
            f"scan {self.position:,}/{total}, {self.replica.n_components:,} components, "
            f"{self.n_missing:,} missing, {self._transport.traffic(self.robot).bytes / 1e3:,.0f} kB sent"
            f"{self.radio.remarks(self.replica.conflicts[self.robot])}"
        )

    def scalars(self) -> dict[str, float]:
        """What changes as it maps: numbers for a plot."""
        books = self._transport.books(self.robot)
        return {
            "scans": float(self.position),
            "components": float(self.replica.n_components),
            "records": float(self.replica.held.size),
            "missing": float(self.n_missing),
            "bytes_sent": float(books["bytes_sent"]),
            "datagrams_sent": float(books["datagrams"]),
            "datagrams_heard": float(self.radio.n_heard),
            "wire_bytes_sent": float(books["wire_bytes"]),
            "wire_bytes_received": float(books["wire_bytes_received"]),
            "refused": float(sum(books["refused"].values()) + sum(self.replica.refused.values())),
        }

    def row(self) -> dict[str, Any]:
        """What the robot leaves in results.json."""
        return {
            "robot": self.robot,
            "digest": self.replica.digest().hex(),
            "incarnation": self.replica.incarnation,
            "scans": self.position,
            "n_scans": self.n_scans,
            "resumed_at": self.resumed_at,
            "unread": self.n_unread,
            "n_components": self.replica.n_components,
            "n_records": self.replica.held.size,
            "missing": self.n_missing,
            **self._transport.books(self.robot),
            "heard": self.radio.n_heard,
            "damaged": self.radio.n_damaged,
            "not_merged": dict(self.replica.refused),
            "conflicts": {str(robot): n for robot, n in sorted(self.replica.conflicts.items()) if n},
            "unkept": self.n_unsaved + (0 if self._logbook is None else self._logbook.n_failed),
            "stage_seconds": self.watch.seconds,
        }

    def files(self) -> dict[str, tuple[str, Callable[[Path], object]]]:
        """The team's map, as far as it is known here, and this robot's own."""
        maps = {"map": self.replica.map(codec="quantized"), "own_map": self.map}
        return {name: (f"{name}{made.suffix}", made.save) for name, made in maps.items() if made.n_components}

    def close(self) -> None:
        """Close the journal, with a last snapshot, and the transport. May be called again."""
        if self._logbook is not None:
            self._logbook.close()
        if isinstance(self._transport, FramedTransport):
            self._transport.close()

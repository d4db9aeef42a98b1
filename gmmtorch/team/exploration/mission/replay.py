"""ReplayMission: a robot that maps a recorded log, and shares the map."""

from __future__ import annotations

import itertools
import json
import logging
from collections.abc import Callable, Iterable, Iterator, Sequence, Sized
from typing import Any

from gmmtorch.errors import DataError, check_number, check_whole
from gmmtorch.mapping import GaussianMap
from gmmtorch.scan import Scan
from gmmtorch.team.exploration.mission.driver import Stopwatch
from gmmtorch.team.sharing import FrameJoiner, Replica, SharedMap, Store, Transport

_log = logging.getLogger(__name__)


class ReplayMission:
    """Inserts a scan per tick, publishes the robot's map, and merges the records of other robots.

    The map is published whenever the components of a window are final, and at the end of the log. With a
    store, records are kept before they are sent, and the map before it is published, every `keep_every`
    scans. A robot that is killed and restarted with the same store and log reads the few scans since then
    again, publishes nothing before it is as far as it was, and ends with the map of a robot that was never
    killed. If the progress is lost, it begins again; the records that it sent before stay in the team's map
    until the log is over. A scan that cannot be read is left out and counted; the first one is logged.

    Args:
        replica, transport, announce_every, budget, joiner: as for `SharedMap`.
        scans: the log. An iterator is read from its beginning again when the robot is restarted.
        make_map: makes an empty map, always with the same options; what it learns is published.
        rate: scans per second.
        store: has restored the replica. Raises `DataError` if its progress is of other options or scans.

    Attributes:
        map: the robot's own map. shared: what it exchanges with its team.
        n_scans: of the log; None while unknown.
        position: scans read so far. resumed_at: position at the start of this session.
        n_unread: scans that could not be read.
    """

    def __init__(
        self,
        replica: Replica,
        scans: Iterable[Scan],
        transport: Transport,
        make_map: Callable[[], GaussianMap],
        *,
        rate: float = 1.0,
        store: Store | None = None,
        announce_every: float = 1.0,
        budget: float | None = None,
        keep_every: int = 10,
        joiner: FrameJoiner | None = None,
    ) -> None:
        check_number("rate", rate, above=True)
        self.replica, self.map, self.tick_seconds = replica, make_map(), 1 / rate
        self.shared = SharedMap(
            replica, transport, store=store, announce_every=announce_every, budget=budget, joiner=joiner
        )
        self.n_scans = len(scans) if isinstance(scans, Sized) else None
        self.watch = Stopwatch()
        self.n_unread = 0
        self.is_over = False
        """Whether the log is over and all of it is published."""
        self._scans, self._store = scans, store
        self._keep_every = check_whole("keep_every", keep_every, 1)
        self._covered_at: int | None = None
        """Position from which the map has all that earlier sessions published; None: there were none."""
        options = {
            "keep_every": keep_every,
            "n_scans": self.n_scans,
            "learning": self.map.get_extra_state()["learning"],  # of an empty map
        }
        self._options: dict[str, Any] = json.loads(json.dumps(options))  # as it is read from a file
        self.position = self._saved_at = self._resume()
        self.resumed_at = self.position
        self._rest: Iterator[Scan] | None = None  # of a log that is no sequence

    def tick(self, now: float) -> None:
        """Inserts the next scan, publishes, and exchanges messages, at the time `now` (s)."""
        if not self.is_over:
            with self.watch("mapping"):
                self.is_over = not self._insert_scan()
            with self.watch("sharing"):
                self._publish()
        self.exchange(now)

    def exchange(self, now: float) -> None:
        """Listens, answers and announces at the time `now` (s)."""
        with self.watch("sharing"):
            self.shared.exchange(now)
        with self.watch("joining"):
            self.shared.search(now)

    def content(self) -> int:
        """Changes whenever records are added to the team's map."""
        return self.shared.content()

    def _resume(self) -> int:
        """Restores the map as it was saved last; returns the position then."""
        if self._store is None:
            return 0
        farthest, found = self._store.farthest, self._store.progress()
        # Beyond this position, the map would have been saved again before it was published.
        self._covered_at = None if farthest is None else farthest + self._keep_every
        if found is None:
            self._save(0)
            return 0
        position, state = found
        kept, own = state.get("options"), self._options
        if kept != own:
            kept = kept if isinstance(kept, dict) else {}
            names = ", ".join(sorted(name for name in own if kept.get(name) != own[name]))
            raise DataError(
                f"The stored progress of robot {self.replica.robot} is of another run ({names} differ); give "
                "the options that it was started with, or another folder."
            )
        self.map.load_state_dict(state["map"])
        return position

    def _insert_scan(self) -> bool:
        """Inserts the next scan; returns whether there was one and there may be more."""
        if self.n_scans is not None and self.position >= self.n_scans:
            return False
        try:
            scan = self._next_scan()
        except DataError as error:
            self.n_unread += 1
            if self.n_unread == 1:
                _log.warning(
                    "Scan %d cannot be read and is left out, and so will others be: %s", self.position, error
                )
        else:
            if scan is None:
                self.n_scans = self.position
                return False
            self.map.insert(scan)
            self.shared.add(scan)
        self.position += 1
        return self.position != self.n_scans

    def _next_scan(self) -> Scan | None:
        if isinstance(self._scans, Sequence):
            scan: Scan = self._scans[self.position]
            return scan
        if self._rest is None:
            self._rest = itertools.islice(iter(self._scans), self.position, None)
        return next(self._rest, None)

    def _publish(self) -> None:
        """Publishes the components that are final; saves the map before that, if it is due."""
        if self.map.n_pending and not self.is_over:
            return
        if self.is_over or self.position >= self._saved_at + self._keep_every:
            self._save(self.position)
        # A map that is behind what was published would withdraw what it has not learned again yet.
        is_whole = self.is_over or (self._covered_at is not None and self.position >= self._covered_at)
        if self.map.dim is not None and (is_whole or self._covered_at is None):
            self.replica.publish(self.map.components(), whole=is_whole)

    def _save(self, position: int) -> None:
        if self._store is not None:
            state = {"map": dict(self.map.state_dict()), "options": self._options}
            if self._store.save_progress(position, state):
                self._saved_at = position

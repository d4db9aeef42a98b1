"""SharedMap: a robot's own map as a part of its team's map."""

from __future__ import annotations

import logging
import time

import torch

from gmmtorch.mapping import Components, GaussianMap, MotionAt, WindowMotions
from gmmtorch.scan import Scan
from gmmtorch.team.sharing.frame_joiner import FrameJoiner
from gmmtorch.team.sharing.radio import Radio, RecordStore
from gmmtorch.team.sharing.replica.moved_map import MovedMap
from gmmtorch.team.sharing.replica.replica import Replica
from gmmtorch.team.sharing.transport.simulated_network import Transport

_log = logging.getLogger(__name__)
_SEARCHING = 0.2
"""Share of the processor's time in which a robot without a known start pose searches for its place."""


class SharedMap:
    """Publishes the components of a robot's own map, and merges those of its teammates.

    Times are seconds of any clock.

    Args:
        replica: of this robot; nothing else may add components to it.
        transport: the network.
        store: keeps records before they are sent; it has restored the replica. None: nothing is kept.
        announce_every: seconds between announcements while there is news.
        budget: bytes per second for records; None: no limit.
        joiner: of a replica with a frame of its own. It searches for this frame's place in a teammate's.

    Attributes:
        replica: the team's map as this robot holds it. radio: the robot's end of the network.
    """

    def __init__(
        self,
        replica: Replica,
        transport: Transport,
        *,
        store: RecordStore | None = None,
        announce_every: float = 1.0,
        budget: float | None = None,
        joiner: FrameJoiner | None = None,
    ) -> None:
        self.replica = replica
        self.radio = Radio(replica.robot, transport, announce_every, budget)
        self.radio.store = store
        self._joiner = joiner
        self._search_at = 0.0

    @property
    def robot(self) -> int:
        """Number of the robot."""
        return self.replica.robot

    def add(self, scan: Scan) -> None:
        """Remembers a scan that the robot has mapped, for the search for its place."""
        if self._joiner is not None:
            self._joiner.add(scan)

    def publish(self, own: GaussianMap, windows: WindowMotions) -> None:
        """Makes the robot's records those of its map, which has no unfinished window.

        What was published before its window moved gets a correction, one record for each window.
        """
        moved = None
        if windows.moved or self.replica.is_corrected:
            moved = MovedMap(*windows.as_inserted(own), windows.motions)
        if own.query_options.calibration is not None:
            self.replica.calibrate(own.query_options.calibration)
        self.replica.publish(own.components(), whole=True, moved=moved)

    def correct(self, motion_at: MotionAt) -> None:
        """Moves the scans that are remembered for the search for the robot's place."""
        if self._joiner is not None:
            self._joiner.correct(motion_at)

    def exchange(self, now: float) -> None:
        """Listens, answers and announces."""
        replica, radio = self.replica, self.radio
        received = radio.receive(now)
        radio.keep([item.datagram for item in received if replica.receive(item.datagram, item.message)])
        datagrams = radio.within_budget(lambda budget: replica.datagrams(budget=budget), now)
        if radio.announcements.due(now, (replica.version,), urgent=bool(replica.missing)):
            datagrams += replica.announcements()
        radio.send(datagrams, now)

    def search(self, now: float) -> None:
        """Searches for the robot's place in a teammate's map, if it is time."""
        if self._joiner is None or now < self._search_at:
            return
        begin = time.process_time()
        if self._joiner.search():
            _log.info("Robot %d has placed its frame in a teammate's.", self.replica.robot)
        self._search_at = now + (time.process_time() - begin) / _SEARCHING

    def content(self) -> int:
        """Changes whenever records are added to the team's map."""
        return self.replica.version

    def map(self, own: GaussianMap, codec: str = "float") -> GaussianMap:
        """The `components` as a map that answers like the robot's own, with the calibration of the team."""
        return own.snapshot(self.components(), codec=codec, calibration=self.replica.calibration)

    def components(self) -> Components:
        """The components of the team that are placed relative to this robot's, in this robot's frame."""
        found, transform = self.replica.components(), self.replica.placement.transform
        if transform is None:
            return found
        return found.transformed(torch.linalg.inv(transform).to(found.means), torch.ones(len(found)).bool())

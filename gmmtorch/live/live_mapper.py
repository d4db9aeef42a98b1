"""Builds a map from live scans, or finds live scans in a known map, and publishes what is found."""

from __future__ import annotations

import time
from concurrent.futures import Future, ThreadPoolExecutor

import torch
from torch import Tensor

from gmmtorch.datasets import NANOSECONDS
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.live.live_scans import LiveScan, LiveScans
from gmmtorch.live.live_view import TeamMap
from gmmtorch.live.publishers import Diagnostics, MapPublisher, PosePublisher
from gmmtorch.live.ros import Node
from gmmtorch.localization import Tracker
from gmmtorch.mapping import GaussianMap, MapBuilder
from gmmtorch.pose import Pose
from gmmtorch.scan import Scan

_MESSAGES = 500  # of a flood, before a scan is mapped
_PATIENCE = 3.0  # s that a due publication waits for the end of a window


class LiveMapper:
    """Inserts the scans of a live topic into a map with a `MapBuilder`, and publishes the map.

    Poses of odometry are published, too. When odometry closes a loop, the windows of the map move with the
    corrected poses of their scans.

    With `shared`, teammates receive the components of complete windows and their corrections, and their
    components are published together with the robot's own.

    Args:
        node: receives the messages of `scans`.
        target: the map.
        publisher: publishes the map; None: it is not published.
        period: seconds between two publications, at least.
        shared: the robot's map in the map of its team; None: it is not shared.

    Attributes:
        n_corrections: how often closed loops have moved the map.
        nbytes: bytes of the map that was published last; 0 before.
    """

    def __init__(
        self,
        node: Node,
        scans: LiveScans,
        target: GaussianMap,
        publisher: MapPublisher | None = None,
        period: float = 1.0,
        device: str | torch.device = "cpu",
        shared: TeamMap | None = None,
    ) -> None:
        self.builder = MapBuilder(scans, target, device)
        self.shared = shared
        self.n_corrections = 0
        self.diagnostics = Diagnostics(node, scans)
        self._node, self._scans, self._publisher, self._period = node, scans, publisher, period
        self._poses = PosePublisher(node, scans.world_frame) if scans.has_odometry else None
        self._unpublished: list[int] = []  # stamps of scans, ns
        self._published: list[int] = []
        self._content = 0  # of the team's map, when it was published last
        self._thread = ThreadPoolExecutor(1, "publication")
        self._publication: Future[int] | None = None
        self.nbytes = 0
        self._begin = self._next_publication = time.monotonic()

    def step(self, timeout: float = 0.1) -> bool:
        """Handles the messages that wait, and maps at most one scan; returns whether it did."""
        handle_messages(self._node, timeout if not self._scans.n_waiting else min(timeout, 0.01))
        did = self._scans.advance() and self._insert()
        if self.shared is not None:
            self.shared.exchange(time.monotonic())
            self.shared.search(time.monotonic())
        self._publish_when_due()
        self._report()
        return did

    def finish(self) -> None:
        """Maps the scans that still wait, learns from the unfinished window, and publishes the map."""
        handle_messages(self._node, 0.0)
        while self._scans.advance(is_last=True):
            self._insert()
        if self.builder.record.indices:
            self.builder.finish()
            self._share()
        for _ in range(2):  # the one that goes on, and one with all scans
            self._end_publication()
            self._begin_publication()
        self._end_publication()
        self._thread.shutdown()
        self._report(is_last=True)

    def snapshot(self, codec: str = "float") -> GaussianMap:
        """A copy of the map that does not grow; of the team's map, if it is shared."""
        built = self.builder.map
        return built.snapshot(codec=codec) if self.shared is None else self.shared.map(built, codec)

    def _insert(self) -> bool:
        self._correct()
        for _ in self.builder.insert_all():
            newest = self._scans.newest
            if newest is not None:
                self._unpublished.append(newest.stamp)
                if self._poses is not None and newest.location is not None:
                    self._poses.publish_odometry(newest.location, newest)
                if self.shared is not None:
                    self.shared.add(newest.scan)
        if self.builder.map.n_pending == 0:
            self._share()
        return True

    def _correct(self) -> None:
        """Moves the map if a loop was closed."""
        corrected = self._scans.corrected_poses()
        motion_at = None if corrected is None else self.builder.correct(*corrected)
        if motion_at is None:
            return
        self.n_corrections += 1
        if self.shared is not None:
            self.shared.correct(motion_at)
            self._share()

    def _share(self) -> None:
        """Makes the robot's records those of its map. After a restart this withdraws what the checkpoint
        lacks."""
        if self.shared is not None:
            self.shared.publish(self.builder.map, self.builder.windows)

    def _publish_when_due(self) -> None:
        if self._publication is not None and self._publication.done():
            self._end_publication()
        late = time.monotonic() - self._next_publication
        is_whole = self.builder.map.n_pending == 0  # else the unfinished window would be learned for it
        if self._has_news() and self._publication is None and (late > _PATIENCE or (late >= 0 and is_whole)):
            self._begin_publication()

    def _has_news(self) -> bool:
        """Whether the map has changed since it was published last."""
        is_merged = self.shared is not None and self.shared.content() != self._content
        return bool(self._unpublished) or (is_merged and bool(self.builder.record.indices))

    def _begin_publication(self) -> None:
        """Publishes a copy of the map in another thread, while scans are mapped."""
        if self._publisher is not None and self._has_news():
            self._content = 0 if self.shared is None else self.shared.content()
            stamp = self._unpublished[-1] if self._unpublished else self._node.now()
            arguments = self.snapshot(), self._scans.world_frame, stamp
            self._published, self._unpublished = self._unpublished, []
            self._publication = self._thread.submit(self._work, *arguments)
            self._begin = time.monotonic()

    def _work(self, shown: GaussianMap, frame: str, stamp: int) -> int:
        """Publishes a copy of the map, and returns its bytes."""
        assert self._publisher is not None
        self._publisher.publish(shown, frame, stamp)
        return GaussianMap.of(shown.components(), codec=self.builder.map.codec).nbytes

    def _end_publication(self) -> None:
        if self._publication is None:
            return
        self.nbytes = self._publication.result()
        self._publication = None
        now, end = self._node.now(), time.monotonic()
        for stamp in self._published:
            self.diagnostics.note_latency((now - stamp) / NANOSECONDS)
        self._next_publication = max(end, self._begin + self._period)

    def _report(self, is_last: bool = False) -> None:
        record = self.builder.record
        if self.diagnostics.is_due() or is_last:
            built = self.builder.map
            n_components = built.n_final if built.dim is not None else 0
            self.diagnostics.publish(len(record.indices), n_components, self.nbytes)


def handle_messages(node: Node, timeout: float) -> None:
    """Calls the callbacks of the messages that wait; waits for the first one up to `timeout` (s)."""
    left = _MESSAGES
    is_handled = node.spin_once(timeout)
    while is_handled and left:
        is_handled, left = node.spin_once(), left - 1


def warm_up(empty: GaussianMap, device: str | torch.device) -> None:
    """Loads and compiles what mapping needs, so that the first scans are not late.

    empty: a map with the options of the run, which is used up.
    """
    angles = torch.arange(400, dtype=torch.float64) * (2 * torch.pi / 400)
    circle = torch.stack([angles.cos(), angles.sin()], 1) * 3
    for shift in (0.0, 0.1):
        empty.insert(Scan(circle + shift, torch.zeros(2, dtype=torch.float64)).to(device))
    empty.finish()
    empty.occupancy(circle.to(device), 0.1)


MAP = "map"
"""Frame of the map."""


class LiveLocalizer:
    """Localises the scans of a live topic in a map, which stays as it is, with a `Tracker`.

    Publishes the sensor's pose as Odometry on the topic pose, and the transform from `map` to the fixed frame
    of TF, each with the stamp of the scan. The motion between scans is that of TF, if it is known.

    Args:
        node: receives the messages of `scans`.
        has_motion: whether the poses of scans are those of TF.

    Attributes:
        poses, times: of the scans that were found: (D+1, D+1) map ← sensor, and seconds.
        n_scans, n_lost: scans so far, and those of them that were not found.
    """

    def __init__(
        self,
        node: Node,
        scans: LiveScans,
        known: GaussianMap,
        has_motion: bool = True,
        device: str | torch.device = "cpu",
    ) -> None:
        self.diagnostics = Diagnostics(node, scans, "gmmtorch localisation")
        self.poses: list[Tensor] = []
        self.times: list[float] = []
        self.n_scans = self.n_lost = 0
        self._node, self._scans, self._has_motion, self._device = node, scans, has_motion, device
        self._tracker = Tracker(known.to(device))
        self._n_components, self._nbytes = known.n_components, known.nbytes
        self._last: Pose | None = None
        self._poses = PosePublisher(node, MAP)

    def step(self, timeout: float = 0.1) -> bool:
        """Handles the messages that wait, and localises at most one scan; returns whether it did."""
        handle_messages(self._node, timeout if not self._scans.n_waiting else min(timeout, 0.01))
        did = self._scans.advance()
        newest = self._scans.newest
        if did and newest is not None:
            self._locate(newest, self._scans.pose(len(self._scans) - 1))
        if self.diagnostics.is_due():
            self.diagnostics.publish(self.n_scans, self._n_components, self._nbytes)
        return did

    def _locate(self, newest: LiveScan, placed: Tensor | None) -> None:
        """Localises a scan that was measured at the pose `placed`, (D+1, D+1) fixed frame ← sensor."""
        assert placed is not None
        dim = newest.scan.dim
        if dim != self._tracker.dim:
            raise InvalidArgumentError(
                f"localize has a map in {self._tracker.dim}D, but topic {self._scans.name} has scans in "
                f"{dim}D; give a map of this kind of sensor."
            )
        pose = Pose.from_matrix(placed)
        points = pose.inverse().apply(newest.scan.points.double())
        motion = None if self._last is None or not self._has_motion else (self._last.inverse() @ pose).matrix
        self._last = pose
        location = self._tracker.locate(points.to(self._device), motion)
        self.n_scans += 1
        if not location.found:
            self.n_lost += 1
            counts = f"{self.n_lost} of {self.n_scans} scans were not found in the map"
            self._node.warn("lost", f"{counts}: {'; '.join(location.doubts)}")
            return
        self.poses.append(location.pose.cpu())
        self.times.append(newest.stamp / NANOSECONDS)
        child = self._scans.world_frame if self._has_motion else newest.frame
        below = pose.to("cpu").in_space() if self._has_motion else Pose.identity(3)
        self._poses.publish(location, newest, child, below)
        self.diagnostics.note_latency((self._node.now() - newest.stamp) / NANOSECONDS)

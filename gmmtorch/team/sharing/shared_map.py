"""SharedMap: a robot's own map in its team's map; FrameJoiner: finds where the robot's frame is in it."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from gmmtorch.errors import check_number, check_whole
from gmmtorch.localization import Tracker, register
from gmmtorch.mapping import Components, GaussianMap, MotionAt, WindowMotions
from gmmtorch.pose import Pose
from gmmtorch.scan import Scan
from gmmtorch.team.sharing.radio import Radio
from gmmtorch.team.sharing.replica.authorship import MovedMap
from gmmtorch.team.sharing.replica.materialized_view import robot_of_frame
from gmmtorch.team.sharing.replica.replica import Replica
from gmmtorch.team.sharing.store import Store
from gmmtorch.team.sharing.transport.simulated_network import Transport

_AGREE = 0.3, math.radians(3)  # metres and radians at the newer scan: two estimates of a frame agree
_POINTS = 1000  # of a scan that are remembered, as many as a tracker uses
_GROWN = 1.2  # times the components that a frame had: it is searched, or both maps registered, again
_COARSEST = 0.25  # metres: the registration of both maps begins near the estimate
_FEWEST = 20  # components of surfaces in which a scan is searched for


_Place = tuple[Tensor, Tensor]
"""Where a scan was taken (D,), in the robot's frame, and its points (N, D) about it."""
_Estimate = tuple[Tensor, Tensor]
"""Transform (D+1, D+1), frame ← the robot's frame; and where the scan that was located was taken (D,)."""


class FrameJoiner:
    """Joins the frame of a robot without a known start pose to the frame of a teammate.

    A scan of the robot is located in the teammates' map (`localization.Tracker`, without a first pose),
    which gives the transform between the frames. Two located scans in succession, taken at different
    places, must give the same transform: within 0.3 m and 3° at the newer one. Registration of the robot's
    map with theirs then makes it more accurate, if it is reliable and agrees; it is repeated each time the
    maps have grown by a fifth.

        joiner = FrameJoiner(replica)                # replica = Replica(robot, own_frame=True)
        joiner.add(scan)                             # each scan that the robot maps, in its own frame
        joiner.search()                              # repeatedly: True if the frame was placed

    Args:
        replica: of the robot. Its frame must have gravity along −z in 3D, to within about 10°.
        spacing: metres between the places of scans that are remembered.
        most_places: scans that are remembered; of more, every second one is left out.

    Attributes: n_searches: scans that were searched for; n_located: of these, those that were found.
    """

    def __init__(self, replica: Replica, *, spacing: float = 1.0, most_places: int = 256) -> None:
        check_number("spacing", spacing)
        self._replica, self._spacing = replica, float(spacing)
        self._most = check_whole("most_places", most_places, 2)
        self._places: list[_Place] = []
        self._waiting: list[_Place] = []  # not searched for yet, in the frame that is tried
        self._frame: int | None = None
        self._tracker: tuple[int, Tracker] | None = None  # with the replica's version
        self._n_components = 0  # of the frame when old scans were last searched for
        self._last: _Estimate | None = None
        self.n_searches = self.n_located = 0

    def add(self, scan: Scan) -> None:
        """Remember a scan of the robot, in the frame in which it adds components."""
        origin = scan.origin.detach().cpu().double()
        if self._places and float((self._places[-1][0] - origin).norm()) < self._spacing:
            return
        points = scan.points.detach().cpu().double()
        chosen = torch.randperm(len(points), generator=torch.Generator().manual_seed(0))[:_POINTS]
        self._places.append((origin, points[chosen] - origin))
        self._waiting.append(self._places[-1])
        if len(self._places) > self._most:
            self._places, self._spacing = self._places[::2], 2 * self._spacing
            self._waiting = self._waiting[::2]

    def correct(self, motion_at: Callable[[Tensor], Tensor]) -> None:
        """Move the remembered scans, when the poses of the robot's scans were corrected.

        motion_at: the motions (N, D+1, D+1) of scans with origins (N, D), after ← before.
        """
        self._places, self._waiting = (_moved(some, motion_at) for some in (self._places, self._waiting))
        self._last = None

    def search(self) -> bool:
        """Search for one scan, the newest that was not searched for, in the first of `other_frames`. If there
        is none, estimate the joined frame again when the maps have grown. Returns whether a frame was joined
        or moved. The time is that of a `Tracker` without a first pose, or of one registration."""
        frames = self._replica.other_frames
        if not frames:
            return self._estimate_again()
        self._choose(frames[0])
        if not self._waiting:
            return False
        origin, points = self._waiting.pop()
        tracker = self._tracker_of(frames[0])
        if tracker is None or tracker.dim != len(origin):
            return False
        tracker.restart()
        location = tracker.locate(points)
        self.n_searches += 1
        if not location.found:
            return False
        self.n_located += 1
        frame = location.pose.clone()  # of the robot, instead of the scan's
        frame[:-1, -1] -= frame[:-1, :-1] @ origin.to(frame)
        return self._agreed(frames[0], (frame, origin))

    def _choose(self, frame: int) -> None:
        """Go on with this frame; all scans wait again if it is another one or has grown."""
        n = len(self._replica.components(frame))
        if frame != self._frame:
            self._last, self._tracker = None, None
        if frame != self._frame or n > _GROWN * self._n_components:
            self._frame, self._n_components, self._waiting = frame, n, list(self._places)

    def _tracker_of(self, frame: int) -> Tracker | None:
        """A tracker in the components of a frame; None while they are few."""
        if self._tracker is None or self._tracker[0] < self._replica.version:
            components = self._replica.components(frame)
            if int((~components.max_range).sum()) < _FEWEST:
                return None
            self._tracker = self._replica.version, Tracker(GaussianMap.of(components))
        return self._tracker[1]

    def _agreed(self, frame: int, now: _Estimate) -> bool:
        """Join if the estimate agrees with the last one."""
        last, self._last = self._last, now
        if last is None or not _agree(last[0], now) or float((last[1] - now[1]).norm()) < self._spacing:
            return False
        own, _ = self._split()
        self._replica.join(frame, _refined(own, self._replica.components(frame), now))
        self._last, self._n_components = None, len(self._replica.components())
        return True

    def _estimate_again(self) -> bool:
        """Lay the robot's map over the others' of the frame that it joined, if the maps have grown."""
        transform, n = self._replica.placement.transform, len(self._replica.components())
        if self._frame is None or transform is None or n < _GROWN * self._n_components:
            return False
        self._n_components = n
        own, theirs = self._split()
        found = _refined(own, theirs, (transform, self._places[-1][0]))
        if torch.equal(found, transform):
            return False
        self._replica.join(self._replica.placement.root, found)
        return True

    def _split(self) -> tuple[Components, Components]:
        """The robot's own components in its own frame, and those of others in the frame of all."""
        placed, to_root = self._replica.components(), self._replica.placement.transform
        is_own = placed.ids[:, 0] == self._replica.robot
        own, theirs = (placed.selected(which.nonzero().squeeze(1)) for which in (is_own, ~is_own))
        if to_root is not None:
            own = own.transformed(Pose.from_matrix(to_root).inverse().matrix, torch.ones(len(own)) > 0)
        return own, theirs


def _refined(own: Components, theirs: Components, estimate: _Estimate) -> Tensor:
    """The transform that lays a map over another one, if it is reliable and agrees; else the estimate's."""
    if bool(own.max_range.all()) or bool(theirs.max_range.all()):
        return estimate[0]
    found = register(own, theirs, estimate[0], coarsest=_COARSEST)
    return found.transform if found.reliable and _agree(found.transform, estimate) else estimate[0]


def _moved(places: Sequence[_Place], motion_at: Callable[[Tensor], Tensor]) -> list[_Place]:
    if not places:
        return []
    motions = motion_at(torch.stack([origin for origin, _ in places]))
    return [
        (motion[:-1, :-1] @ origin + motion[:-1, -1], points @ motion[:-1, :-1].T)
        for (origin, points), motion in zip(places, motions, strict=True)
    ]


def _agree(transform: Tensor, estimate: _Estimate) -> bool:
    """Whether a transform puts the estimate's scan where the estimate does."""
    apart = transform - estimate[0]
    shift = apart[:-1, :-1] @ estimate[1] + apart[:-1, -1]
    turn = torch.linalg.matrix_norm(apart[:-1, :-1]) / math.sqrt(2)
    return bool(shift.norm() < _AGREE[0]) and bool(turn < _AGREE[1])


_log = logging.getLogger(__name__)
_SEARCHING = 0.2
"""Share of the processor's time in which a robot without a known start pose searches for its place."""


class SharedMap:
    """Publishes the components of a robot's own map, and merges those of its teammates. Times are seconds of
    any clock.

    Args:
        replica: of this robot; nothing else may add components to it. transport: the network.
        store: keeps records before they are sent; it has restored the replica. None: nothing is kept.
        announce_every: seconds between announcements while records are missing.
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
        store: Store | None = None,
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
        return self.replica.robot

    def add(self, scan: Scan) -> None:
        """Remembers a scan that the robot has mapped, for the search for its place."""
        if self._joiner is not None:
            self._joiner.add(scan)

    def publish(self, own: GaussianMap, windows: WindowMotions) -> None:
        """Makes the robot's records those of its map, which has no unfinished window. What was published
        before its window moved gets a correction, one record for each window."""
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
        if radio.announcements.due(now, (replica.version,), bool(replica.missing), replica.is_complete):
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
        back = Pose.from_matrix(transform).inverse().matrix.to(found.means)
        return found.transformed(back, torch.ones(len(found)).bool())

    def row(self) -> dict[str, Any]:
        """What the robot shared with its team, as a part of a row of results.json."""
        replica, radio, (root, transform) = self.replica, self.radio, self.replica.placement
        robot = robot_of_frame(root)
        return {
            "robot": replica.robot,
            "digest": replica.digest().hex(),
            "incarnation": replica.incarnation,
            "frame": {  # in which the map is, None: the world; and the pose of this robot's frame in it
                "of_robot": None if robot < 0 else robot,
                "transform": None if transform is None else transform.tolist(),
            },
            "n_components": replica.n_components,
            "n_records": replica.held.size,
            "missing": replica.missing.size,
            **radio.row(),
            "not_merged": dict(replica.refused),
            "conflicts": {str(robot): n for robot, n in sorted(replica.duplicates.items()) if n},
        }

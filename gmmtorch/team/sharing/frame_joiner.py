"""FrameJoiner: finds where a robot's frame is in a teammate's map, and joins it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.errors import check_number, check_whole
from gmmtorch.localization import Tracker, register
from gmmtorch.mapping import Components, GaussianMap
from gmmtorch.scan import Scan
from gmmtorch.team.sharing.replica.replica import Replica

_AGREE = 0.3, math.radians(3)  # metres and radians at the newer scan: two estimates of a frame agree
_POINTS = 1000  # of a scan that are remembered, as many as a tracker uses
_GROWN = 1.2  # times the components that a frame had: it is searched, or both maps registered, again
_COARSEST = 0.25  # metres: the registration of both maps begins near the estimate
_FEWEST = 20  # components of surfaces in which a scan is searched for


class _Place(NamedTuple):
    """Where a scan was taken (D,), in the robot's frame, and its points (N, D) about it."""

    origin: Tensor
    points: Tensor


class _Estimate(NamedTuple):
    """transform: (D+1, D+1), frame ← the robot's frame. place: of the scan that was located."""

    transform: Tensor
    place: _Place


class FrameJoiner:
    """Joins the frame of a robot without a known start pose to the frame of a teammate.

    A scan of the robot is located in the teammates' map (`localization.Tracker`, without a first pose),
    which gives the transform between the frames. Two located scans in succession, taken at different
    places, must give the same transform: within 0.3 m and 3° at the newer one. The registration of the
    robot's map with theirs then makes it more accurate, if it is reliable and agrees. It is repeated each
    time the maps have grown by a fifth, because the frames are known better where the maps overlap more.

        joiner = FrameJoiner(replica)                # replica = Replica(robot, own_frame=True)
        joiner.add(scan)                             # each scan that the robot maps, in its own frame
        joiner.search()                              # repeatedly: True if the frame was placed

    Of several frames the one of the robot with the lowest id is joined; see `Replica.join`.

    Args:
        replica: of the robot. Its frame must have gravity along −z in 3D, to within about 10°.
        spacing: metres between the places of scans that are remembered.
        most_places: scans that are remembered; of more, every second one is left out.

    Attributes:
        n_searches: scans that were searched for. n_located: of these, how many were found.
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
        if self._places and float((self._places[-1].origin - origin).norm()) < self._spacing:
            return
        points = scan.points.detach().cpu().double()
        chosen = torch.randperm(len(points), generator=torch.Generator().manual_seed(0))[:_POINTS]
        place = _Place(origin, points[chosen] - origin)
        self._places.append(place)
        self._waiting.append(place)
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
        """Search for one scan, the newest that was not searched for, in the first of `other_frames`.

        If there is none, the frame that was joined is estimated again when the maps have grown.

        Returns whether a frame was joined or moved. The time is that of a `Tracker` without a first pose, or
        of one registration.
        """
        frames = self._replica.other_frames
        if not frames:
            return self._estimate_again()
        self._choose(frames[0])
        if not self._waiting:
            return False
        place = self._waiting.pop()
        tracker = self._tracker_of(frames[0])
        if tracker is None or tracker.dim != len(place.origin):
            return False
        tracker.restart()
        location = tracker.locate(place.points)
        self.n_searches += 1
        if not location.found:
            return False
        self.n_located += 1
        return self._agreed(frames[0], _Estimate(_shifted(location.pose, -place.origin), place))

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
        if last is None or not _agree(last.transform, now):
            return False
        if float((last.place.origin - now.place.origin).norm()) < self._spacing:
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
        found = _refined(own, theirs, _Estimate(transform, self._places[-1]))
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
            own = own.transformed(torch.linalg.inv(to_root), torch.ones(len(own)) > 0)
        return own, theirs


def _refined(own: Components, theirs: Components, estimate: _Estimate) -> Tensor:
    """The transform that lays a map over another one, if it is reliable and agrees; else the estimate's."""
    if bool(own.max_range.all()) or bool(theirs.max_range.all()):
        return estimate.transform
    found = register(own, theirs, estimate.transform, coarsest=_COARSEST)
    return found.transform if found.reliable and _agree(found.transform, estimate) else estimate.transform


def _moved(places: Sequence[_Place], motion_at: Callable[[Tensor], Tensor]) -> list[_Place]:
    if not places:
        return []
    motions = motion_at(torch.stack([place.origin for place in places]))
    return [
        _Place(motion[:-1, :-1] @ place.origin + motion[:-1, -1], place.points @ motion[:-1, :-1].T)
        for place, motion in zip(places, motions, strict=True)
    ]


def _shifted(pose: Tensor, shift: Tensor) -> Tensor:
    """The pose (D+1, D+1) after a shift (D,) of its own frame."""
    moved = pose.clone()
    moved[:-1, -1] += pose[:-1, :-1] @ shift.to(pose)
    return moved


def _agree(transform: Tensor, estimate: _Estimate) -> bool:
    """Whether a transform puts the estimate's scan where the estimate does."""
    apart = transform - estimate.transform
    shift = apart[:-1, :-1] @ estimate.place.origin + apart[:-1, -1]
    turn = torch.linalg.matrix_norm(apart[:-1, :-1]) / math.sqrt(2)
    return bool(shift.norm() < _AGREE[0]) and bool(turn < _AGREE[1])

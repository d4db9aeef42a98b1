"""Odometry: the poses of a moving sensor, or of a recording that states none, from its scans alone."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike, as_tensor
from gmmtorch.datasets import POINT_TIMES, Dataset, Reposed, deskewed, with_poses
from gmmtorch.errors import DataError, InvalidArgumentError, check_choice, check_number, check_whole
from gmmtorch.localization.local_map import LOST, Keyframe, LocalMap, nowhere
from gmmtorch.localization.location import Location, continued, measured_motion
from gmmtorch.localization.loop_closure import ANYWHERE, Doubts, LoopCloser, closed, information_of, joined
from gmmtorch.localization.pose_graph import Edges, optimised
from gmmtorch.localization.pose_search import Expectation
from gmmtorch.mapping import WindowedRule
from gmmtorch.optional_packages import needs_extra
from gmmtorch.pose import Pose

METHODS = ("kiss_icp", "mixture")
MOTIONS = ("constant", "dataset", "imu")
_RULE = WindowedRule(window=1, noise=0.02, length=0.4, max_cells=5000)
_STORED = 4000  # points of a keyframe
_KEYFRAMES = 10  # in the local map,
_MANY_KEYFRAMES = 80  # or of a sensor that looks in one direction
_NARROW = 0.8  # length of the mean direction of its points; 0.64 for a half circle, 0.9 for a cone of 70°
_GIVEN_UP = 3  # lost scans in a row, after which the next one begins a new local map
_DOUBTED = 0.5  # probability of a pose, below which several scans are searched for together
_WEAK = 0.95  # probability of a pose, below which the scan is searched for again between its neighbours
_APART = "the sensor was lost before, and no place that it saw later is known from before"
_LONGEST_GAP = 2  # steps that a sensor may have moved since the last pose that was found, at most
_FEWEST = 10  # returns of a scan that can be located
_FIRST_STEP = 1.0, math.radians(30)  # standard deviations (m, rad) of the first motions
_SURPRISE = 0.3, math.radians(10)  # least standard deviations of a motion from the predicted one
_MEMORY = 0.7  # share of the past in the mean square of the surprise
_SKEW = 0.05  # metres of a point between two estimates of its skew, above which the scan is located again
_LONGEST_SWEEP = 1.0  # seconds between scans over which a velocity deskews points
_LONG_MEMORY = 0.9  # share of the past in the mean explained share


class Trajectory(NamedTuple):
    """Poses (N, D+1, D+1) of N scans, world ← sensor (the world is the frame of the first one); covariances
    (N, F, F) of a shift (m) and a turn (rad) in the frame of the sensor; whether each was found (N,); the
    number of loop closures that were used; and the reasons against each pose, empty if it was found.
    """

    poses: Tensor
    covariances: Tensor
    found: Tensor
    n_closures: int
    doubts: tuple[str, ...]


class Odometry:
    """Estimates the motion of a sensor, scan by scan, and closes loops.

    Usage::

        odometry = Odometry()
        for points in scans:  # (N, D) in the frame of the sensor
            location = odometry.add(points)
        poses = odometry.trajectory().poses

    The pose of a scan is the one that best explains its points by one mixture of the last keyframes and is
    not far from the prediction, which continues the last motion. In 2D the poses that the sensor can have
    reached are searched by branch and bound (`localization.pose_search`), and the mixture is climbed from the
    best ones. In 3D it is climbed from the best of a lattice of starts around the prediction, and from where
    the scan's own mixture is registered (`localization.registration`); if the points do not support the best
    pose, from a wider lattice and from other headings. `trajectory` finds the places that were seen twice and
    corrects all poses by a pose graph (`localization.pose_graph`). A scan that is not found never enters the
    local map. If the next one is found, it is searched for again. The fourth in a row begins a new map, whose
    poses are found if two closures that agree join it with the first. In 2D `trajectory` estimates doubtful
    motions and the poses of lost scans again, from several scans before and after them.

    Args:
        n_keyframes: in the local map. None: 10, or 80 for a sensor with a narrow field of view, such as a
            depth camera, by the directions of the first points. Along a wall, the poses of such a sensor
            drift if the local map has only what it saw last.
        distance, angle: a scan becomes a keyframe after this motion (m, rad).
        n_points: of a scan that are used at most, drawn with a fixed seed.
        least_explained: share of the points that must lie on surfaces of the local map.
        rule: how a scan becomes a mixture.
        max_step, max_turn: largest motion (m, rad) of the sensor between two scans. A pose that is farther
            from the last one and from the predicted one is not found.
    """

    def __init__(
        self,
        *,
        n_keyframes: int | None = None,
        distance: float = 0.3,
        angle: float = math.radians(10),
        n_points: int = 1000,
        least_explained: float = 0.5,
        rule: WindowedRule = _RULE,
        max_step: float = 8.0,
        max_turn: float = math.pi,
    ) -> None:
        self.n_keyframes = None if n_keyframes is None else check_whole("n_keyframes", n_keyframes, 1)
        self.n_points = check_whole("n_points", n_points, _FEWEST)
        check_number("distance", distance)
        check_number("angle", angle, math.pi)
        check_number("least_explained", least_explained, 1)
        check_number("max_step", max_step)
        check_number("max_turn", max_turn, math.pi)
        self.max_step, self.max_turn = max_step, max_turn
        self.distance, self.angle, self.least_explained, self.rule = distance, angle, least_explained, rule
        self.keyframes: list[Keyframe] = []
        self._local: LocalMap | None = None
        self._poses: list[Pose] = []
        self._locations: list[Location] = []
        self._frames: list[int] = []  # scans that are keyframes
        self._last_frame = self._last_found = 0
        self._lost: list[Keyframe] = []  # the last scans, if they were not found
        self._doubtful: list[int] = []  # keyframes whose motion from the one before may be wrong
        self._unplaced: dict[int, Tensor] = {}  # points of lost scans
        self._parts: list[int] = []  # keyframes that begin a map of their own, because the sensor was lost
        self._edges: list[tuple[int, Pose, Tensor]] = []  # from which scan, motion, information
        self._motion: Pose | None = None
        self._step: Pose | None = None  # the motion that deskews the newest scan
        self._surprise = _FIRST_STEP
        self._explained = 0.95  # share of the points: few places explain less
        self._stamp: float | None = None
        self._seconds: float | None = None
        self._loops = LoopCloser(least_explained, rule)

    def add(
        self,
        points: ArrayLike,
        stamp: float | None = None,
        motion: ArrayLike | None = None,
        seconds: ArrayLike | None = None,
    ) -> Location:
        """The pose of the next scan in the frame of the first one; if it is not `found`, the best guess.

        Args:
            points: (N, D) returns in the frame of the sensor, metres. Rows with NaN or infinite numbers are
                left out.
            stamp: time (s). The predicted motion is scaled by the time since the last scan, if both are
                known and the clock runs forward.
            motion: (D+1, D+1) of the sensor since the last scan, last ← now, such as that of wheels; or its
                rotation (D, D) alone, such as that of an IMU: the velocity in the frame of the sensor
                continues. None: the motion continues.
            seconds: (N,) after `stamp` at which each point was measured. The points are moved to where they
                would be seen at the stamp, by the predicted motion, and again by the estimated one if that
                moves one of them by more than 5 cm. None: all were measured at the stamp.

        Raises `InvalidArgumentError` for another shape or dimension, or for a motion that is not rigid.
        """
        rows, times = self._checked(points, seconds)
        dim = rows.shape[1]
        measured = None if motion is None else measured_motion(motion, dim, rows.device)
        # The points of a keyframe are in random order.
        drawn = torch.randperm(len(rows), generator=torch.Generator().manual_seed(0))[:_STORED]
        raw, times = Keyframe(rows[drawn], Pose.identity(dim)), None if times is None else times[drawn]
        ratio = self._clock(stamp)
        if not self._poses:
            location, scan = Location(torch.eye(dim + 1).double(), nowhere(dim) * 0, 1.0, ()), raw
        else:
            self._step = self._predicted(measured, ratio)[0]
            scan = self._deskewed(raw, times)
            location = self._located(scan, measured, ratio)
            if location.found:
                self._step = self._poses[-1].inverse() @ Pose.from_matrix(location.pose)
                better = self._deskewed(raw, times)
                moved = (better.points - scan.points).norm(dim=1)
                scan = better
                if bool((moved > _SKEW).any()):
                    location = self._located(scan, self._step, ratio)
                    self._step = self._poses[-1].inverse() @ Pose.from_matrix(location.pose)
        self._remember(scan, location)
        return location

    def deskewed(self, points: Tensor, seconds: Tensor) -> Tensor:
        """Points (N, D) of the newest scan, moved to where they would be seen at its stamp by the estimated
        motion since the scan before; unchanged if that or its time is not known. seconds: as for `add`.
        """
        if self._step is None or self._seconds is None or not 0 < self._seconds <= _LONGEST_SWEEP:
            return points
        return deskewed(points.double(), seconds.double(), self._step, self._seconds)

    @property
    def poses(self) -> Tensor:
        """Poses (N, D+1, D+1) of all scans so far, with the corrections of `close_loops`."""
        return Pose.stack(self._poses).matrix

    def close_loops(self) -> bool:
        """Searches for the newest scan in an older place, if it is a keyframe and there is one near; returns
        whether `poses` were corrected. For mapping while the sensor moves: call it after each `add`.

        Every third keyframe is searched for, in the nearest older place, which takes about as long as
        `add`. Two successive closures must agree. The first pose stays.
        """
        is_keyframe = bool(self._frames) and self._frames[-1] == len(self._poses) - 1
        if not is_keyframe or not self._loops.is_due(len(self._frames)):
            return False
        rows = torch.tensor(self._frames)
        chain = self._all_edges().at(rows[1:] - 1)
        row = torch.arange(len(chain.source))
        found = self._loops.corrected(self.keyframes, chain._replace(source=row, target=row + 1))
        if found is None:
            return False
        # Other scans hang on the last keyframe before them.
        before = Pose.stack(self._poses)
        motions = found @ before[rows].inverse()
        last = torch.searchsorted(rows, torch.arange(len(before)), right=True) - 1
        after = motions[last.clamp_min(0)] @ before
        self._poses = [after[number] for number in range(len(before))]
        self.keyframes = [frame._replace(pose=found[row]) for row, frame in enumerate(self.keyframes)]
        self._set_local_map(self.n_keyframes or 1)
        return True

    def trajectory(self, loops: bool = True) -> Trajectory:
        """The poses of all scans so far; with `loops`, corrected by loop closures."""
        if not self._poses:
            raise InvalidArgumentError("no scan was added, so there is no trajectory.")
        poses, edges = Pose.stack(self._poses), self._all_edges()
        found = torch.tensor([location.found for location in self._locations])
        if loops:
            places = list(zip(self._frames, self.keyframes, strict=True))
            parts = self._parts_of_keyframes()
            limits = self.max_step, self.least_explained, self.rule
            poses, edges, again = closed(poses, edges, places, parts, self._doubts(), *limits)
            found[sorted(again)] = True
        best = optimised(poses, edges)
        used = edges.is_closure & (best.weights > 0.5)
        doubts = tuple("" if good else "; ".join(location.doubts)
                       for good, location in zip(found.tolist(), self._locations, strict=True))  # fmt: skip
        is_apart = self._is_apart(edges.at(used))
        doubts = tuple(f"{doubt}; {_APART}" if apart and doubt else _APART if apart else doubt
                       for doubt, apart in zip(doubts, is_apart.tolist(), strict=True))  # fmt: skip
        best = best._replace(poses=_bridged(best.poses, found))
        found &= ~is_apart
        return Trajectory(best.poses.matrix, best.covariances, found, int(used.sum()), doubts)

    def _checked(self, points: ArrayLike, seconds: ArrayLike | None) -> tuple[Tensor, Tensor | None]:
        rows = as_tensor(points, "points", torch.float64).detach().cpu()
        dims = (2, 3) if not self._poses else (self._poses[0].dim,)
        if rows.ndim != 2 or rows.shape[1] not in dims:
            wanted = " or ".join(f"(N, {dim})" for dim in dims)
            raise InvalidArgumentError(f"points has shape {tuple(rows.shape)}; expected {wanted}, metres.")
        finite = torch.isfinite(rows).all(1)
        if seconds is None:
            return rows[finite], None
        times = as_tensor(seconds, "seconds", torch.float64).detach().cpu()
        if times.shape != rows.shape[:1]:
            raise InvalidArgumentError(
                f"seconds has shape {tuple(times.shape)}; expected ({len(rows)},), one for each point."
            )
        finite &= torch.isfinite(times)
        return rows[finite], times[finite]

    def _deskewed(self, scan: Keyframe, seconds: Tensor | None) -> Keyframe:
        return scan if seconds is None else scan._replace(points=self.deskewed(scan.points, seconds))

    def _clock(self, stamp: float | None) -> float:
        """How many times longer than the last motion this one takes; 1 if the clocks do not say."""
        if stamp is None or not math.isfinite(stamp) or self._stamp is None:
            self._stamp = stamp if stamp is not None and math.isfinite(stamp) else None
            return 1.0
        now, before = stamp - self._stamp, self._seconds
        self._stamp, self._seconds = stamp, now
        if before is None or not before > 0 or not 0 < now <= 5 * before:
            return 1.0
        return now / before

    def _located(self, scan: Keyframe, measured: Pose | Tensor | None, ratio: float) -> Location:
        last = self._poses[self._last_found]
        step, rest = self._predicted(measured, ratio)
        guess = self._poses[-1] @ step  # of a scan that was lost, too
        reach = self.max_step * min(len(self._lost) + 1, _LONGEST_GAP)
        expected = Expectation(
            Pose.stack([guess, last @ rest]), *self._surprise, self._explained, reach, self.max_turn
        )
        is_empty = len(scan.points) < _FEWEST
        if is_empty or self._local is None:
            doubt = "the scan has too few points" if is_empty else "no scan before had points"
            return Location(guess.matrix, nowhere(last.dim), 0.0, (doubt,))
        location = self._local.locate(scan, expected, wide=not self._lost)
        self._note_surprise(location, expected)
        return location

    def _predicted(self, measured: Pose | Tensor | None, ratio: float) -> tuple[Pose, Pose]:
        """The motion since the last scan, and that of a sensor that stopped."""
        rest = Pose.identity(self._poses[-1].dim)
        if isinstance(measured, Tensor):
            return continued(measured, self._motion, ratio), continued(measured, None)
        if measured is not None:
            return measured, rest
        if self._motion is None or ratio == 1.0:
            return self._motion or rest, rest
        return rest.towards(self._motion, ratio), rest

    def _note_surprise(self, location: Location, expected: Expectation) -> None:
        off = expected.poses[0].inverse() @ Pose.from_matrix(location.pose)
        seen = float(off.translation.norm()), float(off.chord())
        if location.found:
            self._explained = _LONG_MEMORY * self._explained + (1 - _LONG_MEMORY) * location.explained
        else:
            seen = max(seen[0], LOST[0]), max(seen[1], LOST[1])
        means = [
            math.sqrt(_MEMORY * before**2 + (1 - _MEMORY) * now**2)
            for before, now in zip(self._surprise, seen, strict=True)
        ]
        self._surprise = max(_SURPRISE[0], means[0]), max(_SURPRISE[1], means[1])

    def _remember(self, scan: Keyframe, location: Location) -> None:
        number, pose = len(self._poses), Pose.from_matrix(location.pose)
        if number:
            # The surfaces are those of the keyframes, so the edge begins at the last one.
            since = self._poses[self._last_frame].inverse() @ pose
            self._edges.append((self._last_frame, since, information_of(location)))
            if location.found:
                self._motion = self._poses[-1].inverse() @ pose if not self._lost else None
                self._last_found = number
            elif len(self._lost) >= _GIVEN_UP:
                self._motion = None  # a sensor that is covered for long may have stopped
        self._poses.append(pose)
        self._locations.append(location)
        lost = self._lost
        if location.found:
            self._lost = []
        else:
            lost.append(scan)
            if pose.dim == 2 and len(scan.points) >= _FEWEST:
                self._unplaced[number] = scan.points
        begins = self._local is None or len(self._lost) > _GIVEN_UP
        is_new = begins or (location.found and self._is_new(pose))
        if is_new and len(scan.points) >= _FEWEST:
            if begins:
                if self._edges:  # a closure decides where the new map is, not the guess
                    anywhere = replace(location, covariance=nowhere(pose.dim, *ANYWHERE))
                    self._edges[-1] = (*self._edges[-1][:2], information_of(anywhere))
                self._parts.append(len(self.keyframes))
                self._lost, self._last_found = [], number
            is_sure = location.found and location.probability >= _DOUBTED and not lost
            if self.keyframes and not is_sure:
                self._doubtful.append(len(self.keyframes))
            self._last_frame = number
            self._frames.append(number)
            self.keyframes.append(scan._replace(pose=pose))
            if self.n_keyframes is None:
                directions = torch.nn.functional.normalize(scan.points, dim=1)
                is_narrow = float(directions.mean(0).norm()) > _NARROW
                self.n_keyframes = _MANY_KEYFRAMES if is_narrow else _KEYFRAMES
            self._set_local_map(self.n_keyframes)
        if location.found and len(lost) == 1:
            self._search_again(lost[0])

    def _search_again(self, scan: Keyframe) -> None:
        """The last scan but one, which was lost, between the poses on both sides of it. Of several lost scans
        in a row none is searched for: the pose that ends them is less sure.
        """
        if self._local is None or len(scan.points) < _FEWEST:
            return
        number, last = len(self._poses) - 2, self._last_frame
        before, after = self._poses[number - 1], self._poses[-1]
        way, limits = Pose.stack([before.towards(after, 0.5), before]), (self.max_step, self.max_turn)
        location = self._local.locate(scan, Expectation(way, *self._surprise, self._explained, *limits))
        if location.found:
            pose = Pose.from_matrix(location.pose)
            self._edges[number - 1] = (last, self._poses[last].inverse() @ pose, information_of(location))
            self._poses[number], self._locations[number] = pose, location

    def _set_local_map(self, n: int) -> None:
        """Of the last n keyframes at most, and not of those before the sensor was lost."""
        recent = self.keyframes[max(self._parts[-1], len(self.keyframes) - n) :]
        self._local = LocalMap(recent, self.least_explained, self.rule, self.n_points)

    def _is_new(self, pose: Pose) -> bool:
        """Whether the sensor has moved or turned enough since the last keyframe."""
        if not self.keyframes:
            return True
        off = self.keyframes[-1].pose.inverse() @ pose
        return bool(off.translation.norm() >= self.distance) or bool(off.chord() >= self.angle)

    def _is_apart(self, closures: Edges) -> Tensor:
        """Whether the map of each scan (N,) is not joined with the first one by closures, directly or not."""
        if not self._frames:
            return torch.zeros(len(self._poses)).bool()
        rows = torch.tensor(self._frames)
        group = joined(self._parts_of_keyframes(), closures, self._frames)
        last = torch.searchsorted(rows, torch.arange(len(self._poses)), right=True) - 1
        return (group != group[0])[last.clamp_min(0)]

    def _parts_of_keyframes(self) -> Tensor:
        """The number (K,), from 1, of the map that each keyframe belongs to."""
        return torch.bucketize(torch.arange(len(self._frames)), torch.tensor(self._parts), right=True)

    def _doubts(self) -> Doubts:
        if self._poses[0].dim == 3:
            return Doubts([], [], {})
        weak = [row for row, number in enumerate(self._frames)
                if self._locations[number].probability < _WEAK]  # fmt: skip
        return Doubts(self._doubtful, weak, self._unplaced)

    def _all_edges(self) -> Edges:
        target = torch.arange(1, len(self._poses))
        none = torch.zeros_like(target).bool()
        if not self._edges:
            dim = self._poses[0].dim
            free = dim * (dim + 1) // 2
            return Edges(target, target, Pose.identity(dim, 0), torch.zeros(0, free, free).double(), none)
        source, motions, information = zip(*self._edges, strict=True)
        return Edges(torch.tensor(source), target, Pose.stack(motions), torch.stack(information), none)


def _bridged(poses: Pose, found: Tensor) -> Pose:
    """The poses (N), with lost ones on the way from the last found pose to the next one."""
    number, good = torch.arange(len(poses)), found.nonzero()[:, 0]
    after = torch.searchsorted(good, number).clamp_max(len(good) - 1)
    before = (torch.searchsorted(good, number, right=True) - 1).clamp_min(0)
    first, last = good[before], good[after]
    share = ((number - first) / (last - first).clamp_min(1)).clamp(0, 1).double()
    way = poses[first].towards(poses[last], share)
    is_between = ~found & (first < number) & (number < last)
    shift = torch.where(is_between[:, None], way.translation, poses.translation)
    return Pose(torch.where(is_between[:, None, None], way.rotation, poses.rotation), shift)


class PosedRecording(NamedTuple):
    """The scans with the estimated poses, and the trajectory of all scans."""

    dataset: Reposed
    trajectory: Trajectory


def with_odometry(
    source: Dataset,
    method: str = "mixture",
    on_scan: Callable[[int, int], None] = lambda done, total: None,
    motion: str = "constant",
) -> PosedRecording:
    """A data set whose poses are estimated from its scans. The frame of the first usable scan is the world.

    Args:
        source: its own poses move the points into the frame of the sensor, and are not used otherwise.
        method: mixture, `Odometry`; or kiss_icp, the package of Vizzo et al. (2023), without loop
            closures and without covariances (NaN).
        on_scan: called with the number of scans done and of all.
        motion: prediction of each pose. constant: the motion continues; dataset: as between the poses of the
            data set, such as those of wheel odometry; imu: with the rotation of a bag's IMU, while the
            velocity continues. The last two are for mixture only.

    Raises `InvalidArgumentError` for another method or motion or without a usable IMU, `DataError` if no scan
    can be read.
    """
    check_choice("odometry", method, METHODS)
    check_choice("motion", motion, MOTIONS)
    if motion != "constant" and method != "mixture":
        raise InvalidArgumentError(
            f"motion={motion} does not go with odometry={method}; use odometry=mixture."
        )
    source.check_one_sensor(f"odometry={method}")
    turns = source.turns() if motion == "imu" else None
    odometry = odometry_of(method)
    known = torch.zeros(len(source), dtype=torch.bool)
    times = source.times
    before: int | None = None
    source.keeps_point_times = True
    for index in range(len(source)):
        points, seconds = _sensor_points(source, index)
        if points is not None:
            predicted = None
            if before is not None and motion != "constant":
                predicted = _motion(source, turns, before, index)
            odometry.add(points, None if times is None else float(times[index]), predicted, seconds)
            known[index], before = True, index
        on_scan(index + 1, len(source))
    if not known.any():
        raise DataError(f"{source.name}: no scan of {len(source)} can be read, so none has a pose.")
    trajectory: Trajectory = odometry.trajectory()
    poses = torch.eye(trajectory.poses.shape[1]).double().repeat(len(source), 1, 1)
    poses[known] = trajectory.poses
    return PosedRecording(with_poses(source, poses, known), trajectory)


def _motion(source: Dataset, turns: Tensor | None, before: int, now: int) -> Tensor | None:
    """The motion of the sensor between two scans, by the poses of the data set, or its rotation by `turns`
    (N, D, D) since the scan before; None if it is unknown."""
    if turns is not None:
        turn = functools.reduce(torch.matmul, turns[before + 1 : now + 1])
        return turn if bool(turn.isfinite().all()) else None
    first, last = source.pose(before), source.pose(now)
    if first is None or last is None:
        return None
    return (Pose.from_matrix(first).inverse() @ Pose.from_matrix(last)).matrix


def _sensor_points(source: Dataset, index: int) -> tuple[Tensor | None, Tensor | None]:
    """Returns (N, D) of a scan in the frame of the sensor, and when they were measured (N,), if that is known
    and they are not deskewed; None if it cannot be read."""
    try:
        scan, pose = source[index], source.pose(index)
    except DataError:
        return None, None  # the reader counts it in `skipped`
    if pose is None:
        raise DataError(
            f"{source.name} does not state the poses in which its points are, so they cannot be moved into "
            "the frame of the sensor."
        )
    seconds = scan.attributes.get(POINT_TIMES)
    points = Pose.from_matrix(pose).inverse().apply(scan.points.double())
    return points, None if seconds is None else seconds[:, 0]


def odometry_of(method: str) -> Odometry | KissIcp:
    """Odometry by a method, mixture or kiss_icp, without a scan yet."""
    check_choice("odometry", method, METHODS)
    return Odometry() if method == "mixture" else KissIcp()


class KissIcp:
    """KISS-ICP behind the methods of `Odometry`. Scans in 2D lie at z = 0."""

    def __init__(self) -> None:
        with needs_extra("Odometry by kiss_icp needs", "kiss-icp", "odometry"):
            from kiss_icp.config import KISSConfig
            from kiss_icp.kiss_icp import KissICP
        config = KISSConfig()
        config.data.deskew = False  # the readers have deskewed the points
        config.mapping.voxel_size = config.data.max_range / 100  # its own default
        self._icp = KissICP(config)
        self._locations: list[Location] = []

    def add(self, points: Tensor, *unused: object, seconds: object = None) -> Location:
        """The pose of the next scan in the frame of the first one, without a covariance (NaN).

        The other arguments of `Odometry.add` are not used.
        """
        dim = points.shape[1]
        rows = torch.nn.functional.pad(points, (0, 3 - dim))
        if len(rows):
            self._icp.register_frame(rows.numpy(), rows.new_zeros(0).numpy())
        pose = Pose.from_matrix(self._icp.last_pose.copy())
        pose = pose if dim == 3 else pose.in_plane()
        free = dim * (dim + 1) // 2
        unknown = torch.full((free, free), torch.nan, dtype=torch.float64)
        self._locations.append(Location(pose.matrix, unknown, 1.0, ()))
        return self._locations[-1]

    def trajectory(self) -> Trajectory:
        """The poses of all scans so far."""
        poses = torch.stack([location.pose for location in self._locations])
        covariances = torch.stack([location.covariance for location in self._locations])
        found = torch.ones(len(poses), dtype=torch.bool)
        return Trajectory(poses, covariances, found, 0, ("",) * len(poses))

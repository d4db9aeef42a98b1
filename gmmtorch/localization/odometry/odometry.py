"""Odometry: the poses of a moving sensor from its scans alone."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike, as_tensor
from gmmtorch.errors import InvalidArgumentError, check_number, check_whole
from gmmtorch.localization.location import Location
from gmmtorch.localization.odometry.local_map import LOST, Expectation, Keyframe, LocalMap, nowhere
from gmmtorch.localization.odometry.loop_closure import LoopCloser, closed, information_of
from gmmtorch.localization.odometry.pose_graph import Edges, optimised
from gmmtorch.localization.rigid_motions import continued, measured_motion
from gmmtorch.mapping import Components, WindowedRule, learn_window
from gmmtorch.scan import Scan

_RULE = WindowedRule(window=1, noise=0.02, length=0.4, max_cells=5000)
_STORED = 4000  # points of a keyframe
_KEYFRAMES = 10  # in the local map,
_MANY_KEYFRAMES = 80  # or of a sensor that looks in one direction
_NARROW = 0.8  # length of the mean direction of its points; 0.64 for a half circle, 0.9 for a cone of 70°
_GIVEN_UP = 3  # lost scans in a row, after which the next one begins a new local map
_FEWEST = 10  # returns of a scan that can be located
_FIRST_STEP = 1.0, math.radians(30)  # standard deviations (m, rad) of the first motions
_SURPRISE = 0.3, math.radians(10)  # least standard deviations of a motion from the predicted one
_MEMORY = 0.7  # share of the past in the mean surprise
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
    not far from the prediction. The search climbs from the best of a lattice of starts and, in 3D,
    from where the mixture of the scan is registered. The prediction continues the last motion. `trajectory`
    finds the places that were seen twice and corrects all poses by a pose graph
    (`localization.odometry.pose_graph`).

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
        max_step: float = 4.0,
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
        self._poses: list[Tensor] = []
        self._locations: list[Location] = []
        self._frames: list[int] = []  # scans that are keyframes
        self._last_frame = 0
        self._n_lost = 0
        self._edges: list[tuple[int, Tensor, Tensor]] = []  # from which scan, motion, information
        self._motion: Tensor | None = None
        self._surprise = _FIRST_STEP
        self._explained = 0.95  # share of the points: few places explain less
        self._stamp: float | None = None
        self._seconds: float | None = None
        self._loops = LoopCloser(least_explained, rule)

    def add(self, points: ArrayLike, stamp: float | None = None, motion: ArrayLike | None = None) -> Location:
        """The pose of the next scan in the frame of the first one; if it is not `found`, the best guess.

        Args:
            points: (N, D) returns in the frame of the sensor, metres. Rows with NaN or infinite numbers are
                left out.
            stamp: time (s). The predicted motion is scaled by the time since the last scan, if both are
                known and the clock runs forward.
            motion: (D+1, D+1) of the sensor since the last scan, last ← now, such as that of wheels; or its
                rotation (D, D) alone, such as that of an IMU: the velocity in the frame of the sensor
                continues. None: the motion continues.

        Raises `InvalidArgumentError` for another shape or dimension, or for a motion that is not rigid.
        """
        rows = self._checked(points)
        dim = rows.shape[1]
        measured = None if motion is None else measured_motion(motion, dim, rows.device)
        scan = self._scan(rows)
        ratio = self._clock(stamp)
        if not self._poses:
            location = Location(torch.eye(dim + 1).double(), nowhere(dim) * 0, 1.0, ())
        else:
            location = self._located(scan, measured, ratio)
        self._remember(scan, location)
        return location

    @property
    def poses(self) -> Tensor:
        """Poses (N, D+1, D+1) of all scans so far, with the corrections of `close_loops`."""
        return torch.stack(self._poses)

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
        motions = found @ torch.linalg.inv(self.poses[rows])
        last = torch.searchsorted(rows, torch.arange(len(self._poses)), right=True) - 1
        self._poses = list((motions[last.clamp_min(0)] @ self.poses).unbind(0))
        self.keyframes = [
            frame._replace(pose=pose) for frame, pose in zip(self.keyframes, found, strict=True)
        ]
        recent = self.keyframes[-(self.n_keyframes or 1) :]
        self._local = LocalMap(recent, self.least_explained, self.rule, self.n_points)
        return True

    def trajectory(self, loops: bool = True) -> Trajectory:
        """The poses of all scans so far; with `loops`, corrected by loop closures."""
        if not self._poses:
            raise InvalidArgumentError("no scan was added, so there is no trajectory.")
        poses, edges = torch.stack(self._poses), self._all_edges()
        found = torch.tensor([location.found for location in self._locations])
        if loops:
            places = list(zip(self._frames, self.keyframes, strict=True))
            edges = closed(poses, edges, places, self.least_explained, self.rule)
        best = optimised(poses, edges)
        used = edges.is_closure & (best.weights > 0.5)
        doubts = tuple("; ".join(location.doubts) for location in self._locations)
        return Trajectory(best.poses, best.covariances, found, int(used.sum()), doubts)

    # -- one scan -------------------------------------------------------------------------------------

    def _checked(self, points: ArrayLike) -> Tensor:
        rows = as_tensor(points, "points", torch.float64).detach().cpu()
        dims = (2, 3) if not self._poses else (len(self._poses[0]) - 1,)
        if rows.ndim != 2 or rows.shape[1] not in dims:
            wanted = " or ".join(f"(N, {dim})" for dim in dims)
            raise InvalidArgumentError(f"points has shape {tuple(rows.shape)}; expected {wanted}, metres.")
        return rows[torch.isfinite(rows).all(1)]

    def _scan(self, rows: Tensor) -> Keyframe:
        dim = rows.shape[1]
        draw = torch.Generator().manual_seed(0)
        chosen = rows[torch.randperm(len(rows), generator=draw)[:_STORED]]
        mixture = Components.empty(dim)
        if len(rows) >= _FEWEST:
            seen = Scan(rows, rows.new_zeros(dim))
            mixture = learn_window([seen], self.rule, torch.Generator().manual_seed(0))
        return Keyframe(chosen, mixture, torch.eye(dim + 1).double())

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

    def _located(self, scan: Keyframe, measured: Tensor | None, ratio: float) -> Location:
        last = self._poses[-1]
        dim = len(last) - 1
        step = rest = torch.eye(dim + 1).double()
        if measured is not None and len(measured) == dim:
            step, rest = continued(measured, self._motion, ratio), continued(measured, None)
        elif measured is not None:
            step = measured
        elif self._motion is not None:
            step = _scaled(self._motion, ratio)
        poses, bounds = torch.stack([last @ step, last @ rest]), (self.max_step, self.max_turn)
        expected = Expectation(poses, *self._surprise, self._explained, *bounds)
        if not len(scan.mixture) or self._local is None:
            doubt = "the scan has too few points" if not len(scan.mixture) else "no scan before had points"
            return Location(expected.poses[0], nowhere(dim), 0.0, (doubt,))
        location = self._local.locate(scan, expected)
        self._note_surprise(location, expected)
        return location

    def _note_surprise(self, location: Location, expected: Expectation) -> None:
        off = torch.linalg.solve(expected.poses[0], location.pose)
        turn = torch.linalg.matrix_norm(off[:-1, :-1] - torch.eye(len(off) - 1)) / math.sqrt(2)
        seen = float(off[:-1, -1].norm()), float(turn)
        if location.found:
            self._explained = _LONG_MEMORY * self._explained + (1 - _LONG_MEMORY) * location.explained
        else:
            seen = max(seen[0], LOST[0]), max(seen[1], LOST[1])
        self._surprise = (
            max(_SURPRISE[0], _mean(self._surprise[0], seen[0])),
            max(_SURPRISE[1], _mean(self._surprise[1], seen[1])),
        )

    def _remember(self, scan: Keyframe, location: Location) -> None:
        number = len(self._poses)
        if number:
            # The surfaces are those of the keyframes, so the edge begins at the last one.
            since = torch.linalg.solve(self._poses[self._last_frame], location.pose)
            self._edges.append((self._last_frame, since, information_of(location)))
            if location.found:
                self._motion = torch.linalg.solve(self._poses[-1], location.pose)
            elif self._n_lost >= _GIVEN_UP:
                self._motion = None  # a sensor that is covered for long may have stopped
        self._poses.append(location.pose)
        self._locations.append(location)
        self._n_lost = 0 if location.found else self._n_lost + 1
        is_sure = location.found or self._local is None or self._n_lost > _GIVEN_UP
        if is_sure and len(scan.mixture) and self._is_new(location.pose, len(location.pose) - 1):
            self._last_frame = number
            self._frames.append(number)
            self.keyframes.append(scan._replace(pose=location.pose))
            if self.n_keyframes is None:
                directions = torch.nn.functional.normalize(scan.points, dim=1)
                is_narrow = float(directions.mean(0).norm()) > _NARROW
                self.n_keyframes = _MANY_KEYFRAMES if is_narrow else _KEYFRAMES
            recent = self.keyframes[-self.n_keyframes :]
            self._local = LocalMap(recent, self.least_explained, self.rule, self.n_points)

    def _is_new(self, pose: Tensor, dim: int) -> bool:
        """Whether the sensor has moved or turned enough since the last keyframe."""
        if not self.keyframes:
            return True
        off = torch.linalg.solve(self.keyframes[-1].pose, pose)
        turn = torch.linalg.matrix_norm(off[:dim, :dim] - torch.eye(dim)) / math.sqrt(2)
        return bool(off[:dim, dim].norm() >= self.distance) or bool(turn >= self.angle)

    def _all_edges(self) -> Edges:
        size = len(self._poses[0])
        free = (size - 1) * size // 2
        if not self._edges:
            none = torch.zeros(0, dtype=torch.int64)
            return Edges(
                none,
                none,
                torch.zeros(0, size, size).double(),
                torch.zeros(0, free, free).double(),
                none.bool(),
            )
        source, motions, information = zip(*self._edges, strict=True)
        target = torch.arange(1, len(self._poses))
        none = torch.zeros_like(target).bool()
        return Edges(torch.tensor(source), target, torch.stack(motions), torch.stack(information), none)


def _mean(before: float, now: float) -> float:
    """Of squares, weighted by `_MEMORY`."""
    return math.sqrt(_MEMORY * before**2 + (1 - _MEMORY) * now**2)


def _scaled(motion: Tensor, ratio: float) -> Tensor:
    """The motion that takes `ratio` times as long."""
    if ratio == 1.0:
        return motion
    dim = len(motion) - 1
    half = torch.eye(dim + 1).double()
    half[:dim, dim] = ratio * motion[:dim, dim]
    if dim == 2:
        angle = ratio * torch.atan2(motion[1, 0], motion[0, 0])
        half[0, 0] = half[1, 1] = angle.cos()
        half[1, 0], half[0, 1] = angle.sin(), -angle.sin()
        return half
    from scipy.spatial.transform import Rotation

    spin = Rotation.from_matrix(motion[:3, :3].numpy()).as_rotvec()
    half[:3, :3] = torch.from_numpy(Rotation.from_rotvec(ratio * spin).as_matrix())
    return half

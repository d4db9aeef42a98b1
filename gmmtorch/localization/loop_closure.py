"""Loop closures: pairs of keyframes that saw one place at different times, with the motion between them.

`closed` finds those of a complete trajectory, `LoopCloser` those of a sensor that moves on.
"""

from __future__ import annotations

import bisect
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from gmmtorch.localization.alignment import chosen_rows
from gmmtorch.localization.local_map import Keyframe, LocalMap, nowhere
from gmmtorch.localization.location import Location
from gmmtorch.localization.pose_graph import Edges, optimised
from gmmtorch.localization.pose_search import Expectation
from gmmtorch.mapping import WindowedRule
from gmmtorch.pose import Pose

_ROUNDS = 3  # of closing and correcting: corrected poses bring more places together
_APART = 15  # keyframes between two visits of a place
_REACH = 3.0  # metres between the places of a closure, and
_DRIFT = 0.02  # metres for each metre of path between both, up to
_FARTHEST = 10.0  # metres
_FROM_LOST = 20.0  # metres between places of different parts, whose relative poses are a guess
ANYWHERE = 100.0, math.pi  # deviations (m, rad) of a map that begins, from the one before
_FEWEST = 3  # scans before and after a doubtful motion, at least, and
_TOGETHER = 6  # keyframes after a doubtful motion that are placed together
_DETOUR = 2.0, math.radians(60)  # metres and radians of a way over a pose, more than without it
_LEAST_CLOSURES = 2  # that join two maps: one alone may be wrong
_NEIGHBOURS = 3  # keyframes before and after an old one, in the map of its place
_SPACING = 3  # every third keyframe looks for closures
_MOST_EXPLAINED = 0.8  # share of the points that a closure explains at least
_SYSTEMATIC = {  # deviations (m, rad) of errors that the points do not show, such as thick surfaces
    2: torch.tensor([0.01, 0.01, 0.002]).double(),
    3: torch.tensor([0.01, 0.01, 0.01, 0.001, 0.001, 0.001]).double(),
}
_ANGLE = math.radians(10)  # of the heading of a closure
_AGREE = 0.3, math.radians(3)  # metres and radians: two closures agree
_ELSEWHERE = 0.3, 0.3  # metres and radians: two poses are different places
_NOTICED = 0.03, math.radians(0.3)  # metres and radians: a closure changes the poses


class _Closure(NamedTuple):
    """Numbers of two poses, the motion source ← target between them, and its information."""

    source: int
    target: int
    motion: Pose
    information: Tensor


class Doubts(NamedTuple):
    """What may be wrong in a trajectory in 2D: rows of keyframes whose motion from the one before may be, in
    order; rows of those whose own pose may be; and points of scans that were lost, by number."""

    motions: Sequence[int]
    keyframes: Sequence[int]
    lost: Mapping[int, Tensor]


def closed(
    poses: Pose,
    edges: Edges,
    places: Sequence[tuple[int, Keyframe]],
    parts: Tensor,
    doubts: Doubts,
    max_step: float,
    least_explained: float,
    rule: WindowedRule,
) -> tuple[Pose, Edges, set[int]]:
    """Poses near those that agree best; the edges of a pose graph, with those of the loop closures that can
    be found; and the numbers of doubtful scans that were found again.

    Args:
        poses: (N), world ← sensor. edges: of odometry.
        places: number of the pose, and keyframe, in order. parts: (K,), of the keyframes; between two parts
            the sensor was lost, and the poses of one relative to the other are a guess.
        max_step: metres between two scans.
    """
    tried: set[tuple[int, int]] = set()
    revision = _Revision(poses, edges, places, parts, doubts.lost, max_step, least_explained, rule)
    revision.examine(doubts.motions)
    numbers = torch.tensor([number for number, _ in places], dtype=torch.int64)
    begins = numbers[1:][parts[1:] != parts[:-1]]
    for _ in range(_ROUNDS):
        poses = revision.poses
        pairs = [pair for pair in _candidates(poses.translation[numbers], parts=parts) if pair not in tried]
        found = [
            edge
            for old, new in pairs
            if (edge := _closure(poses, places, old, new, least_explained, rule, parts))
        ]
        tried.update(pairs)
        revision.add(found, begins)
        if not found:
            break
    found_again = revision.place(doubts) if poses.dim == 2 else set[int]()
    return revision.poses, revision.edges, found_again


class _Revision:
    """A trajectory in 2D, whose doubtful motions and poses are estimated again from several scans.

    A motion is replaced if the keyframes after it, together, lie elsewhere in the map of those before it, and
    this is likelier by far than all other poses. A pose is replaced, in the same way, by that in the map of
    the keyframes on both sides.
    """

    def __init__(
        self,
        poses: Pose,
        edges: Edges,
        places: Sequence[tuple[int, Keyframe]],
        parts: Tensor,
        lost: Mapping[int, Tensor],
        max_step: float,
        least_explained: float,
        rule: WindowedRule,
    ) -> None:
        self.poses, self.edges, self.closures = poses, edges, list[_Closure]()
        self._numbers, self._parts, self._max_step = [number for number, _ in places], parts, max_step
        self._points = dict(lost) | {number: frame.points for number, frame in places}
        self._least_explained, self._rule = least_explained, rule

    def examine(self, doubtful: Sequence[int]) -> None:
        """Moves the keyframes from each of these rows on to where the map of those before surely has them."""
        groups: list[list[int]] = []
        for first, end in itertools.pairwise([0, *doubtful, len(self._numbers)]):
            groups.append(self._numbers[first:end])
            while len(groups) > 1:
                below = next((one for one in (2, 3) if self._join(groups[-one:])), None)
                if below is None:
                    break
                groups[-below:] = [groups[-below] + groups[-1]]

    def add(self, closures: Sequence[_Closure], begins: Tensor) -> None:
        """Corrects the poses by closures. begins: as for `_put_together`."""
        if closures:
            self.closures += closures
            self.edges = self.edges.joined(_edges(closures))
            poses = _put_together(self.poses, self.closures, begins)
            self.poses = optimised(poses, self.edges, with_covariances=False).poses

    def _join(self, groups: Sequence[Sequence[int]]) -> bool:
        """Moves the last group to where its first scans lie in the map of the first group's last ones, if
        that is sure; returns whether it is."""
        old, new = groups[0][-2 * _NEIGHBOURS - 1 :], groups[-1][:_TOGETHER]
        if min(len(old), len(new)) < _FEWEST:
            return False
        reach = self._max_step * min(new[0] - old[-1], 2)
        scans = [self._frame(one) for one in new]
        locations, is_sure = self._local(old).placed(scans, self.poses[[old[-1]]], reach)
        pose, before = Pose.from_matrix(locations[0].pose), self.poses[new[0]]
        row = self._numbers.index(new[0])
        is_elsewhere = _is_beyond(before.inverse() @ pose, _ELSEWHERE)
        if is_sure and (is_elsewhere or self._parts[row] != self._parts[row - 1]):
            moved = pose @ before.inverse() @ self.poses[new[0] :]
            self.poses = Pose.cat([self.poses[: new[0]], moved])
            self._replace(old[-1], new[0], locations)
        return is_sure

    def place(self, doubts: Doubts) -> set[int]:
        """Places lost scans and doubtful keyframes in the map of the keyframes on both sides of each; returns
        the numbers of those that lie there for sure."""
        numbers, found = self._numbers, set[int]()
        if not numbers:
            return found
        at = self.poses[numbers]
        detours = {row for row in range(1, len(at) - 1) if _is_detour(at[row - 1 : row + 2])}
        doubtful = detours | set(doubts.keyframes) - {0}
        group = joined(self._parts, self.edges, numbers)
        for number in sorted({*doubts.lost, *(numbers[row] for row in doubtful)}):
            row = bisect.bisect_left(numbers, number)
            if row == 0:
                continue
            scan, last = self._frame(number), numbers[row - 1]
            around = range(max(row - _NEIGHBOURS, 0), min(row + _NEIGHBOURS + 1, len(numbers)))
            mates = [numbers[one] for one in around if group[one] == group[row - 1]]
            near = [one for one in mates if one != number]
            if len(near) < 2:
                continue
            (location,), is_sure = self._local(near).placed([scan], self.poses[[last]], 2 * self._max_step)
            if not is_sure or not location.found:
                continue
            found.add(number)
            pose = Pose.from_matrix(location.pose)
            if number in doubts.lost or _is_beyond(scan.pose.inverse() @ pose, _ELSEWHERE):
                self._set(number, last, pose, information_of(location))
        return found

    def _set(self, number: int, last: int, pose: Pose, information: Tensor) -> None:
        """Replaces the pose of a scan by that relative to another one, on which all that hung on it hangs."""
        source, target, motions, every, is_closure = self.edges
        kept = ~(is_closure & ((source == number) | (target == number)))
        moved = (source == number) & ~is_closure
        source, every = torch.where(moved, last, source), every.clone()
        before = self.poses[last].inverse()
        motions = Pose(*chosen_rows(moved, (before @ self.poses[target]).parts, motions.parts))
        motion = before @ pose
        source[number - 1], every[number - 1] = last, information
        motions.rotation[number - 1], motions.translation[number - 1] = motion.rotation, motion.translation
        self.edges = Edges(source, target, motions, every, is_closure).at(kept)
        self.poses.rotation[number], self.poses.translation[number] = pose.rotation, pose.translation

    def _replace(self, last: int, first: int, locations: Sequence[Location]) -> None:
        """Makes the edge to a scan loose; a closure as exact as the best location takes its place."""
        edge, source = first - 1, int(self.edges.source[first - 1])
        motion = self.poses[source].inverse() @ self.poses[first]
        motions, information = self.edges.motions.matrix, self.edges.information.clone()
        motions[edge], information[edge] = motion.matrix, torch.linalg.inv(nowhere(motion.dim, *ANYWHERE))
        self.edges = self.edges._replace(motions=Pose.from_matrix(motions), information=information)
        sharpest = min(locations, key=lambda one: float(one.covariance.trace()))
        location = replace(sharpest, pose=self.poses[first].matrix)
        motion = self.poses[last].inverse() @ self.poses[first]
        self.add([_Closure(last, first, motion, information_of(location))], torch.zeros(0).long())

    def _frame(self, number: int) -> Keyframe:
        return Keyframe(self._points[number], self.poses[number])

    def _local(self, numbers: Sequence[int]) -> LocalMap:
        return LocalMap([self._frame(one) for one in numbers], self._least_explained, self._rule)


def _is_detour(poses: Pose) -> bool:
    """Whether the second of three poses is far from the way of the others."""
    before, after, across = (poses[one].inverse() @ poses[other] for one, other in ((0, 1), (1, 2), (0, 2)))
    far = before.translation.norm() + after.translation.norm() - across.translation.norm()
    return bool(far > _DETOUR[0]) or bool(before.angle() + after.angle() - across.angle() > _DETOUR[1])


def joined(parts: Tensor, edges: Edges, numbers: Sequence[int]) -> Tensor:
    """The group (K,) of each keyframe: closures join its part (K,), counted from 1, directly or not."""
    rows = torch.tensor(numbers)
    closures = edges.at(edges.is_closure)
    both = closures.source, closures.target
    ends = [parts[torch.searchsorted(rows, end, right=True) - 1] - 1 for end in both]
    n = int(parts.max())
    counts = torch.zeros(n, n).index_put_(tuple(ends), torch.ones(1), accumulate=True)
    _, group = connected_components((counts + counts.T >= _LEAST_CLOSURES).numpy(), directed=False)
    return torch.from_numpy(group)[parts - 1]


def _put_together(poses: Pose, closures: Sequence[_Closure], begins: Tensor) -> Pose:
    """The poses (N), with each part of them moved to where most of its closures with earlier ones agree: a
    pose graph does not find it from far away. begins: (P − 1,) first poses of the parts but the first one."""
    part = torch.bucketize(torch.arange(len(poses)), begins, right=True)
    for number in range(1, len(begins) + 1):
        across = [c for c in closures if part[c.source] < number == part[c.target]]
        if not across:
            continue
        best = max(across, key=lambda one: sum(_agree(poses, one, other) for other in across))
        moved = poses[best.source] @ best.motion @ poses[best.target].inverse()
        poses = Pose.cat([poses[part < number], moved @ poses[part >= number]])
    return poses


class LoopCloser:
    """Closes the loops of a sensor that moves on: every third keyframe is searched for in one old place.

    A closure counts when the next one agrees with it, within 0.3 m and 3°, so that one wrong closure moves
    nothing. The pose graph has the keyframes only.

    Args:
        least_explained, rule: as for `LocalMap`.

    Attributes:
        closures: of the graph, by rows of the keyframes.
    """

    def __init__(self, least_explained: float, rule: WindowedRule) -> None:
        self._least_explained, self._rule = least_explained, rule
        self.closures: list[_Closure] = []
        self._last: _Closure | None = None  # the last one, which may wait for another one that agrees

    @staticmethod
    def is_due(n: int) -> bool:
        """Whether the newest of n keyframes is searched for."""
        return n > _APART and n % _SPACING == 1

    def corrected(self, keyframes: Sequence[Keyframe], edges: Edges) -> Pose | None:
        """Corrected poses (K) of K keyframes if the newest one closes a loop, otherwise None.

        edges: of odometry, between successive keyframes.
        """
        poses = Pose.stack([frame.pose for frame in keyframes])
        pairs = _candidates(poses.translation, [len(keyframes) - 1])
        places = list(enumerate(keyframes))
        found = _closure(poses, places, *pairs[0], self._least_explained, self._rule) if pairs else None
        if found is None:
            return None
        last, self._last = self._last, found
        if last is None or not _agree(poses, last, found):
            return None
        new_ones = [found] if self.closures and self.closures[-1] is last else [last, found]
        self.closures += new_ones
        between = [poses[one.source].inverse() @ poses[one.target] for one in new_ones]
        off = [one.motion.inverse() @ motion for one, motion in zip(new_ones, between, strict=True)]
        if not any(_is_beyond(motion, _NOTICED) for motion in off):
            return None  # the poses agree with them
        return optimised(poses, edges.joined(_edges(self.closures)), with_covariances=False).poses


def _agree(poses: Pose, last: _Closure, now: _Closure) -> bool:
    """Whether the last closure, moved along the poses to the ends of the new one, gives its motion."""
    before = poses[now.source].inverse() @ poses[last.source]
    after = poses[last.target].inverse() @ poses[now.target]
    return not _is_beyond(now.motion.inverse() @ before @ last.motion @ after, _AGREE)


def _is_beyond(motion: Pose, limits: tuple[float, float]) -> bool:
    """Whether a motion is longer than a shift (m) or turns by more than an angle (rad)."""
    return bool(motion.translation.norm() > limits[0]) or bool(motion.angle() > limits[1])


def _edges(closures: Sequence[_Closure]) -> Edges:
    source, target, motions, information = zip(*closures, strict=True)
    is_closure = torch.ones(len(closures), dtype=torch.bool)
    return Edges(
        torch.tensor(source), torch.tensor(target), Pose.stack(motions), torch.stack(information), is_closure
    )


def _candidates(
    at: Tensor, rows: Sequence[int] | None = None, parts: Tensor | None = None
) -> list[tuple[int, int]]:
    """Pairs (old, new) of rows of keyframes that may be at one place: for each new one, the nearest.

    at: positions (K, D) of the keyframes. rows: new ones; None: every third. parts: (K,), see `closed`: of
    other parts, keyframes may be nearer in time, but a part of one or two is no map to search in.
    """
    if not len(at):
        return []
    path = torch.cat([torch.zeros(1), (at[1:] - at[:-1]).norm(dim=1)]).cumsum(0)
    order = torch.arange(len(at))
    new = order if rows is None else torch.tensor(rows)
    gap = torch.cdist(at[new], at)
    reach = (_REACH + _DRIFT * (path[new, None] - path)).clamp_max(_FARTHEST)
    is_apart = new[:, None] - order >= _APART
    if parts is not None:
        is_other = (parts[new, None] > parts) & (torch.bincount(parts)[parts] >= _SPACING)
        is_apart |= is_other
        reach = torch.where(is_other, _FROM_LOST, reach)
    allowed = is_apart & (gap <= reach)
    nearest = torch.where(allowed, gap, torch.inf).argmin(1)
    step = _SPACING if rows is None else 1
    return [
        (int(nearest[row]), int(new[row]))
        for row in range(0, len(new), step)
        if bool(allowed[row, nearest[row]])
    ]


def _closure(
    poses: Pose,
    places: Sequence[tuple[int, Keyframe]],
    old: int,
    new: int,
    least_explained: float,
    rule: WindowedRule,
    parts: Tensor | None = None,
) -> _Closure | None:
    """The closure between two rows of keyframes, if they see one place."""
    around = range(max(old - _NEIGHBOURS, 0), min(old + _NEIGHBOURS + 1, len(places)))
    around_old = [row for row in around if row != old and (parts is None or parts[row] == parts[old])]
    order = [*around_old, old]  # the last one is the centre of a local map
    is_lost = parts is not None and bool(parts[old] != parts[new])
    local = LocalMap(
        [places[row][1]._replace(pose=poses[places[row][0]]) for row in order], least_explained, rule
    )
    source, target = places[old][0], places[new][0]
    width, reach = (_REACH / 2, _ANGLE), (_REACH, 3 * _ANGLE)
    if is_lost:
        width = reach = _FROM_LOST, math.pi
    expected = Expectation(poses[[target]], *width, _MOST_EXPLAINED, *reach)
    location = local.locate(places[new][1], expected)
    if not location.found or location.explained < _MOST_EXPLAINED:
        return None
    motion = poses[source].inverse() @ Pose.from_matrix(location.pose)
    return _Closure(source, target, motion, information_of(location))


def information_of(location: Location) -> Tensor:
    """The inverse covariance (F, F) of a location in the frame of the sensor."""
    pose = Pose.from_matrix(location.pose)
    turn = Pose(pose.rotation, torch.zeros_like(pose.translation)).adjoint()
    covariance = location.covariance + torch.diag(_SYSTEMATIC[pose.dim].square())
    return torch.linalg.inv(turn.T @ covariance @ turn)

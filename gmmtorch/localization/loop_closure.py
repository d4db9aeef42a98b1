"""Loop closures: pairs of keyframes that saw one place at different times, with the motion between them.

`closed` finds those of a complete trajectory, `LoopCloser` those of a sensor that moves on.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

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
_TOGETHER = 5  # keyframes after a doubtful motion that are placed together
_SURE = 5.0  # nats
_NEIGHBOURS = 3  # keyframes before and after an old one, in the map of its place
_SPACING = 3  # every third keyframe looks for closures
_MOST_EXPLAINED = 0.8  # share of the points that a closure explains at least
_SYSTEMATIC = {  # deviations (m, rad) of errors that the points do not show, such as thick surfaces
    2: torch.tensor([0.01, 0.01, 0.002]).double(),
    3: torch.tensor([0.01, 0.01, 0.01, 0.001, 0.001, 0.001]).double(),
}
_ANGLE = math.radians(10)  # of the heading of a closure
_AGREE = 0.3, math.radians(3)  # metres and radians: two closures agree
_NOTICED = 0.03, math.radians(0.3)  # metres and radians: a closure changes the poses


class _Closure(NamedTuple):
    """Numbers of two poses, the motion source ← target between them, and its information."""

    source: int
    target: int
    motion: Pose
    information: Tensor


def closed(
    poses: Pose,
    edges: Edges,
    places: Sequence[tuple[int, Keyframe]],
    parts: Tensor,
    doubtful: Sequence[int],
    max_step: float,
    least_explained: float,
    rule: WindowedRule,
) -> tuple[Pose, Edges]:
    """Poses near those that agree best, and the edges of a pose graph, with those of the loop closures that
    can be found.

    Args:
        poses: (N), world ← sensor. edges: of odometry.
        places: number of the pose, and keyframe, in order. parts: (K,), of the keyframes; between two parts
            the sensor was lost, and the poses of one relative to the other are a guess. doubtful: keyframes
            in 2D, in order, whose motion from the one before may be wrong: of two scans, by `max_step`
            metres each.
    """
    tried: set[tuple[int, int]] = set()
    again = _Again(poses, edges, places, parts, least_explained, rule)
    again.examine(doubtful, max_step)
    poses, edges, closures = again.poses, again.edges, again.closures
    if closures:
        edges = edges.joined(_edges(closures))
        poses = optimised(poses, edges, with_covariances=False).poses
    numbers = torch.tensor([number for number, _ in places], dtype=torch.int64)
    begins = numbers[1:][parts[1:] != parts[:-1]]
    for _ in range(_ROUNDS):
        at = poses.translation[numbers]
        pairs = [pair for pair in _candidates(at, parts=parts) if pair not in tried]
        found = [
            edge
            for old, new in pairs
            if (edge := _closure(poses, places, old, new, least_explained, rule, parts))
        ]
        tried.update(pairs)
        if not found:
            break
        closures += found
        edges = edges.joined(_edges(found))
        poses = optimised(_put_together(poses, closures, begins), edges, with_covariances=False).poses
    return poses, edges


class _Again:
    """A trajectory in 2D, whose doubtful motions are estimated again from several scans together.

    A motion is replaced if the keyframes after it lie elsewhere in the map of those before it, and this is
    likelier by far than all other poses. Its edge then becomes loose, and closures take its place.
    """

    def __init__(
        self,
        poses: Pose,
        edges: Edges,
        places: Sequence[tuple[int, Keyframe]],
        parts: Tensor,
        least_explained: float,
        rule: WindowedRule,
    ) -> None:
        self.poses, self.edges, self.closures = poses, edges, list[_Closure]()
        self._places, self._parts = places, parts
        self._least_explained, self._rule = least_explained, rule

    def examine(self, doubtful: Sequence[int], max_step: float) -> None:
        bounds = [*doubtful, len(self._places)]
        sure = list(range(bounds[0]))
        for row, end in zip(bounds, bounds[1:], strict=False):
            old, new = sure[-2 * _NEIGHBOURS - 1 :], range(row, min(end, row + _TOGETHER))
            if len(new) < 2:
                continue
            local = LocalMap([self._frame(one) for one in old], self._least_explained, self._rule)
            last, first = self._places[old[-1]][0], self._places[row][0]
            reach = max_step * min(first - last, 2)
            found = local.placed([self._frame(one) for one in new], self.poses[[last]], reach)
            if found.total > _SURE + found.tries and found.lead > _SURE:
                moved = Pose.from_matrix(found.locations[0].pose) @ self.poses[first].inverse()
                if self._parts[row] != self._parts[row - 1] or _is_beyond(moved, _AGREE):
                    self._replace(old, new, found.locations)
                sure += range(row, end)
            else:
                sure = list(range(row, end))

    def _replace(self, old: Sequence[int], new: Sequence[int], locations: Sequence[Location]) -> None:
        first = self._places[new[0]][0]
        moved = Pose.from_matrix(locations[0].pose) @ self.poses[first].inverse()
        self.poses = Pose.cat([self.poses[:first], moved @ self.poses[first:]])
        edge, source = first - 1, int(self.edges.source[first - 1])
        motion = self.poses[source].inverse() @ self.poses[first]
        motions, information = self.edges.motions.matrix, self.edges.information.clone()
        motions[edge], information[edge] = motion.matrix, torch.linalg.inv(nowhere(motion.dim, *ANYWHERE))
        self.edges = self.edges._replace(motions=Pose.from_matrix(motions), information=information)
        for row, location in zip(new, locations, strict=True):
            if location.found:
                pose = Pose.from_matrix(location.pose)
                at = [self._places[one][0] for one in old]
                nearest = at[int((self.poses.translation[at] - pose.translation).norm(dim=1).argmin())]
                motion = self.poses[nearest].inverse() @ pose
                self.closures.append(
                    _Closure(nearest, self._places[row][0], motion, information_of(location))
                )

    def _frame(self, row: int) -> Keyframe:
        number, frame = self._places[row]
        return frame._replace(pose=self.poses[number])


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
        if not any(_is_noticed(poses, closure) for closure in new_ones):
            return None
        return optimised(poses, edges.joined(_edges(self.closures)), with_covariances=False).poses


def _agree(poses: Pose, last: _Closure, now: _Closure) -> bool:
    """Whether the last closure, moved along the poses to the ends of the new one, gives its motion."""
    before = poses[now.source].inverse() @ poses[last.source]
    after = poses[last.target].inverse() @ poses[now.target]
    return not _is_beyond(now.motion.inverse() @ before @ last.motion @ after, _AGREE)


def _is_noticed(poses: Pose, closure: _Closure) -> bool:
    """Whether the poses disagree with a closure."""
    between = poses[closure.source].inverse() @ poses[closure.target]
    return _is_beyond(closure.motion.inverse() @ between, _NOTICED)


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

"""LocalMap: the surfaces around a moving sensor, from its last keyframes, in which the next scan is found."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.localization.alignment import Alignment, AlignmentTarget, align, seen_normals
from gmmtorch.localization.location import Location, pose_covariance
from gmmtorch.localization.motions import Motions, distinct, generators
from gmmtorch.localization.registration import register
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.learning.rules import WindowedRule
from gmmtorch.mapping.learning.windowed import learn_window
from gmmtorch.mapping.surfaces import surface_mixture
from gmmtorch.scan import Scan

_BLURS = {2: (0.2, 0.08, 0.03), 3: (0.25, 0.1, 0.04)}  # metres
_STEPS = 15  # of a level
_SPACING = 0.25  # metres between the starts of a search in 2D
_COARSE = {2: 0.5, 3: 1.0}  # metres of blur, and between the starts, of the last search
_TURNED = {
    2: 0.5,
    3: 0.2,
}  # radians between the headings of neighbouring starts, for each metre between their places
_NEAR = 0.5  # metres, and half as many radians, of the deviations of the first search in 2D
_FARTHEST = 3.0  # metres of a search
_IMPOSSIBLE = 4.0  # metres from every expected pose, which costs
_NEVER = 1e4  # nats
_AT_ONCE = 256  # starts
_SORTED = 1024  # best starts, of which
_CLIMBED = 16  # different ones are climbed
_RANKED = 200  # points of the scan that rank the starts
# Points that share one error: with 10, the prediction outweighed the surfaces where a corridor begins.
_CORRELATED = 3.0
_LOOSEST = 0.3  # metres of standard deviation
_APART = 0.3  # metres, and radians: poses are different
_INSIDE = 5.0  # nats of a point on a surface, however many components it touches
_USUAL = {2: 0.6, 3: 0.9}  # of the share that is expected to be explained: less, and the search is wider
_ALIKE = 2.0  # nats by which another pose must be worse


class Keyframe(NamedTuple):
    """A scan that stays: its points (N, D) and their mixture, in the frame of the sensor, and its pose
    (D+1, D+1), world ← sensor.
    """

    points: Tensor
    mixture: Components
    pose: Tensor


class Expectation(NamedTuple):
    """Where a scan is expected: poses (B, D+1, D+1), world ← sensor; the standard deviations of the first one
    (m, rad); and the share of its points that is usually explained.
    """

    poses: Tensor
    distance: float
    angle: float
    explained: float


class LocalMap:
    """The components of some keyframes in one frame.

    Args:
        keyframes: at least one, the last ones last.
        least_explained: share of a scan's points that must lie on surfaces.
    """

    def __init__(
        self, keyframes: Sequence[Keyframe], least_explained: float, rule: WindowedRule, n_points: int = 1000
    ) -> None:
        self.least_explained, self.n_points = least_explained, n_points
        self.dim = keyframes[0].points.shape[1]
        self._center = keyframes[-1].pose[: self.dim, self.dim]
        # One mixture of all points: where many scans overlap, a sum of their mixtures would outweigh the
        # surfaces that only one of them saw, and pull the next scan back.
        scans = [Scan(frame.points, torch.zeros(self.dim)).transformed(frame.pose) for frame in keyframes]
        self._components = learn_window(scans, rule, torch.Generator().manual_seed(0))
        mixture = surface_mixture(self._components, "the local map")
        centered = mixture._replace(means=mixture.means - self._center)
        normals = seen_normals(self._components)
        self._target = functools.partial(AlignmentTarget, centered, normals=normals)
        self._targets = [self._target(blur) for blur in _BLURS[self.dim]]

    def locate(self, scan: Keyframe, expected: Expectation) -> Location:
        """The pose of a scan, whose own pose is not used; `found` if it is sure."""
        best: tuple[Location, float] | None = None
        for starts, targets in self._searches(scan, expected):
            tried = self._climbed(scan, expected, starts, targets)
            if best is None or (tried[0].found, tried[1]) > (best[0].found, best[1]):
                best = tried
            if best[0].found and best[0].explained >= _USUAL[self.dim] * expected.explained:
                break
        assert best is not None
        return best[0]

    def _searches(
        self, scan: Keyframe, expected: Expectation
    ) -> Iterator[tuple[Tensor, list[AlignmentTarget]]]:
        """Starts, and the levels they climb; the cheapest search first."""
        if self.dim == 2:
            near = expected._replace(
                distance=min(expected.distance, _NEAR), angle=min(expected.angle, _NEAR / 2)
            )
            yield self._lattice(scan, near, self._targets[0], _SPACING), self._targets
        else:
            registered = register(scan.mixture, self._components, expected.poses).transform
            yield torch.cat([registered[None], expected.poses]), self._targets
        coarse = self._target(_COARSE[self.dim])
        wide = expected._replace(distance=_FARTHEST / 2, angle=math.pi / 2)
        starts = self._lattice(scan, wide, coarse, coarse.blur)
        yield starts, [coarse, *self._targets]
        if self.dim == 3:
            registered = register(scan.mixture, self._components, starts, coarsest=coarse.blur).transform
            yield registered[None], self._targets

    def _lattice(
        self, scan: Keyframe, expected: Expectation, target: AlignmentTarget, spacing: float
    ) -> Tensor:
        """The expected poses, and the best of the starts around them, `spacing` metres apart."""
        reach = math.ceil(min(2 * expected.distance, _FARTHEST) / spacing)
        side = torch.arange(-reach, reach + 1).double() * spacing
        shifts = torch.nn.functional.pad(torch.cartesian_prod(side, side), (0, self.dim - 2))
        turn = _TURNED[self.dim] * spacing
        n_turns = math.ceil(min(2 * expected.angle, math.pi) / turn)
        angles = torch.arange(-n_turns, n_turns + 1).double() * turn
        turns = torch.linalg.matrix_exp(angles[:, None, None] * generators(self.dim)[-1])
        poses = expected.poses[:, None, None].repeat(1, len(shifts), len(turns), 1, 1)
        poses[..., :-1, -1] += shifts[None, :, None]
        poses[..., :-1, :-1] = turns @ poses[..., :-1, :-1]
        starts = torch.cat([expected.poses, poses.flatten(0, 2)])
        points = scan.points[:_RANKED]
        score = torch.cat([target.sums(points, self._motions(part)).score for part in starts.split(_AT_ONCE)])
        total = score / _CORRELATED - self._unlikely(starts, expected)
        best = total.argsort(descending=True, stable=True)[:_SORTED]
        different = distinct(self._motions(starts[best]), 1.5 * spacing, 1.5 * turn)
        return torch.cat([expected.poses, starts[best[different]][:_CLIMBED]])

    def _climbed(
        self, scan: Keyframe, expected: Expectation, starts: Tensor, targets: list[AlignmentTarget]
    ) -> tuple[Location, float]:
        motions, kept = self._motions(starts), len(starts)
        for target in targets:
            found = align(scan.points[: self.n_points], target, motions, _STEPS)
            kept = max(kept // 2, 3)
            order = self._total(found, scan, expected).argsort(descending=True, stable=True)
            order = order[distinct(found.motions.at(order), target.blur / 2, target.blur / 2)]
            found = found.at(order[:kept])
            motions = found.motions
        total = self._total(found, scan, expected)
        return self._location(scan, found, total), float(total[0])

    def _total(self, found: Alignment, scan: Keyframe, expected: Expectation) -> Tensor:
        """Log-likelihood of the points, and of the motion (B,), nats."""
        likelihood = (
            (found.score + _INSIDE * found.explained) * len(scan.points[: self.n_points]) / _CORRELATED
        )
        return likelihood - self._unlikely(self._poses(found.motions), expected)

    def _unlikely(self, poses: Tensor, expected: Expectation) -> Tensor:
        """Half the square deviation (B,) of poses from the nearest expected one, with a long tail."""
        distance = torch.cdist(poses[:, :-1, -1], expected.poses[:, :-1, -1])
        too_far = torch.where(distance.amin(1) > _IMPOSSIBLE, _NEVER, 0.0)
        distance = distance / expected.distance
        turned = torch.linalg.matrix_norm(poses[:, None, :-1, :-1] - expected.poses[:, :-1, :-1])
        square = distance.square() + (turned / (math.sqrt(2) * expected.angle)).square()
        return torch.log1p(square.amin(1) / 2) + too_far

    def _location(self, scan: Keyframe, found: Alignment, total: Tensor) -> Location:
        covariance, loosest = pose_covariance(found.information[0], scan.points[: self.n_points])
        share, doubts = float(found.explained[0]), []
        if float(total[0]) < -_NEVER / 2:
            doubts.append(f"the pose is more than {_IMPOSSIBLE:g} m from where it is expected")
        if share < self.least_explained:
            doubts.append(f"only {share:.0%} of the points lie on surfaces of the last scans")
        if loosest > _LOOSEST:
            doubts.append(f"the surfaces leave a direction open: a standard deviation of {loosest:.2g} m")
        poses = self._poses(found.motions)
        shift = (poses[:, :-1, -1] - poses[0, :-1, -1]).norm(dim=1)
        turn = torch.linalg.matrix_norm(poses[:, :-1, :-1] - poses[0, :-1, :-1]) / math.sqrt(2)
        if bool((((shift > _APART) | (turn > _APART)) & (total >= total[0] - _ALIKE)).any()):
            doubts.append("another pose explains the scan as well")
        return Location(poses[0], covariance, share, tuple(doubts))

    def _motions(self, poses: Tensor) -> Motions:
        return Motions(poses[:, :-1, :-1], poses[:, :-1, -1] - self._center)

    def _poses(self, motions: Motions) -> Tensor:
        poses = torch.eye(self.dim + 1).double().repeat(len(motions.rotations), 1, 1)
        left, _, right = torch.linalg.svd(motions.rotations)
        poses[:, :-1, :-1] = left @ right
        poses[:, :-1, -1] = motions.translations + self._center
        return poses

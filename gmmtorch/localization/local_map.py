"""LocalMap: the surfaces and the free space around a moving sensor, in which the next scan is found.

Each keyframe is also kept as a range image: the nearest return in each direction. A point of another scan is,
in such an image, in front of the surface (free space, which contradicts it), on the surface, or behind it or
outside the field of view (unknown).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.kernels import is_fused, range_views
from gmmtorch.localization.alignment import (
    Alignment,
    AlignmentTarget,
    align,
    differences,
    distinct,
    seen_normals,
)
from gmmtorch.localization.location import Location, pose_covariance
from gmmtorch.localization.pose_search import (
    CORRELATED,
    MARGIN,
    NEVER,
    WIDE,
    Expectation,
    PoseSearch,
    free_segments,
)
from gmmtorch.localization.registration import register
from gmmtorch.mapping import WindowedRule, learn_window, surface_mixture
from gmmtorch.pose import Pose
from gmmtorch.scan import Scan

_BLURS = {2: (0.2, 0.08, 0.03), 3: (0.25, 0.1, 0.04)}  # metres
_STEPS = 15  # of a level; with six on the last one, headings stay 2° off
_EACH, _LAST = 3, 5  # a third of the poses go on to the next level, but at least five
_SLIDE = 1.0  # metres that the best pose is moved at most along its loosest direction, to
_SLIDES = 16  # places, each of which climbs by
_SLIDE_STEPS = 3
_DECISIVE = 4.0  # nats by which such a place must be better: smaller gains do not make poses more exact
_SPACING = {2: 0.25, 3: 0.5}  # metres between the starts near the expected poses
_COARSE, _FAR = 0.5, 1.0  # metres of blur, and between the starts, of the wider search in 3D
_HEADINGS = 8  # from which a scan in 3D is registered, if it may have turned far
_TURNED = {2: 0.5, 3: 0.2}  # radians between the headings of neighbours, for each metre between their places
_NEAR = 0.5  # metres, and half as many radians, of the deviations of the first search
_FARTHEST = 3.0  # metres of a search
_SORTED = {2: 400, 3: 200}  # best starts, of which
_CLIMBED = 24, 48  # different ones are climbed, of the first and of the wider search
_SPREAD = 0.75  # spacings between them
_COARSE_POINTS = 300  # of the scan on all levels but the last one
_RANKED = 200  # points of the scan that rank the starts
_LOOSEST = 0.3  # metres of standard deviation
LOST = 1.0, math.radians(20)  # deviations (m, rad) of a pose that no scan confirms
_STARTS, _STARTS_WIDE = 40, 100  # poses of the search in 2D that are climbed, and of the wide one
_SEARCHED = 1000  # points of a keyframe
_APART = 0.3  # metres, and radians: poses are different
_UNKNOWN = 4.0  # nats of a point that the local map could not see: neither for nor against a pose
_CONTRADICTED = 8.0  # nats that a point costs in free space, or an earlier point that the scan looks through
_LEAST_PROBABILITY = 0.2  # of a pose that is found: a map that is lost costs more than a wrong step
_LEAST_OF_SURPRISING = 0.8  # the same, of a pose that has against it, by what was expected,
_SURPRISING = 4.0  # nats or more
_LEAST_SEEN = 0.5  # share of the points of which at least so many must lie on surfaces
_USUAL = 0.85  # of the share that is expected to be explained: less, and the search is wider
_SURE = 4.6  # nats: odds of 100 to 1
_LEAD = 10.0  # nats to the best other place: the points of a wall share errors
_ALIKE = 2.0  # nats by which another pose must be worse
_IMAGE_CELL = {2: math.radians(1), 3: math.radians(3)}  # of an image
_KEPT_POINTS = 200  # of each earlier scan, that a new scan must not look through


class Keyframe(NamedTuple):
    """A scan that stays: its points (N, D) in the frame of the sensor, in random order, and its pose,
    world ← sensor."""

    points: Tensor
    pose: Pose


class _Found(NamedTuple):
    """The result of one search, with its log-likelihood (nats) and the share of the points against it."""

    location: Location
    total: float
    contradicted: float


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
        self._center = keyframes[-1].pose.translation
        # One mixture of all points: where many scans overlap, a sum of their mixtures would outweigh the
        # surfaces that only one of them saw, and pull the next scan back.
        self._scans = [Scan(pose.apply(points), pose.translation) for points, pose in keyframes]
        self._rule = rule
        self._components = learn_window(self._scans, rule, torch.Generator().manual_seed(0))
        mixture = surface_mixture(self._components, "the local map")
        centered = mixture._replace(means=mixture.means - self._center)
        self._target = functools.partial(AlignmentTarget, centered, normals=seen_normals(self._components))
        first = self._target(_BLURS[self.dim][0])
        lists = first.table.lists
        self._targets = [first, *(self._target(blur, lists=lists) for blur in _BLURS[self.dim][1:])]
        poses = Pose.stack([frame.pose for frame in keyframes])
        self._space = FreeSpace([frame.points for frame in keyframes], poses)

    @functools.cached_property
    def _search(self) -> PoseSearch:
        points = torch.cat([scan.points[:_SEARCHED] for scan in self._scans])
        origins = torch.cat([scan.origin.expand_as(scan.points[:_SEARCHED]) for scan in self._scans])
        return PoseSearch(points, free_segments(origins, points))

    def locate(self, scan: Keyframe, expected: Expectation, wide: bool = False) -> Location:
        """The pose of a scan, whose own pose is not used; `found` if it is sure.

        wide: search wider in 2D if the first search fails. Where little is expected, as after a lost scan, a
            wider search finds more wrong poses that fit by chance.
        """
        best: _Found | None = None
        for starts, targets in self._searches(scan, expected, wide):
            tried = self._climbed(scan, expected, starts, targets)
            # By another search that found the same pose:
            confirmed = best is not None and best.location.found and _is_same(best.location, tried.location)
            # In 2D a lost scan stays where the first search finds it: that is near the prediction.
            counts = tried.location.found or self.dim == 3
            if best is None or (
                counts and (tried.location.found, tried.total) > (best.location.found, best.total)
            ):
                best = tried
            supported = best.location.explained - best.contradicted
            if best.location.found and (confirmed or supported >= _USUAL * expected.explained):
                break
        assert best is not None
        return best.location

    def _searches(
        self, scan: Keyframe, expected: Expectation, wide: bool
    ) -> Iterator[tuple[Pose, list[AlignmentTarget]]]:
        """Starts, and the levels they climb; the cheapest search first."""
        near = expected._replace(distance=min(expected.distance, _NEAR), angle=min(expected.angle, _NEAR / 2))
        first, spacing = self._targets[0], _SPACING[self.dim]
        starts = self._lattice(scan, near, near.poses, first, spacing, 2 * near.angle, _CLIMBED[0])
        if self.dim == 2:
            # Along a wall most climbs end in one wrong place: the best pose of the raster is not enough.
            starts = Pose.cat([starts, self._search.best(scan.points, expected, _STARTS)[0]])
            yield starts, self._targets
            if wide:  # How sure a pose is depends on all others, so the first starts stay.
                more = self._search.best(scan.points, expected, _SORTED[2], *WIDE)[0]
                yield Pose.cat([starts, self._ranked(scan, expected, more)[:_STARTS_WIDE]]), self._targets
            return
        still = Scan(scan.points, torch.zeros(self.dim))
        mixture = learn_window([still], self._rule, torch.Generator().manual_seed(0))
        found = register(mixture, self._components, expected.poses.matrix)
        registered = Pose.from_matrix(found.transform[None])
        yield Pose.cat([registered, starts]), self._targets
        # Where pillars repeat, it may be one of them off, but has the right rotation.
        places = torch.cat([registered.translation, expected.poses.translation])
        around = Pose(registered.rotation.expand(len(places), 3, 3), places)
        coarse, turn = self._target(_COARSE), _TURNED[3] * _FAR
        starts = self._lattice(scan, expected, around, coarse, _FAR, turn, _CLIMBED[1])
        yield starts, [coarse, *self._targets]
        last = expected.poses[-1]
        angles = torch.arange(_HEADINGS).double() * (2 * math.pi / _HEADINGS)
        turned = Pose.from_yaw(angles, torch.zeros(3).double()).rotation @ last.rotation
        starts = Pose(turned, last.translation.expand(_HEADINGS, 3))
        found = register(mixture, self._components, starts.matrix)
        yield Pose.from_matrix(found.transform[None]), self._targets

    def placed(self, scans: Sequence[Keyframe], near: Pose, reach: float) -> tuple[list[Location], bool]:
        """Where some scans in 2D, whose poses agree with each other, most likely lie together, by the sum of
        their evidence: at their poses, or with the first one up to `reach` metres from a pose `near` (1).

        Returns a location of each, with a doubt if the scan does not support it; and whether all other poses
        are less likely by odds of 100, and so are places that the map does not show.
        """
        ways = [scans[0].pose.inverse() @ scan.pose for scan in scans]
        some = [scan.points[:_COARSE_POINTS] for scan in scans]
        cloud = torch.cat([way.apply(points) for way, points in zip(ways, some, strict=True)])
        cloud = cloud[torch.randperm(len(cloud), generator=torch.Generator().manual_seed(0))]
        firsts = self._starts_together(scans, ways, near, reach)
        for target in self._targets[:2]:
            climbed = align(cloud[: 2 * _COARSE_POINTS], target, firsts.shifted(-self._center), _STEPS)
            firsts = climbed.motions.orthonormal().shifted(self._center)
        unlimited = Expectation(near, math.inf, math.inf, 1.0, math.inf)
        nats = []
        for way, points in zip(ways, some, strict=True):
            found = align(points, self._targets[1], (firsts @ way).shifted(-self._center), _SLIDE_STEPS)
            nats.append(self._total(found, points, unlimited)[0] - _UNKNOWN * len(points) / CORRELATED)
        total = torch.stack(nats).sum(0)
        tries = math.log(math.pi * (reach / _APART) ** 2 * math.pi / _APART)
        best = int(total.argmax())
        is_apart = differences(firsts, firsts[[best]], _APART, _APART)[:, 0] > 1
        lead = float(total[best] - torch.where(is_apart, total, -torch.inf).amax())
        laid = align(cloud, self._targets[-1], firsts[[best]].shifted(-self._center), _STEPS).motions
        locations = []
        for way, points, gain in zip(ways, some, nats, strict=True):
            place = laid.orthonormal().shifted(self._center) @ way
            seen = align(points, self._targets[-1], place.shifted(-self._center), 0)
            covariance = pose_covariance(seen.information[0], points)[0]
            doubts = () if float(gain[best]) > 0 else ("the scan does not support the place",)
            locations.append(Location(place.matrix[0], covariance, float(seen.explained[0]), doubts))
        return locations, lead > _LEAD and float(total[best]) > _SURE + tries

    def _starts_together(
        self, scans: Sequence[Keyframe], ways: Sequence[Pose], near: Pose, reach: float
    ) -> Pose:
        """Starts for the first of some scans: its own pose, then those that the search of each scan finds,
        the likeliest for all scans first. ways: from the first scan to each."""
        starts = [scans[0].pose[None]]
        for way, scan in zip(ways, scans, strict=True):
            around = Expectation(near @ way, math.inf, math.inf, 1.0, reach)
            starts.append(self._search.best(scan.points, around, _STARTS)[0] @ way.inverse())
        firsts = Pose.cat(starts)
        rough = torch.zeros(len(firsts)).double()
        for way, scan in zip(ways, scans, strict=True):
            points, poses = scan.points[:_RANKED], firsts @ way
            score = self._targets[0].scores(points, poses.shifted(-self._center))
            rough += score / CORRELATED + self._seen(points, poses)[0]
        rough[0] = math.inf  # so that its own pose is always tried
        order = rough.argsort(descending=True, stable=True)
        return firsts[order[distinct(firsts[order], _APART, _APART / 2)][:_STARTS]]

    def _lattice(
        self,
        scan: Keyframe,
        expected: Expectation,
        centers: Pose,
        target: AlignmentTarget,
        spacing: float,
        angle: float,
        most: int,
    ) -> Pose:
        """Some poses, and at most `most` of the best starts around them.

        They are `spacing` metres apart, with headings up to `angle` radians from those of the poses.
        """
        reach = math.ceil(min(2 * expected.distance, _FARTHEST) / spacing)
        side = torch.arange(-reach, reach + 1).double() * spacing
        shifts = torch.nn.functional.pad(torch.cartesian_prod(side, side), (0, self.dim - 2))
        turn = _TURNED[self.dim] * spacing
        n_turns = math.ceil(min(angle, math.pi) / turn)
        angles = torch.arange(-n_turns, n_turns + 1).double() * turn
        turns = Pose.from_yaw(angles, torch.zeros(self.dim).double()).rotation
        rotations = (turns @ centers.rotation[:, None, None]).expand(-1, len(shifts), -1, -1, -1)
        places = (centers.translation[:, None] + shifts)[:, :, None].expand(-1, -1, len(turns), -1)
        starts = Pose.cat([centers, Pose(rotations.flatten(0, 2), places.flatten(0, 2))])
        starts = self._ranked(scan, expected, starts, target)
        starts = starts[distinct(starts.shifted(-self._center), _SPREAD * spacing, _SPREAD * turn)]
        return Pose.cat([centers, starts[:most]])

    def _ranked(
        self, scan: Keyframe, expected: Expectation, starts: Pose, target: AlignmentTarget | None = None
    ) -> Pose:
        """The best starts, best first."""
        points = scan.points[:_RANKED]
        score = (target or self._targets[0]).scores(points, starts.shifted(-self._center))
        total = score / CORRELATED - expected.unlikely(starts)
        best = total.argsort(descending=True, stable=True)[: _SORTED[self.dim]]
        total = total[best] + self._seen(points, starts[best])[0]
        return starts[best[total.argsort(descending=True, stable=True)]]

    def _climbed(
        self, scan: Keyframe, expected: Expectation, starts: Pose, targets: list[AlignmentTarget]
    ) -> _Found:
        motions, kept = starts.shifted(-self._center), len(starts)
        for target in targets:
            points = scan.points[: self.n_points if target is targets[-1] else _COARSE_POINTS]
            images = range_images([points])
            found = align(points, target, motions, _STEPS)
            kept = max(kept // _EACH, _LAST)
            total, view = self._total(found, points, expected, images)
            order = total.argsort(descending=True, stable=True)
            order = order[distinct(found.motions[order], target.blur / 2, target.blur / 2)]
            order = order[:kept]
            found, total, view = found.at(order), total[order], view.at(order)
            motions = found.motions
        # A climb has the points' score alone, which can rise along a wall while the sum of evidence falls.
        slid = align(points, targets[-1], _slid(found, points), _SLIDE_STEPS)
        slid_total, slid_view = self._total(slid, points, expected, images)
        # A place whose own direction stays open would lose to any pose of a wider search without a doubt.
        is_open = pose_covariance(slid.information, points)[1] > _LOOSEST
        slid_total = torch.where(is_open, -torch.inf, slid_total)
        order = slid_total.argsort(descending=True, stable=True)
        if float(slid_total[order[0]] - total[0]) > _DECISIVE:
            found, total, view = slid.at(order), slid_total[order], slid_view.at(order)
        return self._judged(points, found, total, view, expected)

    def _total(
        self, found: Alignment, points: Tensor, expected: Expectation, images: Images | None = None
    ) -> tuple[Tensor, View]:
        """Log-likelihood of the points and of the motion (B,), nats; how the points agree with free space."""
        poses = found.motions.orthonormal().shifted(self._center)
        seen, view = self._seen(points, poses, images)
        return found.evidence * len(points) / CORRELATED + seen - expected.unlikely(poses), view

    def _seen(self, points: Tensor, poses: Pose, images: Images | None = None) -> tuple[Tensor, View]:
        """Log-likelihood (B,) of points in free space and of unseen ones, nats; and how many there are."""
        view = self._space.view(points, poses, images)
        mean = _UNKNOWN * view.unknown - _CONTRADICTED * (view.in_free_space + view.looked_through)
        return mean * len(points) / CORRELATED, view

    def _judged(
        self, points: Tensor, found: Alignment, total: Tensor, view: View, expected: Expectation
    ) -> _Found:
        """The best pose; if others explain the scan nearly as well, the most expected one, with a doubt."""
        poses = found.motions.orthonormal().shifted(self._center)
        is_apart = differences(found.motions, found.motions[:1], _APART, _APART)[:, 0] > 1
        rivals = is_apart & (total >= total[0] - _ALIKE)
        chosen = rivals | (torch.arange(len(total)) == 0)
        best = int(torch.where(chosen, expected.unlikely(poses), torch.inf).argmin())
        covariance, deviation = pose_covariance(found.information[best], points)
        explained, loosest = float(found.explained[best]), float(deviation)
        contradicted = float(view.in_free_space[best] + view.looked_through[best])
        seen = 1 - float(view.unknown[best])
        share, doubts = min(explained / max(seen, _LEAST_SEEN), 1.0), []
        if float(total[best]) < -NEVER / 2:
            doubts.append("the pose is farther from where it is expected than max_step and max_turn allow")
        lead = total[best] - torch.where(is_apart, total, -torch.inf).amax()
        unlikely = float(expected.unlikely(poses[[best]]))
        probability = _probability(explained, contradicted, 1 - seen, float(lead), loosest, unlikely)
        if probability < (_LEAST_PROBABILITY if unlikely < _SURPRISING else _LEAST_OF_SURPRISING):
            doubts.append(
                f"the probability of the pose is {probability:.2f}: {share:.0%} of the points lie on "
                f"surfaces, and {contradicted:.0%} contradict the free space of the last scans"
            )
        if share < self.least_explained:
            doubts.append(f"only {share:.0%} of the points lie on surfaces of the last scans")
        if doubts:
            covariance = covariance + nowhere(self.dim)
        if loosest > _LOOSEST:
            doubts.append(f"the surfaces leave a direction open: a standard deviation of {loosest:.2g} m")
        if bool(rivals.any()):
            doubts.append("another pose explains the scan as well")
            covariance = covariance + _scatter(poses[best], poses[chosen])
        location = Location(poses[best].matrix, covariance, share, tuple(doubts), probability)
        return _Found(location, float(total[best]), contradicted)


def _is_same(some: Location, other: Location) -> bool:
    """Whether two searches found one pose."""
    first, second = Pose.from_matrix(some.pose[None]), Pose.from_matrix(other.pose[None])
    return float(differences(first, second, _APART, _APART)) < 1


def _probability(
    explained: float, contradicted: float, unseen: float, lead: float, loosest: float, unlikely: float
) -> float:
    """That a pose is right: within 0.2 m and two deviations of its loosest direction, and 0.1 rad. A logistic
    regression on 3,100 poses of eight logs; many are thinned, so that scans are lost, and some scans are
    searched for in the map of another place. Of each log by the weights of the others, 99.8 % of the poses
    above 0.99 are right.

    explained, contradicted, unseen: shares of the points. lead: nats to the best pose that is apart; infinite
    if there is none. loosest: standard deviation (m) of the loosest direction. unlikely: nats against the
    pose by what was expected.
    """
    shares = 6.3 * explained - 7.5 * contradicted + 2.6 * unseen
    ahead = 3.2 if math.isinf(lead) else 1.1 * math.log1p(max(lead, 0.0))
    sharp = -1.6 * math.log(min(max(loosest, 0.05), 1.0))
    odds = shares + ahead + sharp - 0.6 * min(unlikely, 30.0) - 9.3
    return 1 / (1 + math.exp(-odds))


def _slid(found: Alignment, points: Tensor) -> Pose:
    """The first motion, moved along the direction that the points fix least, by up to two deviations."""
    covariance, loosest = pose_covariance(found.information[0], points)
    scale = torch.ones(len(covariance)).double()
    scale[points.shape[1] :] = 1 / points.norm(dim=1).median().clamp_min(1e-3)
    axis = torch.linalg.eigh(covariance / scale[:, None] / scale)[1][:, -1] * scale
    steps = torch.linspace(-1, 1, _SLIDES).double() * min(2 * float(loosest), _SLIDE)
    return found.motions[[0] * _SLIDES].moved(steps[:, None] * axis)


def nowhere(dim: int, shift: float = LOST[0], turn: float = LOST[1]) -> Tensor:
    """The covariance (F, F) of a pose that no scan confirms, with these deviations (m, rad)."""
    deviations = torch.full((dim * (dim + 1) // 2,), turn).double()
    deviations[:dim] = shift
    return torch.diag(deviations.square())


def _scatter(pose: Pose, others: Pose) -> Tensor:
    """The second moment (F, F) of other poses (B) about a pose, where each may be the true one."""
    turned = others.rotation @ pose.rotation.T
    steps = Pose(turned, others.translation - pose.translation).log()
    return steps.T @ steps / len(steps)


class View(NamedTuple):
    """Of B poses: shares (B,) of the points that lie in free space, of the points that no earlier scan could
    see, and of the earlier points that the scan looks through."""

    in_free_space: Tensor
    unknown: Tensor
    looked_through: Tensor

    def at(self, rows: Tensor) -> View:
        return View(*(value[rows] for value in self))


class FreeSpace:
    """What some scans saw, as range images.

    Args:
        points: (N, D) of each scan, in the frame of its sensor, metres.
        poses: (K), world ← sensor, one for each scan.
    """

    def __init__(self, points: Sequence[Tensor], poses: Pose) -> None:
        self._images = range_images(points)
        self._inverse = poses.inverse()
        some = [one[:: math.ceil(len(one) / _KEPT_POINTS) or 1] for one in points]
        self._points = torch.cat([poses[row].apply(part) for row, part in enumerate(some)])

    def view(self, points: Tensor, poses: Pose, images: Images | None = None) -> View:
        """How a scan's points (N, D) agree with the space that was seen, at poses (B). images: of the scan;
        None: they are made."""
        free, unknown = _counted(points, poses, self._images, self._inverse)
        still = Pose.identity(poses.dim, 1, device=points.device)
        images = range_images([points]) if images is None else images
        through, hidden = _counted(self._points, poses.inverse(), images, still)
        share = through / (len(self._points) - hidden).clamp_min(_KEPT_POINTS // 4)
        return View(free / len(points), unknown / len(points), share)


Images = tuple[Tensor, Tensor]
"""The nearest return (K, C) around each direction, in K scans, and the farthest in it; infinity and zero
without."""


def range_images(points: Sequence[Tensor]) -> Images:
    """Of some scans (N, D), in the frame of the sensor."""
    dim, n = points[0].shape[1], len(points)
    cells, distance = _cells(torch.cat(list(points)))
    across, high = _size(dim)
    scan = torch.arange(n, device=cells.device).repeat_interleave(
        torch.tensor([len(part) for part in points], device=cells.device), output_size=len(cells)
    )
    cells = cells + scan * (across * high)
    nearest = torch.full((n * across * high,), math.inf).to(distance)
    nearest = nearest.scatter_reduce(0, cells, distance, "amin").view(n, high, across)
    farthest = torch.zeros(n * across * high).to(distance).scatter_reduce(0, cells, distance, "amax")
    sides = torch.minimum(nearest, torch.minimum(nearest.roll(1, 2), nearest.roll(-1, 2)))
    if dim == 3:
        up = torch.nn.functional.pad(sides, (0, 0, 1, 1), value=math.inf)
        sides = torch.minimum(sides, torch.minimum(up[:, 2:], up[:, :-2]))
    farthest = farthest.view(n, -1)
    return torch.where(farthest > 0, sides.flatten(1), math.inf), farthest


def _counted(points: Tensor, motions: Pose, images: Images, frames: Pose) -> tuple[Tensor, Tensor]:
    """Numbers (B,) of points (N, D) under each motion in front of the surface of any of K range images
    (K, C), and of those that no image shows. frames: (K), image ← world."""
    if is_fused(points, *motions.parts, *images, *frames.parts):
        limits = _IMAGE_CELL[motions.dim], *MARGIN
        return range_views(points, motions.parts, frames.parts, images, _size(motions.dim), limits)
    cells, distance = _cells(frames[:, None].apply(motions.apply(points)))  # (K, B, N)
    near, far = (image.gather(1, cells.flatten(1)).view_as(distance) for image in images)
    margin = MARGIN[0] + MARGIN[1] * distance
    is_free = torch.isfinite(near) & (distance < near - margin)
    is_known = torch.isfinite(near) & (distance <= far + margin)
    return is_free.any(0).sum(1).double(), (~is_known.any(0)).sum(1).double()


def _cells(points: Tensor) -> tuple[Tensor, Tensor]:
    """The cell of each point's direction, and its distance."""
    dim = points.shape[-1]
    across, high = _size(dim)
    distance = points.norm(dim=-1)
    column = (torch.atan2(points[..., 1], points[..., 0]) / _IMAGE_CELL[dim]).round().long() % across
    if dim == 2:
        return column, distance
    sine = points[..., 2] / distance.clamp_min(1e-9)
    row = ((sine.clamp(-1, 1).asin() + math.pi / 2) / _IMAGE_CELL[dim]).long().clamp_max(high - 1)
    return row * across + column, distance


def _size(dim: int) -> tuple[int, int]:
    across = round(2 * math.pi / _IMAGE_CELL[dim])
    return across, 1 if dim == 2 else across // 2

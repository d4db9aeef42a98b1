"""Tracker: the pose of each scan of a moving sensor, or of a data set, in a map that is known."""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike, as_tensor
from gmmtorch.datasets import Dataset
from gmmtorch.errors import DataError, InvalidArgumentError, check_number, check_whole
from gmmtorch.localization import alignment
from gmmtorch.localization.alignment import Alignment, AlignmentTarget
from gmmtorch.localization.location import UNSEEN, Location, continued, measured_motion, pose_covariance
from gmmtorch.localization.pose_search import CORRELATED, PoseSearch, free_segments
from gmmtorch.mapping import Components, GaussianMap, Surfaces, surface_mixture
from gmmtorch.mixture import surface_pieces
from gmmtorch.pose import Pose
from gmmtorch.scan import check_positions

_GAP = 10.0  # times the median step of a clock: it jumps, or scans are missing
_BLURS = (1.0, 0.5, 0.25, 0.12, 0.06, 0.03)  # metres, one level after the other
_FINE = 2  # the level at which a search around a good prediction begins
_STEPS = 15  # of the first and the last level of a search
_BETWEEN_STEPS = 6  # of the levels between, which only lead to the peak of the next one
_COARSE_SHARE = 0.4  # of the points, on all levels but the last one
_SAME = 0.25  # of the blur: motions that are closer have climbed one peak
_SECOND_CHANCE = 1  # the level after the first: starts are ranked there once more, by its blur
_CLIMBED, _MORE_CLIMBED = 6, 24  # starts that the first level climbs; later levels climb the better half
_RASTERED = 16  # starts from the raster of a map in 2D, which are climbed as they are
_LIKELY = 2  # tilts of a sensor in space that are searched first
_NOISE = 0.03  # metres of a scan whose flat pieces tell how the sensor is tilted
_PLACES = 0.5  # metres between the places of a search of the whole map
_RANKED = 8 * _CLIMBED  # best starts, of which different ones are climbed
_RANKING_POINTS = 150  # of the scan, that rank the starts
_GLIMPSE_POINTS = 60  # of the scan, that choose a fifth of many starts for the ranking
_WIDER = 4  # times the first search
_GLOBAL_AFTER = 1  # lost scans, after which the whole map is searched

_USUAL = 0.9  # of the share that the last scan had: less, and the search is wider
_SURE = 0.95  # of the share that the last scan had: less, and a pose away from the prediction is not accepted
_LOOSEST = 0.3  # metres of standard deviation
_ALIKE = 2.0  # nats by which another pose must be worse
_APART = 0.3  # metres, and radians: poses are different
_FEWEST = 10  # points of a scan
_NEAREST = 0.2  # metres from the sensor: nearer points are its own cover, which would fit any wall
_FREE, _OCCUPIED = 0.2, 0.9  # occupancy of cells that the map is sure of,
_CELL = 0.1  # metres, their side
_BEAMS, _BEAM_POINTS = 60, 64  # of the scan, and of each beam, which are asked
_MOST_CONTRADICTED = 1.5  # times the share that need not be explained


class _Search(NamedTuple):
    """The first level; the starts; the share of explained points that ends the search; and how many starts
    are climbed."""

    level: int
    starts: Pose
    is_enough: float = 0.0
    n_climbed: int = _CLIMBED


class Tracker:
    """Localises the scans of a sensor, one after the other, in a map that does not change.

    A scan is aligned with the surfaces of the map (`localization.alignment`), from the pose that the last
    motion predicts. If this fails, starts around the prediction are tried, then four times as far. After
    a lost scan, and for the first scan without a pose, the whole map is searched: in 2D by branch and bound
    (`localization.pose_search`), in 3D all headings at the places from which the map was seen, with the tilts
    that make the scan's floor or walls parallel to those of the map.

    Args:
        surfaces: a map, its components, or (means, covariances, weights).
        pose: first pose (D+1, D+1), map ← sensor, metres. None: unknown.
        distance, angle: errors of the first pose that the search covers, in metres along the ground and in
            radians of the heading. Height, roll and pitch may be off by about 0.5 m and 10°.
        n_points: of a scan that are used at most, drawn with a fixed seed.
        least_explained: share of the points that must lie on surfaces of the map. Poses in other places
            explained up to 0.81 of a hall's scans, true ones at least 0.98. Lower it where much has changed.

    Raises `InvalidArgumentError` for a map without surfaces, a pose that is not rigid, or a search of the
    whole map if `surfaces` does not state from where it was seen.
    """

    def __init__(
        self,
        surfaces: Surfaces,
        pose: ArrayLike | None = None,
        *,
        distance: float = 0.5,
        angle: float = math.radians(10),
        n_points: int = 1000,
        least_explained: float = 0.9,
    ) -> None:
        mixture = surface_mixture(surfaces, "surfaces")
        if not len(mixture.weights):
            raise InvalidArgumentError("surfaces has no surface component; give the map of a place.")
        check_number("distance", distance)
        check_number("angle", angle, math.pi)
        check_whole("n_points", n_points, 1)
        check_number("least_explained", least_explained, 1)
        self.least_explained = least_explained
        self.distance, self.angle, self.n_points = distance, angle, n_points
        self.dim = mixture.means.shape[1]
        self._map = surfaces if isinstance(surfaces, GaussianMap) else None
        self._center = mixture.means.mean(0)  # numbers stay small anywhere in the world
        self._mixture = centered = mixture._replace(means=mixture.means - self._center)
        seen = surfaces.components() if isinstance(surfaces, GaussianMap) else surfaces
        self._seen = seen if isinstance(seen, Components) else None
        faces = torch.zeros_like(centered.means) if self._seen is None else alignment.seen_normals(self._seen)
        merged = [(blur, *alignment.merged_below(centered, faces, blur)) for blur in _BLURS]
        self._targets = [AlignmentTarget(kept, blur, normals) for blur, kept, normals in merged]
        self._places = mixture.means[:0] if self._seen is None else _places(self._seen, self._center)
        self.restart(pose)

    def restart(self, pose: ArrayLike | None = None) -> None:
        """Forgets all scans: the next one is near `pose` (D+1, D+1), map ← sensor, or anywhere if None.

        Raises as the constructor does.
        """
        if pose is None and not len(self._places):
            raise InvalidArgumentError(
                "pose=None, but surfaces does not state from where it was seen; give the first pose or a map."
            )
        self.n_lost = 0
        self._explained = 0.0
        self._motion: Pose | None = None
        self._last: Pose | None = None  # about the centre
        if pose is not None:
            start = as_tensor(pose, "pose", torch.float64, self._center.device).detach().clone()
            self._last = Pose.checked(start, self.dim, "pose").shifted(-self._center)

    def locate(self, points: ArrayLike, motion: ArrayLike | None = None) -> Location:
        """The pose of the next scan; if it is not `found`, the best guess.

        Args:
            points: (N, D) returns in the frame of the sensor, metres.
            motion: (D+1, D+1) of the sensor since the last scan, last ← now, such as an odometry's; or its
                rotation (D, D) alone, such as that of an IMU: the velocity in the frame of the sensor
                continues. None: the sensor moves as between the last two scans.

        Raises `InvalidArgumentError` for another shape, NaN, or a motion that is not rigid.
        """
        rows = as_tensor(points, "points", torch.float64, self._center.device).detach()
        if rows.ndim != 2 or rows.shape[1] != self.dim:
            shape = tuple(rows.shape)
            raise InvalidArgumentError(f"points has shape {shape}; expected (N, {self.dim}), metres.")
        check_positions("points", rows)
        measured = None if motion is None else measured_motion(motion, self.dim, self._center.device)
        measured = continued(measured, self._motion) if isinstance(measured, Tensor) else measured
        predicted = self._predicted(measured)
        cloud = rows = rows[rows.norm(dim=1) > _NEAREST]
        drawn = torch.randperm(len(rows), generator=torch.Generator().manual_seed(0))[: self.n_points]
        rows = rows[drawn.to(rows.device)]
        best: Location | None = None
        searches = self._searches(cloud, rows, predicted, measured is not None) if len(rows) else ()
        for search in searches:
            found = self._climbed(rows, search)
            if best is None or (found.found, found.explained) > (best.found, best.explained):
                best = found
            if best.found and best.explained >= search.is_enough:
                break
        best = self._nothing(predicted) if best is None else self._questioned(best, predicted)
        self._remember(best, predicted, measured is not None)
        return best

    def _questioned(self, location: Location, predicted: Pose | None) -> Location:
        """The location; not found if it is away from the prediction and fits worse than the last scan did."""
        if predicted is None or not location.found or location.explained >= _SURE * self._explained:
            return location
        pose = Pose.from_matrix(location.pose).shifted(-self._center)
        if float(alignment.differences(pose[None], predicted[None], self.distance, self.angle)) <= 1:
            return location
        doubt = (
            f"{location.explained:.0%} of the points lie on surfaces, fewer than in the last scan, and the "
            "pose is not where it was expected"
        )
        return replace(location, doubts=(doubt,))

    def _predicted(self, measured: Pose | None) -> Pose | None:
        step = self._motion if measured is None else measured
        return self._last if self._last is None or step is None else self._last @ step

    def _searches(
        self, cloud: Tensor, rows: Tensor, predicted: Pose | None, is_measured: bool
    ) -> Iterator[_Search]:
        """The cheapest search first."""
        if predicted is not None:
            start, usual = predicted[None], _USUAL * self._explained
            if self.n_lost == 0 and (is_measured or self._motion is not None):
                yield _Search(_FINE, start, usual)
            yield _Search(_FINE, alignment.around(start, self.distance, self.angle, _BLURS[_FINE]), usual)
            wide = _WIDER * self.distance, min(_WIDER * self.angle, math.pi)
            yield _Search(0, alignment.around(start, *wide, _BLURS[0]))
        if len(self._places) and (predicted is None or self.n_lost >= _GLOBAL_AFTER):
            if self._raster is None:
                axes, targets = self._tilts(cloud)
                for n_axes, n_climbed in (_LIKELY, _CLIMBED), (len(axes), _MORE_CLIMBED):
                    turned = axes[:n_axes], targets[:n_axes]
                    yield _Search(0, alignment.everywhere(self._places, _BLURS[0], *turned), 0.0, n_climbed)
            else:  # from the last level that blurs more than a cell of the raster
                first = max(sum(blur >= self._raster.cell for blur in _BLURS) - 1, 0)
                yield _Search(first, self._raster.anywhere(rows, _RASTERED)[0])

    def _tilts(self, cloud: Tensor) -> tuple[Tensor, Tensor]:
        """Axes (A, 3) of the sensor, and the axis (A, 3) of the map to which each may be turned. The first
        `_LIKELY` are those of a sensor that is held about upright.

        Most of the flat area of a scan is parallel to most of that of the map, or perpendicular to it.
        """
        up = self._center.new_tensor([0.0, 0.0, 1.0])
        main = up if self._main is None else self._main * (1 - 2 * (self._main[2] < 0))
        ones = torch.ones(len(cloud)).to(cloud)
        pieces, _ = surface_pieces(cloud - cloud.mean(0), ones, _NOISE, _NOISE**2)
        axes = alignment.main_normals(pieces)
        axes = torch.cat([axes, -axes])
        axes = axes[axes[:, 2].argsort(descending=True)]
        return torch.cat([up[None], axes]), torch.cat([up[None], main.expand(len(axes), 3)])

    @functools.cached_property
    def _main(self) -> Tensor | None:
        """The normal (3,) of most of the map's flat area; None if there is no such area."""
        return next(iter(alignment.main_normals(self._mixture, 1)), None)

    @functools.cached_property
    def _raster(self) -> PoseSearch | None:
        """The search of the whole map in 2D, whose raster knows its free space."""
        if self.dim == 3 or self._seen is None:
            return None
        return PoseSearch.of_map(self._seen, self._center)

    def _climbed(self, rows: Tensor, search: _Search) -> Location:
        """The location that the levels from the first one on reach from the best of the starts."""
        first, starts, _, most = search
        motions = self._ranked(rows, starts, self._targets[first], most)
        n_starts, are_all = len(motions), len(motions) == len(starts)
        for number, target in enumerate(self._targets[first:]):
            if number == _SECOND_CHANCE and not are_all:
                motions = Pose.cat([motions, self._ranked(rows, starts, target, most)])
            is_last = target is self._targets[-1]
            used = rows if is_last else rows[: max(_RANKING_POINTS, int(_COARSE_SHARE * len(rows)))]
            found = alignment.align(
                used, target, motions, _STEPS if is_last or number == 0 else _BETWEEN_STEPS
            )
            order = alignment.best_distinct(found.motions, found.evidence, target.blur * _SAME)
            found = found.at(order[: max(2, n_starts >> number)])
            motions = found.motions
        return self._location(rows, found, is_tracked=len(starts) == 1)

    def _ranked(self, rows: Tensor, starts: Pose, target: AlignmentTarget, most: int) -> Pose:
        """The best starts that differ from each other, at most `most`; all of them if they are few."""
        if len(starts) > 10 * _RANKED:
            score = target.scores(rows[:_GLIMPSE_POINTS], starts)
            starts = starts[score.topk(len(score) // 5).indices]
        n = len(starts)
        if n <= _RASTERED:
            return starts
        score = target.scores(rows[:_RANKING_POINTS], starts)
        order = score.argsort(descending=True, stable=True)
        if n > _RANKED:
            best = order[:_RANKED]
            order = best[alignment.best_distinct(starts[best], score[best], 1.01 * target.blur)]
        return starts[order[:most]]

    def _location(self, rows: Tensor, found: Alignment, is_tracked: bool) -> Location:
        covariance, deviation = pose_covariance(found.information[0], rows)
        share, loosest, doubts = float(found.explained[0]), float(deviation), []
        if not bool(found.converged[0]):
            doubts.append("the last step was longer than the tolerance")
        if share < self.least_explained:
            doubts.append(f"only {share:.0%} of the points lie on surfaces: another place, or a changed one")
        if loosest > _LOOSEST:
            doubts.append(f"the surfaces leave a direction open: a standard deviation of {loosest:.2g} m")
        other = alignment.differences(found.motions, found.motions, _APART, _APART)[0] > 1
        lead = (found.evidence[0] - found.evidence) * len(rows) / CORRELATED
        if bool((other & (lead <= _ALIKE)).any()):
            doubts.append("another pose explains the scan as well")
        if len(rows) < _FEWEST:
            doubts.append(f"the scan has only {len(rows)} points beyond {_NEAREST} m: is the sensor covered?")
        pose = found.motions[0].shifted(self._center)
        if not doubts and not is_tracked and self._map is not None:
            in_free_space, through = self._contradicted(self._map, rows[:_RANKING_POINTS], pose)
            if in_free_space + through > _MOST_CONTRADICTED * (1 - self.least_explained):
                doubts.append(
                    f"{in_free_space:.0%} of the points lie where the map saw free space, and {through:.0%} "
                    "of the beams pass through its surfaces"
                )
        return Location(pose.matrix, covariance, share, tuple(doubts))

    def _contradicted(self, known: GaussianMap, rows: Tensor, pose: Pose) -> tuple[float, float]:
        """Shares of the points in free space of the map, and of the beams that pass through a surface."""
        beams = free_segments(torch.zeros_like(rows[:_BEAMS]), rows[:_BEAMS])[:, 1]
        parts = torch.linspace(0, 1, _BEAM_POINTS + 1).to(rows)[1:, None]
        asked = pose.apply(torch.cat([rows, (parts * beams[:, None]).flatten(0, 1)]))
        at_ends, on_beams = torch.as_tensor(known.occupancy(asked, _CELL)).tensor_split([len(rows)])
        through = (on_beams.view(len(beams), -1) > _OCCUPIED).any(1)
        return float((at_ends < _FREE).double().mean()), float(through.double().mean())

    def _nothing(self, predicted: Pose | None) -> Location:
        """The prediction, for a scan without points."""
        pose = Pose.identity(self.dim, device=self._center.device) if predicted is None else predicted
        covariance = UNSEEN**2 * torch.eye(self.dim * (self.dim + 1) // 2).to(self._center)
        doubt = f"the scan has no points beyond {_NEAREST} m"
        return Location(pose.shifted(self._center).matrix, covariance, 0.0, (doubt,))

    def _remember(self, location: Location, predicted: Pose | None, is_measured: bool) -> None:
        if not location.found:
            self.n_lost += 1
            self._last, self._motion = predicted if is_measured else self._last, None
            return
        now, last = Pose.from_matrix(location.pose).shifted(-self._center), self._last
        is_next = last is not None and self.n_lost == 0 and self._explained > 0
        self._motion = last.inverse() @ now if last is not None and is_next else None
        self._last, self.n_lost, self._explained = now, 0, location.explained


def _places(surfaces: Components, center: Tensor) -> Tensor:
    """Places (S, D) from which the map was seen, one in each cell of `_PLACES` metres, about `center`."""
    origins = surfaces.origins.to(center) - center
    cells, member = torch.unique((origins / _PLACES).round(), dim=0, return_inverse=True)
    first = torch.full((len(cells),), len(origins), device=center.device)
    return origins[first.scatter_reduce(0, member, torch.arange(len(origins)).to(member), "amin")]


class ScanLocation(NamedTuple):
    """number: of the scan. time: seconds, or the number if the data set has no times. location: in the map.
    seconds: computing time of the tracker.
    """

    number: int
    time: float
    location: Location
    seconds: float


def locate_scans(
    dataset: Dataset, tracker: Tracker, use_motion: bool = False, turns: Tensor | None = None
) -> Iterator[ScanLocation]:
    """Localises every scan in order. A scan that cannot be read is not found, and its doubt is the reason.

    Args:
        dataset: its poses serve only to move its scans to the frame of the sensor.
        tracker: with the first pose, if it is known.
        use_motion: predict each pose with the motion between the poses of the data set, such as an
            odometry's. False: the sensor moves as between the last two scans.
        turns: rotations (N, D, D) of the sensor since the scan before, as `Dataset.turns` returns them, which
            predict the headings instead; NaN where they are unknown.

    Raises `InvalidArgumentError` if scans and map have different dimensions.
    """
    dataset.check_one_sensor("localization")
    times = scan_times(dataset)
    before: Tensor | None = None
    for index in range(len(dataset)):
        points, failure = torch.zeros(0, tracker.dim), ""
        pose = dataset.pose(index)
        try:
            scan = dataset[index]
            turn = torch.eye(scan.dim).double() if pose is None else pose.double()[:-1, :-1]
            points = scan.transformed(Pose(turn, scan.origin.double()).inverse().matrix).points
        except DataError as error:
            failure = str(error)
        motion = None
        if use_motion and pose is not None and before is not None:
            motion = (Pose.from_matrix(before).inverse() @ Pose.from_matrix(pose)).matrix
        if turns is not None and index and bool(turns[index].isfinite().all()):
            motion = turns[index]
        begin = time.process_time()
        location = tracker.locate(points, motion)
        seconds = time.process_time() - begin
        if failure:
            location = replace(location, doubts=(failure,))
        yield ScanLocation(index, float(times[index]), location, seconds)
        before = pose


def scan_times(dataset: Dataset) -> Tensor:
    """Times (N,) of the scans, seconds; their indices if the data set has none."""
    return torch.arange(len(dataset)).double() if dataset.times is None else dataset.times.double()


def clock_faults(times: Tensor) -> list[tuple[int, str]]:
    """Scans before which the clock goes back or jumps, with a sentence for each. times: (N,), seconds."""
    steps = times.diff()
    if len(steps) < 2:
        return []
    usual = float(steps[steps > 0].median()) if bool((steps > 0).any()) else 0.0
    faults = ((steps < 0) | (steps > _GAP * usual)).nonzero()[:, 0] + 1
    found = []
    for scan in faults.tolist():
        step = float(steps[scan - 1])
        fault = (
            f"{step:.3g} s after the scan before it, usually {usual:.2g} s: scans are missing, or the clock "
            "jumps"
        )
        if step < 0:
            fault = (
                f"the clock goes back by {-step:.3g} s; readers of the trajectory drop the poses of one "
                "side: correct the times of the recording (a bag: clock=received)"
            )
        found.append((scan, fault))
    return found

"""PoseSearch: the poses in which a 2D scan may lie in a map, among all within a reach, by branch and bound.

A raster of the map gives each cell the log-likelihood of a return: high at surfaces, low in free space, and
between where nothing was seen. The score of a pose is the sum over the scan's points. Of a square of poses
with one heading, 2ˡ cells wide, the sum over a raster of maxima, each of the 2ˡ × 2ˡ cells from its own on,
is an upper bound (Olson 2009; Hess et al. 2016). Squares that may hold a pose as good as the best one so far,
less a margin, are divided. All squares of a level are scored in one launch.
"""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.kernels import Prior, count_in_grid, fused_bounds, is_fused, raster_sums
from gmmtorch.localization.alignment import distinct
from gmmtorch.mapping import Components
from gmmtorch.pose import Pose

CORRELATED = 10.0
"""Points that share one error, that of their component (measured on a hall and an office)."""

HIT, UNKNOWN, FREE = 8.0, 4.0, -8.0
"""Nats of a point on a surface, where nothing was seen, and in free space."""

_CELLS, _CELLS_ANYWHERE = 1 << 18, 1 << 20  # of a raster at most, and of that of a whole map
_FINEST = 0.1  # metres of a cell
_BLUR = 1.5  # cells of standard deviation of a surface
_ROUNDING = 1e-6  # radians
_TAIL = 2.0  # nats: beyond, the prior falls as a power of the deviation
NEVER = 1e4
"""Nats against a pose that is farther from the expected poses than the sensor moves."""
_NEAR = 3  # cells from a surface: neither free nor unknown
_LEVELS = 5  # the largest squares are 16 cells wide
_MOST_SQUARES = 150  # of one heading
_TURNS = math.radians(0.7), math.radians(4)  # least and largest step between headings
_FAR = 0.8  # quantile of the ranges that a step between headings moves by a cell
_POINTS = 128  # of the scan
_KEPT, _KEPT_ANYWHERE = 3000, 20000  # squares of a level at most, near an expected pose and in a whole map
_REACH = 2.0  # standard deviations of a component that are a surface, along it
_BEAMS = (-0.4, -0.15, 0.15, 0.4)  # of this reach: where the beams end that saw a component
MARGIN = 0.25, 0.02
"""Metres, and share of the range, that a point may be in front of or behind a surface."""
_FIRST = 50  # best squares, which are divided first, for a score to compare with
_BELOW = 12.0  # nats below the best score that are kept: refinement may turn the order
WIDE = _KEPT_ANYWHERE, 30.0
"""Squares of a level, and nats below the best score, of a second search, which takes longer."""
_PLACES = 6  # times as many poses of different places, from which those that differ are chosen
_TOLD_APART = 0.3, math.radians(8)  # metres and radians between poses that are returned


class Expectation(NamedTuple):
    """Where a scan is expected: poses (B), world ← sensor; the standard deviations of the first one (m, rad);
    the share of its points that is usually explained; and the largest shift (m) and turn (rad) from the
    nearest of the poses."""

    poses: Pose
    distance: float
    angle: float
    explained: float
    max_step: float = 8.0
    max_turn: float = math.pi

    def unlikely(self, poses: Pose) -> Tensor:
        """Nats (N,) against poses, by their deviation from the nearest expected one."""
        turned = self.turned(poses.rotation)
        return self.against(torch.cdist(poses.translation, self.poses.translation), turned)

    def turned(self, rotation: Tensor) -> Tensor:
        """Turns (N, B), rad, from the expected poses."""
        chord = torch.cdist(rotation.flatten(1), self.poses.rotation.flatten(1)) / math.sqrt(2)
        return 2 * (chord / 2).clamp_max(1).asin()

    def against(self, shift: Tensor, turned: Tensor) -> Tensor:
        """Nats (N,) by shifts (N, B) and turns (N, B). Far from an expected pose the nats grow with the
        logarithm of the deviation: a robot that stops or turns does not follow any prediction."""
        is_near = (shift <= self.max_step) & (turned <= self.max_turn + _ROUNDING)
        square = (shift / self.distance).square() + (turned / self.angle).square()
        nats = _TAIL * torch.log1p(square.amin(1) / (2 * _TAIL))
        return nats + torch.where(is_near.any(1), 0.0, NEVER)


Found = tuple[Pose, Tensor]
"""Poses (B), world ← sensor, best first, and their scores (B,), nats."""


class _Tried(NamedTuple):
    """Of H headings: the turns (H,) from the last expected pose, the rotations (H, 2, 2), the cells (H, N, 2)
    of the points, and the turns (H, B) from the expected poses; and how many observations a point stands for.
    """

    expected: Expectation
    angles: Tensor
    turned: Tensor
    cells: Tensor
    off: Tensor
    share: float


class PoseSearch:
    """A raster of a 2D map, with its maxima.

    Args:
        points: (N, 2) on the surfaces, world frame, metres; at least one.
        free: (M, 2, 2) segments through free space; none: cells away from surfaces are unknown.
        cell: side (m) of a cell; it is larger where the raster would have more than `most` cells.
    """

    def __init__(
        self, points: Tensor, free: Tensor | None = None, cell: float | None = None, most: int = _CELLS
    ) -> None:
        low, high = points.amin(0), points.amax(0)
        side = _FINEST if cell is None else cell
        while (volume := math.prod(((high - low) / side + 1).tolist())) > most:
            side *= 1.01 * (volume / most) ** 0.5
        self.cell = side
        margin = 1 << _LEVELS
        self._low = (low / side).floor() - margin
        shape = ((high / side).floor() + margin + 1 - self._low).long().tolist()
        hits = points.new_zeros(shape, dtype=torch.float32)
        hits[((points / side).floor() - self._low).long().unbind(1)] = 1.0
        shade = hits
        for axis in (0, 1):  # the margin has no hits, so nothing comes in from the other end
            near = (
                math.exp(-0.5 * (shift / _BLUR) ** 2) * shade.roll(shift, axis)
                for shift in range(-_NEAR, _NEAR + 1)
            )
            shade = functools.reduce(torch.maximum, near)
        raster = torch.where(shade > 0, HIT * shade, UNKNOWN)
        if free is not None and len(free):
            misses = torch.zeros(math.prod(shape), dtype=torch.float64, device=points.device)
            starts, ends = (free.double() / side).unbind(1)
            count_in_grid(misses, starts, ends, tuple(shape), low=self._low)
            crossed = (misses > 0).view(shape)
            raster = torch.where(crossed & (shade == 0), FREE, raster)
        levels = [raster]
        for level in range(_LEVELS - 1):
            step = 1 << level
            wide = torch.nn.functional.pad(levels[-1], (0, step, 0, step), value=UNKNOWN)
            wide = torch.maximum(wide[:-step], wide[step:])
            levels.append(torch.maximum(wide[:, :-step], wide[:, step:]))
        self._levels = [_in_parts(one, 1 << level) for level, one in enumerate(levels)]

    @classmethod
    def of_map(cls, components: Components, center: Tensor) -> PoseSearch:
        """The search of a whole map in 2D, whose poses are about `center` (2,)."""
        variances, axes = torch.linalg.eigh(components.covariances.double())
        half = _REACH * variances[:, 1].clamp_min(0).sqrt()
        means, along = components.means.double() - center, half[:, None] * axes[:, :, 1]
        n_points = torch.where(components.max_range, 0, (2 * half / _FINEST).long() + 1)
        component = torch.repeat_interleave(n_points)
        place = torch.arange(len(component)).to(component) - (n_points.cumsum(0) - n_points)[component]
        offset = (2 * place + 1) / n_points[component] - 1  # from −1 to 1 along the component
        by, parts = components.seen_by, torch.tensor(_BEAMS).to(means)
        ends = (means[by] + parts[:, None, None] * along[by]).flatten(0, 1)
        origins = (components.origins.double()[components.seen_from] - center).repeat(len(parts), 1)
        free = free_segments(origins, ends, components.max_range[by].repeat(len(parts)))
        return cls(means[component] + offset[:, None] * along[component], free, most=_CELLS_ANYWHERE)

    def anywhere(self, points: Tensor, most: int) -> Found:
        """The best poses in the whole raster that differ, at most `most`; arguments as of `best`."""
        size = self._levels[0].shape[2:]
        middle = self.cell * (self._low + torch.tensor(size).to(self._low) / 2)
        level = Pose(torch.eye(2).to(middle)[None], middle[None])
        reach = self.cell * max(size) / math.sqrt(2)
        unknown = Expectation(level, math.inf, math.inf, 1.0, reach)
        return self.best(points, unknown, most, _KEPT_ANYWHERE)

    def best(
        self, points: Tensor, expected: Expectation, most: int, kept: int = _KEPT, below: float = _BELOW
    ) -> Found:
        """The best poses that differ, at most `most`, as far from the last expected pose as a scan can be.

        Args:
            points: (N, 2) of the scan, sensor frame, in random order; the first ones are used.
            kept: squares of a level, at most, which are divided. below: nats below the best score, to which
                they are.
        """
        tried = self._tried(points.double(), expected)
        level = self._first_level(expected.max_step)
        width = 1 << level
        n = math.ceil(expected.max_step / self.cell / width)
        side = torch.arange(-n, n + 1)
        flat = torch.cartesian_prod(side, side).to(tried.cells)
        n_turns = len(tried.angles)
        heading = torch.arange(n_turns, device=flat.device).repeat_interleave(len(flat))
        shift = flat.repeat(n_turns, 1)
        bound = self._scored(tried, heading, shift, level)
        first = _largest(bound, _FIRST)
        some, at, dived = heading[first], shift[first], bound[first]
        for finer in range(level - 1, -1, -1):
            some, at = _divided(some, at)
            score = self._scored(tried, some, at, finer)
            best = _largest(score, _FIRST)
            some, at, dived = some[best], at[best], score[best]
        least = float(dived.max())
        for finer in range(level - 1, -1, -1):
            rows = _most(bound, least - below, kept)
            heading, shift = _divided(heading[rows], shift[rows])
            bound = self._scored(tried, heading, shift, finer)
        # Where more squares than `kept` may hold a better pose, the first ones may not be among them.
        heading, shift, bound = torch.cat([heading, some]), torch.cat([shift, at]), torch.cat([bound, dived])
        rows = _most(bound, float(bound.max()) - below, kept)
        return self._told_apart(tried, heading[rows], shift[rows], bound[rows], most)

    def _tried(self, points: Tensor, expected: Expectation) -> _Tried:
        """The headings of a search, with a step that moves most of the points by a cell."""
        rows = self._spread_out(points)[:_POINTS]
        ranges = rows.norm(dim=1).quantile(_FAR).clamp_min(1e-3)
        step = min(max(self.cell / float(ranges), _TURNS[0]), _TURNS[1])
        n_turns = min(math.ceil(expected.max_turn / step), round(math.pi / step))
        angles = torch.arange(-n_turns, n_turns + 1).to(rows) * step
        center = expected.poses[-1]
        turned = Pose.from_yaw(angles, rows.new_zeros(2)).rotation @ center.rotation
        placed = (rows @ turned.mT + center.translation) / self.cell
        cells = (placed.floor() - self._low).long()
        off = expected.turned(turned)
        return _Tried(expected, angles, turned, cells, off, len(points) / len(rows) / CORRELATED)

    def _scored(self, tried: _Tried, heading: Tensor, shift: Tensor, level: int) -> Tensor:
        """Upper bounds (S,) of the scores in squares of poses, nats; the scores themselves on level 0.

        heading: (S,), in rising order. shift: (S, 2), in widths of a square of this level.
        """
        expected = tried.expected
        places = expected.poses.translation
        if is_fused(tried.cells, places, tried.off):
            prior = Prior(
                places.contiguous(), tried.off.contiguous(), len(places), tried.share, self.cell,
                expected.distance, expected.angle, expected.max_step, expected.max_turn + _ROUNDING,
                _TAIL, NEVER,
            )  # fmt: skip
            return fused_bounds(tried.cells, heading, shift, self._levels[level], UNKNOWN, prior)
        sums = raster_sums(tried.cells, heading, shift, self._levels[level], UNKNOWN)
        width = 1 << level
        away = (width - 1) * self.cell / math.sqrt(2)
        middles = self._middle(tried, shift, width)
        gap = (torch.cdist(middles, places) - away).clamp_min(0)
        return tried.share * sums - expected.against(gap, tried.off[heading])

    def _middle(self, tried: _Tried, shift: Tensor, width: int) -> Tensor:
        """The middle (S, 2) of squares, metres."""
        cells = width * shift.double() + (width - 1) / 2
        return tried.expected.poses[-1].translation + cells * self.cell

    def _told_apart(self, tried: _Tried, heading: Tensor, shift: Tensor, score: Tensor, most: int) -> Found:
        """The best poses that differ, at most `most`."""
        order = score.argsort(descending=True, stable=True)
        # Of neighbours the first one, in two passes: comparing all pairs would take longer than the search.
        places = torch.cat([tried.angles[heading[order], None] / _TOLD_APART[1],
                            shift[order] * (self.cell / _TOLD_APART[0])], 1)  # fmt: skip
        order = order[_firsts(places.floor())][: _PLACES * most]
        found = Pose(tried.turned[heading[order]], self._middle(tried, shift[order], 1))
        chosen = distinct(found, *_TOLD_APART)[:most]
        return found[chosen], score[order[chosen]]

    def _spread_out(self, points: Tensor) -> Tensor:
        """The first point of each cell, in their order: near the sensor, points are dense and tell little."""
        return points[_firsts((points / self.cell).floor())]

    def _first_level(self, reach: float) -> int:
        """The level whose squares are few."""
        for level in range(_LEVELS - 1):
            if (2 * math.ceil(reach / self.cell / (1 << level)) + 1) ** 2 <= _MOST_SQUARES:
                return level
        return _LEVELS - 1


def _firsts(rows: Tensor) -> Tensor:
    """Numbers of the rows (N, D) of whole numbers that are the first of their kind, in rising order."""
    keys = rows.new_zeros(len(rows))
    for column in rows.unbind(1):
        low, high = column.aminmax()
        keys = keys * (high - low + 1) + column - low
    kinds, kind = torch.unique(keys, return_inverse=True)
    number = torch.arange(len(rows), device=rows.device)
    first = number.new_full((len(kinds),), len(rows))
    return first.scatter_reduce(0, kind, number, "amin").sort().values


def _most(bound: Tensor, least: float, most: int) -> Tensor:
    """Rows of the bounds above `least`, but of the `most` largest only; in rising order."""
    kept = (bound >= least).nonzero()[:, 0]
    return kept if len(kept) <= most else kept[_largest(bound[kept], most)]


def _largest(bound: Tensor, most: int) -> Tensor:
    """Rows of the `most` largest bounds, in rising order."""
    return bound.topk(min(most, len(bound))).indices.sort().values


def free_segments(origins: Tensor, ends: Tensor, is_empty: Tensor | None = None) -> Tensor:
    """The segments (B, 2, D) of free space from origins to the ends of beams (B, D): the part of each before
    the margin of its surface, but all of a beam that `is_empty` (B,), because it met no surface."""
    beams = ends - origins
    ranges = beams.norm(dim=1, keepdim=True).clamp_min(1e-9)
    part = (1 - MARGIN[0] / ranges - MARGIN[1]).clamp_min(0)
    if is_empty is not None:
        part = torch.where(is_empty[:, None], 1.0, part)
    return torch.stack([origins, origins + part * beams], 1)


def _divided(heading: Tensor, shift: Tensor) -> tuple[Tensor, Tensor]:
    """The four squares of the next level in each square."""
    parts = torch.tensor([[0, 0], [0, 1], [1, 0], [1, 1]], device=shift.device)
    return heading.repeat_interleave(4), (2 * shift[:, None] + parts).flatten(0, 1)


def _in_parts(raster: Tensor, width: int) -> Tensor:
    """A raster as `raster_sums` takes it: neighbours in a part are `width` cells apart."""
    more = [-size % width for size in raster.shape]
    wide = torch.nn.functional.pad(raster, (0, more[1], 0, more[0]), value=UNKNOWN)
    return wide.unflatten(1, (-1, width)).unflatten(0, (-1, width)).permute(1, 3, 0, 2).contiguous()

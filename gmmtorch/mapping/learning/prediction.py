"""Predict, then learn: what a map says about a window's beams before it learns from them.

The predictions calibrate the map, see `occupancy.calibrator`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from gmmtorch.mapping.components import Components
from gmmtorch.mapping.learning.depth_frame import DepthFrame
from gmmtorch.mapping.query import MANY_POINTS, cutoff_of
from gmmtorch.occupancy import Calibrator, Cones, PointEvidence, Prediction, listed_points, spectrum_of
from gmmtorch.scan import Scan

SIDES = (0.02, 0.1, 0.4)
"""Sides (m) of the cubes for which a map predicts."""

_BEAMS = 12  # of a window, from one scan, whose neighbourhood few components reach
_PREDICTING = 3.5, 8e-4  # ms of a prediction, and of each pair of a point and a cone, on one core
_LEARNING, _MOST = (20.0, 5e-4), 200_000  # ms of a window, and of each of its points, at most so many
_SHARE = 0.04  # of the time of learning that predictions take


def predicted(
    known: Components, window: Sequence[Scan | DepthFrame], calibrator: Calibrator | None, number: int
) -> Calibrator | None:
    """What is known about the calibration after a map has predicted the beams of a window.

    Of each chosen beam, its end is occupied and a point drawn uniformly from the rest is free. Points without
    evidence are left out, and those with less than half of the others: they lie where the map has only begun,
    and later it is asked mostly about places that it knows well.

    Args:
        known: the components before the window.
        calibrator: before the window; None: the ranges of the window give one.
        number: of the window; chooses the beams, and the side of the cubes.
    """
    if calibrator is not None and number < calibrator.next_window:
        return calibrator
    generator = torch.Generator().manual_seed(number)
    origins, ends = _beams(window, generator)
    if not len(ends):
        return calibrator
    if calibrator is None:
        calibrator = Calibrator.of(_mean_range(window), len(SIDES))
    if not len(known):
        return calibrator
    share = torch.rand(len(ends), 1, generator=generator, dtype=torch.float64).to(ends.device)
    points = torch.cat([ends, origins + share * (ends - origins)])
    occupied = torch.arange(len(points), device=points.device) < len(ends)
    predictions = []
    evidence, n_pairs = few_points(known, points, SIDES)
    for side, (hits, misses) in zip(SIDES, evidence, strict=True):
        seen = hits * (calibrator.length / side) + misses
        kept = (seen >= seen.median()) & (seen > 0)
        predictions.append(Prediction(hits[kept], misses[kept], occupied[kept], side))
    due = number + _windows_between(n_pairs, sum(map(_size, window)))
    return replace(calibrator.updated(predictions, known.dim), next_window=due)


def _windows_between(n_pairs: int, n_points: int) -> int:
    """Windows from one prediction to the next, so that predictions take a small share of the time."""
    predicting = _PREDICTING[0] + _PREDICTING[1] * n_pairs
    learning = _LEARNING[0] + _LEARNING[1] * min(n_points, _MOST)
    return max(1, round(predicting / (_SHARE * learning)))


def _size(scan: Scan | DepthFrame) -> int:
    """Number of points, or of pixels."""
    return scan.depth.numel() if isinstance(scan, DepthFrame) else len(scan.points)


def _mean_range(window: Sequence[Scan | DepthFrame]) -> float:
    """Mean range (m) of the returns of a window that has some."""
    ranges = torch.cat([(scan.points - scan.origin).norm(dim=1).double() for scan in window])
    return float(ranges.mean())


def _beams(window: Sequence[Scan | DepthFrame], generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Origins and ends (B, D) of some returns of a scan of a window, float64."""
    scan = window[int(torch.randint(len(window), (1,), generator=generator))]
    points = scan.points
    if len(points):
        points = points[torch.randint(len(points), (_BEAMS,), generator=generator).to(points.device)]
    return scan.origin.double().expand_as(points), points.double()


def few_points(known: Components, points: Tensor, sides: Sequence[float]) -> tuple[list[PointEvidence], int]:
    """Evidence (M,) of cubes of several sides (m) at a few points (M, D), without an index; and the number of
    pairs of a point and a cone that it takes."""
    cutoff = cutoff_of(len(known.seen_count), int((known.seen_count >= MANY_POINTS).sum()))
    point, view = _near(known, points, max(sides), cutoff)
    used, cone = torch.unique(view, return_inverse=True)
    by = known.seen_by[used]
    component, number = torch.unique(by, return_inverse=True)
    origins = known.origins[known.seen_from[used]]
    cones = Cones(
        known.means[by], known.covariances[by], origins, known.seen_count[used], known.max_range[by]
    )
    axes = spectrum_of(known.covariances[component])[1][number]
    return listed_points(cones, axes, points, (point, cone), sides, cutoff), len(point)


def _near(known: Components, points: Tensor, side: float, cutoff: float) -> tuple[Tensor, Tensor]:
    """Pairs of a point (P,) and a viewpoint (P,) whose cone may give evidence to the cube at the point.

    First by boxes around the cones, then by balls around the components. Both keep every pair with evidence.
    """
    widest = side * max(0.5 * known.dim**0.5, cutoff / 12**0.5)
    extent = cutoff * known.covariances.diagonal(dim1=1, dim2=2).sqrt()
    by, origins = known.seen_by, known.origins[known.seen_from]
    low = torch.minimum((known.means - extent)[by], origins) - widest
    high = torch.maximum((known.means + extent)[by], origins) + widest
    view = ((low <= points.amax(0)) & (high >= points.amin(0))).all(1).nonzero().squeeze(1)
    low, high = low[view], high[view]
    met = (points[:, :1] >= low[:, 0]) & (points[:, :1] <= high[:, 0])
    for axis in range(1, known.dim):
        met &= points[:, axis, None] >= low[:, axis]
        met &= points[:, axis, None] <= high[:, axis]
    point, row = met.nonzero(as_tuple=True)
    view = view[row]
    ray, offset = points[point] - origins[view], points[point] - known.means[by[view]]
    square = (ray * ray).sum(1).clamp_min(1e-12)
    along = (ray * offset).sum(1)
    distance = (offset - ray).square().sum(1)
    # The cube seen from a sensor at range r is as wide as widest · distance / r at the component.
    ball = extent.norm(dim=1)[by[view]] + widest * (distance / square).clamp_min(1).sqrt()
    close = (offset * offset).sum(1) * square - along * along <= 1.001 * ball * ball * square
    close = (close & ((along <= 0) | (along * along <= 1.001 * ball * ball * square))) | (
        square <= widest * widest
    )
    return point[close], view[close]

"""Labelled samples as la3dm takes them: one hit and one free sample for each small cube at most.

Doherty, Wang & Englot 2017 ("Bayesian generalized kernel inference for occupancy map prediction") and
Wang & Englot 2016 ("Fast, accurate Gaussian process occupancy maps via test-data octrees and nested
Bayesian fusion") thin a scan's returns to the centroids of cubes of side `ds_resolution`, put free
samples every `free_resolution` on the way to each, and thin these likewise.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, MemoryLimitError
from gmmtorch.scan import Scan

_MAX_SAMPLES = 1 << 27


def check_length(name: str, value: float) -> float:
    """A length (m) as a float; raises `InvalidArgumentError` unless it is finite and above zero."""
    if not isinstance(value, int | float) or not (math.isfinite(value) and value > 0):
        raise InvalidArgumentError(f"{name}={value!r} must be a finite length above zero, in metres.")
    return float(value)


def check_range(max_range: float | None) -> float | None:
    """The largest range (m), None for no limit; raises `InvalidArgumentError` unless above zero."""
    return None if max_range is None else check_length("max_range", max_range)


def thinned_samples(
    scan: Scan, free_resolution: float, ds_resolution: float, max_range: float | None = None
) -> tuple[Tensor, Tensor]:
    """Samples (S, D), float64, of where the scan's beams ended and passed, and which are hits (S,).

    Free samples are at the sensor, at every multiple of `free_resolution` (m) before the end, and at
    `free_resolution` before it. A beam without return has one at its end too. Hits beyond `max_range`
    (m) are dropped with their beams, as the authors do; beams without return are cut there.
    Raises `MemoryLimitError` when there would be too many.
    """
    origin = scan.origin.double()
    hits = centroids(scan.points.double(), ds_resolution)
    empty = centroids(scan.no_return.double(), ds_resolution)
    if max_range is not None:
        hits = hits[(hits - origin).norm(dim=1) <= max_range]
        length = (empty - origin).norm(dim=1, keepdim=True)
        empty = origin + (empty - origin) * (max_range / length.clamp_min(max_range))
    ends = torch.cat([hits, empty])
    free = torch.cat([_on_the_way(origin, ends, free_resolution), empty])
    free = centroids(torch.cat([origin[None], free]), ds_resolution) if ends.shape[0] else free
    is_hit = torch.zeros(hits.shape[0] + free.shape[0], dtype=torch.bool, device=free.device)
    is_hit[: hits.shape[0]] = True
    return torch.cat([hits, free]), is_hit


def _on_the_way(origin: Tensor, ends: Tensor, step: float) -> Tensor:
    """Points at every multiple of `step` before each end (B, D), and at `step` before it."""
    length = (ends - origin).norm(dim=1)
    count = (length / step).ceil().sub(1).clamp_min(0)
    if float(count.sum()) > _MAX_SAMPLES:
        raise MemoryLimitError(
            f"free_resolution={step} m makes {int(count.sum()):,} free samples of one scan, above the limit "
            f"of {_MAX_SAMPLES:,}; take a coarser one, or set max_range."
        )
    count = count.long()
    beam = torch.repeat_interleave(count)
    number = torch.arange(beam.shape[0], device=beam.device) - (torch.cumsum(count, 0) - count)[beam] + 1
    last = (length > step).nonzero().squeeze(1)
    share = torch.cat([number * step / length[beam], 1 - step / length[last]])
    return origin + (ends - origin)[torch.cat([beam, last])] * share[:, None]


def centroids(points: Tensor, side: float) -> Tensor:
    """Mean (C, D) of the points (N, D) in each cube [i·side, (i+1)·side) that holds any."""
    if points.shape[0] == 0:
        return points
    cells = (points / side).floor()
    low = cells.amin(0)
    shape = (cells.amax(0) - low + 1).tolist()
    if math.prod(shape) < 2**62:
        key = torch.zeros(points.shape[0], dtype=torch.int64, device=points.device)
        for axis, size in enumerate(shape):
            key = key * int(size) + (cells[:, axis] - low[axis]).long()
        unique, cube = torch.unique(key, return_inverse=True)
        n_cubes = unique.shape[0]
    else:
        rows, cube = torch.unique(cells, dim=0, return_inverse=True)
        n_cubes = rows.shape[0]
    # Relative to the first point, so that sums far from the origin keep their digits.
    total = points.new_zeros(n_cubes, points.shape[1]).index_add_(0, cube, points - points[0])
    return points[0] + total / torch.bincount(cube, minlength=n_cubes)[:, None]

"""Labelled points from range beams, which regression maps learn from: hits, and free points along the beams.

`beam_samples` places free points as Hilbert maps do. `thinned_samples` places them as la3dm does and
thins them.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gmmtorch.errors import MemoryLimitError
from gmmtorch.linalg import ragged_index
from gmmtorch.scan import Scan

_MAX_SAMPLES = 1 << 27


def beam_samples(
    scan: Scan, spacing: float, *, generator: torch.Generator, gap: float = 0.0, thin: float | None = None
) -> tuple[Tensor, Tensor]:
    """Points (S, D), float64, on the beams of a scan, and whether each (S,) is a hit; hits come first.

    The free part of a beam is the whole beam, without the last `gap` metres if it has a return. It is divided
    into equal segments of at most `spacing`, with one free point in each, at a uniformly random position
    (Ramos & Ott 2016; Senanayake & Ramos 2017). A beam without return gives free points only. A beam of zero
    length gives no point. With `thin`, the beam ends in one cube of that side (m) are first replaced by their
    mean. The generator is on the CPU. Raises `MemoryLimitError` for too many points.
    """
    origin, hits, no_return = scan.origin.double(), scan.points.double(), scan.no_return.double()
    if thin is not None:
        hits, no_return = centroids(hits, thin), centroids(no_return, thin)
    beams = torch.cat([hits, no_return]) - origin
    length = beams.norm(dim=1)
    free_length = length.clone()
    free_length[: hits.shape[0]] -= gap
    count = torch.where(free_length > 0, (free_length / spacing).ceil().clamp_min(1), 0)
    if float(count.sum()) > _MAX_SAMPLES:
        raise MemoryLimitError(
            f"spacing={spacing} m makes {int(count.sum()):,} free points of one scan, above the limit of "
            f"{_MAX_SAMPLES:,}; increase spacing."
        )
    count = count.long()
    beam, segment = ragged_index(count)
    within = torch.rand(beam.shape[0], generator=generator, dtype=torch.float64)
    share = (segment + within.to(beam.device)) / count[beam] * (free_length / length)[beam]
    return _labelled(hits, origin + beams[beam] * share[:, None])


def thinned_samples(
    scan: Scan, free_resolution: float, ds_resolution: float, max_range: float | None = None
) -> tuple[Tensor, Tensor]:
    """Points (S, D), float64, on the beams of a scan, thinned, and whether each (S,) is a hit.

    Hits are replaced by their mean in each cube of side `ds_resolution` (m), and so are the free points:
    at the sensor, at every multiple of `free_resolution` (m) before a beam's end, and at
    `free_resolution` before the end. A beam without return also has a free point at its end. Hits beyond
    `max_range` (m) are dropped with their beams, as in la3dm; beams without return are cut there. Raises
    `MemoryLimitError` for too many points.

    Doherty, Wang & Englot 2017, "Bayesian generalized kernel inference for occupancy map prediction";
    Wang & Englot 2016, "Fast, accurate Gaussian process occupancy maps via test-data octrees and nested
    Bayesian fusion".
    """
    origin = scan.origin.double()
    hits = centroids(scan.points.double(), ds_resolution)
    no_return = centroids(scan.no_return.double(), ds_resolution)
    if max_range is not None:
        hits = hits[(hits - origin).norm(dim=1) <= max_range]
        no_return = cut_beams(origin, no_return, max_range)
    ends = torch.cat([hits, no_return])
    free = torch.cat([_points_along(origin, ends, free_resolution), no_return])
    free = centroids(torch.cat([origin[None], free]), ds_resolution) if ends.shape[0] else free
    return _labelled(hits, free)


def cut_beams(origin: Tensor, ends: Tensor, max_range: float) -> Tensor:
    """The ends (B, D) of beams from an origin; those beyond `max_range` are moved to that distance (m)."""
    length = (ends - origin).norm(dim=1, keepdim=True)
    return origin + (ends - origin) * (max_range / length.clamp_min(max_range))


def _labelled(hits: Tensor, free: Tensor) -> tuple[Tensor, Tensor]:
    is_hit = torch.zeros(hits.shape[0] + free.shape[0], dtype=torch.bool, device=free.device)
    is_hit[: hits.shape[0]] = True
    return torch.cat([hits, free]), is_hit


def _points_along(origin: Tensor, ends: Tensor, step: float) -> Tensor:
    """Points (P, D) at every multiple of `step` (m) before each end (B, D), and at `step` before the end."""
    length = (ends - origin).norm(dim=1)
    count = (length / step).ceil().sub(1).clamp_min(0)
    if float(count.sum()) > _MAX_SAMPLES:
        raise MemoryLimitError(
            f"free_resolution={step} m makes {int(count.sum()):,} free samples of one scan, above the limit "
            f"of {_MAX_SAMPLES:,}; increase it, or set max_range."
        )
    beam, before = ragged_index(count.long())
    number = before + 1
    last = (length > step).nonzero().squeeze(1)
    share = torch.cat([number * step / length[beam], 1 - step / length[last]])
    return origin + (ends - origin)[torch.cat([beam, last])] * share[:, None]


def centroids(points: Tensor, side: float) -> Tensor:
    """Mean (C, D) of the points (N, D) in each non-empty cube [i·side, (i+1)·side)."""
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
    # Relative to the first point, so that sums far from the origin stay exact.
    total = points.new_zeros(n_cubes, points.shape[1]).index_add_(0, cube, points - points[0])
    return points[0] + total / torch.bincount(cube, minlength=n_cubes)[:, None]

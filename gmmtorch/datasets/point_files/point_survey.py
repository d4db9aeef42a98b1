"""One pass over a source of points: what a fit must know before it begins."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gmmtorch.datasets.point_files.point_chunks import PointChunks, mix_bits, row_uniform

_CHECKSUM_BITS = 48  # so that sums of a few are whole numbers in float64, too


class Survey(NamedTuple):
    """What one pass over a source finds.

    n_points, n_dropped: valid and invalid rows; total (D,): sum of the points; low, high (D,): bounds (m;
    ±∞ if there is no point); checksum: of every coordinate and its row; sample (m, 2 + D): of at most
    the wanted number of points drawn, random number, row and coordinates, in the order of the rows.
    """

    n_points: int
    n_dropped: int
    total: Tensor
    low: Tensor
    high: Tensor
    checksum: int
    sample: Tensor

    @property
    def center(self) -> Tensor:
        """The mean of the points (D,)."""
        return self.total / self.n_points

    @property
    def points(self) -> Tensor:
        """The points drawn (m, D)."""
        return self.sample[:, 2:]


def survey(source: PointChunks, sample_points: int | None = None, seed: int = 0) -> Survey:
    """Count, bounds, sum, checksum and a uniform draw of at most `sample_points` points (None: all).

    A point is drawn for its row's random number, the smallest of all: so the draw does not depend on the
    chunks, nor on how the rows are shared among processes.
    """
    inf = torch.full((source.dim,), math.inf, dtype=torch.float64)
    found = Survey(0, 0, torch.zeros_like(inf), inf, -inf, 0, inf.new_empty(0, 2 + source.dim))
    kept = [found.sample]
    for points, rows, n_dropped in source:
        number = row_uniform(rows, seed)
        kept.append(torch.cat([number[:, None], rows.double()[:, None], points], 1))
        if sample_points is not None:
            kept = [smallest(torch.cat(kept), sample_points)]
        found = Survey(
            found.n_points + points.shape[0],
            found.n_dropped + n_dropped,
            found.total + points.sum(0),
            torch.cat([found.low[None], points]).amin(0),
            torch.cat([found.high[None], points]).amax(0),
            (found.checksum + _checksum(points, rows)) % (1 << _CHECKSUM_BITS),
            found.sample,
        )
    return found._replace(sample=torch.cat(kept))


def united(surveys: list[Survey], sample_points: int | None) -> Survey:
    """The survey of the rows of all of these, which are parts of one source in order."""
    sample = torch.cat([part.sample for part in surveys])
    return Survey(
        sum(part.n_points for part in surveys),
        sum(part.n_dropped for part in surveys),
        torch.stack([part.total for part in surveys]).sum(0),
        torch.stack([part.low for part in surveys]).amin(0),
        torch.stack([part.high for part in surveys]).amax(0),
        sum(part.checksum for part in surveys) % (1 << _CHECKSUM_BITS),
        sample if sample_points is None else smallest(sample, sample_points),
    )


def smallest(sample: Tensor, count: int) -> Tensor:
    """The `count` rows of the smallest first column, in the order they had."""
    if sample.shape[0] <= count:
        return sample
    order = sample[:, 0].argsort(stable=True)[:count]
    return sample[order.sort().values]


def _checksum(points: Tensor, rows: Tensor) -> int:
    bits = np.ascontiguousarray(points.numpy()).view(np.uint64)
    state = rows.numpy().astype(np.uint64)
    for axis in range(bits.shape[1]):
        state = mix_bits(state * np.uint64(0x9E3779B97F4A7C15) + bits[:, axis])
    return int((state >> np.uint64(64 - _CHECKSUM_BITS)).sum(dtype=np.uint64)) % (1 << _CHECKSUM_BITS)

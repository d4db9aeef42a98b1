"""Statistics of a point source from one pass, which a fit needs before it starts."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gmmtorch.datasets.point_files.point_chunks import PointChunks, mix_bits, row_uniform

_CHECKSUM_BITS = 48  # so that a sum of several checksums is exact in float64


class Survey(NamedTuple):
    """Statistics of a point source.

    n_points, n_dropped: numbers of valid and invalid rows. total: (D,) sum of the points.
    low, high: (D,) bounds (m); ±∞ without points. checksum: of all coordinates and their rows.
    sample: (m, 2 + D) randomly drawn points in row order: random number, row, coordinates.
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
        """Mean (D,) of the points."""
        return self.total / self.n_points

    @property
    def points(self) -> Tensor:
        """The sampled points (m, D)."""
        return self.sample[:, 2:]


def survey(source: PointChunks, sample_points: int | None = None, seed: int = 0) -> Survey:
    """The survey of a source, with a uniform sample of at most `sample_points` points (None: all).

    The sample consists of the points with the smallest random numbers of their rows. It does not depend on
    the chunk size or on the distribution of rows over processes.
    """
    inf = torch.full((source.dim,), math.inf, dtype=torch.float64)
    found = Survey(0, 0, torch.zeros_like(inf), inf, -inf, 0, inf.new_empty(0, 2 + source.dim))
    kept = [found.sample]
    for points, rows, n_dropped in source:
        number = row_uniform(rows, seed)
        kept.append(torch.cat([number[:, None], rows.double()[:, None], points], 1))
        if sample_points is not None:
            kept = [_smallest(torch.cat(kept), sample_points)]
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


def merge_surveys(surveys: list[Survey], sample_points: int | None) -> Survey:
    """The survey of a whole source from the surveys of its shards, in order."""
    sample = torch.cat([shard.sample for shard in surveys])
    return Survey(
        sum(shard.n_points for shard in surveys),
        sum(shard.n_dropped for shard in surveys),
        torch.stack([shard.total for shard in surveys]).sum(0),
        torch.stack([shard.low for shard in surveys]).amin(0),
        torch.stack([shard.high for shard in surveys]).amax(0),
        sum(shard.checksum for shard in surveys) % (1 << _CHECKSUM_BITS),
        sample if sample_points is None else _smallest(sample, sample_points),
    )


def _smallest(sample: Tensor, count: int) -> Tensor:
    """The `count` rows with the smallest values in the first column, in their original order."""
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

"""Point clouds larger than memory, read in chunks, repeatedly.

The number of rows is known before reading, and each chunk states its rows. A shard or a random subset of the
rows therefore does not depend on the chunk size or on the number of processes that read.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike
from gmmtorch.datasets.base import is_beyond
from gmmtorch.datasets.point_files.point_rows import ArrayRows, Rows, open_rows
from gmmtorch.errors import InvalidArgumentError, check_whole

CHUNK_POINTS = 1 << 17
"""Default number of points per chunk; EM needs about 20 MB for one chunk."""


class Chunk(NamedTuple):
    """points (n, D), finite, float64; rows (n,): their row numbers in the source; n_dropped: invalid rows."""

    points: Tensor
    rows: Tensor
    n_dropped: int


class RowInterval(NamedTuple):
    """A random subset of rows: those whose random number for `seed`, uniform in [0, 1), is in [low, high)."""

    low: float
    high: float
    seed: int


@dataclass(frozen=True)
class PointChunks:
    """Points of a file or an array, in chunks. Each iteration reads the points again.

    Rows with NaN or infinite coordinates (beams without return) are dropped and counted.

    Args:
        rows: the source of the points; see `open_points` and `in_memory`.
        chunk_points: rows per chunk, which limits the memory used.
        max_range: points at this distance (m) from the frame's origin or beyond are dropped; None: no limit.
        begin, end: first row, and the row after the last one; None: the end of the source.
        subset: random subset of these rows; None: all.
    """

    rows: Rows
    chunk_points: int = CHUNK_POINTS
    max_range: float | None = None
    begin: int = 0
    end: int | None = None
    subset: RowInterval | None = None

    def __post_init__(self) -> None:
        check_whole("chunk_points", self.chunk_points, 1)
        if self.max_range is not None and not self.max_range > 0:
            raise InvalidArgumentError(f"max_range={self.max_range} must be above zero metres, or None.")

    @property
    def name(self) -> str:
        return self.rows.name

    @property
    def dim(self) -> int:
        return self.rows.dim

    @property
    def n_rows(self) -> int:
        """Number of rows read, including invalid ones."""
        return self._end - self.begin

    @property
    def _end(self) -> int:
        return self.rows.n_rows if self.end is None else self.end

    def __iter__(self) -> Iterator[Chunk]:
        first = self.begin
        for block in self.rows.blocks(self.begin, self._end, self.chunk_points):
            yield self._chunk(np.asarray(block, dtype=np.float64), first)
            first += block.shape[0]

    def _chunk(self, block: np.ndarray, first: int) -> Chunk:
        rows = torch.arange(first, first + block.shape[0])
        points = torch.from_numpy(np.require(block, requirements=["C", "W"]))
        if self.subset is not None:
            number = row_uniform(rows, self.subset.seed)
            chosen = (number >= self.subset.low) & (number < self.subset.high)
            points, rows = points[chosen], rows[chosen]
        valid = torch.isfinite(points).all(1)
        if self.max_range is not None:
            valid &= ~is_beyond(points.norm(dim=1), self.max_range)
        if bool(valid.all()):
            return Chunk(points, rows, 0)
        return Chunk(points[valid], rows[valid], int((~valid).sum()))

    def shard(self, index: int, n_shards: int) -> PointChunks:
        """Shard `index` of `n_shards` contiguous shards whose sizes differ by at most one row."""
        edges = [self.begin + self.n_rows * i // n_shards for i in (index, index + 1)]
        return dataclasses.replace(self, begin=edges[0], end=edges[1])

    def random_subset(self, low: float, high: float, seed: int) -> PointChunks:
        """The rows whose random number for `seed`, uniform in [0, 1), is in [low, high)."""
        if self.subset is not None:
            raise InvalidArgumentError("These rows are already a random subset; take one subset of all rows.")
        return dataclasses.replace(self, subset=RowInterval(low, high, seed))


def open_points(
    path: str | Path, *, chunk_points: int = CHUNK_POINTS, max_range: float | None = None
) -> PointChunks:
    """The points of a .npy, .las, .laz, .pcd or .ply file, in chunks.

    NPY and binary PCD and PLY files are mapped into memory. LAS, LAZ and ascii files are decoded in each
    iteration. Compressed PCD files, and PLY files with lists in or before the points, are loaded as a whole.

    Raises `MissingDataError` if the file does not exist, `InvalidArgumentError` for another suffix, and
    `DataError`, at once or while reading, for a damaged file.
    """
    return PointChunks(open_rows(path), chunk_points, max_range)


def in_memory(points: ArrayLike, name: str = "points", *, chunk_points: int = CHUNK_POINTS) -> PointChunks:
    """Points (N, D) in memory, in chunks."""
    return PointChunks(ArrayRows(points, name), chunk_points)


def row_uniform(rows: Tensor, seed: int) -> Tensor:
    """A uniform random number in [0, 1) for each row (n,), float64; a function of the row and the seed only.

    53 bits of SplitMix64 (Steele, Lea & Flood, 2014) with the row number as counter.
    """
    base = mix_bits(np.array([seed], dtype=np.uint64))
    state = base + (rows.numpy().astype(np.uint64) + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    return torch.from_numpy((mix_bits(state) >> np.uint64(11)).astype(np.float64) * 2.0**-53)


def mix_bits(state: np.ndarray) -> np.ndarray:
    """64-bit words (n,) after the finalizer of SplitMix64, which mixes their bits."""
    state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    mixed: np.ndarray = state ^ (state >> np.uint64(31))
    return mixed

"""Point clouds larger than memory: reading them in chunks, repeatedly, and statistics from one pass.

The number of rows is known before reading, and each chunk states its rows. A shard or a random subset of the
rows therefore does not depend on the chunk size or on the number of processes that read.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike
from gmmtorch.datasets.base import is_beyond
from gmmtorch.datasets.dataset_options import SUFFIXES, point_path
from gmmtorch.datasets.point_files.las_files import LasRows
from gmmtorch.datasets.point_files.mesh_files import ply_rows
from gmmtorch.datasets.point_files.pcd_files import pcd_rows
from gmmtorch.datasets.point_files.point_rows import ArrayRows, NpyRows, Rows
from gmmtorch.errors import InvalidArgumentError, check_whole

CHUNK_POINTS = 1 << 17
"""Default number of points per chunk; EM needs about 20 MB for one chunk."""

_CHECKSUM_BITS = 48  # so that a sum of several checksums is exact in float64
_ODD = np.uint64(0x9E3779B97F4A7C15)  # of SplitMix64


class Chunk(NamedTuple):
    """points (n, D), finite, float64; rows (n,): their row numbers in the source; n_dropped: invalid rows."""

    points: Tensor
    rows: Tensor
    n_dropped: int


@dataclass(frozen=True)
class PointChunks:
    """Points of a file or an array, in chunks. Each iteration reads the points again.

    Rows with NaN or infinite coordinates (beams without return) are dropped and counted.

    Args:
        rows: the source of the points; see `open_points` and `in_memory`.
        chunk_points: rows per chunk, which limits the memory used.
        max_range: points at this distance (m) from the frame's origin or beyond are dropped; None: no limit.
        begin, end: first row, and the row after the last one; None: the end of the source.
        subset: (low, high, seed) of a random subset of these rows, see `random_subset`; None: all.
    """

    rows: Rows
    chunk_points: int = CHUNK_POINTS
    max_range: float | None = None
    begin: int = 0
    end: int | None = None
    subset: tuple[float, float, int] | None = None

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
            low, high, seed = self.subset
            number = row_uniform(rows, seed)
            chosen = (number >= low) & (number < high)
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
        return dataclasses.replace(self, subset=(low, high, seed))


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
    base = _mix_bits(np.array([seed], dtype=np.uint64))
    state = base + (rows.numpy().astype(np.uint64) + np.uint64(1)) * _ODD
    return torch.from_numpy((_mix_bits(state) >> np.uint64(11)).astype(np.float64) * 2.0**-53)


def _mix_bits(state: np.ndarray) -> np.ndarray:
    """64-bit words (n,) after the finalizer of SplitMix64, which mixes their bits."""
    state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    mixed: np.ndarray = state ^ (state >> np.uint64(31))
    return mixed


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
        state = _mix_bits(state * _ODD + bits[:, axis])
    return int((state >> np.uint64(64 - _CHECKSUM_BITS)).sum(dtype=np.uint64)) % (1 << _CHECKSUM_BITS)


_READERS: dict[str, Callable[[Path], Rows]] = dict(
    zip(SUFFIXES, (NpyRows, LasRows, LasRows, pcd_rows, ply_rows), strict=True)
)


def open_rows(path: str | Path) -> Rows:
    """A reader of the points of a .npy, .las, .laz, .pcd or .ply file.

    Raises `MissingDataError` if the file does not exist, `InvalidArgumentError` for another suffix, and
    `DataError` for a damaged file.
    """
    path = point_path(path)
    return _READERS[path.suffix.lower()](path)


def read_cloud(path: Path) -> Tensor:
    """Points (N, D), float64, of a point file, with those that are not finite. Errors: `open_rows`."""
    rows = open_rows(path)
    blocks = list(rows.blocks(0, rows.n_rows, max(1, rows.n_rows)))
    points = blocks[0] if len(blocks) == 1 else np.concatenate([np.empty((0, rows.dim)), *blocks])
    return torch.from_numpy(np.require(points, np.float64, ["C", "W"]))

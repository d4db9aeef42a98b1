"""Clouds larger than memory: points that come in chunks, as often as they are asked for.

A source knows how many rows it has before it reads any, and every chunk says which rows it holds. So
a share of the rows, or a random draw, is the same whatever the chunks and however many processes read.
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

from gmmtorch.datasets.base import is_beyond
from gmmtorch.datasets.point_files.point_rows import ArrayRows, Rows, open_rows
from gmmtorch.errors import InvalidArgumentError, check_whole

CHUNK_POINTS = 1 << 17
"""Points read at once unless the caller says otherwise: some 20 MB with what EM makes of them."""


class Chunk(NamedTuple):
    """points (n, D), finite, float64; rows (n,): which of the source they are; n_dropped: invalid rows."""

    points: Tensor
    rows: Tensor
    n_dropped: int


class Draw(NamedTuple):
    """The rows whose seeded random number in [0, 1) is at least `low` and below `high`."""

    low: float
    high: float
    seed: int


@dataclass(frozen=True)
class PointChunks:
    """Points of a file or an array in chunks; iterating again reads again.

    Rows with NaN or infinite coordinates (beams without return) are dropped and counted.

    Args:
        rows: where the points are; see `open_points` and `in_memory`.
        chunk_points: rows read at once, which bounds the memory taken.
        max_range: points at or beyond it (m), measured from the frame's origin, are dropped; None: none.
        begin, end: the rows read; None: to the last.
        draw: of these, the ones drawn; None: all.
    """

    rows: Rows
    chunk_points: int = CHUNK_POINTS
    max_range: float | None = None
    begin: int = 0
    end: int | None = None
    draw: Draw | None = None

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
        """Rows that are read, invalid ones included."""
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
        if self.draw is not None:
            number = row_uniform(rows, self.draw.seed)
            drawn = (number >= self.draw.low) & (number < self.draw.high)
            points, rows = points[drawn], rows[drawn]
        valid = torch.isfinite(points).all(1)
        if self.max_range is not None:
            valid &= ~is_beyond(points.norm(dim=1), self.max_range)
        if bool(valid.all()):
            return Chunk(points, rows, 0)
        return Chunk(points[valid], rows[valid], int((~valid).sum()))

    def part(self, index: int, n_parts: int) -> PointChunks:
        """The `index`-th of `n_parts` runs of rows, equal to within one row."""
        edges = [self.begin + self.n_rows * i // n_parts for i in (index, index + 1)]
        return dataclasses.replace(self, begin=edges[0], end=edges[1])

    def drawn(self, low: float, high: float, seed: int) -> PointChunks:
        """The rows whose seeded random number in [0, 1) lies in [low, high)."""
        if self.draw is not None:
            raise InvalidArgumentError("The rows are a draw already; draw once, from all of them.")
        return dataclasses.replace(self, draw=Draw(low, high, seed))


def open_points(
    path: str | Path, *, chunk_points: int = CHUNK_POINTS, max_range: float | None = None
) -> PointChunks:
    """The points of a .npy, .las, .laz, .pcd or .ply file, in chunks.

    .npy and binary PCD and PLY are mapped into memory; LAS, LAZ and ascii files are decoded anew each
    time. Compressed PCD files, and PLY files with lists before or in their points, are held whole.

    Raises `MissingDataError` if it is not there, `InvalidArgumentError` for another kind of file, and
    `DataError`, now or while reading, for a damaged one.
    """
    return PointChunks(open_rows(path), chunk_points, max_range)


def in_memory(
    points: Tensor | np.ndarray, name: str = "points", *, chunk_points: int = CHUNK_POINTS
) -> PointChunks:
    """Points (N, D) in memory, in chunks."""
    return PointChunks(ArrayRows(points, name), chunk_points)


def row_uniform(rows: Tensor, seed: int) -> Tensor:
    """A number in [0, 1) for each row (n,) and seed, float64: always the same, uniform, independent.

    SplitMix64 (Steele, Lea & Flood, 2014) of the row as a counter, 53 bits of it.
    """
    base = mix_bits(np.array([seed], dtype=np.uint64))
    state = base + (rows.numpy().astype(np.uint64) + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    return torch.from_numpy((mix_bits(state) >> np.uint64(11)).astype(np.float64) * 2.0**-53)


def mix_bits(state: np.ndarray) -> np.ndarray:
    """SplitMix64's finalizer: 64-bit words (n,) with their bits mixed."""
    state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    mixed: np.ndarray = state ^ (state >> np.uint64(31))
    return mixed

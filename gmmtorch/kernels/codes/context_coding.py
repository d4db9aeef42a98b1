"""Components and attributes as adaptive binary codes, written and read; the twins are in `mapping.codec`."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from gmmtorch.kernels.compiler import templated

Ints = NDArray[np.int64]
Bytes = NDArray[np.uint8]

MOST_STEPS = 2048
"""For each byte of a batch, to find the ranks of its origins; about 0.1 ms."""

_KINDS = itertools.product((2, 3), (True, False))  # dimension, and whether the code is written
_CODINGS = templated("codes/context_coding.h", "context_coding", _KINDS, rounds_each=True)


@dataclass(frozen=True, eq=False)
class CodedBatch:
    """K components, S origins and E viewpoints as whole numbers, int64; read into arrays of zeros.

    side: log2 of the side (m) of the cells (K, D) that contain the means. coarse: whether means and shears
    are in steps of the coarse lattice; deviations and counts never are. The others: as in `Quantized`.
    """

    side: int
    coarse: bool
    axis_order: Ints
    deviation: Ints
    shear: Ints
    mean: Ints
    count: Ints
    max_range: Ints
    ids: Ints
    origins: Ints
    n_viewpoints: Ints
    seen_from: Ints
    share: Ints
    cells: Ints

    @property
    def dim(self) -> int:
        return self.mean.shape[1]


class ChanceTables(NamedTuple):
    """chances, n_coded (N,), int32: of each slot, the probability of a 0 in 1/65536, and how many bits it has
    coded; both change. rates (M + 1,): in 1/65536, how far a bit moves a slot that has coded 0 … M bits.
    first_slot (F,): of the fields."""

    chances: NDArray[np.int32]
    n_coded: NDArray[np.int32]
    rates: Ints
    first_slot: Ints


def context_coding(batch: CodedBatch, tables: ChanceTables, stream: Bytes, writes: bool) -> int:
    """Write a batch to the stream (B,), uint8, or read it; returns the number of bytes used; −1 if the stream
    is damaged or too short; −2 if it takes more than `MOST_STEPS`. The viewpoints of a component are read
    nearest first."""
    k, n_origins = len(batch.count), len(batch.origins)
    result = np.zeros(1, np.int64)
    n_items = 8 * n_origins // 7 + 16  # of the tree
    waiting, box = np.zeros(n_items, np.int64), np.zeros(n_items * 2 * batch.dim, np.int64)
    rows, distance = np.zeros((2, n_origins), np.int64), np.zeros(n_items)
    shapes = np.zeros((2, batch.mean.size))
    sizes = k, n_origins, len(batch.seen_from), batch.side, int(batch.coarse)
    slots = (*tables[:3], len(tables.rates) - 1, tables.first_slot)
    scratch = (*slots, rows[0], box, distance, waiting, rows[1], *shapes, batch.cells)
    values = list(vars(batch).values())[2:-1]  # without side, coarse and cells
    kernel = _CODINGS[batch.dim, writes]
    kernel(1, *sizes, *values, *scratch, stream, len(stream), MOST_STEPS, result)
    return int(result[0])


_NUMBERS = templated("codes/number_coding.h", "number_coding", (True, False), rounds_each=True)


def number_coding(
    rows: Tensor, width: int, power: Tensor, tables: ChanceTables, stream: Bytes, writes: bool
) -> int:
    """Write rows (K, n) of whole numbers, with `width` columns of the channel, to the stream (B,), uint8, or
    read them into zeros; returns the number of bytes used; −1 if the stream is damaged or too short.

    power (2 M + 1,): √2 to the powers −M … M, of which deviations are. All tensors are on the CPU.
    """
    result, level, height = np.zeros(1, np.int64), np.zeros(width, np.int64), np.zeros(width)
    sizes = (len(rows), rows.shape[1], width)
    slots = (*tables[:3], len(tables.rates) - 1, tables.first_slot)
    scratch = (rows, power, len(power) // 2, level, height, *slots)
    _NUMBERS[writes](1, *sizes, *scratch, stream, len(stream), 0, result)
    return int(result[0])

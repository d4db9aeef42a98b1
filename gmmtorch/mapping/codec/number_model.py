"""Attributes that are numbers as an adaptive binary code (`range_coder`): each is predicted from the
components before it; docs/formats.md.

A row is a component: its share, A steps as powers of √2, A means and slopes in these steps, as whole numbers
(`attribute_block`). The fused kernel does the work. This twin defines it.
"""

from __future__ import annotations

import functools
import math

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import DataError
from gmmtorch.kernels import ChanceTables, is_fused, number_coding
from gmmtorch.mapping.codec.context_chances import OF_ATTRIBUTES
from gmmtorch.mapping.codec.range_coder import NUMBER, RangeCoder, copied, first_chances

MOST_STEPS = 1 << 40
"""Largest mean and slope."""
LARGEST_POWER = 80
"""Largest power of √2 of a step, and of its inverse."""
WHOLE = 8
"""Parts of a share."""
_SLOPES = ("FLAT", "TILTED", "STEEP", "STEEPER")  # of the first column, and of later ones
_FIELDS = ("SHARE", "FIRST", "SECOND", "LATER", "MEAN", "OTHER", *_SLOPES, *(f"LATER_{s}" for s in _SLOPES))
_FOLLOWS = 0.6  # how far the expected mean moves to that of the last component
_LEVEL = 64  # parts of a power, in their running mean
_BYTES, _WIDEST = 16, 128  # of a number, usually and at most


def write_rows(rows: Tensor, width: int) -> bytes:
    """The rows (K, n) of a channel with `width` columns, without zeros at the end."""
    if is_fused(rows):
        given = rows.contiguous().clone()
        for size in (_BYTES, _WIDEST):
            stream = np.zeros(64 + size * rows.numel(), np.uint8)
            n = number_coding(given, width, powers(), copied(first_tables()), stream, writes=True)
            if n >= 0:
                return stream[:n].tobytes().rstrip(b"\0")
        raise AssertionError("numbers in range fit")
    writer = RangeCoder(first_tables())
    _walk(writer, rows.tolist(), width)
    return writer.to_bytes().rstrip(b"\0")


def read_rows(data: bytes, k: int, n: int, width: int) -> Tensor:
    """What `write_rows` wrote of K components. Raises `DataError` for other bytes."""
    if is_fused(torch.empty(0)):
        rows = torch.zeros(k, n, dtype=torch.int64)
        stream = np.frombuffer(data or b"\0", np.uint8)
        is_good = number_coding(rows, width, powers(), copied(first_tables()), stream, writes=False) >= 0
    else:
        table = [[0] * n for _ in range(k)]
        _walk(RangeCoder(first_tables(), data), table, width)
        rows, is_good = torch.tensor(table, dtype=torch.int64).reshape(k, n), True
    if not is_good or write_rows(rows, width) != data:
        raise DataError("The numbers of the attributes are damaged.")
    return rows


@functools.cache
def powers() -> Tensor:
    """√2 to the powers −`LARGEST_POWER` … `LARGEST_POWER`, equal on all machines."""
    powers = range(-LARGEST_POWER, LARGEST_POWER + 1)
    return torch.tensor([math.ldexp(math.sqrt(2) if d % 2 else 1.0, d // 2) for d in powers]).double()


@functools.cache
def first_tables() -> ChanceTables:
    """The tables before the first bit."""
    return first_chances(OF_ATTRIBUTES, [NUMBER] * len(_FIELDS))


def _walk(coder: RangeCoder, rows: list[list[int]], width: int) -> None:
    """Write rows, or read them in place."""
    field = dict(zip(_FIELDS, coder.first, strict=True))
    power = powers().tolist()
    level: list[int] = []
    height: list[float] = []

    def coded(row: list[int], place: int, name: str, expected: int, most: int) -> int:
        row[place] = expected + coder.whole(field[name], row[place] - expected)
        if abs(row[place]) > most:
            raise DataError("A number of the attributes is too large: it is damaged.")
        return row[place]

    for row in rows:
        if coded(row, 0, "SHARE", WHOLE, WHOLE) < 0:
            raise DataError("A share of the attributes is negative: it is damaged.")
        if row[0] == 0:
            continue
        size, step = row[1 : 1 + width], [0.0] * width
        for a in range(width):
            expected = size[a - 1] if a else 0
            if level:
                shift = _LEVEL * size[a - 1] - level[a - 1] if a else 0
                expected = (level[a] + shift + _LEVEL // 2) // _LEVEL
            size[a] = coded(row, 1 + a, _FIELDS[1 + min(a, 2)], expected, LARGEST_POWER)
            step[a] = power[size[a] + LARGEST_POWER]
        for a in range(width):
            near = math.floor(height[a] / step[a] + 0.5) if height else 0
            expected = near if abs(near) < MOST_STEPS else 0
            coded(row, 1 + width + a, "OTHER" if a else "MEAN", expected, MOST_STEPS)
        steep, begin = 0, 1 + 2 * width
        for place in range(begin, len(row)):
            first = 6 if (place - begin) * width < len(row) - begin else 10
            steep += abs(coded(row, place, _FIELDS[first + min(steep, 3)], 0, MOST_STEPS))
        value = [row[1 + width + a] * step[a] for a in range(width)]
        if level:
            height = [h + _FOLLOWS * (v - h) for h, v in zip(height, value, strict=True)]
            level = [p + (_LEVEL * d - p) // 4 for p, d in zip(level, size, strict=True)]
        else:
            height, level = value, [_LEVEL * d for d in size]

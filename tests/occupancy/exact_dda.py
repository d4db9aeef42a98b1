"""A plain DDA in exact rational arithmetic: the oracle of the ray casting tests."""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction

Voxel = tuple[int, ...]


def voxels_left(
    start: Sequence[float], end: Sequence[float], shape: Sequence[int] | None = None
) -> list[Voxel]:
    """Voxels that the segment leaves, in order, of those inside `shape` (all of them if None).

    Voxel i is [i, i+1) on every axis; of planes crossed in the same point that of the lower axis is
    crossed first. Coordinates are taken as the exact numbers that the floats are.
    """
    a, b = [Fraction(x) for x in start], [Fraction(x) for x in end]
    crossings = []
    for axis, (x, y) in enumerate(zip(a, b, strict=True)):
        first, last = math.floor(x), math.floor(y)
        if y > x:
            crossings += [((plane - x) / (y - x), axis, 1) for plane in range(first + 1, last + 1)]
        else:
            crossings += [((plane - x) / (y - x), axis, -1) for plane in range(first, last, -1)]
    voxel = [math.floor(x) for x in a]
    left = []
    for _, axis, step in sorted(crossings):
        left.append(tuple(voxel))
        voxel[axis] += step
    assert voxel == [math.floor(y) for y in b]
    if shape is None:
        return left
    return [v for v in left if all(0 <= i < n for i, n in zip(v, shape, strict=True))]


def voxels_crossed(start: Sequence[float], end: Sequence[float], shortest: float) -> set[Voxel]:
    """Voxels, the last one aside, in which a piece of the segment longer than `shortest` lies."""
    a, b = [Fraction(x) for x in start], [Fraction(x) for x in end]
    length = math.dist(start, end)
    crossed = set()
    for voxel in set(voxels_left(start, end)):
        enter, leave = Fraction(0), Fraction(1)
        for i, x, y in zip(voxel, a, b, strict=True):
            if x != y:
                near, far = sorted(((i - x) / (y - x), (i + 1 - x) / (y - x)))
                enter, leave = max(enter, near), min(leave, far)
        if float(leave - enter) * length > shortest:
            crossed.add(voxel)
    return crossed

"""Reads batches of version 1, which earlier gmmtorch wrote; their layout is in docs/formats.md.

A batch is a bit stream: columns of whole numbers for components, origins and viewpoints. A mean is written as
the number of a cell of a common grid, and its place in the cell.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import DataError
from gmmtorch.mapping.codec.bitstream import BitReader, Ints, within
from gmmtorch.mapping.codec.lattice import (
    AXIS_ORDERS,
    LARGEST_DEVIATION,
    LARGEST_RATIO,
    LEAST_DEVIATION,
    Lattice,
    shear_exponents,
)
from gmmtorch.mapping.codec.quantization import LARGEST_COUNT, LEAST_SHARE, NO_COUNT, Quantized, ints
from gmmtorch.scan import FARTHEST

_ORDER_BITS = {2: 1, 3: 3}
_RASTER_BITS = 60  # of a cell's number, at most
_LARGEST_SIDE = 30  # log2 of a cell's side (m), at most


def read_first(data: bytes) -> Quantized:
    """The components of a batch without version and checksum. Raises `DataError` for one that was not written
    so."""
    reader = BitReader(data)
    dim, k, n_origins = reader.number(), reader.number(), reader.number()
    if dim not in (2, 3):
        raise DataError(f"The components are {dim}-dimensional; a map has 2 or 3 dimensions.")
    if min(k, n_origins) < 0:
        raise DataError(f"{k} components and {n_origins} origins are announced.")
    reader.require(max(k * _ORDER_BITS[dim], n_origins))
    axis_order = within(reader.fixed(k, _ORDER_BITS[dim]), "axis orders", 0, len(AXIS_ORDERS[dim]) - 1)
    ids = np.stack([reader.column(k), reader.column(k) + np.arange(k)], 1)
    places = _read_means(reader, *_read_covariances(reader, axis_order, dim))
    count = within(reader.column(k), "counts", NO_COUNT, LARGEST_COUNT)
    max_range = within(reader.column(k), "max_range flags", 0, 1)
    n_viewpoints, seen_from, share = _read_viewpoints(reader, k, n_origins)
    origins = [reader.column(n_origins) for _ in range(dim)]
    reader.finish()
    return Quantized(
        places=places,
        count=torch.from_numpy(count),
        max_range=torch.from_numpy(max_range).bool(),
        ids=torch.from_numpy(ids),
        origins=torch.from_numpy(np.stack(origins, 1)),
        n_viewpoints=torch.from_numpy(n_viewpoints),
        seen_from=torch.from_numpy(seen_from),
        share=torch.from_numpy(share),
    )


def _read_covariances(reader: BitReader, axis_order: Ints, dim: int) -> tuple[Tensor, Tensor, Tensor]:
    """Reads axis orders, deviations and shears."""
    k = len(axis_order)
    deviation = [within(reader.column(k), "deviations", LEAST_DEVIATION, LARGEST_DEVIATION)]
    for _ in range(1, dim):
        deviation.append(deviation[-1] - within(reader.column(k), "deviations", 0, LARGEST_RATIO))
    steps = torch.from_numpy(np.stack(deviation, 1))
    exponents = ints(shear_exponents(steps))
    shear = [reader.scaled(-exponents[:, pair]) for pair in range(exponents.shape[1])]
    return torch.from_numpy(axis_order), steps, torch.from_numpy(np.stack(shear, 1))


def _read_means(reader: BitReader, axis_order: Tensor, deviation: Tensor, shear: Tensor) -> Lattice:
    k, dim = deviation.shape
    exponent = reader.number()
    least, extent = zip(*((reader.number(), reader.number()) for _ in range(dim)), strict=True)
    # A box of cells may exceed the largest possible map by one cell on each side.
    reach = 2 * FARTHEST / 2.0**exponent + 2 if abs(exponent) <= _LARGEST_SIDE else 0.0
    if max(map(abs, least + extent)) > reach or min(extent) < 1 or math.prod(extent) >> _RASTER_BITS:
        raise DataError(f"Cells of side 2^{exponent} m, {extent} of them from {least} on: out of range.")
    number = within(reader.column(k), "cells", 0, math.prod(extent) - 1)
    cells = np.empty((k, dim), np.int64)
    for axis in reversed(range(dim)):
        number, cells[:, axis] = np.divmod(number, extent[axis])
    blank = Lattice(axis_order, deviation, shear, torch.zeros_like(deviation))
    finer = exponent - ints(blank.by_world_axis(blank.mean_exponents()))
    width, coarser = np.maximum(finer, 0), np.maximum(-finer, 0)
    mean = (cells + np.array(least)) << width
    if (mean & ((np.int64(1) << coarser) - 1)).any():
        raise DataError("A mean lies between the steps of its lattice: it is damaged.")
    mean >>= coarser
    for axis in range(dim):
        mean[:, axis] |= reader.fixed(k, width[:, axis])
    return replace(blank, mean=torch.from_numpy(mean).gather(1, blank.axes()))


def _read_viewpoints(reader: BitReader, k: int, n_origins: int) -> tuple[Ints, Ints, Ints]:
    n_viewpoints = within(reader.column(k), "viewpoints", 0, n_origins)
    reader.require(int(n_viewpoints.sum(dtype=np.float64)) - k)  # shares take at least a bit each
    is_first = np.zeros(int(n_viewpoints.sum()), np.bool_)  # of their component
    is_first[(np.cumsum(n_viewpoints) - n_viewpoints)[n_viewpoints > 0]] = True
    first = reader.column(int(is_first.sum()))
    step = np.zeros(len(is_first), np.int64)
    step[~is_first] = within(reader.column(int((~is_first).sum())), "steps", -n_origins, n_origins)
    total = np.cumsum(step)
    start = first - total[is_first]  # the steps of a component begin at its own first origin
    seen_from = total + np.repeat(start, n_viewpoints[n_viewpoints > 0])
    within(seen_from, "origins seen from", 0, n_origins - 1)
    several = np.repeat(n_viewpoints, n_viewpoints) > 1
    share = np.zeros(len(seen_from), np.int64)
    share[several] = within(reader.short(int(several.sum())), "shares", 0, LEAST_SHARE)
    return n_viewpoints, seen_from, share

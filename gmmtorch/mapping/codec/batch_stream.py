"""The bit stream of a batch: columns of whole numbers for components, origins and viewpoints.

A mean is written as the number of a cell of a common grid, and its place in the cell. The side of the cells
is the one that takes the fewest bits. See docs/formats.md.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gmmtorch.errors import DataError
from gmmtorch.mapping.codec import lattice
from gmmtorch.mapping.codec.bitstream import BitReader, BitWriter, Ints, fewest_bits
from gmmtorch.mapping.codec.lattice import (
    AXIS_ORDERS,
    LARGEST_DEVIATION,
    LARGEST_RATIO,
    LEAST_DEVIATION,
    Lattice,
)
from gmmtorch.mapping.codec.quantization import LARGEST_COUNT, LEAST_SHARE, NO_COUNT, ORIGIN_STEP, Quantized
from gmmtorch.scan import FARTHEST

_ORDER_BITS = {2: 1, 3: 3}
RASTER_BITS = 60
"""Largest number of bits of a cell's number in a batch."""
LARGEST_SIDE = 30
"""Largest log2 of a cell's side (m); few such cells cover the largest possible map."""
_SIDES_TRIED = 10
_WORSE_IN_A_ROW = 2


# -- writing ---------------------------------------------------------------------------------------------


def write_values(writer: BitWriter, values: Quantized) -> None:
    """Writes a batch without its version and checksum."""
    dim, k = values.places.dim, len(values)
    writer.number(dim)
    writer.number(k)
    writer.number(len(values.origins))
    writer.fixed(_ints(values.places.axis_order), _ORDER_BITS[dim])
    writer.column(_ints(values.ids[:, 0]))
    # Consecutive ids become equal numbers, which take no bits.
    writer.column(_ints(values.ids[:, 1]) - np.arange(k))
    _write_covariances(writer, values.places)
    _write_means(writer, values.places)
    writer.column(_ints(values.count))
    writer.column(_ints(values.max_range))
    _write_viewpoints(writer, _ints(values.n_viewpoints), _ints(values.seen_from), _ints(values.share))
    for axis in range(dim):
        writer.column(_ints(values.origins[:, axis]))


def _write_covariances(writer: BitWriter, places: Lattice) -> None:
    writer.column(_ints(places.deviation[:, 0]))
    for axis in range(1, places.dim):
        writer.column(_ints(places.deviation[:, axis - 1] - places.deviation[:, axis]))
    exponents = _ints(lattice.shear_exponents(places.deviation))
    for pair in range(exponents.shape[1]):
        writer.scaled(_ints(places.shear[:, pair]), -exponents[:, pair])


def _write_means(writer: BitWriter, places: Lattice) -> None:
    """Writes the cells of a common grid that contain the means, then the place of each mean in its cell."""
    exponent = _cell_exponent(places, in_order=True)
    cells = _cells(places, np.array([exponent]))[0]
    least, extent = _box(cells)
    writer.number(exponent)
    for axis in range(places.dim):
        writer.number(int(least[axis]))
        writer.number(int(extent[axis]))
    writer.column(_raster(cells, least, extent))
    width = np.maximum(exponent - _ints(_world_exponents(places)), 0)
    within = _ints(_by_world_axis(places, places.mean)) & ((np.int64(1) << width) - 1)
    for axis in range(places.dim):
        writer.fixed(within[:, axis], width[:, axis])


def _write_viewpoints(writer: BitWriter, n_viewpoints: Ints, seen_from: Ints, share: Ints) -> None:
    """Writes the number of viewpoints of each component, the origin of its first one, the steps from one
    origin to the next, and the shares."""
    writer.column(n_viewpoints)
    is_first = _firsts(n_viewpoints)
    writer.column(seen_from[is_first])
    writer.column(np.diff(seen_from, prepend=0)[~is_first])
    writer.rice_column(share[np.repeat(n_viewpoints, n_viewpoints) > 1])


def _firsts(n_viewpoints: Ints) -> NDArray[np.bool_]:
    """Which viewpoints (E,) are the first of their component."""
    first = np.zeros(int(n_viewpoints.sum()), np.bool_)
    first[(np.cumsum(n_viewpoints) - n_viewpoints)[n_viewpoints > 0]] = True
    return first


# -- reading ---------------------------------------------------------------------------------------------


def read_values(reader: BitReader) -> Quantized:
    """Reads a batch. Raises `DataError` for one that `write_values` did not write."""
    dim, k, n_origins = reader.number(), reader.number(), reader.number()
    if dim not in (2, 3):
        raise DataError(f"The components are {dim}-dimensional; a map has 2 or 3 dimensions.")
    if min(k, n_origins) < 0:
        raise DataError(f"{k} components and {n_origins} origins are announced.")
    reader.require(max(k * _ORDER_BITS[dim], n_origins))
    axis_order = _within(reader.fixed(k, _ORDER_BITS[dim]), "axis orders", 0, len(AXIS_ORDERS[dim]) - 1)
    ids = np.stack([reader.column(k), reader.column(k) + np.arange(k)], 1)
    places = _read_means(reader, *_read_covariances(reader, axis_order, dim))
    if not bool(places.is_valid().all()):
        raise DataError("A mean or a covariance is out of range: it is damaged.")
    count = _within(reader.column(k), "counts", NO_COUNT, LARGEST_COUNT)
    max_range = _within(reader.column(k), "max_range flags", 0, 1)
    n_viewpoints, seen_from, share = _read_viewpoints(reader, k, n_origins)
    farthest = int(FARTHEST / ORIGIN_STEP)
    origins = [_within(reader.column(n_origins), "origins", -farthest, farthest) for _ in range(dim)]
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
    deviation = [_within(reader.column(k), "deviations", LEAST_DEVIATION, LARGEST_DEVIATION)]
    for _ in range(1, dim):
        deviation.append(deviation[-1] - _within(reader.column(k), "deviations", 0, LARGEST_RATIO))
    steps = torch.from_numpy(np.stack(deviation, 1))
    exponents = _ints(lattice.shear_exponents(steps))
    shear = [reader.scaled(-exponents[:, pair]) for pair in range(exponents.shape[1])]
    return torch.from_numpy(axis_order), steps, torch.from_numpy(np.stack(shear, 1))


def _read_means(reader: BitReader, axis_order: Tensor, deviation: Tensor, shear: Tensor) -> Lattice:
    k, dim = deviation.shape
    exponent = reader.number()
    least, extent = zip(*((reader.number(), reader.number()) for _ in range(dim)), strict=True)
    # A box of cells may exceed the largest possible map by one cell on each side.
    reach = 2 * FARTHEST / 2.0**exponent + 2 if abs(exponent) <= LARGEST_SIDE else 0.0
    if max(map(abs, least + extent)) > reach or min(extent) < 1 or math.prod(extent) >> RASTER_BITS:
        raise DataError(f"Cells of side 2^{exponent} m, {extent} of them from {least} on: out of range.")
    number = _within(reader.column(k), "cells", 0, math.prod(extent) - 1)
    cells = np.empty((k, dim), np.int64)
    for axis in reversed(range(dim)):
        number, cells[:, axis] = np.divmod(number, extent[axis])
    blank = Lattice(axis_order, deviation, shear, torch.zeros_like(deviation))
    finer = exponent - _ints(_world_exponents(blank))
    width, coarser = np.maximum(finer, 0), np.maximum(-finer, 0)
    mean = (cells + np.array(least)) << width
    if (mean & ((np.int64(1) << coarser) - 1)).any():
        raise DataError("A mean lies between the steps of its lattice: it is damaged.")
    mean >>= coarser
    for axis in range(dim):
        mean[:, axis] |= reader.fixed(k, width[:, axis])
    return replace(blank, mean=torch.from_numpy(mean).gather(1, blank.axes()))


def _read_viewpoints(reader: BitReader, k: int, n_origins: int) -> tuple[Ints, Ints, Ints]:
    n_viewpoints = _within(reader.column(k), "viewpoints", 0, n_origins)
    reader.require(int(n_viewpoints.sum(dtype=np.float64)) - k)  # shares take at least a bit each
    is_first = _firsts(n_viewpoints)
    first = reader.column(int(is_first.sum()))
    step = np.zeros(len(is_first), np.int64)
    step[~is_first] = _within(reader.column(int((~is_first).sum())), "steps", -n_origins, n_origins)
    total = np.cumsum(step)
    start = first - total[is_first]  # the steps of a component begin at its own first origin
    seen_from = total + np.repeat(start, n_viewpoints[n_viewpoints > 0])
    _within(seen_from, "origins seen from", 0, n_origins - 1)
    several = np.repeat(n_viewpoints, n_viewpoints) > 1
    share = np.zeros(len(seen_from), np.int64)
    share[several] = _within(reader.rice_column(int(several.sum())), "shares", 0, LEAST_SHARE)
    return n_viewpoints, seen_from, share


def _within(values: Ints, name: str, least: int, largest: int) -> Ints:
    """The values, if all are from `least` to `largest`; otherwise raises `DataError`."""
    if len(values) and not (int(values.min()) >= least and int(values.max()) <= largest):
        raise DataError(f"The {name} reach from {values.min()} to {values.max()}, not {least} to {largest}.")
    return values


# -- cells ----------------------------------------------------------------------------------------------


def order_of(places: Lattice) -> Tensor:
    """The `spatial_order` (K,) of components on the lattice."""
    cells = _cells(places, np.array([_cell_exponent(places, in_order=False)]))[0]
    return torch.from_numpy(np.lexsort(cells.T[::-1]))


def _cells(places: Lattice, exponents: Ints) -> Ints:
    """The cells (T, K, D) that contain the means, for cells of side 2^exponent m with exponents (T,)."""
    mean, step = _ints(_by_world_axis(places, places.mean)), _ints(_world_exponents(places))
    finer = exponents[:, None, None] - step
    return np.where(finer >= 0, mean >> np.maximum(finer, 0), mean << np.maximum(-finer, 0))


def _cell_exponent(places: Lattice, in_order: bool) -> int:
    """log2 of the side (m) of the cells with which means take the fewest bits, in this order or sorted."""
    exponents = _ints(_world_exponents(places))
    if not len(exponents):
        return 0
    rising = np.sort(exponents, axis=None)
    first = int((rising[(len(rising) - 1) // 2] + rising[len(rising) // 2]) / 2)
    while True:
        tried = np.arange(first, min(first + _SIDES_TRIED, LARGEST_SIDE + 1))
        cells = _cells(places, tried)
        least, extent = _box(cells)
        if first == LARGEST_SIDE or not _too_many(extent[0]):
            break
        first += 1
    rasters = _raster(cells, least, extent)
    within = np.maximum(tried[:, None, None] - exponents, 0).sum((1, 2))
    sizes = fewest_bits(rasters if in_order else np.sort(rasters, axis=1)) + within
    best = 0
    for row in range(len(tried)):
        if sizes[row] < sizes[best]:
            best = row
        if row - best >= _WORSE_IN_A_ROW:
            break
    return int(tried[best])


def _box(cells: Ints) -> tuple[Ints, Ints]:
    """The lowest cell (…, D) of (…, K, D), and the number of cells on each axis."""
    if not cells.shape[-2]:
        shape = (*cells.shape[:-2], cells.shape[-1])
        return np.zeros(shape, np.int64), np.ones(shape, np.int64)
    least = cells.min(-2)
    return least, cells.max(-2) - least + 1


def _too_many(extent: Ints) -> bool:
    """Whether a box (D,) has more cells than `RASTER_BITS` can number."""
    return bool(math.prod(extent.tolist()) >> RASTER_BITS)


def _raster(cells: Ints, least: Ints, extent: Ints) -> Ints:
    """Row-major numbers (…, K) of cells in their box."""
    number = cells[..., 0] - least[..., None, 0]
    for axis in range(1, cells.shape[-1]):
        number = number * extent[..., None, axis] + (cells[..., axis] - least[..., None, axis])
    return number


def _world_exponents(places: Lattice) -> Tensor:
    return _by_world_axis(places, places.mean_exponents())


def _by_world_axis(places: Lattice, values: Tensor) -> Tensor:
    """Values (K, D), ordered by falling deviation, in the order of the world axes."""
    return torch.empty_like(values).scatter_(1, places.axes(), values)


def _ints(values: Tensor) -> Ints:
    return values.long().numpy()

"""Batches: components as bytes, any number of them; and map files, which hold one. See docs/formats.md.

A component takes about 10 bytes in 3D and 7 in 2D. Its rounding error is bounded in its own standard
deviations (see `lattice`), and its covariance stays positive definite. A component decodes to the same values
in every batch: `decode(encode(c))` is `quantized(c)`, and encoding decoded components again, in any grouping,
changes nothing.

A batch is a bit stream: columns of whole numbers for components, origins and viewpoints. A mean is written as
the number of a cell of a common grid, and its place in the cell. The side of the cells is the one that takes
the fewest bits.

A map file is a safetensors container, about 200 bytes, with a batch and the settings of the map that differ
from the defaults of the file format. No pickle.
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gmmtorch.errors import DataError, GmmTorchError, check_choice, check_resolution, check_whole
from gmmtorch.files import pack_tensors, read_tensors, require, unpack_tensors
from gmmtorch.mapping.attributes.moments import Attributes
from gmmtorch.mapping.codec.attribute_block import decode_attributes, encode_attributes
from gmmtorch.mapping.codec.bitstream import BitCounter, BitReader, BitWriter, Ints
from gmmtorch.mapping.codec.lattice import (
    AXIS_ORDERS,
    LARGEST_DEVIATION,
    LARGEST_RATIO,
    LEAST_DEVIATION,
    Lattice,
    shear_exponents,
)
from gmmtorch.mapping.codec.quantization import (
    LARGEST_COUNT,
    LARGEST_SIDE,
    LEAST_SHARE,
    NO_COUNT,
    ORIGIN_STEP,
    RASTER_BITS,
    Quantized,
    box_of,
    cell_exponent,
    cells_of,
    ints,
    number_after,
    numbered,
    quantize,
    quantize_numbered,
    quantized,
    raster,
)
from gmmtorch.mapping.components import TENSORS, Components
from gmmtorch.mapping.learning.rules import LearningRule, changed_options, rule_facts
from gmmtorch.mapping.query_options import QueryOptions, check_method
from gmmtorch.occupancy import Calibration
from gmmtorch.scan import FARTHEST

BATCH_VERSION = 1
_VERSION_BYTES, _CHECKSUM_BYTES = 1, 4
_ORDER_BITS = {2: 1, 3: 3}


def encode(components: Components) -> bytes:
    """A batch of components. Raises `InvalidArgumentError` for values that are too large to be stored."""
    return encode_quantized(quantize(components))


def encode_quantized(values: Quantized) -> bytes:
    """A batch of components that `quantize` has rounded. The values are not checked again."""
    writer = BitWriter()
    _write_values(writer, values)
    body = bytes([BATCH_VERSION]) + writer.to_bytes()
    return body + zlib.crc32(body).to_bytes(_CHECKSUM_BYTES, "little")


def batch_bytes(values: Quantized) -> int:
    """The length of `encode_quantized(values)`, without writing it."""
    counter = BitCounter()
    _write_values(counter, values)
    return _VERSION_BYTES + -(-counter.n_bits // 8) + _CHECKSUM_BYTES


def decode(data: bytes) -> Components:
    """The components of a batch, on the CPU.

    Raises `DataError`, with the reason, for data that `encode` did not write. Memory is bounded in proportion
    to the length of the data, for any numbers in them.
    """
    body, checksum = data[:-_CHECKSUM_BYTES], data[-_CHECKSUM_BYTES:]
    if len(data) <= _CHECKSUM_BYTES:
        raise DataError(f"{len(data)} bytes are too few for a batch of components: it is truncated.")
    if body[0] != BATCH_VERSION:
        raise DataError(
            f"The batch of components is version {body[0]}; this gmmtorch reads version {BATCH_VERSION}. "
            "It is foreign or damaged, or gmmtorch needs an update."
        )
    if zlib.crc32(body) != int.from_bytes(checksum, "little"):
        raise DataError("The batch of components does not match its checksum: it is truncated or damaged.")
    try:
        return _read_values(BitReader(body[1:])).restored().checked()
    except DataError:
        raise
    except GmmTorchError as error:
        raise DataError(f"The batch of components is damaged: {error}") from error


# -- writing ---------------------------------------------------------------------------------------------


def _write_values(writer: BitWriter, values: Quantized) -> None:
    """Writes a batch without its version and checksum."""
    dim, k = values.places.dim, len(values)
    writer.number(dim)
    writer.number(k)
    writer.number(len(values.origins))
    writer.fixed(ints(values.places.axis_order), _ORDER_BITS[dim])
    writer.column(ints(values.ids[:, 0]))
    # Consecutive ids become equal numbers, which take no bits.
    writer.column(ints(values.ids[:, 1]) - np.arange(k))
    _write_covariances(writer, values.places)
    _write_means(writer, values.places)
    writer.column(ints(values.count))
    writer.column(ints(values.max_range))
    _write_viewpoints(writer, ints(values.n_viewpoints), ints(values.seen_from), ints(values.share))
    for axis in range(dim):
        writer.column(ints(values.origins[:, axis]))


def _write_covariances(writer: BitWriter, places: Lattice) -> None:
    writer.column(ints(places.deviation[:, 0]))
    for axis in range(1, places.dim):
        writer.column(ints(places.deviation[:, axis - 1] - places.deviation[:, axis]))
    exponents = ints(shear_exponents(places.deviation))
    for pair in range(exponents.shape[1]):
        writer.scaled(ints(places.shear[:, pair]), -exponents[:, pair])


def _write_means(writer: BitWriter, places: Lattice) -> None:
    """Writes the cells of a common grid that contain the means, then the place of each mean in its cell."""
    exponent = cell_exponent(places, in_order=True)
    cells = cells_of(places, np.array([exponent]))[0]
    least, extent = box_of(cells)
    writer.number(exponent)
    for axis in range(places.dim):
        writer.number(int(least[axis]))
        writer.number(int(extent[axis]))
    writer.column(raster(cells, least, extent))
    width = np.maximum(exponent - ints(places.world_exponents()), 0)
    within = ints(places.by_world_axis(places.mean)) & ((np.int64(1) << width) - 1)
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


def _read_values(reader: BitReader) -> Quantized:
    """Reads a batch. Raises `DataError` for one that `_write_values` did not write."""
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
    exponents = ints(shear_exponents(steps))
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
    finer = exponent - ints(blank.world_exponents())
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


FILE_KIND, FILE_VERSION = "gmmtorch.map", 2

CODECS = ("quantized", "float")
"""About 10 bytes a component, rounded within bounds; or every number as it is, about 150 bytes."""

FILE_OPTIONS = QueryOptions(prior=1.0, cutoff=5.0)
"""The query options of a file that contains none; they are not those of `GaussianMap()`."""

_ATTRIBUTES = "attributes"
_MACHINE_OPTIONS = ("memory_limit", "compiled")  # query options that a file does not contain
_WEIGHTED = "hit_length"  # in files of 1.0, which weighted hits by a length; their answers are calibrated now
_ROOM_FOR_SETTINGS = 48  # bytes by which settings may grow while a map is built; part of its byte budget


@dataclass(frozen=True)
class MapSettings:
    """The settings of a map that its file contains, without the learning rule.

    time: of the last scan (s), in a map with a half-life; None otherwise.
    """

    resolution: float
    method: str
    codec: str
    robot: int
    query: QueryOptions
    time: float | None = None


def map_bytes(components: Components, rule: LearningRule, settings: MapSettings, next_number: int) -> bytes:
    """A map file. `next_number`: sequence number of the next new component."""
    facts = _facts(rule, settings, number_after(components.ids, next_number))
    if settings.codec == "float":
        return _exact_file(components, facts)
    block = encode_attributes(components.attributes, components.covariances) if components.attributes else b""
    return _container(encode(components), block, facts)


def file_size(components: Components, rule: LearningRule, settings: MapSettings, next_number: int) -> int:
    """Bytes of the file of components before they are numbered, without writing it; and room for settings
    that change while the map is built."""
    n_new = int((components.ids[:, 1] < 0).sum())
    if settings.query.prior is None:  # a map that has predicted its next window states its calibration
        known = settings.query.calibration or Calibration.prior(1.0)
        settings = replace(settings, query=replace(settings.query, calibration=known))
    facts = _facts(rule, settings, number_after(components.ids, next_number + n_new))
    if settings.codec == "float":
        data = _exact_file(components, facts)
    elif components.attributes:
        data = map_bytes(
            quantized(numbered(components, settings.robot, next_number)[0]), rule, settings, next_number
        )
    else:
        values = quantize_numbered(components, settings.robot, next_number)
        data = _container(bytes(batch_bytes(values)), b"", facts)
    return len(data) + _ROOM_FOR_SETTINGS


def read_map(path: str | Path) -> tuple[Components, dict[str, Any]]:
    """Components and settings of a map file. Raises `DataError` for a damaged or foreign file."""
    return _content(*read_tensors(path, FILE_KIND, FILE_VERSION), path)


def read_map_bytes(data: bytes, path: str | Path) -> tuple[Components, dict[str, Any]]:
    """`read_map` of bytes that were read from `path`."""
    return _content(*unpack_tensors(data, path, FILE_KIND, FILE_VERSION), path)


def _content(
    tensors: dict[str, Tensor], facts: dict[str, Any], path: str | Path
) -> tuple[Components, dict[str, Any]]:
    facts = {"cutoff": FILE_OPTIONS.cutoff, **_with_calibration(facts, path)}
    if tensors.keys() >= {*TENSORS}:
        return _exact(tensors, path), facts
    batch = require(tensors, "components", (None,), torch.uint8, path)
    try:
        found = decode(batch.numpy().tobytes())
        if _ATTRIBUTES in tensors:
            block = require(tensors, _ATTRIBUTES, (None,), torch.uint8, path).numpy().tobytes()
            found = replace(found, attributes=decode_attributes(block, found.covariances))
        return found, facts
    except DataError as error:
        raise DataError(f"{path}: {error}") from error


def _facts(rule: LearningRule, settings: MapSettings, next_number: int) -> dict[str, Any]:
    facts = {"learning": rule_facts(rule), "n_numbered": next_number, **settings_facts(settings)}
    return facts if settings.time is None else {**facts, "time": settings.time}


def settings_facts(settings: MapSettings) -> dict[str, Any]:
    """The settings as plain values; query options only if they differ from `FILE_OPTIONS`."""
    query = settings.query
    known = query.calibration if query.prior is None else None
    if known is not None:  # which implies that there is no prior
        query = replace(query, prior=FILE_OPTIONS.prior)
    return {
        "resolution": settings.resolution,
        "method": settings.method,
        "codec": settings.codec,
        "robot": settings.robot,
        **changed_options(query, FILE_OPTIONS, leave_out=(*_MACHINE_OPTIONS, "calibration")),
        **({} if known is None else {"calibration": known.text()}),
    }


def _with_calibration(facts: dict[str, Any], path: str | Path) -> dict[str, Any]:
    """The facts with `prior` and `calibration` as options of queries. Raises `DataError` if it is damaged."""
    facts = dict(facts)
    weighted = facts.pop(_WEIGHTED, None) is not None
    usual = FILE_OPTIONS.prior if facts.get("calibration") is None else None
    facts["prior"] = None if weighted else facts.get("prior", usual)
    if facts.get("calibration") is not None:
        try:
            facts["calibration"] = Calibration.read(facts["calibration"])
        except DataError as error:
            raise DataError(f"{path}: {error}") from error
    return facts


def read_settings(facts: dict[str, Any], path: str | Path) -> MapSettings:
    """The settings of `settings_facts`; other facts are ignored. Raises `DataError` if they are damaged."""
    names = {field.name for field in fields(QueryOptions)} - {*_MACHINE_OPTIONS}
    facts = _with_calibration(facts, path)
    try:
        check_choice("codec", facts["codec"], CODECS)
        check_method(facts["method"])
        resolution, robot = check_resolution(facts["resolution"]), check_whole("robot", facts["robot"], 0)
        query = replace(FILE_OPTIONS, **{name: facts[name] for name in names & facts.keys()})
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"{path}: its settings are damaged ({error!r}).") from error
    return MapSettings(resolution, facts["method"], facts["codec"], robot, query)


def _container(batch: bytes, attributes: bytes, facts: dict[str, Any]) -> bytes:
    blocks = {"components": batch, **({_ATTRIBUTES: attributes} if attributes else {})}
    tensors = {name: torch.frombuffer(bytearray(data), dtype=torch.uint8) for name, data in blocks.items()}
    return pack_tensors(tensors, FILE_KIND, FILE_VERSION, **facts)


def _exact_file(components: Components, facts: dict[str, Any]) -> bytes:
    """The file of components with every number as it is."""
    known = {f"{_ATTRIBUTES}.{key}": value for key, value in components.attributes.tensors().items()}
    return pack_tensors({**components.tensors(), **known}, FILE_KIND, FILE_VERSION, **facts)


def _exact(tensors: dict[str, Tensor], path: str | Path) -> Components:
    """Components of a file with codec "float"."""
    known = {
        name.removeprefix(f"{_ATTRIBUTES}."): tensors[name]
        for name in tensors.keys() - {*TENSORS}
        if name.startswith(f"{_ATTRIBUTES}.")
    }
    tensors = {name: tensors[name] for name in TENSORS}
    whole = dict.fromkeys(("ids", "seen_by", "seen_from"), torch.int64) | {"max_range": torch.bool}
    for name, tensor in tensors.items():
        require(tensors, name, (None,) * tensor.ndim, whole.get(name, torch.float64), path)
    if tensors["means"].ndim != 2 or tensors["means"].shape[1] not in (2, 3):
        raise DataError(
            f"{path}: means has shape {tuple(tensors['means'].shape)}; expected (K, 2) or (K, 3)."
        )
    try:
        return Components(**tensors, attributes=Attributes.of(known)).checked()
    except GmmTorchError as error:
        raise DataError(f"{path}: {error}") from error

"""Batches: components as bytes, any number of them; and map files, which hold one. See docs/formats.md.

A component takes 6 to 8 bytes in 3D and 6 in 2D, and a third less on the coarse lattice. Its rounding error
is bounded in its own standard deviations (see `lattice`), and its covariance stays positive definite. A
component decodes to the same values in every batch: `decode(encode(c))` is `quantized(c)`, and encoding
decoded components again, in any grouping, changes nothing.

A batch is its sizes, and one code of all values (`context_model`), in which neighbours predict one another.
Components in `spatial_order` take the fewest bytes. A batch with channels ends with the block of their
attributes (`attribute_block`).

A map file is a safetensors container, about 200 bytes, with a batch and the settings of the map that differ
from the defaults of the file format. No pickle.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import (
    DAMAGED_CONTENT,
    DataError,
    GmmTorchError,
    InvalidArgumentError,
    check_choice,
    check_resolution,
    check_whole,
)
from gmmtorch.files import pack_tensors, read_tensors, require, unpack_tensors
from gmmtorch.kernels import CodedBatch
from gmmtorch.linalg import all_equal, as_tensors
from gmmtorch.mapping.attributes.moments import Attributes
from gmmtorch.mapping.codec.attribute_block import decode_attributes, encode_attributes
from gmmtorch.mapping.codec.bitstream import BitReader, BitWriter
from gmmtorch.mapping.codec.context_model import read_batch, write_batch
from gmmtorch.mapping.codec.first_version import read_first
from gmmtorch.mapping.codec.lattice import COARSER, Lattice, nearest
from gmmtorch.mapping.codec.quantization import (
    LARGEST_SIDE,
    LEAST_SIDE,
    ORIGIN_STEP,
    Quantized,
    cell_exponent,
    cells_of,
    coarse_counts,
    number_after,
    quantize,
    quantize_numbered,
    ranked,
)
from gmmtorch.mapping.components import DTYPES, TENSORS, Components
from gmmtorch.mapping.learning.rules import LearningRule, changed_options, rule_facts
from gmmtorch.mapping.query_options import QueryOptions, check_method
from gmmtorch.occupancy import Calibration
from gmmtorch.scan import FARTHEST

FIRST_VERSION, BATCH_VERSION, CHANNELS_VERSION, COARSE_VERSION = 1, 2, 3, 4
_VERSION_BYTES, _CHECKSUM_BYTES = 1, 4
_SIDE_BITS = 5
_LONGEST_SIZES = 32  # bytes
_VALUES_EACH = 64  # values of attributes for each component that a batch of limited size may have


def encode(components: Components, channels: bool = False) -> bytes:
    """A batch of components. Raises `InvalidArgumentError` for values that are too large to be stored."""
    return encode_quantized(quantize(components), channels)


def encode_quantized(values: Quantized, channels: bool = False) -> bytes:
    """A batch of components that `quantize` has rounded. The values are not checked again.

    channels: whether it has their attributes, those that a component has.
    """
    body = _geometry(values)
    if channels:
        size = BitWriter()
        size.number(len(body))
        block = encode_attributes(values.attributes.present(), values.places.restored()[1])
        body = bytes([CHANNELS_VERSION]) + size.to_bytes() + body + block
    return body + zlib.crc32(body).to_bytes(_CHECKSUM_BYTES, "little")


def _geometry(values: Quantized) -> bytes:
    """A batch without attributes and checksum."""
    places = _coarse_places(values)
    is_coarse = places is not None
    if places is not None:
        values = replace(values, places=places)
    k, e = len(values), len(values.seen_from)
    side = min(cell_exponent(values.places) + is_coarse, LARGEST_SIDE)
    writer = BitWriter()
    writer.one(values.places.dim - 2, 1)
    writer.one(side - LEAST_SIDE, _SIDE_BITS)
    for size in (k, len(values.origins), e - k):
        writer.number(size)
    stream = write_batch(coded(values, side, is_coarse)).ljust(_least_bytes(k, len(values.origins), e), b"\0")
    return bytes([COARSE_VERSION if is_coarse else BATCH_VERSION]) + writer.to_bytes() + stream


def _coarse_places(values: Quantized) -> Lattice | None:
    """The means and covariances on the coarse lattice, perhaps with other axis orders; None unless all
    components are on it."""
    count = values.count.numpy()
    if not len(values) or not np.array_equal(count, coarse_counts(count)):
        return None
    means, covariances = values.places.restored()
    try:
        places = nearest(means, covariances, coarse=True)
    except InvalidArgumentError:  # beyond a bound, or its rounding is
        return None
    found = places.restored()
    return places if all_equal([(means, found[0]), (covariances, found[1])]) else None


def has_channels(batch: bytes) -> bool:
    """Whether a batch says which attributes its components have."""
    return batch[:_VERSION_BYTES] == bytes([CHANNELS_VERSION])


def fits(attributes: Attributes, most: int) -> bool:
    """Whether `decode` with this limit reads a batch with these attributes."""
    return sum(value.numel() for value in attributes.present().tensors().values()) <= _VALUES_EACH * most


def decode(data: bytes, most: int | None = None) -> Components:
    """The components of a batch, on the CPU. most: largest number of components, and of viewpoints.

    Raises `DataError`, with the reason, for data that `encode` did not write. Memory is bounded in proportion
    to the length of the data, for any numbers in them.
    """
    try:
        geometry, block = _parts(data)
        found = _values(geometry, most).restored()
        if block is not None:
            limit = None if most is None else _VALUES_EACH * most
            found = replace(found, attributes=decode_attributes(block, found.covariances, limit))
        return found.checked()
    except DataError:
        raise
    except GmmTorchError as error:
        raise DataError(f"The batch of components is damaged: {error}") from error


def ids_of_batch(data: bytes) -> Tensor:
    """The ids (K, 2) of the components of a batch. Raises as `decode` does, but does not check the rest."""
    return _values(_parts(data)[0]).ids


def _parts(data: bytes) -> tuple[bytes, bytes | None]:
    """The geometry of a batch without checksum, and the block of its attributes; None if it has none."""
    body, checksum = data[:-_CHECKSUM_BYTES], data[-_CHECKSUM_BYTES:]
    if len(data) <= _CHECKSUM_BYTES:
        raise DataError(f"{len(data)} bytes are too few for a batch of components: it is truncated.")
    if not FIRST_VERSION <= body[0] <= COARSE_VERSION:
        raise DataError(
            f"The batch of components is version {body[0]}; this gmmtorch reads versions {FIRST_VERSION} to "
            f"{COARSE_VERSION}. It is foreign or damaged, or gmmtorch needs an update."
        )
    if zlib.crc32(body) != int.from_bytes(checksum, "little"):
        raise DataError("The batch of components does not match its checksum: it is truncated or damaged.")
    if not has_channels(body):
        return body, None
    size = BitReader(body[_VERSION_BYTES:_LONGEST_SIZES])
    n_bits, n = size.left, size.number()
    begin = _VERSION_BYTES + (n_bits - size.left) // 8
    if not 0 < n <= len(body) - begin or body[begin] not in (BATCH_VERSION, COARSE_VERSION):
        raise DataError(f"{len(body)} bytes have no batch of {n} bytes: it is damaged.")
    return body[begin : begin + n], body[begin + n :]


def _values(body: bytes, most: int | None = None) -> Quantized:
    rest = body[_VERSION_BYTES:]
    found = read_first(rest) if body[0] == FIRST_VERSION else _read(rest, most, body[0] == COARSE_VERSION)
    farthest = int(FARTHEST / ORIGIN_STEP)
    if not bool(found.places.is_valid().all()) or bool((found.origins.abs() > farthest).any()):
        raise DataError("A mean, a covariance or an origin is out of range: it is damaged.")
    return found


def _read(data: bytes, most: int | None, coarse: bool) -> Quantized:
    """The components of a batch without version and checksum."""
    reader = BitReader(data[:_LONGEST_SIZES])
    n_bits = reader.left
    dim, side = 2 + reader.one(1), LEAST_SIDE + reader.one(_SIDE_BITS)
    k, n_origins, more = reader.number(), reader.number(), reader.number()
    e, begin = k + more, -((reader.left - n_bits) // 8)
    least = _least_bytes(k, n_origins, e)
    stream = data[begin:]
    is_whole = len(stream) == max(len(stream.rstrip(b"\0")), least)
    if most is not None and max(k, e) > most:
        raise DataError(f"{k} components and {e} viewpoints; {most} of each are the most.")
    if min(k, n_origins, e) < 0 or n_origins > e or side > LARGEST_SIDE or not is_whole:
        raise DataError(
            f"{k} components, {n_origins} origins and {e} viewpoints in {len(stream)} bytes: it is damaged."
        )
    rows: dict[str, tuple[int, ...]] = {
        "axis_order": (k,),
        "deviation": (k, dim),
        "shear": (k, dim * (dim - 1) // 2),
        "mean": (k, dim),
        "count": (k,),
        "max_range": (k,),
        "ids": (k, 2),
        "origins": (n_origins, dim),
        "n_viewpoints": (k,),
        "seen_from": (e,),
        "share": (e,),
        "cells": (k, dim),
    }
    b = CodedBatch(side, coarse, **{name: np.zeros(shape, np.int64) for name, shape in rows.items()})
    read_batch(b, stream)
    shear, mean = (steps << COARSER * coarse for steps in (b.shear, b.mean))
    rank = ranked(b.origins)[0][b.seen_from]
    order = np.argsort(np.arange(k).repeat(b.n_viewpoints) * n_origins + rank, kind="stable")
    shapes, sights = (b.axis_order, b.deviation, shear, mean), (b.seen_from[order], b.share[order])
    *places, count, ids, origins, n, seen_from, share = as_tensors(
        *shapes, b.count, b.ids, b.origins, b.n_viewpoints, *sights
    )
    max_range = torch.from_numpy(b.max_range.astype(bool))
    return Quantized(Lattice(*places), count, max_range, ids, origins, n, seen_from, share)


def coded(values: Quantized, side: int, coarse: bool) -> CodedBatch:
    """The values as the coder takes them. coarse: whether all are on the coarse lattice."""
    tensors = {**vars(values), **vars(values.places)}
    del tensors["places"], tensors["attributes"]
    arrays = {name: np.ascontiguousarray(tensor.numpy(), np.int64) for name, tensor in tensors.items()}
    arrays |= {name: arrays[name] >> COARSER * coarse for name in ("shear", "mean")}
    return CodedBatch(side, coarse, **arrays, cells=np.ascontiguousarray(cells_of(values.places, side)))


def _least_bytes(k: int, n_origins: int, e: int) -> int:
    """Shorter streams are filled with zeros, so that their length bounds the memory of a reader."""
    return max(k, n_origins, e) // 8


FILE_KIND, FILE_VERSION = "gmmtorch.map", 2

CODECS = ("quantized", "float")
"""6 to 8 bytes a component, rounded within bounds; or every number as it is, about 150 bytes."""

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
    return _container(quantize(components), facts)


def file_size(components: Components, rule: LearningRule, settings: MapSettings, next_number: int) -> int:
    """Bytes of the file of components before they are numbered, without writing it; and room for settings
    that change while the map is built."""
    components = components.on_cpu()
    numbers = components.ids.numpy()[:, 1]
    if settings.query.prior is None:  # a map that has predicted its next window states its calibration
        known = settings.query.calibration or Calibration.prior(1.0)
        settings = replace(settings, query=replace(settings.query, calibration=known))
    after = max(next_number + int((numbers < 0).sum()), int(numbers.max(initial=-1)) + 1)
    facts = _facts(rule, settings, after)
    if settings.codec == "float":
        data = _exact_file(components, facts)
    else:
        data = _container(quantize_numbered(components, settings.robot, next_number), facts)
    return len(data) + _ROOM_FOR_SETTINGS


def read_map(path: str | Path, data: bytes | None = None) -> tuple[Components, dict[str, Any]]:
    """Components and settings of a map file; `data`: its bytes, if they are read already. Raises `DataError`
    for a damaged or foreign file."""
    if data is None:
        tensors, facts = read_tensors(path, FILE_KIND, FILE_VERSION)
    else:
        tensors, facts = unpack_tensors(data, path, FILE_KIND, FILE_VERSION)
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
    except (DataError, *DAMAGED_CONTENT) as error:  # attributes of other components
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
    except DAMAGED_CONTENT as error:
        raise DataError(f"{path}: its settings are damaged ({error!r}).") from error
    return MapSettings(resolution, facts["method"], facts["codec"], robot, query)


def _container(values: Quantized, facts: dict[str, Any]) -> bytes:
    blocks = {"components": encode_quantized(values)}
    if values.attributes:
        blocks[_ATTRIBUTES] = encode_attributes(values.attributes, values.places.restored()[1])
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
    for name, tensor in tensors.items():
        require(tensors, name, (None,) * tensor.ndim, DTYPES.get(name, torch.float64), path)
    try:
        return Components(**tensors, attributes=Attributes.of(known)).checked()
    except GmmTorchError as error:
        raise DataError(f"{path}: {error}") from error

"""Map files: one batch of the codec in a safetensors container, with the settings of the map. No pickle.

The container takes about 200 bytes. Settings are written only if they differ from the defaults of the file
format. See docs/formats.md.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gmmtorch.errors import (
    DataError,
    GmmTorchError,
    check_choice,
    check_resolution,
    check_whole,
)
from gmmtorch.files import pack_tensors, read_tensors, require, unpack_tensors
from gmmtorch.mapping.codec.component_batch import batch_bytes, decode, encode
from gmmtorch.mapping.codec.quantization import number_after, quantize_numbered
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.learning.rules import LearningRule, changed_options, rule_facts
from gmmtorch.mapping.query_options import QueryOptions, check_method
from gmmtorch.occupancy import Calibration

FILE_KIND, FILE_VERSION = "gmmtorch.map", 2

CODECS = ("quantized", "float")
"""About 10 bytes a component, rounded within bounds; or every number as it is, about 150 bytes."""

FILE_OPTIONS = QueryOptions(prior=1.0, cutoff=5.0)
"""The query options of a file that contains none; they are not those of `GaussianMap()`."""

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


def to_bytes(components: Components, rule: LearningRule, settings: MapSettings, next_number: int) -> bytes:
    """A map file. `next_number`: sequence number of the next new component."""
    facts = _facts(rule, settings, number_after(components.ids, next_number))
    if settings.codec == "float":
        return pack_tensors(vars(components), FILE_KIND, FILE_VERSION, **facts)
    return _container(torch.frombuffer(bytearray(encode(components)), dtype=torch.uint8), facts)


def file_size(components: Components, rule: LearningRule, settings: MapSettings, next_number: int) -> int:
    """Bytes of the file of components before they are numbered, without writing it; and room for settings
    that change while the map is built."""
    n_new = int((components.ids[:, 1] < 0).sum())
    if settings.query.prior is None:  # a map that has predicted its next window states its calibration
        known = settings.query.calibration or Calibration.prior(1.0)
        settings = replace(settings, query=replace(settings.query, calibration=known))
    facts = _facts(rule, settings, number_after(components.ids, next_number + n_new))
    if settings.codec == "float":
        data = pack_tensors(vars(components), FILE_KIND, FILE_VERSION, **facts)
    else:
        values = quantize_numbered(components, settings.robot, next_number)
        data = _container(torch.zeros(batch_bytes(values), dtype=torch.uint8), facts)
    return len(data) + _ROOM_FOR_SETTINGS


def from_file(path: str | Path) -> tuple[Components, dict[str, Any]]:
    """Components and settings of a map file. Raises `DataError` for a damaged or foreign file."""
    return _content(*read_tensors(path, FILE_KIND, FILE_VERSION), path)


def from_bytes(data: bytes, path: str | Path) -> tuple[Components, dict[str, Any]]:
    """`from_file` of bytes that were read from `path`."""
    return _content(*unpack_tensors(data, path, FILE_KIND, FILE_VERSION), path)


def _content(
    tensors: dict[str, Tensor], facts: dict[str, Any], path: str | Path
) -> tuple[Components, dict[str, Any]]:
    facts = {"cutoff": FILE_OPTIONS.cutoff, **_with_calibration(facts, path)}
    if tensors.keys() == {f.name for f in fields(Components)}:
        return _exact(tensors, path), facts
    batch = require(tensors, "components", (None,), torch.uint8, path)
    try:
        return decode(batch.numpy().tobytes()), facts
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


def _container(batch: Tensor, facts: dict[str, Any]) -> bytes:
    return pack_tensors({"components": batch}, FILE_KIND, FILE_VERSION, **facts)


def _exact(tensors: dict[str, Tensor], path: str | Path) -> Components:
    """Components of a file with codec "float"."""
    whole = dict.fromkeys(("ids", "seen_by", "seen_from"), torch.int64) | {"max_range": torch.bool}
    for name, tensor in tensors.items():
        require(tensors, name, (None,) * tensor.ndim, whole.get(name, torch.float64), path)
    if tensors["means"].ndim != 2 or tensors["means"].shape[1] not in (2, 3):
        raise DataError(
            f"{path}: means has shape {tuple(tensors['means'].shape)}; expected (K, 2) or (K, 3)."
        )
    try:
        return Components(**tensors).checked()
    except GmmTorchError as error:
        raise DataError(f"{path}: {error}") from error

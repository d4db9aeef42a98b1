"""A map's file: one batch of the codec in a safetensors container, with its settings. No pickle.

The container costs some 200 bytes; settings are written only where they are not the defaults. See
docs/formats.md.
"""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gmmtorch.errors import DataError, GmmTorchError
from gmmtorch.files import pack_tensors, read_tensors, require
from gmmtorch.mapping.codec import storage_v1
from gmmtorch.mapping.codec.component_batch import decode, encode, quantized
from gmmtorch.mapping.components import Components

FILE_KIND, FILE_VERSION = "gmmtorch.map", 2

CODECS = ("quantized", "float")
"""Some 10 bytes a component, rounded within bounds; or every number as it is, some 150 bytes."""


def to_bytes(components: Components, facts: dict[str, Any], codec: str = "quantized") -> bytes:
    """The file's bytes; `facts` are the map's settings, JSON. `codec`: one of `CODECS`."""
    if codec == "float":
        return pack_tensors(vars(components), FILE_KIND, FILE_VERSION, **facts)
    batch = torch.frombuffer(bytearray(encode(components)), dtype=torch.uint8)
    return pack_tensors({"components": batch}, FILE_KIND, FILE_VERSION, **facts)


def from_file(path: str | Path) -> tuple[Components, dict[str, Any]]:
    """Components and settings of a map file. Raises `DataError` when it is not sound.

    Files of version 1, whose components were less rounded, are rounded as they are read.
    """
    tensors, facts = read_tensors(path, FILE_KIND, FILE_VERSION, 1)
    if tensors.keys() == {f.name for f in fields(Components)}:
        return _exact(tensors, path), facts
    if "components" not in tensors:
        return quantized(storage_v1.components(tensors, path)), storage_v1.settings(facts)
    batch = require(tensors, "components", (None,), torch.uint8, path)
    try:
        return decode(batch.numpy().tobytes()), facts
    except DataError as error:
        raise DataError(f"{path}: {error}") from error


def _exact(tensors: dict[str, Tensor], path: str | Path) -> Components:
    """Components whose every number was written as it is."""
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

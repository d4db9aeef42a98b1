"""A map's components as a file: float32 relative to a whole-metre frame, safetensors, no pickle.

What is written: means (D floats), covariance (D(D+1)/2), support, max-range flag, id; the table of
origins (D floats each); for each component the number of its sightings, and for each sighting an
origin index and a count. See docs/formats.md.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gmmtorch.errors import DataError, GmmTorchError
from gmmtorch.files import pack_tensors, read_tensors, require
from gmmtorch.linalg import pack_symmetric, unpack_symmetric
from gmmtorch.mapping.components import Components

FILE_KIND, FILE_VERSION = "gmmtorch.map", 1
_POSITION_STEP = 2.0**-16  # metres: 15 µm


def storable(components: Components, frame: Tensor) -> Components:
    """The components rounded to what the file holds, so that a loaded map answers as the saved one.

    Positions go to a multiple of 2⁻¹⁶ m from the frame and to float32 (exact within 256 m of it),
    covariances and counts to float32.
    """

    def single(x: Tensor) -> Tensor:
        return x.float().double()

    def position(x: Tensor) -> Tensor:
        return frame + single(torch.round((x - frame) / _POSITION_STEP) * _POSITION_STEP)

    return replace(
        components,
        means=position(components.means),
        covariances=single(components.covariances),
        support=single(components.support),
        origins=position(components.origins),
        seen_count=single(components.seen_count),
    )


def to_bytes(components: Components, frame: Tensor, facts: dict[str, Any]) -> bytes:
    """The file's bytes. `frame` (D,) is in whole metres."""
    n_origins = components.origins.shape[0]
    index_dtype = torch.uint8 if n_origins <= 256 else torch.int32
    order = torch.argsort(components.seen_by, stable=True)
    sightings = torch.bincount(components.seen_by, minlength=len(components))
    many = bool((sightings > 255).any())
    tensors = {
        "frame": frame,
        "means": (components.means - frame).float(),
        "covariances": pack_symmetric(components.covariances).float(),
        "support": components.support.float(),
        "max_range": components.max_range.to(torch.uint8),
        "ids": components.ids.to(torch.int32),
        "origins": (components.origins - frame).float(),
        "sightings": sightings.to(torch.int32 if many else torch.uint8),
        "seen_from": components.seen_from[order].to(index_dtype),
        "seen_count": components.seen_count[order].float(),
    }
    return pack_tensors(tensors, FILE_KIND, FILE_VERSION, **facts)


def from_file(path: str | Path) -> tuple[Components, Tensor, dict[str, Any]]:
    """Components, frame and facts of a map file. Raises `DataError` when it is not sound."""
    tensors, facts = read_tensors(path, FILE_KIND, FILE_VERSION)
    single = torch.float32
    means = require(tensors, "means", (None, None), single, path)
    k, dim = means.shape
    if dim not in (2, 3):
        raise DataError(f"{path}: the components are {dim}-dimensional; a map has 2 or 3 dimensions.")
    frame = require(tensors, "frame", (dim,), torch.float64, path)
    packed = require(tensors, "covariances", (k, dim * (dim + 1) // 2), single, path)
    origins = require(tensors, "origins", (None, dim), single, path)
    sightings = _index(tensors, "sightings", (k,), path)
    seen_from = _index(tensors, "seen_from", (None,), path)
    count = require(tensors, "seen_count", (seen_from.shape[0],), single, path)
    if int(sightings.sum()) != seen_from.shape[0]:
        raise DataError(
            f"{path}: {int(sightings.sum())} sightings are announced, {seen_from.shape[0]} follow."
        )
    try:
        components = Components(
            means=means.double() + frame,
            covariances=unpack_symmetric(packed, dim).double(),
            support=require(tensors, "support", (k,), single, path).double(),
            max_range=require(tensors, "max_range", (k,), torch.uint8, path).bool(),
            ids=require(tensors, "ids", (k, 2), torch.int32, path).long(),
            origins=origins.double() + frame,
            seen_by=torch.repeat_interleave(sightings),
            seen_from=seen_from,
            seen_count=count.double(),
        ).checked()
    except GmmTorchError as error:
        raise DataError(f"{path}: {error}") from error
    return components, frame, facts


def _index(tensors: dict[str, Tensor], name: str, shape: tuple[int | None, ...], path: str | Path) -> Tensor:
    """An index tensor that is stored as uint8 or int32, as int64; never negative."""
    dtype = torch.uint8 if name in tensors and tensors[name].dtype == torch.uint8 else torch.int32
    value = require(tensors, name, shape, dtype, path).long()
    if value.numel() and int(value.min()) < 0:
        raise DataError(f"{path}: {name} holds negative numbers; the file is damaged.")
    return value

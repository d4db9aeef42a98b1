"""Cache of the computed cells of worlds on disk: bit-packed, found by a hash of everything they depend on."""

from __future__ import annotations

import hashlib
import json
import logging
import math
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import DataError, MissingDataError, OutputError
from gmmtorch.files import pack_tensors, read_tensors, require, write_bytes

_log = logging.getLogger(__name__)

_KIND = "gmmtorch-world"
VERSION = 1
"""Increase it when the same mesh would give other cells."""


def cache_folder() -> Path:
    """Return $GMMTORCH_CACHE, else gmmtorch in $XDG_CACHE_HOME, else in ~/.cache."""
    own = os.environ.get("GMMTORCH_CACHE")
    if own:
        return Path(own)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()) / "gmmtorch"


def cached_cells(
    triangles: Tensor,
    options: Mapping[str, Any],
    names: tuple[str, ...],
    shape: tuple[int, ...],
    compute: Callable[[], dict[str, Tensor]],
) -> dict[str, Tensor]:
    """Return bool tensors of this shape by name, from the cache, or computed and stored there."""
    key = world_key(triangles, options)
    cells = load_cells(key, names, shape)
    if cells is None:
        cells = compute()
        save_cells(key, cells)
    return cells


def world_key(triangles: Tensor, options: Mapping[str, Any]) -> str:
    """Hash triangles (T, 3, 3), float64, options (JSON), and the version."""
    digest = hashlib.sha256(triangles.contiguous().numpy().tobytes())
    digest.update(json.dumps({"version": VERSION, **options}, sort_keys=True).encode())
    return digest.hexdigest()


def load_cells(key: str, names: tuple[str, ...], shape: tuple[int, ...]) -> dict[str, Tensor] | None:
    """Read bool tensors of this shape by name; None if the file is missing or damaged."""
    path = _path(key)
    try:
        tensors, facts = read_tensors(path, _KIND, VERSION)
        packed = [
            require(tensors, name, (math.ceil(math.prod(shape) / 8),), torch.uint8, path) for name in names
        ]
        if facts.get("key") != key or facts.get("shape") != list(shape):
            raise DataError(f"{path} belongs to another world.")
    except MissingDataError:
        return None
    except (DataError, OSError) as error:
        _log.warning("The cached world cannot be used and is computed again: %s", error)
        return None
    bits = (np.unpackbits(part.numpy(), count=math.prod(shape)) for part in packed)
    return {
        name: torch.from_numpy(bit.view(np.bool_)).view(shape) for name, bit in zip(names, bits, strict=True)
    }


def save_cells(key: str, cells: Mapping[str, Tensor]) -> None:
    """Store bool tensors, all of one shape. A failure is logged as a warning."""
    packed = {name: torch.from_numpy(np.packbits(cell.numpy())) for name, cell in cells.items()}
    shape = list(next(iter(cells.values())).shape)
    data = pack_tensors(packed, _KIND, VERSION, key=key, shape=shape)
    try:
        write_bytes(_path(key), data)
    except OutputError as error:
        _log.warning("The world is not cached: %s", error)


def _path(key: str) -> Path:
    return cache_folder() / "worlds" / f"{key[:32]}.safetensors"

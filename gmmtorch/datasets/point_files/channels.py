"""Channels of points in files and messages: colour, intensity, class, and any field by its own name.

Sensors and programs name and scale the same channel differently; here each becomes what `Scan` takes.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gmmtorch.datasets.point_files.las_files import LasRows
from gmmtorch.datasets.point_files.mesh_files import ply_fields, ply_rows
from gmmtorch.datasets.point_files.pcd_files import pcd_fields, pcd_rows
from gmmtorch.datasets.point_files.point_rows import PACKED, Rows
from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.scan import COLOUR, INTENSITY, LARGEST_LABEL, linear_colours

CLASS = "class"
_NAMES: dict[str, tuple[str, ...]] = {
    CLASS: ("class", "label", "classification", "semantic", "scalar_label", "scalar_classification"),
    INTENSITY: ("intensity", "reflectivity", "reflectance", "i", "scalar_intensity"),
}
_COLOURS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
_FROM_FLOAT = 255.0  # the largest value of colours in a floating type that are not from 0 to 1


def check_channels(wanted: Iterable[str], known: Collection[str] = (), fault: str = "") -> tuple[str, ...]:
    """Names of channels. Raises `InvalidArgumentError` unless they are a list of distinct names, and with
    `fault` for names other than the known ones, if there are some."""
    if isinstance(wanted, str):
        raise InvalidArgumentError(f"attributes={wanted!r} must be a list, such as [{wanted!r}].")
    names = tuple(wanted)
    if any(not isinstance(name, str) or not name for name in names) or len(set(names)) < len(names):
        raise InvalidArgumentError(f"attributes={list(names)} must be distinct names of channels.")
    if known and not set(names) <= set(known):
        raise InvalidArgumentError(f"attributes={list(names)}: {fault}.")
    return names


def fields_of(channel: str, fields: Iterable[str]) -> tuple[str, ...]:
    """The fields of a file or message that make a channel; none if it lacks the channel."""
    known = {name.lower(): name for name in fields}
    if channel == COLOUR:
        choices = (*_COLOURS, *((name,) for name in PACKED))
    else:
        choices = tuple((name,) for name in _NAMES.get(channel, (channel.lower(),)))
    found = next((names for names in choices if all(name in known for name in names)), ())
    return tuple(known[name] for name in found)


def channel_of(name: str, columns: Sequence[np.ndarray], kinds: Sequence[np.dtype], where: str) -> Tensor:
    """A channel (N, …) of its fields (N,), whose types in the source are `kinds`.

    Colours are sRGB: packed in 32 bits, whole numbers up to the largest of their type, or floating ones from
    0 to 1 or to 255. Raises `DataError`, which begins with `where`, for values out of range.
    """
    if name == COLOUR:
        return linear_colours(torch.from_numpy(_colours(columns, kinds, where)))
    values = np.asarray(columns[0], np.float64)
    values = np.where(np.isinf(values), np.nan, values)
    if name != CLASS:
        return torch.from_numpy(values)
    bad = (values < -1) | (values > LARGEST_LABEL) | (values != np.floor(values)) & ~np.isnan(values)
    if bad.any():
        raise DataError(f"{where} has the label {values[bad][0]:g}; labels are 0 to {LARGEST_LABEL}.")
    return torch.from_numpy(np.where(np.isnan(values), -1, values).astype(np.int64))


def _colours(columns: Sequence[np.ndarray], kinds: Sequence[np.dtype], where: str) -> np.ndarray:
    """sRGB (N, 3) from 0 to 1, float32."""
    if len(columns) == 1:
        packed = np.asarray(columns[0], np.float64).astype(np.int64)
        return np.stack([packed >> shift & 255 for shift in (16, 8, 0)], 1).astype(np.float32) / 255
    values = np.stack([np.asarray(column, np.float32) for column in columns], 1)
    known = values[np.isfinite(values)]
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)
    if kinds[0].kind == "f":
        scale = 1.0 if high <= 1 else _FROM_FLOAT
    else:
        scale = float(np.iinfo(kinds[0]).max)
        if scale > _FROM_FLOAT and 1 < high <= _FROM_FLOAT:
            scale = _FROM_FLOAT  # LAS asks for 16 bits, but many programs write 8
    if low < 0 or high > scale:
        raise DataError(f"{where} has colours from {low:g} to {high:g}; expected 0 to 1, or 0 to 255.")
    values[~np.isfinite(values)] = np.nan
    return values / np.float32(scale)


def read_channels(path: str | Path, wanted: Iterable[str]) -> dict[str, Tensor]:
    """The channels of the points of a PCD, PLY, LAS or LAZ file that it has, in the order of the points.

    Args:
        wanted: "colour", "intensity", "class", or other names of fields, such as "ring".

    Raises `InvalidArgumentError` for another suffix or a bad list, and `DataError` for a damaged file or
    values out of range.
    """
    path, names = Path(path), check_channels(wanted)
    fields, rows_of = _opened(path)
    found = {}
    for name in names:
        chosen = fields_of(name, fields)
        if chosen:
            rows = rows_of(path, chosen)
            blocks = list(rows.blocks(0, rows.n_rows, max(1, rows.n_rows)))
            table = np.concatenate([np.empty((0, len(chosen))), *blocks])
            if len(chosen) == 1 and name == COLOUR:
                table = _bits(table, fields[chosen[0]], path)
            found[name] = channel_of(name, list(table.T), [fields[field] for field in chosen], str(path))
    return found


def _bits(table: np.ndarray, kind: np.dtype, path: Path) -> np.ndarray:
    """Packed colours that a text file writes as floating numbers, as their bits."""
    if kind.kind != "f" or (table == np.floor(table)).all():
        return table
    return table.astype(np.float32).view(np.uint32).astype(np.float64)


def _opened(path: Path) -> tuple[Mapping[str, np.dtype], Callable[[Path, Sequence[str]], Rows]]:
    """The fields of a file, and the reader of some of them."""
    suffix = path.suffix.lower()
    if suffix == ".pcd":
        return pcd_fields(path), pcd_rows
    if suffix == ".ply":
        return ply_fields(path), ply_rows
    if suffix in (".las", ".laz"):
        return LasRows(path).fields, LasRows
    raise InvalidArgumentError(f"{path} has no channels: they are read from .pcd, .ply, .las and .laz files.")

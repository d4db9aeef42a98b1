"""Triangle meshes from PLY, OBJ and STL files. Polygons become fans of triangles.

Sizes that a header announces are compared with the data before anything is allocated.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gmmtorch.datasets.point_files.cloud_files import (
    AXES,
    PlyProperty,
    check_length,
    ply_elements,
)
from gmmtorch.datasets.point_files.cloud_files import read_header as read_cloud_header
from gmmtorch.errors import DataError

_INDICES = ("vertex_indices", "vertex_index")
_STL_HEADER_BYTES = 80
_STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_VERTEX = re.compile(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)")


def read_triangles(path: Path) -> Tensor:
    """Triangles (T, 3, 3), float64, of a PLY, OBJ or STL file.

    Raises `DataError` if the file is unreadable or truncated, has no triangle, or has a corner that is not
    finite.
    """
    readers: dict[str, Callable[[Path], np.ndarray]] = {".ply": _ply, ".obj": _obj, ".stl": _stl}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise DataError(f"{path} is not a PLY, OBJ or STL file; convert the mesh to one of these formats.")
    try:
        triangles = reader(path)
    except (ValueError, IndexError, KeyError, OverflowError, struct.error) as error:
        raise DataError(
            f"{path} contains no readable triangles ({error}); it is truncated, a point cloud, or not a "
            "mesh. Give a PLY, OBJ or STL file with faces."
        ) from error
    if len(triangles) == 0:
        raise DataError(f"{path} contains no readable triangles; give a PLY, OBJ or STL file with faces.")
    if not np.isfinite(triangles).all():
        raise DataError(f"{path}: a corner is NaN or infinite; the file is damaged.")
    return torch.from_numpy(triangles)


def _fans(corners: np.ndarray, polygons: list[np.ndarray]) -> np.ndarray:
    """Triangles (T, 3, 3) of polygons: arrays (F, k) of rows of `corners` (V, 3)."""
    indices = [p[:, [0, i, i + 1]] for p in polygons for i in range(1, p.shape[1] - 1)]
    faces = np.concatenate(indices) if indices else np.empty((0, 3), np.int64)
    if faces.size and (faces.min() < 0 or faces.max() >= len(corners)):
        raise ValueError("a face refers to a missing corner")
    return corners[faces]


def _by_size(polygons: list[list[int]]) -> list[np.ndarray]:
    """Polygons as one array (F, k) for each number k of corners."""
    found: dict[int, list[list[int]]] = {}
    for polygon in polygons:
        found.setdefault(len(polygon), []).append(polygon)
    return [np.array(same, np.int64).reshape(len(same), size) for size, same in found.items()]


def _ply(path: Path) -> np.ndarray:
    check_length(path, read_cloud_header(path))
    elements, data = ply_elements(path), path.read_bytes()
    order = ">" if elements.form == "binary_big_endian" else "<"
    corners = np.empty((0, 3))
    polygons: list[np.ndarray] = []
    is_text = elements.form == "ascii"
    values = np.array(data[elements.n_bytes :].split() if is_text else [], np.float64)
    start = 0 if is_text else elements.n_bytes
    for name, count in elements.counts.items():
        properties = elements.properties[name]
        if is_text:
            columns, start = _text_records(values, start, count, properties)
        else:
            columns, start = _binary_records(data, start, count, properties, order)
        if name == "vertex":
            corners = np.stack([columns[axis] for axis in AXES], 1).astype(np.float64)
        elif name == "face":
            polygons = next((columns[key] for key in _INDICES if key in columns), [])
    return _fans(corners, polygons)


def _binary_records(
    raw: bytes, start: int, count: int, properties: list[PlyProperty], order: str
) -> tuple[dict, int]:
    """The columns of one element by name (lists as arrays (F, k), grouped by k), and the byte after it."""
    if count == 0:
        return {p.name: [] if p.is_list else np.empty(0) for p in properties}, start

    def record(at: int) -> np.dtype:
        """The layout of the record at a byte."""
        fields: list[Any] = []
        for p in properties:
            if not p.is_list:
                fields += [(p.name, order + p.code)]
                continue
            length = int(np.frombuffer(raw, order + p.code, 1, at + np.dtype(fields).itemsize)[0])
            if not 0 <= length * np.dtype(p.item).itemsize <= len(raw) - at:
                raise ValueError(f"a list of {length} entries exceeds the file")
            fields += [(f"#{p.name}", order + p.code), (p.name, order + p.item, (length,))]
        return np.dtype(fields)

    first = record(start)
    lists = [p.name for p in properties if p.is_list]
    if first.itemsize * count <= len(raw) - start:
        table = np.frombuffer(raw, first, count, start)
        if all((table[f"#{name}"] == table[f"#{name}"][0]).all() for name in lists):
            polygons = {name: [table[name].astype(np.int64)] for name in lists}
            return {**{p.name: table[p.name] for p in properties}, **polygons}, start + table.nbytes
    found: dict[str, list[list[int]]] = {name: [] for name in lists}
    for _ in range(count):
        layout = record(start)
        row = np.frombuffer(raw, layout, 1, start)[0]
        start += layout.itemsize
        for name in lists:
            found[name].append(row[name].tolist())
    return {name: _by_size(polygons) for name, polygons in found.items()}, start


def _text_records(
    values: np.ndarray, start: int, count: int, properties: list[PlyProperty]
) -> tuple[dict, int]:
    """As `_binary_records`, from the numbers of a text file."""
    if not any(p.is_list for p in properties):
        table = values[start : start + count * len(properties)].reshape(count, len(properties))
        return {p.name: table[:, i] for i, p in enumerate(properties)}, start + table.size
    found: dict[str, list[list[int]]] = {p.name: [] for p in properties if p.is_list}
    for _ in range(count):
        for p in properties:
            length = int(values[start]) if p.is_list else 0
            if p.is_list:
                if not 0 <= length < len(values) - start:
                    raise ValueError("the text ends within a face")
                found[p.name].append(values[start + 1 : start + 1 + length].astype(np.int64).tolist())
            start += 1 + length
    return {name: _by_size(polygons) for name, polygons in found.items()}, start


def _obj(path: Path) -> np.ndarray:
    corners: list[list[bytes]] = []
    polygons: list[list[int]] = []
    with path.open("rb") as file:
        for line in file:
            words = line.split()
            if words[:1] == [b"v"]:
                corners.append(words[1:4])
            elif words[:1] == [b"f"]:
                numbers = [int(word.split(b"/")[0]) for word in words[1:]]
                polygons.append([n - 1 if n > 0 else len(corners) + n for n in numbers])
    return _fans(np.array(corners, np.float64).reshape(-1, 3), _by_size(polygons))


def _stl(path: Path) -> np.ndarray:
    data = path.read_bytes()
    start = _STL_HEADER_BYTES + 4
    count = int.from_bytes(data[_STL_HEADER_BYTES:start], "little")
    if len(data) == start + count * _STL_TRIANGLE.itemsize:
        return np.frombuffer(data, _STL_TRIANGLE, count, start)["corners"].astype(np.float64)
    if not data.lstrip().startswith(b"solid"):
        raise ValueError(f"{count} triangles are announced, but it has {len(data)} bytes")
    return np.array(_VERTEX.findall(data), np.float64).reshape(-1, 3, 3)
